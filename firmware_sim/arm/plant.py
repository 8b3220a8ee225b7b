"""Accelerations of the two rigid links: Lagrange's equations in absolute link angles, friction that truly holds.

With φ₁ = q₁, φ₂ = q₁ + q₂ and the kinetic energy of `firmware_sim.arm.arms`, Lagrange gives

    α φ̈₁ + h φ̈₂ = T₁ − h' φ̇₂²        h  =  β cos q₂ − σ sin q₂
    γ φ̈₂ + h φ̈₁ = T₂ + h' φ̇₁²        h' = −β sin q₂ − σ cos q₂

only centrifugal terms, no Coriolis ones: ∂T/∂φ₁ = −h' φ̇₁ φ̇₂ takes with it the part of d(h φ̇₂)/dt that has φ̇₁. σ is
the payload's mass beside the axis of link 2 (`firmware_sim.arm.arms`), 0 for a payload on the axis. φ̇ = J q̇ with
J = [[1, 0], [1, 1]] brings them to the joints, where the motors, the friction and the sensors are:
(Jᵀ N J + R) q̈ = Jᵀ (...), with the inertia R of rotors that turn rigidly with their joints
(`firmware_sim.arm.mechanics`; 0 here). Torque of joint i, Nm, on the link side of its sensor:

    motor torque tau_J + external torque tau_ext − viscous friction F_v q̇ − Coulomb friction

Coulomb friction opposes motion with F_c while the joint slips and holds with up to F_c while it sticks. A joint's
`slip` is +1 or −1 while it moves and 0 while it sticks. Slips are constant within an integration step: when a
velocity passes zero or a holding torque passes F_c, the step is cut at that instant and the slips are decided anew.

A joint stop is a spring with damper that only pushes, on the link side; it counts as external torque, because it comes
from outside the link.

The motor torque follows its target with the first-order lag of the drive's current loop.
"""

import math
from typing import Final

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.structured import Structured, float_fields
from firmware_sim.arm.touch_settings import PAIR, contact_force, contact_torque

CURRENT_LOOP_HZ: Final = 1000.0
CURRENT_LOOP_RAD_S: Final = 2.0 * math.pi * CURRENT_LOOP_HZ
"""Bandwidth of the drive's torque loop; 1 kHz is usual for servo drives."""

ARM_NUMBERS: Final = float_fields(
    {
        "alpha": (),  # kg m², without payload, as β and γ
        "beta": (),
        "gamma": (),
        "link_length_m": PAIR,
        "viscous_Nm_s": PAIR,
        "coulomb_Nm": PAIR,
        "rated_torque_Nm": PAIR,
        "brake_damping_Nm_s": PAIR,
        "moment_kg_m": (),  # first moment of all masses about joint 1 with link 2 folded into joint 2; no payload
        "stop_low_rad": PAIR,
        "stop_high_rad": PAIR,
        "stop_stiffness_Nm_rad": PAIR,
        "stop_damping_Nm_s": PAIR,
    }
)
"""Filled in by `firmware_sim.arm.hardware_settings.MechanicsSettings.arm_numbers`. The table is here because compiled
code contains it, and the cache of compiled code is keyed by the modules that compile."""

MECHANICAL_STATE: Final = float_fields(
    {
        "q": PAIR,  # joint position, rad
        "dq": PAIR,  # joint velocity, rad/s
        "tau_m": PAIR,  # motor torque, Nm
        "payload_kg": (),  # part of the inertia below
        "alpha": (),  # kg m², with payload, as β and γ
        "beta": (),
        "gamma": (),
        "sigma": (),  # σ, kg m²
        "rotor_kg_m2": PAIR,  # inertia of rotors that turn rigidly with their joints, kg m²
        "q_m": PAIR,  # position of the motor side, rad; as q where the joint is stiff
        "dq_m": PAIR,  # its velocity, rad/s
        "tau_J": PAIR,  # torque through the sensor, Nm
        "q_encoder": PAIR,  # position of the shaft that carries the encoder, rad
        "bristle_rad": PAIR,  # deflection of LuGre's bristles, rad
        "temperature_C": PAIR,  # temperature of the joint's lubricant, °C
        "brake_Nm": PAIR,  # torque of the holding brake that is closed, Nm
    }
)
"""The arm in motion, as the integrators carry it on."""


