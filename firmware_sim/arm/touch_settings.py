"""People and things that touch the arm, as a scenario says them: one scripted force, or bodies, hands and walls.

A scripted contact pushes with force_N · shape(t) at `point_m` from the joint that carries the link. Its direction is
`angle_deg`, from the link's own axis (frame "link"; 90° is the normal on the side of +q, the force turns with the
link), from the world's x axis (frame "world"), or from the velocity v of the touched point (frame "motion": 0° helps
the motion, 180° drags). With frame "motion" the force has the factor |v| / √(|v|² + FADE_M_S²), so it is smooth where
the motion reverses, and zero at rest. Shapes, t from 0 to duration d:

    step       1
    half_sine  sin(π t / d)
    push       t / r up, 1, down to 0 again within r = ramp_s

Onset and end lie on the 100 µs grid of the drives, so their jumps never fall inside an integration step.

Bodies, hands and walls react to the arm's motion; a body may recede.

Points and angles are in the world's frame: origin in joint 1, x along link 1 at q₁ = 0. Forces:
`firmware_sim.arm.touch_forces`.

The human body is as ISO/TS 15066:2016 Annex A models it: each region is an effective mass m_H behind a linear spring of
constant K (table A.3).
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.settings.schema import ConfigError, setting
from adacd_hil.structured import Structured, float_fields

TICK_S: Final = 1e-4
"""The drives' inner period, and the grid of everything that happens to the arm."""

PAIR: Final = (2,)
"""Shape of a value per joint."""

SHAPES: Final = ("step", "half_sine", "push")
FRAMES: Final = ("link", "world", "motion")
FADE_M_S: Final = 0.01
"""Speed of the touched point at which a force of frame "motion" has 1/√2 of its size; a moving tip has some 0.5 m/s."""
LARGEST_MOTION_N: Final = 100.0
"""Largest force of frame "motion". Across FADE_M_S it damps the base arms' tip (0.21 kg) by up to 5e4 1/s; RK4 with
LARGEST_SUBSTEPS is stable up to 4e5."""

CONTACT: Final = float_fields(
    {
        "onset_tick": (),
        "end_tick": (),
        "duration_s": (),
        "ramp_s": (),
        "link": (),
        "point_m": (),
        "angle_rad": (),
        "frame": (),  # index into FRAMES
        "shape": (),  # index into SHAPES
        "force_N": (),
    }
)
"""One row of a contact table."""

_WORLD: Final = FRAMES.index("world")
_MOTION: Final = FRAMES.index("motion")
_HALF_SINE: Final = SHAPES.index("half_sine")
_PUSH: Final = SHAPES.index("push")


def ticks(duration_s: float) -> int:
    """Return a time, s, in ticks of 100 µs, rounded to the nearest."""
    return round(duration_s / TICK_S)


@dataclass(frozen=True)
class ContactSettings:
    """One scripted force on a point of a link."""

    at_s: float = setting(unit="s", low=0.0, high=1e6, meaning="onset, since the drives were enabled")
    link: int = setting(low=1, high=2, meaning="which link is touched")
    point_m: float = setting(unit="m", low=0.0, high=5.0, meaning="from the joint that carries the link")
    force_N: float = setting(unit="N", low=0.01, high=1000.0, meaning="largest force")
    duration_s: float = setting(unit="s", low=TICK_S, high=3600.0, meaning="from onset to end")
    angle_deg: float = setting(90.0, unit="deg", low=-360.0, high=360.0, meaning="direction; 90 from link: toward +q")
    frame: str = setting("link", choices=FRAMES, meaning="what the angle is measured from")
    shape: str = setting("step", choices=SHAPES, meaning="force over time")
    ramp_s: float | None = setting(
        None, unit="s", low=TICK_S, high=3600.0, meaning="push: rise and fall; absent: a quarter of the duration"
    )

    def __post_init__(self) -> None:
        if self.ramp_s is not None and self.shape != "push":
            raise ConfigError(f"ramp_s = {self.ramp_s} s belongs to shape 'push', this contact is a {self.shape!r}")
        if self.ramp_s is not None and 2.0 * self.ramp_s > self.duration_s:
            raise ConfigError(f"ramp_s = {self.ramp_s} s is above half of duration_s = {self.duration_s} s")
        if self.frame == "motion" and self.force_N > LARGEST_MOTION_N:
            raise ConfigError(f"force_N = {self.force_N} N is above {LARGEST_MOTION_N} N, the most with frame 'motion'")

    @property
    def onset_tick(self) -> int:
        """First 100 µs tick, since the drives were enabled, in which the force acts."""
        return ticks(self.at_s)

    @property
    def end_tick(self) -> int:
        """First 100 µs tick, since the drives were enabled, in which the force no longer acts."""
        return self.onset_tick + ticks(self.duration_s)

    def row(self) -> tuple[float, ...]:
        """Return the contact's values for compiled functions, in the order of CONTACT's fields.

        The duration is in whole ticks of 100 µs; the ramp is half of it at most.
        """
        duration_s = (self.end_tick - self.onset_tick) * TICK_S
        return (
            self.onset_tick,
            self.end_tick,
            duration_s,
            min(self._rise_s(), 0.5 * duration_s),
            self.link,
            self.point_m,
            math.radians(self.angle_deg),
            FRAMES.index(self.frame),
            SHAPES.index(self.shape),
            self.force_N,
        )

    def _rise_s(self) -> float:
        return 0.25 * self.duration_s if self.ramp_s is None else self.ramp_s


