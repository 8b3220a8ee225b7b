"""Whether one model explains the whole of a fit: its kept samples, and the beliefs that it passed on the way.

A touch that begins or ends while the arm learns changes the samples; its column is not known beforehand. So a fit
counts only if one model explains all of it. With theta_0, P_0 the belief some time ago, a step,

    steady       (theta - theta_0) (P_0 - P)^-1 (theta - theta_0)' <= STEADY u
    explained    |tau_f - W_f theta| <= LIMIT_NM + LIMIT_SHARE rms
    borne out    |W_f (theta_late - theta)| <= LATER_NM + RMS_SHARE rms + LEARNT_SHARE sqrt(u) residual_Nm + sigma

for each step, the last two on all samples. theta_late is the model of the samples after the step, from the two beliefs
alone:

    theta_late - theta = P (P_0 - P)^-1 (theta - theta_0),   of covariance P (P_0 - P)^-1 P

(P_0 a little larger than it was, see `REGULAR`.) u: mean square of the fit's residuals over that of the settings, up to
the step or after it, the smaller; rms: of the residuals of the better half of its samples. sigma: where gravity acts,
the standard deviation of that difference, by the beliefs; else 0. In gravity a part of the motion hardly separates
gravity from an offset, so later samples may not determine the torque of earlier poses: sigma was 0.03 to 0.05 Nm on a
level arm, which differed by 0.033 to 0.045 Nm and got no certificate.

The last condition detects a weak touch of the beginning, when theta_0 is too uncertain to differ. A payload's fit is
exempt from the last two.

Shapes: p parameters, n joints, s samples of room, t steps; samples_W (s, n, p), samples_tau (s, n); steps_theta (t, p),
steps_P (t, p, p), steps_square, steps_rows (t,); factor (p, p), apart, later (p,). When the room is full each second
sample is dropped, and the rate of new ones is halved.
"""

import numpy as np

from adacd_hil import linalg
from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from adacd_hil.scheme.detect.sensitivity import LARGEST_UNIT
from adacd_hil.scheme.memory import Constants, Memory
from adacd_hil.scheme.model.regressor import A5
from adacd_hil.settings.configuration import Settings

ROOM = 128
FIRST_EVERY = 3.0
"""One in so many learnt samples, every 4 ms, is kept: 1.5 s fill the room."""
STEADY = 400.0
"""Squared distance over u at which a fit has changed. Fits of 400 untouched arms, wide ones included: median 0.06 of
it, maximum 0.18. It includes effects outside the model: cross-talk of 2 % comes to 680."""
LIMIT_NM = 0.045
LIMIT_SHARE = 9.0
"""Of 400 untouched arms, wide ones included: maximum 0.63 of the limit, median 0.16."""
SMALLEST_SQUARE = 0.015
"""Least u of a fit that is checked for a change."""
LATER_NM = 0.02
"""With the rest of the limit, the same fits: median 0.31 of it, maximum 0.94, in MuJoCo 0.98."""
RMS_SHARE = 2.0
"""How many times rms a torque may differ beside that."""
LEARNT_SHARE = 2.5
"""How many times the rms of the learnt residuals, of their better part, it may differ beside that."""
REGULAR = 0.01
"""Share of P_0 that is added to P_0 - P, so that a direction without new samples gives no difference."""
NONE = -2
"""Number for a missing step."""
STEP_S = 0.2
STEPS = 8
"""Interval and number of the fit's own earlier beliefs that are kept."""
HARD = 2.0
"""Mean square of the learnt residuals in their hard moments over that of all: the velocity's noise dominates there."""
SMALLEST_UNIT = 0.1
"""Least unit of the variances; the other bound is that of `sensitivity`."""


def step_samples_of(settings: Settings) -> int:
    """Return the number of learnt samples, at least 1, between two steps, at which the fit's belief is stored."""
    return max(round(STEP_S / (settings.bus.period_s * settings.certified.learn_every)), 1)


@compiled
def begin(m: Memory) -> None:
    """Empty the steps, the kept samples and the sums of residuals, as a new fit begins."""
    own = m.fit_check
    own.steps_used = 0.0
    own.fit_square = 0.0
    own.fit_rows = 0.0
    own.fit_samples = 0.0
    own.samples_kept = 0.0
    own.samples_every = FIRST_EVERY
    own.samples_left_out = 0.0


@compiled
def add_residual(m: Memory, square: float) -> None:
    """Add one row to the sum of squares and the count of the fit. square: its squared residual over its variance."""
    m.fit_check.fit_square += square
    m.fit_check.fit_rows += 1.0


@compiled
def follow(k: Constants, m: Memory, W_f: Vector, tau_f: Vector) -> None:
    """Count a learnt sample, keep each `samples_every`-th for the check, and store the belief as a step if one is due.

    A step is due after each `step_samples` samples; the last STEPS of them are stored. W_f (n, p), tau_f (n,): the
    sample in the filter by which the fit is tested.
    """
    own = m.fit_check
    _keep_sample(m, W_f, tau_f)
    own.fit_samples += 1.0
    if own.fit_samples % k.step_samples != 0.0:
        return
    s = int(own.steps_used) % own.steps_rows.shape[0]
    own.steps_theta[s] = m.models.belief
    own.steps_P[s] = m.models.P_belief
    own.steps_square[s] = own.fit_square
    own.steps_rows[s] = own.fit_rows
    own.steps_used += 1.0


