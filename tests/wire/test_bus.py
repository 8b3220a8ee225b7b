"""The seam: the embedded bus, the tap, and interfaces that don't exist. SocketCAN is in test_bus_on_vcan.py."""

import can
import pytest

from adacd_hil.clock import MonotonicClock, VirtualClock
from adacd_hil.wire.bus import BusError, BusOffError, Frame, Tap
from adacd_hil.wire.embedded_bus import EmbeddedBus
from adacd_hil.wire.open_bus import open_bus


def test_the_embedded_device_has_answered_when_send_returns_at_the_virtual_time() -> None:
    clock = VirtualClock()
    bus = EmbeddedBus(clock)
    bus.attach(lambda frame: bus.deliver(frame.can_id + 1, frame.data[::-1]))
    clock.sleep_until_ns(77)
    bus.send(0x10, b"ab")
    assert bus.receive(0.0) == Frame(0x11, b"ba", 77)
    assert bus.receive(1e9) is None  # an empty bus never waits


def test_a_tap_remembers_the_command_before_its_answer() -> None:
    bus = EmbeddedBus(VirtualClock())
    bus.attach(lambda frame: bus.deliver(0x20, b"y"))
    tap = Tap(bus, VirtualClock())
    tap.send(0x10, b"x")
    tap.receive(0.0)
    assert [(is_sent, frame.can_id) for is_sent, frame in tap.take_passed()] == [(True, 0x10), (False, 0x20)]
    assert tap.take_passed() == []


def test_a_tap_recovers_the_bus_behind_it_and_keeps_what_has_passed() -> None:
    bus = EmbeddedBus(VirtualClock())
    tap = Tap(bus, VirtualClock())
    tap.send(0x10, b"x")
    bus.deliver(0x181, b"old")
    tap.recover()
    assert tap.receive(0.0) is None
    assert tap.take_passed() == [(True, Frame(0x10, b"x", 0))]


def test_a_tap_remembers_the_error_frame_of_a_bus_off() -> None:
    class OffBus(EmbeddedBus):
        def receive(self, timeout_s: float) -> Frame | None:
            raise BusOffError("off", Frame(0x40, bytes(8), 5, is_error=True))

    tap = Tap(OffBus(VirtualClock()), VirtualClock())
    with pytest.raises(BusOffError):
        tap.receive(0.0)
    assert tap.take_passed() == [(False, Frame(0x40, bytes(8), 5, is_error=True))]


def test_any_other_python_can_interface_carries_fd_frames_and_marks_them_so() -> None:
    left = open_bus("virtual", "fd seam", MonotonicClock(), is_fd=True)
    with can.Bus("fd seam", interface="virtual") as right:
        left.send(0x123, bytes(range(24)))
        left.send(0x124, bytes(range(8)))
        long, short = right.recv(1.0), right.recv(1.0)
    left.close()
    assert (long.is_fd, long.bitrate_switch, bytes(long.data)) == (True, True, bytes(range(24)))
    assert (short.is_fd, short.bitrate_switch, bytes(short.data)) == (False, False, bytes(range(8)))


def test_a_long_frame_on_a_classic_bus_is_refused_in_one_line() -> None:
    bus = open_bus("virtual", "classic seam", MonotonicClock())
    with pytest.raises(BusError, match="sending on classic seam: 12 data bytes need CAN FD"):
        bus.send(0x123, bytes(12))
    bus.close()


def test_remote_frames_and_ambiguous_identifiers_are_not_received() -> None:
    bus = open_bus("virtual", "odd seam", MonotonicClock())
    with can.Bus("odd seam", interface="virtual") as peer:
        peer.send(can.Message(arbitration_id=0x181, is_remote_frame=True, is_extended_id=False))
        peer.send(can.Message(arbitration_id=0x182, data=b"x"))  # 29 bits
        peer.send(can.Message(arbitration_id=0x1800, data=b"y"))
        peer.send(can.Message(arbitration_id=0x183, data=b"z", is_extended_id=False))
        received = [bus.receive(0.0) for _ in range(3)]
    bus.close()
    assert [(frame.can_id, frame.data) for frame in received if frame] == [(0x1800, b"y"), (0x183, b"z")]


def test_a_recovered_python_can_interface_has_nothing_old_to_read_and_still_works() -> None:
    bus = open_bus("virtual", "recovered seam", MonotonicClock(), is_fd=True)
    with can.Bus("recovered seam", interface="virtual") as peer:
        peer.send(can.Message(arbitration_id=0x181, data=b"old", is_extended_id=False))
        bus.recover()
        peer.send(can.Message(arbitration_id=0x181, data=b"new", is_extended_id=False))
        frame = bus.receive(1.0)
        bus.send(0x201, bytes(12))
        sent = peer.recv(1.0)
    bus.close()
    assert frame is not None
    assert frame.data == b"new"
    assert sent.is_fd
