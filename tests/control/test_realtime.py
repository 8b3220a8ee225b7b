"""When cycles begin."""

import dataclasses
from typing import Any

import pytest

from adacd_hil.clock import VirtualClock
from adacd_hil.control.pacing import GridPacer, Pacer, Tick, calibrate, make_pacer, prepare_spin
from adacd_hil.scheduling import RealtimeGrant
from adacd_hil.settings.arm_settings import LockstepSettings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.wire.bus import Tap
from adacd_hil.wire.embedded_bus import EmbeddedBus

PERIOD_NS = 1_000_000


class LateClock(VirtualClock):
    """A clock whose sleeper is woken late by what a test says, once each."""

    def __init__(self, lateness_ns: list[int]) -> None:
        super().__init__()
        self._lateness_ns = lateness_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        super().sleep_until_ns(t_ns + (self._lateness_ns.pop(0) if self._lateness_ns else 0))


@pytest.mark.parametrize(
    ("late_ns", "ticks", "overruns"),
    [
        ([], [(0, 0, 1, 0), (1, 1_000_000, 1, 0), (2, 2_000_000, 1, 0)], 0),
        ([0, 400_000], [(0, 0, 1, 0), (1, 1_400_000, 1, 400_000), (2, 2_000_000, 1, 0)], 0),
        ([0, 999_999], [(0, 0, 1, 0), (1, 1_999_999, 1, 999_999), (2, 2_000_000, 1, 0)], 0),
        ([0, 2_300_000], [(0, 0, 1, 0), (3, 3_300_000, 3, 300_000), (4, 4_000_000, 1, 0)], 2),
        ([0, 1_000_000, 1_000_000], [(0, 0, 1, 0), (2, 2_000_000, 2, 0), (4, 4_000_000, 2, 0)], 2),
    ],
    ids=["on time", "late", "late by just less than a period", "an overrun keeps the phase", "two overruns"],
)
def test_a_late_tick_does_not_move_the_grid_and_skips_whole_periods(
    late_ns: list[int], ticks: list[tuple[int, int, int, int]], overruns: int
) -> None:
    pacer = GridPacer(LateClock(late_ns), PERIOD_NS)
    assert [pacer.next() for _ in range(3)] == [Tick(*tick) for tick in ticks]
    assert pacer.overruns == overruns


def test_a_pause_that_is_meant_is_no_overrun_and_keeps_the_grid() -> None:
    clock = LateClock([])
    pacer = GridPacer(clock, PERIOD_NS)
    first = pacer.next()
    clock.sleep_until_ns(first.t_ns + 5_300_000)
    pacer.resume()
    assert pacer.next() == Tick(6, first.t_ns + 6_000_000, 1, 0)
    assert pacer.overruns == 0


def test_the_grid_is_that_of_the_clocks_whole_periods() -> None:
    clock = VirtualClock()
    clock.sleep_until_ns(5_300_000)
    assert GridPacer(clock, PERIOD_NS).next() == Tick(0, 6_000_000, 1, 0)


class CountingClock(LateClock):
    """A clock that moves on by 1 µs whenever it is read, and remembers what it was asked to sleep for."""

    def __init__(self, lateness_ns: list[int]) -> None:
        super().__init__(lateness_ns)
        self.slept_until_ns: list[int] = []

    def now_ns(self) -> int:
        now_ns = super().now_ns()
        VirtualClock.sleep_until_ns(self, now_ns + 1_000)
        return now_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        self.slept_until_ns.append(t_ns)
        super().sleep_until_ns(t_ns)


def test_a_pacer_that_spins_sleeps_shorter_and_is_on_time_where_the_wakeup_is_late() -> None:
    clock = CountingClock([0, 20_000, 60_000])
    pacer = GridPacer(clock, PERIOD_NS)
    pacer.spin_ns = 50_000
    assert [pacer.next().lateness_ns for _ in range(3)] == [1_000, 0, 10_000]
    assert clock.slept_until_ns == [-50_000, 950_000, 1_950_000]


LATENESS_NS = [1_000 * (index % 25) for index in range(49)] + [900_000]


@pytest.mark.parametrize(
    ("lateness_ns", "period_ns", "cpu_count", "spin_ns"),
    [
        (LATENESS_NS, PERIOD_NS, 2, 23_000),
        (LATENESS_NS, PERIOD_NS, 1, 0),
        ([80_000] * 50, PERIOD_NS, 2, 80_000),
        ([300_000] * 50, PERIOD_NS, 2, 100_000),
        ([300_000] * 50, 500_000, 2, 50_000),
        ([0] * 50, PERIOD_NS, 2, 0),
    ],
)
def test_the_spin_is_as_long_as_sleeps_are_late_within_bounds(
    lateness_ns: list[int], period_ns: int, cpu_count: int, spin_ns: int
) -> None:
    assert calibrate(LateClock(list(lateness_ns)), period_ns, cpu_count).spin_ns == spin_ns


def test_a_measurement_tells_how_late_sleeps_were() -> None:
    measured = calibrate(LateClock(list(LATENESS_NS)), PERIOD_NS, 2)
    assert (measured.p50_ns, measured.p99_ns, measured.max_ns) == (12_000, 900_000, 900_000)


def test_in_virtual_time_nothing_is_measured() -> None:
    clock, pacer = paced()
    assert prepare_spin(pacer, load_settings(), clock, RealtimeGrant("SCHED_FIFO 80")) == {}
    assert (pacer.spin_ns, clock.now_ns()) == (0, 0)


def paced(**lockstep: Any) -> tuple[VirtualClock, Pacer]:
    clock = VirtualClock()
    settings = dataclasses.replace(load_settings(), lockstep=LockstepSettings(**lockstep))
    return clock, make_pacer(settings, clock, Tap(EmbeddedBus(clock), clock), 0x080)


def test_in_lockstep_the_hosts_work_takes_its_modelled_time() -> None:
    clock, pacer = paced(latency_us=80.0)
    clock.sleep_until_ns(500_000)
    assert (pacer.command_time(500_000), clock.now_ns()) == (580_000, 580_000)


def test_a_modelled_host_that_is_slower_than_a_period_skips_periods() -> None:
    _, pacer = paced(latency_us=1_700.0)
    pacer.next()
    pacer.command_time(500_000)
    assert (pacer.next(), pacer.overruns) == (Tick(2, 2_200_000, 2, 200_000), 1)
