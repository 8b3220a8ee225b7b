"""Torque by place: one that depends on where the arm is, as of a cable, a hose, or a base that is not level.

Per joint i six columns, Nm each: sin q_i, cos q_i, sin 2q_i, cos 2q_i, sin Q, cos Q, Q the sum of all q. The last two
are gravity on the last link of a tilted base; on the links before it are among the first two. X (n, PLACE_TERMS).
"""

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import POSITION_TERMS, Vector

PLACE_TERMS = len(POSITION_TERMS)


@compiled
def fill_position(q: Vector, X: Vector) -> None:
    """Fill X (n, PLACE_TERMS) with the columns of torque by position at q (n,), in the order of `POSITION_TERMS`."""
    total = np.sum(q)
    sin_sum, cos_sum = np.sin(total), np.cos(total)
    for i in range(q.shape[0]):
        s, c = np.sin(q[i]), np.cos(q[i])
        X[i, 0], X[i, 1] = s, c
        X[i, 2], X[i, 3] = 2.0 * s * c, c * c - s * s
        X[i, 4], X[i, 5] = sin_sum, cos_sum


@compiled
def put_position_columns(X: Vector, first_column: int, Y_h: Vector) -> None:
    """Write X (n, PLACE_TERMS) into Y_h (n, p) from `first_column` on, by term and then by joint.

    Only the cells of a joint's own columns are written.
    """
    joints = X.shape[0]
    for i in range(joints):
        for term in range(PLACE_TERMS):
            Y_h[i, first_column + term * joints + i] = X[i, term]