@compiled
def _keep_sample(m: Memory, W_f: Vector, tau_f: Vector) -> None:
    """Keep each `samples_every`-th sample. When the room is full, drop each second one and double `samples_every`."""
    own = m.fit_check
    own.samples_left_out += 1.0
    if own.samples_left_out < own.samples_every:
        return
    own.samples_left_out = 0.0
    kept, room = int(own.samples_kept), own.samples_tau.shape[0]
    if kept == room:
        kept = room // 2
        for s in range(kept):
            own.samples_W[s] = own.samples_W[2 * s]
            own.samples_tau[s] = own.samples_tau[2 * s]
        own.samples_every *= 2.0
    own.samples_W[kept] = W_f
    own.samples_tau[kept] = tau_f
    own.samples_kept = kept + 1.0


@compiled
def unit_of(square: float, rows: float) -> float:
    """Return u, a factor on a belief's variances, by its fit's residuals: HARD times their mean square, within bounds.

    square: sum of the residuals' squares over their variances. rows: number of residuals. The bounds: SMALLEST_UNIT and
    LARGEST_UNIT.
    """
    return min(max(HARD * square / max(rows, 1.0), SMALLEST_UNIT), LARGEST_UNIT)


@compiled
def fit_unit(m: Memory) -> float:
    """Return u of the whole fit so far, see `unit_of`."""
    return unit_of(m.fit_check.fit_square, m.fit_check.fit_rows)


