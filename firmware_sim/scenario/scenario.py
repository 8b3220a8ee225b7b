"""A scenario: the arm, its contacts, its payload, its faults, and the expected outcome with a host; truths beside it.

Times count from the moment both drives are in Operation enabled, those of faults by their `since` also from power-on.
Scenarios are TOML files; those that come with the package are in the folder `scenarios`. `about`, `group`, `lasts_s`,
`acknowledge_faults`, `expect` and `expect_certified` are for the programs that play a scenario; they have no effect on
the arm.

Section `[expect]` of a scenario states the outcome with a healthy host of configuration `paper`, as that host is: where
the host does badly, so does the expectation. `[expect_certified]` replaces `[expect]`, as a whole, for a host of
configuration `certified`; without it the same outcome is expected of both. Counts are exact unless the key that ends in
`_most` gives them room.

Ends of a run:

    finished   parked and disabled when the time was over
    fault      the host went to FAULT, without an acknowledgement
    refused    the host did not put the devices into operation
    lost       the bus failed in operation, or the devices stopped answering

A truth has the properties of the real arm that the host's configuration gets wrong or lacks. The host never reads it.
`[arm]` has values of their own; `[factor]` multiplies values of the host's configuration; `[wiring]` exchanges and
reverses devices; `[habits]` are ways of the drives, in place of those of their maker
(`firmware_sim/maker_habits.toml`); `[sensors]`, `[drives]` and `[mechanics]` are the sections of a scenario and are
laid over them. A truth that comes with the package has one mistake that users make, of any arm.
"""

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any, Final

import numpy as np

from adacd_hil.records import FaultReason, Vector
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.schema import ConfigError, setting
from adacd_hil.settings.toml_files import find_named, read_toml, toml_names
from firmware_sim.arm.arms import ARMS, EmulatedArm
from firmware_sim.arm.hardware_settings import (
    DriveSettings,
    HabitSettings,
    MechanicsSettings,
    PayloadBody,
    SensorSettings,
)
from firmware_sim.arm.touch_settings import BodySettings, ContactSettings, HandSettings, WallSettings, ticks
from firmware_sim.scenario.faults import FaultSettings, check_rows

ENDS: Final = ("finished", "fault", "refused", "lost")
REASONS: Final = tuple(reason.name for reason in FaultReason if reason is not FaultReason.NONE)

Pair = tuple[float, float]
_FOLDER: Final = resources.files("firmware_sim")
"""Its folders `scenarios` and `truths` hold those that come with the package."""


