"""Modelled time on the bus: arbitration, queues, and devices that live with the host's clock."""

from collections import deque
from collections.abc import Callable

import pytest

from adacd_hil.clock import VirtualClock
from adacd_hil.wire.bus import Bus, Frame, SilenceError, TransmitQueueError
from adacd_hil.wire.lockstep_bus import LockstepBus
from adacd_hil.wire.time_marks import DEVICE_MARK, HOST_MARK, MarkKind, pack_mark, unpack_mark

SYNC, PERIOD_NS = 0x080, 1_000_000
FRAME_NS = 100_000  # every frame of these tests takes so long
PATIENCE_S = 0.05


class Devices(Bus):
    """The devices' end, without time of its own: `on_frame` says what they send when they get something."""

    channel = "devices"

    def __init__(self) -> None:
        self.heard: list[tuple[int, bytes]] = []
        self.asked_ns: list[int] = []
        self.queue: deque[Frame] = deque()
        self.on_frame: Callable[[int, bytes], None] = lambda can_id, data: None
        self.events: list[tuple[int, int, bytes]] = []  # when, identifier, data
        self.is_marking = True
        self._is_new = True
        self._has_sent = False
        self._now_ns = 0

    @property
    def waiting_frames(self) -> tuple[int, ...]:
        return ()

    def say(self, can_id: int, data: bytes = b"") -> None:
        self._has_sent = self._has_sent or can_id != DEVICE_MARK
        self.queue.append(Frame(can_id, data, 0))

    def mark(self, kind: MarkKind, t_ns: int = 0) -> None:
        self.say(DEVICE_MARK, pack_mark(kind, t_ns))

    def send(self, can_id: int, data: bytes) -> None:
        if can_id != HOST_MARK:
            self.heard.append((can_id, data))
            self.on_frame(can_id, data)
            return
        mark = unpack_mark(data)
        assert mark is not None
        if not self.is_marking:
            return
        self.asked_ns.append(mark[1])
        if self._is_new:
            self._is_new = False
            self._now_ns = mark[1]
        elif not self._has_sent:
            self._live_until(mark[1])
        self._has_sent = False
        self.mark(MarkKind.GRANT, self._now_ns)

    def _live_until(self, t_ns: int) -> None:
        if self.events and self.events[0][0] <= t_ns:
            t_ns, can_id, data = self.events.pop(0)
            self.say(can_id, data)
        self._now_ns = max(self._now_ns, t_ns)

    def receive(self, timeout_s: float) -> Frame | None:
        return self.queue.popleft() if self.queue else None

    def recover(self) -> None:
        self.queue.clear()

    def close(self) -> None:
        self.is_closed = True


class Rig:
    def __init__(
        self,
        answers: tuple[int, ...] = (),
        queue_length: int = 10,
        is_fifo: bool = False,
        devices: Devices | None = None,
    ) -> None:
        self.devices = devices or Devices()
        self.clock = VirtualClock()
        self.bus = LockstepBus(
            self.devices,
            self.clock,
            lambda can_id, data: FRAME_NS,
            period_ns=PERIOD_NS,
            answers=answers,
            patience_s=PATIENCE_S,
            queue_length=queue_length,
            is_fifo=is_fifo,
        )
        self.devices.on_frame = self._answer
        self.answers = answers

    def _answer(self, can_id: int, data: bytes) -> None:
        if can_id == SYNC:
            for answer in self.answers:
                self.devices.say(answer)

    def receive_all(self, timeout_s: float) -> list[tuple[int, int]]:
        received = []
        end_ns = self.clock.now_ns() + round(timeout_s * 1e9)
        while frame := self.bus.receive((end_ns - self.clock.now_ns()) * 1e-9):
            received.append((frame.can_id, frame.t_ns))
        return received

    def at(self, t_ns: int) -> "Rig":
        self.clock.sleep_until_ns(t_ns)
        return self


def test_answers_follow_sync_one_after_the_other_by_identifier() -> None:
    rig = Rig((0x184, 0x181, 0x183))
    rig.bus.send(SYNC, b"\x01")
    assert rig.receive_all(0.0009) == [(0x181, 200_000), (0x183, 300_000), (0x184, 400_000)]


def test_a_frame_that_ends_after_the_wait_is_there_next_time() -> None:
    rig = Rig((0x181, 0x182))
    rig.bus.send(SYNC, b"\x01")
    assert rig.receive_all(0.00025) == [(0x181, 200_000)]
    assert rig.clock.now_ns() == 250_000
    assert rig.receive_all(0.0005) == [(0x182, 300_000)]


