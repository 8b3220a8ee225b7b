"""An imperfect joint encoder, from the angle of its shaft to the angle that the drive reads.

Of the true angle θ, rad:

    disc     φ = θ + index error + e₁ sin(θ + p₁) + e₂ sin(2θ + p₂)
    reading  φ plus noise, rounded to 2^bits counts per revolution

e₁ is the eccentricity of the disc over its radius, e₂ that of an elliptic or tilted disc. The drive's velocity
follows from the reading, and the wire carries it in its own counts of 2^20 per revolution: a coarser encoder steps.
"""

import math
from typing import Final

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from firmware_sim.arm.sensor_settings import SensorSettings

# Places in the vector of numbers; pairs are joint 1, joint 2.
INDEX_ERROR: Final = 0  # rad
ONCE: Final = 2  # e₁, rad
ONCE_PHASE: Final = 4  # p₁, rad
TWICE: Final = 6  # e₂, rad
TWICE_PHASE: Final = 8  # p₂, rad
LSB: Final = 10  # rad
ENCODER_NUMBERS: Final = 12

NOISE_TICKS: Final = 64
"""Ticks whose noise is drawn at once, in a few µs; a call that advances the arm by more is divided."""


def encoder_numbers(settings: SensorSettings) -> Vector:
    """Pack the encoders' properties for compiled functions (ENCODER_NUMBERS,)."""
    numbers = np.zeros(ENCODER_NUMBERS)
    numbers[INDEX_ERROR : INDEX_ERROR + 2] = settings.index_error_rad
    numbers[ONCE : ONCE + 2] = settings.eccentricity_rad
    numbers[ONCE_PHASE : ONCE_PHASE + 2] = settings.eccentricity_phase_rad
    numbers[TWICE : TWICE + 2] = settings.ellipticity_rad
    numbers[TWICE_PHASE : TWICE_PHASE + 2] = settings.ellipticity_phase_rad
    numbers[LSB : LSB + 2] = [2.0 * math.pi / (1 << bits) for bits in settings.encoder_bits]
    return numbers


@compiled
def read_angle(numbers: Vector, joint: int, angle_rad: float, noise_counts: float) -> float:
    """Give the angle that the drive reads, rad."""
    disc_rad = angle_rad + numbers[INDEX_ERROR + joint]
    if numbers[ONCE + joint] != 0.0:
        disc_rad += numbers[ONCE + joint] * math.sin(angle_rad + numbers[ONCE_PHASE + joint])
    if numbers[TWICE + joint] != 0.0:
        disc_rad += numbers[TWICE + joint] * math.sin(2.0 * angle_rad + numbers[TWICE_PHASE + joint])
    lsb_rad = numbers[LSB + joint]
    return float(math.floor(disc_rad / lsb_rad + noise_counts + 0.5) * lsb_rad)


class EncoderNoise:
    """The noise of both encoders at every tick, so that a run doesn't depend on how its ticks were asked for."""

    def __init__(self, seed: np.random.SeedSequence, rms_counts: tuple[float, float]) -> None:
        self.is_on = any(rms_counts)
        self.table = np.zeros((2 * NOISE_TICKS, 2))
        """Row `tick % (2 · NOISE_TICKS)`: noise of that tick, counts. Zero when it is off."""
        self._generator = np.random.default_rng(seed)
        self._rms_counts = np.array(rms_counts)
        self._drawn = 0  # ticks

    def draw(self, last_tick: int) -> None:
        """Provide the ticks up to `last_tick`, at most NOISE_TICKS after the one before them."""
        while self._drawn <= last_tick:
            first = self._drawn % (2 * NOISE_TICKS)
            rows = self.table[first : first + NOISE_TICKS]
            self._generator.standard_normal(out=rows)
            rows *= self._rms_counts
            self._drawn += NOISE_TICKS
