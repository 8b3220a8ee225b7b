"""A serial arm read from the text of a URDF: geometry, limits and the parameters that its author gave its links.

Read are link, inertial, joint, origin, parent, child, axis, limit, dynamics; the rest (shapes, transmissions) is passed
over. Links on fixed joints become part of the link that carries them, whose frame is the URDF's frame of that link.
Angles are rad, rpy as in the URDF: R = Rz(yaw) Ry(pitch) Rx(roll). Source: http://wiki.ros.org/urdf/XML.

The arm must be one chain of moving joints. A joint outside the chain, such as a finger of a gripper, is named in
`locked`: it counts as fixed at its zero. Only the data that the arm needs are checked: the place of a fixed or locked
joint, and the inertia of a link that moves, if `theta_full` needs it. A speed or effort limit of 0, and two position
limits of 0, as exporters write them, mean unlimited.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from adacd_hil.lab.serial_arm.chain import PER_LINK, Chain
from adacd_hil.records import GRAVITY_M_S2, Vector

MOVING = ("revolute", "continuous", "prismatic")
STANDARD_GRAVITY_M_S2 = (0.0, 0.0, -GRAVITY_M_S2)
LARGEST = 1e18
"""Largest number, in its unit: products of lengths, masses and speeds stay finite."""
BASE = -1
"""Index of links that do not move."""


class UrdfError(ValueError):
    """A URDF that can't be used; the message is one line that names the link, joint or attribute."""


class FramePose(NamedTuple):
    """Pose of a frame in another one: p_other = rotation @ p + translation."""

    rotation: Vector  # (3, 3)
    translation: Vector  # (3,), m

    def then(self, other: "FramePose") -> "FramePose":
        """Return the pose of a third frame in this pose's outer frame; other: its pose in this pose's own frame."""
        return FramePose(self.rotation @ other.rotation, self.translation + self.rotation @ other.translation)


@dataclass(frozen=True)
class SerialArm:
    """An arm as described by its URDF; n moving joints, from the base outward.

    Limits are infinite where the URDF has none; so are a velocity or torque limit of 0, and position limits if both are
    0.
    """

    name: str
    chain: Chain
    joint_names: tuple[str, ...]  # (n,)
    link_names: tuple[str, ...]  # (n,), the link that each joint moves
    places: dict[
        str, tuple[int, FramePose]
    ]  # of every link: the index of the joint that carries it, or BASE, and where
    position_low: Vector  # (n,), rad or m; -inf without a limit, as for each continuous joint
    position_high: Vector  # (n,)
    velocity_limit: Vector  # (n,), rad/s or m/s
    torque_limit: Vector  # (n,), Nm or N
    damping: Vector  # (n,), Nm s/rad or N s/m; 0 without <dynamics>
    friction: Vector  # (n,), Nm or N
    links: dict[str, Element]  # as the URDF has them

    @property
    def theta_full(self) -> Vector:
        """Parameters (10 n,) of the moving links, with all links that are fixed to them.

        They are zero for a link without <inertial>. Raises UrdfError for an <inertial> without mass or inertia, with a
        negative mass, or an impossible inertia.
        """
        theta = np.zeros((len(self.joint_names), PER_LINK))
        for name, (carrier, pose) in self.places.items():
            if carrier != BASE and name in self.links:
                theta[carrier] += _moved(_read_inertial(self.links[name], name), pose)
        return theta.reshape(-1)


@dataclass(frozen=True)
class _Joint:
    """One joint as the URDF has it. kind: one of `MOVING`, or "fixed", also for a locked one.

    origin: the joint's frame in the parent link's. axis (3,): unit vector in the joint's frame. numbers: limits and
    dynamics in the order of `SerialArm`: low, high, velocity, torque, damping, friction. A fixed joint has placeholders
    for axis and numbers.
    """

    name: str
    kind: str
    parent: str
    child: str
    origin: FramePose
    axis: Vector
    numbers: tuple[float, ...]


