"""The arm as a small picture: both links seen along their axes, the touched one marked, and the force on it.

x to the right, y up, joint 1 at the origin; lengths in mm of the arm.
"""

import math
from html import escape
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


def draw_arm(q: Vector, length_m: tuple[float, float], push: Push | None, description: str) -> str:
    """Draw the arm at the joint angles q, rad (2,)."""
    angles = (float(q[0]), float(q[0] + q[1]))
    l1, l2 = (1000.0 * length for length in length_m)
    elbow = _along((0.0, 0.0), angles[0], l1)
    tip = _along(elbow, angles[1], l2)
    reach = l1 + l2
    links = (((0.0, 0.0), elbow), (elbow, tip))
    touched = 0 if push is None else push.link
    arrow, points = ("", []) if push is None else _arrow(push, links, angles, reach)
    shapes = [
        _line(start, end, "link touched" if number == touched else "link")
        for number, (start, end) in enumerate(links, start=1)
    ]
    joints = "".join(f'<circle cx="{x:.0f}" cy="{-y:.0f}" r="{0.035 * reach:.0f}"/>' for x, y in ((0.0, 0.0), elbow))
    xs, ys = zip((0.0, 0.0), elbow, tip, *points, strict=True)
    width, height = 1.5 * reach, 1.1 * reach
    left = 0.5 * (min(xs) + max(xs)) - 0.5 * width
    top = -0.5 * (min(ys) + max(ys)) - 0.5 * height
    base = 0.08 * reach
    ground = f'<path d="M{-base:.0f} {-base:.0f}v{2 * base:.0f}" class="base"/>'
    body = ground + "".join(shapes) + f'<g class="joints">{joints}</g>' + arrow
    view = f"{left:.0f} {top:.0f} {width:.0f} {height:.0f}"
    return f'<svg class="arm" viewBox="{view}" role="img" aria-label="{escape(description)}">{body}</svg>'


def _along(start: _Point, angle: float, distance: float) -> _Point:
    return (start[0] + distance * math.cos(angle), start[1] + distance * math.sin(angle))


def _line(start: _Point, end: _Point, kind: str) -> str:
    return f'<path d="M{start[0]:.0f} {-start[1]:.0f}L{end[0]:.0f} {-end[1]:.0f}" class="{kind}"/>'


def _arrow(
    push: Push, links: tuple[tuple[_Point, _Point], ...], angles: tuple[float, float], reach: float
) -> tuple[str, list[_Point]]:
    """Draw the force with its head on the link, and the spread of its place; give what it reaches."""
    start, end = links[push.link - 1]
    angle = angles[push.link - 1]
    length = math.dist(start, end)
    lever = 0.5 * length if push.lever_m is None else 1000.0 * push.lever_m
    head = _along(start, angle, lever)
    shapes = ""
    if push.lever_sigma_m is not None:
        spread = 1000.0 * push.lever_sigma_m
        shapes += _line(_along(start, angle, lever - spread), _along(start, angle, lever + spread), "spread")
    if push.side == 0:
        return shapes, []
    outward = angle - push.side * 0.5 * math.pi
    tail = _along(head, outward, (0.14 + 0.22 * float(np.clip(push.share, 0.0, 1.0))) * reach)
    neck = _along(head, outward, 0.085 * reach)
    wings = [_along(neck, angle, side * 0.04 * reach) for side in (-1.0, 1.0)]
    corners = " ".join(f"{x:.0f},{-y:.0f}" for x, y in (head, *wings))
    kind = "force" if push.lever_sigma_m is not None else "force guessed"
    return f'{shapes}{_line(tail, neck, kind)}<polygon points="{corners}" class="head"/>', [tail]
