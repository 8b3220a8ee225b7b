"""Device profiles, and the devices of one arm in their places: name in the contract, node id, profile, objects.

A profile is a short TOML that, with an EDS, describes a drive or a sensor well enough to be run.

The EDS lists a device's objects and their types. The profile adds the rest: the frame and signal name of each object
that travels on the bus, the worth of one count, the protection of frames, the device's abilities.
Source: CiA 306 (EDS), CiA 301 clause 7.5.2 (PDO parameters), CiA 402-2, CiA 404.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from adacd_hil.device.canopen_bus import ANSWER_TIMEOUT_S, EdsVariable, find_variable
from adacd_hil.device.drive_units import LEAST_INCREMENTS
from adacd_hil.remedies import hint
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.schema import ConfigError, setting
from adacd_hil.wire.e2e import PROFILES_BY_CODE

FEATURES = (
    "heartbeat_consumer",
    "sync_counter",
    "option_codes",
    "torque_limits",
    "sync_tolerance",
    "watchdog_in_emcy",
)
"""Kinds of object that a profile may name; the host uses such an object only if the EDS lists it too.

heartbeat_consumer 0x1016; sync_counter 0x1019; option_codes 0x605A, 0x605E; torque_limits 0x6072, 0x60E0, 0x60E1;
sync_tolerance 0x2201, without which the set-up fails; watchdog_in_emcy: EMCY byte 3 is the watchdog's number, bytes 4
to 7 the device's time in ms.
"""
LAST_SYNCHRONOUS = 240
RECEIVED, SENT, TO_MAPPING = 0x1400, 0x1800, 0x200
"""First communication parameters of RPDO and TPDO, and their distance to the mapping parameters."""
COMMAND_WATCHDOGS = NO_WATCHDOG, SYNC_WATCHDOG, EVENT_TIMER = "none", "0x2200", "0x1400:5"
EMCY_INHIBIT_100US = 100
"""0x1015 of every device that has it: one EMCY per device and 10 ms, so that a storm of errors can't take the bus."""


@dataclass(frozen=True)
class ObjectName:
    """An object with its sub-index, `0x6064` or `0x9130:1` in text."""

    index: int
    sub: int = 0

    def __str__(self) -> str:
        return f"0x{self.index:04X}" + (f":{self.sub}" if self.sub else "")


def parse_object(text: str) -> ObjectName:
    """Return the object that a text like `0x9130:1` or `0x6064` names.

    Raises ValueError for another form, and outside 0x0001 to 0xFFFF:255.
    """
    index, _, sub = text.partition(":")
    try:
        name = ObjectName(int(index, 16), int(sub or "0"))
    except ValueError:
        raise ValueError(f"object {text!r} must be like 0x6064 or 0x9130:1") from None
    if not (0 < name.index <= 0xFFFF and 0 <= name.sub <= 0xFF):
        raise ValueError(f"object {text!r} must be within 0x0001 to 0xFFFF:255")
    return name


MERGED = ("scale", "plausibility", "patience")
"""Sections that are merged key by key where a profile extends another; `pdo` is merged frame by frame."""
_TOGETHER = {
    "Feedback": ("position", "velocity"),
    "Command": ("controlword", "target_torque"),
    "Torque": ("torque",),
}
"""Signals that are one sample or one command, and so travel in one frame."""
HOST_SIGNALS = ("controlword", "target_torque", "torque_offset", "max_torque", "mode")
"""Signals that the host can fill in a command frame."""

_COMMANDS = (0x6040, 0x6071, 0x60B2)
"""Controlword, target torque and torque offset: what is written there enables a drive, or acts as torque."""
_KEYS_OF_KIND = {
    "drive": (
        "scale.increments_per_joint_rev",
        "scale.velocity_rad_s",
        "scale.gear_ratio",
        "scale.gear_efficiency",
        "scale.rated_torque_count_Nm",
        "plausibility.position_jump_rad",
        "patience.enable_s",
        "patience.mode_s",
        "command_watchdog",
        "quick_stop_option",
        "fault_reaction_option",
    ),
    "sensor": ("scale.torque_Nm", "plausibility.torque_rate_Nm_s", "plausibility.torque_range_Nm"),
}
"""Keys of a profile that have an effect on devices of one kind only."""

