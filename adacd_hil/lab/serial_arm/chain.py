"""The dynamics of a serial arm with n joints, linear in the inertial parameters of its links.

    tau = M(q) ddq + C(q, dq) dq + g(q) + F_v dq + F_c sgn(dq) = W(q, dq, ddq) theta

Split as the filter needs it, without acceleration:

    tau = d/dt (Y_p theta) + Y_h theta,    Y_p theta = M dq,    Y_h theta = -C' dq + g + F_v dq + F_c sgn(dq)

(C' dq)_i = 1/2 dq' (dM/dq_i) dq is the derivative of the kinetic energy T by q_i. With spatial vectors (angular part
first), each in the frame of its link, v_k the velocity of link k, s_i the axis of joint i, I_k the inertia of link k
and X_ki the transform of a motion from the frame of link i to that of link k >= i:

    T = 1/2 sum_k v_k' I_k v_k,    dv_k/d(dq_i) = X_ki s_i,    dv_k/dq_i = X_ki (v_i x s_i)

    (M dq)_i  = sum_k (X_ki s_i)' I_k v_k
    (C' dq)_i = sum_k (X_ki (v_i x s_i))' I_k v_k
    g_i       = sum_k (X_ki s_i)' I_k (-gravity, seen from link k)

so every entry is one bilinear form u' I_k x, which is linear in the ten parameters of link k: `add_form`. Spatial
algebra: Featherstone, Rigid Body Dynamics Algorithms, 2008, chapters 2 and 5. The planar arm of
`adacd_hil.scheme.model.regressor` is the case n = 2.

**Parameters.** For each link, about the origin of its joint and in the axes of its frame, in the order of
`LINK_PARAMETERS`: mass, first moment, inertia; together theta_full (10 n,). The torque doesn't show all of them:
`find_base` picks a smallest set of columns that spans the others and gives the map theta_base = B theta_full.

`Chain` is a tuple of arrays, not a structured array: its type does not hold n, so that one compilation serves every
arm.

Shapes: q, dq, ddq, tau (n,); W, Y_p, Y_h (n, 10 n). Units: rad, m, s, kg, Nm (N for a prismatic joint).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector

Indices = NDArray[np.int64]

LINK_PARAMETERS = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
"""Parameters of one link, in Pinocchio's order: kg, kg m, kg m²; the inertia is about the origin of the link's
frame."""

PER_LINK = len(LINK_PARAMETERS)

_BASE_STATES_PER_PARAMETER = 4
_RANK_TOLERANCE = 1e-9  # of the largest: rounding leaves 1e-15 of a dependent column; a real one is over 1e-6


class Chain(NamedTuple):
    """Geometry of a serial arm. Joint i carries link i; its frame is the joint's, moved by q_i."""

    rotation: Vector  # (n, 3, 3), from the joint's frame at q = 0 to the frame of the link before it
    translation: Vector  # (n, 3), of the joint's origin in the frame of the link before it, m
    axis: Vector  # (n, 3), unit vector in the joint's frame
    is_prismatic: Vector  # (n,), 1.0 for a prismatic joint, 0.0 for a revolute one
    gravity_m_s2: Vector  # (3,), in the frame of the base


@compiled
def split_regressor(chain: Chain, q: Vector, dq: Vector) -> tuple[Vector, Vector]:
    """Return Y_p and Y_h (n, 10 n) of tau = d/dt (Y_p theta_full) + Y_h theta_full. q, dq (n,).

    Friction is left out; gravity is in.
    """
    n = q.shape[0]
    Y_p, Y_h = np.zeros((n, PER_LINK * n)), np.zeros((n, PER_LINK * n))
    E, r = _place_links(chain, q)
    rest, still = np.zeros(n), np.zeros((n, 6))
    v = _move_links(chain, E, r, np.zeros(6), dq, still)
    a = _move_links(chain, E, r, _upward(chain), rest, still)
    u, w = np.zeros(6), np.zeros(6)
    for i in range(n):
        u[:] = 0.0
        _add_along_axis(chain, i, 1.0, u)
        _cross(v[i], u, w)
        for k in range(i, n):
            if k > i:
                _carry(E[k], r[k], u, u)
                _carry(E[k], r[k], w, w)
            link = slice(PER_LINK * k, PER_LINK * (k + 1))
            add_form(u, v[k], 1.0, Y_p[i, link])
            add_form(w, v[k], -1.0, Y_h[i, link])
            add_form(u, a[k], 1.0, Y_h[i, link])
    return Y_p, Y_h


