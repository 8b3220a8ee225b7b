"""Two rigid links as a description gives them: a URDF of two joints, or lengths and masses.

The parameters are those of the host's model, in the order of `records.PARAMETER_NAMES`: with link i of mass m_i, its
centre of mass c_i from joint i on the line of the link and the inertia I_i about it,

    a1 = I₁ + m₁ c₁² + m₂ l₁² + a3    a2 = m₂ l₁ c₂    a3 = I₂ + m₂ c₂²        kg m²
    a4 = g (m₁ c₁ + m₂ l₁)            a5 = g m₂ c₂                             Nm, where the axes are not vertical

Friction is not known from a description; it is 0.
"""

import math
from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from adacd_hil.records import JOINTS, Vector
from adacd_hil.scheme.model.chain import PER_LINK
from adacd_hil.scheme.model.urdf import BASE, SerialArm, UrdfError, read_urdf

STANDARD_GRAVITY_M_S2 = 9.80665
Pair = tuple[float, float]
_PARALLEL = math.cos(math.radians(2.0))
"""Least |cosine| between axes that count as parallel, and with the vertical for one that counts as vertical."""
_BENT_RAD = math.radians(5.0)
"""From here on the zero of joint 2 is not that of a stretched arm."""


class PlanarArm(NamedTuple):
    """What a description says of an arm with two parallel axes.

    cad_theta: parameters, empty where the masses are not known. The rest: None where nothing is said of it.
    doubts: what the model can't have as the description says, a line each.
    """

    link_length_m: Pair
    cad_theta: tuple[float, ...]
    is_upright: bool
    position_limit_deg: Pair | None = None
    velocity_limit_deg_s: Pair | None = None
    effort_Nm: Pair | None = None
    doubts: tuple[str, ...] = ()
    is_tip_known: bool = True


def uniform_rods(link_length_m: Pair, mass_kg: Pair, is_upright: bool) -> PlanarArm:
    """Describe an arm of two uniform rods: centre of mass in the middle, inertia m l² / 12 about it."""
    (l1, l2), (m1, m2) = link_length_m, mass_kg
    a3 = m2 * l2**2 / 3.0
    theta = [m1 * l1**2 / 3.0 + m2 * l1**2 + a3, m2 * l1 * l2 / 2.0, a3, 0.0, 0.0, 0.0, 0.0]
    if is_upright:
        theta += [STANDARD_GRAVITY_M_S2 * (m1 * l1 / 2.0 + m2 * l1), STANDARD_GRAVITY_M_S2 * m2 * l2 / 2.0]
    return PlanarArm(link_length_m, _rounded(theta), is_upright)