STANDARD_OBJECTS = {
    0x603F: (16, False, "error_code"),
    0x6040: (16, False, "controlword"),
    0x6041: (16, False, "statusword"),
    0x6060: (8, True, "mode"),
    0x6061: (8, True, "mode_display"),
    0x6064: (32, True, "position"),
    0x606C: (32, True, "velocity"),
    0x6071: (16, True, "target_torque"),
    0x6072: (16, False, "max_torque"),
    0x6077: (16, True, "torque_actual"),
    0x60B2: (16, True, "torque_offset"),
}
"""Bits, sign and signal of the objects by which a drive lives, by index. Source: CiA 402-2."""
_STANDARD_SIGNALS = {signal for _, _, signal in STANDARD_OBJECTS.values()}

_DBC_MARKS = '"', "\\"
"""What the text of a unit can't have in a DBC."""


@dataclass(frozen=True)
class SignalSettings:
    """One mapped object and the signal that it is in the contract."""

    object: str = setting(meaning="index and sub-index")
    signal: str = setting(meaning="name in the contract")
    unit: str = setting("", meaning="unit of the signal's value")
    scale: float = setting(1.0, low=1e-12, high=1e12, meaning="value of one count, where [scale] doesn't say it")
    low: float | None = setting(None, low=-1e12, high=1e12, meaning="least value, else the arm stops")
    high: float | None = setting(None, low=-1e12, high=1e12, meaning="greatest value, else the arm stops")
    of: str = setting("", meaning="signal of the same frame: `low` and `high` bound the difference to it")

    def __post_init__(self) -> None:
        parse_object(self.object)
        if not (self.signal.isascii() and self.signal.isidentifier()) or self.signal.endswith("_"):  # DBC: `SG_`
            raise ValueError(f"signal {self.signal!r} must be a name of letters a to z, digits and _, not at its end")
        if not self.unit.isprintable() or any(mark in self.unit for mark in _DBC_MARKS):
            raise ValueError(
                f"signal {self.signal!r}: unit = {self.unit!r} can't have {' '.join(_DBC_MARKS)} or a line end"
            )
        *_, meant = STANDARD_OBJECTS.get(self.name.index, ("",))
        if meant and self.signal in _STANDARD_SIGNALS - {meant}:
            raise ValueError(f"signal {self.signal!r}: object {self.object} is {meant!r} by CiA 402")
        if self.of and not self.is_bounded:
            raise ValueError(f"signal {self.signal!r}: `of` needs `low` or `high`")
        if self.low is not None and self.high is not None and self.low > self.high:
            raise ValueError(f"signal {self.signal!r}: low = {self.low:g} is above high = {self.high:g}")

    @property
    def is_bounded(self) -> bool:
        """Whether a least or greatest value, beyond which the arm stops, is set."""
        return self.low is not None or self.high is not None

    @property
    def name(self) -> ObjectName:
        """Index and sub-index of `object`."""
        return parse_object(self.object)


@dataclass(frozen=True)
class PdoSettings:
    """One PDO: which frame of the contract it is, and its communication and mapping parameters."""

    message: str = setting(choices=("Feedback", "Status", "Command", "Torque"), meaning="name in the contract")
    number: int = setting(low=1, high=512, meaning="1 is 0x1400 or 0x1800")
    cob_id: int = setting(low=0x180, high=0x57F, is_hex=True, meaning="identifier without the node id")
    signals: tuple[SignalSettings, ...] = setting(meaning="mapped objects in order, the header apart")
    transmission: int = setting(1, low=0, high=255, meaning="1 on every SYNC, 254 and 255 on events")
    inhibit_100us: int = setting(0, unit="100 µs", low=0, high=0xFFFF, meaning="smallest distance of two frames")
    event_timer_ms: int = setting(0, unit="ms", low=0, high=0xFFFF, meaning="period of an event-driven frame")
    data_ids: tuple[str, ...] = setting((), meaning="hexadecimal data ids of joint 1 and 2; none: unprotected")

    @property
    def is_received(self) -> bool:
        """Whether the device receives the PDO."""
        return self.message == "Command"

    @property
    def is_synchronous(self) -> bool:
        """Whether the PDO is exchanged on SYNC: its transmission type is LAST_SYNCHRONOUS or less."""
        return self.transmission <= LAST_SYNCHRONOUS

    @property
    def communication_index(self) -> int:
        """Index of the communication parameters, 0x1400 to 0x15FF or 0x1800 to 0x19FF."""
        return (RECEIVED if self.is_received else SENT) + self.number - 1

    @property
    def mapping_index(self) -> int:
        """Index of the mapping parameters, 0x1600 to 0x17FF or 0x1A00 to 0x1BFF."""
        return self.communication_index + TO_MAPPING