def read_urdf(
    text: str | bytes,
    gravity_m_s2: tuple[float, float, float] = STANDARD_GRAVITY_M_S2,
    locked: Collection[str] = (),
) -> SerialArm:
    """Read a serial arm from the text of a URDF.

    gravity_m_s2: in the frame of the root link. locked: names of joints that count as fixed at their zero, with those
    that mimic them. Raises UrdfError if the text is no URDF, a locked joint does not exist, or a joint that isn't
    locked mimics another. Raises UrdfError, too, if a value is missing or impossible, no joint moves, or the moving
    joints are no single chain.
    """
    try:
        robot = ElementTree.fromstring(text)
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # the latter two: an encoding that is unknown
        raise UrdfError(f"not XML: {error}") from error
    if robot.tag != "robot":
        raise UrdfError(f"the outermost element is <{robot.tag}>, not <robot>")
    if left := [element.tag for element in robot.iter() if "/xacro}" in str(element.tag)]:
        raise UrdfError(f"<xacro:{left[0].rpartition('}')[2]}> is in it: let xacro make the URDF of it")
    links, named = _named(robot, "link"), _named(robot, "joint")
    unknown = [name for name in locked if name not in named]
    if unknown:
        raise UrdfError(f'no joint "{unknown[0]}" to be locked')
    held = _held(named, locked)
    joints = [_read_joint(element, name, links, name in held) for name, element in named.items()]
    return _assemble(robot.get("name", ""), links, joints, gravity_m_s2)


def _held(joints: dict[str, Element], locked: Collection[str]) -> set[str]:
    """Return the names of the locked joints, and of those that mimic them, directly or through others."""
    held = set(locked)
    leaders = {name: mimic.get("joint") for name, joint in joints.items() if (mimic := joint.find("mimic")) is not None}
    while following := {name for name, leader in leaders.items() if leader in held} - held:
        held |= following
    return held


def _assemble(
    name: str, links: dict[str, Element], joints: list[_Joint], gravity_m_s2: tuple[float, float, float]
) -> SerialArm:
    """Return the arm: walk from the root outward, and merge the links that are fixed to each other.

    Other root links without joint and <inertial> are ignored. Raises UrdfError if there isn't one root, a link has two
    parents, the joints branch or are a loop, or none moves.
    """
    children: dict[str, list[_Joint]] = {link: [] for link in (*links, *(joint.parent for joint in joints))}
    carried: set[str] = set()
    for joint in joints:
        if joint.child in carried:
            raise UrdfError(f'link "{joint.child}" is the child of more than one joint')
        carried.add(joint.child)
        children[joint.parent].append(joint)
    roots = [link for link in children if link not in carried]
    for link in roots[:]:
        if joints and not children[link] and _only(links[link], "inertial", f'link "{link}"') is None:
            roots.remove(link)  # a frame without a body or a joint
    unknown = [link for link in roots if link not in links]
    if unknown and len(roots) > 1:
        raise UrdfError(f'link "{unknown[0]}", the parent of joint "{children[unknown[0]][0].name}", does not exist')
    if len(roots) != 1:
        raise UrdfError("no root: the joints are a loop" if not roots else f"more than one root link: {_list(roots)}")
    moving: list[_Joint] = []
    placed: list[FramePose] = []
    places: dict[str, tuple[int, FramePose]] = {}
    outward = _merge(roots[0], BASE, children, places)
    while outward:
        if len(outward) > 1:
            raise UrdfError(
                f"the arm branches: joints {_list([joint.name for joint in outward])} move on the same link; "
                "lock those that are no part of it"
            )
        joint = outward[0]
        moving.append(joint)
        placed.append(places[joint.parent][1].then(joint.origin))
        outward = _merge(joint.child, len(moving) - 1, children, places)
    lost = [link for link in children if link in carried and link not in places]
    if lost:
        raise UrdfError(f'link "{lost[0]}" hangs on a loop, not on the root')
    if not moving:
        raise UrdfError("no joint moves")
    chain = Chain(
        np.array([pose.rotation for pose in placed]),
        np.array([pose.translation for pose in placed]),
        np.array([joint.axis for joint in moving]),
        np.array([float(joint.kind == "prismatic") for joint in moving]),
        np.array(gravity_m_s2, dtype=np.float64),
    )
    low, high, velocity, torque, damping, friction = np.array([joint.numbers for joint in moving]).T
    return SerialArm(
        name,
        chain,
        tuple(joint.name for joint in moving),
        tuple(joint.child for joint in moving),
        places,
        low,
        high,
        velocity,
        torque,
        damping,
        friction,
        links,
    )


