"""The computation of one cycle of the certified scheme: bank of filters, belief about the model, evidence, detection.

theta is a belief here (`belief`): mean and covariance P in true units. It starts at the prior of any arm of this kind
and is corrected by recursive least squares. P and a filter's regressor row give the uncertainty of a prediction, so
each threshold follows from the present knowledge (`sensitivity`). At the start of an adaptation P is large and no
contact can be detected; a fraction of a second later it can.

**A touch is not learnt.** Samples wait in a ring before they correct the belief. When a residual exceeds its threshold
the ring is emptied, so no sample of the touch, from its beginning on, is learnt. Earlier knowledge judges later
estimates (`earlier`), and independent knowledge judges the offsets (`anchor`).

**A certificate** is a test of the frozen model on motion that was not used for the fit (`termination`). While detection
is armed the belief goes on learning; its mean replaces the frozen model after a test (`refinement`).

Constants, memory and block: `certified_memory`.
"""

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import CertifiedBlock, Vector
from adacd_hil.scheme.detect import external_torque, lost_samples, sensitivity, sight, tail, undone_filter
from adacd_hil.scheme.identify import (
    anchor,
    belief,
    certificate,
    doubt,
    earlier,
    evidence,
    fit_check,
    missing_torque,
    refinement,
    termination,
)
from adacd_hil.scheme.kernel.kernel_samples import (
    is_filled,
    keep_sample,
    observe,
    put_between,
)
from adacd_hil.scheme.memory import Constants, Memory
from adacd_hil.scheme.model import filter_bank, regressor
from adacd_hil.scheme.supervisor.findings import (
    AT_REST,
    CERTIFIED,
    COLLISION,
    CONTACT,
    CONTACT_SHIFT,
    FITTED,
    NOT_A_NUMBER,
    OVER_SPEED,
    REFUTED,
    UNSEEN,
    WITHHELD,
)
from adacd_hil.structured import Structured

# Tasks of a cycle, as bits.
MEASURE = 1  # the arm is at rest: measure the torque sensors' noise and zero
WATCH = 2  # compare the residuals with their thresholds
LEARN = 4  # correct the belief and use it at once
TEST = 8  # test the frozen model
REFINE = 16  # correct the belief; its mean replaces the model after a test
WEIGH = 32  # weigh the evidence for each cause of a contact of the certified model


@compiled
def begin_adaptation(constants: Structured, memory: Structured, is_payload: bool, is_first: bool) -> None:
    """Reset belief, filters, fit and residuals, to learn from the prior, or a payload on top of the certified arm.

    is_first: the first attempt on the present arm. False: a fit or test has failed, or a contact has interrupted it;
    the samples learnt before stay as evidence of a torque that depends on the position. The belief learnt before is
    dropped, so a contact on the way leaves no trace in it, whenever it is detected. Filters that started with the old
    payload would mix the old theta into the new one for about 4 / a.
    """
    k, m = constants[0], memory[0]
    if is_first:
        missing_torque.clear(k, m)
    m.gaps.has_gap = 1.0
    filter_bank.forget(m)
    missing_torque.forget(m)
    undone_filter.forget(m.wide_history)
    belief.begin_fit(k, m, is_payload)
    if is_payload and int(k.first_offset) > regressor.A5:
        filter_bank.rest(m)
        missing_torque.rest(m)
    fit_check.begin(m)
    tail.begin_tail(m)
    sensitivity.begin_fit(m)
    termination.begin_fit(m)


@compiled
def begin_test(constants: Structured, memory: Structured) -> None:
    """Use the belief, without negative friction, as the model, and begin its test, with all counts at 0.

    Drop the samples that wait in the ring. The fit's late residuals give the test's limit, see
    `termination.begin_test`.
    """
    k, m = constants[0], memory[0]
    belief.freeze(m)
    sight.begin_sight(m)
    termination.begin_test(k, m, fit_check.late_square(m))


@compiled
def begin_refinement(constants: Structured, memory: Structured) -> None:
    """Store the model in use as certified, and begin to test candidates for a better one.

    From now on the lags are not learnt, see `belief.hold_lags`. Drop the beliefs kept from before a touch, and the
    evidence of a torque that the model lacks.
    """
    k, m = constants[0], memory[0]
    belief.certify(k, m)
    refinement.begin(m)
    earlier.forget(m)
    missing_torque.clear(k, m)


