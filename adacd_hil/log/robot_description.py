"""The arm as a URDF of two links and a tip, made from the settings: for viewers, and for physics engines.

Frames: `base` stands still, `link1` and `link2` begin at their joints with x along the link, `tip` is at the end. Joint
axes are z. `world` carries `base` turned about x by the tilt of the plane of motion, so that y points uphill; q1 = 0 is
where `arm.mounting_deg` has it.

Masses and friction are those of the CAD model, `arm.cad_theta`, without payload. It knows inertia about the joint axes
only; about the link's own axis it is that of a bar of LINK_WIDTH_M. Without a CAD model the links have no inertia, and
a comment in the file gives the reason: an engine then refuses the file, a viewer still shows it.

The parameters of eq. (17) are lumped, in the frame of `records.PARAMETER_NAMES`; two rigid links with this motion:

    a1 - a3 = I1 + m1 c1² + m2 l1²     a2 = l1 m2 c2     a3 = I2 + m2 c2²     a4 = g (m1 c1 + m2 l1)     a5 = g m2 c2

m mass kg, c place of the centre of mass along the link m, I inertia about it kg m², l length m. All mass distributions
with these parameters give the same torque and motion. Link 2's centre of mass must lie within
l1 a2 / (a1 - a3) < c2 < l1 a3 / a2, or an inertia is negative; the geometric mean of both is taken. Link 1 is a uniform
rod, unless gravity determines its centre of mass.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Comment, Element, SubElement

import numpy as np

from adacd_hil.records import GRAVITY_M_S2, JOINT_NAMES, PARAMETER_NAMES
from adacd_hil.settings.configuration import Settings

_A1, _A2, _A3, _A4, _A5 = 0, 1, 2, 7, 8
_ROD_C, _ROD_I = 1.0 / 2.0, 1.0 / 12.0  # of a uniform rod: place of its centre and inertia about it
_AGREEMENT = 0.01
"""Largest relative difference between a5 and its value computed from a2."""


class LinkBody(NamedTuple):
    """One link's mass in kg, its centre along the link in m, inertia about it in kg m²."""

    mass_kg: float
    center_m: float
    inertia_kg_m2: float


def bodies_of(
    theta: Sequence[float], length1_m: float, gravity_m_s2: float = GRAVITY_M_S2
) -> tuple[LinkBody, LinkBody]:
    """Return two rigid links with the parameters `theta` (p,), p = 7 or with gravity 9.

    Without gravity link 1 is a uniform rod. A negative a2 counts as 0. Raises ValueError if no rigid links have them,
    or if a5 differs by more than 1 % from the value that a2 gives. theta: in the order of `records.PARAMETER_NAMES`.
    gravity_m_s2: in the plane of motion.
    """
    alpha, beta, gamma = theta[_A1] - theta[_A3], theta[_A2], theta[_A3]
    if not (gamma > 0.0 and alpha * gamma > beta * beta):
        raise ValueError(f"a1 = {theta[_A1]:g}, a2 = {beta:g}, a3 = {gamma:g} kg m² belong to no rigid links")
    if beta > 0.0:
        center2_m = length1_m * math.sqrt(gamma / alpha)
        mass2_kg = beta / (length1_m * center2_m)
    else:
        center2_m, mass2_kg = 0.0, 0.5 * alpha / length1_m**2
    second = LinkBody(mass2_kg, center2_m, gamma - mass2_kg * center2_m**2)
    left = alpha - mass2_kg * length1_m**2  # of link 1 about joint 1
    if len(theta) <= _A5:
        mass1_kg = left / ((_ROD_C**2 + _ROD_I) * length1_m**2)
        return LinkBody(mass1_kg, _ROD_C * length1_m, _ROD_I * mass1_kg * length1_m**2), second
    expected_Nm = gravity_m_s2 * mass2_kg * center2_m
    if abs(theta[_A5] - expected_Nm) > _AGREEMENT * max(expected_Nm, theta[_A5]):
        raise ValueError(f"a5 = {theta[_A5]:g} Nm, but a2 = {beta:g} kg m² makes it {expected_Nm:g} Nm")
    moment = theta[_A4] / gravity_m_s2 - mass2_kg * length1_m
    if moment == 0.0:
        return LinkBody(3.0 * left / length1_m**2, 0.0, left), second
    center1_m = math.copysign(min(_ROD_C * length1_m, 0.5 * left / abs(moment)), moment)
    return LinkBody(moment / center1_m, center1_m, left - moment * center1_m), second


WORLD, BASE, TIP = "world", "base", "tip"
LINK_NAMES = ("link1", "link2")
LINK_WIDTH_M = 0.04
_JOINT_RADIUS_M = 0.035
_TIP_RADIUS_M = 0.02
_COLORS = {"link": "0.35 0.45 0.6 1", "joint": "0.25 0.27 0.3 1"}


