"""The computation of one cycle of the paper's scheme: filters, predictions, estimator, evidence, contact.

Constants, memory and block: as in `kernel_samples`; the block is `records.scheme_layout`.

A cycle without a fresh sample leaves filters and estimate as they were. Up to `MOST_FILLED` missing samples are
interpolated on a straight line between their neighbours, so that a lost frame causes no blind time. A longer gap, a
value that is not a number, or an interval far from the nominal one makes a gap; the filters resume from it as described
in `torque_filter`. The step's result has the bit UNSEEN unless the filters took the sample in.

The measured interval enters the quantities that integrate: filters, estimator, information, impulse. It does not enter
the quantities that count. T of eq. (15) is counted in cycles, whose grid keeps its phase, so it is right to a period.
`undone_filter.undo_filter` needs only the ends of the mean of five derivatives, and the five periods between them.

**Beside.** Beside the certified scheme it takes the same samples by the same step (`step_beside`): it adapts until eq.
(15) holds with enough excitation and motion, then compares with its thresholds. Its results are in the block of the
scheme in charge.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, CertifiedBlock, SchemeBlock, Vector, block_sizes
from adacd_hil.scheme.detect import external_torque, undone_filter
from adacd_hil.scheme.identify import estimator, excitation, termination
from adacd_hil.scheme.kernel.kernel_samples import (
    Numbers,
    is_filled,
    keep_sample,
    limits_of,
    observe,
    put_between,
    put_sample,
)
from adacd_hil.scheme.memory import Limits, Motion, Sample
from adacd_hil.scheme.model import regressor, torque_filter
from adacd_hil.scheme.supervisor.findings import ADAPTED, ANY_CONTACT, CONTACT_SHIFT, NOT_A_NUMBER, OVER_LIMIT, UNSEEN
from adacd_hil.settings.configuration import Settings
from adacd_hil.structured import Columns, PerJoint, PerParameter, Square, Structured, packed, zeros_of

# Tasks of a cycle, as bits: the estimator learns; thresholds are in force; a collision's report is not final yet.
LEARN = 1
ARMED = 2
REPORTING = 4


MOST_FILLED = 4
"""Largest number of missing samples that are interpolated: with one more the model is blind by default. Over 5 ms the
line is within 2.1e-5 Nm s of a torque of 2 Nm at 5 Hz."""


class PaperMemory:
    """The memory of the paper's scheme. mode: LEARN, then ARMED, of a step beside another scheme.

    motion: evidence of the excitation. quiet_cycles: cycles in a row within beta, eq. (15). standstill: see
    `external_torque`; integral, peak, wide_history: see `undone_filter`. last, between: q, dq, tau_J of the sample
    before, and of an interpolated one.
    """

    has_gap: float
    mode: float
    Y_p: Columns
    Y_h: Columns
    input_old: Columns
    S: Columns
    W_f: Columns
    tau_old: PerJoint
    last: Annotated[Vector, "3 n"]
    between: Annotated[Vector, "3 n"]
    v: PerParameter
    K: PerParameter
    P: Square
    motion: Motion
    quiet_cycles: float
    standstill: PerJoint
    integral: PerJoint
    peak: PerJoint
    wide_history: Annotated[Vector, "wide n"]


@dataclass(frozen=True)
class PaperConstants:
    """The constants of the paper's scheme: the filter b / (s + a) of eq. (3), and the settings."""

    period_s: float
    level_rad: float
    a_rad_s: float
    b_rad_s: float
    dc_gain: float
    decay: float
    weight_old: float
    weight_new: float
    is_least_squares: float
    P0: Vector
    theta_cad: Vector
    beta_Nm: float
    hold_cycles: float
    travel_rad: float
    velocity_rad_s: float
    excitation_Nm2s: float
    scale: Vector
    threshold_Nm: Vector
    standstill_rad_s: float
    limits: Limits