@compiled
def step(constants: Structured, memory: Structured, block: Structured, is_complete: int, steps: int, mode: int) -> int:
    """Process the block's q, dq, tau_J and fill its other fields; return bits of an observation (`findings`).

    The caller sets q, dq, tau_J and period_s (0: `steps` nominal periods); `paper_*` stay, which
    `paper_kernel.step_beside` fills. is_complete: 1 for a fresh sample; else the filters and the model stay. A fresh
    sample with a value that isn't finite makes a gap. steps: periods since the fresh sample before it. mode: bits
    MEASURE to WEIGH; without WATCH the thresholds are inf.
    """
    k, m, out = constants[0], memory[0], block[0]
    observation = observe(k.limits, k.period_s, block, steps, OVER_SPEED)
    is_fresh = is_complete != 0 and observation & NOT_A_NUMBER == 0
    if is_fresh:
        evidence.follow(m, out.period_s)
        if mode & MEASURE:
            sensitivity.measure_noise(k, m, out.tau_J)
            anchor.measure(k, m, out.tau_J, observation & AT_REST != 0)
        if _filter(k, m, out, steps):
            observation &= ~UNSEEN
        if not (np.all(np.isfinite(m.filters.r)) and np.all(np.isfinite(m.models.theta))):
            observation |= NOT_A_NUMBER
    elif is_complete != 0:
        m.gaps.has_gap = 1.0
    if mode & MEASURE and anchor.is_rest_refused(k, m):
        certificate.withhold(m, certificate.READING)
        observation |= WITHHELD
    if mode & WATCH:
        observation |= _watch(k, m, out, is_fresh)
    else:
        out.threshold[:] = np.inf
        out.threshold_bank[:] = np.inf
        sensitivity.lift(m)
    if mode & WEIGH and not observation & UNSEEN:
        doubt.weigh(k, m)
    if is_fresh and mode & (LEARN | TEST | REFINE):
        observation |= improve(k, m, out, observation & CONTACT != 0, mode)
    _fill_model(k, m, out)
    return observation


@compiled
def _filter(k: Constants, m: Memory, out: CertifiedBlock, steps: int) -> bool:
    """Advance all filters to this sample, missing samples interpolated, and fill the torques of the block.

    steps: periods since the fresh sample before. Return False after a gap, when the filters resume from the sample; a
    moving arm then doesn't learn for `settle_cycles`.
    """
    nominal_s: float = k.period_s
    period_s: float = out.period_s
    is_seen = m.gaps.has_gap == 0.0 and is_filled(steps, period_s, nominal_s, lost_samples.MOST_FILLED)
    each_s = period_s / steps if is_seen else period_s
    if is_seen:
        filter_bank.choose_rates(k, m, each_s)
        for between in range(1, steps):
            put_between(m.gaps.last, out.q, out.dq, out.tau_J, between / steps, m.gaps.between)
            m.gaps.is_steady = 0.0
            q, dq, tau_J = m.gaps.between[0], m.gaps.between[1], m.gaps.between[2]
            _take_sample(k, m, q, dq, tau_J, each_s, is_seen, out.tau_ext_wide_hat)
    lost_samples.follow_lost(k, m, out.dq, max(steps, 1), period_s, is_seen)
    sensitivity.follow_torque_step(k, m, out.tau_J)
    if not is_seen and np.max(np.abs(out.dq)) > regressor.SLOW_RAD_S:
        belief.pause(m, k.settle_cycles)
    m.gaps.is_steady = 1.0 if is_seen and steps == 1 else 0.0
    q, dq, tau_J = out.q[:], out.dq[:], out.tau_J[:]  # arrays like those above, so that this is compiled once
    _take_sample(k, m, q, dq, tau_J, each_s, is_seen, out.tau_ext_wide_hat)
    m.gaps.has_gap = 0.0
    keep_sample(out.q, out.dq, out.tau_J, m.gaps.last)
    out.tau_f[:] = m.filters.tau_f[filter_bank.SLOW]
    external_torque.predict(m.filters.W_f[filter_bank.SLOW], k.theta_cad, out.tau_f_cad)
    for i in range(out.q.shape[0]):
        out.tau_ext_hat[i] = m.filters.r[filter_bank.SLOW, i]
        out.tau_f_hat[i] = m.filters.r[filter_bank.SLOW, i] + out.tau_f[i]
        out.tau_ext_hat_cad[i] = out.tau_f_cad[i] - out.tau_f[i]
    return bool(is_seen)


