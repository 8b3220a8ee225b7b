"""Whether one model explains the whole of a fit: its kept samples, and the beliefs that it passed on the way.

**Samples.** Samples of a fit, kept so that the model it has come to is asked whether it explains each of them.

A touch that came and went while little was known is a small part of a fit, and its model passes a test on new motion:
what the touch has bent shows elsewhere. But the samples of that time don't agree with the model. So a fit counts only
if

    |tau_f - W_f theta| <= LIMIT_NM + LIMIT_SHARE rms

of every sample and joint, rms: of the residuals of its better half. Not asked of a payload's fit. They are also the
motion on which other models are compared with the fit's, see `earlier`.

Shapes: p parameters, n joints, s samples of room; samples_W (s, n, p), samples_tau (s, n). When there is no room left
every second sample goes, and half as many come.

**Later samples.** The model of the samples that came between two beliefs, from the two beliefs alone.

With theta_0, P_0 the earlier and theta, P the later one, what came between them says by itself theta_late:

    theta_late - theta = P (P_0 - P)^-1 (theta - theta_0),   of covariance P (P_0 - P)^-1 P

(P_0 a little larger than it was, see `REGULAR`.)

Shapes: p parameters, n joints; theta (p,), P (p, p); scratch (p, p); v, later (p,).
"""

from typing import Any

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, Vector

ROOM = 128
FIRST_EVERY = 3.0
"""Of the samples that are learnt, every 4 ms: 1.5 s fill the room."""
LIMIT_NM = 0.045
LIMIT_SHARE = 9.0
"""Of 400 untouched arms, wide ones included, the worst came to 0.63 of the limit, half of them to 0.16."""


