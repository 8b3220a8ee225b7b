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
    """Return the rms of the white noise on smooth series: (n,) for parts (k, n), a 0-d array for parts (k,).

    It is estimated by the median of the second differences of all parts, which motion hardly changes. 0 if no part has
    three samples.
    """
    seconds = np.concatenate([np.abs(np.diff(part, 2, axis=0)) for part in parts])
    if not len(seconds):
        return np.zeros(seconds.shape[1:])
    return np.asarray(_MEDIAN_TO_SIGMA * np.median(seconds, axis=0))


def resolution(values: Vector) -> float:
    """Return the step of a quantised series (k,), k > 0: the smallest difference between two of its values.

    Differences of up to 1e-9 of the series' range are rounding and don't count. 0 if all values are equal, or one is
    NaN.
    """
    levels = np.unique(values)
    steps = np.diff(levels)
    steps = steps[steps > 1e-9 * (levels[-1] - levels[0])]
    return float(steps.min()) if steps.size else 0.0


def low_pass(values: Vector, poles_rad_s: Sequence[float], period_s: float) -> Vector:
    """Return series (k,) or (k, n) after one first-order low-pass per pole in turn; each filter starts at 0."""
    from scipy.signal import lfilter  # takes half a second to load

    for pole in poles_rad_s:
        decay = math.exp(-pole * period_s)
        values = np.asarray(lfilter([1.0 - decay], [1.0, -decay], values, axis=0))
    return values
