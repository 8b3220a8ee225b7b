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

    def __init__(self, counters: list[int]) -> None:
        self.bus = TimedBus()
        for place, counter in enumerate(counters, 1):
            self.bus.put(place * PERIOD_NS, SYNC, counter)
        self.tap = Tap(self.bus, self.bus.clock)
        self.pacer = FollowingPacer(self.tap, self.bus.clock, PERIOD_NS, SYNC, TIMEOUT_NS)

    def stall(self, duration_ns: int) -> None:
        self.bus.clock.sleep_until_ns(self.bus.clock.now_ns() + duration_ns)


@pytest.mark.parametrize(
    ("syncs", "stall", "ticks"),
    [
        ({1: 239, 2: 240, 3: 1}, 0, [(0, 1), (1, 1), (2, 1)]),
        ({1: 1, 2: 2, 3: 3, 4: 4}, 2, [(0, 1), (2, 2), (3, 1)]),
        ({1: 5, 4: 8}, 0, [(0, 1), (3, 3)]),
        ({1: 10, 301: 70}, 299, [(0, 1), (300, 300)]),
        ({1: None, 2: None, 5: None}, 0, [(0, 1), (1, 1), (4, 3)]),
    ],
    ids=["the counter wraps", "the last of several", "one was lost", "a gap of more than 240", "without a counter"],
)
def test_syncs_are_counted_by_their_counter_and_by_the_clock(
    syncs: dict[int, int | None], stall: int, ticks: list[tuple[int, int]]
) -> None:
    """Counters by the period in which they come; after the first the host stalls for some periods."""
    follower = Follower([])
    for period, counter in syncs.items():
        follower.bus.put(period * PERIOD_NS, SYNC, *([] if counter is None else [counter]))
    found = [follower.pacer.next()]
    follower.stall(stall * PERIOD_NS)
    found += [follower.pacer.next() for _ in ticks[1:]]
    assert [(tick.cycle, tick.periods) for tick in found] == ticks
    assert follower.pacer.overruns == sum(periods - 1 for _, periods in ticks)


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
