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
`find_base` picks a smallest set of columns that spans the others and gives the map theta_base = B theta_full. A
regressor for the filter has the chosen columns first, then F_v and F_c of each joint, then those that the caller adds.

`Chain` and `Scratch` are tuples of arrays, not structured arrays: their type does not hold n, so that one compilation
serves every arm.

Shapes: q, dq, ddq, tau (n,); W, Y_p, Y_h (n, p) with p at least the number of columns chosen. Units: rad, m, s, kg, Nm
(N for a prismatic joint).
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

NOT_USED = -1
"""Value in `place` of a parameter without a column."""

_BASE_STATES_PER_PARAMETER = 4
_RANK_TOLERANCE = 1e-9  # of the largest: rounding leaves 1e-15 of a dependent column; a real one is over 1e-6


class Chain(NamedTuple):
    """Geometry of a serial arm. Joint i carries link i; its frame is the joint's, moved by q_i."""

    rotation: Vector  # (n, 3, 3), from the joint's frame at q = 0 to the frame of the link before it
    translation: Vector  # (n, 3), of the joint's origin in the frame of the link before it, m
    axis: Vector  # (n, 3), unit vector in the joint's frame
    is_prismatic: Vector  # (n,), 1.0 for a prismatic joint, 0.0 for a revolute one
    gravity_m_s2: Vector  # (3,), in the frame of the base


class Scratch(NamedTuple):
    """Scratch arrays for one evaluation of an arm; each evaluation overwrites them. `new_scratch` makes them."""

    E: Vector  # (n, 3, 3), from the frame of the link before to the link's
    r: Vector  # (n, 3), the link's origin in the frame of the link before, m
    v: Vector  # (n, 6), velocity of each link
    a: Vector  # (n, 6), acceleration of each link, gravity as an upward one
    u: Vector  # (6,)
    w: Vector  # (6,)
    x: Vector  # (6,)
    row: Vector  # (PER_LINK,)


def new_scratch(chain: Chain) -> Scratch:
    """Return scratch arrays for evaluations of an arm, one after the other; each overwrites them."""
    n = chain.axis.shape[0]
    shapes = ((n, 3, 3), (n, 3), (n, 6), (n, 6), (6,), (6,), (6,), (PER_LINK,))
    return Scratch(*(np.zeros(shape) for shape in shapes))


def all_columns(chain: Chain) -> Indices:
    """Return the `place` (10 n,) of regressors with all of theta_full: parameter i has column i."""
    return np.arange(PER_LINK * chain.axis.shape[0], dtype=np.int64)


@compiled
def fill(chain: Chain, place: Indices, q: Vector, dq: Vector, scratch: Scratch, Y_p: Vector, Y_h: Vector) -> None:
    """Write Y_p and Y_h (n, p) of tau = d/dt (Y_p theta) + Y_h theta, in the columns of the inertial parameters.

    Friction is left out; gravity is in. q, dq (n,). place (10 n,): the column of each parameter of theta_full, or
    NOT_USED. A joint has no torque of the links before it: these entries, and other columns, stay as they are, so begin
    with zeros. Overwrites `scratch`.
    """
    v, a, u, w, row = scratch.v, scratch.a, scratch.u, scratch.w, scratch.row
    _place_links(chain, q, scratch.E, scratch.r)
    _move_links(chain, dq, scratch.E, scratch.r, v)
    _lift_links(chain, scratch.E, a)
    for i in range(q.shape[0]):
        u[:] = 0.0
        _add_along_axis(chain, i, 1.0, u)
        _cross(v[i], u, w)
        for k in range(i, q.shape[0]):
            if k > i:
                _carry(scratch.E[k], scratch.r[k], u, u)
                _carry(scratch.E[k], scratch.r[k], w, w)
            row[:] = 0.0
            add_form(u, v[k], 1.0, row)
            _put(row, place, k, Y_p[i])
            row[:] = 0.0
            add_form(w, v[k], -1.0, row)
            add_form(u, a[k], 1.0, row)
            _put(row, place, k, Y_h[i])


@compiled
def fill_friction(dq: Vector, first_column: int, Y: Vector) -> None:
    """Write dq to the columns of F_v, one per joint from `first_column` on, in Y (n, p), and sgn(dq) to those of F_c.

    The columns of F_c follow. Only joint i's row is written in its columns; all other cells stay as they are.
    """
    for i in range(dq.shape[0]):
        Y[i, first_column + i] = dq[i]
        Y[i, first_column + dq.shape[0] + i] = np.sign(dq[i])


