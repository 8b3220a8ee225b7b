"""The seam: the embedded bus, interfaces that don't exist, and real SocketCAN where there is one."""

import socket

import pytest

from adacd_hil.clock import MonotonicClock, VirtualClock
from adacd_hil.wire.bus import BusError, BusMissingError, EmbeddedBus, Frame, open_bus
from adacd_hil.wire.socketcan import SocketCanBus
from adacd_hil.wire.tap import Tap


def test_the_embedded_device_has_answered_when_send_returns() -> None:
    bus = EmbeddedBus(VirtualClock())
    bus.attach(lambda frame: bus.deliver(frame.can_id + 1, frame.data[::-1]))
    bus.send(0x10, b"ab")
    assert bus.receive(0.0) == Frame(0x11, b"ba", 0)


def test_an_empty_embedded_bus_never_waits() -> None:
    assert EmbeddedBus(VirtualClock()).receive(1e9) is None


def test_embedded_frames_carry_the_virtual_time() -> None:
    clock = VirtualClock()
    bus = EmbeddedBus(clock)
    clock.sleep_until_ns(77)
    bus.deliver(1, b"")
    frame = bus.receive(0.0)
    assert frame is not None
    assert frame.t_ns == 77


def test_a_tap_remembers_the_command_before_its_answer() -> None:
    bus = EmbeddedBus(VirtualClock())
    bus.attach(lambda frame: bus.deliver(0x20, b"y"))
    tap = Tap(bus, VirtualClock())
    tap.send(0x10, b"x")
    tap.receive(0.0)
    assert [(is_sent, frame.can_id) for is_sent, frame in tap.take()] == [(True, 0x10), (False, 0x20)]


def test_a_tap_forgets_what_was_taken() -> None:
    tap = Tap(EmbeddedBus(VirtualClock()), VirtualClock())
    tap.send(0x10, b"x")
    tap.take()
    assert tap.take() == []


@pytest.mark.parametrize(
    ("interface", "reason"),
    [
        ("sockecan", "unknown interface 'sockecan'; did you mean 'socketcan'?"),
        ("udp_multicast", "echoes own frames"),
    ],
)
def test_an_interface_that_cant_serve_is_refused_in_one_line(interface: str, reason: str) -> None:
    with pytest.raises(BusMissingError, match=reason.replace("?", r"\?")):
        open_bus(interface, "x", MonotonicClock())


def test_any_other_python_can_interface_carries_frames() -> None:
    left = open_bus("virtual", "seam", MonotonicClock())
    right = open_bus("virtual", "seam", MonotonicClock())
    left.send(0x123, b"\x01\x02")
    frame = right.receive(1.0)
    left.close()
    right.close()
    assert frame is not None
    assert (frame.can_id, frame.data) == (0x123, b"\x01\x02")


@pytest.mark.vcan
def test_a_frame_crosses_vcan_and_does_not_echo() -> None:
    left, right = SocketCanBus("vcan0", MonotonicClock()), SocketCanBus("vcan0", MonotonicClock())
    left.send(0x201, b"\x01\x02\x03\x04\x05\x06")
    frame, echo = right.receive(1.0), left.receive(0.01)
    left.close()
    right.close()
    assert frame is not None
    assert (frame.can_id, frame.data, echo) == (0x201, b"\x01\x02\x03\x04\x05\x06", None)


@pytest.mark.vcan
def test_the_kernel_filters_other_identifiers() -> None:
    left, right = SocketCanBus("vcan0", MonotonicClock()), SocketCanBus("vcan0", MonotonicClock(), [0x181])
    left.send(0x182, b"\x01")
    left.send(0x181, b"\x02")
    frame = right.receive(1.0)
    left.close()
    right.close()
    assert frame is not None
    assert frame.can_id == 0x181


@pytest.mark.vcan
def test_a_missing_channel_names_those_that_are_present() -> None:
    with pytest.raises(BusMissingError, match=r"CAN interface vcan9 does not exist; present: .*vcan0"):
        open_bus("socketcan", "vcan9", MonotonicClock())


@pytest.mark.vcan
def test_an_error_frame_is_seen_and_marked() -> None:
    bus = SocketCanBus("vcan0", MonotonicClock())
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as peer:
        peer.bind(("vcan0",))
        peer.send(bytes.fromhex("40000020080000000000000000000000"))  # CAN_ERR_BUSOFF
        frame = bus.receive(1.0)
    bus.close()
    assert frame is not None
    assert frame.is_error


@pytest.mark.vcan
def test_an_interface_that_goes_down_is_one_line() -> None:
    import subprocess

    bus = SocketCanBus("vcan1", MonotonicClock())
    subprocess.run(["ip", "link", "set", "vcan1", "down"], check=True)
    try:
        with pytest.raises(BusError, match="vcan1: Network is down"):
            bus.send(0x80, b"\x01")
    finally:
        subprocess.run(["ip", "link", "set", "vcan1", "up"], check=True)
        bus.close()