@compiled
def late_square(m: Memory) -> float:
    """Return the mean square of the residuals over their variances in the fit's later half; 1 before the second step.

    Of a long fit only the residuals since the oldest stored step count. The earlier half is left out, so that a touch
    of the beginning doesn't count.
    """
    own = m.fit_check
    used = int(own.steps_used)
    if used < 2:
        return 1.0
    steps = own.steps_rows.shape[0]
    s = max(used // 2 - 1, used - steps) % steps
    return float((own.fit_square - own.steps_square[s]) / max(own.fit_rows - own.steps_rows[s], 1.0))


@compiled
def _better_square(m: Memory, s: int) -> float:
    """Return the mean square of the residuals over their variances, up to a step or after it, the smaller.

    s: index at which the step is stored.
    """
    own = m.fit_check
    early = own.steps_square[s] / max(own.steps_rows[s], 1.0)
    late = (own.fit_square - own.steps_square[s]) / max(own.fit_rows - own.steps_rows[s], 1.0)
    return float(min(early, late))


@compiled
def last_step_before_change(k: Constants, m: Memory) -> int:
    """Return the number of the last step, from 0, before the fit contradicts itself; NONE if it doesn't.

    The number counts all steps since the fit began; a step is stored at its number modulo the STEPS that are stored.
    First by `last_step_before_contradiction`. If that finds none, but the model of the samples after a stored step
    contradicts the fit, return the last step of all; a payload's fit is not tested for that.
    """
    own = m.fit_check
    used, oldest = int(own.steps_used), max(int(own.steps_used) - own.steps_rows.shape[0], 0)
    changed = last_step_before_contradiction(k, m)
    if changed != NONE or m.models.is_payload:
        return changed
    for number in range(oldest, used):
        if not later_share(k, m, number % own.steps_rows.shape[0]) <= 1.0:
            return used - 1
    return NONE


@compiled
def last_step_before_contradiction(k: Constants, m: Memory) -> int:
    """Return the number, from 0, of the last stored step whose belief contradicts the fit's; NONE without one.

    The number counts all steps since the fit began. If no stored step does, but the fit doesn't explain a kept sample,
    return the last step before the first such sample; -1 if the sample came before the first step.
    """
    changed = last_unsteady_step(m)
    first = first_unexplained(m)
    return changed if changed != NONE or first < 0 else int(first // k.step_samples) - 1


@compiled
def first_unexplained(m: Memory) -> int:
    """Return the index, from 0, of the first kept sample that the fit's belief doesn't explain, less FIRST_EVERY - 1.

    The index counts learnt samples. -1 without such a sample, for a payload's fit, and with fewer than two kept
    samples. Unexplained: a residual over `limit_Nm`. Up to `samples_every` - 1 learnt samples before it are not kept,
    so not examined.
    """
    kept, first = int(m.fit_check.samples_kept), -1
    if m.models.is_payload or kept < 2:
        return first
    limit = limit_Nm(m)
    for s in range(kept - 1, -1, -1):
        for i in range(m.fit_check.samples_tau.shape[1]):
            if not abs(residual(m, s, i)) <= limit:
                first = s
    return first if first < 0 else int(first * m.fit_check.samples_every)


@compiled
def limit_Nm(m: Memory) -> float:
    """Return the size up to which a residual counts as explained by the fit, Nm."""
    return float(LIMIT_NM + LIMIT_SHARE * better_rms(m))


@compiled
def residual(m: Memory, s: int, joint: int) -> float:
    """Return the belief's residual of kept sample s in a joint, both from 0: measured less predicted torque, Nm."""
    return float(-linalg.misfit(m.fit_check.samples_W[s, joint], m.models.belief, m.fit_check.samples_tau[s, joint]))


@compiled
def last_unsteady_step(m: Memory) -> int:
    """Return the number, from 0, of the last stored step whose belief contradicts the fit's; NONE if none does.

    The number counts all steps since the fit began; the step is stored at that number modulo the STEPS stored ones.
    """
    used, steps = int(m.fit_check.steps_used), m.fit_check.steps_rows.shape[0]
    for number in range(used - 1, max(used - steps, 0) - 1, -1):
        if not changed_share(m, number % steps) <= 1.0:
            return number
    return NONE


@compiled
def changed_share(m: Memory, s: int) -> float:
    """Return a step's `distance` from the whole fit, a square, over its limit; over 1: the fit has changed since.

    s: index at which the step is stored.
    """
    return float(distance(m, s) / (STEADY * max(_better_square(m, s), SMALLEST_SQUARE)))


@compiled
def later_share(k: Constants, m: Memory, s: int) -> float:
    """Return the largest torque on the kept samples between the fit and the model after a step, over its limit.

    s: index at which the step is stored. Over 1: the samples after it contradict the fit. inf if they determine no
    model. The limit is wider in a model with gravity. Overwrites `later`, `factor` and `apart`.
    """
    own = m.fit_check
    if not find_later(m, s):
        return np.inf
    limit_Nm = LATER_NM + RMS_SHARE * better_rms(m)
    limit_Nm += LEARNT_SHARE * k.residual_Nm * np.sqrt(_better_square(m, s))
    has_gravity, unit, largest = int(k.first_offset) > A5, fit_unit(m), 0.0
    for sample in range(int(own.samples_kept)):
        for i in range(own.samples_tau.shape[1]):
            w, allowed_Nm = own.samples_W[sample, i], limit_Nm
            torque = abs(linalg.dot(w, own.later))
            if has_gravity and torque > limit_Nm:
                allowed_Nm += np.sqrt(unit * _later_variance(m, s, w))
            largest = max(largest, torque / allowed_Nm)
    return float(largest)


@compiled
def better_rms(m: Memory) -> float:
    """Return the rms of the residuals, Nm, over the earlier or the later half of the kept samples, the smaller.

    0 with fewer than two samples. Of an odd number the last is left out.
    """
    squares, half = np.zeros(2), int(m.fit_check.samples_kept) // 2
    for s in range(2 * half):
        for i in range(m.fit_check.samples_tau.shape[1]):
            squares[s // half] += residual(m, s, i) ** 2
    return float(np.sqrt(np.min(squares) / max(half * m.fit_check.samples_tau.shape[1], 1)))


@compiled
def distance(m: Memory, s: int) -> float:
    """Return (theta - theta_0) (P_0 - P)^-1 (theta - theta_0)' of step s and the fit; inf if P_0 - P has no factor.

    s: index at which the step is stored, with belief theta_0, P_0, which is enlarged by REGULAR in the difference.
    theta, P: the present belief. Leave the Cholesky factor of P_0 - P in `factor`, scaled by the square roots of P_0's
    diagonal, and in `apart` the vector whose square is the result.
    """
    own = m.fit_check
    P_0, P, L, x = own.steps_P[s], m.models.P_belief, own.factor, own.apart
    for j in range(x.shape[0]):
        scale = np.sqrt(P_0[j, j])
        x[j] = (m.models.belief[j] - own.steps_theta[s, j]) / scale
        for n in range(j + 1):
            L[j, n] = ((1.0 + REGULAR) * P_0[j, n] - P[j, n]) / (scale * np.sqrt(P_0[n, n]))
    if not linalg.factor(L, 0.0):
        return np.inf
    linalg.solve_lower(L, x)
    return float(np.sum(x * x))


@compiled
def find_later(m: Memory, s: int) -> bool:
    """Fill `later` (p,): parameters of the samples after step s less those of the fit.

    Return False, and keep `later`, if the `distance` is inf. s: index at which the step is stored. Overwrites `factor`
    and `apart`.
    """
    own = m.fit_check
    if not distance(m, s) < np.inf:
        return False
    x, P_0 = own.apart, own.steps_P[s]
    linalg.solve_upper(own.factor, x)
    x /= np.sqrt(np.diag(P_0))
    for j in range(x.shape[0]):
        own.later[j] = linalg.dot(m.models.P_belief[j], x)
    return True


@compiled
def _later_variance(m: Memory, s: int, w: Vector) -> float:
    """Return w P (P_0 - P)^-1 P w', the variance of the torque w `later`; call `find_later` for step s before.

    Overwrites `apart`.
    """
    x = m.fit_check.apart
    for j in range(x.shape[0]):
        x[j] = linalg.dot(m.models.P_belief[j], w) / np.sqrt(m.fit_check.steps_P[s, j, j])
    linalg.solve_lower(m.fit_check.factor, x)
    return float(np.sum(x * x))