def robot_description(settings: Settings) -> str:
    """Return the URDF of the configured arm: lengths, limits, shapes, and the CAD model's masses and friction.

    Without a CAD model, or with one that no rigid links have, it has neither masses nor friction, but a comment with
    the reason.
    """
    arm, tilt_rad = settings.arm, settings.tilt_rad
    robot = Element("robot", name="adacd")
    bodies: tuple[LinkBody, ...] = ()
    try:
        gravity_m_s2 = GRAVITY_M_S2 * math.sin(tilt_rad)
        bodies = bodies_of(arm.cad_theta, arm.link_length_m[0], gravity_m_s2) if arm.cad_theta else ()
        reason = "arm.cad_theta is not given"
    except ValueError as error:
        reason = f"arm.cad_theta: {error}"
    if not bodies:
        robot.append(Comment(f" no inertia: {reason} "))
    for color, rgba in _COLORS.items():
        SubElement(SubElement(robot, "material", name=color), "color", rgba=rgba)
    SubElement(robot, "link", name=WORLD)
    _add_joint(robot, "mount", "fixed", WORLD, BASE, rpy=(tilt_rad, 0.0, 0.0))
    base = SubElement(robot, "link", name=BASE)
    _add_shape(base, "joint", "cylinder", radius=_JOINT_RADIUS_M, length=2.0 * LINK_WIDTH_M)
    reach_m = 0.0
    parent = BASE
    for index, (joint_name, link_name) in enumerate(zip(JOINT_NAMES, LINK_NAMES, strict=True)):
        yaw_rad = 0.0 if index else -settings.level_rad
        joint = _add_joint(robot, joint_name, "revolute", parent, link_name, x_m=reach_m, rpy=(0.0, 0.0, yaw_rad))
        SubElement(joint, "axis", xyz="0 0 1")
        limit_rad = float(arm.position_limit_rad[index])
        SubElement(
            joint,
            "limit",
            lower=_text(-limit_rad),
            upper=_text(limit_rad),
            velocity=_text(arm.velocity_limit_rad_s[index]),
            effort=_text(arm.torque_limit_Nm[index]),
        )
        if bodies:
            viscous, coulomb = (arm.cad_theta[PARAMETER_NAMES.index(f"{name}{index + 1}")] for name in ("F_v", "F_c"))
            SubElement(joint, "dynamics", damping=_text(viscous), friction=_text(coulomb))
        reach_m, parent = arm.link_length_m[index], link_name
        link = SubElement(robot, "link", name=link_name)
        if bodies:
            _add_inertia(link, bodies[index])
        size = f"{_text(reach_m)} {_text(LINK_WIDTH_M)} {_text(LINK_WIDTH_M)}"
        _add_shape(link, "link", "box", x_m=0.5 * reach_m, size=size)
        _add_shape(link, "joint", "cylinder", radius=_JOINT_RADIUS_M, length=1.5 * LINK_WIDTH_M)
    _add_joint(robot, "tip_mount", "fixed", parent, TIP, x_m=reach_m)
    _add_shape(SubElement(robot, "link", name=TIP), "joint", "sphere", radius=_TIP_RADIUS_M)
    ElementTree.indent(robot)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"


def _add_joint(
    robot: Element,
    name: str,
    kind: str,
    parent: str,
    child: str,
    x_m: float = 0.0,
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Element:
    joint = SubElement(robot, "joint", name=name, type=kind)
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    SubElement(joint, "origin", xyz=f"{_text(x_m)} 0 0", rpy=" ".join(map(_text, rpy)))
    return joint


def _add_inertia(link: Element, body: LinkBody) -> None:
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "origin", xyz=f"{_text(body.center_m)} 0 0", rpy="0 0 0")
    SubElement(inertial, "mass", value=_text(body.mass_kg))
    across = body.inertia_kg_m2
    along = min(across, body.mass_kg * LINK_WIDTH_M**2 / 6.0)  # the most that a rigid body can have
    moments = {"ixx": along, "iyy": across, "izz": across}
    SubElement(inertial, "inertia", {"ixy": "0", "ixz": "0", "iyz": "0"} | {k: _text(v) for k, v in moments.items()})


def _add_shape(link: Element, color: str, shape: str, x_m: float = 0.0, **sizes: float | str) -> None:
    visual = SubElement(link, "visual")
    SubElement(visual, "origin", xyz=f"{_text(x_m)} 0 0", rpy="0 0 0")
    SubElement(SubElement(visual, "geometry"), shape, {key: str(value) for key, value in sizes.items()})
    SubElement(visual, "material", name=color)


def _text(value: float | np.floating) -> str:
    """Return a number as text that reads back to the same value."""
    return repr(float(value))
