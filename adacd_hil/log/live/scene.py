"""What the live view draws: where the links are, how far each residual is on its way to the threshold, who pushes.

Drawn at each joint: a sphere that is small and grey while detection is off, then green, yellow from half of the
threshold, red over it. Where a contact is reported: an arrow on the link, as long as the force is strong, with its
numbers. Frames are those of robot_description.py.
"""

import math
from typing import NamedTuple

from adacd_hil.log.live.robot_description import BASE, LINK_NAMES, TIP, WORLD, mount_roll_rad
from adacd_hil.log.live.scene_types import (
    UPRIGHT,
    Arrow,
    Color,
    Entity,
    Label,
    Point,
    Quaternion,
    Sphere,
    Transform,
)
from adacd_hil.records import JOINT_NAMES, ContactLevel, ContactReport, Location, SchemeState, Vector

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
    """The arm as it is drawn. `is_upright`: gravity acts on its joints."""

    link_length_m: tuple[float, float]
    is_upright: bool = False


def about_z(angle_rad: float) -> Quaternion:
    """Return the rotation by an angle about z."""
    return (0.0, 0.0, math.sin(0.5 * angle_rad), math.cos(0.5 * angle_rad))


def transforms_of(shape: Shape, q: Vector) -> tuple[Transform, ...]:
    """Place all frames of the robot description for the joint positions q (2,)."""
    half_rad = 0.5 * mount_roll_rad(shape.is_upright)
    origin = (0.0, 0.0, 0.0)
    elbow, end = ((length_m, 0.0, 0.0) for length_m in shape.link_length_m)
    return (
        Transform(WORLD, BASE, origin, (math.sin(half_rad), 0.0, 0.0, math.cos(half_rad))),
        Transform(BASE, LINK_NAMES[0], origin, about_z(q[0])),
        Transform(LINK_NAMES[0], LINK_NAMES[1], elbow, about_z(q[1])),
        Transform(LINK_NAMES[1], TIP, end, UPRIGHT),
    )


def share_of_threshold(tau_ext_hat: float, threshold: float) -> float:
    """Return |residual| / threshold; NaN while detection is off."""
    return abs(tau_ext_hat) / threshold if 0.0 < threshold < math.inf else math.nan


def draw_joints(state: SchemeState, tau_ext_hat: Vector, threshold: Vector) -> tuple[Entity, ...]:
    """Draw both joints and the state; tau_ext_hat, threshold (2,), Nm."""
    entities = []
    for index, link in enumerate(LINK_NAMES):
        share = share_of_threshold(float(tau_ext_hat[index]), float(threshold[index]))
        sphere = Sphere((0.0, 0.0, 0.0), _diameter_m(share), _color(share))
        label = Label((0.0, 0.0, 0.5 * _ABOVE_M), _joint_text(float(tau_ext_hat[index]), share), _LABEL_HEIGHT_M, INK)
        entities.append(Entity(JOINT_NAMES[index], link, spheres=(sphere,), labels=(label,)))
    label = Label((0.0, 0.0, _ABOVE_M), state.name, 1.5 * _LABEL_HEIGHT_M, INK)
    return (*entities, Entity("state", BASE, labels=(label,)))


def draw_contact(shape: Shape, report: ContactReport) -> Entity:
    """Draw the force of a report: on link 2 where its place is known, else at the end of the link that was touched."""
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
    arrow = Arrow(tail, about_z(-side * 0.5 * math.pi), arrow_m, color)
    label = Label((place_m, side * (arrow_m + 0.03), 0.5 * _ABOVE_M), text, _LABEL_HEIGHT_M, INK)
    return Entity("contact", LINK_NAMES[report.link - 1], (arrow,), labels=(label,), lifetime_ns=ARROW_LIFETIME_NS)


def _force(shape: Shape, report: ContactReport) -> tuple[float, bool]:
    """Return the force across the link, N, and whether it is that rather than the smallest with this torque."""
    if report.location is Location.NOT_SOUGHT:
        torque = report.tau_ext_peak[report.link - 1]
        return torque / shape.link_length_m[report.link - 1], False
    return report.force_N, report.location is Location.KNOWN


def _diameter_m(share: float) -> float:
    if math.isnan(share):
        return SMALLEST_SPHERE_M
    return SMALLEST_SPHERE_M + min(share, 1.0) * (LARGEST_SPHERE_M - SMALLEST_SPHERE_M)


def _color(share: float) -> Color:
    if math.isnan(share):
        return GREY
    if share < NEAR:
        return GREEN
    return YELLOW if share < 1.0 else RED


def _joint_text(tau_ext_hat: float, share: float) -> str:
    return f"{tau_ext_hat:+.3f} Nm" + ("" if math.isnan(share) else f", {100.0 * share:.0f} %")
