"""Arms for the laboratory: profiles P, S, M and random ones around them, with friction variants and sensor errors."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from lab_motion import PERIOD_S
from numpy.typing import NDArray

from adacd_hil.settings.configuration_files import load_settings
from firmware_sim.arm.arms import ARMS, EmulatedArm
from firmware_sim.arm.hardware_settings import DriveSettings, MechanicsSettings, SensorSettings

Pair = tuple[float, float]

FRICTIONS = ("plain", "stribeck", "drift", "load", "asymmetric")
STATIC_SHARE = 2.0
"""Static over Coulomb friction of variant "stribeck"; it falls off at 0.05 rad/s."""
DRIFT_SHARE = 0.2
DRIFT_S = 120.0
"""Friction goes up and down by DRIFT_SHARE in this time, in variant "drift"."""
ASYMMETRY = 0.15
"""Coulomb friction is larger by this share at positive velocity, and smaller at negative, in variant "asymmetric"."""
LOAD_SHARE = (0.02, 0.02)
_REFERENCE = "S"  # whose gains are scaled with the inertia


def theta_of(arm: EmulatedArm, payload_kg: float = 0.0) -> NDArray[np.float64]:
    """Return an arm's parameters (7,) in the order of `records.PARAMETER_NAMES`, with a point mass at its tip."""
    alpha, beta, gamma = arm.inertia()
    length1_m, length2_m = arm.link_length_m
    alpha += payload_kg * length1_m**2
    beta += payload_kg * length1_m * length2_m
    gamma += payload_kg * length2_m**2
    return np.array([alpha + gamma, beta, gamma, *arm.viscous_Nm_s, *arm.coulomb_Nm])


@dataclass(frozen=True)
class LabArm:
    """An arm to be recorded. torque_offset_Nm: zero error of the torque sensors; pairs are (joint 1, joint 2)."""

    arm: EmulatedArm
    Kp: Pair
    Kd: Pair
    payload_kg: float = 0.0
    friction: str = "plain"
    torque_offset_Nm: Pair = (0.0, 0.0)
    sensors: SensorSettings = field(default_factory=SensorSettings)
    drives: DriveSettings = field(default_factory=DriveSettings)
    own_mechanics: MechanicsSettings | None = None

    @property
    def name(self) -> str:
        """Profile, payload and friction, for tables."""
        load = f" {self.payload_kg:g} kg" if self.payload_kg else ""
        return f"{self.arm.name}{load}" + ("" if self.friction == "plain" else f" {self.friction}")

    @cached_property
    def theta(self) -> NDArray[np.float64]:
        """True parameters (7,), payload included, at the beginning of the record's drift."""
        return theta_of(self.arm, self.payload_kg)

    @property
    def mechanics(self) -> MechanicsSettings:
        """What the rigid plant leaves out: its own, or that of a variant that needs some."""
        if self.own_mechanics is not None:
            return self.own_mechanics
        if self.friction == "stribeck":
            static_Nm = (STATIC_SHARE * self.arm.coulomb_Nm[0], STATIC_SHARE * self.arm.coulomb_Nm[1])
            return MechanicsSettings(static_Nm=static_Nm)
        if self.friction == "load":
            return MechanicsSettings(load_friction=LOAD_SHARE)
        return MechanicsSettings()

    @property
    def asymmetry(self) -> float:
        """Share by which Coulomb friction depends on the direction."""
        return ASYMMETRY if self.friction == "asymmetric" else 0.0

    def drift(self, seed: int, count: int) -> NDArray[np.float64]:
        """Return the factors (n, 2) of viscous and Coulomb friction over a record; ones but in variant "drift"."""
        if self.friction != "drift":
            return np.ones((count, 2))
        turns = np.random.default_rng([seed, 3]).uniform(0.0, 1.0, 2)
        turns = turns + np.arange(count)[:, None] * (PERIOD_S / DRIFT_S)
        return 1.0 + DRIFT_SHARE * np.sin(2.0 * np.pi * turns)


def profile_arm(profile: str, payload_kg: float = 0.0, friction: str = "plain", **changes: object) -> LabArm:
    """Return profile P, S or M with the gains of the configuration `paper`; further fields of LabArm by name."""
    controller = load_settings("paper", profile).controller
    built = LabArm(ARMS[profile], controller.Kp, controller.Kd, payload_kg, _known(friction))
    return replace(built, **changes)  # type: ignore[arg-type]


def random_arm(seed: int, payload_kg: float = 0.0, friction: str = "plain", **changes: object) -> LabArm:
    """Draw an arm: links from 0.7 of P's to 1.5 of S's masses, friction from half of S's to 1.5 of M's.

    The gains follow the inertia, so that it is controlled as well as the profiles are.
    """
    generator = np.random.default_rng([seed, 4])
    links = []
    light = ARMS["P"]
    for light_m, light_kg, heavy_kg in zip(light.link_length_m, light.mass_kg, ARMS[_REFERENCE].mass_kg, strict=True):
        length_m = light_m * generator.uniform(0.8, 1.2)
        mass_kg = np.exp(generator.uniform(np.log(0.7 * light_kg), np.log(1.5 * heavy_kg)))
        center_m = length_m * generator.uniform(0.35, 0.65)
        inertia_kg_m2 = mass_kg * length_m**2 * generator.uniform(0.07, 0.14)
        links.append((float(length_m), float(mass_kg), float(center_m), float(inertia_kg_m2)))
    low, high = ARMS[_REFERENCE], ARMS["M"]
    share = generator.uniform(0.0, 1.0, (2, 2))
    viscous, coulomb = (
        np.exp(np.log(0.5 * np.array(least)) * (1.0 - share[row]) + np.log(1.5 * np.array(most)) * share[row])
        for row, (least, most) in enumerate(((low.viscous_Nm_s, high.viscous_Nm_s), (low.coulomb_Nm, high.coulomb_Nm)))
    )
    lengths_m, masses_kg, centers_m, inertias_kg_m2 = ((first, second) for first, second in zip(*links, strict=True))
    drawn = replace(
        low,
        name=f"random {seed}",
        link_length_m=lengths_m,
        mass_kg=masses_kg,
        center_m=centers_m,
        inertia_kg_m2=inertias_kg_m2,
        viscous_Nm_s=(float(viscous[0]), float(viscous[1])),
        coulomb_Nm=(float(coulomb[0]), float(coulomb[1])),
    )
    scale = theta_of(drawn)[[0, 2]] / theta_of(low)[[0, 2]]
    torque = np.maximum(1.0, scale)
    drawn = replace(
        drawn, rated_torque_Nm=(low.rated_torque_Nm[0] * float(torque[0]), low.rated_torque_Nm[1] * float(torque[1]))
    )
    controller = load_settings("paper", _REFERENCE).controller
    Kp = (controller.Kp[0] * float(scale[0]), controller.Kp[1] * float(scale[1]))
    Kd = (controller.Kd[0] * float(scale[0]), controller.Kd[1] * float(scale[1]))
    built = LabArm(drawn, Kp, Kd, payload_kg, _known(friction))
    return replace(built, **changes)  # type: ignore[arg-type]


def _known(friction: str) -> str:
    if friction not in FRICTIONS:
        raise ValueError(f"friction = {friction!r} is none of {', '.join(FRICTIONS)}")
    return friction
