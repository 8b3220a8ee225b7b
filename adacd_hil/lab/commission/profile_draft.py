"""Draft of a device profile from an EDS: the frames that a cycle needs, as far as the device's mapping allows them.

A value that the EDS leaves open, such as the scale of a count, comes from the user's answers, else from the device's
objects, else from a shipped profile of the same maker; else it is a guess. The EDS's value of a writable object is a
factory setting, and a guess, too, if the right value depends on the arm.

Sources: CiA 301 (0x1000, 0x1018; clause 7.5.2, PDO parameters), CiA 306 (EDS: PDOMapping, AccessType), CiA 402-2,
CiA 404.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from adacd_hil.device.canopen_bus import EdsVariable, find_variable
from adacd_hil.device.device_files import load_profile, profile_names
from adacd_hil.device.device_setup import CST_SUPPORTED, NEWTON_METRE
from adacd_hil.device.drive_units import (
    CREDIBLE_INCREMENTS,
    RPM,
    name_velocity_unit,
    read_drive_units,
    unit_prefix,
    velocity_rad_s,
)
from adacd_hil.device.eds_file import read_eds
from adacd_hil.device.profile import (
    EVENT_TIMER,
    HOST_SIGNALS,
    LAST_SYNCHRONOUS,
    RECEIVED,
    SENT,
    TO_MAPPING,
    DeviceProfile,
    ObjectName,
    PatienceSettings,
    PdoSettings,
    ProfileSettings,
    ScaleSettings,
)
from adacd_hil.settings.parsing import bounds_of, parse
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.toml_files import parse_toml
from adacd_hil.settings.toml_text import toml_value
from adacd_hil.wire.contract_frames import NOT_VALID, RPDO_IDS, TPDO_IDS
from adacd_hil.wire.frame_lengths import CLASSIC_BYTES

DRIVE, SENSOR = "drive", "sensor"
KINDS = {402: DRIVE, 404: SENSOR}
_DEG_S_PER_RPM = 6.0
_LEAST_LIMIT_DEG, _MOST_LIMIT_DEG, _MOST_SPEED_DEG_S = 1.0, 360.0, 720.0
"""Plausible limits of a joint; others are a drive's factory values. A wrist of a UR3e turns at 360 deg/s."""
_Place = tuple[int, int]
_SIGNAL_OBJECTS = {
    "position": 0x6064,
    "velocity": 0x606C,
    "statusword": 0x6041,
    "mode_display": 0x6061,
    "torque_actual": 0x6077,
    "torque_demand": 0x6074,
    "error_code": 0x603F,
    "error_register": 0x1001,
    "controlword": 0x6040,
    "target_torque": 0x6071,
    "torque_offset": 0x60B2,
    "max_torque": 0x6072,
    "mode": 0x6060,
    "torque": 0x9130,
    "status": 0x6150,
}
"""CiA 301, 402 and 404: the object behind a signal's name."""


class DeviceRatings(NamedTuple):
    """Values read from a device. numbers: by (index, sub-index); an object that wasn't read is missing."""

    numbers: Mapping[_Place, int] = {}

    @property
    def torque_share(self) -> float | None:
        """0x6072, the largest torque, over the rated one; None if it was not read or is 0."""
        permille = self.numbers.get((0x6072, 0))
        return permille * 1e-3 if permille else None

    def rated_torque_Nm(self, scale: ScaleSettings) -> float | None:
        """Return the motor's rated torque at the joint, Nm, from 0x6076 as read; None if it was not read or is 0."""
        counts = self.numbers.get((0x6076, 0))
        return counts * scale.joint_torque_Nm if counts else None

    def position_limit_deg(self, scale: ScaleSettings) -> float | None:
        """Return the largest |q| within the limits 0x607D on both sides, deg.

        None if they were not read, don't enclose 0, the scale is unknown, or the result isn't plausible for a joint.
        """
        low, high = self.numbers.get((0x607D, 1)), self.numbers.get((0x607D, 2))
        if low is None or high is None or min(-low, high) <= 0 or not scale.increments_per_joint_rev:
            return None
        degrees = 360.0 * min(-low, high) / scale.increments_per_joint_rev
        return degrees if _LEAST_LIMIT_DEG <= degrees <= _MOST_LIMIT_DEG else None

    def velocity_limit_deg_s(self, scale: ScaleSettings) -> float | None:
        """Return the joint's largest speed, deg/s, by 0x6080, rpm of the motor, and the gear, 0x6091 or `scale`'s.

        `scale`'s counts if 0x6091 was not read, or is 1 : 1, a factory value. None if 0x6080 was not read, or the
        result isn't plausible for a joint, as of a factory's 50000 rpm.
        """
        rpm = self.numbers.get((0x6080, 0))
        gear = read_drive_units(lambda *place: self.numbers.get(place)).stated_gear_ratio or scale.gear_ratio
        degrees_s = (rpm or 0) * _DEG_S_PER_RPM / gear
        return degrees_s if _LEAST_LIMIT_DEG <= degrees_s <= _MOST_SPEED_DEG_S else None


