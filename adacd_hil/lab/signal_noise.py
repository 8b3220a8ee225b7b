"""White noise, resolution and low-pass filters of measured series.

Shapes: series (k,) or (k, n), time-first.
"""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from adacd_hil.records import Vector

_MEDIAN_TO_SIGMA: Final = 1.4826 / math.sqrt(6.0)  # of the second difference of white noise


def white_noise(*parts: Vector) -> Vector:
    """Estimate the rms of the white noise on otherwise smooth series: (n,) for parts (k, n), a number for parts (k,).

    By the median of the second differences of all parts, which motion hardly changes. 0 if no part has three samples.
    """
    seconds = np.concatenate([np.abs(np.diff(part, 2, axis=0)) for part in parts])
    if not len(seconds):
        return np.zeros(seconds.shape[1:])
    return np.asarray(_MEDIAN_TO_SIGMA * np.median(seconds, axis=0))


def resolution(values: Vector) -> float:
    """Return the step of a quantised series (k,): its smallest difference of two values, 0 if it never changes."""
    levels = np.unique(values)
    steps = np.diff(levels)
    steps = steps[steps > 1e-9 * (levels[-1] - levels[0])]
    return float(steps.min()) if steps.size else 0.0


def low_pass(values: Vector, poles_rad_s: Sequence[float], period_s: float) -> Vector:
    """Filter series (k,) or (k, n) by a first-order low-pass per pole, one after the other, each 0 at the start."""
    from scipy.signal import lfilter  # takes half a second to load

    for pole in poles_rad_s:
        decay = math.exp(-pole * period_s)
        values = np.asarray(lfilter([1.0 - decay], [1.0, -decay], values, axis=0))
    return values
