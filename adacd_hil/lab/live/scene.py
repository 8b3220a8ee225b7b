"""The arm and its contacts as viewers draw them in 3-D: TFMessage, SceneUpdate, and their types.

Unlike the log's types these hold lists and texts of any length, so a payload is put together field by field. Of a
scene's primitives only arrows, spheres and texts are filled; lists of the others are empty, as the type demands.
"""

import math
import struct
from typing import Any, NamedTuple

import numpy as np

from adacd_hil.log.robot_description import BASE, LINK_NAMES, TIP, WORLD
from adacd_hil.log.types.message_types import ENCAPSULATION, MessageType, foreign_type
from adacd_hil.records import JOINT_NAMES, JOINTS, ContactLevel, ContactReport, Location, SchemeState, Vector

TRANSFORMS_TOPIC, DESCRIPTION_TOPIC = "/tf", "/robot_description"
"""Topics that only the live view has; each viewer gets the last once, when it subscribes."""
Point = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Color = tuple[float, float, float, float]
"""Red, green, blue, opacity, each 0 to 1."""
ORIGIN: Point = (0.0, 0.0, 0.0)
UPRIGHT: Quaternion = (0.0, 0.0, 0.0, 1.0)


STRING = MessageType("std_msgs/msg/String", "string data\n")
TRANSFORMS = foreign_type("tf2_msgs/msg/TFMessage")
SCENE = foreign_type("foxglove_msgs/msg/SceneUpdate")


Transform = tuple[str, str, Point, Quaternion]
"""Pose of a frame in another: names of that other one and of the frame, translation, rotation."""
Arrow = tuple[Point, Quaternion, float, Color]
"""Tail, rotation from +x, length in m, colour."""
Sphere = tuple[float, Color]
"""Diameter in m and colour; the frame's origin is its centre."""
Label = tuple[Point, str, float, Color]
"""Centre, text, height in m and colour of a text that always faces the viewer."""


class Entity(NamedTuple):
    """Shapes that move with the coordinate frame `frame`; they replace the entity of the same name.

    `lifetime_ns`: how long they are shown; 0: until they are replaced.
    """

    name: str
    frame: str
    arrows: tuple[Arrow, ...] = ()
    spheres: tuple[Sphere, ...] = ()
    labels: tuple[Label, ...] = ()
    lifetime_ns: int = 0


class _Payload:
    """A `cdr` payload that is put together field by field."""

    def __init__(self) -> None:
        self._data = bytearray()

    def put(self, code: str, *values: float) -> None:
        """Append numbers of one type, aligned to its size; code: the type's letter in `struct`."""
        size = struct.calcsize(code)
        self._data += bytes(-len(self._data) % size)
        self._data += struct.pack(f"<{len(values)}{code}", *values)

    def time(self, t_ns: int) -> None:
        """Append a time or a duration, ns, as seconds and nanoseconds."""
        self.put("I", *divmod(t_ns, 1_000_000_000))

    def text(self, text: str) -> None:
        """Append a string."""
        encoded = text.encode() + b"\0"
        self.put("I", len(encoded))
        self._data += encoded

    def bytes(self) -> bytes:
        """Return the whole payload."""
        return ENCAPSULATION + bytes(self._data)


def pack_string(text: str) -> bytes:
    """Return a text as a payload of std_msgs/String."""
    payload = _Payload()
    payload.text(text)
    return payload.bytes()


def pack_transforms(time_ns: int, transforms: tuple[Transform, ...]) -> bytes:
    """Return a payload of tf2_msgs/msg/TFMessage with these poses; time_ns: log time of all."""
    payload = _Payload()
    payload.put("I", len(transforms))
    for parent, child, translation, rotation in transforms:
        payload.time(time_ns)
        payload.text(parent)
        payload.text(child)
        payload.put("d", *translation, *rotation)
    return payload.bytes()