def constants_of(settings: Settings) -> Structured:
    """Return the settings of the paper's compiled step, converted to cycles, coefficients and vectors.

    As a structured array (1,) with the fields of `PaperConstants`.
    """
    count = len(settings.estimator.parameter_names)
    period_s = settings.bus.period_s
    hold = torque_filter.first_order_hold(settings.filter.a_rad_s, settings.filter.b_rad_s, period_s)
    inertia, viscous, coulomb, gravity = settings.termination.excitation_scale
    scale = (inertia,) * 3 + (viscous,) * 2 + (coulomb,) * 2 + (gravity,) * 2
    return packed(
        PaperConstants(
            period_s=period_s,
            level_rad=settings.level_rad,
            a_rad_s=settings.filter.a_rad_s,
            b_rad_s=settings.filter.b_rad_s,
            dc_gain=settings.filter.b_rad_s / settings.filter.a_rad_s,
            decay=hold.decay,
            weight_old=hold.weight_old,
            weight_new=hold.weight_new,
            is_least_squares=float(settings.estimator.law == "least_squares"),
            P0=np.array(settings.estimator.P0),
            theta_cad=settings.cad_theta if settings.arm.cad_theta else np.zeros(count),
            beta_Nm=settings.termination.beta_Nm,
            hold_cycles=round(settings.termination.hold_s / period_s),
            travel_rad=np.radians(settings.termination.travel_deg),
            velocity_rad_s=np.radians(settings.termination.velocity_deg_s),
            excitation_Nm2s=settings.termination.excitation_Nm2s,
            scale=np.array(scale[:count]),
            threshold_Nm=np.array(settings.detector.threshold_Nm),
            standstill_rad_s=settings.detector.standstill_rad_s,
            limits=limits_of(settings),
        )
    )


def new_memory(parameter_count: int) -> Structured:
    """Return the memory (1,) before the first sample: a gap, all else 0; P, too, until `begin_adaptation`.

    parameter_count: p.
    """
    memory = zeros_of(PaperMemory, {"n": JOINTS, "p": parameter_count, "wide": undone_filter.WIDE_SAMPLES + 1})
    m: PaperMemory = memory[0]
    m.has_gap = 1.0
    return memory


def new_block(parameter_count: int) -> Structured:
    """Return the values that a cycle fills and logs (1,), before the first sample: zeros, infinite thresholds."""
    block = zeros_of(SchemeBlock, block_sizes(parameter_count))
    block["threshold"] = np.inf
    return block


def numbers_of(settings: Settings) -> Numbers:
    """Return new constants, memory and block of the kernel for one run, as they are before the first sample."""
    count = len(settings.estimator.parameter_names)
    block = new_block(count)
    return Numbers(constants_of(settings), new_memory(count), block, block.view(np.float64))


@compiled
def begin_adaptation(constants: Structured, memory: Structured, block: Structured) -> None:
    """Reset filtered torque and regressor, P and evidence to begin an adaptation of an arm at rest; keep theta_hat.

    The filters resume at the next sample. A step beside the certified scheme learns again, see `step_beside`. Filters
    that started with the old payload would mix the old theta into the new one for about 4 / a.
    """
    c, m, out = constants[0], memory[0], block[0]
    m.has_gap = 1.0
    m.W_f[:] = 0.0
    out.tau_f[:] = 0.0
    undone_filter.forget(m.wide_history)
    m.mode = LEARN  # used by a step beside; in charge, the mode follows from the state
    m.P[:] = np.diag(c.P0)
    excitation.begin(m.motion)
    m.quiet_cycles = 0.0
    out.quiet_s = 0.0
    out.excitation = 0.0


