"""The only reader of time: integer nanoseconds, monotonic in a run.

`t_ns` is always a value of one of these clocks. Wall-clock time appears once, in the log's header.
"""

import time
from typing import Protocol


class Clock(Protocol):
    """A source of `t_ns`."""

    def now_ns(self) -> int:
        """Return the present time in ns."""

    def sleep_until_ns(self, t_ns: int) -> None:
        """Return at `t_ns`, at once if that has passed."""


class MonotonicClock:
    """The host's monotonic clock."""

    def now_ns(self) -> int:
        """Return CLOCK_MONOTONIC in ns."""
        return time.monotonic_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleep until `t_ns`; the kernel may wake us later, never much earlier."""
        remaining_ns = t_ns - time.monotonic_ns()
        while remaining_ns > 0:
            time.sleep(remaining_ns * 1e-9)
            remaining_ns = t_ns - time.monotonic_ns()


class VirtualClock:
    """A clock that moves only when told; starts at 0."""

    def __init__(self) -> None:
        self._t_ns = 0

    def now_ns(self) -> int:
        """Return the time reached so far in ns."""
        return self._t_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        """Move to `t_ns`; never backwards."""
        self._t_ns = max(self._t_ns, t_ns)


def wall_ns() -> int:
    """Return the wall clock, ns since 1970; for log headers only."""
    return time.time_ns()


def wall_offset_ns() -> int:
    """Return the wall clock minus CLOCK_MONOTONIC, ns; of three readings the one that was interrupted least."""
    offsets = []
    for _ in range(3):
        before_ns = time.monotonic_ns()
        now_ns = time.time_ns()
        after_ns = time.monotonic_ns()
        offsets.append((after_ns - before_ns, now_ns - (before_ns + after_ns) // 2))
    return min(offsets)[1]
