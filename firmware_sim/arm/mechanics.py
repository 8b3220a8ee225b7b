"""The arm with everything that the rigid plant leaves out, in motion: RK4 in substeps of the 100 µs tick.

Link side, with the mass matrix and centrifugal terms of `firmware_sim.arm.plant`:

    M(q) q̈ + centrifugal = τ_J + τ_ext − τ_gravity − friction          friction: `firmware_sim.arm.joint_mechanics`

An elastic joint has τ_J = τ_s and a motor side of its own (`firmware_sim.arm.joint_mechanics`). A stiff joint turns
with its rotor: M gets the rotor's inertia R, motor-side friction adds to the joint's, and what the sensor sees follows:
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
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from firmware_sim.arm.joint_mechanics import (
    CAPACITY,
    COULOMB_DROP,
    ENCODER_ON_LINK,
    FREE,
    MOTOR_COULOMB,
    MOTOR_VISCOUS,
    ROTOR_INERTIA,
    SIGMA0,
    SIGMA1,
    SIGMA2,
    STIFFNESS,
    TRANSMISSION_NUMBERS,
    VISCOUS_DROP,
    advance_bristle,
    bristle_rate,
    drift_factor,
    dry_level,
    ripple_torque,
    spring_torque,
    warm,
)
from firmware_sim.arm.plant import (
    ARM_NUMBERS,
    BRAKE,
    BRISTLE,
    COULOMB,
    CURRENT_LOOP,
    DQ,
    DSHAFT,
    ENCODED,
    INERTIA,
    JOINT_TORQUE,
    LENGTH,
    MOMENT,
    PAYLOAD,
    ROTOR,
    SHAFT,
    SKEW,
    TAU,
    VISCOUS,
    WARMTH,
    Q,
    accelerate,
    decide_slips,
    external_torque,
    follow_target,
)
from firmware_sim.arm.touch_forces import touch

STANDARD_GRAVITY_M_S2: Final = 9.80665
"""Standard gravity, CGPM 1901."""

# Places in the vector that stands for the mechanics, after those of friction and transmission.
GRAVITY: Final = TRANSMISSION_NUMBERS  # g', m/s²
DOWNHILL: Final = TRANSMISSION_NUMBERS + 1  # δ, rad
HOLDING_BRAKE: Final = TRANSMISSION_NUMBERS + 2  # 2: Nm, motor side, while the drive is off
MECHANICS_NUMBERS: Final = TRANSMISSION_NUMBERS + 4

# Places in the integrated vector: link side, motor side, bristles, motor torque, two joints each.
_Q: Final = 0
_DQ: Final = 2
_SHAFT: Final = 4
_DSHAFT: Final = 6
_BRISTLE: Final = 8
_TAU: Final = 10

# Rows of the work space: where each row of the integrated vector begins. Their contacts' parts follow after all rows.
_ROW: Final = 12
_START: Final = 0
_STAGE: Final = _ROW
_END: Final = 2 * _ROW
_K1: Final = 3 * _ROW
_K2: Final = 4 * _ROW
_K3: Final = 5 * _ROW
_K4: Final = 6 * _ROW
_TOUCH_RATES: Final = 7 * _ROW
_ALL_ROWS: Final = 8 * _ROW

# Places in the work space, after the rows: forces, two joints each, Nm but for the factors.
_VISCOUS_DRIFT: Final = _ALL_ROWS + 0
_COULOMB_DRIFT: Final = _ALL_ROWS + 2
_LINK: Final = _ALL_ROWS + 4  # on the link side, less dry and viscous friction
_MOTOR: Final = _ALL_ROWS + 6  # on the motor side of an elastic joint, less dry friction
_MOTOR_LEVEL: Final = _ALL_ROWS + 8
_JOINT: Final = _ALL_ROWS + 10  # through the sensor; of a stiff joint before motor friction and rotor
_EXTERNAL: Final = _ALL_ROWS + 12
_HELD: Final = _ALL_ROWS + 14  # gravity torque, positive where it must be held along +q
_BRISTLES: Final = _ALL_ROWS + 16  # LuGre's σ₀ z + σ₁ ż
_BRISTLE_LEVEL: Final = _ALL_ROWS + 18  # g of a joint with bristles
_LEVELS: Final = _ALL_ROWS + 20  # the arm's numbers, with viscous and dry friction as they are at this instant
_TOUCH: Final = _LEVELS + ARM_NUMBERS  # eight rows of the contacts' state

_LARGEST_CUTS: Final = 16
"""Cuts of a substep. Four slips can each stop and break away once or twice; a slip lasts much longer than a substep."""
_SMALLEST_CUT_S: Final = 1e-13
"""How closely a cut is found: accelerations of 1e4 rad/s² make 1e-9 rad/s of it."""


def work_space(touch_size: int) -> Vector:
    """Allocate what a step works in, for a contact state of `touch_size` values."""
    return np.zeros(_TOUCH + 8 * touch_size)


@compiled
def _touch_size(work: Vector) -> int:
    """Say how many values the contact state has."""
    return (work.size - _TOUCH) // 8


@compiled
def _touch_row(row: int, work: Vector) -> int:
    """Give the place at which the contacts' part of a row begins."""
    return _TOUCH + row // _ROW * _touch_size(work)


