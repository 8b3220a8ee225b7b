"""The draft of a device profile from an EDS: the frames that a cycle needs, as the device's mapping allows them.

What an EDS doesn't say, as the worth of a count, is taken from the device's own objects where they were read, and is a
guess otherwise. Sources: CiA 301 (0x1000, 0x1018; clause 7.5.2, PDO parameters), CiA 402-2, CiA 404.
"""

import math
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, NamedTuple

from adacd_hil.device.canopen_bus import find_variable, read_eds
from adacd_hil.device.device_setup import SIGNAL_OBJECTS
from adacd_hil.device.profile import ObjectName, ProfileSettings
from adacd_hil.settings.schema import ConfigError, parse
from adacd_hil.settings.toml_files import parse_toml
from adacd_hil.wire.frame_lengths import CLASSIC_BYTES

DRIVE, SENSOR = "drive", "sensor"
KINDS = {402: DRIVE, 404: SENSOR}


class DeviceRatings(NamedTuple):
    """What a device's objects say of the arm; None where it doesn't say.

    gear: motor revolutions per joint revolution. torque_Nm: one count of a sensor.
    """

    rated_torque_Nm: float | None = None
    torque_share: float | None = None
    increments_per_rev: int | None = None
    position_limit_deg: float | None = None
    velocity_limit_deg_s: float | None = None
    torque_Nm: float | None = None


def identity_of(eds: Path) -> tuple[int | None, int | None]:
    """Return vendor and product of an EDS, 0x1018:1 and :2. Raises ConfigError."""
    variables = [find_variable(read_eds(eds, 1), 0x1018, sub) for sub in (1, 2)]
    vendor, product = (None if variable is None else variable.default for variable in variables)
    return vendor, product


_TORQUE_OBJECTS = ((0x9130, 1), (0x7130, 1))
"""CiA 404: process value of an input as int32, as int16."""
_FEATURES = {
    "heartbeat_consumer": (0x1016, 1),
    "sync_counter": (0x1019, 0),
    "option_codes": (0x605A, 0),
    "torque_limits": (0x6072, 0),
}
_PERMILLE = ("torque_actual", "torque_demand", "target_torque", "torque_offset", "max_torque")
_EVENT = "transmission = 255\nevent_timer_ms = 100\n"
_Place = tuple[int, int]
_GUESSED_INCREMENTS = 1 << 20
_GUESSED_TORQUE_NM = 1e-6, 2e-3
"""What a count may be worth, of more than 16 bits and of 16: ±2147 Nm and ±65 Nm in all."""


class ProfileDraft(NamedTuple):
    """The text of a profile. guesses: what in it neither EDS nor device says, a line each."""

    kind: str
    text: str
    guesses: tuple[str, ...]


def kind_of(eds: Path) -> str:
    """Tell whether an EDS is that of a drive or a sensor, by 0x1000. Raises ConfigError."""
    variable = find_variable(read_eds(eds, 1), 0x1000, 0)
    number = None if variable is None or variable.default is None else variable.default & 0xFFFF
    if number not in KINDS:
        told = "tells no device profile" if number is None else f"is of CiA {number}"
        raise ConfigError(f"EDS {eds} {told} in 0x1000; a drive is of CiA 402, a sensor of CiA 404")
    return KINDS[number]


def draft_profile(eds: Path, ratings: DeviceRatings = DeviceRatings()) -> ProfileDraft:  # noqa: B008 (immutable)
    """Draft the profile of the device that an EDS describes. Raises ConfigError where it lacks what a cycle needs."""
    kind = kind_of(eds)
    objects = read_eds(eds, 1)
    writer = _DriveWriter(eds, objects, ratings) if kind == DRIVE else _SensorWriter(eds, objects, ratings)
    text = writer.text()
    try:
        parse(ProfileSettings, parse_toml(text))
    except ConfigError as error:
        raise ConfigError(f"EDS {eds}: {error}") from None
    return ProfileDraft(kind, text, tuple(writer.guesses))