@pytest.mark.parametrize(("is_fifo", "order"), [(False, [0x000, 0x201, 0x77F]), (True, [0x201, 0x77F, 0x000])])
def test_what_the_host_sends_leaves_by_identifier_or_in_the_order_of_sending(is_fifo: bool, order: list[int]) -> None:
    rig = Rig(is_fifo=is_fifo)
    for can_id in (0x201, 0x77F, 0x000):
        rig.bus.send(can_id, b"")
    rig.receive_all(0.001)
    assert [can_id for can_id, _ in rig.devices.heard] == order


def test_commands_in_time_reach_the_devices_before_the_next_sync() -> None:
    rig = Rig((0x181,))
    rig.bus.send(SYNC, b"\x01")
    rig.receive_all(0.0007)
    rig.at(790_000).bus.send(0x201, b"")
    rig.bus.send(0x202, b"")
    rig.at(PERIOD_NS)
    assert rig.bus.waiting_frames == ()
    rig.bus.send(SYNC, b"\x02")
    rig.receive_all(0.0007)
    assert [can_id for can_id, _ in rig.devices.heard] == [SYNC, 0x201, 0x202, SYNC]


@pytest.mark.parametrize(
    ("is_fifo", "order", "answer_ns"),
    [(False, [0x201, SYNC, 0x202], 1_250_000), (True, [0x201, 0x202, SYNC], 1_350_000)],
)
def test_a_late_command_acts_one_sync_later_or_holds_sync_up(is_fifo: bool, order: list[int], answer_ns: int) -> None:
    rig = Rig((0x181,), is_fifo=is_fifo)
    rig.at(950_000).bus.send(0x201, b"")
    rig.bus.send(0x202, b"")
    assert rig.at(PERIOD_NS).bus.waiting_frames == (() if is_fifo else (0x202,))
    rig.bus.send(SYNC, b"\x01")
    assert rig.receive_all(0.0007) == [(0x181, answer_ns)]
    assert [can_id for can_id, _ in rig.devices.heard] == order


@pytest.mark.parametrize(("is_fifo", "sync_ns"), [(False, 1_100_000), (True, 1_400_000)])
def test_in_a_fifo_sync_waits_behind_a_frame_that_loses_to_the_devices(is_fifo: bool, sync_ns: int) -> None:
    rig = Rig((0x181,), is_fifo=is_fifo)
    rig.devices.on_frame = lambda can_id, data: (
        [rig.devices.say(one) for one in (*([0x281] * 10 if data == b"\x01" else []), 0x181)]
        if can_id == SYNC
        else None
    )
    rig.bus.send(SYNC, b"\x01")
    rig.receive_all(0.0007)
    rig.bus.send(0x77F, b"")
    rig.at(PERIOD_NS).bus.send(SYNC, b"\x02")
    rig.receive_all(0.0007)
    assert rig.clock.now_ns() >= PERIOD_NS
    assert [can_id for can_id, _ in rig.devices.heard] == ([SYNC, 0x77F, SYNC] if is_fifo else [SYNC, SYNC, 0x77F])
    assert rig.bus.sync_ns == sync_ns


def test_released_frames_come_when_they_are_released() -> None:
    rig = Rig((0x181, 0x182))

    def answer_late(can_id: int, data: bytes) -> None:
        rig.devices.mark(MarkKind.RELEASE, 0)
        rig.devices.say(0x181)
        rig.devices.mark(MarkKind.RELEASE, 350_000)
        rig.devices.say(0x182)
        rig.devices.mark(MarkKind.END)

    rig.devices.on_frame = answer_late
    rig.bus.send(SYNC, b"\x01")
    assert rig.receive_all(0.0009) == [(0x181, 200_000), (0x182, 550_000)]


def test_what_came_before_the_first_mark_is_before_it() -> None:
    rig = Rig((0x181, 0x182))

    def answer(can_id: int, data: bytes) -> None:
        rig.devices.say(0x181, b"old")
        rig.devices.mark(MarkKind.RELEASE, 0)
        rig.devices.say(0x181, b"new")
        rig.devices.mark(MarkKind.END)

    rig.devices.on_frame = answer
    rig.bus.send(SYNC, b"\x01")
    assert [frame.data for _ in range(2) if (frame := rig.bus.receive(0.0007))] == [b"old", b"new"]