def contact_table(contacts: tuple[ContactSettings, ...]) -> Structured:
    """Return scripted contacts as a table (n,) of dtype CONTACT, in the same order, for compiled functions."""
    return np.array([contact.row() for contact in contacts], dtype=CONTACT)


@compiled
def contact_force(contact: np.void, elapsed_s: float) -> float:
    """Return a contact's force, N, by its shape, `elapsed_s` after its onset. Call it between onset and end only."""
    duration_s = contact["duration_s"]
    if contact["shape"] == _HALF_SINE:
        return float(contact["force_N"] * math.sin(math.pi * elapsed_s / duration_s))
    if contact["shape"] == _PUSH:
        rise_s = min(elapsed_s, duration_s - elapsed_s)
        return float(contact["force_N"] * min(1.0, rise_s / contact["ramp_s"]))
    return float(contact["force_N"])


@compiled
def aim(
    contact: np.void, force_N: float, length1_m: float, q1: float, q2: float, dq1: float, dq2: float
) -> tuple[float, float]:
    """Return the world's angle of a contact's force, rad, and its size, N.

    The size is `force_N`; in frame "motion" less where the touched point is slow (FADE_M_S).
    """
    angle_rad = contact["angle_rad"]
    if contact["frame"] == _WORLD:
        return angle_rad, force_N
    phi = q1 + q2 if contact["link"] == 2.0 else q1
    if contact["frame"] != _MOTION:
        return phi + angle_rad, force_N
    rate = contact["point_m"] * (dq1 + dq2 if contact["link"] == 2.0 else dq1)
    elbow_rate = length1_m * dq1 if contact["link"] == 2.0 else 0.0
    v_x = -elbow_rate * math.sin(q1) - rate * math.sin(phi)
    v_y = elbow_rate * math.cos(q1) + rate * math.cos(phi)
    speed_m_s = math.sqrt(v_x * v_x + v_y * v_y)
    faded_N = force_N * speed_m_s / math.sqrt(speed_m_s * speed_m_s + FADE_M_S * FADE_M_S)
    return math.atan2(v_y, v_x) + angle_rad, faded_N


@compiled
def contact_torque(
    contact: np.void, force_N: float, length1_m: float, q1: float, q2: float, dq1: float, dq2: float
) -> tuple[float, float]:
    """Return the external torque of the two joints, J(q)ᵀ F, Nm: moments of the force about the two joint axes.

    force_N: as `contact_force` gives it; `aim` reduces it in frame "motion". A force at the angle ψ has the moment p F
    sin(ψ − φ) about the joint at the other end of the lever p, which itself points along φ.
    """
    link2 = contact["link"] == 2.0
    phi = q1 + q2 if link2 else q1
    psi, force_N = aim(contact, force_N, length1_m, q1, q2, dq1, dq2)
    moment = contact["point_m"] * force_N * math.sin(psi - phi)
    if link2:
        return moment + length1_m * force_N * math.sin(psi - q1), moment
    return moment, 0.0


class BodyRegion(NamedTuple):
    """A body region of ISO/TS 15066: one row of table A.3."""

    mass_kg: float  # effective mass m_H
    stiffness_N_m: float  # effective spring constant K


