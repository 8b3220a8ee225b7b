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
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from adacd_hil.records import Vector
from firmware_sim.arm.plant import ARM_NUMBERS, CURRENT_LOOP_RAD_S

STOP_STIFFNESS_NM_RAD: Final = (3000.0, 1000.0)
STOP_DAMPING_NM_S: Final = (10.0, 2.0)
"""Of the joint stops, per rad/s."""


@dataclass(frozen=True)
class RigidLink:
    """One rigid link: its length and where its mass is, seen from the joint that carries it."""

    length_m: float
    mass_kg: float
    center_m: float
    inertia_kg_m2: float  # about the centre of mass


@dataclass(frozen=True)
class ArmProfile:
    """A profile: links, joint friction, and the drives' ratings. Pairs are (joint 1, joint 2)."""

    name: str
    links: tuple[RigidLink, RigidLink]
    viscous_Nm_s: tuple[float, float]  # per rad/s of the joint
    coulomb_Nm: tuple[float, float]
    rated_torque_Nm: tuple[float, float]  # 0x6076, also the most that the drive gives
    brake_damping_Nm_s: tuple[float, float]  # quick stop and fault: braking torque per rad/s
    stop_deg: tuple[float, float] = (170.0, 160.0)  # joint stops at ±

    @property
    def link_length_m(self) -> tuple[float, float]:
        """Joint 1 to joint 2, joint 2 to tip."""
        return self.links[0].length_m, self.links[1].length_m

    def inertia(self, payload_kg: float = 0.0) -> tuple[float, float, float]:
        """Lump the masses into α, β, γ, kg m²."""
        first, second = self.links
        alpha = first.inertia_kg_m2 + first.mass_kg * first.center_m**2
        alpha += (second.mass_kg + payload_kg) * first.length_m**2
        beta = first.length_m * (second.mass_kg * second.center_m + payload_kg * second.length_m)
        gamma = second.inertia_kg_m2 + second.mass_kg * second.center_m**2 + payload_kg * second.length_m**2
        return alpha, beta, gamma

    def theta(self, payload_kg: float = 0.0) -> Vector:
        """Give the dynamic parameters in the order of `records.PARAMETER_NAMES` (7,)."""
        alpha, beta, gamma = self.inertia(payload_kg)
        return np.array([alpha + gamma, beta, gamma, *self.viscous_Nm_s, *self.coulomb_Nm])

    def numbers(self) -> np.void:
        """Pack the empty arm for compiled functions, one element of ARM_NUMBERS."""
        numbers: np.void = np.zeros(1, ARM_NUMBERS)[0]
        numbers["alpha"], numbers["beta"], numbers["gamma"] = self.inertia()
        numbers["length_m"][:] = self.link_length_m
        numbers["viscous_Nm_s"][:] = self.viscous_Nm_s
        numbers["coulomb_Nm"][:] = self.coulomb_Nm
        numbers["torque_limit_Nm"][:] = self.rated_torque_Nm
        numbers["brake_damping_Nm_s"][:] = self.brake_damping_Nm_s
        numbers["current_loop_rad_s"][:] = CURRENT_LOOP_RAD_S
        numbers["stop_high_rad"][:] = np.radians(self.stop_deg)
        numbers["stop_low_rad"][:] = -numbers["stop_high_rad"]
        numbers["stop_stiffness_Nm_rad"][:] = STOP_STIFFNESS_NM_RAD
        numbers["stop_damping_Nm_s"][:] = STOP_DAMPING_NM_S
        first, second = self.links
        numbers["moment_kg_m"] = first.mass_kg * first.center_m + second.mass_kg * first.length_m
        return numbers


_LINKS: Final = (RigidLink(0.35, 3.0, 0.20, 0.040), RigidLink(0.30, 1.5, 0.13, 0.015))
_LIGHT_LINKS: Final = (RigidLink(0.35, 1.5, 0.20, 0.020), RigidLink(0.30, 0.75, 0.13, 0.0075))
_RATED_TORQUE_NM: Final = (12.0, 6.0)

# Braking slows the unloaded arm with time constants of 10 to 30 ms, long enough that the 1.6 ms lag of the drive's
# velocity leaves them well damped, and the arm with 1 kg at its tip within 0.1 s.
_BRAKE_DAMPING_NM_S: Final = (25.0, 3.0)
_LIGHT_BRAKE_DAMPING_NM_S: Final = (12.5, 1.5)

ARMS: Final = {
    # Reproduces the paper's two adaptation times.
    "P": ArmProfile("P", _LIGHT_LINKS, (0.03, 0.015), (0.0375, 0.02), _RATED_TORQUE_NM, _LIGHT_BRAKE_DAMPING_NM_S),
    # Twice the inertia, little friction.
    "S": ArmProfile("S", _LINKS, (0.024, 0.012), (0.03, 0.016), _RATED_TORQUE_NM, _BRAKE_DAMPING_NM_S),
    # The torque sensor sees the gear's friction.
    "M": ArmProfile("M", _LINKS, (0.12, 0.06), (0.15, 0.08), _RATED_TORQUE_NM, _BRAKE_DAMPING_NM_S),
}
"""Profiles by name."""
