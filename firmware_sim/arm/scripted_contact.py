"""The person who touches the arm: one force on one link, over time.

A contact pushes with force_N · shape(t) at `point_m` from the joint that carries the link. Its direction is
`angle_deg`, from the link's own axis (frame "link"; 90° is the normal on the side of +q, the force turns with the
link) or from the world's x axis (frame "world"). Shapes, t from 0 to duration d:

    step       1
    half_sine  sin(π t / d)
    push       t / r up, 1, down to 0 again within r = ramp_s

Onset and end lie on the 100 µs grid of the drives, so their jumps never fall inside an integration step.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from adacd_hil.settings.schema import ConfigError, setting

TICK_S: Final = 1e-4
"""The drives' inner period, and the grid of everything that happens to the arm."""

SHAPES: Final = ("step", "half_sine", "push")
FRAMES: Final = ("link", "world")

# Columns of a contact table, one row per contact.
ONSET_TICK: Final = 0
END_TICK: Final = 1
DURATION_S: Final = 2
RAMP_S: Final = 3
LINK: Final = 4
POINT_M: Final = 5
ANGLE_RAD: Final = 6
FRAME: Final = 7  # index into FRAMES
SHAPE: Final = 8  # index into SHAPES
FORCE_N: Final = 9
COLUMNS: Final = 10

_WORLD: Final = FRAMES.index("world")
_HALF_SINE: Final = SHAPES.index("half_sine")
_PUSH: Final = SHAPES.index("push")


def ticks(duration_s: float) -> int:
    """Round a time to the 100 µs grid."""
    return round(duration_s / TICK_S)


@dataclass(frozen=True)
class ContactSettings:
    """One touch."""

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

    @property
    def onset_tick(self) -> int:
        """First 100 µs tick, since the drives were enabled, in which the force acts."""
        return ticks(self.at_s)

    @property
    def end_tick(self) -> int:
        """First tick in which it no longer does."""
        return self.onset_tick + ticks(self.duration_s)

    @property
    def impulse_N_s(self) -> float:
        """Force integrated over time."""
        if self.shape == "half_sine":
            return self.force_N * self.duration_s * 2.0 / math.pi
        if self.shape == "push":
            return self.force_N * (self.duration_s - self._rise_s())
        return self.force_N * self.duration_s

    def row(self) -> list[float]:
        """Pack the contact for compiled functions, by the columns named above."""
        duration_s = (self.end_tick - self.onset_tick) * TICK_S
        row = [0.0] * COLUMNS
        row[ONSET_TICK] = self.onset_tick
        row[END_TICK] = self.end_tick
        row[DURATION_S] = duration_s
        row[RAMP_S] = min(self._rise_s(), 0.5 * duration_s)
        row[LINK] = self.link
        row[POINT_M] = self.point_m
        row[ANGLE_RAD] = math.radians(self.angle_deg)
        row[FRAME] = FRAMES.index(self.frame)
        row[SHAPE] = SHAPES.index(self.shape)
        row[FORCE_N] = self.force_N
        return row

    def _rise_s(self) -> float:
        return 0.25 * self.duration_s if self.ramp_s is None else self.ramp_s


def contact_table(contacts: tuple[ContactSettings, ...]) -> NDArray[np.float64]:
    """Pack contacts (n, COLUMNS)."""
    return np.array([contact.row() for contact in contacts], dtype=np.float64).reshape(len(contacts), COLUMNS)


@compiled
def contact_force(contact: Vector, elapsed_s: float) -> float:
    """Give the force in N of a contact, a row of the table, `elapsed_s` after its onset and before its end."""
    duration_s = contact[DURATION_S]
    if contact[SHAPE] == _HALF_SINE:
        return float(contact[FORCE_N] * math.sin(math.pi * elapsed_s / duration_s))
    if contact[SHAPE] == _PUSH:
        rise_s = min(elapsed_s, duration_s - elapsed_s)
        return float(contact[FORCE_N] * min(1.0, rise_s / contact[RAMP_S]))
    return float(contact[FORCE_N])


@compiled
def contact_torque(contact: Vector, force_N: float, length1_m: float, q1: float, q2: float) -> tuple[float, float]:
    """Give the external torque of the two joints, J(q)ᵀ F, Nm: moments of the force about the two joint axes.

    A force at the angle ψ has the moment p F sin(ψ − φ) about the joint at the other end of the lever p, which
    itself points along φ.
    """
    link2 = contact[LINK] == 2.0
    phi = q1 + q2 if link2 else q1
    psi = contact[ANGLE_RAD] if contact[FRAME] == _WORLD else phi + contact[ANGLE_RAD]
    moment = contact[POINT_M] * force_N * math.sin(psi - phi)
    if link2:
        return moment + length1_m * force_N * math.sin(psi - q1), moment
    return moment, 0.0