@dataclass(frozen=True)
class ScaleSettings:
    """The worth of one count of the device."""

    increments_per_joint_rev: float = setting(
        0.0,
        low=0.0,
        high=2.0**40,
        meaning="position increments per revolution of the joint; checked with 0x608F, 0x6091",
    )
    velocity_rad_s: float = setting(
        0.0, unit="rad/s", low=0.0, high=100.0, meaning="one count of velocity, at the joint; checked with 0x60A9"
    )
    gear_ratio: float = setting(
        1.0,
        low=1e-3,
        high=1e5,
        meaning="motor revolutions per revolution of the joint: 0x6076 is the motor's; 1: a drive that rates its joint",
    )
    gear_efficiency: float = setting(1.0, low=0.05, high=1.0, meaning="part of the motor's torque that leaves the gear")
    rated_torque_count_Nm: float = setting(
        1e-3, unit="Nm", low=1e-12, high=1.0, meaning="one count of 0x6076: 1e-3 by CiA 402-2, 1e-6 in an EPOS4"
    )
    torque_Nm: float = setting(0.0, unit="Nm", low=0.0, high=100.0, meaning="one count of the sensor's torque")

    @property
    def joint_torque_Nm(self) -> float:
        """One count of 0x6076 at the joint, Nm: behind the gear, with its efficiency."""
        return self.rated_torque_count_Nm * self.gear_ratio * self.gear_efficiency


@dataclass(frozen=True)
class PlausibilitySettings:
    """Bounds on values of frames that no end-to-end header protects."""

    # The drive's velocity lags 1.6 ms, so 100 rad/s² leave 0.16 mrad in 1 ms; a flipped high bit is at least 0.1 rad.
    position_jump_rad: float = setting(
        0.02, unit="rad", low=1e-4, high=10.0, meaning="largest step of position beyond velocity x time"
    )
    torque_rate_Nm_s: float = setting(20_000.0, unit="Nm/s", low=1.0, high=1e7, meaning="largest change of torque")
    torque_range_Nm: float = setting(
        0.0, unit="Nm", low=0.0, high=1e6, meaning="end of the sensor's range, there it is overloaded; 0: unknown"
    )


@dataclass(frozen=True)
class PatienceSettings:
    """How long the host waits for a device, and how soon it asks again."""

    answer_s: float = setting(ANSWER_TIMEOUT_S, unit="s", low=0.01, high=60.0, meaning="longest wait for an SDO answer")
    pause_ms: float = setting(
        0.0, unit="ms", low=0.0, high=1000.0, meaning="from an SDO answer to the next request, 15 for an EPOS"
    )
    enable_s: float = setting(
        5.0, unit="s", low=0.1, high=300.0, meaning="longest way to Operation enabled, as of a brake that opens"
    )
    mode_s: float = setting(
        10.0, unit="s", low=0.0, high=300.0, meaning="how much later 0x6061 may show cyclic synchronous torque"
    )


@dataclass(frozen=True)
class WriteSettings:
    """One extra SDO write at set-up."""

    object: str = setting(meaning="index and sub-index")
    value: int = setting(low=-(2**31), high=2**32 - 1, meaning="value")

    def __post_init__(self) -> None:
        if self.name.index in _COMMANDS:
            raise ValueError(f"object {self.object!r} commands the drive: only the host's cycle may write it")

    @property
    def name(self) -> ObjectName:
        """Index and sub-index of `object`."""
        return parse_object(self.object)


