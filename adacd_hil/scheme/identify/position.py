"""Torque that depends on where the arm is, as of a cable, a hose, or a base that is not level.

Per joint i six columns, Nm each: sin q_i, cos q_i, sin 2q_i, cos 2q_i, sin Q, cos Q, Q the sum of all q. The last two
are gravity on the last link of a tilted base; on the links before it is among the first two.

They are in the model only where `arm.position_torque_Nm` says that the arm has such a torque, and how much at most. A
hand's spring that is held from before the start looks the same, and so does a lean to some extent: over a short way a
cosine is a constant. So a fit gets no certificate while the torque that it gives to its place is more than that
anywhere on its own samples. The torque is what stays of it when the joint's offset is put where its anchor says, with
what goes with it by the belief's covariance. Where the model has no such columns `missing_torque` tells whether it
should.

Shapes: q (n,), X (n, TERMS), by_place_Nm (n,): the largest torque by place of the fit.
"""

from typing import Any

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, POSITION_TERMS, Vector
from adacd_hil.scheme.identify import anchor

TERMS = len(POSITION_TERMS)
LARGEST_OF_STD = 2.5
"""The largest torque, over the standard deviation that each coefficient is expected to have."""


def shapes_of() -> dict[str, tuple[int, ...]]:
    """Return the shapes of what is remembered, by name."""
    return {"by_place_Nm": (JOINTS,)}


@compiled
def fill(q: Vector, X: Vector) -> None:
    """Fill X (n, TERMS) with the columns at q (n,), in the order of `POSITION_TERMS`."""
    total = np.sum(q)
    sin_sum, cos_sum = np.sin(total), np.cos(total)
    for i in range(q.shape[0]):
        s, c = np.sin(q[i]), np.cos(q[i])
        X[i, 0], X[i, 1] = s, c
        X[i, 2], X[i, 3] = 2.0 * s * c, c * c - s * s
        X[i, 4], X[i, 5] = sin_sum, cos_sum


@compiled
def put_columns(X: Vector, first_column: int, Y_h: Vector) -> None:
    """Put X (n, TERMS) into Y_h (n, p) from `first_column` on, by term and then by joint."""
    joints = X.shape[0]
    for i in range(joints):
        for term in range(TERMS):
            Y_h[i, first_column + term * joints + i] = X[i, term]


@compiled
def is_bounded(k: Any, m: Any) -> bool:
    """Tell whether the fit's torque by place keeps to `arm.position_torque_Nm`; fill `by_place_Nm`."""
    if k["position_torque_Nm"] == 0.0:
        return True
    is_bounded = True
    for i in range(m["by_place_Nm"].shape[0]):
        m["by_place_Nm"][i] = _largest_Nm(k, m, i)
        is_bounded = is_bounded and m["by_place_Nm"][i] <= k["position_torque_Nm"]
    return bool(is_bounded)


@compiled
def _largest_Nm(k: Any, m: Any, joint: int) -> float:
    """Return the largest torque by place of a joint over the fit's samples, its offset where the anchor says."""
    joints, first = m["by_place_Nm"].shape[0], int(k["first_position"])
    offset, largest = int(k["base"]) + joint, 0.0
    P, theta = m["P_belief"], m["belief"]
    innovation = anchor.innovation(k, m, joint, theta[offset], P[offset, offset])
    for s in range(int(m["samples_kept"])):
        torque = 0.0
        for term in range(TERMS):
            j = first + term * joints + joint
            torque += m["samples_W"][s, joint, j] * (theta[j] - P[j, offset] * innovation)
        largest = max(largest, abs(torque))
    return float(largest)


def describe(k: Any, m: Any) -> str:
    """Say how much of a torque by place the certified model has, Nm; empty where it has none."""
    if k["position_torque_Nm"] == 0.0:
        return ""
    return (
        f"; torque by place up to {_by_joint(m['by_place_Nm'])}, believed up to {float(k['position_torque_Nm']):g} Nm"
    )


def describe_refused(k: Any, m: Any) -> list[str]:
    """Say of each joint whose torque by place is too large how large it is, a line each."""
    limit = float(k["position_torque_Nm"])
    return [
        f"joint {i + 1} has a torque of up to {torque:.3f} Nm that depends on where the arm is, bound {limit:g} Nm"
        for i, torque in enumerate(m["by_place_Nm"].tolist())
        if not torque <= limit
    ]


def _by_joint(values: Vector) -> str:
    return ", ".join(f"{value:.3f} Nm (joint {i + 1})" for i, value in enumerate(values.tolist()))