@compiled
def gravity_torque(state: Vector, arm: Vector, mechanics: Vector, q1: float, q2: float) -> tuple[float, float]:
    """Give tau_gravity of both joints in Nm, positive where it must be held along +q."""
    gravity = mechanics[GRAVITY]
    if gravity == 0.0:
        return 0.0, 0.0
    length1_m = arm[LENGTH]
    downhill1 = mechanics[DOWNHILL] - q1
    downhill2 = downhill1 - q2
    moment1 = arm[MOMENT] + state[PAYLOAD] * length1_m
    along2 = state[INERTIA + 1] / length1_m
    beside2 = state[SKEW] / length1_m
    exerted2 = gravity * (along2 * math.sin(downhill2) - beside2 * math.cos(downhill2))
    return -(gravity * moment1 * math.sin(downhill1) + exerted2), -exerted2


@compiled
def _drift(mechanics: Vector, state: Vector, work: Vector) -> None:
    """Take the temperatures' factors of friction into the work space."""
    for joint in range(2):
        work[_VISCOUS_DRIFT + joint] = drift_factor(mechanics[VISCOUS_DROP + joint], state[WARMTH + joint])
        work[_COULOMB_DRIFT + joint] = drift_factor(mechanics[COULOMB_DROP + joint], state[WARMTH + joint])


@compiled
def _collect(
    row: int,
    state: Vector,
    arm: Vector,
    mechanics: Vector,
    contact: Vector,
    touch_numbers: NDArray[np.float64],
    time_s: float,
    elapsed_s: float,
    work: Vector,
    levels: Vector,
) -> None:
    """Fill forces, friction levels and touch rates for the integrated vector in `row`."""
    q1, q2, dq1, dq2 = work[row + _Q], work[row + _Q + 1], work[row + _DQ], work[row + _DQ + 1]
    ext1, ext2 = external_torque(arm, contact, elapsed_s, q1, q2, dq1, dq2)
    touch1, touch2 = 0.0, 0.0
    if touch_numbers.size != 0:
        size = _touch_size(work)
        first, rates = _touch_row(row, work), _touch_row(_TOUCH_RATES, work)
        touch1, touch2 = touch(
            touch_numbers, time_s, q1, q2, dq1, dq2, work[first : first + size], work[rates : rates + size]
        )
    held1, held2 = gravity_torque(state, arm, mechanics, q1, q2)
    work[_EXTERNAL] = ext1 + touch1
    work[_EXTERNAL + 1] = ext2 + touch2
    work[_HELD], work[_HELD + 1] = held1, held2
    for joint in range(2):
        velocity = work[row + _DQ + joint]
        tau = work[row + _TAU + joint]
        motor = tau + ripple_torque(mechanics, joint, work[row + _SHAFT + joint], tau)
        viscous = arm[VISCOUS + joint] * work[_VISCOUS_DRIFT + joint]
        motor_viscous = mechanics[MOTOR_VISCOUS + joint] * work[_VISCOUS_DRIFT + joint]
        motor_level = mechanics[MOTOR_COULOMB + joint] * work[_COULOMB_DRIFT + joint] + state[BRAKE + joint]
        is_elastic = mechanics[STIFFNESS + joint] != 0.0
        through = motor
        if is_elastic:
            twist = work[row + _SHAFT + joint] - work[row + _Q + joint]
            through = spring_torque(mechanics, joint, twist, work[row + _DSHAFT + joint] - velocity)
            work[_MOTOR + joint] = motor - through - motor_viscous * work[row + _DSHAFT + joint]
        level = dry_level(mechanics, joint, arm[COULOMB + joint], velocity, through, work[_COULOMB_DRIFT + joint])
        bristles = 0.0
        sigma0 = mechanics[SIGMA0 + joint]
        if sigma0 != 0.0:
            z = work[row + _BRISTLE + joint]
            bristles = sigma0 * z + mechanics[SIGMA1 + joint] * bristle_rate(sigma0, z, velocity, level)
            work[_BRISTLE_LEVEL + joint] = level
            viscous = mechanics[SIGMA2 + joint] * work[_VISCOUS_DRIFT + joint]
            level = 0.0
        if not is_elastic:
            viscous += motor_viscous
            level += motor_level
        work[_MOTOR_LEVEL + joint] = motor_level
        work[_JOINT + joint] = through
        work[_BRISTLES + joint] = bristles
        work[_LINK + joint] = through + work[_EXTERNAL + joint] - work[_HELD + joint] - bristles
        levels[VISCOUS + joint] = viscous
        levels[COULOMB + joint] = level


