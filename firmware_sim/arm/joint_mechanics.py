"""A joint's dry and viscous friction, and the gear between its motor and its torque sensor.

Friction, beyond constant viscous and Coulomb terms: Stribeck, LuGre, load and temperature. The level of
dry friction at the velocity v, with the torque τ through the joint and its lubricant at T °C:

    g(v) = (F_c + (F_s − F_c) exp(−(v/v_s)²)) exp(−k_c (T − 25)) + k_load |τ|       Nm

with the static level F_s and the Stribeck velocity v_s. Without bristles g opposes the motion, and at standstill up to
g(0) holds (`firmware_sim.arm.plant` decides the slips).
With LuGre's bristles (Canudas de Wit, Olsson, Åström, Lischinsky 1995) the deflection z has its own state:

    ż = v − σ₀ |v| z / g(v)         friction = σ₀ z + σ₁ ż + σ₂ v exp(−k_v (T − 25))

which creeps through z = v/|v| · g/σ₀ to friction g at steady motion, and is a spring σ₀ before it slides. The viscous
term drifts with k_v in both models. Power P of the friction warms the lubricant: C Ṫ = P − C (T − T_ambient) / t_cool.

The gear: spring with dead zone, rotor, ripple and motor-side friction. All quantities
are seen from the joint: a rotor's inertia is already multiplied by the square of the gear ratio.

    J q̈_m = τ_m + ripple(q_m, τ_m) − F_vm q̇_m − (motor-side Coulomb friction) − τ_s
    τ_s   = K dead(q_m − q, b) + D (q̇_m − q̇)                        the torque that the sensor sees
    dead(x, b) = x − b/2 above b/2, x + b/2 below −b/2, 0 within     b: whole width of the backlash

In the dead zone nothing is transmitted, damping included, and a flank only pushes: where K dead + D (q̇_m − q̇) would
pull, the flanks have parted and τ_s is 0. Ripple is (amplitude + share · |τ_m|) sin(n q_m + phase).
"""

import math
from typing import Final

import numpy as np

from adacd_hil.compiled import compiled, float_fields

REFERENCE_C: Final = 25.0
"""Temperature for which the profiles' friction holds."""

PAIR: Final = (2,)
"""Shape of what both joints have."""

MECHANICS_NUMBERS: Final = float_fields(
    {
        "surplus_Nm": PAIR,  # F_s − F_c, Nm
        "stribeck_rad_s": PAIR,  # v_s, rad/s
        "sigma0_Nm_rad": PAIR,  # Nm/rad; 0: no bristles
        "sigma1_Nm_s": PAIR,
        "sigma2_Nm_s": PAIR,
        "load_friction": PAIR,  # k_load
        "viscous_drop_per_K": PAIR,  # k_v, 1/K
        "coulomb_drop_per_K": PAIR,  # k_c, 1/K
        "capacity_J_K": PAIR,  # C, J/K; 0: the temperature stays
        "cooling_s": PAIR,  # t_cool, s
        "ambient_C": PAIR,  # T_ambient, °C
        "is_free": PAIR,  # nothing dry in this joint, it never sticks
        "stiffness_Nm_rad": PAIR,  # K, Nm/rad; 0: the joint is stiff
        "damping_Nm_s": PAIR,  # D, Nm s/rad
        "rotor_inertia_kg_m2": PAIR,  # J, kg m²
        "backlash_rad": PAIR,  # b, rad
        "ripple_Nm": PAIR,
        "ripple_share": PAIR,
        "ripple_periods": PAIR,  # n, per revolution of the joint
        "ripple_phase_rad": PAIR,
        "motor_viscous_Nm_s": PAIR,  # F_vm, Nm s/rad
        "motor_coulomb_Nm": PAIR,
        "is_encoder_on_link": PAIR,  # the encoder is on the link side
        "gravity_m_s2": (),  # g', m/s²
        "downhill_rad": (),  # δ, rad
        "holding_brake_Nm": PAIR,  # motor side, while the drive is off
    }
)
"""What `MechanicsSettings.numbers` fills in: friction, transmission, gravity and the holding brakes."""


@compiled
def dry_level(
    mechanics: np.void, joint: int, coulomb_Nm: float, velocity_rad_s: float, transmitted_Nm: float, drift: float
) -> float:
    """Give g(v) in Nm of joint 0 or 1; drift is the factor of `drift_factor` for Coulomb friction."""
    level = coulomb_Nm
    surplus = mechanics["surplus_Nm"][joint]
    if surplus != 0.0:
        ratio = velocity_rad_s / mechanics["stribeck_rad_s"][joint]
        level += surplus * math.exp(-ratio * ratio)
    return float(level * drift + mechanics["load_friction"][joint] * abs(transmitted_Nm))


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
def warm(mechanics: np.void, joint: int, temperature_C: float, power_W: float, step_s: float) -> float:
    """Give the lubricant's temperature after a step of constant friction power, °C."""
    capacity_J_K = mechanics["capacity_J_K"][joint]
    if capacity_J_K == 0.0:
        return temperature_C
    cooling_s = mechanics["cooling_s"][joint]
    settled_C = mechanics["ambient_C"][joint] + power_W * cooling_s / capacity_J_K
    return float(temperature_C - (settled_C - temperature_C) * math.expm1(-step_s / cooling_s))


@compiled
def spring_torque(mechanics: np.void, joint: int, twist_rad: float, twist_rad_s: float) -> float:
    """Give τ_s in Nm of an elastic joint, twist = motor side minus link side."""
    stiffness = mechanics["stiffness_Nm_rad"][joint]
    damping = mechanics["damping_Nm_s"][joint]
    half_rad = 0.5 * mechanics["backlash_rad"][joint]
    if half_rad == 0.0:
        return float(stiffness * twist_rad + damping * twist_rad_s)
    if twist_rad > half_rad:
        return float(max(0.0, stiffness * (twist_rad - half_rad) + damping * twist_rad_s))
    if twist_rad < -half_rad:
        return float(min(0.0, stiffness * (twist_rad + half_rad) + damping * twist_rad_s))
    return 0.0


@compiled
def ripple_torque(mechanics: np.void, joint: int, shaft_rad: float, motor_Nm: float) -> float:
    """Give the ripple in Nm that adds to the motor torque."""
    amplitude = mechanics["ripple_Nm"][joint] + mechanics["ripple_share"][joint] * abs(motor_Nm)
    if amplitude == 0.0:
        return 0.0
    return float(
        amplitude * math.sin(mechanics["ripple_periods"][joint] * shaft_rad + mechanics["ripple_phase_rad"][joint])
    )