@compiled
def step(constants: Structured, memory: Structured, block: Structured, is_complete: int, steps: int, mode: int) -> int:
    """Process the block's q, dq, tau_J and fill its other fields; return bits of an observation (`findings`).

    The caller sets q, dq, tau_J and period_s (0: `steps` nominal periods). is_complete: 1 for a fresh sample; else
    filters and estimate stay. A fresh sample with a value that isn't finite makes a gap. steps: periods since the fresh
    sample before it. mode: LEARN, ARMED, REPORTING; without ARMED the thresholds are inf, and the contact's impulse and
    peak torque 0.
    """
    c, m, out = constants[0], memory[0], block[0]
    period_s = c.period_s
    observation = observe(c.limits, c.period_s, block, steps, OVER_LIMIT)
    is_fresh = is_complete != 0 and observation & NOT_A_NUMBER == 0
    if is_fresh:
        is_seen, period_s = _filter(c, m, out, steps)
        if is_seen:
            observation &= ~UNSEEN
        if mode & LEARN:
            observation |= _learn(c, m, out, period_s)
        if not (np.all(np.isfinite(out.tau_ext_hat)) and np.all(np.isfinite(out.theta_hat))):
            observation |= NOT_A_NUMBER
    elif is_complete != 0:
        m.has_gap = 1.0
    if mode & ARMED:
        return observation | _watch(c, m, out, period_s, is_fresh, mode & REPORTING != 0)
    out.threshold[:] = np.inf
    m.integral[:] = 0.0
    m.peak[:] = 0.0
    return observation


@compiled
def _filter(c: PaperConstants, m: PaperMemory, out: SchemeBlock, steps: int) -> tuple[bool, float]:
    """Advance the filters to this sample, and fill the torques by the estimate and by the CAD model.

    steps: periods since the fresh sample before. Return whether the filters took the sample in, False after a gap, and
    the time, s, that it covers: the measured interval, after a gap the nominal one.
    """
    a, b = c.a_rad_s, c.b_rad_s
    nominal_s: float = c.period_s
    period_s: float = out.period_s
    q, dq, tau_J = out.q[:], out.dq[:], out.tau_J[:]  # arrays like those of `between`: all is compiled once
    is_seen = m.has_gap == 0.0 and is_filled(steps, period_s, nominal_s, MOST_FILLED)
    if is_seen:
        step_s = period_s / steps
        hold = torque_filter.FirstOrderHold(c.decay, c.weight_old, c.weight_new)
        if step_s != nominal_s:
            hold = torque_filter.first_order_hold(a, b, step_s)
        for k in range(1, steps):
            put_between(m.last, out.q, out.dq, out.tau_J, k / steps, m.between)
            _advance(c, m, m.between[0], m.between[1], m.between[2], hold, out.tau_f)
            _compare(c, m, m.between[1], hold.decay, out)
        _advance(c, m, q, dq, tau_J, hold, out.tau_f)
        _compare(c, m, dq, hold.decay, out)
    else:
        period_s = nominal_s
        regressor.fill_momentum(q, dq, m.Y_p)
        regressor.fill_remainder(q, dq, c.level_rad, m.Y_h)
        torque_filter.resume(a, b, m.Y_p, m.Y_h, tau_J, m.input_old, m.tau_old, m.S, m.W_f)
        m.has_gap = 0.0
        _compare(c, m, dq, c.decay, out)
    keep_sample(out.q, out.dq, out.tau_J, m.last)
    return is_seen, period_s


@compiled
def _advance(
    c: PaperConstants,
    m: PaperMemory,
    q: Vector,
    dq: Vector,
    tau_J: Vector,
    hold: torque_filter.FirstOrderHold,
    tau_f: Vector,
) -> None:
    """Advance the filters of torque and regressor by one period to a sample; fill tau_f (2,), and W_f of `m`."""
    a, b = c.a_rad_s, c.b_rad_s
    regressor.fill_momentum(q, dq, m.Y_p)
    regressor.fill_remainder(q, dq, c.level_rad, m.Y_h)
    torque_filter.advance(hold, m.tau_old, tau_J, tau_f)
    torque_filter.advance_regressor(hold, a, b, m.Y_p, m.Y_h, m.input_old, m.S, m.W_f)