@dataclass(frozen=True)
class ExpectSettings:
    """The outcome of a scenario with a healthy host."""

    adaptations: int = setting(low=0, high=1000, meaning="adaptations that come to their end")
    contacts: int = setting(low=0, high=100_000, meaning="true contacts that are detected")
    adaptations_most: int | None = setting(None, low=0, high=1000, meaning="at most; absent: exactly `adaptations`")
    contacts_most: int | None = setting(None, low=0, high=100_000, meaning="at most; absent: exactly `contacts`")
    false_alarms: int = setting(0, low=0, high=100_000, meaning="detections without a contact")
    false_alarms_most: int | None = setting(
        None, low=0, high=100_000, meaning="at most; absent: exactly `false_alarms`"
    )
    missed: int = setting(0, low=0, high=100_000, meaning="contacts that armed detection doesn't see")
    missed_most: int | None = setting(None, low=0, high=100_000, meaning="at most; absent: exactly `missed`")
    end: str = setting("finished", choices=ENDS, meaning="how the run ends")
    fault: str | None = setting(None, choices=REASONS, meaning="why the host first goes to FAULT; absent: it doesn't")
    fault_s: Pair | None = setting(None, unit="s", low=0.0, high=1e6, meaning="between when and when it does so")
    adaptation_s: Pair | None = setting(
        None, unit="s", low=0.0, high=1e6, meaning="shortest and longest first adaptation"
    )
    delay_ms: float | None = setting(
        None, unit="ms", low=0.0, high=1e6, meaning="longest time from a contact's onset to its detection"
    )
    force_N: float | None = setting(None, unit="N", low=0.0, high=1e6, meaning="largest contact force")

    def __post_init__(self) -> None:
        for key in COUNTS:
            least, most = getattr(self, key), getattr(self, f"{key}_most")
            if most is not None and most < least:
                raise ConfigError(f"`expect.{key}_most` = {most} is below `expect.{key}` = {least}")
        for key in ("fault_s", "adaptation_s"):
            pair = getattr(self, key)
            if pair is not None and pair[1] < pair[0]:
                raise ConfigError(f"`expect.{key}[1]` = {pair[1]:g} s is below `expect.{key}[0]` = {pair[0]:g} s")
        if self.end == "fault" and self.fault is None:
            raise ConfigError("`expect.end` = 'fault' lacks the key `expect.fault`")
        if self.fault_s is not None and self.fault is None:
            raise ConfigError("`expect.fault_s` lacks the key `expect.fault`")

    @property
    def text(self) -> str:
        """The expectation in a few words: adaptations, detections, false alarms and misses if any, fault, end.

        The end is left out if it is `finished` or `fault`.
        """
        words = [f"{self._count('adaptations')} adapted", f"{self._count('contacts')} detected"]
        words += [f"{self._count(key)} {word}" for key, word in _TROUBLES if self._count(key) != "0"]
        if self.fault is not None:
            words.append(self.fault)
        if self.end not in ("finished", "fault"):
            words.append(self.end)
        return ", ".join(words)

    def _count(self, key: str) -> str:
        least, most = getattr(self, key), getattr(self, f"{key}_most", None)
        return f"{least}" if most is None else f"{least}-{most}"


COUNTS: Final = ("adaptations", "contacts", "false_alarms", "missed")
"""Keys of `ExpectSettings` that are counts, each with its `_most`."""
_TROUBLES: Final = (("false_alarms", "false"), ("missed", "missed"))


@dataclass(frozen=True)
class PayloadSettings:
    """One change of the payload."""

    at_s: float = setting(unit="s", low=0.0, high=1e6, meaning="since the drives were enabled")
    mass_kg: float = setting(unit="kg", low=0.0, high=20.0, meaning="payload from then on, at the tip; 0: none")
    center_m: tuple[float, float] = setting(
        (0.0, 0.0), unit="m", low=-2.0, high=2.0, meaning="its centre of mass from the tip, along and beside link 2"
    )
    inertia_kg_m2: float = setting(0.0, unit="kg m²", low=0.0, high=10.0, meaning="its inertia about that point")

    @property
    def tick(self) -> int:
        """First 100 µs tick, since the drives were enabled, with this payload."""
        return ticks(self.at_s)