@compiled
def fit_payload(
    state: np.void,
    arm: np.void,
    payload_kg: float,
    along_m: float = 0.0,
    beside_m: float = 0.0,
    inertia_kg_m2: float = 0.0,
) -> None:
    """Replace the payload in `state` by a body with its centre of mass at (along, beside) from the tip.

    Updates the inertia. along, beside: in the frame of link 2. inertia_kg_m2: about the payload's centre of mass.

    A mass that is added was at rest: it shares the momentum of the moving arm, M q̇ stays and q̇ changes. A mass that
    is taken off leaves with its speed: q̇ stays. At rest both change only the inertia.
    """
    added_kg = payload_kg - state["payload_kg"]
    m11, m12, m22 = mass_matrix(state, state["q"][1])
    momentum1 = m11 * state["dq"][0] + m12 * state["dq"][1]
    momentum2 = m12 * state["dq"][0] + m22 * state["dq"][1]
    length1_m, length2_m = arm["link_length_m"][0], arm["link_length_m"][1]
    state["payload_kg"] = payload_kg
    state["alpha"] = arm["alpha"] + payload_kg * length1_m * length1_m
    reach_m = length2_m + along_m
    state["beta"] = arm["beta"] + payload_kg * length1_m * reach_m
    state["gamma"] = arm["gamma"] + payload_kg * reach_m * reach_m
    state["gamma"] += payload_kg * beside_m * beside_m + inertia_kg_m2
    state["sigma"] = payload_kg * length1_m * beside_m
    if added_kg > 0.0 and (momentum1 != 0.0 or momentum2 != 0.0):
        m11, m12, m22 = mass_matrix(state, state["q"][1])
        determinant = m11 * m22 - m12 * m12
        state["dq"][0] = (m22 * momentum1 - m12 * momentum2) / determinant
        state["dq"][1] = (m11 * momentum2 - m12 * momentum1) / determinant


@compiled
def mass_matrix(state: np.void, q2: float) -> tuple[float, float, float]:
    """Return m11, m12, m22 of the mass matrix Jᵀ N J + R at the elbow angle q2, kg m²; with payload and rotors."""
    coupling = state["beta"] * math.cos(q2)
    if state["sigma"] != 0.0:
        coupling -= state["sigma"] * math.sin(q2)
    m22 = state["gamma"]
    return (
        state["alpha"] + m22 + 2.0 * coupling + state["rotor_kg_m2"][0],
        m22 + coupling,
        m22 + state["rotor_kg_m2"][1],
    )


@compiled
def accelerate(
    state: np.void,
    arm: np.void,
    slip1: int,
    slip2: int,
    torque1: float,
    torque2: float,
    q2: float,
    dq1: float,
    dq2: float,
) -> tuple[float, float, float, float]:
    """Return ddq1, ddq2 in rad/s² and the Coulomb friction of both joints in Nm, positive along +dq.

    state: has the inertia. arm: has the fields `viscous_Nm_s` and `coulomb_Nm`. torque: of motor, touches, joint stops
    and gravity, Nm. slip: 1 or -1, the direction in which a joint slips, or 0: it sticks. A sticking joint has no
    acceleration; its friction is the holding torque, even where that is more than F_c.
    """
    sine = state["beta"] * math.sin(q2)
    if state["sigma"] != 0.0:
        sine += state["sigma"] * math.cos(q2)
    m11, m12, m22 = mass_matrix(state, q2)
    rate2 = dq1 + dq2
    # Jᵀ of the centrifugal terms, less viscous friction
    centrifugal2 = -sine * dq1 * dq1
    drive1 = torque1 + sine * rate2 * rate2 + centrifugal2 - arm["viscous_Nm_s"][0] * dq1
    drive2 = torque2 + centrifugal2 - arm["viscous_Nm_s"][1] * dq2
    friction1 = arm["coulomb_Nm"][0] * slip1
    friction2 = arm["coulomb_Nm"][1] * slip2
    if slip1 != 0 and slip2 != 0:
        net1 = drive1 - friction1
        net2 = drive2 - friction2
        determinant = m11 * m22 - m12 * m12
        return (m22 * net1 - m12 * net2) / determinant, (m11 * net2 - m12 * net1) / determinant, friction1, friction2
    if slip1 != 0:
        ddq1 = (drive1 - friction1) / m11
        return ddq1, 0.0, friction1, drive2 - m12 * ddq1
    if slip2 != 0:
        ddq2 = (drive2 - friction2) / m22
        return 0.0, ddq2, drive1 - m12 * ddq2, friction2
    return 0.0, 0.0, drive1, drive2


