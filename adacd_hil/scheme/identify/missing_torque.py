"""Evidence that the model lacks a torque that depends on the arm's position.

Each sample that the belief learns, a row w of the regressor with its torque and variance R, also goes into the sums

    L = Σ v v'/R,   b = Σ v r/R,   r = tau_f - w prior,   v = (w, x)

with x the columns of `regressor` behind the filter that is learnt from. From a prior N(0, S²) of the parameters less
their mean, with x or without, each sum gives the likelihood of the samples:

    log evidence = ½ b' S M^-1 S b - ½ log det M,   M = I + S L S

The model lacks a torque by place if x makes them e^GAIN times likelier, leaves less than 1 - SHARE of the weighted
squares that the basic model leaves, and comes to LEAST_NM rms. Of clean arms, with every error of
the error campaign but a tilt and a cable, the gain was -25 to -3, or the share below 0.4; tilts of 0.5 and 1
deg and a cable of 0.1 Nm came to a gain of 20 and more on a motion that shows them.

An adaptation is checked as a whole, when it refuses a fit. While the arm monitors, the check for a torque by place runs
over the first 2 s of learnt samples, the next 4, 8, 16 s and then each 16 s. Longer stretches are not used: the drift
of a sensor over a minute looks like such a torque. One stretch is not enough there, since on one way many effects
depend on the place: its result must explain AGREED_SHARE of the squares that the basic model leaves in a later one.

Shapes: p parameters, n joints, t = PLACE_TERMS, f = p + n t; L (n, f, f): by the joint of the row, lower half;
b, basic, full, row, scale (f,); M (f, f); last_found (n t,): coefficients of the last stretch
that came to a torque by place, else all 0; rms_Nm (n,): the last torque found, 0 without one.
"""

import math

import numpy as np

from adacd_hil import linalg
from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, Vector
from adacd_hil.scheme.memory import Constants, Memory, TermConstants
from adacd_hil.scheme.model import filter_bank
from adacd_hil.scheme.model.regressor import F_C1
from adacd_hil.scheme.model.torque_by_place import PLACE_TERMS
from adacd_hil.scheme.model.torque_filter import FirstOrderHold, advance, low_pass
from adacd_hil.settings.configuration import Settings

EXPECTED_NM = 0.06
"""Standard deviation of a coefficient, of an arm that has a cable."""
GAIN, SHARE, LEAST_NM = 8.0, 0.6, 0.01
"""Thresholds for one stretch."""
AGREED_SHARE = 0.4
LEAST_BACK = 0.2
"""Share of a joint's samples in its less frequent direction: on a way in one direction a torque by speed or by time
also depends on the place."""
STILL = 0.05
"""Share of standstill in the filter's memory above which friction may take any value."""
FIRST_S, LONGEST_S = 2.0, 16.0
"""Learnt time before the first check while the arm monitors, and before each later one at most."""


def constants_of(settings: Settings, prior_std: Vector) -> TermConstants:
    """Return the prior deviations (f,), and numbers of learnt samples before checks while the arm monitors.

    first: before the first check; longest: before each later one at most. prior_std (p,): prior deviations of the
    model's own parameters.
    """
    learn_s = settings.bus.period_s * settings.certified.learn_every
    return TermConstants(
        prior_std=np.concatenate([prior_std, np.full(JOINTS * PLACE_TERMS, EXPECTED_NM)]),
        first=round(FIRST_S / learn_s),
        longest=round(LONGEST_S / learn_s),
    )


@compiled
def forget(m: Memory) -> None:
    """Set the filtered columns of the torque that depends on the position, `X_f` and `X_learnt`, to 0."""
    m.missing_torque.X_f[:] = 0.0
    m.missing_torque.X_learnt[:] = 0.0


@compiled
def rest(m: Memory) -> None:
    """Set the filtered columns `X_f` to their values after a long rest in the present pose."""
    m.missing_torque.X_f[:] = m.regressor.X


@compiled
def follow(m: Memory, rates: Vector, smoothing: float, is_seen: bool) -> None:
    """Advance the filtered columns X (n, PLACE_TERMS) over one period, by the filter `LEARNT` and the pole behind it.

    Store this sample's columns for the next call. is_seen: False after a gap, when that filter keeps its values, and
    only the pole advances. rates (3,): the filter's coefficients for one period, see `torque_filter.FirstOrderHold`;
    smoothing: share of the pole's old output that stays after one period.
    """
    hold = FirstOrderHold(rates[0], rates[1], rates[2])
    X, X_old, X_f, X_learnt = m.regressor.X, m.missing_torque.X_old, m.missing_torque.X_f, m.missing_torque.X_learnt
    for i in range(X.shape[0]):
        if is_seen:
            advance(hold, X_old[i], X[i], X_f[i])
        else:
            for term in range(PLACE_TERMS):
                X_old[i, term] = X[i, term]
        low_pass(smoothing, X_f[i], X_learnt[i])


