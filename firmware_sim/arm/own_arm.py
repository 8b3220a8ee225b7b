"""An arm of one's own in place of a profile: section `[own_arm]` of a scenario.

Its links, friction, ratings and stops are those of `firmware_sim.arm.arms.ArmProfile`; beside them stands how its
devices are wired: which joint each of them is at, which way it counts, and how many counts it makes of what the host
was told. Places 1 and 2 are those of the contract's names, Drive1 and Drive2, Sensor1 and Sensor2. Pairs are by joint,
or by place where they are about devices.
"""

from dataclasses import dataclass

from adacd_hil.settings.schema import ConfigError, setting
from firmware_sim.arm.arms import ArmProfile, RigidLink
from firmware_sim.arm.sensing import Measurement

Pair = tuple[float, float]
Joints = tuple[int, int]
IN_ORDER: Joints = (1, 2)


@dataclass(frozen=True)
class OwnArmSettings:
    """Two links of one's own, and the devices at their joints."""

    name: str = setting(meaning="name of the arm")
    link_length_m: Pair = setting(unit="m", low=0.01, high=5.0, meaning="joint to joint, and joint 2 to tip")
    mass_kg: Pair = setting(unit="kg", low=1e-4, high=1000.0, meaning="mass of each link")
    center_m: Pair = setting(unit="m", low=-5.0, high=5.0, meaning="centre of mass, from the joint that carries it")
    inertia_kg_m2: Pair = setting(unit="kg m²", low=0.0, high=1000.0, meaning="inertia about the centre of mass")
    viscous_Nm_s: Pair = setting(unit="Nm s/rad", low=0.0, high=1e4, meaning="viscous friction behind the sensor")
    coulomb_Nm: Pair = setting(unit="Nm", low=0.0, high=1e3, meaning="Coulomb friction behind the sensor")
    rated_torque_Nm: Pair = setting(
        unit="Nm", low=0.1, high=1000.0, meaning="rated torque of each joint's drive, 0x6076, and the most it gives"
    )
    brake_damping_Nm_s: Pair = setting(
        unit="Nm s/rad", low=0.0, high=1e4, meaning="quick stop and fault: braking torque per rad/s"
    )
    stop_deg: Pair = setting(unit="deg", low=1.0, high=720.0, meaning="joint stops at ±")
    drive_joint: Joints = setting(IN_ORDER, low=1, high=2, meaning="joint that each drive moves")
    sensor_joint: Joints = setting(IN_ORDER, low=1, high=2, meaning="joint that each torque sensor is at")
    drive_sign: Joints = setting((1, 1), low=-1, high=1, meaning="+1 or -1: joint direction to drive direction")
    sensor_sign: Joints = setting((1, 1), low=-1, high=1, meaning="+1 or -1: joint direction to sensor direction")
    increments_per_joint_rev: Pair = setting(
        (0.0, 0.0), low=0.0, high=2.0**41, meaning="position counts per revolution of the joint; 0: 2^20"
    )
    velocity_factor: Pair = setting(
        (1.0, 1.0), low=1e-3, high=1e3, meaning="counts of velocity, in those that the contract says"
    )
    torque_factor: Pair = setting(
        (1.0, 1.0), low=1e-3, high=1e3, meaning="counts of torque, in those that the contract says"
    )

    def __post_init__(self) -> None:
        for key in ("drive_joint", "sensor_joint"):
            if sorted(getattr(self, key)) != [1, 2]:
                raise ConfigError(f"`own_arm.{key}` = {list(getattr(self, key))} must be [1, 2] or [2, 1]")
        for key in ("drive_sign", "sensor_sign"):
            if 0 in getattr(self, key):
                raise ConfigError(f"`own_arm.{key}` = {list(getattr(self, key))} must be +1 or -1 for each device")

    @property
    def profile(self) -> ArmProfile:
        """The arm without its wiring."""
        first, second = (
            RigidLink(self.link_length_m[i], self.mass_kg[i], self.center_m[i], self.inertia_kg_m2[i]) for i in range(2)
        )
        return ArmProfile(
            self.name,
            (first, second),
            self.viscous_Nm_s,
            self.coulomb_Nm,
            self.rated_torque_Nm,
            self.brake_damping_Nm_s,
            self.stop_deg,
        )

    @property
    def wiring(self) -> "Wiring":
        """How the devices are at the joints."""
        drive, sensor = (tuple(joint - 1 for joint in places) for places in (self.drive_joint, self.sensor_joint))
        return Wiring(drive, sensor, self.drive_sign, self.sensor_sign)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Wiring:
    """Which joint (0, 1) the device at each place is at, and which way it counts."""

    drive_joint: Joints = (0, 1)
    sensor_joint: Joints = (0, 1)
    drive_sign: Joints = (1, 1)
    sensor_sign: Joints = (1, 1)

    def read(self, measured: Measurement) -> Measurement:
        """Order the samples of the joints by the devices' places, each counted the device's way."""
        positions, velocities, torques = measured
        (d1, d2), (s1, s2) = self.drive_joint, self.sensor_joint
        (up1, up2), (turn1, turn2) = self.drive_sign, self.sensor_sign
        return Measurement(
            (up1 * positions[d1], up2 * positions[d2]),
            (up1 * velocities[d1], up2 * velocities[d2]),
            (turn1 * torques[s1], turn2 * torques[s2]),
        )


STRAIGHT = Wiring()
