"""The dynamics of the 2R arm, linear in its parameters: the paper's eq. (17) and (18) with a6 = F_v1, a7 = F_v2.

    tau = M(q) ddq + C(q, dq) dq + g(q) + F_v dq + F_c sgn(dq) = W(q, dq, ddq) theta

theta is ordered as `PARAMETER_NAMES`, with `GRAVITY_PARAMETER_NAMES` appended where the joint axes are not vertical;
p = 7 or 9. With level_rad, the q1 at which link 1 is level (`Settings.level_rad`),

    g = (a4 cos(q1 - level_rad) + a5 cos(q1 + q2 - level_rad),  a5 cos(q1 + q2 - level_rad))

Split as the filter needs it, without acceleration:

    tau = d/dt (Y_p theta) + Y_h theta,    Y_p theta = M dq,    Y_h theta = -C' dq + g + F_v dq + F_c sgn(dq)

Shapes: q, dq, ddq, tau (2,); theta (p,); W, Y_p, Y_h (2, p); M (2, 2). Units: rad, rad/s, rad/s², Nm.
"""

import numpy as np

from adacd_hil import linalg
from adacd_hil.compiled import compiled
from adacd_hil.records import GRAVITY_PARAMETER_NAMES, JOINTS, PARAMETER_NAMES, Vector
from adacd_hil.scheme.memory import Constants, Memory
from adacd_hil.scheme.model.further_friction import bend_bristles, fill_terms, smooth_sign
from adacd_hil.scheme.model.torque_by_place import fill_position, put_position_columns

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
def fill_remainder(q: Vector, dq: Vector, level_rad: float, Y_h: Vector) -> None:
    """Fill Y_h (2, p) of -C' dq + g + F_v dq + F_c sgn(dq). Entries that are always zero are left as they are."""
    Y_h[1, A2] = np.sin(q[1]) * dq[0] * (dq[0] + dq[1])  # (-Mdot + C) dq = -C' dq
    _fill_friction_and_gravity(q, dq, level_rad, Y_h)


@compiled
def _fill_friction_and_gravity(q: Vector, dq: Vector, level_rad: float, W: Vector) -> None:
    W[0, F_V1] = dq[0]
    W[1, F_V2] = dq[1]
    W[0, F_C1] = np.sign(dq[0])
    W[1, F_C2] = np.sign(dq[1])
    if W.shape[1] > A5:
        W[0, A4] = np.cos(q[0] - level_rad)
        W[0, A5] = W[1, A5] = np.cos(q[0] + q[1] - level_rad)


@compiled
def regressor(q: Vector, dq: Vector, ddq: Vector, parameter_count: int, level_rad: float) -> Vector:
    """Return the regressor W (2, p) of eq. (17), tau = W theta. level_rad: q1 at which link 1 is level.

    parameter_count: p, 7 or with gravity 9.
    """
    W = np.zeros((JOINTS, parameter_count))
    fill_momentum(q, ddq, W)  # M ddq
    s2 = np.sin(q[1])
    W[0, A2] += -s2 * dq[1] * dq[0] - s2 * (dq[0] + dq[1]) * dq[1]  # C dq
    W[1, A2] += s2 * dq[0] * dq[0]
    _fill_friction_and_gravity(q, dq, level_rad, W)
    return W


@compiled
def inverse_dynamics(q: Vector, dq: Vector, ddq: Vector, theta: Vector, level_rad: float) -> Vector:
    """Return tau (2,) = W theta, the torque that the model needs for this motion, Nm.

    theta (p,): without or with gravity. level_rad: q1 at which link 1 is level.
    """
    W = regressor(q, dq, ddq, theta.shape[0], level_rad)
    tau = np.zeros(JOINTS)
    for i in range(JOINTS):
        tau[i] = linalg.dot(W[i], theta)
    return tau


@compiled
def fill_mass_matrix(q: Vector, theta: Vector, M: Vector) -> None:
    """Fill M (2, 2) with the mass matrix at q, kg m²."""
    c2 = np.cos(q[1])
    M[0, 0] = theta[A1] + 2.0 * theta[A2] * c2
    M[0, 1] = M[1, 0] = theta[A3] + theta[A2] * c2
    M[1, 1] = theta[A3]


def mass_matrix(q: Vector, theta: Vector) -> Vector:
    """Return the mass matrix M(q) (2, 2), kg m²."""
    M = np.zeros((JOINTS, JOINTS))
    fill_mass_matrix(q, theta, M)
    return M


@compiled
def is_positive_definite(theta: Vector) -> bool:
    """Return whether M(q) is positive definite at every q: a3 > 0 and a3 (a1 - a3) > a2²; False for NaN."""
    return bool(theta[A3] > 0.0 and theta[A3] * (theta[A1] - theta[A3]) > theta[A2] ** 2)


SLOW_RAD_S = 0.02
"""Speed below which noise dominates the expected friction."""


@compiled
def fill(k: Constants, m: Memory, q: Vector, dq: Vector, tau_J: Vector, period_s: float) -> None:
    """Fill the regressor of a sample in `m`: Y_p, Y_h (n, p), and X, the columns of torque by position.

    The columns of the lags and of cross-talk stay 0, since `filter_bank` writes them into W_f. Fill M (n, n), the mass
    matrix of the model in use. Advance the friction's bristles by period_s.
    """
    own = m.regressor
    base, count = int(k.first_offset), q.shape[0]
    bend_bristles(dq, period_s, k.still_rad_s, k.dahl_rad, own.bent)
    fill_momentum(q, dq, own.Y_p[:, :base])
    fill_remainder(q, dq, k.level_rad, own.Y_h[:, :base])
    for i in range(count):
        own.Y_h[i, F_C1 + i] = smooth_sign(dq[i], k.still_rad_s, k.width_rad_s)
        own.Y_h[i, base + i] = 1.0
    speeds = k.still_rad_s, k.width_rad_s, k.stribeck_rad_s
    fill_terms(dq, tau_J, k.terms, speeds, own.bent, base + 2 * count, own.Y_h)
    fill_position(q, own.X)
    if k.position_torque_Nm != 0.0:
        put_position_columns(own.X, int(k.first_position), own.Y_h)
    fill_mass_matrix(q, m.models.theta, own.M)


def payload_direction(link_length_m: tuple[float, float], count: int, gravity_m_s2: float) -> Vector:
    """Return the contribution of 1 kg at the tip of a 2R arm to its parameters (count,).

    It is 0 for all but those of inertia and gravity. gravity_m_s2: in the plane, 0 without gravity there.
    """
    l1, l2 = link_length_m
    direction = np.zeros(count)
    direction[:3] = l1**2 + l2**2, l1 * l2, l2**2
    if gravity_m_s2:
        direction[[A4, A5]] = gravity_m_s2 * l1, gravity_m_s2 * l2
    return direction