@compiled
def _is_free(joint: int, state: Vector, mechanics: Vector) -> bool:
    """Say whether nothing dry acts on a link, so that it never sticks."""
    is_braked = mechanics[STIFFNESS + joint] == 0.0 and state[BRAKE + joint] != 0.0
    return bool(mechanics[FREE + joint] != 0.0 and not is_braked)


@compiled
def _decide(row: int, state: Vector, mechanics: Vector, work: Vector, levels: Vector) -> tuple[int, int, int, int]:
    """Decide the slips of both links and both motors from the forces in the work space."""
    slip1, slip2 = decide_slips(
        state, levels, work[_LINK], work[_LINK + 1], work[row + _Q + 1], work[row + _DQ], work[row + _DQ + 1]
    )
    if _is_free(0, state, mechanics):
        slip1 = 1
    if _is_free(1, state, mechanics):
        slip2 = 1
    return slip1, slip2, _motor_slip(0, row, mechanics, work), _motor_slip(1, row, mechanics, work)


@compiled
def _motor_slip(joint: int, row: int, mechanics: Vector, work: Vector) -> int:
    """Decide the slip of one motor; only an elastic joint with motor-side Coulomb friction has one."""
    if mechanics[STIFFNESS + joint] == 0.0 or work[_MOTOR_LEVEL + joint] == 0.0:
        return 1
    velocity = work[row + _DSHAFT + joint]
    if velocity != 0.0:
        return 1 if velocity > 0.0 else -1
    torque = work[_MOTOR + joint]
    if abs(torque) <= work[_MOTOR_LEVEL + joint]:
        return 0
    return 1 if torque > 0.0 else -1


@compiled
def _fill_rates(
    row: int,
    rates: int,
    state: Vector,
    mechanics: Vector,
    slips: tuple[int, int, int, int],
    work: Vector,
    levels: Vector,
) -> None:
    """Fill the row `rates` with the derivative of the integrated vector in `row`.

    Forces of the same instant are in the work space. Bristles and motor torques go their own way.
    """
    ddq1, ddq2, _, _ = accelerate(
        state,
        levels,
        slips[0],
        slips[1],
        work[_LINK],
        work[_LINK + 1],
        work[row + _Q + 1],
        work[row + _DQ],
        work[row + _DQ + 1],
    )
    work[rates + _Q], work[rates + _Q + 1], work[rates + _DQ], work[rates + _DQ + 1] = (
        work[row + _DQ],
        work[row + _DQ + 1],
        ddq1,
        ddq2,
    )
    for joint in range(2):
        motor_slip = slips[2] if joint == 0 else slips[3]
        if mechanics[STIFFNESS + joint] == 0.0:
            work[rates + _SHAFT + joint] = work[rates + _Q + joint]
            work[rates + _DSHAFT + joint] = work[rates + _DQ + joint]
        else:
            work[rates + _SHAFT + joint] = work[row + _DSHAFT + joint]
            work[rates + _DSHAFT + joint] = 0.0
            if motor_slip != 0:
                net = work[_MOTOR + joint]
                net -= work[_MOTOR_LEVEL + joint] * motor_slip
                work[rates + _DSHAFT + joint] = net / mechanics[ROTOR_INERTIA + joint]
    size = _touch_size(work)
    if size != 0:
        first, now = _touch_row(rates, work), _touch_row(_TOUCH_RATES, work)
        for index in range(size):
            work[first + index] = work[now + index]