@compiled
def fill_friction(dq: Vector, first_column: int, Y: Vector) -> None:
    """Write dq to the columns of F_v, one per joint from `first_column` on, in Y (n, p), and sgn(dq) to those of F_c.

    The columns of F_c follow. Only joint i's row is written in its columns; all other cells stay as they are.
    """
    for i in range(dq.shape[0]):
        Y[i, first_column + i] = dq[i]
        Y[i, first_column + dq.shape[0] + i] = np.sign(dq[i])


@compiled
def regressor(chain: Chain, q: Vector, dq: Vector, ddq: Vector) -> Vector:
    """Return W (n, 10 n) of tau = W theta_full: gravity is in, friction left out. q, dq, ddq (n,)."""
    n = q.shape[0]
    W = np.zeros((n, PER_LINK * n))
    E, r = _place_links(chain, q)
    bias = np.zeros((n, 6))
    v = _move_links(chain, E, r, np.zeros(6), dq, bias)
    for i in range(n):
        _add_along_axis(chain, i, dq[i], bias[i])
        _cross(v[i], bias[i], bias[i])
    a = _move_links(chain, E, r, _upward(chain), ddq, bias)
    u, w = np.zeros(6), np.zeros(6)
    for i in range(n):
        u[:] = 0.0
        _add_along_axis(chain, i, 1.0, u)
        for k in range(i, n):
            if k > i:
                _carry(E[k], r[k], u, u)
            link = slice(PER_LINK * k, PER_LINK * (k + 1))
            add_form(u, a[k], 1.0, W[i, link])
            _cross(v[k], u, w)
            add_form(w, v[k], -1.0, W[i, link])  # u' (v x* I v) = -(v x u)' I v
    return W


@compiled
def add_form(u: Vector, x: Vector, scale: float, row: Vector) -> None:
    """Add `scale` times the coefficients of a link's ten parameters in the form u' I x to row (10,), in place.

    I: the link's spatial inertia. u, x (6,): motions in the link's frame, the angular part first.
    """
    row[0] += scale * (u[3] * x[3] + u[4] * x[4] + u[5] * x[5])
    # first moment: u_v x x_w + x_v x u_w
    row[1] += scale * (u[4] * x[2] - u[5] * x[1] + x[4] * u[2] - x[5] * u[1])
    row[2] += scale * (u[5] * x[0] - u[3] * x[2] + x[5] * u[0] - x[3] * u[2])
    row[3] += scale * (u[3] * x[1] - u[4] * x[0] + x[3] * u[1] - x[4] * u[0])
    # inertia
    row[4] += scale * (u[0] * x[0])
    row[5] += scale * (u[0] * x[1] + u[1] * x[0])
    row[6] += scale * (u[1] * x[1])
    row[7] += scale * (u[0] * x[2] + u[2] * x[0])
    row[8] += scale * (u[1] * x[2] + u[2] * x[1])
    row[9] += scale * (u[2] * x[2])


@compiled
def _place_links(chain: Chain, q: Vector) -> tuple[Vector, Vector]:
    """Return the pose of each link in the frame of the link before, at joint positions q (n,).

    E (n, 3, 3): rotation from that frame to the link's. r (n, 3): the link's origin in that frame, m.
    """
    E, r = np.zeros((q.shape[0], 3, 3)), np.zeros((q.shape[0], 3))
    for i in range(q.shape[0]):
        x, y, z = chain.axis[i, 0], chain.axis[i, 1], chain.axis[i, 2]
        angle = 0.0 if chain.is_prismatic[i] != 0.0 else q[i]
        shift = q[i] if chain.is_prismatic[i] != 0.0 else 0.0
        c, s = np.cos(angle), np.sin(angle)
        rest = 1.0 - c
        for row in range(3):
            to_x, to_y, to_z = chain.rotation[i, row, 0], chain.rotation[i, row, 1], chain.rotation[i, row, 2]
            r[i, row] = chain.translation[i, row] + shift * (to_x * x + to_y * y + to_z * z)
            E[i, 0, row] = (c + x * x * rest) * to_x + (x * y * rest + z * s) * to_y + (x * z * rest - y * s) * to_z
            E[i, 1, row] = (x * y * rest - z * s) * to_x + (c + y * y * rest) * to_y + (y * z * rest + x * s) * to_z
            E[i, 2, row] = (x * z * rest + y * s) * to_x + (y * z * rest - x * s) * to_y + (c + z * z * rest) * to_z
    return E, r


@compiled
def _upward(chain: Chain) -> Vector:
    """Return the upward acceleration (6,) of the base that stands for gravity, m/s², in the base's frame.

    The angular part comes first and is 0.
    """
    upward = np.zeros(6)
    upward[3:] = -chain.gravity_m_s2
    return upward


