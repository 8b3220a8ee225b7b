"""One exchange with the arm: what belongs to which cycle, when the last of it came, and what its record says."""

import pytest
from bench_bus import CODEC, PERIOD_NS, BenchBus

from adacd_hil.control.exchange import Evidence, Exchange
from adacd_hil.control.pacing import Tick
from adacd_hil.device.arm_report import ArmReport
from adacd_hil.records import ArmState
from adacd_hil.wire.bus import EmbeddedBus, Frame


class Rig:
    """An arm in operation; `read` goes through one cycle on the grid."""

    def __init__(self) -> None:
        self.bench = BenchBus()
        self.bench.start()
        bench = self.bench
        self.exchange = Exchange(bench.settings, bench.tap, bench.arm, bench.master, bench.clock)
        self._cycle = -1

    def begin(self) -> Tick:
        clock = self.bench.clock
        clock.sleep_until_ns((clock.now_ns() // PERIOD_NS + 1) * PERIOD_NS)
        self._cycle += 1
        return Tick(self._cycle, clock.now_ns(), 1, 0)

    def read(self) -> ArmState:
        return self.exchange.read(self.begin())


def drain(bus: EmbeddedBus) -> list[Frame]:
    frames = []
    while (frame := bus.receive(0.0)) is not None:
        frames.append(frame)
    return frames


def test_a_duplicate_that_comes_between_two_cycles_stands_for_no_frame_of_the_next() -> None:
    rig = Rig()
    last: dict[int, bytes] = {}
    rig.bench.tamper = last.setdefault
    assert rig.read().is_complete
    rig.bench.bus.deliver(0x181, last[0x181])  # Drive 1's feedback again, after the cycle is over
    rig.bench.tamper = lambda can_id, data: None if can_id == 0x181 else data
    state = rig.read()
    assert not state.is_complete
    assert state.age_q == (1, 0)


def test_a_frame_that_comes_after_its_cycle_was_given_up_is_of_that_cycle() -> None:
    rig = Rig()
    rig.read()
    kept: list[bytes] = []
    rig.bench.tamper = lambda can_id, data: kept.append(data) if can_id == 0x183 else data
    assert not rig.read().is_complete
    rig.bench.tamper = lambda can_id, data: data
    rig.bench.bus.deliver(0x183, kept[0])
    state = rig.read()
    assert state.is_complete
    assert state.age_tau_J == (0, 0)
    assert "0 NO_NEW_DATA" in ArmReport(rig.bench.arm).describe_checks()[2]


def test_the_feedback_is_in_when_its_last_frame_came_not_when_it_was_read() -> None:
    rig = Rig()
    clock = rig.bench.clock
    rig.read()
    receive = rig.bench.bus.receive

    def read_late(timeout_s: float):  # type: ignore[no-untyped-def]
        frame = receive(timeout_s)
        if frame is not None and frame.can_id == CODEC.message("Sensor2Torque").can_id:
            clock.sleep_until_ns(frame.t_ns + 30_000)
        return frame

    rig.bench.bus.receive = read_late  # type: ignore[method-assign]
    rig.read()
    assert rig.exchange.feedback_ns == rig.exchange.sync_ns == clock.now_ns() - 30_000


def test_feedback_that_was_read_with_a_followed_sync_came_when_its_last_frame_did() -> None:
    rig = Rig()
    bus = rig.bench.bus
    rig.read()
    tick = rig.begin()
    bus.send(0x080, bytes((1 + tick.cycle,)))  # for the answers, as they wait beside a SYNC of another host
    ahead = tuple(frame._replace(t_ns=tick.t_ns + 1000 * place) for place, frame in enumerate(drain(bus), 1))
    rig.bench.tamper = lambda can_id, data: None
    rig.exchange.read(tick._replace(ahead=ahead))
    assert rig.exchange.feedback_ns == ahead[-1].t_ns == tick.t_ns + 4000


def test_frames_that_the_kernel_dropped_are_counted_and_said_at_most_once_a_second(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = Rig()
    bench = rig.bench
    lost = [0]
    monkeypatch.setattr(EmbeddedBus, "frames_lost", property(lambda _: lost[-1]))
    evidence = Evidence(bench.settings, bench.tap, bench.arm, rig.exchange, bench.clock)
    counted, said = [], []
    for count in (0, 1, 4, 4):
        lost.append(count)
        tick = rig.begin()
        counted.append(evidence.record(tick, rig.exchange.read(tick), 0, 0).frames_lost)
        said += evidence.take_events()
    assert counted == [0, 1, 4, 4]
    assert [event.message for event in said] == ["1 received frame dropped by the kernel: this host reads too late"]
    bench.clock.sleep_until_ns(bench.clock.now_ns() + 1_000_000_000)
    tick = rig.begin()
    evidence.record(tick, rig.exchange.read(tick), 0, 0)
    (event,) = evidence.take_events()
    assert event.message.startswith("3 received frames")
