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

from adacd_hil.compiled import Structured, compiled, float_fields
from adacd_hil.settings.schema import ConfigError, setting

TICK_S: Final = 1e-4
"""The drives' inner period, and the grid of everything that happens to the arm."""

PAIR: Final = (2,)
"""Shape of what both joints have."""

SHAPES: Final = ("step", "half_sine", "push")
FRAMES: Final = ("link", "world")

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

    def row(self) -> tuple[float, ...]:
        """Pack the contact for compiled functions, in the order of CONTACT."""
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
    """Pack contacts (n,), with the fields of CONTACT."""
    return np.array([contact.row() for contact in contacts], dtype=CONTACT)


@compiled
def contact_force(contact: np.void, elapsed_s: float) -> float:
    """Give the force in N of a contact, a row of the table, `elapsed_s` after its onset and before its end."""
    duration_s = contact["duration_s"]
    if contact["shape"] == _HALF_SINE:
        return float(contact["force_N"] * math.sin(math.pi * elapsed_s / duration_s))
    if contact["shape"] == _PUSH:
        rise_s = min(elapsed_s, duration_s - elapsed_s)
        return float(contact["force_N"] * min(1.0, rise_s / contact["ramp_s"]))
    return float(contact["force_N"])


@compiled
def contact_torque(contact: np.void, force_N: float, length1_m: float, q1: float, q2: float) -> tuple[float, float]:
    """Give the external torque of the two joints, J(q)ᵀ F, Nm: moments of the force about the two joint axes.

    A force at the angle ψ has the moment p F sin(ψ − φ) about the joint at the other end of the lever p, which
    itself points along φ.
    """
    link2 = contact["link"] == 2.0
    phi = q1 + q2 if link2 else q1
    psi = contact["angle_rad"] if contact["frame"] == _WORLD else phi + contact["angle_rad"]
    moment = contact["point_m"] * force_N * math.sin(psi - phi)
    if link2:
        return moment + length1_m * force_N * math.sin(psi - q1), moment
    return moment, 0.0