@compiled
def _set_stage(row: int, rates: int, length_s: float, mechanics: Vector, work: Vector) -> None:
    """Fill `row` with the start plus `length_s` times the rates; bristles advance by the rates' velocity.

    The level of the bristles is the one of the same velocity.
    """
    for index in range(_BRISTLE):
        work[row + index] = work[_START + index] + length_s * work[rates + index]
    size = _touch_size(work)
    if size != 0:
        start, stage, rate = _touch_row(_START, work), _touch_row(row, work), _touch_row(rates, work)
        for index in range(size):
            work[stage + index] = work[start + index] + length_s * work[rate + index]
    _set_bristles(row, length_s, mechanics, work)


@compiled
def _set_bristles(row: int, length_s: float, mechanics: Vector, work: Vector) -> None:
    """Advance the bristles to `row` by the mean velocity between start and `row`."""
    for joint in range(2):
        sigma0 = mechanics[SIGMA0 + joint]
        if sigma0 != 0.0 and length_s > 0.0:
            velocity = (work[row + _Q + joint] - work[_START + _Q + joint]) / length_s
            work[row + _BRISTLE + joint] = advance_bristle(
                sigma0, work[_START + _BRISTLE + joint], velocity, work[_BRISTLE_LEVEL + joint], length_s
            )


@compiled
def _combine(start: int, end: int, rate: int, stride: int, sixth_s: float, work: Vector) -> None:
    """Fill the place `end` from the place `start` and four rates that lie `stride` apart."""
    inner = work[rate + stride] + work[rate + 2 * stride]
    work[end] = work[start] + sixth_s * (work[rate] + 2.0 * inner + work[rate + 3 * stride])


@compiled
def _runge_kutta(
    state: Vector,
    arm: Vector,
    mechanics: Vector,
    contact: Vector,
    touch_numbers: NDArray[np.float64],
    time_s: float,
    elapsed_s: float,
    slips: tuple[int, int, int, int],
    target1: float,
    target2: float,
    step_s: float,
    work: Vector,
    levels: Vector,
) -> None:
    """Fill the end row: one step of classical RK4 with constant slips. The first rates stand in the work space."""
    half_s = 0.5 * step_s
    mid1, end1 = follow_target(work[_START + _TAU], target1, arm[CURRENT_LOOP] * step_s)
    mid2, end2 = follow_target(work[_START + _TAU + 1], target2, arm[CURRENT_LOOP + 1] * step_s)
    work[_STAGE + _TAU], work[_STAGE + _TAU + 1] = mid1, mid2
    for rates in (_K2, _K3, _K4):
        length_s = half_s
        if rates == _K4:
            length_s = step_s
            work[_STAGE + _TAU], work[_STAGE + _TAU + 1] = end1, end2
        _set_stage(_STAGE, rates - _ROW, length_s, mechanics, work)
        _collect(
            _STAGE, state, arm, mechanics, contact, touch_numbers,
            time_s + length_s, elapsed_s + length_s, work, levels,
        )  # fmt: skip
        _fill_rates(_STAGE, rates, state, mechanics, slips, work, levels)
    sixth_s = step_s / 6.0
    for index in range(_BRISTLE):
        _combine(_START + index, _END + index, _K1 + index, _ROW, sixth_s, work)
    size = _touch_size(work)
    for index in range(size):
        _combine(index + _TOUCH, index + _touch_row(_END, work), index + _touch_row(_K1, work), size, sixth_s, work)
    _set_bristles(_END, step_s, mechanics, work)
    work[_END + _TAU], work[_END + _TAU + 1] = end1, end2


