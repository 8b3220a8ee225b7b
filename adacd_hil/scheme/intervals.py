"""The measured interval between two samples, s; 0 where it is unknown or not to be used."""

import numpy as np
from numpy.typing import NDArray

from adacd_hil.config import Settings
from adacd_hil.records import Vector


class Intervals:
    """Turns the stamps of consecutive cycles into the intervals that the scheme integrates over."""

    def __init__(self, settings: Settings) -> None:
        self._is_measuring = settings.realtime.sample_period == "measured"
        self._t_ns: int | None = None

    def since_last(self, t_ns: int) -> float:
        """Take in one cycle's stamp."""
        if not self._is_measuring:
            return 0.0
        period_s = 0.0 if self._t_ns is None else (t_ns - self._t_ns) * 1e-9
        self._t_ns = t_ns
        return period_s

    def between(self, t_ns: NDArray[np.int64]) -> Vector:
        """Take in the stamps of many cycles (n,) and return the interval before each."""
        periods_s = np.zeros(t_ns.size)
        if not self._is_measuring or not t_ns.size:
            return periods_s
        periods_s[1:] = np.diff(t_ns) * 1e-9
        periods_s[0] = self.since_last(int(t_ns[0]))
        self._t_ns = int(t_ns[-1])
        return periods_s
