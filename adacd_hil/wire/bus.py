"""Where frames enter and leave: one seam over SocketCAN, the embedded bus, and every other python-can interface.

SocketCAN is opened by python-can (filters, error mask, options) and then used through its socket, because building a
`can.Message` costs more than everything else in a cycle together. The embedded bus joins host and emulator in one
process, without threads: what the host sends is handled before `send` returns.
"""

import contextlib
import difflib
import errno
import select
import socket
import struct
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import can

from adacd_hil.clock import Clock, MonotonicClock

CAN_ERR_FLAG = 0x20000000
CAN_ID_MASK = 0x1FFFFFFF
_FRAME = struct.Struct("=IB3x8s")
_ARPHRD_CAN = "280"
_IFF_UP = 1
_ECHOING_INTERFACES = ("udp_multicast",)
_SEND_PATIENCE_S = 0.05
"""Longest wait for room in the transmit queue: over 300 frames at 1 Mbit/s, so a live bus has drained by then."""


class BusError(OSError):
    """The bus failed while running; one line."""


class BusMissingError(BusError):
    """The bus can't be opened; one line with what there is."""


class Frame(NamedTuple):
    """One CAN frame. t_ns: host time of its reception or transmission."""

    can_id: int
    data: bytes
    t_ns: int
    is_error: bool = False


class Bus(Protocol):
    """One end of a CAN bus."""

    channel: str

    def send(self, can_id: int, data: bytes) -> None:
        """Hand a frame to the bus. Raises BusError."""

    def receive(self, timeout_s: float) -> Frame | None:
        """Return the next frame, or None when none came within `timeout_s`. Raises BusError."""

    def recover(self) -> None:
        """Drop everything that is queued both ways. Raises BusError."""

    def close(self) -> None:
        """Release the bus; twice is once."""


class EmbeddedBus:
    """The host's end of a bus within one process; the device's end is `attach` and `deliver`.

    Frames that the device sends from within the host's `send` are in the host's queue when `send` returns. Waiting is
    pointless, so `receive` never does.
    """

    def __init__(self, clock: Clock) -> None:
        self.channel = "embedded"
        self._clock = clock
        self._received: deque[Frame] = deque()
        self._device: Callable[[Frame], None] | None = None

    def attach(self, device: Callable[[Frame], None]) -> None:
        """Connect the device's receiver."""
        self._device = device

    def deliver(self, can_id: int, data: bytes) -> None:
        """Send from the device to the host."""
        self._received.append(Frame(can_id, data, self._clock.now_ns()))

    def send(self, can_id: int, data: bytes) -> None:
        """Hand a frame to the device; it has acted on it when this returns."""
        if self._device is not None:
            self._device(Frame(can_id, data, self._clock.now_ns()))

    def receive(self, timeout_s: float) -> Frame | None:  # noqa: ARG002 (the protocol's signature)
        """Return the next frame, or None."""
        return self._received.popleft() if self._received else None

    def recover(self) -> None:
        """Drop what the device sent."""
        self._received.clear()

    def close(self) -> None:
        """Disconnect the device."""
        self._device = None


class SocketCanBus:
    """A SocketCAN interface, classic frames.

    Frames that are found waiting carry one stamp, that of the first of them: a reading of the clock costs as much as a
    frame where it is a system call.
    """

    def __init__(self, channel: str, clock: Clock, can_ids: Iterable[int] | None = None) -> None:
        """Open `channel`, receiving only `can_ids` when given. Raises BusMissingError."""
        filters = None if can_ids is None else [{"can_id": i, "can_mask": 0x7FF, "extended": False} for i in can_ids]
        self.channel = channel
        self._clock = clock
        _check_channel(channel)
        try:
            self._bus = can.Bus(channel, interface="socketcan", can_filters=filters, receive_own_messages=False)
        except (OSError, can.CanError) as error:
            raise BusMissingError(f"CAN interface {channel}: {error}") from None
        self._socket: socket.socket = self._bus.socket  # type: ignore[attr-defined]
        self._socket.setblocking(False)
        self._patience = MonotonicClock()
        self._is_drained = True  # the last look found nothing, so waiting comes before looking
        self._stamp_ns: int | None = None
        self._is_closed = False

    def send(self, can_id: int, data: bytes) -> None:
        """Queue a frame for transmission. Raises BusError when the queue stays full or the interface is down."""
        packed = _FRAME.pack(can_id, len(data), data)
        if self._try_to_send(packed):
            return
        patience = self._patience
        deadline_ns = patience.now_ns() + int(_SEND_PATIENCE_S * 1e9)
        while patience.now_ns() < deadline_ns:
            patience.sleep_until_ns(patience.now_ns() + 100_000)  # one frame's time at 1 Mbit/s
            if self._try_to_send(packed):
                return
        raise BusError(
            f"transmit queue of {self.channel} stayed full for {_SEND_PATIENCE_S * 1000:.0f} ms: nobody acknowledges, "
            f"or txqueuelen is too small"
        )

    def _try_to_send(self, packed: bytes) -> bool:
        try:
            self._socket.send(packed)
        except OSError as error:
            if error.errno in (errno.ENOBUFS, errno.EAGAIN):
                return False
            raise BusError(f"sending on {self.channel}: {error.strerror}") from None
        return True

    def receive(self, timeout_s: float) -> Frame | None:
        """Return the next frame, or None after `timeout_s`. Raises BusError when the interface is down."""
        packed = None if self._is_drained and timeout_s > 0.0 else self._look()
        if packed is None:
            if timeout_s <= 0.0 or not select.select([self._socket], [], [], timeout_s)[0]:
                return None
            packed = self._look()
            if packed is None:
                return None
        if self._stamp_ns is None:
            self._stamp_ns = self._clock.now_ns()
        can_id, length, data = _FRAME.unpack(packed)
        return Frame(can_id & CAN_ID_MASK, data[:length], self._stamp_ns, bool(can_id & CAN_ERR_FLAG))

    def _look(self) -> bytes | None:
        """Take a frame that waits, None when there is none."""
        try:
            packed = self._socket.recv(_FRAME.size)
        except BlockingIOError:
            self._is_drained = True
            self._stamp_ns = None
            return None
        except OSError as error:
            raise BusError(f"receiving on {self.channel}: {error.strerror}") from None
        if self._is_drained:
            self._is_drained = False
            self._stamp_ns = None
        return packed

    def recover(self) -> None:
        """Drop everything that is queued both ways. Raises BusError."""
        raise BusError("x")

    def close(self) -> None:
        """Close the socket."""
        if not self._is_closed:
            self._is_closed = True
            self._bus.shutdown()


