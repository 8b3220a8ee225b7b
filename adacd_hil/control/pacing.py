"""The begin of a cycle: on a fixed grid, of the host's clock in real time, of a virtual one in lockstep.

If another host on the bus sends SYNC, a cycle begins with that SYNC.
"""

import math
import statistics
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

import numpy as np

from adacd_hil.clock import Clock, VirtualClock
from adacd_hil.scheduling import RealtimeGrant
from adacd_hil.settings.arm_settings import LockstepSettings
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import BusError, Frame, Tap
from adacd_hil.wire.contract_frames import SYNC_OVERFLOW

_BLOCK: Final = 1024
_TAIL: Final = 3.090232306167813
"""Standard deviations of a normal distribution that 1 in 1000 exceeds."""


class HostLatency:
    """How long a modelled host takes between the last feedback of a cycle and its commands; lockstep only.

    In real time the work takes as long as it takes. In lockstep no time passes by itself; a distribution stands for it:

        constant    latency_us
        uniform     latency_us … latency_high_us
        lognormal   median latency_us, exceeded by 1 in 1000: latency_high_us

    With `stall_every_s`, one cycle in that time (at random, on average) takes `stall_us` longer: a machine that was
    away.
    """

    def __init__(self, settings: LockstepSettings, period_s: float) -> None:
        self._settings = settings
        self._stall_share = period_s / settings.stall_every_s if settings.stall_every_s > 0.0 else 0.0
        self._generator = np.random.default_rng(settings.seed)
        self._drawn: list[int] = []

    def draw_ns(self) -> int:
        """Return the latency of the next cycle, ns."""
        if not self._drawn:
            self._drawn = self._draw_block()
        return self._drawn.pop()

    def _draw_block(self) -> list[int]:
        """Return the latencies of the next _BLOCK cycles, ns, that of the next cycle last."""
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


MOST_FRAMES = 1000
"""Frames taken at once, so that a bus that somebody floods can't hold up the cycle: a classic one carries 21 per ms."""
_JUDGED_SYNCS = 101
"""SYNCs after which their period is judged. The median of so many doesn't mind that a host stalls."""
_PERIOD_TOLERANCE = 0.1
_CALIBRATION_SLEEPS = 50
_CALIBRATION_LOW_NS, _CALIBRATION_HIGH_NS = 200_000, 1_000_000
_SPIN_SHARE = 0.95
"""Share of the measured sleeps whose lateness the spin covers: greater lateness is not due to the timer."""
_MOST_SPIN_NS = 100_000
_MOST_SPIN_SHARE = 0.1


class Tick(NamedTuple):
    """The beginning of one cycle. `periods` since the previous one, 1 unless periods were skipped.

    `t_ns`: its time; `lateness_ns`: behind the grid, or since the received SYNC.

    Of a SYNC that was received: `late` came before it and belongs to the cycle before, `ahead` came after it.
    """

    cycle: int
    t_ns: int
    periods: int
    lateness_ns: int
    late: tuple[Frame, ...] = ()
    ahead: tuple[Frame, ...] = ()


@dataclass(frozen=True)
class SpinCalibration:
    """How late sleeps were woken, ns, and how long the pacer spins because of it."""

    p50_ns: int
    p99_ns: int
    max_ns: int
    spin_ns: int


class Pacer(Protocol):
    """Decides when the next cycle begins. `spin_ns`: how long before that it reads the clock instead of sleeping."""

    overruns: int
    spin_ns: int

    def next(self) -> Tick:
        """Wait until the next cycle begins; return its number, time and lateness."""

    def command_time(self, feedback_ns: int) -> int:
        """Return the time at which the cycle's commands leave, ns; in lockstep, first move the clock by modelled work.

        feedback_ns: time of the last feedback.
        """

    def resume(self) -> None:
        """End an intended pause: the next cycle skips the pause's periods and doesn't count them as overruns."""