BODY_REGIONS: Final = {
    "skull_forehead": BodyRegion(4.4, 150e3),
    "face": BodyRegion(4.4, 75e3),
    "neck": BodyRegion(1.2, 50e3),
    "back_shoulder": BodyRegion(40.0, 35e3),
    "chest": BodyRegion(40.0, 25e3),
    "abdomen": BodyRegion(40.0, 10e3),
    "pelvis": BodyRegion(40.0, 25e3),
    "upper_arm_elbow": BodyRegion(3.0, 30e3),
    "lower_arm_wrist": BodyRegion(2.0, 40e3),
    "hand_finger": BodyRegion(0.6, 75e3),
    "thigh_knee": BodyRegion(75.0, 50e3),
    "lower_leg": BodyRegion(75.0, 60e3),
}
"""Regions by the name that a scenario uses."""


_REACH_M: Final = 20.0
"""Bound of coordinates: twice the reach of two links of 5 m, the longest allowed."""


def _ends(lengths_m: tuple[float, float], pose_rad: tuple[float, float]) -> tuple[tuple[float, float], ...]:
    """Return base, elbow and tip in the world (x, y), m, of an arm in a pose (q1, q2)."""
    elbow = lengths_m[0] * math.cos(pose_rad[0]), lengths_m[0] * math.sin(pose_rad[0])
    angle = pose_rad[0] + pose_rad[1]
    return (0.0, 0.0), elbow, (elbow[0] + lengths_m[1] * math.cos(angle), elbow[1] + lengths_m[1] * math.sin(angle))


@dataclass(frozen=True)
class BodySettings:
    """A body in the arm's way: a body region of ISO/TS 15066, or mass and stiffness in numbers."""

    at_s: float = setting(unit="s", low=0.0, high=1e6, meaning="when it steps in, since the drives were enabled")
    link: int = setting(low=1, high=2, meaning="the link that meets it")
    x_m: float = setting(unit="m", low=-_REACH_M, high=_REACH_M, meaning="where its centre stands, world")
    y_m: float = setting(unit="m", low=-_REACH_M, high=_REACH_M, meaning="where its centre stands, world")
    duration_s: float | None = setting(
        None, unit="s", low=TICK_S, high=1e6, meaning="from at_s to its leaving; absent: it stays"
    )
    region: str | None = setting(None, choices=tuple(BODY_REGIONS), meaning="body region, for mass and stiffness")
    mass_kg: float | None = setting(None, unit="kg", low=0.01, high=1000.0, meaning="what the arm pushes away")
    stiffness_N_m: float | None = setting(None, unit="N/m", low=1.0, high=1e6, meaning="of its surface")
    damping_N_s_m: float = setting(0.0, unit="N s/m", low=0.0, high=1e5, meaning="of its surface")
    radius_m: float = setting(
        0.0, unit="m", low=0.0, high=1.0, meaning="from its centre to its surface, half the width of the link added"
    )
    clamped: bool = setting(False, meaning="stands against a wall: it can't be pushed away")
    gap_m: float | None = setting(None, unit="m", low=0.0, high=_REACH_M, meaning="room behind it; absent: no wall")
    free_deg: float | None = setting(
        None, unit="deg", low=-360.0, high=360.0, meaning="where it can be pushed; absent: normal to the link"
    )

    def __post_init__(self) -> None:
        numbers = [name for name in ("mass_kg", "stiffness_N_m") if getattr(self, name) is not None]
        if self.region is not None and numbers:
            raise ConfigError(f"{numbers[0]} = {getattr(self, numbers[0])} is given by region {self.region!r}")
        if self.region is None and len(numbers) < 2:
            raise ConfigError("a body needs a region, or mass_kg and stiffness_N_m")
        if self.clamped and self.gap_m:
            raise ConfigError(f"gap_m = {self.gap_m} m: a clamped body has no gap")

    @property
    def onset_tick(self) -> int:
        """First 100 µs tick, since the drives were enabled, in which the body may stand there."""
        return ticks(self.at_s)

    @property
    def mass(self) -> float:
        """Effective mass, kg: that of the region, or `mass_kg` without a region."""
        return BODY_REGIONS[self.region].mass_kg if self.region is not None else float(self.mass_kg or 0.0)

    @property
    def stiffness(self) -> float:
        """Stiffness, N/m: that of the region, or `stiffness_N_m` without a region."""
        return BODY_REGIONS[self.region].stiffness_N_m if self.region is not None else float(self.stiffness_N_m or 0.0)

    @property
    def room_m(self) -> float:
        """Distance that the body can recede, m: 0 if clamped, inf without a wall behind it."""
        if self.clamped:
            return 0.0
        return math.inf if self.gap_m is None else self.gap_m

    def overlap_m(self, lengths_m: tuple[float, float], pose_rad: tuple[float, float]) -> float:
        """Return how deep the body's link enters the body in a pose (q1, q2), m.

        While they are apart, it is minus their distance. lengths_m: of both links.
        """
        ends = _ends(lengths_m, pose_rad)
        (base_x, base_y), (end_x, end_y) = ends[self.link - 1], ends[self.link]
        along_x, along_y = end_x - base_x, end_y - base_y
        share = ((self.x_m - base_x) * along_x + (self.y_m - base_y) * along_y) / (along_x**2 + along_y**2)
        share = min(max(share, 0.0), 1.0)
        return self.radius_m - math.hypot(self.x_m - base_x - share * along_x, self.y_m - base_y - share * along_y)


