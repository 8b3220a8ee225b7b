"""The belief about the parameters: mean theta and covariance P, corrected by samples that have waited.

The prior gives the range of possible arms in true units; recursive least squares (`estimator`) corrects it. Filtered
samples are not independent measurements: the noise of a filter of cut-off a is correlated over about 2 / a. A sample
every T_learn therefore counts with the variance

       R = sigma² 2 / (a T_learn),    sigma: residual of a good model behind the filter, Nm rms,

so that P is the true uncertainty. Friction of a joint that stands still is any torque up to the static one: its share
in the filter counts as further deviation, and the belief learns little from a joint that mostly rests.

**Payload.** A mass m at the tip adds m (l1² + l2², l1 l2, l2²) to (a1, a2, a3): the belief widens along this direction
g by sigma_m² g g', and a little in each inertia, as a payload is not a point mass. All else stays known.

**Lags.** Their column is the derivative of a torque that is measured with noise. If the motion changes the torque
little, the column is mostly noise, and an estimate from it shrinks towards zero, the more the longer it goes on. So
lags are learnt on the excitation, and *held* after it (`hold_lags`).

**Hold-back.** A sample waits in a ring until `waiting` others have followed. `discard` empties it.

Shapes: theta, prior (p,); P (p, p); ring_W (h, n, p), ring_tau, ring_R, ring_still (h, n).
"""

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from adacd_hil.scheme.detect import sensitivity
from adacd_hil.scheme.identify import estimator, fit_check, missing_torque
from adacd_hil.scheme.memory import Constants, Memory
from adacd_hil.scheme.model import filter_bank, regressor

_SWEEPS = 200
"""Most sweeps over the parameters that must not be negative; a handful is enough unless P couples them closely."""
_SETTLED = 1e-9
"""Largest step of a parameter in the last sweep, Nm or Nm s/rad."""


@compiled
def begin_fit(k: Constants, m: Memory, is_payload: bool) -> None:
    """Begin a fit: set the belief to the prior, use it as the model, and empty the ring of waiting samples.

    Learn the lags again, and set the cycles without learning to 0. is_payload: begin with the certified model in place
    of the prior, widened by an unknown payload. The flag is stored.
    """
    own = m.models
    own.is_payload = 1.0 if is_payload else 0.0
    if is_payload:
        own.belief[:] = own.certified
        own.P_belief[:] = own.P_certified
        add_payload(k.payload_direction, k.payload_std_kg, k.payload_rest_std, own.P_belief)
    else:
        begin(k.prior, k.prior_std, own.belief, own.P_belief)
    use(m)
    discard(m)
    own.are_lags_held = 0.0
    own.recovering_cycles = 0.0


@compiled
def freeze(m: Memory) -> None:
    """Move negative friction in the belief to 0, use the belief as the model, and empty the ring of waiting samples.

    The other parameters follow by their covariance with the friction; the covariance stays, see `keep_non_negative`.
    """
    keep_non_negative(regressor.F_V1, regressor.F_C2 + 1, m.models.belief, m.models.P_belief)
    use(m)
    discard(m)


@compiled
def certify(k: Constants, m: Memory) -> None:
    """Store the model in use as the certified one, set `promotions` to 0, and hold the lags, see `hold_lags`."""
    m.models.promotions = 0.0
    _certify(m)
    hold_lags(k, m)


@compiled
def promote(m: Memory, theta: Vector, P: Vector) -> None:
    """Set the model in use and the certified model to theta (p,) and P (p, p), and add 1 to `promotions`.

    The belief stays.
    """
    m.models.theta[:] = theta
    m.models.P[:] = P
    _certify(m)
    m.models.promotions += 1.0


@compiled
def _certify(m: Memory) -> None:
    """Copy the model in use to the certified one."""
    own = m.models
    own.certified[:] = own.theta
    own.P_certified[:] = own.P


@compiled
def use(m: Memory) -> None:
    """Copy the belief to the model in use."""
    own = m.models
    own.theta[:] = own.belief
    own.P[:] = own.P_belief


@compiled
def pause(m: Memory, cycles: float) -> None:
    """Set `recovering_cycles`, for which the arm doesn't learn, to at least `cycles`."""
    m.models.recovering_cycles = max(m.models.recovering_cycles, cycles)


@compiled
def is_free(k: Constants, m: Memory, is_touched: bool) -> bool:
    """Count down the cycles without learning by one; return whether none is left.

    is_touched: raise them to at least `recover_cycles` in place of the count.
    """
    if is_touched:
        pause(m, k.recover_cycles)
    elif m.models.recovering_cycles > 0.0:
        m.models.recovering_cycles -= 1.0
    return bool(m.models.recovering_cycles == 0.0)


@compiled
def begin(prior: Vector, prior_std: Vector, theta: Vector, P: Vector) -> None:
    """Set theta (p,) to the prior, and P (p, p) to the diagonal of prior_std² (p,), in place."""
    theta[:] = prior
    P[:] = np.diag(prior_std**2)


@compiled
def add_payload(direction: Vector, payload_std_kg: float, rest_std: Vector, P: Vector) -> None:
    """Add the uncertainty of an unknown payload to P (p, p) in place.

    direction (p,): parameters of a point mass of 1 kg at the tip. rest_std (p,): deviation by which a payload differs
    from a point mass.
    """
    P += np.outer(payload_std_kg**2 * direction, direction)
    P += np.diag(rest_std**2)


