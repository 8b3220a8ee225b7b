"""SocketCAN through its raw socket, classic and FD: a `can.Message` costs more than everything else in a cycle.

Sources: Linux Documentation/networking/can.rst; linux/can.h, linux/can/raw.h. The kernel's filter drops remote frames,
and 29-bit identifiers that fit into 11 bits.

This end distinguishes three failures of a live bus: the transmit queue stays full (no node acknowledges), the interface
down or vanishes, the controller goes bus-off. After the second this end stays closed until `recover`, so that no frame
is sent on an interface that others have set up again.
"""

import errno
import select
import socket
import struct
from collections import deque
from collections.abc import Iterable, Sequence
from typing import NoReturn

from adacd_hil.clock import Clock, MonotonicClock
from adacd_hil.wire.bus import (
    NOTHING_QUEUED,
    Bus,
    BusError,
    BusMissingError,
    BusOffError,
    Frame,
    InterfaceDownError,
    QueueBytes,
    TransmitQueueError,
)
from adacd_hil.wire.can_interface import CanInterface
from adacd_hil.wire.error_frames import ERROR_CLASS_MASK, is_bus_off
from adacd_hil.wire.frame_batches import CAN_ID_MASK, FrameReceiver, FrameSender
from adacd_hil.wire.frame_lengths import CLASSIC_BYTES, FD_LENGTHS, MAX_STANDARD_ID

CAN_RTR_FLAG = 0x40000000
CAN_EFF_FLAG = 0x80000000
CANFD_BRS = 0x01
_FRAME = struct.Struct("=IB3x8s")
_FD_FRAME = struct.Struct("=IBB2x64s")
_FILTER = struct.Struct("=II")
_CAN_RAW_ERR_FILTER = 2
_SO_MEMINFO = 55
_SO_RCVBUFFORCE = 33
_MEMINFO = struct.Struct("=9I")
_RECEIVED, _SENT, _DROPS = 0, 2, 8  # of its numbers
_DOWN = (errno.ENETDOWN, errno.ENODEV, errno.ENXIO)
_LISTENER_BYTES = 1 << 24
"""Receive buffer of a listener: some 20,000 frames, 2 s of a full bus at 1 Mbit/s."""
_LIVE_S = 0.25
"""Longest silence of a bus with two arms: 2.5 of the usual heartbeat periods."""
_SEND_PATIENCE_S = 0.05
"""Longest wait for room in the transmit queue: over 300 frames at 1 Mbit/s, so a live bus has drained by then."""


