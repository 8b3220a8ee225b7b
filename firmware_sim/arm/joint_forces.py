"""Friction and gear of the joints, and all forces of one instant in the arm.

`firmware_sim.arm.mechanics` integrates them. `now` is one element of ROW: where the arm is.

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

In the dead zone the gear transmits no torque, damping included. A flank only pushes: where K dead + D (q̇_m − q̇) would
pull, the flanks have parted and τ_s is 0. Ripple is (amplitude + share · |τ_m|) sin(n q_m + phase).
"""

import math
from typing import Final, NamedTuple

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from adacd_hil.structured import Structured, float_fields
from firmware_sim.arm.plant import accelerate, decide_slips, external_torque
from firmware_sim.arm.touch_forces import touch
from firmware_sim.arm.touch_settings import PAIR

REFERENCE_C: Final = 25.0
"""Temperature for which the profiles' friction holds."""

MECHANICS_NUMBERS: Final = float_fields(
    {
        "surplus_Nm": PAIR,  # F_s − F_c, Nm
        "stribeck_velocity_rad_s": PAIR,  # v_s, rad/s
        "sigma0_Nm_rad": PAIR,  # Nm/rad; 0: no bristles
        "sigma1_Nm_s": PAIR,
        "sigma2_Nm_s": PAIR,
        "load_friction": PAIR,  # k_load
        "viscous_drop_per_K": PAIR,  # k_v, 1/K
        "coulomb_drop_per_K": PAIR,  # k_c, 1/K
        "heat_capacity_J_K": PAIR,  # C, J/K; 0: the temperature stays
        "cooling_s": PAIR,  # t_cool, s
        "ambient_C": PAIR,  # T_ambient, °C
        "is_free": PAIR,  # no dry friction in this joint, it never sticks
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
"""Filled in by `MechanicsSettings.numbers`: friction, transmission, gravity and the holding brakes."""


@compiled
def dry_level(
    mechanics: np.void, joint: int, coulomb_Nm: float, velocity_rad_s: float, transmitted_Nm: float, drift: float
) -> float:
    """Return the level g(v) of dry friction at joint 0 or 1, Nm: Stribeck curve times `drift`, plus the load's share.

    transmitted_Nm: load through the joint. drift: the temperature's factor, from `drift_factor`.
    """
    level = coulomb_Nm
    surplus = mechanics["surplus_Nm"][joint]
    if surplus != 0.0:
        ratio = velocity_rad_s / mechanics["stribeck_velocity_rad_s"][joint]
        level += surplus * math.exp(-ratio * ratio)
    return float(level * drift + mechanics["load_friction"][joint] * abs(transmitted_Nm))


@compiled
def drift_factor(drop_per_K: float, temperature_C: float) -> float:
    """Return the factor of friction at a temperature, exp(-k (T - 25)), 1 at REFERENCE_C; drop_per_K: k."""
    if drop_per_K == 0.0:
        return 1.0
    return math.exp(-drop_per_K * (temperature_C - REFERENCE_C))


@compiled
def bristle_rate(sigma0_Nm_rad: float, z_rad: float, velocity_rad_s: float, level_Nm: float) -> float:
    """Return ż = v - σ₀ |v| z / g(v), rad/s: the rate of the bristle deflection z of LuGre friction; level_Nm: g(v)."""
    return velocity_rad_s - sigma0_Nm_rad * abs(velocity_rad_s) * z_rad / level_Nm


@compiled
def advance_bristle(sigma0_Nm_rad: float, z_rad: float, velocity_rad_s: float, level_Nm: float, step_s: float) -> float:
    """Return the bristle deflection z after a step of constant velocity, rad: exact, stable at any stiffness.

    level_Nm: g(v). It and the stiffness of the bristles, `sigma0_Nm_rad`, must be above 0.
    """
    if velocity_rad_s == 0.0:
        return z_rad
    settled_rad = math.copysign(level_Nm / sigma0_Nm_rad, velocity_rad_s)
    share = -math.expm1(-sigma0_Nm_rad * abs(velocity_rad_s) / level_Nm * step_s)
    return z_rad + (settled_rad - z_rad) * share


@compiled
def warm(mechanics: np.void, joint: int, temperature_C: float, power_W: float, step_s: float) -> float:
    """Return the lubricant's temperature, °C, after a step of constant friction power.

    It decays with the time constant `cooling_s` toward ambient plus the power's steady rise. A heat capacity of 0 keeps
    it.
    """
    capacity_J_K = mechanics["heat_capacity_J_K"][joint]
    if capacity_J_K == 0.0:
        return temperature_C
    cooling_s = mechanics["cooling_s"][joint]
    settled_C = mechanics["ambient_C"][joint] + power_W * cooling_s / capacity_J_K
    return float(temperature_C - (settled_C - temperature_C) * math.expm1(-step_s / cooling_s))


@compiled
def spring_torque(mechanics: np.void, joint: int, twist_rad: float, twist_rad_s: float) -> float:
    """Return the torque τ_s in an elastic joint's spring with its damper, Nm.

    With backlash it is 0 within the dead zone, and beyond it a flank only pushes. Without backlash it is linear. twist:
    motor side minus link side.
    """
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
    """Return the torque ripple that adds to the motor torque, Nm: a sine of the motor side's angle q_m, `shaft_rad`.

    Its amplitude is `ripple_Nm` plus `ripple_share` of |motor_Nm|.
    """
    amplitude = mechanics["ripple_Nm"][joint] + mechanics["ripple_share"][joint] * abs(motor_Nm)
    if amplitude == 0.0:
        return 0.0
    return float(
        amplitude * math.sin(mechanics["ripple_periods"][joint] * shaft_rad + mechanics["ripple_phase_rad"][joint])
    )


Slips = tuple[int, int, int, int]
"""Of both links, then of both motors."""

ROW: Final = float_fields({"q": PAIR, "dq": PAIR, "q_m": PAIR, "dq_m": PAIR, "bristle_rad": PAIR, "tau_m": PAIR})
"""The integrated state, or its rates: link side, motor side, bristles, motor torque. The touch state is beside it."""

FORCES: Final = float_fields(
    {
        "viscous_drift": PAIR,  # factors of friction at this temperature
        "coulomb_drift": PAIR,
        "link_Nm": PAIR,  # on the link side, with the bristles' friction, without dry and viscous friction
        "motor_Nm": PAIR,  # on the motor side of an elastic joint, with viscous friction, without dry friction
        "motor_level_Nm": PAIR,  # dry friction there
        "joint_Nm": PAIR,  # through the sensor; of a stiff joint before motor friction and rotor
        "external_Nm": PAIR,
        "held_Nm": PAIR,  # gravity torque, positive where it must be held along +q
        "bristles_Nm": PAIR,  # LuGre's σ₀ z + σ₁ ż
        "bristle_level_Nm": PAIR,  # g of a joint with bristles
        "viscous_Nm_s": PAIR,  # friction of the link side as it is at this instant
        "coulomb_Nm": PAIR,
    }
)
"""Forces and friction of one instant."""


class Surroundings(NamedTuple):
    """Everything that acts on the arm in a tick.

    state, arm, mechanics: elements of MECHANICAL_STATE, ARM_NUMBERS and MECHANICS_NUMBERS. contact: one row of the
    contact table, or an empty array. things: the table of bodies, hands and walls.
    """

    state: np.void
    arm: np.void
    mechanics: np.void
    contact: Structured
    things: Structured


@compiled
def gravity_torque(state: np.void, arm: np.void, mechanics: np.void, q1: float, q2: float) -> tuple[float, float]:
    """Return the gravity torque of joints 1 and 2, Nm, positive where it must be held along +q; 0 on a level base."""
    gravity = mechanics["gravity_m_s2"]
    if gravity == 0.0:
        return 0.0, 0.0
    length1_m = arm["link_length_m"][0]
    downhill1 = mechanics["downhill_rad"] - q1
    downhill2 = downhill1 - q2
    moment1 = arm["moment_kg_m"] + state["payload_kg"] * length1_m
    along2 = state["beta"] / length1_m
    beside2 = state["sigma"] / length1_m
    exerted2 = gravity * (along2 * math.sin(downhill2) - beside2 * math.cos(downhill2))
    return -(gravity * moment1 * math.sin(downhill1) + exerted2), -exerted2


@compiled
def set_drift(state: np.void, mechanics: np.void, forces: np.void) -> None:
    """Set `viscous_drift` and `coulomb_drift` of `forces`: the factors of friction at the joints' temperatures."""
    for joint in range(2):
        temperature_C = state["temperature_C"][joint]
        forces["viscous_drift"][joint] = drift_factor(mechanics["viscous_drop_per_K"][joint], temperature_C)
        forces["coulomb_drift"][joint] = drift_factor(mechanics["coulomb_drop_per_K"][joint], temperature_C)


@compiled
def collect_forces(
    around: Surroundings,
    now: np.void,
    touch_state: Vector,
    touch_rates: Vector,
    time_s: float,
    elapsed_s: float,
    forces: np.void,
) -> None:
    """Fill `forces` except its two drifts, and `touch_rates` if bodies, hands or walls exist.

    Of a stiff joint `motor_Nm` stays, of a joint without bristles `bristle_level_Nm`. Call `set_drift` first: the
    friction levels use its factors. now: integrated state, an element of ROW. time_s: scenario time. elapsed_s: time
    since the contact's onset.
    """
    state, arm, mechanics = around.state, around.arm, around.mechanics
    q1, q2, dq1, dq2 = now["q"][0], now["q"][1], now["dq"][0], now["dq"][1]
    ext1, ext2 = external_torque(arm, around.contact, elapsed_s, q1, q2, dq1, dq2)
    touch1, touch2 = 0.0, 0.0
    if around.things.size != 0:
        touch1, touch2 = touch(around.things, time_s, q1, q2, dq1, dq2, touch_state, touch_rates)
    held1, held2 = gravity_torque(state, arm, mechanics, q1, q2)
    forces["external_Nm"][0] = ext1 + touch1
    forces["external_Nm"][1] = ext2 + touch2
    forces["held_Nm"][0], forces["held_Nm"][1] = held1, held2
    for joint in range(2):
        velocity = now["dq"][joint]
        tau = now["tau_m"][joint]
        motor = tau + ripple_torque(mechanics, joint, now["q_m"][joint], tau)
        viscous = arm["viscous_Nm_s"][joint] * forces["viscous_drift"][joint]
        motor_viscous = mechanics["motor_viscous_Nm_s"][joint] * forces["viscous_drift"][joint]
        motor_level = mechanics["motor_coulomb_Nm"][joint] * forces["coulomb_drift"][joint] + state["brake_Nm"][joint]
        is_elastic = mechanics["stiffness_Nm_rad"][joint] != 0.0
        through = motor
        if is_elastic:
            twist = now["q_m"][joint] - now["q"][joint]
            through = spring_torque(mechanics, joint, twist, now["dq_m"][joint] - velocity)
            forces["motor_Nm"][joint] = motor - through - motor_viscous * now["dq_m"][joint]
        level = dry_level(mechanics, joint, arm["coulomb_Nm"][joint], velocity, through, forces["coulomb_drift"][joint])
        bristles = 0.0
        sigma0 = mechanics["sigma0_Nm_rad"][joint]
        if sigma0 != 0.0:
            z = now["bristle_rad"][joint]
            bristles = sigma0 * z + mechanics["sigma1_Nm_s"][joint] * bristle_rate(sigma0, z, velocity, level)
            forces["bristle_level_Nm"][joint] = level
            viscous = mechanics["sigma2_Nm_s"][joint] * forces["viscous_drift"][joint]
            level = 0.0
        if not is_elastic:
            viscous += motor_viscous
            level += motor_level
        forces["motor_level_Nm"][joint] = motor_level
        forces["joint_Nm"][joint] = through
        forces["bristles_Nm"][joint] = bristles
        forces["link_Nm"][joint] = through + forces["external_Nm"][joint] - forces["held_Nm"][joint] - bristles
        forces["viscous_Nm_s"][joint] = viscous
        forces["coulomb_Nm"][joint] = level


@compiled
def is_free(joint: int, state: np.void, mechanics: np.void) -> bool:
    """Return whether a link never sticks: no dry friction acts on it, nor the closed brake of a stiff joint."""
    is_braked = mechanics["stiffness_Nm_rad"][joint] == 0.0 and state["brake_Nm"][joint] != 0.0
    return bool(mechanics["is_free"][joint] != 0.0 and not is_braked)


@compiled
def decide(now: np.void, around: Surroundings, forces: np.void) -> Slips:
    """Return the slips of both links, then of both motors, by the present forces: 1 or -1, or 0 if it sticks.

    The sign is the direction of the slip. A link or motor that never sticks has 1. now: element of ROW;
    forces: of FORCES.
    """
    state, mechanics = around.state, around.mechanics
    slip1, slip2 = decide_slips(
        state, forces, forces["link_Nm"][0], forces["link_Nm"][1], now["q"][1], now["dq"][0], now["dq"][1]
    )
    if is_free(0, state, mechanics):
        slip1 = 1
    if is_free(1, state, mechanics):
        slip2 = 1
    return slip1, slip2, _motor_slip(0, now, mechanics, forces), _motor_slip(1, now, mechanics, forces)


@compiled
def _motor_slip(joint: int, now: np.void, mechanics: np.void, forces: np.void) -> int:
    """Return the slip of one motor: 1 or -1 by its velocity, at standstill by its torque, 0 if it sticks.

    It is 1 for a stiff joint, and for a motor side without dry friction or closed brake.
    """
    if mechanics["stiffness_Nm_rad"][joint] == 0.0 or forces["motor_level_Nm"][joint] == 0.0:
        return 1
    velocity = now["dq_m"][joint]
    if velocity != 0.0:
        return 1 if velocity > 0.0 else -1
    torque = forces["motor_Nm"][joint]
    if abs(torque) <= forces["motor_level_Nm"][joint]:
        return 0
    return 1 if torque > 0.0 else -1


@compiled
def accelerate_links(
    now: np.void, around: Surroundings, slips: Slips, forces: np.void
) -> tuple[float, float, float, float]:
    """Return ddq of joints 1 and 2, rad/s², and their dry friction, Nm, positive along +dq, for these slips.

    The friction of a sticking link is the torque that holds it. now: element of ROW; forces: of FORCES, for `now`.
    """
    link_Nm = forces["link_Nm"]
    return accelerate(
        around.state, forces, slips[0], slips[1], link_Nm[0], link_Nm[1], now["q"][1], now["dq"][0], now["dq"][1]
    )


@compiled
def find_friction(
    now: np.void, around: Surroundings, forces: np.void
) -> tuple[float, float, float, float, float, float]:
    """Return ddq, rad/s², then friction on the link side of the sensor, then on its motor side, Nm along +dq.

    Each is for joints 1 and 2. On the motor side it is 0 for an elastic joint. now: element of ROW; forces: of FORCES.
    """
    mechanics = around.mechanics
    ddq1, ddq2, dry1, dry2 = accelerate_links(now, around, decide(now, around, forces), forces)
    motor1, motor2 = 0.0, 0.0
    if mechanics["stiffness_Nm_rad"][0] == 0.0:
        motor1 = _motor_share(0, dry1, now, mechanics, forces)
    if mechanics["stiffness_Nm_rad"][1] == 0.0:
        motor2 = _motor_share(1, dry2, now, mechanics, forces)
    friction1 = dry1 + forces["viscous_Nm_s"][0] * now["dq"][0] + forces["bristles_Nm"][0] - motor1
    friction2 = dry2 + forces["viscous_Nm_s"][1] * now["dq"][1] + forces["bristles_Nm"][1] - motor2
    return ddq1, ddq2, friction1, friction2, motor1, motor2


@compiled
def _motor_share(joint: int, dry_Nm: float, now: np.void, mechanics: np.void, forces: np.void) -> float:
    """Return the friction on the motor side of a stiff joint, Nm: viscous, plus its share of the dry friction.

    dry_Nm: dry friction of the whole joint; both sides share it in the ratio of their levels.
    """
    viscous = mechanics["motor_viscous_Nm_s"][joint] * forces["viscous_drift"][joint] * now["dq"][joint]
    if forces["coulomb_Nm"][joint] == 0.0:
        return float(viscous)
    return float(viscous + dry_Nm * forces["motor_level_Nm"][joint] / forces["coulomb_Nm"][joint])
