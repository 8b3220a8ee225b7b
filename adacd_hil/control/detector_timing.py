"""How long live detectors take: measured before the run, and watched in it.

A decision never depends on it. In lockstep the run's own clock stands still while a detector works, so there the
measurement before the run is all that is told.
"""

from collections.abc import Callable
from typing import Final

from adacd_hil.clock import MonotonicClock, VirtualClock
from adacd_hil.device.arm_watch import RateLimitedEvents
from adacd_hil.records import Event
from adacd_hil.scheme.detect.live_detectors import LiveDetectors
from adacd_hil.settings.schema import DetectorError

REFUSED_SHARE: Final = 0.5
"""Of the period: a detector that takes as much leaves the cycle no time for frames; in real time it is refused."""
SLOW_SHARE: Final = 0.1
"""Of the period: a call in the run that takes longer is an event."""


class DetectorTiming(RateLimitedEvents):
    """Tells of detectors that take long."""

    def __init__(self, detectors: LiveDetectors | None, period_ns: int, clock: object) -> None:
        """clock: of the run."""
        super().__init__()
        self._detectors = detectors
        self._period_ns = period_ns
        self._is_real_time = not isinstance(clock, VirtualClock)

    def measure(self, progress: Callable[[str], None]) -> None:
        """Measure before the run, and say what each takes. Raises DetectorError in real time for one that is too slow.

        All of it is compiled by then.
        """
        if self._detectors is None:
            return
        now_ns = MonotonicClock().now_ns
        for name, took_ns in self._detectors.measure(now_ns).items():
            if self._is_real_time and took_ns > REFUSED_SHARE * self._period_ns:
                raise DetectorError(
                    f"`detector.live`: detector {name} takes {took_ns / 1e3:.0f} µs a cycle, more than "
                    f"{REFUSED_SHARE:g} of the period of {self._period_ns / 1e3:g} µs"
                )
            progress(f"live detector {name}: {took_ns / 1e3:.1f} µs of a period of {self._period_ns / 1e3:g} µs")
        self._detectors.stopwatch = now_ns if self._is_real_time else None

    def step(self, cycle: int, t_ns: int) -> None:
        """Look at what the detectors took in this cycle."""
        if self._detectors is None:
            return
        for each in self._detectors.running:
            if each.took_ns > SLOW_SHARE * self._period_ns:
                took = f"{each.took_ns / 1e3:.0f} µs in cycle {cycle}, at most {each.slowest_ns / 1e3:.0f} µs so far"
                self.say(t_ns, each.wish.name, Event("warning", "timing", f"detector {each.wish.name} took {took}"))
            each.took_ns = 0