def _merge(
    link: str,
    index: int,
    children: dict[str, list[_Joint]],
    places: dict[str, tuple[int, FramePose]],
) -> list[_Joint]:
    """Add `link`, and all links on fixed joints behind it, to `places`; return the joints that move on them.

    index: of the joint that carries these links, or BASE. A pose in `places` is in the frame of `link`. children:
    joints by their parent link.
    """
    outward = []
    places[link] = (index, FramePose(np.eye(3), np.zeros(3)))
    waiting = [link]
    while waiting:
        at = waiting.pop()
        for joint in children[at]:
            if joint.kind == "fixed":
                places[joint.child] = (index, places[at][1].then(joint.origin))
                waiting.append(joint.child)
            else:
                outward.append(joint)
    return outward


def _moved(parameters: Vector, pose: FramePose) -> Vector:
    """Return the parameters (10,) of a body in another frame; pose: of the body's frame in that one."""
    mass, moment, inertia = parameters[0], parameters[1:4], symmetric(parameters[4:])
    at, turned = pose.translation, pose.rotation @ moment
    about = pose.rotation @ inertia @ pose.rotation.T
    about += 2.0 * (at @ turned) * np.eye(3) - np.outer(at, turned) - np.outer(turned, at)
    about += mass * ((at @ at) * np.eye(3) - np.outer(at, at))
    return np.concatenate([[mass], turned + mass * at, about[np.tril_indices(3)]])


def symmetric(six: Vector) -> Vector:
    """Return the symmetric matrix (3, 3) of its elements (xx, xy, yy, xz, yz, zz)."""
    return np.asarray(six[np.array([[0, 1, 3], [1, 2, 4], [3, 4, 5]])])


def _read_inertial(link: Element, name: str) -> Vector:
    """Return the parameters (10,) of a link in its own frame; zeros for a link without <inertial>.

    Raises UrdfError if mass or inertia are missing, no number or impossible.
    """
    where = f'link "{name}"'
    inertial = _only(link, "inertial", where)
    if inertial is None:
        return np.zeros(PER_LINK)
    mass_element, inertia_element = _only(inertial, "mass", where), _only(inertial, "inertia", where)
    if mass_element is None or inertia_element is None:
        raise UrdfError(f"{where}: <inertial> needs <mass> and <inertia>")
    mass = _number(mass_element, "value", where)
    six = np.array([_number(inertia_element, key, where) for key in ("ixx", "ixy", "iyy", "ixz", "iyz", "izz")])
    if mass < 0.0:
        raise UrdfError(f"{where}: mass {mass:g} kg is negative")
    if np.min(np.linalg.eigvalsh(symmetric(six))) < -1e-12 * np.max(np.abs(six)):
        raise UrdfError(f"{where}: the inertia is not positive semidefinite")
    about_mass_centre = np.concatenate([[mass, 0.0, 0.0, 0.0], six])
    return _moved(about_mass_centre, _read_origin(inertial, where))


def _read_joint(joint: Element, name: str, links: Collection[str], is_locked: bool) -> _Joint:
    """Return one joint; of a fixed or, by `is_locked`, locked one only its place. links: names of all links.

    The axis is x without <axis>. A limit of speed or effort of 0 is none, and so are limits of position that are both
    0, or of a continuous joint. Raises UrdfError for an unknown type or child link, a missing parent or child, a mimic
    that isn't locked, or a value that is no number or impossible.
    """
    where = f'joint "{name}"'
    kind = "fixed" if is_locked else joint.get("type", "")
    if kind != "fixed" and kind not in MOVING:
        raise UrdfError(f'{where}: type "{kind}" is not one of {_list([*MOVING, "fixed"])}, nor is it locked')
    ends = []
    for tag in ("parent", "child"):
        end = _only(joint, tag, where)
        link = end.get("link") if end is not None else None
        if link is None:
            raise UrdfError(f'{where}: no <{tag} link="...">')
        if tag == "child" and link not in links:  # a parent without <link> may be the world
            raise UrdfError(f'{where}: {tag} link "{link}" does not exist')
        ends.append(link)
    origin = _read_origin(joint, where)
    if kind == "fixed":
        return _Joint(name, kind, ends[0], ends[1], origin, np.zeros(3), ())
    if _only(joint, "mimic", where) is not None:
        raise UrdfError(f"{where}: <mimic> is not supported; lock the joint if it is no part of the arm")
    axis_element, limit = _only(joint, "axis", where), _only(joint, "limit", where)
    axis = np.array([1.0, 0.0, 0.0]) if axis_element is None else _numbers(axis_element, "xyz", where)
    length = float(np.linalg.norm(axis))
    if length < 1e-6:
        raise UrdfError(f"{where}: the axis is zero")
    low, high, velocity, effort = -math.inf, math.inf, math.inf, math.inf
    if limit is not None:
        if kind != "continuous":
            low, high = _number(limit, "lower", where, 0.0), _number(limit, "upper", where, 0.0)
            low, high = (low, high) if low or high else (-math.inf, math.inf)
        velocity, effort = (_number(limit, key, where, 0.0) or math.inf for key in ("velocity", "effort"))
    if min(velocity, effort) < 0.0:
        raise UrdfError(f"{where}: <limit> velocity {velocity:g}, effort {effort:g}: neither may be negative")
    if low > high:
        raise UrdfError(f"{where}: lower limit {low:g} is above the upper {high:g}")
    dynamics = _only(joint, "dynamics", where)
    damping, friction = (
        0.0 if dynamics is None else _number(dynamics, key, where, 0.0) for key in ("damping", "friction")
    )
    if min(damping, friction) < 0.0:
        raise UrdfError(f"{where}: <dynamics> damping {damping:g}, friction {friction:g}: neither may be negative")
    numbers = low, high, velocity, effort, damping, friction
    return _Joint(name, kind, ends[0], ends[1], origin, axis / length, numbers)


