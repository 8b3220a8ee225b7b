"""The smallest push that the certified scheme finds in time, by thresholds and residuals of each moment.

A channel whose response to a step of 1 is g after `WITHIN_S` is then over its threshold h, whatever the sign, if

    |tau_ext| > (h + |r|) / g

with r what it shows without the push. A bare channel counts only if the smoothed one of its filter is over AGREES h as
well (`scheme.sensitivity`). Of all channels the least counts. The threshold *in force* is the least h. Both
stand for the cycles in MONITOR in which nothing touches the arm, and assume that h and r stay as they are meanwhile. So
what a moment says is an estimate: of 300 pushes 2 % larger than at their moment 247 were found in 100 ms, the others as
h rose. Of 300 as large as at the worst moment all were, after 59 ms at most.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from adacd_hil.analysis.confidence_bounds import rate_bound_per_h
from adacd_hil.analysis.distribution import Distribution
from adacd_hil.config import Settings
from adacd_hil.records import JOINTS, Vector
from adacd_hil.scheme.bank import channels_of, step_response
from adacd_hil.scheme.sensitivity import AGREES

WITHIN_S: Final = 0.1
"""The slowest filter is at 0.63 of a step by then, without its smoothing."""


@dataclass(frozen=True)
class SmallestPush:
    """Of each joint the percentiles p50, p99, p99.9 and max, Nm, over so many hours of MONITOR without a touch."""

    push_Nm: tuple[dict[str, float], ...]
    threshold_Nm: tuple[dict[str, float], ...]
    hours: float

    def false_alarm_bound_per_h(self, false_alarms: int) -> float:
        """Give the upper 95 % bound of the rate of false alarms, by counting alone: 3 / T where there was none."""
        return rate_bound_per_h(false_alarms, self.hours)


class PushGatherer:
    """Gathers the cycles of MONITOR in which nothing touches the arm."""

    def __init__(self, settings: Settings) -> None:
        channels = channels_of(settings)
        self._response = np.array([step_response(WITHIN_S, cutoff, smoothing) for cutoff, smoothing in channels])
        self._filters = len(settings.certified.cutoffs_rad_s)
        self._period_s = settings.bus.period_s
        self._push, self._threshold = ([Distribution() for _ in range(JOINTS)] for _ in range(2))

    def add(self, tau_ext: Vector, threshold: Vector) -> None:
        """Take in residuals and thresholds (k, channels, 2), k > 0."""
        found = (threshold + np.abs(tau_ext)) / self._response[:, None]
        agreed = (AGREES * threshold + np.abs(tau_ext)) / self._response[:, None]
        bare = np.maximum(found[:, self._filters :], agreed[:, 1 : self._filters])
        push = np.concatenate((found[:, : self._filters], bare), axis=1).min(axis=1)
        in_force = threshold.min(axis=1)
        for joint in range(JOINTS):
            self._push[joint].add(push[:, joint])
            self._threshold[joint].add(in_force[:, joint])

    def smallest_push(self) -> SmallestPush | None:
        """Sum up; None where nothing has been taken in."""
        if not self._push[0].count:
            return None
        return SmallestPush(
            push_Nm=tuple(each.percentiles() for each in self._push),
            threshold_Nm=tuple(each.percentiles() for each in self._threshold),
            hours=self._push[0].count * self._period_s / 3600.0,
        )
