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


@pytest.mark.parametrize("length", [1, 10])
def test_a_full_queue_refuses_and_keeps_what_it_has(length: int) -> None:
    rig = Rig(length)
    rig.bus.is_acknowledged = False
    for number in range(length):
        rig.bus.send(number, b"")
    with pytest.raises(TransmitQueueError, match=f"transmit queue of embedded is full with {length} frames"):
        rig.bus.send(0x7FF, b"")
    rig.bus.is_acknowledged = True
    assert rig.arrived == [(number, b"") for number in range(length)]


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