class SocketCanBus(Bus):
    """A SocketCAN interface. Received frames are fetched in batches; each carries the kernel's reception stamp.

    With a clock other than MonotonicClock each carries that clock's time instead.
    """

    def __init__(
        self,
        channel: str,
        clock: Clock,
        can_ids: Iterable[int] | None = None,
        is_fd: bool = False,
        is_shared: bool = False,
    ) -> None:
        """Open `channel`, receiving only `can_ids` if given. `is_fd`: for CAN FD, too. `is_shared`: see `recover`.

        Without `can_ids` the receive buffer is a listener's, or as large as the system allows an unprivileged user.
        Raises BusMissingError if the kernel has no SocketCAN, or the interface is absent, down, or carries no CAN FD
        although `is_fd`.
        """
        self._is_shared = is_shared
        self.channel = channel
        self._clock = clock
        self._is_listener = can_ids is None
        self._filters = _pack_filters(can_ids)
        self._is_fd = is_fd
        self._interface = CanInterface(channel)
        self._patience = MonotonicClock()
        self._lost_before = 0  # drops of earlier sockets
        self._is_down = False
        self._is_closed = False
        _require_socketcan(channel)
        problem = self._interface.problem(is_fd)
        if problem:
            raise BusMissingError(problem)
        self._open()

    def _open(self) -> None:
        """Open and bind a socket, and make its receiver and sender; drop received frames of an earlier one.

        Raises BusMissingError if the interface can't be bound.
        """
        opened = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        try:
            opened.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, self._filters)
            opened.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, ERROR_CLASS_MASK)
            opened.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, int(self._is_fd))
            if self._is_listener:
                _widen(opened)
            opened.setblocking(False)
            opened.bind((self.channel,))
            self._receiver = FrameReceiver(opened, self._clock)
        except OSError as error:
            opened.close()
            raise BusMissingError(f"CAN interface {self.channel}: {error.strerror}") from None
        self._socket = opened
        self._sender = FrameSender(opened)
        self._received: deque[Frame] = deque()
        self._is_down = False

    def send(self, can_id: int, data: bytes) -> None:
        """Queue a frame for transmission; identifiers beyond 0x7FF are 29-bit ones.

        If the queue is full, wait for room, up to _SEND_PATIENCE_S. Raises TransmitQueueError if it stays full,
        InterfaceDownError, or BusError for other failures and for data that the bus can't carry.
        """
        packed = self._pack(can_id, data)
        try:
            self._socket.send(packed)
        except OSError as error:
            if error.errno not in (errno.ENOBUFS, errno.EAGAIN):
                self._fail("sending", error)
            self._send_patiently(packed)

    def send_all(self, frames: Sequence[tuple[int, bytes]]) -> None:
        """Queue several frames in this order, in one system call if they are 64 at most and there is room for all.

        Wait for room as `send`. Raises TransmitQueueError, InterfaceDownError or BusError as `send`.
        """
        packed = [self._pack(can_id, data) for can_id, data in frames]
        sent = 0 if self._socket.fileno() < 0 else self._sender.send(packed)
        for can_id, data in frames[sent:]:  # no room for all, or an error, which `send` raises
            self.send(can_id, data)

    def _pack(self, can_id: int, data: bytes) -> bytes:
        """Return the kernel's struct of a frame. Raises BusError for data that the bus can't carry."""
        if can_id > MAX_STANDARD_ID:
            can_id |= CAN_EFF_FLAG
        length = len(data)
        return _FRAME.pack(can_id, length, data) if length <= CLASSIC_BYTES else self._pack_fd(can_id, data)

    def _pack_fd(self, can_id: int, data: bytes) -> bytes:
        if not self._is_fd:
            raise BusError(f"sending on {self.channel}: {len(data)} data bytes need CAN FD, and it was opened without")
        if len(data) not in FD_LENGTHS:
            allowed = ", ".join(map(str, FD_LENGTHS))
            raise BusError(f"sending on {self.channel}: an FD frame can't have {len(data)} data bytes, only {allowed}")
        return _FD_FRAME.pack(can_id, len(data), CANFD_BRS, data)

    def _send_patiently(self, packed: bytes) -> None:
        """Send a frame as soon as there is room for it, trying every 0.1 ms.

        Raises TransmitQueueError after _SEND_PATIENCE_S, InterfaceDownError or BusError for an error other than a full
        queue.
        """
        patience = self._patience
        deadline_ns = patience.now_ns() + int(_SEND_PATIENCE_S * 1e9)
        while patience.now_ns() < deadline_ns:
            patience.sleep_until_ns(patience.now_ns() + 100_000)  # one frame's time at 1 Mbit/s
            try:
                self._socket.send(packed)
            except OSError as error:
                if error.errno not in (errno.ENOBUFS, errno.EAGAIN):
                    self._fail("sending", error)
            else:
                return
        raise TransmitQueueError(
            f"transmit queue of {self.channel} stayed full for {_SEND_PATIENCE_S * 1000:.0f} ms: no node acknowledges "
            f"(power, wiring, termination, bit rate), or it is too short: ip link set {self.channel} txqueuelen 64"
        )

    def receive(self, timeout_s: float) -> Frame | None:
        """Return the next frame, or None after `timeout_s`. An error frame is returned like others.

        Raises BusOffError, with the frame, for an error frame of bus-off; InterfaceDownError if the interface is down
        or absent; BusError for other failures.
        """
        received = self._received
        if not received:
            if self._socket.fileno() < 0:
                self._fail("receiving", OSError(errno.EBADF, "closed"))
            self._take(timeout_s)
            if not received:
                return None
        frame = received.popleft()
        if frame.is_error and is_bus_off(frame):
            raise BusOffError(
                f"{self.channel} is bus-off: its controller has left the bus after too many errors (wiring, "
                f"termination, bit rate); to have it return by itself: ip link set {self.channel} type can "
                f"restart-ms 100",
                frame,
            )
        return frame

    def _take(self, timeout_s: float) -> None:
        """Fetch received frames into `_received`; wait for the first up to `timeout_s`.

        Raises InterfaceDownError if the interface is down or absent, BusError for other failures.
        """
        try:
            if timeout_s <= 0.0 or self._receiver.wait(timeout_s):
                self._received.extend(self._receiver.take_frames())
        except BlockingIOError:
            return
        except OSError as error:
            self._fail("receiving", error)

    def _fail(self, doing: str, error: OSError) -> NoReturn:
        """Raise an error of the socket as BusError, or as InterfaceDownError if the interface is down or absent.

        The latter closes the socket, and until `recover` every further error is one. doing: the failed action, for the
        message.
        """
        if error.errno in _DOWN:
            self._is_down = True
            self._retire_socket()
        if self._is_down:
            reason = self._interface.problem(self._is_fd) or f"CAN interface {self.channel} was down and is up again"
            raise InterfaceDownError(f"{doing} on {self.channel}: {reason}") from None
        raise BusError(f"{doing} on {self.channel}: {'closed' if self._is_closed else error.strerror}") from None

    @property
    def frames_lost(self) -> int:
        """Number of received frames that the kernel dropped because this end didn't read them in time.

        Updated by the first frame after a drop, and by `queue_bytes`.
        """
        return self._lost_before + self._receiver.frames_lost

    def queue_bytes(self) -> QueueBytes:
        """Return the fill of both queues, by a system call; update `frames_lost`. Zeros if the socket is closed.

        Sent frames count until the interface has sent them.
        """
        if self._socket.fileno() < 0:
            return NOTHING_QUEUED
        info = _MEMINFO.unpack(self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size))
        self._receiver.frames_lost = info[_DROPS]
        return QueueBytes(info[_RECEIVED], info[_SENT])

    def recover(self) -> None:
        """Open the socket again; if old frames may wait, empty the interface's queue by taking it down and up.

        Old frames may wait if the queue isn't empty, or if there is a controller, unless the interface has been down
        since this end last sent. Other sockets of the interface see it go down. A shared interface is not taken down
        while the bus carries frames: then the queue empties by itself.

        Raises InterfaceDownError while the interface is down, BusError with the command if it isn't permitted, and
        after `close`.
        """
        if self._is_closed:
            raise BusError(f"recovering {self.channel}: closed")
        problem = self._interface.problem(self._is_fd)
        if problem:
            raise InterfaceDownError(problem)
        if not self._is_down and self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) in _DOWN:
            self._is_down = True  # not noticed before, so no frame was sent since
        may_hold = self._interface.waiting_frames() > 0 or not (self._is_down or self._interface.is_virtual)
        if may_hold and not (self._is_shared and self._carries_frames()):
            self._interface.take_down_and_up()
        self._retire_socket()
        self._is_down = True  # should it not open
        self._open()

    def _carries_frames(self) -> bool:
        """Return whether a frame passes within 0.25 s, from the bus or from any program of this machine, also this."""
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as listener:
            listener.bind((self.channel,))
            return bool(select.select([listener], [], [], _LIVE_S)[0])

    def _retire_socket(self) -> None:
        """Close the socket and drop its received frames; keep its count of drops."""
        self.queue_bytes()
        self._lost_before = self.frames_lost
        self._receiver.frames_lost = 0
        self._received.clear()
        self._socket.close()

    def close(self) -> None:
        """Close the socket; ignore a second call."""
        self._is_closed = True
        self._retire_socket()