@dataclass(frozen=True)
class ProfileSettings:
    """One device profile."""

    kind: str = setting(choices=("drive", "sensor"), meaning="what it is")
    eds: str = setting(meaning="EDS file, beside the profile or in dbc/")
    pdo: tuple[PdoSettings, ...] = setting(meaning="the frames")
    identity: str = setting(
        "eds", choices=("eds", "any"), meaning="device type, vendor, product, revision as in the EDS, or unchecked"
    )
    serial: tuple[int, ...] = setting((), low=0, high=2**32 - 1, meaning="serial number of joint 1 and 2; none: any")
    contract_object: bool = setting(False, meaning="the device carries wire version and layout digest in 0x2000")
    protection: str = setting("none", choices=("none", *PROFILES_BY_CODE), meaning="AUTOSAR end-to-end profile")
    header: tuple[str, ...] = setting((), meaning="objects of the end-to-end header, in order")
    mapping: str = setting(
        "writable",
        choices=("writable", "rewritten", "fixed"),
        meaning="written where it differs, always, or only compared",
    )
    command_watchdog: str = setting(
        NO_WATCHDOG, choices=COMMAND_WATCHDOGS, meaning="where the deadline of commands is set: SYNCs, or ms"
    )
    features: tuple[str, ...] = setting((), choices=FEATURES, meaning="what the device can do besides")
    quick_stop_option: int | None = setting(None, low=0, high=8, meaning="0x605A that is written, or fixed")
    fault_reaction_option: int | None = setting(None, low=0, high=4, meaning="0x605E that is written, or fixed")
    scale: ScaleSettings = setting(ScaleSettings, meaning="worth of a count")
    plausibility: PlausibilitySettings = setting(PlausibilitySettings, meaning="bounds for unprotected frames")
    patience: PatienceSettings = setting(PatienceSettings, meaning="how long the host waits for it")
    assumed: tuple[str, ...] = setting((), meaning="keys of this profile whose values are guesses")
    setup: tuple[WriteSettings, ...] = setting((), meaning="extra SDO writes, before the host's own")

    def __post_init__(self) -> None:
        for text in self.header:
            parse_object(text)
        self._check_frames()
        self._check_protection()
        self._check_scale()
        self._check_kind()
        for pdo in self.pdo:
            self._check_bounds(pdo)
        self._check_assumed()

    def _check_frames(self) -> None:
        """Raise ValueError unless all needed frames and signals are there, signals in the right frame.

        The frame Status may be missing; no frame may be there twice. PDOs of one direction have different numbers. Each
        PDO has signals, none twice. Position and velocity must be in Feedback, controlword and target torque in
        Command, torque in Torque; of a signal in two frames the later one counts. The statusword may be in any frame.
        Feedback and Torque have transmission 1, on every SYNC.
        """
        wanted = {"drive": ("Feedback", "Command"), "sensor": ("Torque",)}[self.kind]
        found = [pdo.message for pdo in self.pdo]
        if missing := [name for name in wanted if name not in found]:
            raise ValueError(f"pdo: a {self.kind} needs {' and '.join(missing)}")
        if len(set(found)) != len(found) or not set(found) <= {*wanted, "Status"}:
            raise ValueError(f"pdo: a {self.kind} has {', '.join(wanted)} and perhaps Status, once each")
        taken: dict[int, str] = {}
        for pdo in self.pdo:
            if (first := taken.setdefault(pdo.communication_index, pdo.message)) != pdo.message:
                raise ValueError(f"pdo {pdo.message}: number = {pdo.number} is that of {first}, too")
            names = [signal.signal for signal in pdo.signals]
            if not names or len(set(names)) != len(names):
                raise ValueError(f"pdo {pdo.message}: signals must be there and differ")
        needed = {
            "drive": ("position", "velocity", "statusword", "controlword", "target_torque"),
            "sensor": ("torque",),
        }
        carried = {signal.signal: pdo.message for pdo in self.pdo for signal in pdo.signals}
        if missing := [name for name in needed[self.kind] if name not in carried]:
            raise ValueError(f"pdo: no frame carries {', '.join(missing)}")
        for message, signals in _TOGETHER.items():
            for name in signals:
                if carried.get(name, message) != message:
                    others = " and ".join(other for other in signals if other != name)
                    beside = f", in one PDO with {others}" if others else ""
                    raise ValueError(f"pdo {carried[name]}: {name} must be in {message}{beside}")
        for pdo in self.pdo:
            if pdo.message in ("Feedback", "Torque") and pdo.transmission != 1:
                raise ValueError(f"pdo {pdo.message}: transmission = {pdo.transmission} must be 1, on every SYNC")

    def _check_bounds(self, pdo: PdoSettings) -> None:
        """Raise ValueError for bounds in a command or in a status without event timer, and for a wrong `of`.

        `of` must name another signal of the frame, of the same unit.
        """
        signals = {signal.signal: signal for signal in pdo.signals}
        for name, signal in signals.items():
            place = f"pdo {pdo.message}: signal {name!r}"
            if signal.of and (signal.of not in signals or signal.of == name):
                others = ", ".join(signals)
                raise ValueError(f"{place}: of = {signal.of!r} must be another signal of the frame: {others}")
            if signal.is_bounded and pdo.is_received:
                raise ValueError(f"{place} is the host's own, and can't have `low` or `high`")
            if signal.is_bounded and pdo.message == "Status" and not pdo.event_timer_ms:
                raise ValueError(
                    f"{place}: `low` and `high` need event_timer_ms: without it a silent device isn't noticed"
                )
            if not signal.of:
                continue
            (_, unit), (_, other) = self.unit_of(signal), self.unit_of(signals[signal.of])
            if unit != other:
                raise ValueError(f"{place}: unit = {unit!r} must be that of {signal.of!r}, {other!r}")

    def _check_protection(self) -> None:
        """Raise ValueError if the number of header objects or the data ids don't fit `protection`.

        Also for a signal that has the name of a part of the header.
        """
        profile = PROFILES_BY_CODE.get(self.protection)
        objects = 0 if profile is None else profile.objects
        if len(self.header) != objects:
            raise ValueError(f"header has {len(self.header)} objects, {self.protection} takes {objects}")
        for pdo in self.pdo:
            if not pdo.data_ids:
                continue
            if profile is None:
                raise ValueError(f"pdo {pdo.message}: data_ids need protection {' or '.join(PROFILES_BY_CODE)}")
            digits = 2 * profile.data_id_bytes
            if len(pdo.data_ids) != 2 or any(not _is_hex(text, digits) for text in pdo.data_ids):
                raise ValueError(f"pdo {pdo.message}: data_ids must be two of {digits} hexadecimal digits")
            header = [name for name, _ in profile.signals]
            if taken := [signal.signal for signal in pdo.signals if signal.signal in header]:
                raise ValueError(f"pdo {pdo.message}: signal {taken[0]!r} has the name of a part of the header")

    def _check_scale(self) -> None:
        """Raise ValueError for a missing scale, too few increments, and unless there are 0 or 2 serial numbers.

        A drive needs `increments_per_joint_rev`, at least LEAST_INCREMENTS, and `velocity_rad_s`; a sensor needs
        `torque_Nm`.
        """
        if self.kind == "drive" and not (self.scale.increments_per_joint_rev and self.scale.velocity_rad_s):
            raise ValueError("scale: a drive needs increments_per_joint_rev and velocity_rad_s")
        if self.kind == "drive" and self.scale.increments_per_joint_rev < LEAST_INCREMENTS:
            raise ValueError(
                f"scale: increments_per_joint_rev = {self.scale.increments_per_joint_rev:g} is below "
                f"{LEAST_INCREMENTS}: "
                "a factory value of 0x608F? It is increments per motor revolution times the gear"
            )
        if self.kind == "sensor" and not self.scale.torque_Nm:
            raise ValueError("scale: a sensor needs torque_Nm")
        if self.serial and len(self.serial) != 2:
            raise ValueError(f"serial has {len(self.serial)} numbers, 2 expected")

    def _check_kind(self) -> None:
        """Raise ValueError for a key that has an effect on devices of another kind only, and isn't its default."""
        for kind, keys in _KEYS_OF_KIND.items():
            for key in keys if kind != self.kind else ():
                section, _, name = key.rpartition(".")
                owner = getattr(self, section) if section else self
                if getattr(owner, name) != getattr(type(owner), name):
                    raise ValueError(f"`{key}` has no effect: this is a {self.kind}, and the key is a {kind}'s")

    def _check_assumed(self) -> None:
        """Raise ValueError for a key in `assumed` that no section in MERGED has."""
        known = [f"{name}.{field.name}" for name in MERGED for field in dataclasses.fields(type(getattr(self, name)))]
        for key in self.assumed:
            if key not in known:
                raise ValueError(f"assumed: {key!r} is no key of a profile; {hint(key, known)}")

    def unit_of(self, signal: SignalSettings) -> tuple[float, str]:
        """Return (value of one count, unit) of a signal, by `scale` or else by the signal's own settings.

        By `scale`: position and velocity of a drive, in rad and rad/s; torque and gross_torque of a sensor, in Nm.
        """
        if self.kind == "drive" and signal.signal == "position":
            return 2.0 * math.pi / self.scale.increments_per_joint_rev, "rad"
        if self.kind == "drive" and signal.signal == "velocity":
            return self.scale.velocity_rad_s, "rad/s"
        if self.kind == "sensor" and signal.signal in ("torque", "gross_torque"):
            return self.scale.torque_Nm, "Nm"
        return signal.scale, signal.unit