def pack_scene(time_ns: int, entities: tuple[Entity, ...]) -> bytes:
    """Return a payload of foxglove_msgs/msg/SceneUpdate that adds or replaces `entities`; time_ns: log time."""
    payload = _Payload()
    payload.put("I", 0, len(entities))  # no deletions
    for entity in entities:
        payload.time(time_ns)
        payload.text(entity.frame)
        payload.text(entity.name)
        payload.time(entity.lifetime_ns)
        payload.put("?", True)  # moves with its frame
        payload.put("I", 0, len(entity.arrows))  # no metadata
        for tail, rotation, length_m, color in entity.arrows:
            head_m = min(0.4 * length_m, 0.04)
            payload.put("d", *tail, *rotation, length_m - head_m, 0.012, head_m, 0.03, *color)
        payload.put("I", 0, len(entity.spheres))  # no cubes
        for diameter_m, color in entity.spheres:
            payload.put("d", *ORIGIN, *UPRIGHT, *[diameter_m] * 3, *color)
        payload.put("I", 0, 0, 0, len(entity.labels))  # no cylinders, lines, triangles
        for centre, text, height_m, color in entity.labels:
            payload.put("d", *centre, *UPRIGHT)
            payload.put("?", True)
            payload.put("d", height_m)
            payload.put("?", False)
            payload.put("d", *color)
            payload.text(text)
        payload.put("I", 0)  # no models
    return payload.bytes()


ARROW_M_PER_N = 0.01
LONGEST_ARROW_M = 0.6
ARROW_LIFETIME_NS = 2_000_000_000
SMALLEST_SPHERE_M, LARGEST_SPHERE_M = 0.08, 0.16
NEAR = 0.5
"""Share of the threshold from which a joint is yellow."""
GREY: Color = (0.6, 0.6, 0.6, 0.5)
GREEN: Color = (0.2, 0.7, 0.3, 0.6)
YELLOW: Color = (0.95, 0.75, 0.1, 0.7)
RED: Color = (0.85, 0.15, 0.15, 0.8)
INK: Color = (0.3, 0.3, 0.3, 1.0)
_LABEL_HEIGHT_M = 0.04
_ABOVE_M = 0.16


class Shape(NamedTuple):
    """The arm as it is drawn.

    tilt_rad: of its plane of motion against the ground. level_rad: q1 at which link 1 is level.
    """

    link_length_m: tuple[float, float]
    tilt_rad: float = 0.0
    level_rad: float = 0.0


def about_z(angle_rad: float) -> Quaternion:
    """Return the quaternion (x, y, z, w) of a rotation by an angle about z."""
    return (0.0, 0.0, math.sin(0.5 * angle_rad), math.cos(0.5 * angle_rad))


def transforms_of(shape: Shape, q: Vector) -> tuple[Transform, ...]:
    """Return the poses of the robot description's frames at the joint positions q (2,), rad: base, both links, tip."""
    half_rad = 0.5 * shape.tilt_rad
    elbow, end = ((length_m, 0.0, 0.0) for length_m in shape.link_length_m)
    return (
        (WORLD, BASE, ORIGIN, (math.sin(half_rad), 0.0, 0.0, math.cos(half_rad))),
        (BASE, LINK_NAMES[0], ORIGIN, about_z(q[0] - shape.level_rad)),
        (LINK_NAMES[0], LINK_NAMES[1], elbow, about_z(q[1])),
        (LINK_NAMES[1], TIP, end, UPRIGHT),
    )


def threshold_shares(scheme: Any) -> Vector:
    """Return each joint's largest |residual| / threshold (2,) over its channels that are on, of a record of /scheme.

    NaN for a joint whose detection is off: all its thresholds are 0, infinite or NaN.
    """
    has_bank = "tau_ext_bank" in scheme.dtype.names
    torque, threshold = ("tau_ext_bank", "threshold_bank") if has_bank else ("tau_ext_hat", "threshold")
    is_on = np.isfinite(scheme[threshold]) & (scheme[threshold] > 0.0)
    shares = np.abs(scheme[torque]) / np.where(is_on, scheme[threshold], np.nan)
    largest: Vector = np.fmax.reduce(shares.reshape(-1, JOINTS))
    return largest


