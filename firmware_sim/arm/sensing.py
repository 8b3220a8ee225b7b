"""Measurements of the devices: encoder, the drive's velocity, joint torque.

encoder    20 bit per revolution, rounded to the nearest count
velocity   critically damped tracking loop on the encoder at 10 kHz, v̂/q = ω² s / (s + ω)², ω = 2π · 200 rad/s;
           it lags a steady acceleration by 2/ω = 1.59 ms; sent with an LSB of 5e-4 rad/s
torque     white noise of 0.02 Nm rms at the SYNC sample, then a 16-bit converter over ±50 Nm that saturates

These are the defaults. `firmware_sim.body.sensors` and `firmware_sim.body.motor` have the errors that a scenario sets.
"""

import math
from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import compiled

ENCODER_COUNTS: Final = 1 << 20
"""Per revolution, 0x608F."""
POSITION_LSB_RAD: Final = 2.0 * math.pi / ENCODER_COUNTS
VELOCITY_LSB_RAD_S: Final = 5e-4
VELOCITY_LOOP_HZ: Final = 200.0
TRACKING_RAD_S: Final = 2.0 * math.pi * VELOCITY_LOOP_HZ
TORQUE_NOISE_NM: Final = 0.02
TORQUE_RANGE_NM: Final = 50.0
TORQUE_LSB_NM: Final = 2.0 * TORQUE_RANGE_NM / (1 << 16)
"""1.526 mNm."""
TORQUE_COUNTS: Final = (-(1 << 15), (1 << 15) - 1)
"""Ends of the converter's range; a value at either end is saturated."""

# Samples drawn at once: large enough for a negligible cost per sample, small enough to draw within 10 µs.
_SAMPLES_AT_ONCE: Final = 256


class DriveMode(IntEnum):
    """The torque that a drive asks of its motor. The drive node chooses; every mode can follow every other."""

    OFF = 0  # no torque, the arm coasts: Switched on and below, until the node enables
    TORQUE = 1  # follows the set-point: Operation enabled, until the node disables, stops or faults
    BRAKE = 2  # torque against the velocity: Quick stop and Fault reaction active, until the node sees standstill
    BRAKE_SLOWLY = 3  # as BRAKE, on the slow-down ramp: half the damping
    BRAKE_HARD = 4  # as BRAKE, up to the current limit: one and a half times the damping, the most that stays damped


@compiled
def to_counts(value: float, lsb: float) -> int:
    """Return a value in counts of `lsb`, rounded to the nearest, halves up."""
    return math.floor(value / lsb + 0.5)


@compiled
def torque_counts(torque_Nm: float, count_Nm: float = TORQUE_LSB_NM) -> int:
    """Return a torque in counts of `count_Nm`, rounded to the nearest, limited to TORQUE_COUNTS."""
    return min(max(to_counts(torque_Nm, count_Nm), TORQUE_COUNTS[0]), TORQUE_COUNTS[1])


@compiled
def track(
    before_rad: float,
    now_rad: float,
    estimate_rad: float,
    velocity_rad_s: float,
    tick_s: float,
    tracking_rad_s: float = TRACKING_RAD_S,
) -> tuple[float, float]:
    """Return the drive's estimates after one more tick of its tracking loop: position, rad, and velocity, rad/s.

    before, now: encoder positions at the two ends of the tick, taken as joined by a straight line. tracking: ω.
    Exact for

        p̂' = v̂ + 2ω (p − p̂),  v̂' = ω² (p − p̂)

    The line itself (p̂ = p, v̂ = its slope) is a solution, so only the distance from it decays, by the exponential
    of a matrix with the double eigenvalue −ω.
    """
    slope_rad_s = (now_rad - before_rad) / tick_s
    away_rad = estimate_rad - before_rad
    away_rad_s = velocity_rad_s - slope_rad_s
    turn = tracking_rad_s * tick_s
    decay = math.exp(-turn)
    return (
        now_rad + decay * ((1.0 - turn) * away_rad + tick_s * away_rad_s),
        slope_rad_s + decay * ((1.0 + turn) * away_rad_s - tracking_rad_s * turn * away_rad),
    )


class TorqueNoise:
    """Random numbers of both torque sensors: noise of their samples, or steps of their zeros.

    A seed always gives the same numbers.
    """

    def __init__(self, seed: int | np.random.SeedSequence, rms_Nm: float | tuple[float, float]) -> None:
        self._generator = np.random.default_rng(seed)
        self._rms_Nm = np.broadcast_to(np.asarray(rms_Nm, dtype=np.float64), (2,))
        self._is_on = bool(self._rms_Nm.any())
        self._block: NDArray[np.float64] = np.zeros((_SAMPLES_AT_ONCE, 2))
        self._next = _SAMPLES_AT_ONCE

    def draw(self) -> NDArray[np.float64]:
        """Return the next sample (2,), Nm, zeros if both rms are 0. Its memory is overwritten by later calls."""
        if self._next == _SAMPLES_AT_ONCE:
            self._next = 0
            if self._is_on:
                self._generator.standard_normal(out=self._block)
                self._block *= self._rms_Nm
        sample: NDArray[np.float64] = self._block[self._next]
        self._next += 1
        return sample


class Measurement(NamedTuple):
    """Measurement of the devices at one SYNC, as raw counts."""

    position_counts: tuple[int, int]
    velocity_counts: tuple[int, int]
    torque_counts: tuple[int, int]