@compiled
def _take_sample(
    k: Constants,
    m: Memory,
    q: Vector,
    dq: Vector,
    tau_J: Vector,
    period_s: float,
    is_seen: bool,
    tau_ext_wide_hat: Vector,
) -> None:
    """Advance all filters by one period to a sample, and compare it with the model in use.

    is_seen: False after a gap: the filters resume from the sample. Fill tau_ext_wide_hat (2,), and the residuals,
    channels, standstill, velocity noise and friction at rest of `m`.
    """
    cutoff = k.cutoff
    regressor.fill(k, m, q, dq, tau_J, period_s)
    filter_bank.take_sample(k, m, tau_J, is_seen)
    missing_torque.follow(m, m.filters.rates[:, filter_bank.LEARNT], k.smoothing, is_seen)
    filter_bank.fill_lag(cutoff, tau_J, m.filters.tau_f, int(k.first_offset) + q.shape[0], m.filters.W_f)
    if k.first_cross_talk < m.models.theta.shape[0]:
        filter_bank.fill_cross_talk(m.filters.tau_f, int(k.first_cross_talk), m.filters.W_f)
    filter_bank.smooth_learnt(k.smoothing, m.filters.W_f, m.filters.tau_f, m.filters.W_learnt, m.filters.tau_learnt)
    filter_bank.estimate_external(m.filters.tau_f, m.filters.W_f, m.models.theta, m.filters.r)
    filter_bank.smooth(k.smoothing, m.filters.r, m.filters.y)
    sensitivity.follow_standstill(k, m, dq)
    sensitivity.follow_velocity_noise(k, m, dq, m.gaps.is_steady != 0.0)
    sensitivity.follow_friction(k, m, tau_J)
    undone_filter.undo_filter(
        m.filters.r[filter_bank.WIDE], k.decay[filter_bank.WIDE], m.wide_history, tau_ext_wide_hat
    )


@compiled
def _watch(k: Constants, m: Memory, out: CertifiedBlock, is_fresh: bool) -> int:
    """Fill the thresholds and compare the residuals with them; return bits of an observation, or 0.

    CONTACT, and from CONTACT_SHIFT on one bit per joint over its threshold. COLLISION: a bare channel is over
    `collision_Nm`, too. is_fresh: False keeps the thresholds of the sample before.
    """
    if is_fresh:
        sensitivity.fill_thresholds(k, m)
        out.threshold[:] = m.sensitivity.h[filter_bank.SLOW]
        sensitivity.fill_wide(k, m)
    joints = sensitivity.joints_over(m.filters.y, m.sensitivity.h)
    if not joints:
        return 0
    observation = CONTACT | joints << CONTACT_SHIFT
    for c in range(m.filters.r.shape[0], m.filters.y.shape[0]):
        for i in range(m.filters.y.shape[1]):
            if not (abs(m.filters.y[c, i]) <= max(k.collision_Nm[i], m.sensitivity.h[c, i])):
                observation |= COLLISION
    return observation


@compiled
def improve(k: Constants, m: Memory, out: CertifiedBlock, is_touched: bool, mode: int) -> int:
    """Learn, test or refine with this sample, by `mode`; return the result as bits of an observation, or 0.

    The bits: FITTED, CERTIFIED, REFUTED, WITHHELD, with the contradiction in `withheld_by`. is_touched: a joint is over
    its threshold in this cycle. A touch pauses learning, but not a test. In LEARN and TEST its first cycle raises the
    joints' thresholds and keeps the fit's beliefs as evidence, unless learning was paused before; in REFINE a touch
    begins the evidence on the contact's cause.
    """
    was_free = m.models.recovering_cycles == 0.0
    is_free = belief.is_free(k, m, is_touched)
    if is_touched and was_free and mode & (LEARN | TEST):
        sensitivity.raise_strain(m, sensitivity.LARGEST_STRAIN)
        earlier.keep_fit(k, m)
    if is_touched and mode & REFINE:
        doubt.begin(k, m)
    _follow_noise(k, m, is_free, mode)
    if mode & TEST:
        return _test(k, m, out.dq)
    if mode & REFINE:
        return _refine(k, m) if is_free else 0
    W_f, tau_f = m.filters.W_f[filter_bank.SLOW], m.filters.tau_f[filter_bank.SLOW]
    if is_free and belief.learn(k, m):
        belief.use(m)
        fit_check.follow(k, m, W_f, tau_f)
    is_complete = is_free and termination.follow(k, m, out.q, out.dq, W_f)
    if not is_complete:
        return 0
    certificate.withhold(m, certificate.contradicted_by(k, m))
    return FITTED if m.withheld_by == certificate.NOTHING else WITHHELD


