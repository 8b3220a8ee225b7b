"""Desired motions for the laboratory: the paper's, random point-to-point moves with dwells, multisines, and joins.

Shapes: q_d, dq_d, ddq_d (n, 2) of n cycles of 1 ms; rad, rad/s, rad/s².
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import compiled
from adacd_hil.control.motions import corner_to_corner
from adacd_hil.control.reference import SHORTEST_APPROACH_S
from adacd_hil.records import JOINTS, QUINTIC_PEAK_ACCELERATION, QUINTIC_PEAK_SPEED, Vector
from adacd_hil.settings.run_settings import TrajectorySettings

PERIOD_S = 1e-3
REACH_RAD = np.radians([60.0, 110.0])
"""Random motions stay within these of zero, inside `arm.position_limit_deg`."""
SPEED_RAD_S = np.radians([100.0, 100.0])
BRAKE_S = 0.4
"""In which a motion that is broken off comes to rest."""
ACCELERATION_RAD_S2 = np.radians(500.0)
"""Bound of random moves: not twice what the paper's motion of joint 1 has."""
_SYNCHRONOUS_HALF_PERIOD_S = (2.25, 2.25)


@dataclass(frozen=True)
class Motion:
    """A desired motion: q_d, dq_d, ddq_d (n, 2)."""

    name: str
    q_d: NDArray[np.float64]
    dq_d: NDArray[np.float64]
    ddq_d: NDArray[np.float64]

    @property
    def duration_s(self) -> float:
        """How long it lasts."""
        return len(self.q_d) * PERIOD_S


def paper_motion(duration_s: float, is_synchronous: bool = False) -> Motion:
    """Return the paper's motion between two corners, as printed (1.125 s and 4.5 s) or with a common half period."""
    settings = TrajectorySettings()
    half_period_s = np.array(_SYNCHRONOUS_HALF_PERIOD_S if is_synchronous else settings.half_period_s)
    motion = _still("synchronous" if is_synchronous else "paper", round(duration_s / PERIOD_S), np.zeros(2))
    amplitude = np.radians(settings.amplitude_deg)
    for k in range(len(motion.q_d)):
        corner_to_corner(k * PERIOD_S, amplitude, half_period_s, motion.q_d[k], motion.dq_d[k], motion.ddq_d[k])
    return motion


def random_moves(
    seed: int,
    duration_s: float,
    start: NDArray[np.float64] | None = None,
    speed_share: tuple[float, float] = (0.1, 1.0),
) -> Motion:
    """Return quintic moves between random places, at random speeds, with random dwells; sometimes one joint rests.

    `speed_share`: least and largest peak speed, as a share of SPEED_RAD_S.
    """
    generator = np.random.default_rng([seed, 1])
    count = round(duration_s / PERIOD_S)
    at = generator.uniform(-REACH_RAD, REACH_RAD) if start is None else np.asarray(start, np.float64)
    parts, cycles = [], 0
    while cycles < count:
        target = generator.uniform(-REACH_RAD, REACH_RAD)
        resting = generator.random()
        if resting < 0.2:
            target[int(resting < 0.1)] = at[int(resting < 0.1)]
        speed = SPEED_RAD_S * np.exp(generator.uniform(*np.log(speed_share), 2))
        part = _move(at, target, speed, bool(generator.random() < 0.5))
        parts.append(part)
        if generator.random() < 0.5:
            parts.append(_still("", round(generator.exponential(0.6) / PERIOD_S), target))
            cycles += len(parts[-1].q_d)
        cycles += len(part.q_d)
        at = target
    return _cut(f"moves {seed}", parts, count)


def multisine(seed: int, duration_s: float, tones: int = 5, band_Hz: tuple[float, float] = (0.05, 0.8)) -> Motion:
    """Return a sum of sines per joint that begins at rest, within REACH_RAD and SPEED_RAD_S."""
    generator = np.random.default_rng([seed, 2])
    t = np.arange(round(duration_s / PERIOD_S)) * PERIOD_S
    rate = 2.0 * np.pi * np.exp(generator.uniform(*np.log(band_Hz), (tones, 2)))
    size = generator.uniform(0.3, 1.0, (tones, 2)) / rate
    angle = rate[:, None, :] * t[None, :, None] + generator.uniform(0.0, 2.0 * np.pi, (tones, 1, 2))
    q = np.sum(size[:, None] * np.sin(angle), 0)
    dq = np.sum((size * rate)[:, None] * np.cos(angle), 0)
    ddq = -np.sum((size * rate**2)[:, None] * np.sin(angle), 0)
    rise_s = min(1.5, duration_s)
    x = np.minimum(t / rise_s, 1.0)[:, None]
    w, dw, ddw = _quintic(x)
    q, dq, ddq = w * q, w * dq + dw / rise_s * q, w * ddq + 2.0 * dw / rise_s * dq + ddw / rise_s**2 * q
    share = np.minimum(REACH_RAD / np.abs(q).max(0), SPEED_RAD_S / np.abs(dq).max(0))
    share = np.minimum(share, ACCELERATION_RAD_S2 / np.abs(ddq).max(0)) * generator.uniform(0.5, 1.0, 2)
    return Motion(f"multisine {seed}", q * share, dq * share, ddq * share)


def random_motion(seed: int, duration_s: float) -> Motion:
    """Return random moves or, one time in four, a multisine."""
    return multisine(seed, duration_s) if seed % 4 == 3 else random_moves(seed, duration_s)


def still(at: NDArray[np.float64], duration_s: float) -> Motion:
    """Stand at a place (2,)."""
    return _still("", round(duration_s / PERIOD_S), at)


