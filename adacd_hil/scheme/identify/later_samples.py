"""The model of the samples that came between two beliefs, from the two beliefs alone.

With theta_0, P_0 the earlier and theta, P the later one, what came between them says by itself theta_late:

    theta_late - theta = P (P_0 - P)^-1 (theta - theta_0),   of covariance P (P_0 - P)^-1 P

(P_0 a little larger than it was, see `REGULAR`.) Two beliefs are **apart** if that comes to another torque than the
second on some samples, by more than

    APART_NM + RMS_SHARE rms   and   APART_SIGMAS of its standard deviation, in units of the second's u

rms as in `fit_samples`: then something touched the arm, or let go, before the second.

Shapes: p parameters, n joints; theta (p,), P (p, p); scratch (p, p); v, later (p,).
"""

from typing import Any

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from adacd_hil.scheme.identify import fit_samples

REGULAR = 0.01
"""Share of P_0 that is added to P_0 - P, so that what no sample has shown since is no difference."""
RMS_SHARE = 2.0
"""How many times rms a torque may differ beside a bound in Nm."""
APART_NM = 0.04
APART_SIGMAS = 1.2
"""Touched beliefs came to 1.4 to 2.4, untouched ones to 0.9 in the middle, 1.8 at most; those may be dropped, too."""
PROBES = 16
"""Samples on which two beliefs are compared."""


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
def find(m: Any, theta_0: Vector, P_0: Vector, theta: Vector, P: Vector) -> bool:
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
def is_apart(m: Any, theta_0: Vector, P_0: Vector, theta: Vector, P: Vector, unit: float) -> bool:
    """Tell whether two beliefs are apart, on samples of the fit that is under way. unit: the second's u."""
    kept = int(m["samples_kept"])
    if kept == 0 or not find(m, theta_0, P_0, theta, P):
        return False
    L, x = m["scratch"], m["v"]
    largest_Nm, largest_share = 0.0, 0.0
    for r in range(0, kept, max(kept // PROBES, 1)):
        for i in range(m["samples_tau"].shape[1]):
            w = m["samples_W"][r, i]
            torque_Nm, variance = 0.0, 0.0
            for j in range(x.shape[0]):
                torque_Nm += w[j] * m["later"][j]
                x[j] = 0.0
                for k in range(x.shape[0]):
                    x[j] += P[j, k] * w[k]
                x[j] /= np.sqrt(P_0[j, j])
                for k in range(j):
                    x[j] -= L[j, k] * x[k]
                x[j] /= L[j, j]
                variance += x[j] * x[j]
            largest_Nm = max(largest_Nm, abs(torque_Nm))
            largest_share = max(largest_share, torque_Nm * torque_Nm / max(variance, 1e-12))
    if not largest_share > APART_SIGMAS**2 * unit:
        return False
    return bool(largest_Nm > APART_NM + RMS_SHARE * fit_samples.better_rms(m))