class _ProfileWriter(ABC):
    kind = ""

    def __init__(self, eds: Path, objects: Any, ratings: DeviceRatings) -> None:
        self.eds, self.objects, self.ratings = eds, objects, ratings
        self.guesses: list[str] = []

    def has(self, index: int, sub: int = 0) -> bool:
        return find_variable(self.objects, index, sub) is not None

    def default(self, index: int, sub: int = 0) -> int:
        variable = find_variable(self.objects, index, sub)
        return 0 if variable is None or variable.default is None else variable.default

    def require(self, index: int, sub: int, what: str) -> None:
        if not self.has(index, sub):
            raise ConfigError(f"EDS {self.eds}: no {ObjectName(index, sub)} ({what}), which a {self.kind} needs")

    @property
    def is_fixed(self) -> bool:
        """Whether the first transmit mapping can't be written."""
        variable = find_variable(self.objects, 0x1A00, 1)
        return variable is None or not variable.is_writable

    def text(self) -> str:
        features = [name for name, place in _FEATURES.items() if self.has(*place) and self.allows(name)]
        watchdog = "0x1400:5" if self.kind == DRIVE and self.has(0x1400, 5) else "none"
        lines = [
            f"# Drafted from {self.eds.name} by `adacd-hil init`. `adacd-hil doctor` compares it with the device.",
            "",
            f'kind = "{self.kind}"',
            f'eds = "{self.eds.name}"',
        ]
        if self.is_fixed:
            lines.append('mapping = "fixed"')
        if watchdog != "none":
            lines.append(f'command_watchdog = "{watchdog}"')
        elif self.kind == DRIVE:
            lines.append("# command_watchdog: the EDS has no 0x1400:5; see that the drive stops without commands.")
        lines.append(f"features = [{', '.join(f'{chr(34)}{name}{chr(34)}' for name in features)}]")
        if "option_codes" in features:
            lines += ["# Brake on a ramp, then without torque.", "quick_stop_option = 2", "fault_reaction_option = 2"]
        lines += ["", "[scale]", *self.scale(), ""]
        return "\n".join([*lines, *self.frames()])

    def allows(self, feature: str) -> bool:
        """Whether a feature is one of this kind of device."""
        return self.kind == DRIVE or feature in ("heartbeat_consumer", "sync_counter")

    @abstractmethod
    def scale(self) -> list[str]:
        """Write what a count is worth."""

    @abstractmethod
    def frames(self) -> list[str]:
        """Write the PDOs."""

    def pdo(self, message: str, number: int, cob_id: int, places: list[_Place], further: str = "") -> list[str]:
        """Write one PDO; a fixed one has what the EDS maps by default."""
        mapping = (0x1600 if message == "Command" else 0x1A00) + number - 1
        self.require(mapping, 0, f"mapping of {message}")
        if self.is_fixed:
            entries = [self.default(mapping, sub) for sub in range(1, self.default(mapping, 0) + 1)]
            places = [(entry >> 16, entry >> 8 & 0xFF) for entry in entries if entry >> 16]
        rows = [f'    {{ object = "{ObjectName(*place)}", {self.signal(place)} }},' for place in places]
        head = ["[[pdo]]", f'message = "{message}"', f"number = {number}", f"cob_id = 0x{cob_id:X}"]
        return [*head, *further.splitlines(), "signals = [", *rows, "]", ""]

    def signal(self, place: _Place) -> str:
        index, sub = place
        if place in _TORQUE_OBJECTS:
            return 'signal = "torque"'
        name = next((name for name, known in SIGNAL_OBJECTS.items() if known == index), "")
        unit = ', unit = "permille"' if name in _PERMILLE else ""
        return f'signal = "{name or f"object_{index:04X}_{sub}"}"{unit}'

    def fill(self, places: list[_Place]) -> list[_Place]:
        """Keep of some objects those that the EDS has and that fit into a frame, in order."""
        kept, bits = [], 0
        for place in places:
            variable = find_variable(self.objects, *place)
            if variable is not None and variable.bits and bits + variable.bits <= 8 * CLASSIC_BYTES:
                kept.append(place)
                bits += variable.bits
        return kept


class _DriveWriter(_ProfileWriter):
    kind = DRIVE

    def scale(self) -> list[str]:
        for index, what in ((0x6064, "position"), (0x606C, "velocity"), (0x6041, "statusword"), (0x6071, "torque")):
            self.require(index, 0, what)
        increments = self.ratings.increments_per_rev or self._increments()
        lines = []
        if not increments:
            increments = _GUESSED_INCREMENTS
            self.guesses.append(f"increments_per_joint_rev = {increments}: neither 0x608F nor 0x6091 says it")
            lines.append("# A guess: the device doesn't say it. Increments per motor revolution times the gear.")
        lines.append(f"increments_per_joint_rev = {increments}")
        lines.append("# As CiA 402 has it without further units: a count is one increment per second.")
        lines.append(f"velocity_rad_s = {math.tau / increments!r}")
        return lines

    def _increments(self) -> int:
        encoder, motor_revs = self.default(0x608F, 1), self.default(0x608F, 2) or 1
        gear_in, gear_out = self.default(0x6091, 1) or 1, self.default(0x6091, 2) or 1
        return encoder * gear_in // (motor_revs * gear_out)

    def frames(self) -> list[str]:
        status = self.fill([(0x6041, 0), (0x6061, 0), (0x6077, 0), (0x603F, 0)])
        return [
            *self.pdo("Feedback", 1, 0x180, [(0x6064, 0), (0x606C, 0)]),
            *self.pdo("Status", 2, 0x280, status, _EVENT),
            *self.pdo("Command", 1, 0x200, [(0x6040, 0), (0x6071, 0)]),
        ]


class _SensorWriter(_ProfileWriter):
    kind = SENSOR

    def scale(self) -> list[str]:
        torque_Nm = self.ratings.torque_Nm
        if torque_Nm is not None:
            return [f"torque_Nm = {torque_Nm!r}"]
        place = next((place for place in _TORQUE_OBJECTS if self.has(*place)), _TORQUE_OBJECTS[0])
        variable = find_variable(self.objects, *place)
        guess_Nm = _GUESSED_TORQUE_NM[0 if variable is None or variable.bits > 16 else 1]
        self.guesses.append(f"torque_Nm = {guess_Nm:g}: the worth of a count is in the data sheet")
        return ["# A guess: the worth of a count is in the data sheet.", f"torque_Nm = {guess_Nm!r}"]

    def frames(self) -> list[str]:
        torque = next((place for place in _TORQUE_OBJECTS if self.has(*place)), None)
        if torque is None:
            told = "; its 0x6130:1 is a float, which no frame of a cycle can hold" if self.has(0x6130, 1) else ""
            raise ConfigError(f"EDS {self.eds}: no 0x9130:1 or 0x7130:1 (torque), which a sensor needs{told}")
        lines = self.pdo("Torque", 1, 0x180, [torque])
        status = self.fill([(0x6150, 1), (0x1001, 0)])
        if not self.is_fixed and self.has(0x6150, 1) and self.has(0x1A01, 0):
            lines += self.pdo("Status", 2, 0x280, status, _EVENT)
        return lines
