"""The arm as a URDF of two links and a tip, made from the settings: for viewers, and for physics engines.

Frames: `base` stands still, `link1` and `link2` begin at their joints with x along the link, `tip` is at the end. Joint
axes are z. Where gravity acts on the joints the plane of motion is upright: `world` carries `base` with y up.

Masses and friction are those of the CAD model, `arm.cad_theta`, without payload. It knows inertia about the joint axes
only; about the link's own axis it is that of a bar of LINK_WIDTH_M. Without a CAD model the links have no inertia, and
a comment says so: an engine then refuses the file, a viewer doesn't mind.
"""

import math
from xml.etree import ElementTree
from xml.etree.ElementTree import Comment, Element, SubElement

import numpy as np

from adacd_hil.log.live.link_bodies import LinkBody, ModelError, find_bodies
from adacd_hil.records import JOINT_NAMES, PARAMETER_NAMES
from adacd_hil.settings.configuration import Settings

ROBOT_NAME = "robot.urdf"
WORLD, BASE, TIP = "world", "base", "tip"
LINK_NAMES = ("link1", "link2")
LINK_WIDTH_M = 0.04
_JOINT_RADIUS_M = 0.035
_TIP_RADIUS_M = 0.02
_COLORS = {"link": "0.35 0.45 0.6 1", "joint": "0.25 0.27 0.3 1"}


def robot_description(settings: Settings) -> str:
    """Write the URDF of the configured arm: lengths, limits, shapes, and the CAD model's masses and friction."""
    arm = settings.arm
    robot = Element("robot", name="adacd")
    bodies: tuple[LinkBody, ...] = ()
    try:
        bodies = find_bodies(arm.cad_theta, arm.link_length_m[0]) if arm.cad_theta else ()
        reason = "arm.cad_theta is not given"
    except ModelError as error:
        reason = f"arm.cad_theta: {error}"
    if not bodies:
        robot.append(Comment(f" no inertia: {reason} "))
    for color, rgba in _COLORS.items():
        SubElement(SubElement(robot, "material", name=color), "color", rgba=rgba)
    SubElement(robot, "link", name=WORLD)
    _add_joint(robot, "mount", "fixed", WORLD, BASE, roll_rad=mount_roll_rad(settings.estimator.gravity))
    base = SubElement(robot, "link", name=BASE)
    _add_shape(base, "joint", "cylinder", radius=_JOINT_RADIUS_M, length=2.0 * LINK_WIDTH_M)
    reach_m = 0.0
    parent = BASE
    for index, (joint_name, link_name) in enumerate(zip(JOINT_NAMES, LINK_NAMES, strict=True)):
        joint = _add_joint(robot, joint_name, "revolute", parent, link_name, x_m=reach_m)
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


def mount_roll_rad(is_upright: bool) -> float:
    """Return how far `base` is turned about the x axis of `world`."""
    return 0.5 * math.pi if is_upright else 0.0


def _add_joint(
    robot: Element, name: str, kind: str, parent: str, child: str, x_m: float = 0.0, roll_rad: float = 0.0
) -> Element:
    joint = SubElement(robot, "joint", name=name, type=kind)
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    SubElement(joint, "origin", xyz=f"{_text(x_m)} 0 0", rpy=f"{_text(roll_rad)} 0 0")
    return joint


def _add_inertia(link: Element, body: LinkBody) -> None:
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "origin", xyz=f"{_text(body.center_m)} 0 0", rpy="0 0 0")
    SubElement(inertial, "mass", value=_text(body.mass_kg))
    across = body.inertia_kg_m2
    along = min(across, body.mass_kg * LINK_WIDTH_M**2 / 6.0)  # any more would be more than a rigid body can have
    moments = {"ixx": along, "iyy": across, "izz": across}
    SubElement(inertial, "inertia", {"ixy": "0", "ixz": "0", "iyz": "0"} | {k: _text(v) for k, v in moments.items()})


def _add_shape(link: Element, color: str, shape: str, x_m: float = 0.0, **sizes: float | str) -> None:
    visual = SubElement(link, "visual")
    SubElement(visual, "origin", xyz=f"{_text(x_m)} 0 0", rpy="0 0 0")
    SubElement(SubElement(visual, "geometry"), shape, {key: str(value) for key, value in sizes.items()})
    SubElement(visual, "material", name=color)


def _text(value: float | np.floating) -> str:
    """Write a number so that it is read back the same."""
    return repr(float(value))
