"""When cycles begin that follow another host's SYNC, in virtual time."""

from collections import deque

import pytest

from adacd_hil.clock import VirtualClock
from adacd_hil.control.pacing import FollowingPacer
from adacd_hil.wire.bus import Bus, BusError, Frame, Tap

SYNC, FEEDBACK = 0x080, 0x185
PERIOD_NS = 2_000_000
TIMEOUT_NS = 50_000_000


class TimedBus(Bus):
    """Frames that come at their time; waiting for one makes time pass. Read late, they carry the time of the read."""

    channel = "timed"
    waiting_frames = ()

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.coming: deque[Frame] = deque()

    def put(self, t_ns: int, can_id: int, *data: int, is_error: bool = False) -> None:
        self.coming.append(Frame(can_id, bytes(data), t_ns, is_error))

    def receive(self, timeout_s: float) -> Frame | None:
        limit_ns = self.clock.now_ns() + round(max(timeout_s, 0.0) * 1e9)
        if not self.coming or self.coming[0].t_ns > limit_ns:
            self.clock.sleep_until_ns(limit_ns)
            return None
        frame = self.coming.popleft()
        self.clock.sleep_until_ns(max(frame.t_ns, self.clock.now_ns()))
        return frame._replace(t_ns=self.clock.now_ns())


class Follower:
    """A follower on a timed bus."""

    def __init__(self, counters: list[int], start_ns: int = PERIOD_NS) -> None:
        self.bus = TimedBus()
        for place, counter in enumerate(counters):
            self.bus.put(start_ns + place * PERIOD_NS, SYNC, counter)
        self.tap = Tap(self.bus, self.bus.clock)
        self.pacer = FollowingPacer(self.tap, self.bus.clock, PERIOD_NS, SYNC, TIMEOUT_NS)

    def stall(self, duration_ns: int) -> None:
        self.bus.clock.sleep_until_ns(self.bus.clock.now_ns() + duration_ns)


def test_each_sync_begins_a_cycle_at_the_time_it_came_also_where_the_counter_wraps() -> None:
    follower = Follower([239, 240, 1])
    ticks = [follower.pacer.next() for _ in range(3)]
    assert [(tick.cycle, tick.t_ns, tick.periods) for tick in ticks] == [
        (0, PERIOD_NS, 1),
        (1, 2 * PERIOD_NS, 1),
        (2, 3 * PERIOD_NS, 1),
    ]


def test_of_several_syncs_that_wait_the_last_one_counts() -> None:
    follower = Follower([1, 2, 3, 4])
    follower.pacer.next()
    follower.stall(2 * PERIOD_NS)
    tick = follower.pacer.next()
    assert (tick.cycle, tick.periods, follower.pacer.overruns) == (2, 2, 1)
    assert follower.pacer.next().cycle == 3


def test_a_sync_that_was_lost_counts_by_the_counter_of_the_next() -> None:
    follower = Follower([5])
    follower.bus.put(4 * PERIOD_NS, SYNC, 8)
    follower.pacer.next()
    tick = follower.pacer.next()
    assert (tick.cycle, tick.periods, follower.pacer.overruns) == (3, 3, 2)


def test_a_gap_of_more_than_240_periods_is_counted_by_the_clock() -> None:
    follower = Follower([10])
    follower.pacer.next()
    follower.bus.put(301 * PERIOD_NS, SYNC, 10 + 300 - 240)
    follower.stall(299 * PERIOD_NS)
    assert follower.pacer.next().periods == 300


def test_a_sync_without_counter_is_counted_by_the_clock() -> None:
    follower = Follower([])
    for place in (1, 2, 5):
        follower.bus.put(place * PERIOD_NS, SYNC)
    assert [follower.pacer.next().cycle for _ in range(3)] == [0, 1, 4]


def test_frames_are_told_apart_by_the_sync_between_them() -> None:
    follower = Follower([])
    for t_ns, can_id, data in ((10, FEEDBACK, 1), (20, SYNC, 1), (30, FEEDBACK, 2), (40, SYNC, 2), (50, FEEDBACK, 3)):
        follower.bus.put(t_ns, can_id, data)
    follower.stall(100)
    tick = follower.pacer.next()
    assert [frame.data[0] for frame in tick.late if frame.can_id == FEEDBACK] == [1, 2]
    assert [frame.data[0] for frame in tick.ahead] == [3]


def test_an_error_frame_is_no_sync() -> None:
    follower = Follower([])
    follower.bus.put(100, SYNC, *range(8), is_error=True)  # 0x080 is the error class of bus errors
    follower.bus.put(PERIOD_NS, SYNC, 1)
    tick = follower.pacer.next()
    assert tick.t_ns == PERIOD_NS
    assert [frame.is_error for frame in tick.late] == [True]


def test_a_silent_producer_is_an_error_within_the_timeout() -> None:
    follower = Follower([1])
    follower.pacer.next()
    for t_ms in range(10, 50, 10):  # other frames don't put it off
        follower.bus.put(PERIOD_NS + t_ms * 1_000_000, FEEDBACK, 0)
    with pytest.raises(BusError, match="no SYNC on timed within 50 ms: the host that sends it begins first"):
        follower.pacer.next()
    assert follower.bus.clock.now_ns() == PERIOD_NS + TIMEOUT_NS


def test_a_frame_that_is_put_back_is_the_next_one() -> None:
    follower = Follower([1, 2, 3])
    follower.pacer.next()
    sync = follower.tap.receive(1.0)
    assert sync is not None
    follower.tap.unread(sync)
    assert follower.pacer.next().t_ns == 2 * PERIOD_NS
    assert [frame.data[0] for _, frame in follower.tap.take_passed()] == [1, 2]


def test_a_pause_that_is_meant_is_no_overrun() -> None:
    follower = Follower(list(range(1, 12)))
    follower.pacer.next()
    follower.stall(8 * PERIOD_NS)
    follower.pacer.resume()
    tick = follower.pacer.next()
    assert (tick.cycle, tick.periods, follower.pacer.overruns) == (8, 1, 0)


def test_another_period_than_the_configured_one_is_refused() -> None:
    follower = Follower([])
    for place in range(200):
        follower.bus.put(place * PERIOD_NS // 2, SYNC, 1 + place % 240)
    for _ in range(101):
        follower.pacer.next()
    with pytest.raises(BusError, match=r"SYNC on timed comes every 1000 µs, but `bus.period_us` = 2000 µs"):
        follower.pacer.next()


def test_stalls_are_not_taken_for_another_period() -> None:
    follower = Follower([1 + place % 240 for place in range(400)])
    for cycle in range(150):
        follower.pacer.next()
        follower.stall(5 * PERIOD_NS if cycle % 10 == 0 else 0)
    assert follower.pacer.overruns > 50