@dataclass(frozen=True)
class Scenario:
    """Everything that the emulated arm and the person beside it do, resolved."""

    name: str = setting("", meaning="name of the scenario")
    about: str = setting("", meaning="what happens, in one line")
    group: str = setting("", meaning="which scenarios it belongs to")
    lasts_s: float = setting(
        51.0,
        unit="s",
        low=0.1,
        high=1e6,
        meaning="how long a run of it is meant to take, since the drives were enabled",
    )
    acknowledge_faults: int = setting(0, low=0, high=1000, meaning="how many faults the person acknowledges")
    profile: str = setting("P", choices=tuple(ARMS), meaning="which arm")
    own_arm: EmulatedArm | None = setting(None, meaning="an arm of one's own in place of the profile")
    truth: str = setting("", meaning="name of the truth in that arm, with the digest of a file")
    seed: int = setting(1, low=0, high=2**63 - 1, meaning="of the sensor noise")
    noise: bool = setting(True, meaning="noise of torque sensors and encoders; quantisation stays")
    start_deg: tuple[float, float] = setting(
        (0.0, 0.0), unit="deg", low=-180.0, high=180.0, meaning="pose at power-on, at rest"
    )
    payload_kg: float = setting(0.0, unit="kg", low=0.0, high=20.0, meaning="payload at power-on")
    torque_offset_Nm: tuple[float, float] = setting(
        (0.0, 0.0), unit="Nm", low=-50.0, high=50.0, meaning="zero error of the torque sensors"
    )
    sensors: SensorSettings = setting(SensorSettings, meaning="errors of the torque sensors and the encoders")
    drives: DriveSettings = setting(DriveSettings, meaning="errors and limits of the drives")
    habits: tuple[HabitSettings, ...] = setting((), meaning="ways of the drives, by place; none: those of our own")
    payloads: tuple[PayloadSettings, ...] = setting((), meaning="changes of the payload, in order of time")
    contacts: tuple[ContactSettings, ...] = setting((), meaning="touches, in order of time, one at a time")
    bodies: tuple[BodySettings, ...] = setting((), meaning="bodies in the arm's way")
    hands: tuple[HandSettings, ...] = setting((), meaning="hands that grasp and guide")
    walls: tuple[WallSettings, ...] = setting((), meaning="walls")
    faults: tuple[FaultSettings, ...] = setting((), meaning="what goes wrong, each row by its own time")

    mechanics: MechanicsSettings = setting(MechanicsSettings, meaning="the arm beyond rigid links")
    expect: ExpectSettings | None = setting(None, meaning="what a healthy host of configuration `paper` makes of it")
    expect_certified: ExpectSettings | None = setting(
        None, meaning="what one of configuration `certified` makes of it, where that is something else"
    )

    def __post_init__(self) -> None:
        if len(self.about.splitlines()) > 1:
            raise ConfigError(f"`about` has {len(self.about.splitlines())} lines, 1 expected")
        if len(self.habits) not in (0, len(self.start_deg)):
            raise ConfigError(f"`habits` has {len(self.habits)} rows, {len(self.start_deg)} expected")
        self.mechanics.check(self.arm, self.start_deg, self.payload_bodies)
        self._check_points("contacts", self.contacts)
        self._check_points("hands", self.hands)
        self._check_room("bodies", self.bodies)
        self._check_room("walls", self.walls)
        for index, (first, second) in enumerate(zip(self.contacts, self.contacts[1:], strict=False), start=1):
            if second.onset_tick < first.end_tick:
                raise ConfigError(
                    f"`contacts[{index}].at_s` = {second.at_s} s is before the end of the contact before it at "
                    f"{first.at_s + first.duration_s} s"
                )
        for index, change in enumerate(self.payloads):
            if change.mass_kg == 0.0 and (change.center_m != (0.0, 0.0) or change.inertia_kg_m2 != 0.0):
                raise ConfigError(f"`payloads[{index}].mass_kg` = 0 kg has neither `center_m` nor `inertia_kg_m2`")
        for index, (before, after) in enumerate(zip(self.payloads, self.payloads[1:], strict=False), start=1):
            if after.tick <= before.tick:
                raise ConfigError(
                    f"`payloads[{index}].at_s` = {after.at_s} s is not after the change before it at {before.at_s} s"
                )
        check_rows(self.faults)

    def _check_points(self, key: str, touches: Sequence[ContactSettings | HandSettings]) -> None:
        for index, one in enumerate(touches):
            length_m = self.arm.link_length_m[one.link - 1]
            if one.point_m > length_m:
                raise ConfigError(
                    f"`{key}[{index}].point_m` = {one.point_m} m is beyond the end of link {one.link} at {length_m} m"
                )

    def _check_room(self, key: str, things: Sequence[BodySettings | WallSettings]) -> None:
        pose_rad = math.radians(self.start_deg[0]), math.radians(self.start_deg[1])
        for index, thing in enumerate(things):
            overlap_m = thing.overlap_m(self.arm.link_length_m, pose_rad)
            if thing.onset_tick == 0 and overlap_m > 0.0:
                raise ConfigError(
                    f"`{key}[{index}]`: at at_s = 0 s the arm in its start pose {self.start_deg} deg "
                    f"is {overlap_m:.4g} m inside it"
                )

    @property
    def arm(self) -> EmulatedArm:
        """`own_arm`, or, without it, the arm of the profile."""
        return ARMS[self.profile] if self.own_arm is None else self.own_arm

    @property
    def payload_bodies(self) -> tuple[PayloadBody, ...]:
        """All payloads, as (mass kg, centre of mass m, inertia kg m²): none, that at power-on, then the changes."""
        changes = ((change.mass_kg, change.center_m, change.inertia_kg_m2) for change in self.payloads)
        return (0.0, (0.0, 0.0), 0.0), (self.payload_kg, (0.0, 0.0), 0.0), *changes

    @property
    def start_rad(self) -> Vector:
        """Pose at power-on, rad, (2,)."""
        return np.radians(self.start_deg)