@compiled
def _follow_noise(k: Constants, m: Memory, is_free: bool, mode: int) -> None:
    """If `is_free`, update the velocity's noise by a sample, and while testing or refining the largest residuals.

    Else discard the samples that wait in the ring, and the residuals of the last two blocks.
    """
    if not is_free:
        belief.discard(m)
        tail.discard_tail(m)
        return
    sensitivity.keep_velocity_noise(k, m)
    if mode & (TEST | REFINE):
        tail.follow_tail(k, m)


@compiled
def _test(k: Constants, m: Memory, dq: Vector) -> int:
    """Add this sample to the test of the frozen model; return CERTIFIED, REFUTED, REFUTED and WITHHELD, or 0.

    0 while the test goes on. WITHHELD: the model lacks a torque that depends on the position. If refuted set
    `withheld_by`, and, without a payload, keep the fit's beliefs as evidence.
    """
    sensitivity.follow_unit(k, m, False)
    sight.follow_test(k, m)
    result = termination.test(k, m, dq, m.filters.r[filter_bank.SLOW])
    if result >= 0:
        return CERTIFIED if result > 0 else 0
    if m.models.is_payload == 0.0:  # a new payload: hands have been on the arm, and friction may depend on it
        earlier.keep_fit(k, m)
    is_by_place = missing_torque.is_found(k, m)
    certificate.withhold(m, certificate.BY_PLACE if is_by_place else certificate.NOTHING)
    return REFUTED | WITHHELD if is_by_place else REFUTED


@compiled
def _refine(k: Constants, m: Memory) -> int:
    """Learn on beside the model in use, and replace it by a better tested candidate.

    Return WITHHELD if later evidence contradicts the certificate, else 0; set `withheld_by` to the contradiction, or
    NOTHING.
    """
    sensitivity.follow_unit(k, m, True)
    sensitivity.decay_strain(k, m)
    cause = certificate.BLIND if sight.follow_sight(k, m) else certificate.NOTHING
    if belief.learn(k, m):
        belief.wander(k.drift_std, m.filters.W_learnt, k.period_s * k.learn_every, m.models.P_belief)
        if missing_torque.is_confirmed(k, m):
            cause = certificate.BY_PLACE
    if refinement.test(k, m):
        cause = certificate.ANCHOR
    certificate.withhold(m, cause)
    return 0 if cause == certificate.NOTHING else WITHHELD


@compiled
def _fill_model(k: Constants, m: Memory, out: CertifiedBlock) -> None:
    """Fill the block's fields of the model in use, of the channels, and of the fit's progress.

    The channels' thresholds only while thresholds are in force.
    """
    base, joints = int(k.first_offset), m.filters.y.shape[1]
    for j in range(m.models.theta.shape[0]):
        if j < base:
            out.theta_hat[j] = m.models.theta[j]
        else:
            out.theta_further[j - base] = m.models.theta[j]
        out.theta_std[j] = np.sqrt(max(m.models.P[j, j], 0.0))
    for c in range(m.filters.y.shape[0]):
        for i in range(joints):
            out.tau_ext_bank[c * joints + i] = m.filters.y[c, i]
            if out.threshold[i] != np.inf:
                out.threshold_bank[c * joints + i] = m.sensitivity.h[c, i]
    out.excitation = m.fit.excitation
    out.condition = m.fit.condition
    out.promotions = m.models.promotions
    out.quiet_s = m.fit.tested * k.period_s
