"""SocketCAN, classic frames.

The interface is opened by python-can (filters, error mask, options) and then used through its socket, because building
a `can.Message` costs more than everything else in a cycle together.
"""

import difflib
import errno
import select
import socket
import struct
from collections.abc import Iterable
from pathlib import Path

import can

from adacd_hil.clock import Clock, MonotonicClock
from adacd_hil.wire.bus import BusError, BusMissingError, Frame, can_interfaces

CAN_ERR_FLAG = 0x20000000
CAN_ID_MASK = 0x1FFFFFFF
_FRAME = struct.Struct("=IB3x8s")
_IFF_UP = 1
_SEND_PATIENCE_S = 0.05
"""Longest wait for room in the transmit queue: over 300 frames at 1 Mbit/s, so a live bus has drained by then."""


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

    def close(self) -> None:
        """Close the socket."""
        if not self._is_closed:
            self._is_closed = True
            self._bus.shutdown()


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