@compiled
def decide_slips(
    state: np.void, arm: np.void, torque1: float, torque2: float, q2: float, dq1: float, dq2: float
) -> tuple[int, int]:
    """Return the slip of each joint: the sign of its velocity, or at standstill of its breakaway; 0 if it sticks.

    state, arm: as of `accelerate`. torque: all but friction, Nm. At standstill exactly one choice fits friction's
    law, because the inertia is positive definite: joints that stick need no more than F_c, joints that slip accelerate
    the way they slip. Within rounding of the limit no choice may fit; then the function returns the choice that fits
    best.
    """
    if dq1 != 0.0 and dq2 != 0.0:
        return (1 if dq1 > 0.0 else -1), (1 if dq2 > 0.0 else -1)
    best1, best2, best_violation = 0, 0, np.inf
    for choice1 in (0, 1, -1):
        if dq1 * choice1 < 0.0 or (dq1 != 0.0 and choice1 == 0):
            continue
        for choice2 in (0, 1, -1):
            if dq2 * choice2 < 0.0 or (dq2 != 0.0 and choice2 == 0):
                continue
            ddq1, ddq2, friction1, friction2 = accelerate(state, arm, choice1, choice2, torque1, torque2, q2, dq1, dq2)
            violation = 0.0
            if dq1 == 0.0:
                excess = -ddq1 * choice1 if choice1 != 0 else abs(friction1) - arm["coulomb_Nm"][0]
                violation = max(violation, excess)
            if dq2 == 0.0:
                excess = -ddq2 * choice2 if choice2 != 0 else abs(friction2) - arm["coulomb_Nm"][1]
                violation = max(violation, excess)
            if violation < best_violation:
                best1, best2, best_violation = choice1, choice2, violation
            if best_violation == 0.0:
                return best1, best2
    return best1, best2


@compiled
def _stop_torque(arm: np.void, joint: int, q: float, dq: float) -> float:
    """Return the torque, Nm, with which a stop pushes back a joint (0 or 1) that is beyond it; 0 between the stops.

    A stop never pulls: damping may lower the push to 0.
    """
    if q > arm["stop_high_rad"][joint]:
        push = (
            -arm["stop_stiffness_Nm_rad"][joint] * (q - arm["stop_high_rad"][joint])
            - arm["stop_damping_Nm_s"][joint] * dq
        )
        return float(min(0.0, push))
    if q < arm["stop_low_rad"][joint]:
        push = (
            -arm["stop_stiffness_Nm_rad"][joint] * (q - arm["stop_low_rad"][joint])
            - arm["stop_damping_Nm_s"][joint] * dq
        )
        return float(max(0.0, push))
    return 0.0


@compiled
def external_torque(
    arm: np.void, contact: Structured, elapsed_s: float, q1: float, q2: float, dq1: float, dq2: float
) -> tuple[float, float]:
    """Return the external torque on both joints, Nm: of joint stops, and of the contact if there is one.

    contact: one row of the contact table, or empty. elapsed_s: time since its onset.
    """
    stop1, stop2 = _stop_torque(arm, 0, q1, dq1), _stop_torque(arm, 1, q2, dq2)
    if contact.size == 0:
        return stop1, stop2
    ext1, ext2 = contact_torque(
        contact[0], contact_force(contact[0], elapsed_s), arm["link_length_m"][0], q1, q2, dq1, dq2
    )
    return ext1 + stop1, ext2 + stop2


@compiled
def follow_target(tau_Nm: float, target_Nm: float, turn: float) -> tuple[float, float]:
    """Return the motor torque in the middle and at the end of a step, Nm, for a lag of first order.

    turn: length of the step in time constants of the torque loop, above 0.

    The torque's distance from its target decays. In the middle of the step stands the value with which Simpson's rule
    gives the exact impulse; the torque at the midpoint itself would be wrong by 1e-7 rad/s after a step of 3 Nm.
    """
    fall = -math.expm1(-turn)
    middle = 0.25 * (6.0 * fall / turn - 2.0 + fall)
    return target_Nm + (tau_Nm - target_Nm) * middle, tau_Nm + (target_Nm - tau_Nm) * fall