class ProfileDraft(NamedTuple):
    """The text of a profile, and its settings. guessed: by key, such as "scale.gear_ratio", the value and its reason.

    remarks: limits of the device, a line each. rated_torque_Nm: at the joint, by 0x6076; None if unknown.
    is_rated_known: no guess went into it.
    """

    text: str
    settings: ProfileSettings
    guessed: Mapping[str, tuple[float, str]]
    remarks: tuple[str, ...]
    rated_torque_Nm: float | None
    is_rated_known: bool

    @property
    def guesses(self) -> tuple[str, ...]:
        """The guesses as text, such as "gear_ratio = 50: the EDS has no 0x6091", a line each."""
        return tuple(f"{key.partition('.')[2]} = {text}" for key, (_, text) in self.guessed.items())


def identity_of(eds: Path) -> tuple[int | None, int | None]:
    """Return vendor and product of an EDS: the defaults of 0x1018:1 and :2, else the numbers of its head.

    Each is None if neither gives it. Raises ConfigError if the EDS can't be read.
    """
    objects = read_eds(eds, 1)
    head = objects.device_information
    found = []
    for sub, number in ((1, head.vendor_number), (2, head.product_number)):
        default = _default(objects, 0x1018, sub)
        found.append(default if default is not None else number)
    return found[0], found[1]


def is_of(identity: tuple[int | None, int | None], node: tuple[int | None, int | None]) -> bool:
    """Return whether an EDS of this vendor and product is of a node with these.

    A number that the EDS lacks fits all.
    """
    return all(expected in (None, found) for expected, found in zip(identity, node, strict=True))


def kind_of(eds: Path) -> str:
    """Return "drive" or "sensor" by 0x1000 of an EDS; "" if that names another device profile.

    If 0x1000 names no profile: the kind of a shipped profile of the same maker with `assumed` keys, "" without one.
    Raises ConfigError if the EDS can't be read.
    """
    number = _profile_number(eds)
    if not number:
        return next((kind for kind in (DRIVE, SENSOR) if maker_facts(eds, kind) is not None), "")
    return KINDS.get(number, "")


def describe_kind(eds: Path) -> str:
    """Return the line "0x1000 of … names …, neither a drive's nor a sensor's", for an EDS of another kind.

    Raises ConfigError if the EDS can't be read.
    """
    number = _profile_number(eds)
    profile = f"names CiA {number}" if number else "names no profile"
    return f"0x1000 of {eds.name} {profile}, neither a drive's (CiA 402) nor a sensor's (CiA 404)"


def _profile_number(eds: Path) -> int:
    return (_default(read_eds(eds, 1), 0x1000, 0) or 0) & 0xFFFF


def _default(objects: Any, index: int, sub: int) -> int | None:
    """Return the default of an object by an EDS; None if the EDS lacks either."""
    variable = find_variable(objects, index, sub)
    return None if variable is None else variable.default


def draft_profile(
    eds: Path,
    ratings: DeviceRatings = DeviceRatings(),  # noqa: B008 (immutable)
    kind: str = "",
    answers: Mapping[str, float] | None = None,
) -> ProfileDraft:
    """Draft the profile of the device that an EDS describes; write no file.

    `ratings`: values read from the device. `kind`: "drive" or "sensor", whatever 0x1000 says; "": of `kind_of`.
    `answers`: given values of `scale`, by key; `velocity_unit` is a code of 0x60A9. Raises ConfigError if the EDS can't
    be read, its kind is unknown, it lacks an object or a PDO that a cycle needs, or a value isn't one that a profile
    may have.
    """
    kind = kind or kind_of(eds)
    if not kind:
        raise ConfigError(f"EDS {eds}: {describe_kind(eds)}")
    objects = read_eds(eds, 1)
    make = _DriveWriter if kind == DRIVE else _SensorWriter
    writer = make(eds, objects, ratings, answers or {})
    text = writer.text()
    try:
        settings = parse(ProfileSettings, parse_toml(text))
    except ConfigError as error:
        raise ConfigError(f"EDS {eds}: {error}") from None
    is_rated_known = not (writer.guessed.keys() & TORQUE_KEYS or writer.is_factory(0x6076, 0))
    return ProfileDraft(text, settings, writer.guessed, tuple(writer.remarks), writer.rated_torque_Nm, is_rated_known)