class GridPacer:
    """Begins cycles on a fixed grid; a late one doesn't move the grid, a very late one skips whole periods.

    The grid is that of the clock's whole periods.
    """

    def __init__(self, clock: Clock, period_ns: int, latency: HostLatency | None = None) -> None:
        """`latency`: the modelled time of the host's work for a virtual clock, None in real time."""
        self.overruns = 0
        self.spin_ns = 0
        self._latency = latency
        self._clock = clock
        self._period_ns = period_ns
        self._start_ns: int | None = None
        self._cycle = -1

    def next(self) -> Tick:
        """Sleep until the next grid point and return the tick; if whole periods were missed, skip and count them.

        The first call sets the grid, at the clock's next whole period. For the last `spin_ns` read the clock in place
        of sleep.
        """
        if self._start_ns is None:
            self._start_ns = -(-self._clock.now_ns() // self._period_ns) * self._period_ns
        previous = self._cycle
        self._cycle += 1
        due_ns = self._start_ns + self._cycle * self._period_ns
        clock = self._clock
        clock.sleep_until_ns(due_ns - self.spin_ns)
        now_ns = clock.now_ns()
        while now_ns < due_ns:
            now_ns = clock.now_ns()
        skipped = (now_ns - due_ns) // self._period_ns
        if skipped > 0:
            self.overruns += skipped
            self._cycle += skipped
            due_ns += skipped * self._period_ns
        return Tick(self._cycle, now_ns, self._cycle - previous, now_ns - due_ns)

    def command_time(self, feedback_ns: int) -> int:
        """Return the clock's time, ns; with a modelled latency, first move the clock to feedback_ns plus that."""
        if self._latency is not None:
            self._clock.sleep_until_ns(feedback_ns + self._latency.draw_ns())
        return self._clock.now_ns()

    def resume(self) -> None:
        """Skip the periods of a pause, without counting them as overruns; do nothing before the first cycle."""
        if self._start_ns is not None:
            self._cycle = max(self._cycle, (self._clock.now_ns() - self._start_ns) // self._period_ns)


class FollowingPacer:
    """Begins a cycle with each SYNC that another host sends. Of several that wait, the last one counts.

    The first SYNC heard is cycle 0; from there its counter 1…240 is unwrapped, with the help of the clock after a long
    gap. Without a counter, the time between two SYNCs gives the number of periods.
    """

    def __init__(self, bus: Tap, clock: Clock, period_ns: int, sync_id: int, timeout_ns: int) -> None:
        self.overruns = 0
        self.spin_ns = 0
        self._bus = bus
        self._clock = clock
        self._period_ns = period_ns
        self._sync_id = sync_id
        self._timeout_ns = timeout_ns
        self._cycle = 0
        self._last: Frame | None = None
        self._is_resuming = False
        self._periods_ns: list[float] = []

    def next(self) -> Tick:
        """Wait for SYNC and return the cycle that it begins; count skipped periods as overruns, unless after `resume`.

        Raises BusError if it doesn't come within the timeout, or if the first `_JUDGED_SYNCS` come at another period
        than configured.
        """
        frames, place = self._receive()
        sync = frames[place]
        periods = self._count(sync)
        self._last = sync
        self._cycle += periods
        skipped = 0 if self._is_resuming else max(periods - 1, 0)
        self._is_resuming = False
        self.overruns += skipped
        lateness_ns = self._clock.now_ns() - sync.t_ns
        return Tick(self._cycle, sync.t_ns, 1 + skipped, lateness_ns, tuple(frames[:place]), tuple(frames[place + 1 :]))

    def command_time(self, feedback_ns: int) -> int:  # noqa: ARG002 (the protocol's signature)
        """Return the clock's time, ns."""
        return self._clock.now_ns()

    def resume(self) -> None:
        """Don't count the periods up to the next SYNC as overruns."""
        self._is_resuming = True

    def _receive(self) -> tuple[list[Frame], int]:
        """Return the frames up to SYNC and all that wait behind it, and the index of the last SYNC among them.

        Raises BusError if SYNC doesn't come in time.
        """
        bus, clock = self._bus, self._clock
        frames: list[Frame] = []
        place = -1
        limit_ns = clock.now_ns() + self._timeout_ns
        while place < 0:
            begin_ns = clock.now_ns()
            frame = bus.receive((limit_ns - begin_ns) * 1e-9)
            if frame is not None:
                frames.append(frame)
                place = len(frames) - 1 if self._is_sync(frame) else -1
            now_ns = clock.now_ns()
            if place < 0 and (now_ns >= limit_ns or (frame is None and now_ns == begin_ns)):
                raise BusError(
                    f"no SYNC on {bus.channel} within {self._timeout_ns // 1_000_000} ms: the host that sends it "
                    "begins first and ends last"
                )
        for _ in range(MOST_FRAMES):
            frame = bus.receive(0.0)
            if frame is None:
                break
            frames.append(frame)
            if self._is_sync(frame):
                place = len(frames) - 1
        return frames, place

    def _is_sync(self, frame: Frame) -> bool:
        return frame.can_id == self._sync_id and not frame.is_error

    def _count(self, sync: Frame) -> int:
        """Return the periods since the SYNC before, at least 1; 0 for the first.

        By the counters of both SYNCs, and the bus's times for whole rounds of the counter; by the times alone without
        counters. Raises BusError if the first `_JUDGED_SYNCS` with counters come at another period than configured.
        """
        last = self._last
        if last is None:
            return 0
        elapsed_ns = sync.t_ns - last.t_ns
        periods = round(elapsed_ns / self._period_ns)
        if sync.data and last.data:
            steps = (sync.data[0] - last.data[0]) % SYNC_OVERFLOW
            periods = steps + SYNC_OVERFLOW * round((periods - steps) / SYNC_OVERFLOW)
            self._judge(elapsed_ns / max(steps, 1))
        return max(periods, 1)

    def _judge(self, period_ns: float) -> None:
        """Add a period, ns; raise BusError if the median of the first `_JUDGED_SYNCS` isn't the configured one.

        It may be a share of `_PERIOD_TOLERANCE` away. Later periods are not judged.
        """
        if len(self._periods_ns) == _JUDGED_SYNCS:
            return
        self._periods_ns.append(period_ns)
        if len(self._periods_ns) < _JUDGED_SYNCS:
            return
        found_ns = statistics.median(self._periods_ns)
        if abs(found_ns - self._period_ns) > _PERIOD_TOLERANCE * self._period_ns:
            raise BusError(
                f"SYNC on {self._bus.channel} comes every {found_ns / 1000:.0f} µs, but `bus.period_us` = "
                f"{self._period_ns // 1000} µs"
            )


def calibrate(clock: Clock, period_ns: int, cpu_count: int) -> SpinCalibration:
    """Measure how late this process wakes up from sleeps of 0.2 to 1 ms, and choose how long to spin; takes 30 ms.

    The spin covers a share `_SPIN_SHARE` of the sleeps, but is at most `_MOST_SPIN_NS`, and `_MOST_SPIN_SHARE` of the
    period; 0 with one processor.

    cpu_count: processors that others can use while this process spins. With one, spinning blocks all other work, even
    the kernel's threads that hand over received frames: the time gained at SYNC would be lost at the feedback.
    """
    step_ns = (_CALIBRATION_HIGH_NS - _CALIBRATION_LOW_NS) // (_CALIBRATION_SLEEPS - 1)
    lateness_ns = []
    now_ns = clock.now_ns()
    for index in range(_CALIBRATION_SLEEPS):
        due_ns = now_ns + _CALIBRATION_LOW_NS + index * step_ns
        clock.sleep_until_ns(due_ns)
        now_ns = clock.now_ns()
        lateness_ns.append(now_ns - due_ns)
    lateness_ns.sort()
    p50_ns, spin_ns, p99_ns = (
        lateness_ns[min(int(share * _CALIBRATION_SLEEPS), _CALIBRATION_SLEEPS - 1)]
        for share in (0.5, _SPIN_SHARE, 0.99)
    )
    spin_ns = min(spin_ns, _MOST_SPIN_NS, round(_MOST_SPIN_SHARE * period_ns)) if cpu_count > 1 else 0
    return SpinCalibration(p50_ns, p99_ns, lateness_ns[-1], spin_ns)


def prepare_spin(pacer: Pacer, settings: Settings, clock: Clock, grant: RealtimeGrant) -> dict[str, str]:
    """Set the pacer's `spin_ns` by the settings, or by a measurement; return entries for a log's metadata.

    These are the spin and the measured times of waking up, µs: it measures in both cases, see `calibrate`. Call it once
    real-time priority has been granted. In virtual time, or if SYNC is followed, do nothing and return {}.
    """
    if isinstance(clock, VirtualClock) or settings.bus.follows:
        return {}
    measured = calibrate(clock, settings.bus.period_ns, len(grant.cpus))
    wish_us = settings.realtime.spin_us
    pacer.spin_ns = measured.spin_ns if wish_us < 0.0 else round(wish_us * 1000.0)
    times_us = "/".join(f"{t_ns / 1000:.0f}" for t_ns in (measured.p50_ns, measured.p99_ns, measured.max_ns))
    return {"spin_us": f"{pacer.spin_ns / 1000:.0f}", "wakeup_us": f"{times_us} (p50/p99/max of {_CALIBRATION_SLEEPS})"}


def make_pacer(settings: Settings, clock: Clock, tap: Tap, sync_id: int) -> Pacer:
    """Return the pacer: one that follows SYNC by the settings, or one on a grid, with latency for a VirtualClock.

    sync_id: CAN identifier of SYNC, for a pacer that follows it.
    """
    bus = settings.bus
    if bus.follows:
        return FollowingPacer(tap, clock, bus.period_ns, sync_id, bus.sync_timeout_ms * 1_000_000)
    is_virtual = isinstance(clock, VirtualClock)
    return GridPacer(clock, bus.period_ns, HostLatency(settings.lockstep, bus.period_s) if is_virtual else None)