@compiled
def _compare(c: PaperConstants, m: PaperMemory, dq: Vector, decay: float, out: SchemeBlock) -> None:
    """Fill the torques predicted by the estimate and by the CAD model, and the external torques by these.

    Also tau_ext_wide_hat, that by the estimate with the filter undone. Update each joint's share of standstill first;
    decay: the share of its old value that stays.
    """
    external_torque.follow_standstill(dq, c.standstill_rad_s, decay, m.standstill)
    external_torque.predict(m.W_f, out.theta_hat, out.tau_f_hat)
    external_torque.predict(m.W_f, c.theta_cad, out.tau_f_cad)
    external_torque.estimate_external(out.tau_f, out.tau_f_hat, c.dc_gain, out.tau_ext_hat)
    external_torque.estimate_external(out.tau_f, out.tau_f_cad, c.dc_gain, out.tau_ext_hat_cad)
    undone_filter.undo_filter(out.tau_ext_hat, c.decay, m.wide_history, out.tau_ext_wide_hat)


@compiled
def _learn(c: PaperConstants, m: PaperMemory, out: SchemeBlock, period_s: float) -> int:
    """Test the estimate by eq. (15) on this sample, then correct it; return ADAPTED if the adaptation is over, or 0.

    It is if eq. (15) has held for `hold_cycles` in a row, with enough excitation and motion.
    """
    if excitation.gather(m.motion, out.q, out.dq, m.W_f, period_s):
        out.excitation = excitation.eigenvalue_range(m.motion.information, c.scale, m.motion.scratch)[0]
    m.quiet_cycles = m.quiet_cycles + 1.0 if termination.is_quiet(out.tau_ext_hat, c.beta_Nm) else 0.0
    out.quiet_s = m.quiet_cycles * c.period_s
    is_over = (
        m.quiet_cycles >= c.hold_cycles
        and out.excitation >= c.excitation_Nm2s
        and excitation.has_moved(m.motion, c.travel_rad, c.velocity_rad_s)
    )
    R = 1.0 / period_s
    estimator.update(m.W_f, out.tau_f, R, c.is_least_squares != 0.0, out.theta_hat, m.P, m.v, m.K)
    return ADAPTED if is_over else 0


@compiled
def _watch(
    c: PaperConstants, m: PaperMemory, out: SchemeBlock, period_s: float, is_fresh: bool, is_reporting: bool
) -> int:
    """Fill the thresholds and compare the torques with them; return bits of an observation, or 0 without a contact.

    The bits: CONTACT and COLLISION, which this scheme doesn't tell apart, and from CONTACT_SHIFT on one per joint.
    is_fresh: False adds nothing to the contact's impulse and peak. is_reporting: a report is due, so they don't begin
    anew.
    """
    F_c = out.theta_hat[regressor.F_C1 : regressor.F_C2 + 1]
    external_torque.fill_threshold(c.threshold_Nm, m.standstill, F_c, out.threshold)
    if is_fresh:
        undone_filter.follow_contact(
            out.tau_ext_hat,
            out.tau_ext_wide_hat,
            out.threshold,
            period_s,
            is_reporting,
            m.integral,
            m.peak,
        )
    joints = external_torque.joints_over(out.tau_ext_hat, out.threshold)
    return ANY_CONTACT | joints << CONTACT_SHIFT if joints else 0


@compiled
def step_beside(
    constants: Structured, memory: Structured, block: Structured, sample: Sample, period_s: float, main: CertifiedBlock
) -> None:
    """Process a sample in the paper's scheme while the certified scheme decides; write the results into `main`.

    main: the certified scheme's block. The paper's scheme learns from `begin_adaptation` until `_learn` returns
    ADAPTED, then its thresholds are in force.
    """
    m, own = memory[0], block[0]
    put_sample(block, sample, period_s)
    observation = step(constants, memory, block, sample.is_complete, sample.steps, int(m.mode))
    if observation & ADAPTED:
        m.mode = ARMED
    main.paper_is_armed = 1.0 if m.mode == ARMED else 0.0
    for i in range(JOINTS):
        main.paper_tau_ext_hat[i] = own.tau_ext_hat[i]
        main.paper_threshold[i] = own.threshold[i]
    for j in range(own.theta_hat.size):
        main.paper_theta_hat[j] = own.theta_hat[j]
