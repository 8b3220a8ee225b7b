"""Friction of a joint beyond constant viscous and Coulomb terms: Stribeck, LuGre, load and temperature.

The level of dry friction at the velocity v, with the torque τ through the joint and its lubricant at T °C:

    g(v) = (F_c + (F_s − F_c) exp(−(v/v_s)²)) exp(−k_c (T − 25)) + k_load |τ|       Nm

with the static level F_s and the Stribeck velocity v_s. Without bristles g opposes the motion, and at standstill up to
g(0) holds (`firmware_sim.arm.plant` decides the slips).
With LuGre's bristles (Canudas de Wit, Olsson, Åström, Lischinsky 1995) the deflection z has its own state:

    ż = v − σ₀ |v| z / g(v)         friction = σ₀ z + σ₁ ż + σ₂ v exp(−k_v (T − 25))

which creeps through z = v/|v| · g/σ₀ to friction g at steady motion, and is a spring σ₀ before it slides. The viscous
term drifts with k_v in both models. Power P of the friction warms the lubricant: C Ṫ = P − C (T − T_ambient) / t_cool.
"""

import math
from typing import Final

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector

REFERENCE_C: Final = 25.0
"""Temperature for which the profiles' friction holds."""

# Places in the vector that stands for the mechanics, two joints each; see `MechanicsSettings.numbers`.
SURPLUS: Final = 0  # F_s − F_c, Nm
STRIBECK: Final = 2  # v_s, rad/s
SIGMA0: Final = 4  # Nm/rad; 0: no bristles
SIGMA1: Final = 6  # Nm s/rad
SIGMA2: Final = 8  # Nm s/rad
LOAD: Final = 10  # k_load
VISCOUS_DROP: Final = 12  # k_v, 1/K
COULOMB_DROP: Final = 14  # k_c, 1/K
CAPACITY: Final = 16  # C, J/K; 0: the temperature stays
COOLING: Final = 18  # t_cool, s
AMBIENT: Final = 20  # T_ambient, °C
FREE: Final = 22  # 1: nothing dry in this joint, it never sticks
FRICTION_NUMBERS: Final = 24


@compiled
def dry_level(
    mechanics: Vector, joint: int, coulomb_Nm: float, velocity_rad_s: float, transmitted_Nm: float, drift: float
) -> float:
    """Give g(v) in Nm of joint 0 or 1; drift is the factor of `drift_factor` for Coulomb friction."""
    level = coulomb_Nm
    surplus = mechanics[SURPLUS + joint]
    if surplus != 0.0:
        ratio = velocity_rad_s / mechanics[STRIBECK + joint]
        level += surplus * math.exp(-ratio * ratio)
    return float(level * drift + mechanics[LOAD + joint] * abs(transmitted_Nm))


@compiled
def drift_factor(drop_per_K: float, temperature_C: float) -> float:
    """Give the factor of friction at a temperature, 1 at REFERENCE_C."""
    if drop_per_K == 0.0:
        return 1.0
    return math.exp(-drop_per_K * (temperature_C - REFERENCE_C))


@compiled
def bristle_rate(sigma0_Nm_rad: float, z_rad: float, velocity_rad_s: float, level_Nm: float) -> float:
    """Give ż in rad/s."""
    return velocity_rad_s - sigma0_Nm_rad * abs(velocity_rad_s) * z_rad / level_Nm


@compiled
def advance_bristle(sigma0_Nm_rad: float, z_rad: float, velocity_rad_s: float, level_Nm: float, step_s: float) -> float:
    """Give z after a step of constant velocity: exact, and stable however fast the bristle follows."""
    if velocity_rad_s == 0.0:
        return z_rad
    settled_rad = math.copysign(level_Nm / sigma0_Nm_rad, velocity_rad_s)
    share = -math.expm1(-sigma0_Nm_rad * abs(velocity_rad_s) / level_Nm * step_s)
    return z_rad + (settled_rad - z_rad) * share


@compiled
def warm(mechanics: Vector, joint: int, temperature_C: float, power_W: float, step_s: float) -> float:
    """Give the lubricant's temperature after a step of constant friction power, °C."""
    capacity_J_K = mechanics[CAPACITY + joint]
    if capacity_J_K == 0.0:
        return temperature_C
    cooling_s = mechanics[COOLING + joint]
    settled_C = mechanics[AMBIENT + joint] + power_W * cooling_s / capacity_J_K
    return float(temperature_C - (settled_C - temperature_C) * math.expm1(-step_s / cooling_s))