@compiled
def _margin(state: Vector, mechanics: Vector, slips: tuple[int, int, int, int], work: Vector, levels: Vector) -> float:
    """Say how well the slips still fit at the end row: negative when a joint ought to have stopped or broken away."""
    row = _END
    margin = np.inf
    friction1, friction2 = 0.0, 0.0
    if slips[0] == 0 or slips[1] == 0:
        _, _, friction1, friction2 = accelerate(
            state,
            levels,
            slips[0],
            slips[1],
            work[_LINK],
            work[_LINK + 1],
            work[row + _Q + 1],
            work[row + _DQ],
            work[row + _DQ + 1],
        )
    if not _is_free(0, state, mechanics):
        margin = min(margin, work[row + _DQ] * slips[0] if slips[0] != 0 else levels[COULOMB] - abs(friction1))
    if not _is_free(1, state, mechanics):
        margin = min(margin, work[row + _DQ + 1] * slips[1] if slips[1] != 0 else levels[COULOMB + 1] - abs(friction2))
    for joint in range(2):
        if mechanics[STIFFNESS + joint] != 0.0 and work[_MOTOR_LEVEL + joint] != 0.0:
            slip = slips[2] if joint == 0 else slips[3]
            if slip != 0:
                margin = min(margin, work[row + _DSHAFT + joint] * slip)
            else:
                margin = min(margin, work[_MOTOR_LEVEL + joint] - abs(work[_MOTOR + joint]))
    return margin


@compiled
def _take_end(state: Vector, mechanics: Vector, slips: tuple[int, int, int, int], work: Vector) -> None:
    """Make the end row the start; a velocity that has passed zero is zero."""
    for index in range(_ROW):
        work[_START + index] = work[_END + index]
    size = _touch_size(work)
    if size != 0:
        start, end = _touch_row(_START, work), _touch_row(_END, work)
        for index in range(size):
            work[start + index] = work[end + index]
    for joint in range(2):
        slip = slips[0] if joint == 0 else slips[1]
        if not _is_free(joint, state, mechanics) and not work[_START + _DQ + joint] * slip > 0.0:
            work[_START + _DQ + joint] = 0.0
        if mechanics[STIFFNESS + joint] == 0.0:
            work[_START + _SHAFT + joint] = work[_START + _Q + joint]
            work[_START + _DSHAFT + joint] = work[_START + _DQ + joint]
        elif work[_MOTOR_LEVEL + joint] != 0.0:
            motor_slip = slips[2] if joint == 0 else slips[3]
            if not work[_START + _DSHAFT + joint] * motor_slip > 0.0:
                work[_START + _DSHAFT + joint] = 0.0


@compiled
def _step(
    state: Vector,
    arm: Vector,
    mechanics: Vector,
    contact: Vector,
    touch_numbers: NDArray[np.float64],
    time_s: float,
    elapsed_s: float,
    target1: float,
    target2: float,
    step_s: float,
    work: Vector,
    levels: Vector,
) -> None:
    """Advance the start row by a substep, cutting it where a slip changes.

    Its forces stand in the work space, and those of the new start do afterwards.
    """
    left_s = step_s
    for cut in range(_LARGEST_CUTS):
        slips = _decide(_START, state, mechanics, work, levels)
        _fill_rates(_START, _K1, state, mechanics, slips, work, levels)
        advanced_s = left_s
        _runge_kutta(
            state,
            arm,
            mechanics,
            contact,
            touch_numbers,
            time_s,
            elapsed_s,
            slips,
            target1,
            target2,
            left_s,
            work,
            levels,
        )
        _collect(_END, state, arm, mechanics, contact, touch_numbers, time_s + left_s, elapsed_s + left_s, work, levels)
        margin = _margin(state, mechanics, slips, work, levels)
        if margin >= 0.0:
            _take_end(state, mechanics, slips, work)
            return
        if cut < _LARGEST_CUTS - 1:
            fits_s = 0.0
            while advanced_s - fits_s > _SMALLEST_CUT_S:
                middle_s = 0.5 * (fits_s + advanced_s)
                _runge_kutta(
                    state, arm, mechanics, contact, touch_numbers,
                    time_s, elapsed_s, slips, target1, target2, middle_s, work, levels,
                )  # fmt: skip
                _collect(
                    _END, state, arm, mechanics, contact, touch_numbers,
                    time_s + middle_s, elapsed_s + middle_s, work, levels,
                )  # fmt: skip
                if _margin(state, mechanics, slips, work, levels) < 0.0:
                    advanced_s = middle_s
                else:
                    fits_s = middle_s
            _runge_kutta(
                state, arm, mechanics, contact, touch_numbers,
                time_s, elapsed_s, slips, target1, target2, advanced_s, work, levels,
            )  # fmt: skip
        _take_end(state, mechanics, slips, work)
        time_s += advanced_s
        elapsed_s += advanced_s
        left_s -= advanced_s
        _collect(_START, state, arm, mechanics, contact, touch_numbers, time_s, elapsed_s, work, levels)
        if left_s <= 0.0:
            return