def _is_hex(text: str, digits: int) -> bool:
    return len(text) == digits and all(c in "0123456789abcdefABCDEF" for c in text)


class DeviceProfile(NamedTuple):
    """A device profile with its name, the file's without suffix, and its EDS: path and content."""

    name: str
    eds: Path
    eds_bytes: bytes
    settings: ProfileSettings


def device_name(kind: str, joint: int) -> str:
    """Return the name in the contract of the device of a kind, drive or sensor, of a joint from 0: `Drive1`."""
    return f"{kind.capitalize()}{joint + 1}"


@dataclass(frozen=True)
class PlacedDevice:
    """One device of the arm. `joint` counts from 0. objects: the object dictionary of its EDS."""

    name: str
    joint: int
    node_id: int
    profile: DeviceProfile
    objects: Any = field(compare=False, repr=False)

    @property
    def settings(self) -> ProfileSettings:
        """The settings of its profile."""
        return self.profile.settings

    def has(self, index: int, sub: int = 0) -> bool:
        """Return whether the EDS lists an object."""
        return find_variable(self.objects, index, sub) is not None

    @property
    def is_heartbeat_known(self) -> bool:
        """Whether the host can set the period of its heartbeat, 0x1017, and so knows when one is overdue."""
        variable = find_variable(self.objects, 0x1017, 0)
        return variable is not None and variable.is_writable

    def can(self, feature: str) -> bool:
        """Return whether the profile lists a feature of FEATURES; the EDS isn't asked."""
        return feature in self.settings.features

    def pdo(self, message: str) -> PdoSettings | None:
        """Return the PDO that is this message of the contract, None when the device has none."""
        return next((pdo for pdo in self.settings.pdo if pdo.message == message), None)

    def can_id(self, pdo: PdoSettings) -> int:
        """Return the CAN identifier of a PDO of this device: its `cob_id` plus the node id."""
        return pdo.cob_id + self.node_id

    def listed(self, name: ObjectName) -> EdsVariable:
        """Return an object of the EDS. Raises ConfigError when it isn't listed."""
        found = find_variable(self.objects, name.index, name.sub)
        if found is None:
            raise ConfigError(f"device profile {self.profile.name}: object {name} is not in {self.profile.eds}")
        return found

    def variable(self, name: ObjectName) -> EdsVariable:
        """Return an object of the EDS that is an integer.

        Raises ConfigError when it isn't listed, is a float or no number, or hasn't the type of STANDARD_OBJECTS.
        """
        found = self.listed(name)
        if found.is_float:
            raise ConfigError(
                f"device profile {self.profile.name}: object {name} ({found.name}) is a float, REAL{found.bits}; the "
                "frames of a cycle hold integers: map the device's integer, as 0x9130 or 0x7130 of a sensor"
            )
        if not found.bits:
            raise ConfigError(f"device profile {self.profile.name}: object {name} ({found.name}) fits no PDO")
        bits, is_signed, _ = STANDARD_OBJECTS.get(name.index, (found.bits, found.is_signed, ""))
        if (found.bits, found.is_signed) != (bits, is_signed):
            raise ConfigError(
                f"device profile {self.profile.name}: {name} is {_type(found.bits, found.is_signed)} in "
                f"{self.profile.eds}, {_type(bits, is_signed)} by CiA 402: correct DataType there"
            )
        return found

    def mapping(self, pdo: PdoSettings) -> list[int]:
        """Return the mapping entries of a PDO, CiA 301 figure 70: each index, sub-index and bits in one number.

        Those of the end-to-end header come first. Raises ConfigError for an object that `variable` refuses.
        """
        names = [signal.name for signal in self.header(pdo)] + [signal.name for signal in pdo.signals]
        return [name.index << 16 | name.sub << 8 | self.variable(name).bits for name in names]

    def header(self, pdo: PdoSettings) -> list[SignalSettings]:
        """Return the objects of the end-to-end header of a PDO, each as a signal; [] for an unprotected one."""
        if not pdo.data_ids:
            return []
        return [SignalSettings(object=text, signal="e2e") for text in self.settings.header]


def _type(bits: int, is_signed: bool) -> str:
    return f"{'INTEGER' if is_signed else 'UNSIGNED'}{bits}"


def enable_timeout_s(settings: Settings, devices: Sequence[PlacedDevice]) -> float:
    """Return how long ENABLE may take, s: `safety.enable_timeout_s` if it is set, else by the drives' profiles.

    By the profiles: the largest `enable_s` + `mode_s`, but at least `safety.phase_timeout_s`.
    """
    if settings.safety.enable_timeout_s is not None:
        return settings.safety.enable_timeout_s
    patience = [device.settings.patience for device in devices if device.settings.kind == "drive"]
    return max(settings.safety.phase_timeout_s, *(one.enable_s + one.mode_s for one in patience))
