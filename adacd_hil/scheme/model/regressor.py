"""The dynamics of the 2R arm, linear in its parameters: the paper's eq. (17) and (18) with a6 = F_v1, a7 = F_v2.

    tau = M(q) ddq + C(q, dq) dq + g(q) + F_v dq + F_c sgn(dq) = W(q, dq, ddq) theta

theta is ordered as `PARAMETER_NAMES`, with `GRAVITY_PARAMETER_NAMES` appended where the joint axes are not vertical;
p = 7 or 9. Split as the filter needs it, without acceleration:

    tau = d/dt (Y_p theta) + Y_h theta,    Y_p theta = M dq,    Y_h theta = -C' dq + g + F_v dq + F_c sgn(dq)

Shapes: q, dq, ddq, tau (2,); theta (p,); W, Y_p, Y_h (2, p); M (2, 2). Units: rad, rad/s, rad/s², Nm.
"""

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import GRAVITY_PARAMETER_NAMES, JOINTS, PARAMETER_NAMES, Vector

# Columns of the regressors, named so that no offset is written by hand.
_NAMES = PARAMETER_NAMES + GRAVITY_PARAMETER_NAMES
A1, A2, A3 = (_NAMES.index(name) for name in ("a1", "a2", "a3"))
F_V1, F_V2, F_C1, F_C2 = (_NAMES.index(name) for name in ("F_v1", "F_v2", "F_c1", "F_c2"))
A4, A5 = (_NAMES.index(name) for name in GRAVITY_PARAMETER_NAMES)


@compiled
def fill_momentum(q: Vector, dq: Vector, Y_p: Vector) -> None:
    """Fill Y_p (2, p) of M(q) dq = Y_p theta. Entries that are always zero are left as they are."""
    c2 = np.cos(q[1])
    Y_p[0, A1] = dq[0]
    Y_p[0, A2] = c2 * (2.0 * dq[0] + dq[1])
    Y_p[0, A3] = dq[1]
    Y_p[1, A2] = c2 * dq[0]
    Y_p[1, A3] = dq[0] + dq[1]


@compiled
def fill_remainder(q: Vector, dq: Vector, Y_h: Vector) -> None:
    """Fill Y_h (2, p) of -C' dq + g + F_v dq + F_c sgn(dq). Entries that are always zero are left as they are."""
    Y_h[1, A2] = np.sin(q[1]) * dq[0] * (dq[0] + dq[1])  # (-Mdot + C) dq = -C' dq
    Y_h[0, F_V1] = dq[0]
    Y_h[1, F_V2] = dq[1]
    Y_h[0, F_C1] = np.sign(dq[0])
    Y_h[1, F_C2] = np.sign(dq[1])
    if Y_h.shape[1] > A5:
        Y_h[0, A4] = np.cos(q[0])
        Y_h[0, A5] = np.cos(q[0] + q[1])
        Y_h[1, A5] = np.cos(q[0] + q[1])


@compiled
def regressor(q: Vector, dq: Vector, ddq: Vector, parameter_count: int) -> Vector:
    """Return W (2, p) of eq. (17)."""
    W = np.zeros((JOINTS, parameter_count))
    c2 = np.cos(q[1])
    s2 = np.sin(q[1])
    # M ddq
    W[0, A1] = ddq[0]
    W[0, A2] = c2 * (2.0 * ddq[0] + ddq[1])
    W[0, A3] = ddq[1]
    W[1, A2] = c2 * ddq[0]
    W[1, A3] = ddq[0] + ddq[1]
    # C dq
    W[0, A2] += -s2 * dq[1] * dq[0] - s2 * (dq[0] + dq[1]) * dq[1]
    W[1, A2] += s2 * dq[0] * dq[0]
    # friction
    W[0, F_V1] = dq[0]
    W[1, F_V2] = dq[1]
    W[0, F_C1] = np.sign(dq[0])
    W[1, F_C2] = np.sign(dq[1])
    # gravity
    if parameter_count > A5:
        W[0, A4] = np.cos(q[0])
        W[0, A5] = np.cos(q[0] + q[1])
        W[1, A5] = np.cos(q[0] + q[1])
    return W


@compiled
def inverse_dynamics(q: Vector, dq: Vector, ddq: Vector, theta: Vector) -> Vector:
    """Return tau (2,) = W theta, the torque that the model needs for this motion, Nm."""
    W = regressor(q, dq, ddq, theta.shape[0])
    tau = np.zeros(JOINTS)
    for i in range(JOINTS):
        for j in range(theta.shape[0]):
            tau[i] += W[i, j] * theta[j]
    return tau


@compiled
def fill_mass_matrix(q: Vector, theta: Vector, M: Vector) -> None:
    """Fill M(q) (2, 2), kg m²."""
    c2 = np.cos(q[1])
    M[0, 0] = theta[A1] + 2.0 * theta[A2] * c2
    M[0, 1] = M[1, 0] = theta[A3] + theta[A2] * c2
    M[1, 1] = theta[A3]


def mass_matrix(q: Vector, theta: Vector) -> Vector:
    """Return M(q) (2, 2), kg m²."""
    M = np.zeros((JOINTS, JOINTS))
    fill_mass_matrix(q, theta, M)
    return M


@compiled
def is_positive_definite(theta: Vector) -> bool:
    """Tell whether M(q) is positive definite at every q: a3 > 0 and a3 (a1 - a3) > a2²; NaN is not."""
    return bool(theta[A3] > 0.0 and theta[A3] * (theta[A1] - theta[A3]) > theta[A2] ** 2)
