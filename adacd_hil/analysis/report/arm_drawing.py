"""The arm as a small picture: both links seen along their axes, the touched one marked, and the force on it.

x to the right, y up, joint 1 at the origin; lengths in mm of the arm.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from adacd_hil.records import Vector

_Point = tuple[float, float]


class Push(NamedTuple):
    """A force at right angles to a link: how far from the link's joint, and how strong, of the strongest to be shown.

    lever_m, lever_sigma_m: None where the place is not known; the arrow then points at the middle, or at `lever_m`
    without its spread, and is dashed. side: +1 toward +q, -1, or 0 where not known.
    """

    link: int
    side: int
    share: float
    lever_m: float | None
    lever_sigma_m: float | None


class Stroke(NamedTuple):
    """A straight line, and its class."""

    start: _Point
    end: _Point
    kind: str


@dataclass(frozen=True)
class ArmDrawing:
    """What the picture has. view: its left, top, width and height with y down; force: strokes of arrow and spread."""

    description: str
    view: tuple[float, float, float, float]
    reach: float
    links: tuple[Stroke, Stroke]
    force: list[Stroke]
    arrowhead: list[_Point]


def draw_arm(q: Vector, length_m: tuple[float, float], push: Push | None, description: str) -> ArmDrawing:
    """Draw the arm at the joint angles q, rad (2,)."""
    angles = (float(q[0]), float(q[0] + q[1]))
    l1, l2 = (1000.0 * length for length in length_m)
    elbow = _along((0.0, 0.0), angles[0], l1)
    tip = _along(elbow, angles[1], l2)
    reach = l1 + l2
    touched = 0 if push is None else push.link
    lines = (((0.0, 0.0), elbow), (elbow, tip))
    kinds = ("link touched" if number == touched else "link" for number in (1, 2))
    first, second = (Stroke(*line, kind) for line, kind in zip(lines, kinds, strict=True))
    force, arrowhead = ([], []) if push is None else _arrow(push, (first, second), angles, reach)
    tails = [stroke.start for stroke in force if stroke.kind.startswith("force")]
    xs, ys = zip((0.0, 0.0), elbow, tip, *tails, strict=True)
    width, height = 1.5 * reach, 1.1 * reach
    left = 0.5 * (min(xs) + max(xs)) - 0.5 * width
    top = -0.5 * (min(ys) + max(ys)) - 0.5 * height
    return ArmDrawing(description, (left, top, width, height), reach, (first, second), force, arrowhead)


def _along(start: _Point, angle: float, distance: float) -> _Point:
    return (start[0] + distance * math.cos(angle), start[1] + distance * math.sin(angle))


def _arrow(
    push: Push, links: tuple[Stroke, Stroke], angles: tuple[float, float], reach: float
) -> tuple[list[Stroke], list[_Point]]:
    """Draw the force and the spread of its place; give the strokes, and the corners of the arrowhead."""
    start, end, _ = links[push.link - 1]
    angle = angles[push.link - 1]
    lever = 0.5 * math.dist(start, end) if push.lever_m is None else 1000.0 * push.lever_m
    head = _along(start, angle, lever)
    strokes = []
    if push.lever_sigma_m is not None:
        spread = 1000.0 * push.lever_sigma_m
        strokes.append(Stroke(_along(start, angle, lever - spread), _along(start, angle, lever + spread), "spread"))
    if push.side == 0:
        return strokes, []
    outward = angle - push.side * 0.5 * math.pi
    tail = _along(head, outward, (0.14 + 0.22 * float(np.clip(push.share, 0.0, 1.0))) * reach)
    neck = _along(head, outward, 0.085 * reach)
    strokes.append(Stroke(tail, neck, "force" if push.lever_sigma_m is not None else "force guessed"))
    return strokes, [head, *(_along(neck, angle, side * 0.04 * reach) for side in (-1.0, 1.0))]
