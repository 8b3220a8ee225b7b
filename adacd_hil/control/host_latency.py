"""How long a modelled host takes between the last feedback of a cycle and its commands; lockstep only.

In real time the work takes as long as it takes. In lockstep no time passes by itself, so a distribution stands for it:

    constant    latency_us
    uniform     latency_us … latency_high_us
    lognormal   median latency_us, exceeded by 1 in 1000: latency_high_us

With `stall_every_s`, one cycle in that time (at random, on average) takes `stall_us` longer: a machine that was away.
"""

import math
from typing import Final

import numpy as np

from adacd_hil.settings.bus_settings import LockstepSettings

_BLOCK: Final = 1024
_TAIL: Final = 3.090232306167813
"""Standard deviations of a normal distribution that 1 in 1000 exceeds."""


class HostLatency:
    """Draws latencies from the configured distribution."""

    def __init__(self, settings: LockstepSettings, period_s: float) -> None:
        self._settings = settings
        self._stall_share = period_s / settings.stall_every_s if settings.stall_every_s > 0.0 else 0.0
        self._constant_ns = round(settings.latency_us * 1000)
        self._is_constant = settings.latency == "constant" and self._stall_share == 0.0
        self._generator = np.random.default_rng(settings.seed)
        self._drawn: list[int] = []

    def draw_ns(self) -> int:
        """Give the latency of the next cycle, ns."""
        if self._is_constant:
            return self._constant_ns
        if not self._drawn:
            self._drawn = self._draw_block()
        return self._drawn.pop()

    def _draw_block(self) -> list[int]:
        settings, generator = self._settings, self._generator
        low_us, high_us = settings.latency_us, settings.latency_high_us
        if settings.latency == "uniform":
            latency_us = generator.uniform(low_us, high_us, _BLOCK)
        elif settings.latency == "lognormal":
            sigma = math.log(high_us / low_us) / _TAIL
            latency_us = low_us * np.exp(sigma * generator.standard_normal(_BLOCK))
        else:
            latency_us = np.full(_BLOCK, low_us)
        latency_us = latency_us + settings.stall_us * (generator.random(_BLOCK) < self._stall_share)
        drawn: list[int] = np.rint(latency_us[::-1] * 1000.0).astype(np.int64).tolist()
        return drawn