@compiled
def keep_columns(m: Memory, slot: int) -> None:
    """Put the filtered columns of this sample into the ring, where they wait with the sample's regressor.

    slot: index in the ring.
    """
    m.missing_torque.ring_X[slot] = m.missing_torque.X_learnt


@compiled
def clear(k: Constants, m: Memory) -> None:
    """Set the sums, the torque found before and its rms to 0; the next check waits for as many samples as the first.

    Call it for another arm or payload, or with a new certificate.
    """
    _clear_sums(m)
    m.missing_torque.last_found[:] = 0.0
    m.missing_torque.rms_Nm[:] = 0.0
    m.missing_torque.wanted = k.missing_torque.first


@compiled
def _clear_sums(m: Memory) -> None:
    own = m.missing_torque
    own.L[:] = 0.0
    own.b[:] = 0.0
    own.yy = 0.0
    own.weight[:] = 0.0
    own.ways[:] = 0.0
    own.samples = 0.0


@compiled
def add(k: Constants, m: Memory, slot: int, joint: int) -> None:
    """Add to the sums a joint's row that the belief learns now from the ring; skip it if the joint was slow or at rest.

    slot: index in the ring. joint: from 0.
    """
    own = m.missing_torque
    if m.ring.still[slot, joint] > STILL:
        return
    v, count = own.row, m.models.belief.shape[0]
    R = m.ring.R[slot, joint] + k.correlated * _rough_variance(k, m, joint)
    v[:] = 0.0
    v[:count] = m.ring.W[slot, joint]
    v[count + PLACE_TERMS * joint : count + PLACE_TERMS * (joint + 1)] = own.ring_X[slot, joint]
    r = -linalg.misfit(v, k.prior, m.ring.tau[slot, joint])
    linalg.add_row(v, r, R, own.L[joint], own.b)
    own.ways[joint, 1 if v[F_C1 + joint] > 0.0 else 0] += 1.0
    own.yy += r * r / R
    own.weight[joint] += 1.0 / R


@compiled
def _rough_variance(k: Constants, m: Memory, joint: int) -> float:
    """Return the residual's variance from a velocity noisier than in the settings, Nm²: an encoder's steps.

    At low speed they come slowly, so they count as the model's error does.
    """
    total = 0.0
    for j in range(m.regressor.M.shape[1]):
        total += (m.sensitivity.velocity_roughness[j] - 1.0) * m.regressor.M[joint, j] ** 2
    return float(filter_bank.VELOCITY_STD_SHARE**2 * k.noise.velocity_variance[filter_bank.LEARNT] * total)


@compiled
def is_confirmed(k: Constants, m: Memory) -> bool:
    """Count a sample learnt while the arm monitors; return whether the model lacks a torque by position.

    Check after the first samples, then after stretches that double up to a limit; return False between checks. True if
    the torque that an earlier stretch showed explains this stretch, too. A check sets `rms_Nm` (n,), to 0 if False,
    keeps the torque that this stretch shows for later checks, and empties the sums.
    """
    own = m.missing_torque
    own.samples += 1.0
    if own.samples < own.wanted:
        return False
    is_lacking = is_found(k, m)
    found = own.full[m.models.belief.shape[0] :].copy()
    is_agreed = _is_found_again(k, m)
    if is_lacking:
        own.last_found[:] = found
    own.wanted = min(2.0 * own.wanted, k.missing_torque.longest)
    _clear_sums(m)
    return is_agreed


@compiled
def is_found(k: Constants, m: Memory) -> bool:
    """Return whether a torque that depends on the position, and that the model lacks, explains the samples in the sums.

    It must be over LEAST_NM rms in a joint that has moved enough both ways. Fill `basic` and `full`, the coefficients
    without and with that torque, and `rms_Nm` (n,), the torque of each joint, 0 if False. Always False, with only
    `rms_Nm` filled, for a model that has such columns.
    """
    own = m.missing_torque
    own.rms_Nm[:] = 0.0
    if k.position_torque_Nm:
        return False
    basic, full = own.basic, own.full
    without = log_evidence(m, own.b, scale_of(k, m, False), basic)
    gain = log_evidence(m, own.b, scale_of(k, m, True), full) - without
    if not (gain > GAIN and squares_left(m, full) < (1.0 - SHARE) * squares_left(m, basic)):
        return False
    largest = 0.0
    for i in range(own.rms_Nm.shape[0]):
        ways = own.ways[i]
        if np.min(ways) >= LEAST_BACK * np.sum(ways):
            largest = max(largest, _rms_Nm(m, i))
    if largest > LEAST_NM:
        _fill_missing(m)
    return bool(largest > LEAST_NM)