def cut(motion: Motion, count: int) -> Motion:
    """Return the first `count` cycles of a motion."""
    return Motion(motion.name, motion.q_d[:count], motion.dq_d[:count], motion.ddq_d[:count])


def join(motions: Sequence[Motion], speed_deg_s: float = 40.0) -> Motion:
    """Play motions one after the other, from whatever the one ends with by a quintic to where the next one begins.

    Each but the first begins at rest.
    """
    parts: list[Motion] = []
    for motion in motions:
        if parts:
            parts.append(_lead(parts[-1], motion.q_d[0], np.radians(speed_deg_s)))
        parts.append(motion)
    return _cut(" + ".join(motion.name for motion in motions), parts, sum(len(part.q_d) for part in parts))


def _lead(before: Motion, end: NDArray[np.float64], speed_rad_s: float) -> Motion:
    """Lead from the last cycle of a motion to rest, if it moves, and from there to rest at `end` (2,)."""
    q, dq, ddq = before.q_d[-1], before.dq_d[-1], before.ddq_d[-1]
    if np.any(dq) or np.any(ddq):
        # straight to the end it would overshoot, far if that takes long
        stop = _way(q, dq, ddq, q + 0.5 * BRAKE_S * dq, BRAKE_S)
        return _cut("", [stop, rest := _lead(stop, end, speed_rad_s)], len(stop.q_d) + len(rest.q_d))
    duration_s = QUINTIC_PEAK_SPEED * float(np.abs(end - q).max()) / speed_rad_s
    if duration_s < PERIOD_S:
        return _still("", 0, end)
    return _way(q, dq, ddq, end, max(duration_s, SHORTEST_APPROACH_S))


def to_rest(q: Vector, dq: Vector, ddq: Vector, q_end: Vector, duration_s: float) -> Vector:
    """Return the quintic's coefficients (6, 2), lowest order first, from (q, dq, ddq) to rest at `q_end`."""
    T = duration_s
    travel = q_end - q
    return np.vstack(
        [
            q,
            dq,
            ddq / 2.0,
            (20.0 * travel - 12.0 * dq * T - 3.0 * ddq * T**2) / (2.0 * T**3),
            (-30.0 * travel + 16.0 * dq * T + 3.0 * ddq * T**2) / (2.0 * T**4),
            (12.0 * travel - 6.0 * dq * T - ddq * T**2) / (2.0 * T**5),
        ]
    )


@compiled
def evaluate(coefficients: Vector, elapsed_s: float, q: Vector, dq: Vector, ddq: Vector) -> None:
    """Fill the motion of a quintic at `elapsed_s`."""
    t = elapsed_s
    for i in range(JOINTS):
        c0, c1, c2 = coefficients[0, i], coefficients[1, i], coefficients[2, i]
        c3, c4, c5 = coefficients[3, i], coefficients[4, i], coefficients[5, i]
        q[i] = c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * c5))))
        dq[i] = c1 + t * (2.0 * c2 + t * (3.0 * c3 + t * (4.0 * c4 + t * 5.0 * c5)))
        ddq[i] = 2.0 * c2 + t * (6.0 * c3 + t * (12.0 * c4 + t * 20.0 * c5))


def _way(
    q: NDArray[np.float64], dq: NDArray[np.float64], ddq: NDArray[np.float64], end: NDArray[np.float64], lasts_s: float
) -> Motion:
    """Move by a quintic to rest at `end` (2,)."""
    count = round(lasts_s / PERIOD_S)
    coefficients = to_rest(q, dq, ddq, end, count * PERIOD_S)
    way = _still("", count, end)
    for k in range(count - 1):
        evaluate(coefficients, (k + 1) * PERIOD_S, way.q_d[k], way.dq_d[k], way.ddq_d[k])
    return way


def _quintic(
    x: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the rest-to-rest quintic from 0 to 1 and its two derivatives by x."""
    value = x**3 * (10.0 + x * (-15.0 + 6.0 * x))
    return value, 30.0 * x**2 * (1.0 - x) ** 2, x * (60.0 + x * (-180.0 + 120.0 * x))


def _still(name: str, count: int, at: NDArray[np.float64]) -> Motion:
    return Motion(name, np.tile(at, (count, 1)), np.zeros((count, 2)), np.zeros((count, 2)))


def _move(
    start: NDArray[np.float64], end: NDArray[np.float64], speed: NDArray[np.float64], is_synchronous: bool
) -> Motion:
    """Move by quintics that keep to peak speeds (2,) and ACCELERATION_RAD_S2; the quicker joint waits at its end."""
    travel = end - start
    by_acceleration = np.sqrt(QUINTIC_PEAK_ACCELERATION * np.abs(travel) / ACCELERATION_RAD_S2)
    duration_s = np.maximum(QUINTIC_PEAK_SPEED * np.abs(travel) / speed, by_acceleration) + PERIOD_S
    if is_synchronous:
        duration_s[:] = duration_s.max()
    count = int(np.ceil(duration_s.max() / PERIOD_S))
    x = np.minimum(np.arange(count)[:, None] * PERIOD_S / duration_s, 1.0)
    value, rate, acceleration = _quintic(x)
    return Motion("", start + travel * value, travel / duration_s * rate, travel / duration_s**2 * acceleration)


def _cut(name: str, parts: Sequence[Motion], count: int) -> Motion:
    return Motion(
        name,
        np.concatenate([part.q_d for part in parts])[:count],
        np.concatenate([part.dq_d for part in parts])[:count],
        np.concatenate([part.ddq_d for part in parts])[:count],
    )