@compiled
def _friction(
    row: int, state: Vector, mechanics: Vector, work: Vector, levels: Vector
) -> tuple[float, float, float, float, float, float]:
    """Give ddq, friction of the joint and of a stiff joint's motor side, two each, from the forces of `row`."""
    slip1, slip2, _, _ = _decide(row, state, mechanics, work, levels)
    ddq1, ddq2, dry1, dry2 = accelerate(
        state,
        levels,
        slip1,
        slip2,
        work[_LINK],
        work[_LINK + 1],
        work[row + _Q + 1],
        work[row + _DQ],
        work[row + _DQ + 1],
    )
    motor1, motor2 = 0.0, 0.0
    if mechanics[STIFFNESS] == 0.0:
        motor1 = _motor_share(0, dry1, row, mechanics, work, levels)
    if mechanics[STIFFNESS + 1] == 0.0:
        motor2 = _motor_share(1, dry2, row, mechanics, work, levels)
    friction1 = dry1 + levels[VISCOUS] * work[row + _DQ] + work[_BRISTLES] - motor1
    friction2 = dry2 + levels[VISCOUS + 1] * work[row + _DQ + 1] + work[_BRISTLES + 1] - motor2
    return ddq1, ddq2, friction1, friction2, motor1, motor2


@compiled
def _motor_share(joint: int, dry_Nm: float, row: int, mechanics: Vector, work: Vector, levels: Vector) -> float:
    """Give the motor-side part of a stiff joint's friction, Nm."""
    viscous = mechanics[MOTOR_VISCOUS + joint] * work[_VISCOUS_DRIFT + joint] * work[row + _DQ + joint]
    if levels[COULOMB + joint] == 0.0:
        return float(viscous)
    return float(viscous + dry_Nm * work[_MOTOR_LEVEL + joint] / levels[COULOMB + joint])


@compiled
def _load(state: Vector, mechanics: Vector, touch_state: Vector, work: Vector) -> None:
    """Take the mechanical state into the start row."""
    for joint in range(2):
        work[_START + _Q + joint] = state[Q + joint]
        work[_START + _DQ + joint] = state[DQ + joint]
        is_elastic = mechanics[STIFFNESS + joint] != 0.0
        work[_START + _SHAFT + joint] = state[SHAFT + joint] if is_elastic else state[Q + joint]
        work[_START + _DSHAFT + joint] = state[DSHAFT + joint] if is_elastic else state[DQ + joint]
        work[_START + _BRISTLE + joint] = state[BRISTLE + joint]
        work[_START + _TAU + joint] = state[TAU + joint]
        state[ROTOR + joint] = 0.0 if is_elastic else mechanics[ROTOR_INERTIA + joint]
    first = _touch_row(_START, work)
    for index in range(touch_state.size):
        work[first + index] = touch_state[index]
    _drift(mechanics, state, work)