def planar_from_urdf(text: bytes, locked: Collection[str] = ()) -> PlanarArm:
    """Read an arm of two turning joints with parallel axes. Raises UrdfError for any other."""
    arm = read_urdf(text, locked=locked)
    count = len(arm.joint_names)
    if count != JOINTS:
        names = ", ".join(arm.joint_names)
        remedy = "; name those that stay where they are with --lock" if count > JOINTS else ""
        raise UrdfError(f"{count} joints move ({names}), an arm has {JOINTS} here{remedy}")
    chain = arm.chain
    if np.any(chain.is_prismatic):
        raise UrdfError("a joint slides; both must turn")
    turned = chain.rotation[1] @ chain.axis[1]  # in link 1's frame
    cosine = float(chain.axis[0] @ turned)
    if abs(cosine) < _PARALLEL:
        raise UrdfError(f"the axes are {math.degrees(math.acos(min(abs(cosine), 1.0))):.0f} deg apart, not parallel")
    doubts = []
    if cosine < 0.0:
        doubts.append("joint 2 turns the other way than joint 1: its `arm.sign` is -1 if its drive does so, too")
    offset = chain.translation[1]
    across = offset - (offset @ chain.axis[0]) * chain.axis[0]
    l1 = float(np.linalg.norm(across))
    if l1 < 1e-3:
        raise UrdfError("the two axes are the same line")
    first, second = arm.theta_full.reshape(JOINTS, PER_LINK)
    moment = second[1:4] - (second[1:4] @ chain.axis[1]) * chain.axis[1]  # kg m, in link 2's frame
    l2 = _reach(arm)
    is_tip_known = l2 > 1e-3
    if not is_tip_known:
        l2 = 2.0 * float(np.linalg.norm(moment)) / second[0] if second[0] > 0.0 and np.any(moment) else l1
    vertical = abs(float((chain.rotation[0] @ chain.axis[0])[2]))
    is_upright = vertical < _PARALLEL
    if is_upright and vertical > math.sin(math.radians(2.0)):
        doubts.append("the axes are neither vertical nor horizontal: gravity's part is smaller than with `gravity`")
    theta: list[float] = []
    if first[0] > 0.0 and second[0] > 0.0:
        inertia = [_about(link, axis) for link, axis in zip((first, second), chain.axis, strict=True)]
        along = across / l1
        across_2 = chain.rotation[1] @ moment
        bent_rad = math.atan2(float(np.linalg.norm(np.cross(along, across_2))), float(along @ across_2))
        if np.linalg.norm(moment) > 1e-6 and bent_rad > _BENT_RAD:
            doubts.append(
                f"at q2 = 0 the centre of mass of link 2 is {math.degrees(bent_rad):.0f} deg off the line of link 1; "
                "the model wants the drives' zero where the arm is stretched"
            )
        turn = float(np.linalg.norm(moment))
        theta = [inertia[0] + second[0] * l1**2 + inertia[1], l1 * turn, inertia[1], 0.0, 0.0, 0.0, 0.0]
        if is_upright:
            along_1 = first[1:4] - (first[1:4] @ chain.axis[0]) * chain.axis[0]
            share = STANDARD_GRAVITY_M_S2 * math.sqrt(max(1.0 - vertical**2, 0.0))
            theta += [share * (float(np.linalg.norm(along_1)) + second[0] * l1), share * turn]
    return PlanarArm(
        (_short(l1), _short(l2)),
        _rounded(theta),
        is_upright,
        _position_limits(arm),
        _in_degrees(arm.velocity_limit),
        (float(arm.torque_limit[0]), float(arm.torque_limit[1])) if np.all(np.isfinite(arm.torque_limit)) else None,
        tuple(doubts),
        is_tip_known,
    )


def _reach(arm: SerialArm) -> float:
    """Return how far the farthest frame on link 2 is from its axis, m."""
    axis = arm.chain.axis[1]
    far = [0.0]
    for carrier, pose in arm.places.values():
        if carrier == JOINTS - 1 and carrier != BASE:
            far.append(float(np.linalg.norm(pose.translation - (pose.translation @ axis) * axis)))
    return max(far)


def _about(link: Vector, axis: Vector) -> float:
    """Return the inertia of a link about its joint's axis, kg m²."""
    xx, xy, yy, xz, yz, zz = link[4:]
    return float(axis @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ axis)


def _position_limits(arm: SerialArm) -> Pair | None:
    """Return the largest |q| that is within the limits on both sides, deg; None where a joint has none."""
    largest = np.minimum(-arm.position_low, arm.position_high)
    if not np.all(np.isfinite(largest)):
        return None
    if np.any(largest <= 0.0):
        joint = int(np.argmax(largest <= 0.0))
        raise UrdfError(f'joint "{arm.joint_names[joint]}": 0 is not within its limits; set the zero between them')
    return _in_degrees(largest)


def _in_degrees(values: Vector) -> Pair | None:
    if not np.all(np.isfinite(values)):
        return None
    first, second = np.degrees(values)
    return round(float(first), 2), round(float(second), 2)


def _short(value: float) -> float:
    return float(f"{value:.6g}")


def _rounded(values: list[float]) -> tuple[float, ...]:
    return tuple(map(_short, values))
