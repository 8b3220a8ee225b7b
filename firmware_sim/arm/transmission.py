"""The gear between motor and torque sensor: spring with dead zone, rotor, ripple and motor-side friction.

All quantities are seen from the joint: a rotor's inertia is already multiplied by the square of the gear ratio.

    J q̈_m = τ_m + ripple(q_m, τ_m) − F_vm q̇_m − (motor-side Coulomb friction) − τ_s
    τ_s   = K dead(q_m − q, b) + D (q̇_m − q̇)                        the torque that the sensor sees
    dead(x, b) = x − b/2 above b/2, x + b/2 below −b/2, 0 within     b: whole width of the backlash

In the dead zone nothing is transmitted, damping included, and a flank only pushes: where K dead + D (q̇_m − q̇) would
pull, the flanks have parted and τ_s is 0. Ripple is (amplitude + share · |τ_m|) sin(n q_m + phase).
"""

import math
from typing import Final

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from firmware_sim.arm.plant_friction import FRICTION_NUMBERS

# Places in the vector that stands for the mechanics, two joints each.
STIFFNESS: Final = FRICTION_NUMBERS  # K, Nm/rad; 0: the joint is stiff
DAMPING: Final = FRICTION_NUMBERS + 2  # D, Nm s/rad
ROTOR_INERTIA: Final = FRICTION_NUMBERS + 4  # J, kg m²
BACKLASH: Final = FRICTION_NUMBERS + 6  # b, rad
RIPPLE: Final = FRICTION_NUMBERS + 8  # Nm
RIPPLE_SHARE: Final = FRICTION_NUMBERS + 10
RIPPLE_PERIODS: Final = FRICTION_NUMBERS + 12  # n, per revolution of the joint
RIPPLE_PHASE: Final = FRICTION_NUMBERS + 14  # rad
MOTOR_VISCOUS: Final = FRICTION_NUMBERS + 16  # F_vm, Nm s/rad
MOTOR_COULOMB: Final = FRICTION_NUMBERS + 18  # Nm
ENCODER_ON_LINK: Final = FRICTION_NUMBERS + 20  # 1: the encoder is on the link side
TRANSMISSION_NUMBERS: Final = FRICTION_NUMBERS + 22


@compiled
def spring_torque(mechanics: Vector, joint: int, twist_rad: float, twist_rad_s: float) -> float:
    """Give τ_s in Nm of an elastic joint, twist = motor side minus link side."""
    stiffness = mechanics[STIFFNESS + joint]
    damping = mechanics[DAMPING + joint]
    half_rad = 0.5 * mechanics[BACKLASH + joint]
    if half_rad == 0.0:
        return float(stiffness * twist_rad + damping * twist_rad_s)
    if twist_rad > half_rad:
        return float(max(0.0, stiffness * (twist_rad - half_rad) + damping * twist_rad_s))
    if twist_rad < -half_rad:
        return float(min(0.0, stiffness * (twist_rad + half_rad) + damping * twist_rad_s))
    return 0.0


@compiled
def ripple_torque(mechanics: Vector, joint: int, shaft_rad: float, motor_Nm: float) -> float:
    """Give the ripple in Nm that adds to the motor torque."""
    amplitude = mechanics[RIPPLE + joint] + mechanics[RIPPLE_SHARE + joint] * abs(motor_Nm)
    if amplitude == 0.0:
        return 0.0
    return float(amplitude * math.sin(mechanics[RIPPLE_PERIODS + joint] * shaft_rad + mechanics[RIPPLE_PHASE + joint]))
