"""The only reader of time: integer nanoseconds, monotonic in a run.

In a run `t_ns` is always a value of one of these clocks. Wall-clock time is for dates: in the log's header, a tare, the
history, names of folders.
"""

import ctypes
import os
import time
from typing import Protocol

CLOCKS = LOCKSTEP, REALTIME = "lockstep", "realtime"

_CLOCK_MONOTONIC = 1
_TIMER_ABSTIME = 1
_EINTR = 4
_NS_PER_S = 1_000_000_000


class _Timespec(ctypes.Structure):
    """struct timespec of Linux on 64 bits."""

    _fields_ = (("seconds", ctypes.c_int64), ("nanoseconds", ctypes.c_int64))


class Clock(Protocol):
    """A clock whose times in ns are the `t_ns` of a run."""

    def now_ns(self) -> int:
        """Return the present time in ns."""

    def sleep_until_ns(self, t_ns: int) -> None:
        """Wait until `t_ns`; return at once if it has passed."""


class MonotonicClock:
    """The host's monotonic clock."""

    def __init__(self) -> None:
        self._due = _Timespec()
        self._due_reference = ctypes.byref(self._due)
        self._sleep = ctypes.CDLL(None).clock_nanosleep

    def now_ns(self) -> int:
        """Return CLOCK_MONOTONIC in ns."""
        return time.monotonic_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleep until `t_ns` in one system call; the kernel may wake the process later, never earlier.

        A signal's handler runs when the signal comes, and the sleep goes on after it. Raises OSError if the system call
        fails for another reason.
        """
        due = self._due
        due.seconds, due.nanoseconds = divmod(max(t_ns, 0), _NS_PER_S)
        while number := self._sleep(_CLOCK_MONOTONIC, _TIMER_ABSTIME, self._due_reference, None):
            if number != _EINTR:
                raise OSError(number, os.strerror(number))
            due.seconds, due.nanoseconds = divmod(max(t_ns, 0), _NS_PER_S)  # a handler may have slept, too


class VirtualClock:
    """A clock for lockstep: starts at 0 and moves only by `sleep_until_ns`."""

    def __init__(self) -> None:
        self._t_ns = 0

    def now_ns(self) -> int:
        """Return the time reached so far in ns."""
        return self._t_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        """Set the clock to `t_ns`, never backwards; doesn't wait."""
        self._t_ns = max(self._t_ns, t_ns)


def wall_ns() -> int:
    """Return the wall clock, ns since 1970; for dates only, since it may be set while a run lasts."""
    return time.time_ns()


def wall_offset_ns() -> int:
    """Return the wall clock minus CLOCK_MONOTONIC, ns: measured three times, the one with the shortest interruption."""
    offsets = []
    for _ in range(3):
        before_ns = time.monotonic_ns()
        now_ns = time.time_ns()
        after_ns = time.monotonic_ns()
        offsets.append((after_ns - before_ns, now_ns - (before_ns + after_ns) // 2))
    return min(offsets)[1]