@compiled
def _move_links(chain: Chain, E: Vector, r: Vector, base: Vector, rate: Vector, bias: Vector) -> Vector:
    """Return the motion (n, 6) of each link in its own frame, angular part first: velocity or acceleration.

    E, r: of `_place_links`. base (6,): motion of the base. rate (n,): of each joint, added along its axis. bias (n, 6):
    added to each link's motion.
    """
    motion = np.zeros_like(bias)
    before = base
    for i in range(rate.shape[0]):
        _carry(E[i], r[i], before, motion[i])
        _add_along_axis(chain, i, rate[i], motion[i])
        for j in range(6):
            motion[i, j] += bias[i, j]
        before = motion[i]
    return motion


@compiled
def _add_along_axis(chain: Chain, i: int, amount: float, motion: Vector) -> None:
    """Add `amount` of a unit motion of joint i, from 0, to `motion` (6,), in its frame; rad/s or m/s, for example."""
    first = 3 if chain.is_prismatic[i] != 0.0 else 0
    for j in range(3):
        motion[first + j] += amount * chain.axis[i, j]


@compiled
def _carry(E: Vector, r: Vector, x: Vector, y: Vector) -> None:
    """Write to y (6,) the motion x (6,) of the link before, as the motion of this link in its frame; y may be x.

    E (3, 3), r (3,): this link's pose, of `_place_links`.
    """
    w0, w1, w2 = x[0], x[1], x[2]
    v0, v1, v2 = x[3] + w1 * r[2] - w2 * r[1], x[4] + w2 * r[0] - w0 * r[2], x[5] + w0 * r[1] - w1 * r[0]
    for row in range(3):
        y[row] = E[row, 0] * w0 + E[row, 1] * w1 + E[row, 2] * w2
        y[3 + row] = E[row, 0] * v0 + E[row, 1] * v1 + E[row, 2] * v2


@compiled
def _cross(v: Vector, u: Vector, y: Vector) -> None:
    """Write to y (6,) the product v x u of two motions (6,): the rate of u, which moves along with v; y may be u."""
    u0, u1, u2, u3, u4, u5 = u[0], u[1], u[2], u[3], u[4], u[5]
    y[0] = v[1] * u2 - v[2] * u1
    y[1] = v[2] * u0 - v[0] * u2
    y[2] = v[0] * u1 - v[1] * u0
    y[3] = v[1] * u5 - v[2] * u4 + v[4] * u2 - v[5] * u1
    y[4] = v[2] * u3 - v[0] * u5 + v[5] * u0 - v[3] * u2
    y[5] = v[0] * u4 - v[1] * u3 + v[3] * u1 - v[4] * u0


def point_mass(mass_kg: float, at_m: Sequence[float] | Vector) -> Vector:
    """Return the parameters (10,) that a point mass at `at_m` (3,), in the link's frame, adds to those of its link."""
    x, y, z = at_m
    inertia = (y * y + z * z, -x * y, x * x + z * z, -x * z, -y * z, x * x + y * y)
    return mass_kg * np.array([1.0, x, y, z, *inertia])


@dataclass(frozen=True)
class BaseParameters:
    """A smallest set of parameters that determines the torque of an arm: theta_base = map @ theta_full.

    Each parameter is one of theta_full, changed by others that can't be told from it.
    """

    columns: Indices  # (n_base,), the chosen columns of theta_full, ascending
    map: Vector  # (n_base, 10 n)
    names: tuple[str, ...]  # (n_base,), of the chosen columns: each stands for the sum of its row of `map`


def find_base(chain: Chain) -> BaseParameters:
    """Return a smallest set of parameters that determines the torque without friction, by W at random states.

    By QR with pivoting. A combination that shows in no W shows neither in Y_p nor in Y_h: its M, and with it C, is
    zero, and its g. The states are the same at every call. Source: Gautier, Numerical calculation of the base inertial
    parameters of robots, 1991.
    """
    n = chain.axis.shape[0]
    random = np.random.default_rng(0)
    count = _BASE_STATES_PER_PARAMETER * PER_LINK
    states = random.uniform(-3.0, 3.0, (count, 3, n))
    W = np.concatenate([regressor(chain, *state) for state in states])
    R, order = scipy.linalg.qr(W, mode="r", pivoting=True)
    size = np.abs(np.diag(R))
    rank = int(np.sum(size > _RANK_TOLERANCE * size[0])) if size[0] > 0.0 else 0
    columns = np.sort(order[:rank]).astype(np.int64)
    base_map = scipy.linalg.lstsq(W[:, columns], W)[0]
    base_map[np.abs(base_map) < _RANK_TOLERANCE] = 0.0
    names = tuple(f"{LINK_PARAMETERS[column % PER_LINK]}_{column // PER_LINK + 1}" for column in columns)
    return BaseParameters(columns, base_map, names)