def builtin_scenarios() -> list[str]:
    """Return the names of the scenarios that come with the package."""
    return toml_names(_FOLDER / "scenarios")


def load_scenario(name_or_file: str, profile: str | None = None, seed: int | None = None) -> Scenario:
    """Return a scenario: a built-in name or a TOML file. `profile` (of the arm), `seed`: in place of the file's.

    Raises ConfigError if the file is missing, can't be read or has errors.
    """
    return resolve_scenario(name_or_file, read_table(name_or_file), profile, seed)


def resolve_scenario(
    name_or_file: str, table: dict[str, Any], profile: str | None = None, seed: int | None = None
) -> Scenario:
    """Check a scenario's table and return the scenario; a given `profile` and `seed` are written into the table.

    Raises ConfigError with `name_or_file` if the table has errors.
    """
    if profile is not None:
        table["profile"] = profile
    if seed is not None:
        table["seed"] = seed
    try:
        return parse(Scenario, table)
    except ConfigError as error:
        raise ConfigError(f"scenario {name_or_file}: {error}") from None


def read_table(name_or_file: str) -> dict[str, Any]:
    """Return a scenario's TOML table, unchecked but for its syntax; `name` is the file's where the table has none.

    Raises ConfigError if the file is missing or no TOML.
    """
    return _read("scenario", name_or_file)


def _read(kind: str, name_or_file: str) -> dict[str, Any]:
    path = find_named(kind, name_or_file, _FOLDER / f"{kind}s")
    table = read_toml(path, kind)
    table.setdefault("name", path.stem)
    return table


def named_profile(name_or_file: str) -> str | None:
    """Return the name of the arm's profile in a scenario's file, unchecked; None if it names none.

    Raises ConfigError if the file can't be read.
    """
    profile = read_table(name_or_file).get("profile")
    return None if profile is None else str(profile)


_SAME: Final = (1.0, 1.0)
SCENARIO_SECTIONS: Final = {"sensors": SensorSettings, "drives": DriveSettings, "mechanics": MechanicsSettings}
"""Sections that a truth lays over those of a scenario."""


@dataclass(frozen=True)
class TruthArmSettings:
    """The arm itself; an absent value is that of the host's configuration, or assumed. Pairs are by joint."""

    link_length_m: Pair | None = setting(None, unit="m", low=0.01, high=5.0, meaning="joint to joint, joint 2 to tip")
    mass_kg: Pair | None = setting(None, unit="kg", low=1e-4, high=1000.0, meaning="mass of each link")
    center_m: Pair | None = setting(
        None, unit="m", low=-5.0, high=5.0, meaning="centre of mass from the link's joint; absent: the middle"
    )
    inertia_kg_m2: Pair | None = setting(
        None, unit="kg m²", low=0.0, high=1000.0, meaning="about the centre of mass; absent: a rod's"
    )
    viscous_Nm_s: Pair | None = setting(None, unit="Nm s/rad", low=0.0, high=1e4, meaning="viscous friction")
    coulomb_Nm: Pair | None = setting(None, unit="Nm", low=0.0, high=1e3, meaning="Coulomb friction")
    rated_torque_Nm: Pair | None = setting(
        None, unit="Nm", low=0.1, high=1000.0, meaning="rated torque of each joint's drive, 0x6076"
    )
    brake_damping_Nm_s: Pair | None = setting(
        None, unit="Nm s/rad", low=0.0, high=1e4, meaning="quick stop and fault: braking torque per rad/s"
    )
    stop_deg: Pair | None = setting(None, unit="deg", low=1.0, high=720.0, meaning="joint stops at ±")
    torque_offset_Nm: Pair | None = setting(
        None, unit="Nm", low=-50.0, high=50.0, meaning="zero error of the torque sensors"
    )

    def __post_init__(self) -> None:
        for key in ("center_m", "inertia_kg_m2"):
            if getattr(self, key) is not None and self.mass_kg is None:
                raise ConfigError(f"`arm.{key}` needs `arm.mass_kg` beside it")


