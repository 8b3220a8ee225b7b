"""The deadline policy: what is done when the host misses too many periods.

A miss is a period that was skipped whole: its SYNC was never sent. A SYNC that is late by less than a period is none;
the devices sample late, and the scheme counts with the interval that was measured. Pauses that are meant, as between
two attempts, are no misses.

`realtime.misses` of them within `realtime.misses_window_s` are too many. By `realtime.on_misses` the run then faults,
or the arm brakes to rest and holds its place until the user acknowledges, where the scheme knows such a state.
"""

from collections import deque

from adacd_hil.records import ArmState, FaultReason
from adacd_hil.settings.configuration import Settings


class DeadlineWatch:
    """Counts the misses of one attempt over a sliding window."""

    def __init__(self, settings: Settings) -> None:
        realtime = settings.realtime
        self._most = realtime.misses
        self._window_s = realtime.misses_window_s
        self._window_cycles = max(1, round(realtime.misses_window_s / settings.bus.period_s))
        self._is_holding = realtime.on_misses == "hold"
        self._misses: deque[tuple[int, int]] = deque()  # cycle that came late, periods skipped before it
        self._count = 0
        self._verdict = ""

    def judge(self, arm: ArmState) -> ArmState:
        """Take in one cycle; return it as it is, or as that of a host which has missed too many."""
        misses = self._misses
        if arm.periods > 1:
            misses.append((arm.cycle, arm.periods - 1))
            self._count += arm.periods - 1
        while misses and arm.cycle - misses[0][0] >= self._window_cycles:
            self._count -= misses.popleft()[1]
        if self._count < self._most:
            return arm
        self._verdict = f"{self._count} periods missed within {self._window_s:g} s; {self._most} are too many"
        if self._is_holding:
            return arm._replace(is_late=True)
        return arm._replace(fault=FaultReason.DEADLINE) if arm.fault is FaultReason.NONE else arm

    def describe(self) -> str:
        """Say how many misses the last verdict was about; empty without one."""
        return self._verdict
