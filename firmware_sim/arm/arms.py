"""The arms that the emulator can play: two rigid links in the horizontal plane, with friction in both joints.

Profiles P, S and M are given by the masses that a lab could weigh, not by the host's lumped parameters. Link i
has its mass m_i at the distance c_i from joint i and the inertia I_i about that point. A payload m has its centre of
mass at (x, y) from the tip, in the frame of link 2, and the inertia I about it; a point mass at the tip has neither.

With the absolute link angles φ₁ = q₁, φ₂ = q₁ + q₂ and the unit vectors e(φ), n(φ) along and across a link, the
payload moves with ṙ = l₁ φ̇₁ n(φ₁) + φ̇₂ ((l₂ + x) n(φ₂) − y e(φ₂)). With n(φ₁)·n(φ₂) = cos q₂ and
n(φ₁)·e(φ₂) = sin q₂ the kinetic energy of the arm is

    T = ½ α φ̇₁² + (β cos q₂ − σ sin q₂) φ̇₁ φ̇₂ + ½ γ φ̇₂²                            kg m²
    α = I₁ + m₁ c₁² + (m₂ + m) l₁²          β = l₁ (m₂ c₂ + m (l₂ + x))
    γ = I₂ + m₂ c₂² + m ((l₂ + x)² + y²) + I     σ = l₁ m y

The host's a₁ = α + γ, a₂ = β, a₃ = γ appear in the truth record only.

An arm of one's own stands in place of a profile: section `[own_arm]` of a scenario. It also says how its devices are
wired: the joint, the direction and the counts of each, in the counts of the host's configuration.
Places 1 and 2 are those of the contract's names, Drive1 and Drive2, Sensor1 and Sensor2.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from adacd_hil.settings.schema import ConfigError, setting
from firmware_sim.arm.sensing import POSITION_LSB_RAD, Measurement


def pack_fields(settings: object, layout: np.dtype[np.void]) -> np.void:
    """Return a record of dtype `layout` with the values of the equally named attributes of `settings`.

    Other fields are 0.
    """
    numbers: np.void = np.zeros(1, layout)[0]
    for name in layout.names or ():
        if hasattr(settings, name):
            numbers[name] = getattr(settings, name)
    return numbers


Pair = tuple[float, float]
Joints = tuple[int, int]
IN_ORDER: Joints = (1, 2)


@dataclass(frozen=True)
class EmulatedArm:
    """Two links, and the devices at their joints. Pairs are by joint, or by place where they are about devices."""

    name: str = setting(meaning="name of the arm")
    link_length_m: Pair = setting(unit="m", low=0.01, high=5.0, meaning="joint to joint, and joint 2 to tip")
    mass_kg: Pair = setting(unit="kg", low=1e-4, high=1000.0, meaning="mass of each link")
    center_m: Pair = setting(unit="m", low=-5.0, high=5.0, meaning="centre of mass, from the joint that carries it")
    inertia_kg_m2: Pair = setting(unit="kg m²", low=0.0, high=1000.0, meaning="inertia about the centre of mass")
    viscous_Nm_s: Pair = setting(unit="Nm s/rad", low=0.0, high=1e4, meaning="viscous friction behind the sensor")
    coulomb_Nm: Pair = setting(unit="Nm", low=0.0, high=1e3, meaning="Coulomb friction behind the sensor")
    rated_torque_Nm: Pair = setting(
        unit="Nm", low=1e-3, high=1e5, meaning="rated torque of each joint's drive, 0x6076, and the most it gives"
    )
    brake_damping_Nm_s: Pair = setting(
        unit="Nm s/rad", low=0.0, high=1e4, meaning="quick stop and fault: braking torque per rad/s"
    )
    stop_deg: Pair = setting(unit="deg", low=1.0, high=720.0, meaning="joint stops at ±")
    drive_joint: Joints = setting(IN_ORDER, low=1, high=2, meaning="joint that each drive moves")
    sensor_joint: Joints = setting(IN_ORDER, low=1, high=2, meaning="joint that each torque sensor is at")
    drive_sign: Joints = setting((1, 1), low=-1, high=1, meaning="+1 or -1: joint direction to drive direction")
    motor_sign: Joints = setting((1, 1), low=-1, high=1, meaning="-1: the drive's torque counts against its position")
    sensor_sign: Joints = setting((1, 1), low=-1, high=1, meaning="+1 or -1: joint direction to sensor direction")
    zero_deg: Pair = setting(
        (0.0, 0.0), unit="deg", low=-720.0, high=720.0, meaning="position of each drive at q = 0, before its sign"
    )
    increments_per_joint_rev: Pair = setting(
        (0.0, 0.0), low=0.0, high=2.0**41, meaning="position counts per revolution of the joint; 0: 2^20"
    )
    velocity_factor: Pair = setting(
        (1.0, 1.0), low=1e-3, high=1e3, meaning="counts of velocity, in those that the contract says"
    )
    rated_count_Nm: Pair = setting(
        (1e-3, 1e-3), unit="Nm", low=1e-12, high=1e6, meaning="one count of 0x6076 of each drive, behind its gear"
    )
    torque_factor: Pair = setting(
        (1.0, 1.0), low=1e-3, high=1e3, meaning="counts of torque, in those that the contract says"
    )

    def __post_init__(self) -> None:
        for key in ("drive_joint", "sensor_joint"):
            if sorted(getattr(self, key)) != [1, 2]:
                raise ConfigError(f"`own_arm.{key}` = {list(getattr(self, key))} must be [1, 2] or [2, 1]")
        for key in ("drive_sign", "motor_sign", "sensor_sign"):
            if 0 in getattr(self, key):
                raise ConfigError(f"`own_arm.{key}` = {list(getattr(self, key))} must be +1 or -1 for each device")

    def inertia(self) -> tuple[float, float, float]:
        """Return α, β, γ of the mass matrix, kg m², without payload."""
        length1_m, (mass1_kg, mass2_kg) = self.link_length_m[0], self.mass_kg
        (center1_m, center2_m), (inertia1_kg_m2, inertia2_kg_m2) = self.center_m, self.inertia_kg_m2
        alpha = inertia1_kg_m2 + mass1_kg * center1_m**2 + mass2_kg * length1_m**2
        beta = length1_m * (mass2_kg * center2_m)
        gamma = inertia2_kg_m2 + mass2_kg * center2_m**2
        return alpha, beta, gamma

    @property
    def wiring(self) -> "Wiring":
        """Joints (0, 1), signs and zeros of Drive1 and Drive2, Sensor1 and Sensor2.

        The sign of a drive's torque is `drive_sign` times `motor_sign`. Only drives have zeros; they are rounded to
        2^-20 revolutions, their unit.
        """
        drive, sensor = (tuple(joint - 1 for joint in places) for places in (self.drive_joint, self.sensor_joint))
        torque = tuple(turn * up for turn, up in zip(self.drive_sign, self.motor_sign, strict=True))
        zero = tuple(round(math.radians(zero_deg) / POSITION_LSB_RAD) for zero_deg in self.zero_deg)
        return Wiring(drive, sensor, self.drive_sign, self.sensor_sign, torque, zero)  # type: ignore[arg-type]


_LENGTH_M: Final = (0.35, 0.30)
_CENTER_M: Final = (0.20, 0.13)
_STOP_DEG: Final = (170.0, 160.0)
_RATED_TORQUE_NM: Final = (12.0, 6.0)

# Braking slows the unloaded arm with time constants of 10 to 30 ms, long enough that the 1.6 ms lag of the drive's
# velocity leaves them well damped, and the arm with 1 kg at its tip within 0.1 s.
_BRAKE_DAMPING_NM_S: Final = (25.0, 3.0)
_LIGHT_BRAKE_DAMPING_NM_S: Final = (12.5, 1.5)


def _profile(
    name: str, mass_kg: Pair, inertia_kg_m2: Pair, viscous_Nm_s: Pair, coulomb_Nm: Pair, brake_damping_Nm_s: Pair
) -> EmulatedArm:
    return EmulatedArm(
        name, _LENGTH_M, mass_kg, _CENTER_M, inertia_kg_m2, viscous_Nm_s, coulomb_Nm,
        _RATED_TORQUE_NM, brake_damping_Nm_s, _STOP_DEG,
    )  # fmt: skip


ARMS: Final = {
    arm.name: arm
    for arm in (
        # Reproduces the paper's two adaptation times.
        _profile("P", (1.5, 0.75), (0.020, 0.0075), (0.03, 0.015), (0.0375, 0.02), _LIGHT_BRAKE_DAMPING_NM_S),
        # Twice the inertia, little friction.
        _profile("S", (3.0, 1.5), (0.040, 0.015), (0.024, 0.012), (0.03, 0.016), _BRAKE_DAMPING_NM_S),
        # The torque sensor sees the gear's friction.
        _profile("M", (3.0, 1.5), (0.040, 0.015), (0.12, 0.06), (0.15, 0.08), _BRAKE_DAMPING_NM_S),
    )
}
"""Profiles by name."""


@dataclass(frozen=True)
class Wiring:
    """Joint (0, 1) and direction (1, -1) of the device at each place: pairs are (Drive1, Drive2) or (Sensor1, Sensor2).

    torque_sign: direction of a drive's torque. zero_counts: position of each drive at q = 0, before `drive_sign`.
    """

    drive_joint: Joints
    sensor_joint: Joints
    drive_sign: Joints
    sensor_sign: Joints
    torque_sign: Joints
    zero_counts: Joints

    def read(self, measured: Measurement) -> Measurement:
        """Return a measurement by joint as pairs by device, (Drive1, Drive2) and (Sensor1, Sensor2), in counts.

        Each device takes the value of its joint, with its sign; a drive adds its zero before the sign.
        """
        positions, velocities, torques = measured
        (d1, d2), (s1, s2) = self.drive_joint, self.sensor_joint
        (up1, up2), (turn1, turn2) = self.drive_sign, self.sensor_sign
        zero1, zero2 = self.zero_counts
        return Measurement(
            (up1 * (positions[d1] + zero1), up2 * (positions[d2] + zero2)),
            (up1 * velocities[d1], up2 * velocities[d2]),
            (turn1 * torques[s1], turn2 * torques[s2]),
        )