def maker_facts(eds: Path, kind: str) -> ProfileSettings | None:
    """Return the settings of the first shipped profile of the EDS's maker that has `assumed` keys; None without one.

    kind: "drive" or "sensor". Its values that are not `assumed` hold for all devices of this maker. Raises ConfigError
    if the EDS can't be read.
    """
    vendor, _ = identity_of(eds)
    for _, profile in shipped_profiles(kind):
        if vendor is not None and profile.settings.assumed and identity_of(profile.eds)[0] == vendor:
            return profile.settings
    return None


def shipped_profiles(kind: str) -> Iterator[tuple[str, DeviceProfile]]:
    """Yield each shipped profile of a kind, "drive" or "sensor", after its name."""
    for name in profile_names():
        with suppress(ConfigError):  # of the other kind
            yield name, load_profile(name, kind)


_TORQUE_OBJECTS = ((0x9130, 1), (0x7130, 1))
"""CiA 404: process value of an input as int32, as int16."""
_SENSOR_FEATURES = {"heartbeat_consumer": (0x1016, 1), "sync_counter": (0x1019, 0)}
_PERMILLE = ("torque_actual", "torque_demand", "target_torque", "torque_offset", "max_torque")
_STATUS_OBJECTS = ((0x6041, 0), (0x6061, 0), (0x6077, 0), (0x603F, 0))
_COMMANDED = ((0x6040, 0), (0x6071, 0))
_EVENT_TYPE, _EVENT_MS = 255, 100
_INHIBIT_100US = 50
"""Inhibit time of a status frame with the torque, which changes all the time: 5 ms leave two drives 4 % of a bus."""
_MOST_RECORDS = 64
"""Most PDO parameter records that are read; CiA 301 allows 512, devices have 4 to 8."""
_GUESSED_INCREMENTS = 1 << 20
_GUESSED_TORQUE_NM = 1e-6, 2e-3
"""Guessed torque of one count, for more than 16 bits and for 16: a range of ±2147 Nm and ±65 Nm."""
_MOST_MOTOR_NM = 100.0
"""Largest plausible rated torque of a motor in an arm of this size; beyond it 0x6076 counts µNm."""
_LEAST_JOINT_NM, _JOINT_NM = 3.0, 10.0
"""A rated torque below the first is a motor's; the guessed gear raises it to the second."""
_LIKELY_GEAR, _MOST_GEAR = 50.0, 160.0
_RPM_UNITS = {prefix << 24 | RPM for prefix in (0, *range(0xF7, 0x100))}
"""0x60A9: rpm, and decimal fractions of it."""
TORQUE_KEYS = {"scale.gear_ratio", "scale.rated_torque_count_Nm"}
"""Factors from 0x6076 to the torque at the joint, except the efficiency, which is within a third of 1."""
POLARITIES = (0x00, 0xE0)
"""0x607E of a drive that turns none or all of position (bit 7), velocity (bit 6) and torque (bit 5, not of all makers)
round."""


class _Record(NamedTuple):
    """A PDO of a device. number: from 1. cob_id: without the node id. entries: objects of the default mapping.

    room: most objects of its mapping; 0: the mapping is read-only. transmission, inhibit_100us, timer_ms: read-only
    values; None, 0 and 0 if they can be written. has_timer: the event timer can be written.
    """

    number: int
    cob_id: int
    entries: tuple[_Place, ...]
    room: int
    transmission: int | None
    has_timer: bool
    inhibit_100us: int
    timer_ms: int

    def carries(self, *places: _Place) -> bool:
        """Return whether the PDO's default mapping has all these objects, (index, sub-index)."""
        return set(places) <= set(self.entries)

    def takes(self, *places: _Place) -> bool:
        """Return whether the mapping has room for so many objects, or, if it is read-only, has all of these."""
        return self.room >= len(places) if self.room else self.carries(*places)

    @property
    def can_sync(self) -> bool:
        """Whether the PDO goes with every SYNC, transmission type 1, or can be set to that."""
        return self.transmission in (None, 1)


