"""When a cycle begins: on a fixed grid, of the host's clock in real time, of a virtual one in lockstep."""

from typing import NamedTuple, Protocol

from adacd_hil.clock import Clock, VirtualClock
from adacd_hil.config import Settings
from adacd_hil.control.host_latency import HostLatency


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

    def spend(self, feedback_ns: int) -> int:
        """Let the host's work after the feedback take its time; return when its commands leave."""

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


class GridPacer:
    """Begins cycles on a fixed grid; a late one doesn't move the grid, a very late one skips whole periods.

    The grid is that of the clock's whole periods.
    """

    def __init__(self, clock: Clock, period_ns: int, latency: HostLatency | None = None) -> None:
        """`latency`: how long the host's work takes by a clock that doesn't go on while it works."""
        self.overruns = 0
        self._latency = latency
        self._clock = clock
        self._period_ns = period_ns
        self._start_ns: int | None = None
        self._cycle = -1

    def next(self) -> Tick:
        """Sleep until the next grid point that is still ahead; the first call sets the grid."""
        if self._start_ns is None:
            self._start_ns = -(-self._clock.now_ns() // self._period_ns) * self._period_ns
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

    def spend(self, feedback_ns: int) -> int:
        """Move a virtual clock by the modelled latency; in real time the commands carry the feedback's stamp."""
        if self._latency is not None:
            feedback_ns += self._latency.draw_ns()
            self._clock.sleep_until_ns(feedback_ns)
        return feedback_ns

    def resume(self) -> None:
        """Let the next cycle begin on the next grid point that is ahead."""
        if self._start_ns is not None:
            self._cycle = max(self._cycle, (self._clock.now_ns() - self._start_ns) // self._period_ns)


def make_pacer(settings: Settings, clock: Clock) -> Pacer:
    """Make the pacer that goes with a clock: with a VirtualClock the host's work takes a modelled time."""
    bus = settings.bus
    is_virtual = isinstance(clock, VirtualClock)
    return GridPacer(clock, bus.period_ns, HostLatency(settings.lockstep, bus.period_s) if is_virtual else None)
