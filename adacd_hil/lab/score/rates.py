"""Exact bounds of shares and rates, by `CONFIDENCE`.

Sources: Clopper and Pearson, "The use of confidence or fiducial limits illustrated in the case of the binomial",
Biometrika 26 (1934); Garwood, "Fiducial limits for the Poisson distribution", Biometrika 28 (1936).
"""

import math
from typing import Final

from scipy.special import betaincinv, gammaincinv

CONFIDENCE: Final = 0.95
CONFIDENCE_TEXT: Final = f"{100.0 * CONFIDENCE:g} %"


def share_bounds(found: int, count: int) -> tuple[float, float]:
    """Return the exact two-sided interval, at `CONFIDENCE`, of a share that was seen in `found` of `count` cases.

    (0, 1) for no case; the low end is 0 if none was found, the high end 1 if all were.
    """
    rest = 0.5 * (1.0 - CONFIDENCE)
    low = float(betaincinv(found, count - found + 1, rest)) if found > 0 else 0.0
    high = float(betaincinv(found + 1, count - found, 1.0 - rest)) if found < count else 1.0
    return low, high


def rate_bound_per_h(alarms: int, hours: float) -> float:
    """Return the one-sided upper bound, at `CONFIDENCE`, of a rate, 1/h, after `alarms` in `hours`; inf without time.

    Without an alarm it is about 3 / hours.
    """
    return float(gammaincinv(alarms + 1, CONFIDENCE)) / hours if hours > 0.0 else math.inf


def least_rate_per_h(alarms: int, hours: float) -> float:
    """Return the one-sided lower bound, at `CONFIDENCE`, of a rate, 1/h, after `alarms` in `hours`.

    0 without an alarm or time.
    """
    return float(gammaincinv(alarms, 1.0 - CONFIDENCE)) / hours if alarms > 0 and hours > 0.0 else 0.0