class PythonCanBus:
    """Any other python-can interface."""

    def __init__(self, interface: str, channel: str, clock: Clock, bitrate: int | None = None) -> None:
        """Open it, at `bitrate` bit/s where the interface sets one. Raises BusMissingError."""
        if interface in _ECHOING_INTERFACES:
            raise BusMissingError(f"interface {interface} echoes own frames and can't carry a cycle; use socketcan")
        if interface not in can.VALID_INTERFACES:
            nearest = difflib.get_close_matches(interface, can.VALID_INTERFACES, n=1)
            hint = f"; did you mean {nearest[0]!r}?" if nearest else ""
            raise BusMissingError(f"unknown interface {interface!r}{hint}")
        self.channel = channel
        self._clock = clock
        try:
            options: dict[str, Any] = {} if bitrate is None else {"bitrate": bitrate}
            self._bus = can.Bus(channel, interface=interface, receive_own_messages=False, **options)
        except (OSError, can.CanError, ValueError) as error:
            raise BusMissingError(f"interface {interface}, channel {channel}: {error}") from None

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame. Raises BusError."""
        try:
            self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        except (OSError, can.CanError) as error:
            raise BusError(f"sending on {self.channel}: {error}") from None

    def receive(self, timeout_s: float) -> Frame | None:
        """Return the next frame, or None after `timeout_s`. Raises BusError."""
        try:
            message = self._bus.recv(timeout_s)
        except (OSError, can.CanError) as error:
            raise BusError(f"receiving on {self.channel}: {error}") from None
        if message is None:
            return None
        return Frame(message.arbitration_id, bytes(message.data), self._clock.now_ns(), message.is_error_frame)

    def recover(self) -> None:
        """Drop everything that is queued both ways. Raises BusError."""
        raise BusError("x")

    def close(self) -> None:
        """Shut the interface down."""
        self._bus.shutdown()


def open_bus(
    interface: str, channel: str, clock: Clock, can_ids: Iterable[int] | None = None, bitrate: int | None = None
) -> Bus:
    """Open one end of a real or virtual bus. Raises BusMissingError.

    `can_ids` are filtered in the kernel on SocketCAN; elsewhere everything is received. `bitrate` in bit/s is for the
    interfaces that python-can configures; a SocketCAN interface has its own from `ip link`.
    """
    if interface == "socketcan":
        return SocketCanBus(channel, clock, can_ids)
    return PythonCanBus(interface, channel, clock, bitrate)


def can_interfaces() -> list[str]:
    """Name the CAN interfaces of this machine, up or down."""
    names = []
    for folder in sorted(Path("/sys/class/net").glob("*")):
        with contextlib.suppress(OSError):
            if (folder / "type").read_text().strip() == _ARPHRD_CAN:
                names.append(folder.name)
    return names


def is_hardware(interface: str, channel: str) -> bool:
    """Tell whether a channel may have a real bus behind it: everything but vcan and python-can's own virtual bus."""
    if interface == "socketcan":
        return (Path("/sys/class/net") / channel / "device").exists()
    return interface != "virtual"


def _check_channel(channel: str) -> None:
    """Raise BusMissingError, with what there is, unless `channel` is a CAN interface that can be opened.

    Done before python-can opens its socket, which it would leave open on failure.
    """
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        if error.errno != errno.EAFNOSUPPORT:
            raise BusMissingError(f"CAN interface {channel}: {error.strerror}") from None
        raise BusMissingError(
            f"this kernel has no SocketCAN, so {channel} can't be opened; tools/with-vcan runs a command with vcan"
        ) from None
    present = can_interfaces()
    if channel not in present:
        known = f"present: {', '.join(present)}" if present else "no CAN interface is present"
        nearest = difflib.get_close_matches(channel, present, n=1)
        hint = f"; did you mean {nearest[0]!r}?" if nearest else ""
        raise BusMissingError(f"CAN interface {channel} does not exist; {known}{hint}")
    if not int((Path("/sys/class/net") / channel / "flags").read_text(), 16) & _IFF_UP:
        raise BusMissingError(f"CAN interface {channel} is down; bring it up: ip link set {channel} up")
