"""The bound on the torque by place that a fit may find.

Its columns (`regressor`) are in the model only if `arm.position_torque_Nm` gives the arm such a torque, and its bound.
A hand's spring held from before the start looks the same, and so does a lean to some extent: over a short way a cosine
is a constant. So a fit gets no certificate while its torque by place exceeds the bound anywhere on its own samples.
That torque is judged with the joint's offset moved to its anchor, and with the changes that follow from the belief's
covariance. If the model has no such columns, `missing_torque` detects whether it needs them.

Shapes: by_place_Nm (n,): the largest torque by place of the fit.
"""

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from adacd_hil.scheme.identify import anchor
from adacd_hil.scheme.memory import Constants, Memory

LARGEST_OF_STD = 2.5
"""The largest torque by place, as a multiple of each coefficient's expected standard deviation."""


@compiled
def is_bounded(k: Constants, m: Memory) -> bool:
    """Return whether the fit's torque by place is at most `arm.position_torque_Nm` in each joint; fill `by_place_Nm`.

    Torque by place: it depends on the joint's position. True, without filling, for a model without such a torque.
    """
    if not k.position_torque_Nm:
        return True
    is_bounded = True
    for i in range(m.place_bound.by_place_Nm.shape[0]):
        m.place_bound.by_place_Nm[i] = _largest_Nm(k, m, i)
        is_bounded = is_bounded and m.place_bound.by_place_Nm[i] <= k.position_torque_Nm
    return bool(is_bounded)


@compiled
def _largest_Nm(k: Constants, m: Memory, joint: int) -> float:
    """Return a joint's largest torque by place, Nm, over the fit's samples, with its offset moved to the anchor."""
    joints, first = m.place_bound.by_place_Nm.shape[0], int(k.first_position)
    offset, largest = int(k.first_offset) + joint, 0.0
    P, theta = m.models.P_belief, m.models.belief
    off = anchor.innovation(k, m, joint)
    for s in range(int(m.fit_check.samples_kept)):
        torque = 0.0
        for term in range(m.regressor.X.shape[1]):
            j = first + term * joints + joint
            torque += m.fit_check.samples_W[s, joint, j] * (theta[j] - P[j, offset] * off)
        largest = max(largest, abs(torque))
    return float(largest)


def describe(k: Constants, m: Memory) -> str:
    """Return "; ", each joint's last checked torque by place, and its bound, as text; "" for a model without one."""
    if not k.position_torque_Nm:
        return ""
    largest, limit = _by_joint(m.place_bound.by_place_Nm), float(k.position_torque_Nm)
    return f"; torque by place up to {largest}, believed up to {limit:g} Nm"


def describe_refused(k: Constants, m: Memory) -> list[str]:
    """Return a line for each joint whose last checked torque by place is over `arm.position_torque_Nm`, with it.

    Torque by place: it depends on the joint's position. [] if all joints keep to the bound.
    """
    limit = float(k.position_torque_Nm)
    return [
        f"joint {i + 1} has a torque of up to {torque:.3f} Nm that depends on where the arm is, bound {limit:g} Nm"
        for i, torque in enumerate(m.place_bound.by_place_Nm.tolist())
        if not torque <= limit
    ]


def _by_joint(values: Vector) -> str:
    return ", ".join(f"{value:.3f} Nm (joint {i + 1})" for i, value in enumerate(values.tolist()))
