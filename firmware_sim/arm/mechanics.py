"""The arm in motion: RK4 in substeps of the 100 µs tick. A rigid arm is one whose other properties are 0.

Link side, with the mass matrix and centrifugal terms of `firmware_sim.arm.plant`:

    M(q) q̈ + centrifugal = τ_J + τ_ext − τ_gravity − friction          friction: `firmware_sim.arm.joint_forces`

An elastic joint has τ_J = τ_s and a motor side of its own (`firmware_sim.arm.joint_forces`). A stiff joint turns
with its rotor: M gets the rotor's inertia R, motor-side friction adds to the joint's, and the sensor sees
τ_J = τ_m + ripple − R q̈ − motor-side friction. While a stiff joint sticks, motor-side and joint friction share the load
in the ratio of their levels; rigid bodies leave it open.

Gravity on a base tilted by ϑ, downhill along the direction δ of the base's plane, with g' = g sin ϑ and the first
moments μ₁, μ₂ along the links and ν beside link 2 (kg m), in absolute link angles:

    torque that gravity exerts:   G₁ = g' μ₁ sin(δ − φ₁)      G₂ = g' (μ₂ sin(δ − φ₂) − ν cos(δ − φ₂))

so τ_gravity = −(G₁ + G₂, G₂).

Dry friction truly holds: up to four slips (two links, two motors) are constant within a step, and the step is cut at
the instant where a velocity passes zero or a holding torque passes its level, as in `firmware_sim.arm.plant`. Bristles
advance exactly for the mean velocity of each stage, which is stable at any speed. Temperatures change once per tick.
A holding brake is Coulomb friction on the motor side while the drive is off.

Substeps per tick: as many as the fastest eigenfrequency of the linearised arm asks for, see
`MechanicsSettings.substeps`.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from adacd_hil.structured import Structured
from firmware_sim.arm.joint_forces import (
    FORCES,
    ROW,
    Slips,
    Surroundings,
    accelerate_links,
    advance_bristle,
    collect_forces,
    decide,
    find_friction,
    is_free,
    set_drift,
    warm,
)
from firmware_sim.arm.plant import CURRENT_LOOP_RAD_S, follow_target

# Rows of the work space; only the touch state has the last one.
_START: Final = 0
_STAGE: Final = 1
_END: Final = 2
_K1: Final = 3
_K2: Final = 4
_K3: Final = 5
_K4: Final = 6
_TOUCH_RATES: Final = 7
_ROWS: Final = 8
_INTEGRATED: Final = 8
"""Places of q, dq, q_m and dq_m in ROW, which Runge-Kutta advances."""
_ROWS_END: Final = _ROWS * ROW.itemsize // 8
_FORCES_END: Final = _ROWS_END + FORCES.itemsize // 8

_LARGEST_CUTS: Final = 16
"""Cuts of a substep. Four slips can each stop and break away once or twice; a slip lasts much longer than a substep."""
_BISECTIONS: Final = 40
"""Bisections that find the instant of a cut: 100 µs · 2⁻⁴⁰ is below the resolution of time within a step."""


class _StepWork(NamedTuple):
    """Views of the work space: rows (_ROWS,) of ROW, rows of the touch state (_ROWS, n), one element of FORCES.

    values (_ROWS, number of ROW's values): the same memory as `rows`.
    """

    rows: Structured
    values: NDArray[np.float64]
    touch: NDArray[np.float64]
    forces: np.void


def work_space(touch_size: int) -> Vector:
    """Return the memory (k,) that integration and `observe` overwrite, zeros; touch_size: values of the touch state."""
    return np.zeros(_FORCES_END + _ROWS * touch_size)


@compiled
def _matrix(space: Vector) -> NDArray[np.float64]:
    """Return an array as a matrix with _ROWS rows that shares its memory."""
    return space.reshape((_ROWS, space.size // _ROWS))


@compiled
def _collect(row: int, around: Surroundings, time_s: float, elapsed_s: float, work: _StepWork) -> None:
    """Fill the work space's forces and touch rates for the state in row number `row`, as `collect_forces` does."""
    collect_forces(around, work.rows[row], work.touch[row], work.touch[_TOUCH_RATES], time_s, elapsed_s, work.forces)


@compiled
def _fill_rates(row: int, rates: int, around: Surroundings, slips: Slips, work: _StepWork) -> None:
    """Fill row number `rates` of the work space with the derivative of the state in row number `row`.

    Needs the forces and touch rates of the same state in the work space. Leaves the rates of bristles and motor torques
    out.
    """
    now, rate, forces, mechanics = work.rows[row], work.rows[rates], work.forces, around.mechanics
    ddq1, ddq2, _, _ = accelerate_links(now, around, slips, forces)
    rate["dq"][0], rate["dq"][1] = ddq1, ddq2
    for joint in range(2):
        motor_slip = slips[2 + joint]
        rate["q"][joint] = now["dq"][joint]
        if mechanics["stiffness_Nm_rad"][joint] == 0.0:
            rate["q_m"][joint] = rate["q"][joint]
            rate["dq_m"][joint] = rate["dq"][joint]
        else:
            rate["q_m"][joint] = now["dq_m"][joint]
            rate["dq_m"][joint] = 0.0
            if motor_slip != 0:
                net = forces["motor_Nm"][joint]
                net -= forces["motor_level_Nm"][joint] * motor_slip
                rate["dq_m"][joint] = net / mechanics["rotor_inertia_kg_m2"][joint]
    for index in range(work.touch.shape[1]):
        work.touch[rates, index] = work.touch[_TOUCH_RATES, index]


@compiled
def _set_stage(rates: int, length_s: float, mechanics: np.void, work: _StepWork) -> None:
    """Fill the row `_STAGE` with the start row plus `length_s` times the rates in row number `rates`.

    The bristles of LuGre friction advance by the mean velocity over `length_s`. The motor torques of the row stay.
    """
    values = work.values
    for place in range(_INTEGRATED):
        values[_STAGE, place] = values[_START, place] + length_s * values[rates, place]
    for index in range(work.touch.shape[1]):
        work.touch[_STAGE, index] = work.touch[_START, index] + length_s * work.touch[rates, index]
    _set_bristles(_STAGE, length_s, mechanics, work)


@compiled
def _set_bristles(row: int, length_s: float, mechanics: np.void, work: _StepWork) -> None:
    """Set the bristle deflections of row number `row` by the mean velocity since the start row, `length_s` before.

    Joints without bristles stay as they are, and all do if `length_s` is 0. Needs `bristle_level_Nm` in the work
    space's forces.
    """
    start, now = work.rows[_START], work.rows[row]
    for joint in range(2):
        sigma0 = mechanics["sigma0_Nm_rad"][joint]
        if sigma0 != 0.0 and length_s > 0.0:
            velocity = (now["q"][joint] - start["q"][joint]) / length_s
            now["bristle_rad"][joint] = advance_bristle(
                sigma0, start["bristle_rad"][joint], velocity, work.forces["bristle_level_Nm"][joint], length_s
            )


@compiled
def _combine(values: NDArray[np.float64], count: int, sixth_s: float) -> None:
    """Fill the first `count` values of the end row by RK4's weighted sum; sixth_s: a sixth of the step's length."""
    for place in range(count):
        inner = values[_K2, place] + values[_K3, place]
        values[_END, place] = values[_START, place] + sixth_s * (values[_K1, place] + 2.0 * inner + values[_K4, place])


@compiled
def _runge_kutta(
    around: Surroundings,
    time_s: float,
    elapsed_s: float,
    slips: Slips,
    target1: float,
    target2: float,
    step_s: float,
    work: _StepWork,
) -> None:
    """Fill the end row by one step of classical RK4 from the start row with constant slips.

    Needs the start's rates in the row _K1; overwrites the other rates, `_STAGE` and the forces. target: set-points of
    the torque loops, Nm.
    """
    touch, mechanics = work.touch, around.mechanics
    start, stage, end = work.rows[_START], work.rows[_STAGE], work.rows[_END]
    half_s = 0.5 * step_s
    mid1, end1 = follow_target(start["tau_m"][0], target1, CURRENT_LOOP_RAD_S * step_s)
    mid2, end2 = follow_target(start["tau_m"][1], target2, CURRENT_LOOP_RAD_S * step_s)
    stage["tau_m"][0], stage["tau_m"][1] = mid1, mid2
    for rates in (_K2, _K3, _K4):
        length_s = half_s
        if rates == _K4:
            length_s = step_s
            stage["tau_m"][0], stage["tau_m"][1] = end1, end2
        _set_stage(rates - 1, length_s, mechanics, work)
        _collect(_STAGE, around, time_s + length_s, elapsed_s + length_s, work)
        _fill_rates(_STAGE, rates, around, slips, work)
    sixth_s = step_s / 6.0
    _combine(work.values, _INTEGRATED, sixth_s)
    _combine(touch, touch.shape[1], sixth_s)
    _set_bristles(_END, step_s, mechanics, work)
    end["tau_m"][0], end["tau_m"][1] = end1, end2


@compiled
def _margin(around: Surroundings, slips: Slips, work: _StepWork) -> float:
    """Return by how much the slips still fit at the end row; negative: a link or motor has stopped or broken away.

    It is the smallest of all velocities along their slips, rad/s, and all reserves of holding torque, Nm; inf if no
    link or motor can stick. Needs the forces of the end row in the work space.
    """
    now, forces, mechanics = work.rows[_END], work.forces, around.mechanics
    margin = np.inf
    links = (0.0, 0.0, 0.0, 0.0)
    if slips[0] == 0 or slips[1] == 0:
        links = accelerate_links(now, around, slips, forces)
    for joint in range(2):
        slip = slips[joint]
        if not is_free(joint, around.state, mechanics):
            reserve_Nm = forces["coulomb_Nm"][joint] - abs(links[2 + joint])
            margin = min(margin, now["dq"][joint] * slip if slip != 0 else reserve_Nm)
        if mechanics["stiffness_Nm_rad"][joint] != 0.0 and forces["motor_level_Nm"][joint] != 0.0:
            slip = slips[2 + joint]
            if slip != 0:
                margin = min(margin, now["dq_m"][joint] * slip)
            else:
                margin = min(margin, forces["motor_level_Nm"][joint] - abs(forces["motor_Nm"][joint]))
    return margin


@compiled
def _take_end(around: Surroundings, slips: Slips, work: _StepWork) -> None:
    """Copy the end row to the start row.

    The velocity of a link or motor that can stick is set to 0 if it sticks or has passed zero. The motor side of a
    stiff joint gets position and velocity of its link side.
    """
    work.rows[_START] = work.rows[_END]
    for index in range(work.touch.shape[1]):
        work.touch[_START, index] = work.touch[_END, index]
    start, mechanics = work.rows[_START], around.mechanics
    for joint in range(2):
        if not is_free(joint, around.state, mechanics) and not start["dq"][joint] * slips[joint] > 0.0:
            start["dq"][joint] = 0.0
        if mechanics["stiffness_Nm_rad"][joint] == 0.0:
            start["q_m"][joint] = start["q"][joint]
            start["dq_m"][joint] = start["dq"][joint]
        elif work.forces["motor_level_Nm"][joint] != 0.0 and not start["dq_m"][joint] * slips[2 + joint] > 0.0:
            start["dq_m"][joint] = 0.0


@compiled
def _step(
    around: Surroundings,
    time_s: float,
    elapsed_s: float,
    target1: float,
    target2: float,
    step_s: float,
    work: _StepWork,
) -> None:
    """Advance the start row by `step_s`, in parts that end where a link or motor stops or breaks away.

    After `_LARGEST_CUTS` - 1 such parts the last part is the whole rest. Needs the forces of the start row in the work
    space, and leaves those of the new start there.
    """
    left_s = step_s
    for cut in range(_LARGEST_CUTS):
        slips = decide(work.rows[_START], around, work.forces)
        _fill_rates(_START, _K1, around, slips, work)
        advanced_s = left_s
        _runge_kutta(around, time_s, elapsed_s, slips, target1, target2, left_s, work)
        _collect(_END, around, time_s + left_s, elapsed_s + left_s, work)
        margin = _margin(around, slips, work)
        if margin >= 0.0:
            _take_end(around, slips, work)
            return
        if cut < _LARGEST_CUTS - 1:
            fits_s = 0.0
            for _ in range(_BISECTIONS):
                middle_s = 0.5 * (fits_s + advanced_s)
                _runge_kutta(around, time_s, elapsed_s, slips, target1, target2, middle_s, work)
                _collect(_END, around, time_s + middle_s, elapsed_s + middle_s, work)
                if _margin(around, slips, work) < 0.0:
                    advanced_s = middle_s
                else:
                    fits_s = middle_s
            _runge_kutta(around, time_s, elapsed_s, slips, target1, target2, advanced_s, work)
        _take_end(around, slips, work)
        time_s += advanced_s
        elapsed_s += advanced_s
        left_s -= advanced_s
        _collect(_START, around, time_s, elapsed_s, work)
        if left_s <= 0.0:
            return


@compiled
def _load(around: Surroundings, touch_state: Vector, work: _StepWork) -> None:
    """Fill the start row of the work space from the mechanical state and the touch state.

    Set the friction factors of temperature in the work space's forces, and `rotor_kg_m2` in the mechanical state.
    """
    start, state, mechanics = work.rows[_START], around.state, around.mechanics
    for joint in range(2):
        start["q"][joint] = state["q"][joint]
        start["dq"][joint] = state["dq"][joint]
        is_elastic = mechanics["stiffness_Nm_rad"][joint] != 0.0
        start["q_m"][joint] = state["q_m"][joint] if is_elastic else state["q"][joint]
        start["dq_m"][joint] = state["dq_m"][joint] if is_elastic else state["dq"][joint]
        start["bristle_rad"][joint] = state["bristle_rad"][joint]
        start["tau_m"][joint] = state["tau_m"][joint]
        state["rotor_kg_m2"][joint] = 0.0 if is_elastic else mechanics["rotor_inertia_kg_m2"][joint]
    for index in range(touch_state.size):
        work.touch[_START, index] = touch_state[index]
    set_drift(state, mechanics, work.forces)


@compiled
def integrate_mechanics(
    around: Surroundings,
    touch_state: Vector,
    time_s: float,
    elapsed_s: float,
    target1: float,
    target2: float,
    step_s: float,
    substeps: int,
    space: Vector,
) -> None:
    """Advance the mechanical state and the touch state by `step_s` in `substeps` substeps, in place.

    Temperatures change once, at the end. touch_state: of bodies, hands and walls, for
    `firmware_sim.arm.touch_forces.touch`. time_s: scenario time, negative before the scenario starts. elapsed_s: since
    the contact's onset. target: set-points of the drives' torque loops, Nm. space: from `work_space`, overwritten.
    """
    state, mechanics = around.state, around.mechanics
    rows, forces = space[:_ROWS_END], space[_ROWS_END:_FORCES_END].view(FORCES)[0]
    work = _StepWork(rows.view(ROW), _matrix(rows), _matrix(space[_FORCES_END:]), forces)
    _load(around, touch_state, work)
    substep_s = step_s / substeps
    _collect(_START, around, time_s, elapsed_s, work)
    for index in range(substeps):
        done_s = index * substep_s
        _step(around, time_s + done_s, elapsed_s + done_s, target1, target2, substep_s, work)
    if mechanics["heat_capacity_J_K"][0] != 0.0 or mechanics["heat_capacity_J_K"][1] != 0.0:
        _warm(around, step_s, work)
    start = work.rows[_START]
    for joint in range(2):
        state["q"][joint] = start["q"][joint]
        state["dq"][joint] = start["dq"][joint]
        state["q_m"][joint] = start["q_m"][joint]
        state["dq_m"][joint] = start["dq_m"][joint]
        state["bristle_rad"][joint] = start["bristle_rad"][joint]
        state["tau_m"][joint] = start["tau_m"][joint]
        is_on_link = mechanics["is_encoder_on_link"][joint] != 0.0
        state["q_encoder"][joint] = start["q"][joint] if is_on_link else start["q_m"][joint]
    for index in range(touch_state.size):
        touch_state[index] = work.touch[_START, index]
    _set_joint_torque(around, work)


@compiled
def _has_stiff_motor(joint: int, mechanics: np.void, forces: np.void) -> bool:
    """Return whether a joint is stiff and its motor side has inertia or friction, which the sensor does not measure."""
    has_friction = mechanics["motor_viscous_Nm_s"][joint] != 0.0 or forces["motor_level_Nm"][joint] != 0.0
    is_stiff = mechanics["stiffness_Nm_rad"][joint] == 0.0
    return bool(is_stiff and (has_friction or mechanics["rotor_inertia_kg_m2"][joint] != 0.0))


@compiled
def _set_joint_torque(around: Surroundings, work: _StepWork) -> None:
    """Set `tau_J` of the mechanical state, the torque through the sensors, from the forces of the start row."""
    state, mechanics, forces = around.state, around.mechanics, work.forces
    state["tau_J"][0], state["tau_J"][1] = forces["joint_Nm"][0], forces["joint_Nm"][1]
    if not (_has_stiff_motor(0, mechanics, forces) or _has_stiff_motor(1, mechanics, forces)):
        return
    ddq1, ddq2, _, _, motor1, motor2 = find_friction(work.rows[_START], around, forces)
    if mechanics["stiffness_Nm_rad"][0] == 0.0:
        state["tau_J"][0] -= motor1 + mechanics["rotor_inertia_kg_m2"][0] * ddq1
    if mechanics["stiffness_Nm_rad"][1] == 0.0:
        state["tau_J"][1] -= motor2 + mechanics["rotor_inertia_kg_m2"][1] * ddq2


@compiled
def _warm(around: Surroundings, step_s: float, work: _StepWork) -> None:
    """Set the joints' temperatures after `step_s` of the friction power at the start row.

    Friction on the motor side counts, too. A joint with heat capacity 0 keeps its temperature.
    """
    now, state, mechanics, forces = work.rows[_START], around.state, around.mechanics, work.forces
    _, _, friction1, friction2, motor1, motor2 = find_friction(now, around, forces)
    for joint in range(2):
        friction, motor = (friction1, motor1) if joint == 0 else (friction2, motor2)
        if mechanics["stiffness_Nm_rad"][joint] != 0.0:
            velocity = now["dq_m"][joint]
            motor = mechanics["motor_viscous_Nm_s"][joint] * forces["viscous_drift"][joint] * velocity
            if velocity != 0.0:
                motor += math.copysign(forces["motor_level_Nm"][joint], velocity)
        power_W = friction * now["dq"][joint] + motor * now["dq_m"][joint]
        state["temperature_C"][joint] = warm(mechanics, joint, state["temperature_C"][joint], power_W, step_s)


@compiled
def observe(
    around: Surroundings, touch_state: Vector, time_s: float, elapsed_s: float, space: Vector
) -> tuple[float, float, float, float, float, float]:
    """Return the present true values, Nm: external torque, friction along +dq, gravity torque, two joints each.

    The friction is on the link side of the sensor; the external torque includes joint stops. Position, velocity and
    touch state stay; `rotor_kg_m2` of the state is set, `space` is overwritten. Arguments are as of
    `integrate_mechanics`.
    """
    rows, forces = space[:_ROWS_END], space[_ROWS_END:_FORCES_END].view(FORCES)[0]
    work = _StepWork(rows.view(ROW), _matrix(rows), _matrix(space[_FORCES_END:]), forces)
    _load(around, touch_state, work)
    _collect(_START, around, time_s, elapsed_s, work)
    _, _, friction1, friction2, _, _ = find_friction(work.rows[_START], around, work.forces)
    external_Nm, held_Nm = work.forces["external_Nm"], work.forces["held_Nm"]
    return external_Nm[0], external_Nm[1], friction1, friction2, held_Nm[0], held_Nm[1]
