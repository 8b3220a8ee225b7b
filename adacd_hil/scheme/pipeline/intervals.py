"""The measured interval between two samples, s; 0 where it is unknown or not to be used.

Between the SYNCs on which they were taken: a sample that comes late was still taken in time.
"""

import numpy as np

from adacd_hil.records import ArmBatch, ArmState, Vector
from adacd_hil.settings.configuration import Settings


class Intervals:
    """Turns the stamps of fresh samples into the intervals that the scheme integrates over."""

    def __init__(self, settings: Settings) -> None:
        self._is_measuring = settings.realtime.sample_period == "measured"
        self._sampled_ns: int | None = None

    def since_last(self, arm: ArmState) -> float:
        """Take in one cycle; 0 for one without a fresh sample."""
        if not (self._is_measuring and arm.is_complete):
            return 0.0
        sampled_ns = arm.t_ns if arm.sampled_ns is None else arm.sampled_ns
        period_s = 0.0 if self._sampled_ns is None else (sampled_ns - self._sampled_ns) * 1e-9
        self._sampled_ns = sampled_ns
        return period_s

    def between(self, arms: ArmBatch) -> Vector:
        """Take in n cycles and return the interval before each (n,); 0 for one without a fresh sample."""
        periods_s = np.zeros(arms.cycle.size)
        sampled_ns = arms.sampled_ns[arms.is_complete]
        if not self._is_measuring or not sampled_ns.size:
            return periods_s
        first_ns = sampled_ns[0] if self._sampled_ns is None else self._sampled_ns
        periods_s[arms.is_complete] = np.diff(sampled_ns, prepend=first_ns) * 1e-9
        self._sampled_ns = int(sampled_ns[-1])
        return periods_s