@dataclass(frozen=True)
class HandSettings:
    """A hand that grasps a point of a link and guides it: spring and damper to a point that moves at constant speed.

    Stiffness and damping of a human hand that holds a posture: Mussa-Ivaldi, Hogan and Bizzi 1985; Tsuji et al. 1995.
    """

    at_s: float = setting(unit="s", low=0.0, high=1e6, meaning="when it grasps, since the drives were enabled")
    duration_s: float = setting(unit="s", low=TICK_S, high=1e6, meaning="from grasp to release")
    link: int = setting(low=1, high=2, meaning="which link it grasps")
    point_m: float = setting(unit="m", low=0.0, high=5.0, meaning="from the joint that carries the link")
    move_to_m: tuple[float, float] | None = setting(
        None, unit="m", low=-_REACH_M, high=_REACH_M, meaning="where it guides the point, world x and y"
    )
    direction_deg: float | None = setting(
        None, unit="deg", low=-360.0, high=360.0, meaning="or the way it guides, until it lets go"
    )
    speed_m_s: float = setting(
        0.1, unit="m/s", low=0.001, high=2.0, meaning="how fast it guides; without a way it holds the point"
    )
    stiffness_N_m: float = setting(400.0, unit="N/m", low=1.0, high=1e5, meaning="of the hand and arm")
    damping_N_s_m: float = setting(40.0, unit="N s/m", low=0.0, high=1e4, meaning="of the hand and arm")
    force_limit_N: float = setting(60.0, unit="N", low=0.1, high=1000.0, meaning="largest force")

    def __post_init__(self) -> None:
        if self.move_to_m is not None and self.direction_deg is not None:
            raise ConfigError(f"direction_deg = {self.direction_deg} deg beside move_to_m: a hand has one way to go")


@dataclass(frozen=True)
class WallSettings:
    """A fixed wall, a line in the plane; only the ends of both links can meet it."""

    x_m: float = setting(unit="m", low=-_REACH_M, high=_REACH_M, meaning="a point of it, world")
    y_m: float = setting(unit="m", low=-_REACH_M, high=_REACH_M, meaning="a point of it, world")
    normal_deg: float = setting(unit="deg", low=-360.0, high=360.0, meaning="its normal, toward the free side")
    at_s: float = setting(0.0, unit="s", low=0.0, high=1e6, meaning="when it is put there")
    duration_s: float | None = setting(
        None, unit="s", low=TICK_S, high=1e6, meaning="from at_s to its removal; absent: it stays"
    )
    stiffness_N_m: float = setting(1e5, unit="N/m", low=100.0, high=1e6, meaning="of wall and link end together")
    damping_s_m: float = setting(
        0.5, unit="s/m", low=0.0, high=100.0, meaning="χ of Hunt and Crossley; restitution is about 1 - 2/3 χ v"
    )

    @property
    def onset_tick(self) -> int:
        """First 100 µs tick, since the drives were enabled, in which the wall may stand there."""
        return ticks(self.at_s)

    def overlap_m(self, lengths_m: tuple[float, float], pose_rad: tuple[float, float]) -> float:
        """Return how far elbow or tip, whichever is deeper, is behind the wall in a pose (q1, q2), m.

        In front of the wall it is negative. lengths_m: of both links.
        """
        normal_x, normal_y = math.cos(math.radians(self.normal_deg)), math.sin(math.radians(self.normal_deg))
        ends = _ends(lengths_m, pose_rad)[1:]
        return max(-(x - self.x_m) * normal_x - (y - self.y_m) * normal_y for x, y in ends)