def _widen(opened: socket.socket) -> None:
    """Give a socket a listener's receive buffer, or the largest that the system allows an unprivileged user."""
    try:
        opened.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _LISTENER_BYTES)
    except PermissionError:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _LISTENER_BYTES)


def _pack_filters(can_ids: Iterable[int] | None) -> bytes:
    """Return the kernel's receive filters; without `can_ids` for everything but remote and ambiguous frames.

    The kernel looks a filter up by table if it asks for identifier, 11 bits and no remote frame.
    """
    flags = CAN_EFF_FLAG | CAN_RTR_FLAG
    if can_ids is not None:
        return b"".join(
            _FILTER.pack(can_id, MAX_STANDARD_ID | flags)
            if can_id <= MAX_STANDARD_ID
            else _FILTER.pack(can_id | CAN_EFF_FLAG, CAN_ID_MASK | flags)
            for can_id in can_ids
        )
    extended = (_FILTER.pack(CAN_EFF_FLAG | 1 << bit, flags | 1 << bit) for bit in range(11, 29))
    return b"".join((_FILTER.pack(0, flags), *extended))


def _require_socketcan(channel: str) -> None:
    """Raise BusMissingError, for `channel`, unless a raw socket of SocketCAN can be opened."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        if error.errno != errno.EAFNOSUPPORT:
            raise BusMissingError(f"CAN interface {channel}: {error.strerror}") from None
        raise BusMissingError(
            f"this kernel has no SocketCAN, so {channel} can't be opened; tools/with-vcan runs a command with vcan"
        ) from None