class _ProfileWriter(ABC):
    """Writes a device's profile by EDS, the user's answers, values read from the device, and the maker's profile.

    `text` fills `guessed`, `remarks` and `rated_torque_Nm`. find: None for an object that the EDS lacks. default: 0 for
    one without a default.
    """

    kind = ""
    features = _SENSOR_FEATURES

    def __init__(self, eds: Path, objects: Any, ratings: DeviceRatings, answers: Mapping[str, float]) -> None:
        self.eds, self.objects, self.ratings, self.answers = eds, objects, ratings, answers
        self.guessed: dict[str, tuple[float, str]] = {}
        self.remarks: list[str] = []
        self.rated_torque_Nm: float | None = None
        self.facts = maker_facts(eds, self.kind)
        self._numbered = read_eds(eds, 2)

    def find(self, place: _Place) -> EdsVariable | None:
        return find_variable(self.objects, *place)

    def has(self, index: int, sub: int = 0) -> bool:
        return self.find((index, sub)) is not None

    def can_write(self, index: int, sub: int = 0) -> bool:
        variable = self.find((index, sub))
        return variable is not None and variable.is_writable

    def default(self, index: int, sub: int = 0) -> int:
        return _default(self.objects, index, sub) or 0

    def number(self, index: int, sub: int) -> int | None:
        """Return the value read from the device, else the EDS's default; None if there is neither."""
        return self.ratings.numbers.get((index, sub), _default(self.objects, index, sub))

    def is_factory(self, index: int, sub: int) -> bool:
        """Return whether an object can be written and was not read: its default is a factory setting at best."""
        return (index, sub) not in self.ratings.numbers and self.can_write(index, sub)

    def refuse(self, reason: str) -> ConfigError:
        """Return the ConfigError, with the EDS's path, to raise if no profile can be made."""
        return ConfigError(f"EDS {self.eds}: {reason}")

    def first(self, fitting: Iterable[_Record], reason: str) -> _Record:
        """Return the first of the fitting PDOs. Raises ConfigError with the reason if there is none."""
        for record in fitting:
            return record
        raise self.refuse(reason)

    def require(self, index: int, sub: int, what: str) -> None:
        """Raise ConfigError if the EDS lacks an object, or the object can't be mapped to a PDO.

        what: its name in the error.
        """
        name = f"{ObjectName(index, sub)} ({what})"
        variable = self.find((index, sub))
        if variable is None:
            raise self.refuse(f"no {name}, which a {self.kind} needs")
        if not variable.is_mappable:
            raise self.refuse(f"{name} can't be in a frame (PDOMapping=0), which a {self.kind} needs")

    @property
    def is_fixed(self) -> bool:
        """Whether no mapping of a PDO can be written."""
        return not any(record.room for is_received in (False, True) for record in self.records(is_received))

    def records(self, is_received: bool) -> list[_Record]:
        """Return the device's PDOs with a usable identifier and a mapping, ascending: RPDOs if is_received, else TPDOs.

        Those after the `_MOST_RECORDS`th parameter record are not read.
        """
        base = RECEIVED if is_received else SENT
        found = []
        for number in range(1, _MOST_RECORDS + 1):
            index, mapping = base + number - 1, base + TO_MAPPING + number - 1
            cob_id = self._cob_id(index, number, is_received) if self.has(index, 1) and self.has(mapping, 0) else None
            if cob_id is None:
                continue
            subs = 0
            while self.has(mapping, subs + 1):
                subs += 1
            can_map = self.can_write(mapping, 0) and self.can_write(mapping, 1)
            mapped = [self.default(mapping, sub) for sub in range(1, min(self.default(mapping, 0), subs) + 1)]
            entries = tuple((entry >> 16, entry >> 8 & 0xFF) for entry in mapped if entry >> 16)
            transmission = None if self.can_write(index, 2) else self.default(index, 2)
            room = subs if can_map else 0
            times = [0 if self.can_write(index, sub) else self.default(index, sub) for sub in (3, 5)]
            has_timer = self.can_write(index, 5)
            found.append(_Record(number, cob_id, entries, room, transmission, has_timer, *times))
        return found

    def _cob_id(self, index: int, number: int, is_received: bool) -> int | None:
        """Return a PDO's identifier without the node id, by the EDS, or else the predefined one that can be written.

        None if the PDO is switched off for good, or no usable identifier can be set. number: of the PDO, from 1.
        is_received: it is an RPDO, else a TPDO.
        """
        by_eds = self.default(index, 1)
        if by_eds & NOT_VALID and not self.can_write(index, 1):
            return None
        other = _default(self._numbered, index, 1) or 0
        # An identifier without $NODEID belongs to the node id of the file; a DCF states it.
        node = 1 if other != by_eds else (read_eds(self.eds, None).node_id or 1)
        cob_id = (by_eds & 0x7FF) - node
        least, most = bounds_of(PdoSettings, "cob_id")
        if least <= cob_id <= most:
            return cob_id
        first, second, *_ = RPDO_IDS if is_received else TPDO_IDS
        predefined = first + (second - first) * (number - 1)
        return predefined if self.can_write(index, 1) and predefined <= most else None

    def text(self) -> str:
        """Return the profile as the text of a TOML file; store guesses and remarks.

        Call it once. Raises ConfigError if the device lacks an object or a PDO that a cycle needs.
        """
        features = [name for name, place in self.features.items() if self.can_write(*place)]
        frames = self.frames()
        scale = self.scale()
        lines = [
            f"# Drafted from {self.eds.name} by `adacd-hil init`. `adacd-hil doctor` compares it with the device.",
            "",
            f'kind = "{self.kind}"',
            f'eds = "{self.eds.name}"',
        ]
        if self.is_fixed:
            lines.append('mapping = "fixed"')
        lines += self.watchdog()
        lines.append(f"features = {toml_value(tuple(features))}")
        lines += self.options("option_codes" in features)
        if self.guessed:
            lines += [
                "# Guesses: look each up or measure it, write it, and take the key off here.",
                f"assumed = {toml_value(tuple(self.guessed))}",
            ]
        lines += ["", "[scale]", *scale, ""]
        return "\n".join([*lines, *self.further(), *frames])

    def watchdog(self) -> list[str]:
        """Return the profile's lines on the deadline of commands; [] for a device without commands."""
        return []

    def options(self, can_write: bool) -> list[str]:  # noqa: ARG002 (of a drive)
        """Return the profile's lines on the drive's reactions to a stop. can_write: its option codes can be written."""
        return []

    def further(self) -> list[str]:
        """Return the profile's lines that hold for all devices of the maker, such as [patience]; [] without any."""
        return []

    @abstractmethod
    def scale(self) -> list[str]:
        """Return the lines of [scale]: the worth of a count of each value; store guesses."""

    @abstractmethod
    def frames(self) -> list[str]:
        """Return the lines of all [[pdo]] tables.

        Raises ConfigError if the device lacks an object or a PDO that is needed.
        """

    def fact(self, key: str) -> float | None:
        """Return a value of `scale` that holds for all devices of this maker, by its shipped profile.

        None if there is no such profile, the value is `assumed` in it, or 0.
        """
        if self.facts is None or f"scale.{key}" in self.facts.assumed:
            return None
        value: float = getattr(self.facts.scale, key)
        return value or None

    def guess(self, key: str, value: float, text: str) -> str:
        """Store a guess of `scale.KEY` with its reason, `text`; return the comment for the line above it."""
        self.guessed[f"scale.{key}"] = value, text
        return f"# A guess: {text}"

    def pdo(self, message: str, record: _Record, places: Sequence[_Place], transmission: int = 1) -> list[str]:
        """Return the profile's lines on one PDO, with inhibit time and event timer where they are needed.

        message: its name, such as "Feedback". places: objects to map, (index, sub-index); a fixed mapping keeps the
        EDS's default objects. transmission: type to write, unless the PDO's is read-only; 1 is not printed.
        """
        rows = [
            f'    {{ object = "{ObjectName(*place)}", {self.signal(place)} }},'
            for place in (places if record.room else record.entries)
        ]
        head = ["[[pdo]]", f'message = "{message}"', f"number = {record.number}", f"cob_id = 0x{record.cob_id:X}"]
        kept = record.transmission if record.transmission is not None else transmission
        if kept != 1:
            head.append(f"transmission = {kept}")
        inhibit = record.inhibit_100us
        if kept > LAST_SYNCHRONOUS and (0x6077, 0) in places and self.can_write(SENT + record.number - 1, 3):
            inhibit = _INHIBIT_100US
        if inhibit:
            head.append(f"inhibit_100us = {inhibit}")
        if kept > LAST_SYNCHRONOUS and message == "Status" and record.has_timer:
            head.append(f"event_timer_ms = {_EVENT_MS}")
        elif record.timer_ms:
            head.append(f"event_timer_ms = {record.timer_ms}")
        return [*head, "signals = [", *rows, "]", ""]

    def signal(self, place: _Place) -> str:
        """Return the keys of a mapped object in a profile: `signal = "NAME"`, and `unit` if it counts per mille.

        An object without a known name gets one by its index, such as "object_2031_0". place: (index, sub-index).
        """
        index, sub = place
        if place in _TORQUE_OBJECTS:
            return 'signal = "torque"'
        name = next((name for name, known in _SIGNAL_OBJECTS.items() if known == index and sub <= 1), "")
        unit = ', unit = "permille"' if name in _PERMILLE else ""
        return f'signal = "{name or f"object_{index:04X}_{sub}"}"{unit}'

    def fill(self, places: Sequence[_Place], room: int) -> list[_Place]:
        """Return the objects of `places` that can be mapped and together fit a PDO of `CLASSIC_BYTES`.

        places: (index, sub-index), most important first. room: most objects of the PDO. An object that doesn't fit is
        left out; later ones may fit.
        """
        kept: list[_Place] = []
        bits = 0
        for place in places:
            variable = self.find(place)
            if variable is None or not (variable.bits and variable.is_mappable) or len(kept) >= room:
                continue
            if bits + variable.bits <= 8 * CLASSIC_BYTES:
                kept.append(place)
                bits += variable.bits
        return kept