def draw_joints(state: SchemeState, tau_ext_hat: Vector, shares: Vector) -> tuple[Entity, ...]:
    """Return three entities: at each joint a sphere with torque and share as text; the state's name above the base.

    Size and colour of a sphere show the joint's share: it grows up to a share of 1, and is smallest and grey for NaN.
    tau_ext_hat (2,), Nm; shares (2,): of `threshold_shares`.
    """
    entities = []
    for index, link in enumerate(LINK_NAMES):
        share = float(shares[index])
        is_off = math.isnan(share)
        text = f"{tau_ext_hat[index]:+.3f} Nm" + ("" if is_off else f", {100.0 * share:.0f} %")
        label = ((0.0, 0.0, 0.5 * _ABOVE_M), text, _LABEL_HEIGHT_M, INK)
        grown = 0.0 if is_off else min(share, 1.0)
        sphere = (SMALLEST_SPHERE_M + grown * (LARGEST_SPHERE_M - SMALLEST_SPHERE_M), _color(share))
        entities.append(Entity(JOINT_NAMES[index], link, spheres=(sphere,), labels=(label,)))
    label = ((0.0, 0.0, _ABOVE_M), state.name, 1.5 * _LABEL_HEIGHT_M, INK)
    return (*entities, Entity("state", BASE, labels=(label,)))


def draw_contact(shape: Shape, report: ContactReport) -> Entity:
    """Return an entity with the arrow and text of a report's force, which viewers show for `ARROW_LIFETIME_NS`.

    It is at the touched place of link 2 if that is known, else at the link's end. The arrow's length is limited; it is
    red for a collision, else yellow. "≥" stands before a force that is not known.
    """
    on_link_2 = report.link == 2
    length_m = shape.link_length_m[report.link - 1]
    place_m = min(max(report.lever_m, 0.0), length_m) if on_link_2 and report.location is Location.KNOWN else length_m
    force_N, is_measured = _force(shape, report)
    arrow_m = min(max(abs(force_N) * ARROW_M_PER_N, 0.05), LONGEST_ARROW_M)
    side = -1.0 if force_N > 0.0 else 1.0  # a force toward +y comes from the side of -y
    tail: Point = (place_m, side * arrow_m, 0.0)
    color = RED if report.level is ContactLevel.COLLISION else YELLOW
    sign = "" if is_measured else "≥ "
    text = f"{report.level.name} link {report.link}: {sign}{abs(force_N):.1f} N"
    if on_link_2 and report.location is Location.KNOWN:
        text += f" at {report.lever_m:.2f} m"
    arrow = (tail, about_z(-side * 0.5 * math.pi), arrow_m, color)
    label = ((place_m, side * (arrow_m + 0.03), 0.5 * _ABOVE_M), text, _LABEL_HEIGHT_M, INK)
    return Entity("contact", LINK_NAMES[report.link - 1], (arrow,), labels=(label,), lifetime_ns=ARROW_LIFETIME_NS)


def _force(shape: Shape, report: ContactReport) -> tuple[float, bool]:
    """Return the force across the link, N, positive toward +q, and whether it is known.

    If it was not sought, it is the force at the link's end that has the joint's peak torque: the smallest possible one.
    """
    if report.location is Location.NOT_SOUGHT:
        torque = report.tau_ext_peak[report.link - 1]
        return torque / shape.link_length_m[report.link - 1], False
    return report.force_N, report.location is Location.KNOWN


def _color(share: float) -> Color:
    if math.isnan(share):
        return GREY
    if share < NEAR:
        return GREEN
    return YELLOW if share < 1.0 else RED