@dataclass(frozen=True)
class FactorSettings:
    """Factors on values of the host's configuration, by joint."""

    link_length: Pair = setting(_SAME, low=0.1, high=10.0, meaning="of the lengths; masses keep their shares")
    mass: Pair = setting(_SAME, low=0.01, high=100.0, meaning="of the masses, and with them the inertia")
    rated_torque: Pair = setting(_SAME, low=0.01, high=100.0, meaning="of the rated torque of each joint's drive")
    gear: Pair = setting(
        _SAME, low=1e-3, high=1e3, meaning="of the gear ratio of each joint's drive: its torque and its counts"
    )
    torque_counts: Pair = setting(_SAME, low=1e-3, high=1e3, meaning="of the torque sensors' counts")
    position_counts: Pair = setting(_SAME, low=1e-3, high=1e3, meaning="of the drives' counts of position")
    velocity_counts: Pair = setting(_SAME, low=1e-3, high=1e3, meaning="of the drives' counts of velocity")


SWAPS = ("nothing", "drives", "sensors", "joints")


@dataclass(frozen=True)
class WiringSettings:
    """Devices that are exchanged or reversed against the host's configuration."""

    swapped: str = setting(
        "nothing", choices=SWAPS, meaning="what is exchanged between the joints; `joints`: drives and sensors"
    )
    reversed_joint: tuple[bool, bool] = setting(
        (False, False), meaning="joints whose drive and sensor both count the other way"
    )
    reversed_motor: tuple[bool, bool] = setting(
        (False, False), meaning="joints whose drive counts its torque against its position"
    )
    reversed_sensor: tuple[bool, bool] = setting((False, False), meaning="torque sensors that count the other way")


@dataclass(frozen=True)
class ArmTruth:
    """A truth, resolved, without its sections of a scenario."""

    name: str = setting("", meaning="name of the truth")
    about: str = setting("", meaning="what the host is told wrongly, in one line")
    arm: TruthArmSettings = setting(TruthArmSettings, meaning="the arm")
    factor: FactorSettings = setting(FactorSettings, meaning="factors on what the host is told")
    wiring: WiringSettings = setting(WiringSettings, meaning="devices elsewhere than the host is told")
    habits: HabitSettings | None = setting(None, meaning="ways of every drive, in place of its maker's")


def truth_names() -> list[str]:
    """Return the names of the truths that come with the package."""
    return toml_names(_FOLDER / "truths")


def load_truth(name_or_file: str) -> tuple[ArmTruth, dict[str, Any]]:
    """Return a truth, a built-in name or a TOML file, and its sections `sensors`, `drives`, `mechanics`, unchecked.

    The name of a file gets a digest of its content.

    Raises ConfigError if the file is missing, can't be read or has errors.
    """
    table = _read("truth", name_or_file)
    if name_or_file not in truth_names():
        content = json.dumps(table, sort_keys=True, default=str).encode()
        table["name"] = f"{table['name']} {hashlib.sha256(content).hexdigest()[:12]}"
    sections = {key: table.pop(key) for key in SCENARIO_SECTIONS if key in table}
    try:
        return parse(ArmTruth, table), sections
    except ConfigError as error:
        raise ConfigError(f"truth {name_or_file}: {error}") from None
