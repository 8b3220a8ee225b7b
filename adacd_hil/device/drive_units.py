"""Units of a drive's counts at the joint, by its objects: position, velocity, and the torque of its motor.

    position   0x6064 in increments: 0x608F per motor revolution, times the gear 0x6091; if 0x6092 has 360 units or
               more per revolution of the driven shaft, in these; else, if 0x60A8 is an angle, in that of the motor
    velocity   0x606C in increments per second, or in the unit of 0x60A9, as rpm, of the motor
    torque     0x6071, 0x6077 in per mille of 0x6076, the motor's rated torque

A unit is coded 0xPPNNDD00: power of ten (signed), numerator, denominator. Source: CiA 402-2 / IEC 61800-7-201 (0x608F,
0x6091, 0x6092, 0x60A8, 0x60A9), CiA 303-2 (codes of units).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

Number = Callable[[int, int], int | None]
"""Returns the value of an object by index and sub-index; None without one."""

LEAST_INCREMENTS = 360
"""Per revolution of a joint, 1 deg. A drive with factory values of 1 : 1 has 1."""
CREDIBLE_INCREMENTS = 4096
"""Per revolution of a joint, 1.5 mrad: fewer are more likely a factory value."""

_INCREMENTS, _REVOLUTION = 0xB5, 0xB4
RPM = 0x00B44700
_ANGLES_RAD = {
    _REVOLUTION: math.tau,
    0x41: math.radians(1.0),
    0x42: math.radians(1.0 / 60.0),
    0x43: math.radians(1.0 / 3600.0),
    0x10: 1.0,
}
"""Numerators that are angles: revolution, degree, minute, second, radian."""
_TIMES_S = {0x03: 1.0, 0x47: 60.0, 0x48: 3600.0}
"""Denominators: second, minute, hour."""
_NAMES = {_INCREMENTS: "increment", _REVOLUTION: "revolution", 0x41: "deg", 0x42: "arcmin", 0x43: "arcsec", 0x10: "rad"}
_TIME_NAMES = {0x03: "s", 0x47: "min", 0x48: "h"}


class DriveUnits(NamedTuple):
    """Units by the objects of a drive; None, "" or 0 if they are missing.

    gear_ratio: 0x6091, motor revolutions per revolution of the joint. increments_per_joint_rev: counts of 0x6064;
    increments_text: the objects behind it, with their values. velocity_rad_s: one count of 0x606C at the joint, None if
    0x60A9 is missing or no velocity, or counts increments of unknown size; velocity_unit: the code in 0x60A9.
    """

    gear_ratio: float | None = None
    increments_per_joint_rev: float | None = None
    increments_text: str = ""
    velocity_rad_s: float | None = None
    velocity_unit: int = 0

    @property
    def has_increments(self) -> bool:
        """Whether `increments_per_joint_rev` is known and at least LEAST_INCREMENTS: fewer are the factory's 1 : 1."""
        return (self.increments_per_joint_rev or 0.0) >= LEAST_INCREMENTS

    @property
    def stated_gear_ratio(self) -> float | None:
        """`gear_ratio`; None, too, for 1 : 1, the factory's value."""
        return None if self.gear_ratio == 1.0 else self.gear_ratio

    def is_other_gear(self, ratio: float) -> bool:
        """Return whether 0x6091 differs from a profile's `scale.gear_ratio` by more than 0.1 %; False without 0x6091.

        1 in the profile doesn't contradict: 0x6076 is then the joint's. Nor does 1 : 1 in the drive.
        """
        return ratio != 1.0 and not math.isclose(ratio, self.stated_gear_ratio or ratio, rel_tol=1e-3)


def read_drive_units(number: Number, gear_ratio: float = 1.0) -> DriveUnits:
    """Return the units of a drive's position and velocity by its objects; `number` returns an object's value or None.

    Increments come from 0x6092 if it has at least LEAST_INCREMENTS per revolution. Without that they come from 0x60A8
    if its unit is an angle, else from 0x608F, both times the gear. `gear_ratio`: motor revolutions per revolution of
    the joint, used if 0x6091 is missing or 0.
    """
    encoder, motor_revs = number(0x608F, 1), number(0x608F, 2)
    gear_in, gear_out = number(0x6091, 1), number(0x6091, 2)
    feed, shaft_revs = number(0x6092, 1), number(0x6092, 2)
    position_unit, velocity_unit = number(0x60A8, 0), number(0x60A9, 0)
    gear = gear_in / gear_out if gear_in and gear_out else None
    ratio = gear_ratio if gear is None else gear
    ratio_text = f"`scale.gear_ratio` {gear_ratio:g}" if gear is None else f"{gear_in}/{gear_out}"
    increments, text = None, ""
    if encoder:
        increments = encoder / (motor_revs or 1) * ratio
        text = f"0x608F x 0x6091 = {encoder}/{motor_revs or 1} x {ratio_text}"
    if feed and feed / (shaft_revs or 1) >= LEAST_INCREMENTS:
        increments, text = feed / (shaft_revs or 1), f"0x6092 = {feed}/{shaft_revs or 1}"
    elif (count_rad := _angle_rad(position_unit)) is not None:
        increments, text = math.tau / count_rad * ratio, f"0x60A8 x 0x6091 = 0x{position_unit:08X} x {ratio_text}"
    velocity = velocity_rad_s(velocity_unit, increments, ratio)
    return DriveUnits(gear, increments, text, velocity, velocity_unit or 0)


def _angle_rad(unit: int | None) -> float | None:
    """Return one count of a position unit, rad; None for increments and other units that don't measure an angle."""
    if not unit:
        return None
    angle_rad = _ANGLES_RAD.get(unit >> 16 & 0xFF)
    return None if angle_rad is None else angle_rad * 10.0 ** unit_prefix(unit)


def velocity_rad_s(unit: int | None, increments: float | None, gear_ratio: float) -> float | None:
    """Return one count of a velocity unit at the joint, rad/s; None for another unit, or increments of unknown size.

    increments: per revolution of the joint; None or 0: unknown. gear_ratio: for units of an angle, which are the
    motor's.
    """
    if not unit or (time_s := _TIMES_S.get(unit >> 8 & 0xFF)) is None:
        return None
    if unit >> 16 & 0xFF == _INCREMENTS:
        return None if not increments else 10.0 ** unit_prefix(unit) * math.tau / increments / time_s
    angle_rad = _angle_rad(unit)
    return None if angle_rad is None else angle_rad / time_s / gear_ratio


def unit_prefix(unit: int) -> int:
    """Return the exponent of ten of a unit's code, such as -3 for milli."""
    prefix = unit >> 24 & 0xFF
    return prefix - 256 if prefix > 127 else prefix


def name_velocity_unit(unit: int) -> str:
    """Return the name of a unit of 0x60A9: `rpm`, `10^-3 rpm`, `increment/s`; the code of an unknown one."""
    numerator, denominator = unit >> 16 & 0xFF, unit >> 8 & 0xFF
    if numerator not in _NAMES or denominator not in _TIME_NAMES:
        return f"0x{unit:08X}"
    power = f"10^{unit_prefix(unit)} " if unit_prefix(unit) else ""
    if unit & 0xFFFFFF == RPM:
        return f"{power}rpm"
    return f"{power}{_NAMES[numerator]}/{_TIME_NAMES[denominator]}"