def test_end_says_that_what_is_missing_does_not_come() -> None:
    rig = Rig((0x181, 0x182))
    rig.devices.on_frame = lambda can_id, data: rig.devices.mark(MarkKind.END)
    rig.bus.send(SYNC, b"\x01")
    assert rig.bus.receive(0.0007) is None


def test_devices_that_say_nothing_to_sync_have_gone() -> None:
    rig = Rig((0x181,))
    rig.devices.on_frame = lambda can_id, data: None
    rig.bus.send(SYNC, b"\x01")
    with pytest.raises(SilenceError, match=r"silence on devices for 0\.05 s"):
        rig.bus.receive(0.0007)
    rig.bus.send(SYNC, b"\x02")
    with pytest.raises(SilenceError):
        rig.bus.close()
    assert rig.devices.is_closed


def test_without_sync_devices_live_with_the_hosts_clock() -> None:
    rig = Rig()
    rig.devices.events = [(300_000_000, 0x701, b"\x7f"), (600_000_000, 0x701, b"\x05")]
    assert rig.receive_all(0.5) == [(0x701, 300_100_000)]
    assert rig.receive_all(0.5) == [(0x701, 600_100_000)]


def test_an_answer_is_handed_over_when_its_request_is_through() -> None:
    rig = Rig()
    rig.devices.on_frame = lambda can_id, data: rig.devices.say(0x581)
    rig.bus.send(0x601, b"")
    assert rig.receive_all(0.5) == [(0x581, 200_000)]


def test_while_nobody_is_powered_frames_stay_in_the_queue_until_it_is_full_and_go_out_later() -> None:
    rig = Rig(queue_length=3)
    rig.devices.mark(MarkKind.DARK)
    rig.bus.receive(0.0)
    rig.devices.mark(MarkKind.DARK)
    rig.bus.receive(0.001)
    for _ in range(3):
        rig.bus.send(0x201, b"old")
    with pytest.raises(TransmitQueueError, match="full with 3 frames: nobody acknowledges"):
        rig.bus.send(0x201, b"")
    rig.bus.receive(0.5)
    assert rig.devices.heard == []
    rig.devices.mark(MarkKind.LIT)
    rig.bus.receive(0.5)
    rig.bus.receive(0.001)
    assert rig.devices.heard == [(0x201, b"old")] * 3


def test_devices_without_marks_are_waited_for() -> None:
    rig = Rig((0x181,))
    rig.devices.is_marking = False
    rig.bus.send(SYNC, b"\x01")
    assert rig.receive_all(0.0009) == [(0x181, 200_000)]


class Strangers(Devices):
    """A bus on which nobody answers, but another node sends a frame every `every_s` by the host's monotonic clock.

    That clock moves as `receive` waits, and by `TAKEN_NS` for each call.
    """

    TAKEN_NS = 10_000

    def __init__(self, every_s: float) -> None:
        super().__init__()
        self.is_marking, self.every_s, self.wall = False, every_s, VirtualClock()

    def receive(self, timeout_s: float) -> Frame | None:
        waited_ns = round(min(self.every_s, timeout_s) * 1e9) + self.TAKEN_NS
        self.wall.sleep_until_ns(self.wall.now_ns() + waited_ns)
        return Frame(0x123, b"", 0) if timeout_s >= self.every_s else None


@pytest.mark.parametrize("every_s", [0.0, 0.01, 0.1])
@pytest.mark.parametrize("wait_s", [0.0, 0.1, 0.2])
def test_a_wait_ends_however_much_another_node_sends(
    every_s: float, wait_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    strangers = Strangers(every_s)
    monkeypatch.setattr("adacd_hil.wire.lockstep_bus.MonotonicClock", lambda: strangers.wall)
    rig = Rig((0x181,), devices=strangers)
    received = rig.receive_all(wait_s)
    assert wait_s * 1e9 == rig.clock.now_ns()
    assert all(t_ns <= rig.clock.now_ns() for _, t_ns in received)
    rig.bus.send(SYNC, b"\x01")
    with pytest.raises(SilenceError):
        rig.receive_all(0.001)
    assert strangers.wall.now_ns() < (wait_s + 10 * PATIENCE_S) * 1e9


@pytest.mark.parametrize("data", [b"", b"\x00" * 8, b"\x07" + bytes(7), bytes(7)])
def test_what_is_no_mark_is_none(data: bytes) -> None:
    assert unpack_mark(data) is None