class _DriveWriter(_ProfileWriter):
    kind = DRIVE
    features = _SENSOR_FEATURES | {"option_codes": (0x605A, 0), "torque_limits": (0x6072, 0)}

    def _check(self) -> None:
        """Raise ConfigError if the EDS lacks an object of the cycle, or the drive can't be commanded by torque.

        It can't if 0x6071 can't be in an RPDO, or 0x6502 has no cyclic synchronous torque. A 0x6502 that is missing, 0
        or a factory value passes.
        """
        target = self.find((0x6071, 0))
        if target is None:
            raise self.refuse("no 0x6071 (target torque): it can't be commanded by torque")
        if not (target.is_mappable and target.is_writable):
            raise self.refuse(
                "0x6071 (target torque) can't be in a frame to the drive: it can't be commanded by torque"
            )
        modes = self.number(0x6502, 0)
        if modes and not modes & CST_SUPPORTED and not self.is_factory(0x6502, 0):
            raise self.refuse(f"0x6502 = 0x{modes:X} has no cyclic synchronous torque: it can't be commanded by torque")
        for index, what in (
            (0x6040, "controlword"),
            (0x6041, "statusword"),
            (0x6064, "position"),
            (0x606C, "velocity"),
        ):
            self.require(index, 0, what)

    def watchdog(self) -> list[str]:
        command = self._command()
        if command.number == 1 and command.has_timer:
            return [f'command_watchdog = "{EVENT_TIMER}"']
        self.remarks.append(
            "no deadline of commands (0x1400:5): only the loss of the host's heartbeat stops the drive"
            if self.can_write(0x1016, 1)
            else "neither a deadline of commands (0x1400:5) nor a heartbeat consumer (0x1016): see that the drive "
            "stops when the host is gone"
        )
        return [f"# command_watchdog: {self.remarks[-1]}."]

    def options(self, can_write: bool) -> list[str]:
        if can_write:
            return ["# Brake on a ramp, then without torque.", "quick_stop_option = 2", "fault_reaction_option = 2"]
        option = _default(self.objects, 0x605A, 0)
        least, most = bounds_of(ProfileSettings, "quick_stop_option")
        return [f"quick_stop_option = {option}"] if option is not None and least <= option <= most else []

    def further(self) -> list[str]:
        if self.facts is None or self.facts.patience == PatienceSettings():
            return []
        plain, patience = vars(PatienceSettings()), vars(self.facts.patience)
        return ["[patience]", *(f"{key} = {value!r}" for key, value in patience.items() if value != plain[key]), ""]

    def scale(self) -> list[str]:
        motor_Nm, torque_lines = self._torque()
        gear, gear_lines = self._gear(motor_Nm)
        if motor_Nm:
            efficiency = self.answers.get("gear_efficiency", 1.0)
            self.rated_torque_Nm = float(f"{motor_Nm * gear * efficiency:.10g}")
        increments, lines = self._increments(gear)
        return [*lines, *self._velocity(gear, increments), *gear_lines, *torque_lines]

    def _gear(self, motor_Nm: float) -> tuple[float, list[str]]:
        """Return the gear ratio, and the profile's lines on it and its efficiency; store guesses.

        motor_Nm: rated torque of the motor, 0 if unknown. The ratio is the user's answer, else the drive's own 0x6091
        unless that is 1 : 1, else a guess. A factory value of 0x6091 is stored as a guess, too, and so is an efficiency
        without an answer. There is no efficiency without a gear.
        """
        units = read_drive_units(self.number)
        by_drive, lines = units.stated_gear_ratio, list[str]()
        if "gear_ratio" in self.answers:
            gear = self.answers["gear_ratio"]
        elif by_drive is not None and not self.is_factory(0x6091, 1):
            gear = by_drive
        else:
            gear = by_drive or self._likely_gear(motor_Nm)
            why = "the EDS has no 0x6091" if units.gear_ratio is None else "0x6091 is a factory value"
            lines = [self.guess("gear_ratio", gear, f"{gear:g}: {why}")]
        text = [*lines, f"gear_ratio = {gear:.16g}"]
        if gear != 1.0:
            efficiency = self.answers.get("gear_efficiency", 1.0)
            if "gear_efficiency" not in self.answers:
                text.append(self.guess("gear_efficiency", 1.0, "1: it is in the gear's data sheet"))
            text.append(f"gear_efficiency = {efficiency:g}")
        return gear, text

    def _likely_gear(self, motor_Nm: float) -> float:
        """Return a guess of the gear ratio, rather too large, so that too little torque is commanded.

        It is that of the maker's profile, if there is one. Else it raises a motor_Nm below `_LEAST_JOINT_NM` to
        `_JOINT_NM`, by `_MOST_GEAR` at most. For an unknown motor with a velocity in rpm it is `_LIKELY_GEAR`; in other
        cases it is 1. motor_Nm: 0 if unknown.
        """
        if self.facts is not None:
            return self.facts.scale.gear_ratio
        if 0.0 < motor_Nm < _LEAST_JOINT_NM:
            return float(max(1, round(min(_JOINT_NM / motor_Nm, _MOST_GEAR))))
        return _LIKELY_GEAR if not motor_Nm and self.number(0x60A9, 0) in _RPM_UNITS else 1.0

    def _increments(self, gear: float) -> tuple[float, list[str]]:
        """Return the increments per revolution of the joint, and the profile's lines on them; store a guess.

        They are the user's answer, else the maker's, else the drive's own, else a guess. The drive's own are a guess,
        too, if they are a factory value or coarser than `CREDIBLE_INCREMENTS`. Coarser ones count only if they were
        read, and are at least `LEAST_INCREMENTS`. gear: motor revolutions per joint revolution.
        """
        units = read_drive_units(self._numbers_with_gear(), gear)
        found, text = units.increments_per_joint_rev, units.increments_text
        places = [place for place in ((0x608F, 1), (0x6092, 1)) if self.number(*place) is not None]
        is_factory = any(self.is_factory(*place) for place in places)
        is_read = any(place in self.ratings.numbers for place in places)
        lines: list[str] = []
        if "increments_per_joint_rev" in self.answers:
            increments = self.answers["increments_per_joint_rev"]
        elif (fact := self.fact("increments_per_joint_rev")) is not None:
            increments = fact
        elif found is not None and (found >= CREDIBLE_INCREMENTS or (is_read and units.has_increments)):
            increments, lines = found, [f"# By {text}."]
            if is_factory or found < CREDIBLE_INCREMENTS:
                why = f"{text} is a factory value" if is_factory else f"{text} is coarse for a joint"
                lines = [self.guess("increments_per_joint_rev", found, f"{found:.10g}: {why}")]
        else:
            increments = float(_GUESSED_INCREMENTS)
            if self.facts is not None:
                increments = self.facts.scale.increments_per_joint_rev * gear / self.facts.scale.gear_ratio
            why = f"{text} is a factory value" if text else "the EDS gives no usable 0x608F and 0x6091"
            lines = [self.guess("increments_per_joint_rev", increments, f"{increments:.10g}: {why}")]
        return increments, [*lines, f"increments_per_joint_rev = {increments:.16g}"]

    def _numbers_with_gear(self) -> Any:
        """Return a function of index and sub-index that reads the drive's objects.

        It hides 0x6091 if that is 1 : 1, or if the user gave a gear.
        """
        by_drive = read_drive_units(self.number).stated_gear_ratio
        is_set = by_drive is not None and "gear_ratio" not in self.answers
        return lambda index, sub: None if index == 0x6091 and not is_set else self.number(index, sub)

    def _velocity(self, gear: float, increments: float) -> list[str]:
        """Return the profile's lines on `velocity_rad_s`, the joint's velocity per count, rad/s.

        The unit is the user's answer, or without one 0x60A9. If that unit is unknown, the value is that of the maker's
        profile. Without one it is a stored guess: one increment per second. gear: motor revolutions per joint
        revolution. increments: per revolution of the joint.
        """
        unit = self.answers.get("velocity_unit")
        code = int(unit) if unit is not None else self.number(0x60A9, 0)
        found = velocity_rad_s(code, increments, gear)
        if code and found is not None:
            return [f"# In {name_velocity_unit(code)} of the motor.", f"velocity_rad_s = {found!r}"]
        if (fact := self.fact("velocity_rad_s")) is not None:
            return [f"velocity_rad_s = {fact!r}"]
        rad_s = math.tau / increments
        why = f"0x60A9 = 0x{code:08X} is no known unit of velocity" if code else "CiA 402's default without 0x60A9"
        text = f"{rad_s:.6g}: one increment per second; {why}"
        return [self.guess("velocity_rad_s", rad_s, text), f"velocity_rad_s = {rad_s!r}"]

    def _torque(self) -> tuple[float, list[str]]:
        """Return the motor's rated torque, Nm, 0 if unknown, and the profile's lines on the unit of 0x6076.

        The unit is the user's answer, else the maker's, else mNm; µNm, stored as a guess, if the motor would be
        implausibly strong.
        """
        counts = self.number(0x6076, 0) or 0
        count_Nm, lines = self.answers.get("rated_torque_count_Nm", 1e-3), list[str]()
        if "rated_torque_count_Nm" not in self.answers:
            if (fact := self.fact("rated_torque_count_Nm")) is not None:
                count_Nm = fact
            elif counts * count_Nm > _MOST_MOTOR_NM:
                count_Nm = 1e-6
                text = f"1e-6: 0x6076 = {counts} mNm would be a motor of {counts * 1e-3:.4g} Nm, so these are µNm"
                lines.append(self.guess("rated_torque_count_Nm", count_Nm, text))
        if count_Nm != 1e-3:
            lines.append(f"rated_torque_count_Nm = {count_Nm!r}")
        return counts * count_Nm, lines

    def _command(self) -> _Record:
        """Return the RPDO that can take controlword and target torque.

        If its mapping is fixed, it has no object that the host can't fill. Raises ConfigError if there is no such RPDO.
        """
        known = {_SIGNAL_OBJECTS[name] for name in HOST_SIGNALS}
        fitting = (
            record
            for record in self.records(is_received=True)
            if record.takes(*_COMMANDED) and (record.room or {index for index, _ in record.entries} <= known)
        )
        return self.first(fitting, "no RPDO takes 0x6040 (controlword) and 0x6071 (target torque) together")

    def frames(self) -> list[str]:
        self._check()
        if (polarity := self.default(0x607E) & 0xE0) not in POLARITIES:
            self.remarks.append(
                f"0x607E (polarity) = 0x{polarity:02X}: position and torque may count against each other"
            )
        sample, statusword = ((0x6064, 0), (0x606C, 0)), (0x6041, 0)
        sent = self.records(is_received=False)
        fitting = (record for record in sent if record.can_sync and record.takes(*sample))
        reason = "no TPDO brings 0x6064 (position) and 0x606C (velocity) together on every SYNC"
        feedback = self.first(fitting, reason)
        lines = self.pdo("Feedback", feedback, sample)
        if feedback.room or not feedback.carries(statusword):
            others = (record for record in sent if record is not feedback and record.takes(statusword))
            status = self.first(others, "no TPDO is left for 0x6041 (statusword)")
            # Without an inhibit time, a torque that changes all the time would fill the bus.
            is_bounded = self.has(SENT + status.number - 1, 3)
            wanted = [place for place in _STATUS_OBJECTS if is_bounded or place != (0x6077, 0)]
            lines += self.pdo("Status", status, self.fill(wanted, status.room), _EVENT_TYPE)
            if status.transmission is None and not status.has_timer:
                self.remarks.append(
                    f"its statusword comes on change only, as 0x{SENT + status.number - 1:X}:5 (event timer) is not "
                    "there: a lost one is not noticed"
                )
        return [*lines, *self.pdo("Command", self._command(), _COMMANDED)]