def shapes_of(count: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of what is remembered, by name, of a model with this many parameters."""
    return {
        "samples_W": (ROOM, JOINTS, count),
        "samples_tau": (ROOM, JOINTS),
        "samples_kept": (),
        "samples_every": (),
        "samples_left_out": (),
    }


@compiled
def begin(m: Any) -> None:
    """Begin a fit."""
    m["samples_kept"] = 0.0
    m["samples_every"] = FIRST_EVERY
    m["samples_left_out"] = 0.0


@compiled
def keep(m: Any, W_f: Vector, tau_f: Vector) -> None:
    """Take in a sample that is learnt. W_f (n, p), tau_f (n,)."""
    m["samples_left_out"] += 1.0
    if m["samples_left_out"] < m["samples_every"]:
        return
    m["samples_left_out"] = 0.0
    kept, room = int(m["samples_kept"]), m["samples_tau"].shape[0]
    if kept == room:
        kept = room // 2
        for s in range(kept):
            m["samples_W"][s] = m["samples_W"][2 * s]
            m["samples_tau"][s] = m["samples_tau"][2 * s]
        m["samples_every"] *= 2.0
    m["samples_W"][kept] = W_f
    m["samples_tau"][kept] = tau_f
    m["samples_kept"] = kept + 1.0


@compiled
def first_unexplained(m: Any) -> int:
    """Return which of the fit's learnt samples, from 0, is the first that its belief doesn't explain; -1: none is."""
    kept, first = int(m["samples_kept"]), -1
    if m["is_payload"] != 0.0 or kept < 2:
        return first
    limit = limit_Nm(m)
    for s in range(kept - 1, -1, -1):
        for i in range(m["samples_tau"].shape[1]):
            if not abs(residual(m, s, i)) <= limit:
                first = s
    return first if first < 0 else int(first * m["samples_every"])


@compiled
def limit_Nm(m: Any) -> float:
    """Return the largest residual that the fit explains."""
    return float(LIMIT_NM + LIMIT_SHARE * better_rms(m))


@compiled
def better_rms(m: Any) -> float:
    """Return the root mean square of the residuals, Nm, of the earlier or later half of the samples, the smaller."""
    squares, half = np.zeros(2), int(m["samples_kept"]) // 2
    for s in range(2 * half):
        for i in range(m["samples_tau"].shape[1]):
            squares[s // half] += residual(m, s, i) ** 2
    return float(np.sqrt(np.min(squares) / max(half * m["samples_tau"].shape[1], 1)))


@compiled
def largest_torque(m: Any, theta: Vector) -> float:
    """Return the largest |W_f theta| over the samples and joints, Nm. theta (p,)."""
    largest = 0.0
    for s in range(int(m["samples_kept"])):
        for i in range(m["samples_tau"].shape[1]):
            torque = 0.0
            for j in range(theta.shape[0]):
                torque += m["samples_W"][s, i, j] * theta[j]
            largest = max(largest, abs(torque))
    return float(largest)


@compiled
def residual(m: Any, s: int, joint: int) -> float:
    """Return what the belief leaves of sample s, Nm."""
    w, r = m["samples_W"][s, joint], m["samples_tau"][s, joint]
    for j in range(w.shape[0]):
        r -= w[j] * m["belief"][j]
    return float(r)


REGULAR = 0.01
"""Share of P_0 that is added to P_0 - P, so that what no sample has shown since is no difference."""
RMS_SHARE = 2.0
"""How many times rms a torque may differ beside a bound in Nm."""


@compiled
def distance(m: Any, theta_0: Vector, P_0: Vector, theta: Vector, P: Vector) -> float:
    """Return (theta - theta_0) (P_0 - P)^-1 (theta - theta_0)' of two beliefs, the earlier first; inf if there is none.

    By a Cholesky decomposition, in units of the square roots of P_0's diagonal. Leaves its lower half in `scratch`, and
    in `v` the vector whose square the distance is.
    """
    L, x = m["scratch"], m["v"]
    for j in range(x.shape[0]):
        scale = np.sqrt(P_0[j, j])
        x[j] = (theta[j] - theta_0[j]) / scale
        for n in range(j + 1):
            V = (1.0 + REGULAR) * P_0[j, n] - P[j, n]
            V /= scale * np.sqrt(P_0[n, n])
            for i in range(n):
                V -= L[j, i] * L[n, i]
            if n < j:
                L[j, n] = V / L[n, n]
            elif V > 0.0:
                L[j, j] = np.sqrt(V)
            else:
                return np.inf
        for n in range(j):
            x[j] -= L[j, n] * x[n]
        x[j] /= L[j, j]
    return float(np.sum(x * x))


@compiled
def find_later(m: Any, theta_0: Vector, P_0: Vector, theta: Vector, P: Vector) -> bool:
    """Fill `later` (p,): the model of what came between two beliefs less the second; False if there is none."""
    if not distance(m, theta_0, P_0, theta, P) < np.inf:
        return False
    L, x, later = m["scratch"], m["v"], m["later"]
    for j in range(x.shape[0] - 1, -1, -1):
        for n in range(j + 1, x.shape[0]):
            x[j] -= L[n, j] * x[n]
        x[j] /= L[j, j]
    for j in range(x.shape[0]):
        later[j] = 0.0
        for n in range(x.shape[0]):
            later[j] += P[j, n] * x[n] / np.sqrt(P_0[n, n])
    return True


@compiled
def later_share(m: Any, P_0: Vector, P: Vector, limit_Nm: float, unit: float) -> float:
    """Return the largest |W_f later| of the samples over limit_Nm, beyond which its standard deviation is allowed, too.

    After `find_later` of the same beliefs. unit: of their variances.
    """
    largest = 0.0
    for s in range(int(m["samples_kept"])):
        for i in range(m["samples_tau"].shape[1]):
            w, torque, allowed_Nm = m["samples_W"][s, i], 0.0, limit_Nm
            for j in range(w.shape[0]):
                torque += w[j] * m["later"][j]
            if abs(torque) > limit_Nm:
                allowed_Nm += np.sqrt(unit * _later_variance(m, w, P_0, P))
            largest = max(largest, abs(torque) / allowed_Nm)
    return float(largest)


@compiled
def _later_variance(m: Any, w: Vector, P_0: Vector, P: Vector) -> float:
    """Return w P (P_0 - P)^-1 P w', with what `distance` has left in `scratch`."""
    L, x, variance = m["scratch"], m["v"], 0.0
    for j in range(w.shape[0]):
        x[j] = 0.0
        for n in range(w.shape[0]):
            x[j] += P[j, n] * w[n]
        x[j] /= np.sqrt(P_0[j, j])
        for n in range(j):
            x[j] -= L[j, n] * x[n]
        x[j] /= L[j, j]
        variance += x[j] * x[j]
    return float(variance)