@compiled
def fill_regressor(
    chain: Chain, place: Indices, q: Vector, dq: Vector, ddq: Vector, scratch: Scratch, W: Vector
) -> None:
    """Write W (n, p) of tau = W theta, friction left out, in the columns of the inertial parameters.

    q, dq, ddq (n,). place (10 n,): the column of each parameter of theta_full, or NOT_USED. Cells of links before the
    joint, and other columns, stay as they are, so begin with zeros. Overwrites `scratch`.
    """
    v, a, u, w, row = scratch.v, scratch.a, scratch.u, scratch.w, scratch.row
    _place_links(chain, q, scratch.E, scratch.r)
    _move_links(chain, dq, scratch.E, scratch.r, v)
    _accelerate_links(chain, dq, ddq, scratch.E, scratch.r, v, scratch.x, a)
    for i in range(q.shape[0]):
        u[:] = 0.0
        _add_along_axis(chain, i, 1.0, u)
        for k in range(i, q.shape[0]):
            if k > i:
                _carry(scratch.E[k], scratch.r[k], u, u)
            row[:] = 0.0
            add_form(u, a[k], 1.0, row)
            _cross(v[k], u, w)
            add_form(w, v[k], -1.0, row)  # u' (v x* I v) = -(v x u)' I v
            _put(row, place, k, W[i])


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
def _put(row: Vector, place: Indices, k: int, target: Vector) -> None:
    """Write the coefficients (10,) of link k, from 0, into their columns of `target` (p,), if they have one."""
    for j in range(row.shape[0]):
        column = place[k * row.shape[0] + j]
        if column >= 0:
            target[column] = row[j]


@compiled
def _place_links(chain: Chain, q: Vector, E: Vector, r: Vector) -> None:
    """Write the pose of each link in the frame of the link before, at joint positions q (n,).

    E (n, 3, 3): rotation from that frame to the link's. r (n, 3): the link's origin in that frame, m.
    """
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


@compiled
def _move_links(chain: Chain, dq: Vector, E: Vector, r: Vector, v: Vector) -> None:
    """Write the velocity of each link, angular part first, in its own frame, to v (n, 6). E, r: of `_place_links`."""
    for i in range(dq.shape[0]):
        if i == 0:
            v[0, :] = 0.0
        else:
            _carry(E[i], r[i], v[i - 1], v[i])
        _add_along_axis(chain, i, dq[i], v[i])


@compiled
def _lift_links(chain: Chain, E: Vector, a: Vector) -> None:
    """Write to a (n, 6) the upward acceleration that stands for gravity, in each link's frame. E: of `_place_links`."""
    for i in range(E.shape[0]):
        for row in range(3):
            a[i, row] = 0.0
            a[i, 3 + row] = 0.0
            for column in range(3):
                before = -chain.gravity_m_s2[column] if i == 0 else a[i - 1, 3 + column]
                a[i, 3 + row] += E[i, row, column] * before


@compiled
def _accelerate_links(
    chain: Chain, dq: Vector, ddq: Vector, E: Vector, r: Vector, v: Vector, x: Vector, a: Vector
) -> None:
    """Write the acceleration of each link, gravity as an upward one, in its own frame, to a (n, 6).

    E, r: of `_place_links`; v: of `_move_links`; x (6,) is scratch.
    """
    for i in range(dq.shape[0]):
        if i == 0:
            for j in range(3):
                x[j] = 0.0
                x[3 + j] = -chain.gravity_m_s2[j]
        else:
            x[:] = a[i - 1]
        _carry(E[i], r[i], x, a[i])
        _add_along_axis(chain, i, ddq[i], a[i])
        x[:] = 0.0
        _add_along_axis(chain, i, dq[i], x)
        _cross(v[i], x, x)
        for j in range(6):
            a[i, j] += x[j]


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


def regressor(chain: Chain, q: Vector, dq: Vector, ddq: Vector) -> Vector:
    """Return W (n, 10 n) of tau = W theta_full, friction left out. q, dq, ddq (n,)."""
    place = all_columns(chain)
    W = np.zeros((q.shape[0], place.size))
    fill_regressor(chain, place, q, dq, ddq, new_scratch(chain), W)
    return W


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
    place: Indices  # (10 n,), the column of each parameter of theta_full in the base, or NOT_USED
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
    place = np.full(PER_LINK * n, NOT_USED, dtype=np.int64)
    place[columns] = np.arange(rank)
    names = tuple(f"{LINK_PARAMETERS[column % PER_LINK]}_{column // PER_LINK + 1}" for column in columns)
    return BaseParameters(columns, place, base_map, names)