def _read_origin(element: Element, where: str) -> FramePose:
    """Return <origin> as a pose, the identity if it is missing.

    Raises UrdfError for two of them, or a value that is no finite number. where: the element's name in errors.
    """
    origin = _only(element, "origin", where)
    if origin is None:
        return FramePose(np.eye(3), np.zeros(3))
    from scipy.spatial.transform import Rotation  # takes 0.2 s to load

    xyz, rpy = _numbers(origin, "xyz", where, 0.0), _numbers(origin, "rpy", where, 0.0)
    return FramePose(Rotation.from_euler("xyz", rpy).as_matrix(), xyz)


def _named(robot: Element, tag: str) -> dict[str, Element]:
    """Return the elements of one kind, "link" or "joint", by name.

    Raises UrdfError for one without a name, two with the same name, or no link at all.
    """
    found: dict[str, Element] = {}
    for element in robot.findall(tag):
        name = element.get("name")
        if not name:
            raise UrdfError(f"a <{tag}> has no name")
        if name in found:
            raise UrdfError(f'{tag} "{name}" is there twice')
        found[name] = element
    if tag == "link" and not found:
        raise UrdfError("no <link>")
    return found


def _only(element: Element, tag: str, where: str) -> Element | None:
    """Return the one child element of a kind, None without one. Raises UrdfError for more; where: name in errors."""
    found = element.findall(tag)
    if len(found) > 1:
        raise UrdfError(f"{where}: more than one <{tag}>")
    return found[0] if found else None


def _number(element: Element, key: str, where: str, default: float | None = None) -> float:
    """Return an attribute as a finite number, `default` if it is missing.

    Raises UrdfError if it is no such number, its size is above LARGEST, or it is missing without a default. where: name
    in errors.
    """
    text = element.get(key)
    if text is None:
        if default is None:
            raise UrdfError(f'{where}: <{element.tag}> has no attribute "{key}"')
        return default
    return _parse(text, f'{where}: <{element.tag} {key}="{text}">')


def _numbers(element: Element, key: str, where: str, default: float | None = None) -> Vector:
    """Return an attribute as three finite numbers (3,); three times `default` if it is missing.

    Raises UrdfError if it isn't three such numbers, the size of one is above LARGEST, or it is missing without a
    default. where: name in errors.
    """
    text = element.get(key)
    if text is None:
        return np.full(3, _number(element, key, where, default))
    named = f'{where}: <{element.tag} {key}="{text}">'
    words = text.split()
    if len(words) != 3:
        raise UrdfError(f"{named} has {len(words)} numbers, not 3")
    return np.array([_parse(word, named) for word in words])


def _parse(word: str, where: str) -> float:
    """Return a word as a number from -LARGEST to LARGEST. Raises UrdfError if it isn't one; where: name in errors."""
    try:
        value = float(word)
    except ValueError:
        raise UrdfError(f'{where}: "{word}" is not a number') from None
    if not math.isfinite(value):
        raise UrdfError(f"{where}: {word} is not finite")
    if abs(value) > LARGEST:
        raise UrdfError(f"{where}: {word} is more than {LARGEST:g}")
    return value


def _list(names: list[str]) -> str:
    """Return names in quotes, joined by commas."""
    return ", ".join(f'"{name}"' for name in names)
