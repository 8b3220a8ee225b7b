"""One exchange with the arm: what belongs to which cycle, when the last of it came, its record and its events."""

import numpy as np
import pytest
from rig import CODEC, PERIOD_NS, Rig

from adacd_hil.control.exchange import Exchange, say_trouble
from adacd_hil.control.pacing import GridPacer
from adacd_hil.device.arm_watch import RateLimitedEvents
from adacd_hil.records import ArmCommand, ArmState
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.embedded_bus import EmbeddedBus


class ExchangeRig:
    """An arm in operation; `read` goes through one cycle on the grid."""

    def __init__(self) -> None:
        self.bench = Rig(is_wall=True)
        self.bench.start()
        bench = self.bench
        self.pacer = GridPacer(bench.clock, PERIOD_NS)
        self.exchange = Exchange(bench.settings, bench.tap, bench.arm, bench.master, self.pacer, bench.clock)

    def read(self) -> ArmState:
        return self.exchange.turn()[1]


def drain(bus: EmbeddedBus) -> list[Frame]:
    frames = []
    while (frame := bus.receive(0.0)) is not None:
        frames.append(frame)
    return frames


def test_a_duplicate_that_comes_between_two_cycles_stands_for_no_frame_of_the_next() -> None:
    rig = ExchangeRig()
    last: dict[int, bytes] = {}
    rig.bench.tamper = lambda cycle, can_id, data: last.setdefault(can_id, data)
    assert rig.read().is_complete
    rig.bench.bus.deliver(0x181, last[0x181])  # Drive 1's feedback again, after the cycle is over
    rig.bench.tamper = lambda cycle, can_id, data: None if can_id == 0x181 else data
    state = rig.read()
    assert not state.is_complete
    assert state.age_q == (1, 0)


def test_the_feedback_is_in_when_its_last_frame_came_not_when_it_was_read() -> None:
    rig = ExchangeRig()
    clock = rig.bench.clock
    rig.read()
    receive = rig.bench.bus.receive

    def read_late(timeout_s: float) -> Frame | None:
        frame = receive(timeout_s)
        if frame is not None and frame.can_id == CODEC.message("Sensor2Torque").can_id:
            clock.sleep_until_ns(frame.t_ns + 30_000)
        return frame

    rig.bench.bus.receive = read_late  # type: ignore[method-assign]
    rig.read()
    assert rig.exchange.feedback_ns == rig.exchange.sync_ns == clock.now_ns() - 30_000


def test_feedback_that_was_read_with_a_followed_sync_came_when_its_last_frame_did() -> None:
    rig = ExchangeRig()
    bus = rig.bench.bus
    rig.read()
    tick = rig.pacer.next()
    bus.send(0x080, bytes((1 + tick.cycle,)))  # for the answers, as they wait beside a SYNC of another host
    ahead = tuple(frame._replace(t_ns=tick.t_ns + 1000 * place) for place, frame in enumerate(drain(bus), 1))
    rig.bench.tamper = lambda cycle, can_id, data: None
    rig.exchange.read(tick._replace(ahead=ahead))
    assert rig.exchange.feedback_ns == ahead[-1].t_ns == tick.t_ns + 4000


def test_frames_that_the_kernel_dropped_are_counted_and_said_at_most_once_a_second(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = ExchangeRig()
    bench = rig.bench
    lost = [0]
    monkeypatch.setattr(EmbeddedBus, "frames_lost", property(lambda _: lost[-1]))
    exchange, off = rig.exchange, ArmCommand(np.zeros(2), enable=False, quick_stop=False)
    counted, said = [], []
    for count in (0, 1, 4, 4):
        lost.append(count)
        counted.append(exchange.end(*exchange.turn(), off).frames_lost)
        said += exchange.events.take_events()
    assert counted == [0, 1, 4, 4]
    assert [event.message for event in said] == ["1 received frame dropped by the kernel: this host reads too late"]
    bench.clock.sleep_until_ns(bench.clock.now_ns() + 1_000_000_000)
    exchange.end(*exchange.turn(), off)
    (event,) = exchange.events.take_events()
    assert event.message.startswith("3 received frames")


def texts(events: RateLimitedEvents) -> list[str]:
    return [event.message for event in events.take_events()]


def test_each_kind_of_error_frame_is_said_once_a_second_and_the_rest_counted() -> None:
    events = RateLimitedEvents()
    for t_s in (0.0, 0.4, 0.999, 1.0):
        say_trouble(events, Frame(0x020, bytes(8), int(t_s * 1e9), is_error=True))
    passive = Frame(0x204, bytes((0, 0x20, 0, 0, 0, 0, 130, 0)), 1_100_000_000, is_error=True)
    say_trouble(events, passive)
    assert texts(events) == [
        "no acknowledgement",
        "no acknowledgement (and 2 before)",
        "error passive (sending); error counters: sending 130, receiving 0",
    ]
    assert texts(events) == []
