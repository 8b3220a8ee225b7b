"""When a cycle begins: at once in lockstep, on a fixed grid in real time."""

from typing import NamedTuple, Protocol

from adacd_hil.clock import Clock, VirtualClock


class Tick(NamedTuple):
    """The beginning of one cycle. `periods` since the previous one, 1 unless periods were skipped."""

    cycle: int
    t_ns: int
    periods: int
    lateness_ns: int


class Pacer(Protocol):
    """Decides when the next cycle begins."""

    overruns: int

    def next(self) -> Tick:
        """Wait for the next cycle and return its beginning."""

    def resume(self) -> None:
        """Go on after a pause that was meant: its periods are passed over and not counted as overruns."""


class Recurrence:
    """Something that is done every so many cycles, and after skipped ones as soon as there is a cycle again."""

    def __init__(self, interval_s: float, period_s: float) -> None:
        self._cycles = max(1, round(interval_s / period_s))
        self._due_cycle = 0

    def is_due(self, cycle: int) -> bool:
        """Whether it is to be done in this cycle; asked once per cycle."""
        if cycle < self._due_cycle:
            return False
        self._due_cycle = cycle - cycle % self._cycles + self._cycles
        return True


class LockstepPacer:
    """Begins a cycle as soon as it is asked, and moves the virtual clock by one period each time."""

    def __init__(self, clock: VirtualClock, period_ns: int) -> None:
        self.overruns = 0
        self._clock = clock
        self._period_ns = period_ns
        self._cycle = -1

    def next(self) -> Tick:
        """Return the next cycle's beginning, at once."""
        self._cycle += 1
        t_ns = self._cycle * self._period_ns
        self._clock.sleep_until_ns(t_ns)
        return Tick(self._cycle, t_ns, 1, 0)

    def resume(self) -> None:
        """Let the next cycle begin at the first multiple of the period that the clock has not passed."""
        self._cycle = max(self._cycle, -(-self._clock.now_ns() // self._period_ns) - 1)


class GridPacer:
    """Begins cycles on a fixed grid; a late one doesn't move the grid, a very late one skips whole periods."""

    def __init__(self, clock: Clock, period_ns: int) -> None:
        self.overruns = 0
        self._clock = clock
        self._period_ns = period_ns
        self._start_ns: int | None = None
        self._cycle = -1

    def next(self) -> Tick:
        """Sleep until the next grid point that is still ahead; the first call sets the grid."""
        if self._start_ns is None:
            self._start_ns = self._clock.now_ns() + self._period_ns
        previous = self._cycle
        self._cycle += 1
        due_ns = self._start_ns + self._cycle * self._period_ns
        self._clock.sleep_until_ns(due_ns)
        now_ns = self._clock.now_ns()
        skipped = (now_ns - due_ns) // self._period_ns
        if skipped > 0:
            self.overruns += skipped
            self._cycle += skipped
            due_ns += skipped * self._period_ns
        return Tick(self._cycle, now_ns, self._cycle - previous, now_ns - due_ns)

    def resume(self) -> None:
        """Let the next cycle begin on the next grid point that is ahead."""
        if self._start_ns is not None:
            self._cycle = max(self._cycle, (self._clock.now_ns() - self._start_ns) // self._period_ns)


def make_pacer(clock: Clock, period_ns: int) -> Pacer:
    """Make the pacer that goes with a clock: lockstep with a VirtualClock, else the grid."""
    return LockstepPacer(clock, period_ns) if isinstance(clock, VirtualClock) else GridPacer(clock, period_ns)