class _SensorWriter(_ProfileWriter):
    kind = SENSOR

    def scale(self) -> list[str]:
        torque_Nm = self.answers.get("torque_Nm", self._torque_of_count())
        if torque_Nm is not None:
            return [f"torque_Nm = {torque_Nm!r}"]
        variable = self.find(self._torque())
        guess_Nm = _GUESSED_TORQUE_NM[0 if variable is None or variable.bits > 16 else 1]
        return [
            self.guess("torque_Nm", guess_Nm, f"{guess_Nm:g}: the worth of a count is in the data sheet"),
            f"torque_Nm = {guess_Nm!r}",
        ]

    def _torque_of_count(self) -> float | None:
        """Return the torque of one count, Nm, by its unit, 0x6131, and its digits, 0x6132.

        None if they are missing, or are writable and were not read, the unit is no torque, or the size is beyond any
        sensor.
        """
        if self.is_factory(0x6131, 1) or self.is_factory(0x6132, 1):
            return None
        unit, digits = self.number(0x6131, 1), self.number(0x6132, 1)
        if unit is None or digits is None or unit & 0x00FFFFFF != NEWTON_METRE:
            return None
        exponent = unit_prefix(unit) - digits
        return 10.0**exponent if abs(exponent) < 12 else None

    def _torque(self) -> _Place:
        """Return the object that holds the torque. Raises ConfigError if the EDS has none that fits a frame."""
        for place in _TORQUE_OBJECTS:
            if self.has(*place):
                return place
        hint = "; its 0x6130:1 is a float, which no frame of a cycle can hold" if self.has(0x6130, 1) else ""
        raise self.refuse(f"no 0x9130:1 or 0x7130:1 (torque), which a sensor needs{hint}")

    def frames(self) -> list[str]:
        torque = self._torque()
        self.require(*torque, "torque")
        sent = self.records(is_received=False)
        fitting = (one for one in sent if one.can_sync and one.takes(torque))
        record = self.first(fitting, f"no TPDO brings {ObjectName(*torque)} (torque) on every SYNC")
        lines = self.pdo("Torque", record, [torque])
        status = next((one for one in sent if one is not record and one.room), None)
        mapped = [] if status is None else self.fill([(0x6150, 1), (0x1001, 0)], status.room)
        if status is not None and (0x6150, 1) in mapped:
            lines += self.pdo("Status", status, mapped, _EVENT_TYPE)
        return lines