@compiled
def scale_of(k: Constants, m: Memory, is_by_place: bool) -> Vector:
    """Return `scale` (f,), overwritten with the prior deviations of the parameters and of the columns by position.

    is_by_place: False sets those of the columns by position to 0, so that these explain no torque.
    """
    scale, count = m.missing_torque.scale, m.models.belief.shape[0]
    scale[:] = k.missing_torque.prior_std
    if not is_by_place:
        scale[count:] = 0.0
    return scale


@compiled
def _is_found_again(k: Constants, m: Memory) -> bool:
    """Return whether the torque found in an earlier stretch explains this stretch, too; fill `rms_Nm` (n,).

    Call `is_found` before, which fills `basic`. Fill `full` with this stretch's best model that has the earlier torque;
    overwrite `row`. False without an earlier torque.
    """
    own = m.missing_torque
    own.rms_Nm[:] = 0.0
    last_found, count, basic, full = own.last_found, m.models.belief.shape[0], own.basic, own.full
    if not np.any(last_found):
        return False
    b = own.row
    b[:] = own.b
    for i in range(own.L.shape[0]):
        for j in range(count):
            for n in range(last_found.shape[0]):
                b[j] -= own.L[i, count + n, j] * last_found[n]
    log_evidence(m, b, scale_of(k, m, False), full)
    full[count : count + last_found.shape[0]] = last_found
    left = squares_left(m, basic)
    explained = left - squares_left(m, full)
    is_agreed = 0.5 * explained > GAIN and explained > AGREED_SHARE * left
    if is_agreed:
        _fill_missing(m)
    return bool(is_agreed)


@compiled
def _fill_missing(m: Memory) -> None:
    """Fill `rms_Nm` (n,) with the rms of each joint's torque by which `full` and `basic` differ, see `_rms_Nm`."""
    for i in range(m.missing_torque.rms_Nm.shape[0]):
        m.missing_torque.rms_Nm[i] = _rms_Nm(m, i)


@compiled
def _rms_Nm(m: Memory, joint: int) -> float:
    """Return the rms torque, Nm, over a joint's learnt rows, weighted by 1/R, by which two fits differ.

    `full`: with a torque that depends on the position; `basic`: without. Overwrites `row`.
    """
    own = m.missing_torque
    apart = own.row
    for j in range(apart.shape[0]):
        apart[j] = own.full[j] - own.basic[j]
    square = linalg.quadratic(own.L[joint], apart)
    return float(np.sqrt(square / max(own.weight[joint], 1e-12)))


@compiled
def log_evidence(m: Memory, b: Vector, s: Vector, x: Vector) -> float:
    """Return the log evidence of the columns with a prior deviation s (f,) above 0, less a constant common to all s.

    b (f,): the sums Σ v r/R. Fill x (f,) with the columns' most likely coefficients, 0 where s is 0. Overwrites `M`.
    """
    M, count, log_det = m.missing_torque.M, s.shape[0], 0.0
    for j in range(count):
        x[j] = s[j] * b[j]
        for n in range(j + 1):
            total = 0.0
            for i in range(m.missing_torque.L.shape[0]):
                total += m.missing_torque.L[i, j, n]
            M[j, n] = s[j] * total * s[n] + (1.0 if n == j else 0.0)
    linalg.factor(M, 1e-12)
    for j in range(count):
        log_det += 2.0 * math.log(M[j, j])
    linalg.solve_lower(M, x)
    square = linalg.dot(x, x)
    linalg.solve_upper(M, x)
    x *= s
    return float(0.5 * (square - log_det))


@compiled
def squares_left(m: Memory, x: Vector) -> float:
    """Return Σ (r - v x)² / R, at least 0: the weighted squares that coefficients x (f,) leave in the sums' samples."""
    own = m.missing_torque
    total = own.yy - 2.0 * linalg.dot(x, own.b)
    for i in range(own.L.shape[0]):
        total += linalg.quadratic(own.L[i], x)
    return float(max(total, 0.0))


def describe(m: Memory) -> list[str]:
    """Return one line on the torque that the model lacks, with its rms by joint; [] without such a torque."""
    missing_Nm = m.missing_torque.rms_Nm.tolist()
    if not any(missing_Nm):
        return []
    torques = " and ".join(f"{rms:.3f} Nm rms in joint {i + 1}" for i, rms in enumerate(missing_Nm))
    return [
        f"a torque that depends on where the arm is, {torques}, is missing in the model: a cable, a base that is not "
        "mounted as arm.mounting_deg says (flat: not level), or a hand's spring"
    ]
