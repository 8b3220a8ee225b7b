"""The bounded transmit queue: an adapter with nobody to acknowledge."""

import pytest
from queued_bus import QueuedBus

from adacd_hil.clock import VirtualClock
from adacd_hil.wire.bus import EmbeddedBus, Frame, InterfaceDownError, TransmitQueueError


class Rig:
    """A queued bus; `arrived` is what the device has received."""

    def __init__(self, length: int = 10) -> None:
        self.inner = EmbeddedBus(VirtualClock())
        self.arrived: list[tuple[int, bytes]] = []
        self.inner.attach(lambda frame: self.arrived.append((frame.can_id, frame.data)))
        self.bus = QueuedBus(self.inner, length)


def test_an_acknowledged_frame_goes_out_at_once() -> None:
    rig = Rig()
    rig.bus.send(0x201, b"a")
    assert (rig.arrived, len(rig.bus.waiting_frames)) == ([(0x201, b"a")], 0)


def test_frames_that_nobody_acknowledges_wait_and_go_out_in_order() -> None:
    rig = Rig()
    rig.bus.is_acknowledged = False
    for number in range(4):
        rig.bus.send(0x200 + number, bytes((number,)))
    assert (rig.arrived, len(rig.bus.waiting_frames)) == ([], 4)
    rig.bus.is_acknowledged = True
    assert rig.arrived == [(0x200, b"\0"), (0x201, b"\1"), (0x202, b"\2"), (0x203, b"\3")]
    assert rig.bus.waiting_frames == ()


@pytest.mark.parametrize("length", [1, 10, 512])
def test_a_full_queue_refuses_and_keeps_what_it_has(length: int) -> None:
    rig = Rig(length)
    rig.bus.is_acknowledged = False
    for number in range(length):
        rig.bus.send(number, b"")
    with pytest.raises(TransmitQueueError, match=f"transmit queue of embedded is full with {length} frames"):
        rig.bus.send(0x7FF, b"")
    rig.bus.is_acknowledged = True
    assert rig.arrived == [(number, b"") for number in range(length)]


@pytest.mark.parametrize("length", [0, 513, -1])
def test_a_length_that_no_adapter_has_is_refused(length: int) -> None:
    with pytest.raises(ValueError, match=f"= {length} frames is not within 1…512"):
        Rig(length)


def test_after_a_recovery_no_old_frame_gets_out_or_in() -> None:
    rig = Rig()
    rig.bus.is_acknowledged = False
    rig.bus.send(0x201, b"old")
    rig.inner.deliver(0x181, b"old")
    rig.bus.recover()
    rig.bus.is_acknowledged = True
    rig.bus.send(0x201, b"new")
    rig.inner.deliver(0x181, b"new")
    assert rig.arrived == [(0x201, b"new")]
    assert rig.bus.receive(0.0) == Frame(0x181, b"new", 0)
    assert rig.bus.receive(0.0) is None


def test_a_recovery_does_not_bring_acknowledgement_back() -> None:
    rig = Rig()
    rig.bus.is_acknowledged = False
    rig.bus.recover()
    rig.bus.send(0x201, b"")
    assert (rig.arrived, len(rig.bus.waiting_frames)) == ([], 1)


def test_a_later_change_of_the_data_does_not_change_what_waits() -> None:
    rig = Rig()
    rig.bus.is_acknowledged = False
    data = bytearray(b"a")
    rig.bus.send(0x201, data)
    data[0] = 0
    rig.bus.is_acknowledged = True
    assert rig.arrived == [(0x201, b"a")]


def test_an_interface_that_is_down_drops_what_waits_and_stays_dead_until_recovery() -> None:
    rig = Rig()
    rig.bus.is_acknowledged = False
    rig.bus.send(0x201, b"old")
    rig.bus.is_up = False
    for use in (lambda: rig.bus.send(0x201, b""), lambda: rig.bus.receive(0.0), rig.bus.recover):
        with pytest.raises(InterfaceDownError, match="interface embedded is down"):
            use()
    rig.bus.is_acknowledged = True
    rig.bus.is_up = True
    with pytest.raises(InterfaceDownError, match="was down and is up again"):
        rig.bus.send(0x201, b"")
    rig.bus.recover()
    rig.bus.send(0x201, b"new")
    assert rig.arrived == [(0x201, b"new")]


def test_a_device_that_takes_the_acknowledgement_away_while_the_queue_drains_stops_it() -> None:
    rig = Rig()

    def take_one(frame: Frame) -> None:
        rig.arrived.append((frame.can_id, frame.data))
        rig.bus.is_acknowledged = False

    rig.inner.attach(take_one)
    rig.bus.is_acknowledged = False
    for number in range(3):
        rig.bus.send(number, b"")
    rig.bus.is_acknowledged = True
    assert (rig.arrived, len(rig.bus.waiting_frames)) == ([(0, b"")], 2)


def test_closing_closes_the_bus_behind_it() -> None:
    rig = Rig()
    rig.bus.close()
    rig.bus.send(0x201, b"")
    assert rig.arrived == []