@compiled
def wander(drift_std: Vector, W_f: Vector, elapsed_s: float, P: Vector) -> None:
    """Add the variance of a random walk of the parameters over elapsed_s to P (p, p) in place.

    drift_std (p,): deviation after 1 s; it grows with √s, and is scaled by the parameter's largest |w| in W_f (n, p),
    at most 1. Without that scale a parameter that hardly shows would be learnt from the error of the others, such as
    friction by load from a load that hardly varies, and would be far off where it counts.
    """
    for j in range(drift_std.shape[0]):
        P[j, j] += (drift_std[j] * min(np.max(np.abs(W_f[:, j])), 1.0)) ** 2 * elapsed_s


@compiled
def learn(k: Constants, m: Memory) -> bool:
    """Put each `learn_every`-th sample into the ring; correct the belief by the sample that leaves the full ring.

    Return whether a sample left it. The sample: `W_learnt` (n, p) and `tau_learnt` (n,) of the filters, less the torque
    of the lags if these are held. A joint's row of infinite variance, as of a joint at rest, corrects nothing. Each
    other row also goes to `missing_torque.add` and `fit_check.add_residual`.
    """
    own = m.models
    W, tau_J, still = m.filters.W_learnt, m.filters.tau_learnt, m.sensitivity.still_smooth[filter_bank.LEARNT]
    own.since_learnt += 1.0
    if own.since_learnt < k.learn_every:
        return False
    own.since_learnt = 0.0
    place = int(m.ring.next)
    has_waited = m.ring.used == k.waiting
    if has_waited:
        for i in range(tau_J.shape[0]):
            R = m.ring.R[place, i]
            w, tau = m.ring.W[place, i], m.ring.tau[place, i]
            if np.inf == R:
                continue
            missing_torque.add(k, m, place, i)
            epsilon, s = estimator.correct(w, tau, R, True, own.belief, own.P_belief, own.v, own.K)
            fit_check.add_residual(m, epsilon * epsilon / (s - R + R / k.correlated))
    else:
        m.ring.used += 1.0
    m.ring.W[place] = W
    missing_torque.keep_columns(m, place)
    for i in range(still.shape[0]):
        m.ring.still[place, i] = still[i] if abs(m.sensitivity.dq_old[i]) > regressor.SLOW_RAD_S else 1.0
    m.ring.tau[place] = tau_J
    if own.are_lags_held != 0.0:
        _take_out_lags(k, m, place)
    for i in range(tau_J.shape[0]):
        m.ring.R[place, i] = k.correlated * (k.residual_Nm**2 + sensitivity.held_Nm(m, i, still[i]) ** 2)
    m.ring.next = (place + 1) % k.waiting
    return bool(has_waited)


@compiled
def hold_lags(k: Constants, m: Memory) -> None:
    """Stop learning the lags of the velocity behind the torque.

    Clear their covariances with other parameters in P_belief, keep their variances. From now on `learn` subtracts the
    lags' torque from samples that enter the ring.
    """
    m.models.are_lags_held = 1.0
    P = m.models.P_belief
    first = int(k.first_offset) + m.ring.tau.shape[1]
    for j in range(first, first + m.ring.tau.shape[1]):
        variance = P[j, j]
        P[j, :] = 0.0
        P[:, j] = 0.0
        P[j, j] = variance


@compiled
def _take_out_lags(k: Constants, m: Memory, place: int) -> None:
    """Subtract the torque of the believed lags from the sample at index `place` of the ring.

    Set the sample's columns of lags to 0.
    """
    joints = m.ring.tau.shape[1]
    first = int(k.first_offset) + joints
    for i in range(joints):
        for j in range(first, first + joints):
            m.ring.tau[place, i] -= m.ring.W[place, i, j] * m.models.belief[j]
            m.ring.W[place, i, j] = 0.0


@compiled
def discard(m: Memory) -> None:
    """Empty the ring of waiting samples, which then never correct the belief, and count to the next sample from 0."""
    m.ring.used = 0.0
    m.ring.next = 0.0
    m.models.since_learnt = 0.0


@compiled
def keep_non_negative(first: int, last: int, theta: Vector, P: Vector) -> None:
    """Move theta (p,) in place so that its parameters first .. last - 1 are all at least 0.

    The result is the nearest such theta in the metric of P, by Hildreth's method: a negative parameter is pushed to
    zero and moves all others by their covariance in P (p, p); a push that turns out too large is taken back. A
    parameter of variance 0, or one still negative after `_SWEEPS` sweeps, is clipped alone. P stays: the constraint
    doesn't reduce the uncertainty.
    """
    pushed = np.zeros(last - first)
    for _ in range(_SWEEPS):
        moved = 0.0
        for j in range(first, last):
            if not P[j, j] > 0.0:
                continue
            push = max(-theta[j] / P[j, j], -pushed[j - first])
            pushed[j - first] += push
            for n in range(theta.shape[0]):
                theta[n] += push * P[n, j]
            moved = max(moved, abs(push) * P[j, j])
        if moved < _SETTLED:
            break
    for j in range(first, last):
        theta[j] = max(theta[j], 0.0)