@compiled
def integrate_mechanics(
    state: Vector,
    arm: Vector,
    mechanics: Vector,
    contact: Vector,
    touch_numbers: NDArray[np.float64],
    touch_state: Vector,
    time_s: float,
    elapsed_s: float,
    target1: float,
    target2: float,
    step_s: float,
    substeps: int,
    work: Vector,
) -> None:
    """Advance the mechanical state and the contacts' state by `step_s` in `substeps` substeps.

    contact: row of the contact table, or empty; elapsed_s: since its onset. touch_numbers, touch_state: what
    `firmware_sim.arm.touch_forces.touch` knows of bodies, hands and walls, and their state; time_s: scenario time,
    negative before the scenario starts. target: what the drives' torque loops are asked for, Nm. work: from
    `work_space`.
    """
    levels = work[_LEVELS:_TOUCH]
    _load(state, mechanics, touch_state, work)
    substep_s = step_s / substeps
    _collect(_START, state, arm, mechanics, contact, touch_numbers, time_s, elapsed_s, work, levels)
    for index in range(substeps):
        done_s = index * substep_s
        _step(
            state, arm, mechanics, contact, touch_numbers,
            time_s + done_s, elapsed_s + done_s, target1, target2, substep_s, work, levels,
        )  # fmt: skip
    if mechanics[CAPACITY] != 0.0 or mechanics[CAPACITY + 1] != 0.0:
        _warm(state, mechanics, step_s, work, levels)
    for joint in range(2):
        state[Q + joint] = work[_START + _Q + joint]
        state[DQ + joint] = work[_START + _DQ + joint]
        state[SHAFT + joint] = work[_START + _SHAFT + joint]
        state[DSHAFT + joint] = work[_START + _DSHAFT + joint]
        state[BRISTLE + joint] = work[_START + _BRISTLE + joint]
        state[TAU + joint] = work[_START + _TAU + joint]
        is_on_link = mechanics[ENCODER_ON_LINK + joint] != 0.0
        state[ENCODED + joint] = work[_START + _Q + joint] if is_on_link else work[_START + _SHAFT + joint]
    first = _touch_row(_START, work)
    for index in range(touch_state.size):
        touch_state[index] = work[first + index]
    _set_joint_torque(state, mechanics, work, levels)


@compiled
def _set_joint_torque(state: Vector, mechanics: Vector, work: Vector, levels: Vector) -> None:
    """Set the torque through the sensors from the forces of the start row."""
    state[JOINT_TORQUE], state[JOINT_TORQUE + 1] = work[_JOINT], work[_JOINT + 1]
    if mechanics[STIFFNESS] != 0.0 and mechanics[STIFFNESS + 1] != 0.0:
        return
    ddq1, ddq2, _, _, motor1, motor2 = _friction(_START, state, mechanics, work, levels)
    if mechanics[STIFFNESS] == 0.0:
        state[JOINT_TORQUE] -= motor1 + mechanics[ROTOR_INERTIA] * ddq1
    if mechanics[STIFFNESS + 1] == 0.0:
        state[JOINT_TORQUE + 1] -= motor2 + mechanics[ROTOR_INERTIA + 1] * ddq2


@compiled
def _warm(state: Vector, mechanics: Vector, step_s: float, work: Vector, levels: Vector) -> None:
    """Warm the joints by the power of their friction, motor side included."""
    row = _START
    _, _, friction1, friction2, motor1, motor2 = _friction(_START, state, mechanics, work, levels)
    for joint in range(2):
        friction, motor = (friction1, motor1) if joint == 0 else (friction2, motor2)
        if mechanics[STIFFNESS + joint] != 0.0:
            velocity = work[row + _DSHAFT + joint]
            motor = mechanics[MOTOR_VISCOUS + joint] * work[_VISCOUS_DRIFT + joint] * velocity
            if velocity != 0.0:
                motor += math.copysign(work[_MOTOR_LEVEL + joint], velocity)
        power_W = friction * work[row + _DQ + joint] + motor * work[row + _DSHAFT + joint]
        state[WARMTH + joint] = warm(mechanics, joint, state[WARMTH + joint], power_W, step_s)


@compiled
def observe(
    state: Vector,
    arm: Vector,
    mechanics: Vector,
    contact: Vector,
    touch_numbers: NDArray[np.float64],
    touch_state: Vector,
    time_s: float,
    elapsed_s: float,
    work: Vector,
) -> tuple[float, float, float, float, float, float]:
    """Give what is true now, Nm: external torque, friction along +dq, gravity torque, two joints each.

    Changes nothing that goes on.
    """
    levels = work[_LEVELS:_TOUCH]
    _load(state, mechanics, touch_state, work)
    _collect(_START, state, arm, mechanics, contact, touch_numbers, time_s, elapsed_s, work, levels)
    _, _, friction1, friction2, _, _ = _friction(_START, state, mechanics, work, levels)
    return work[_EXTERNAL], work[_EXTERNAL + 1], friction1, friction2, work[_HELD], work[_HELD + 1]
