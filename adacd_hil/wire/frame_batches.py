"""Batches of SocketCAN frames: recvmmsg and sendmmsg in memory that is laid out once.

A received frame comes with the kernel's stamp of its reception and the number of frames that the socket has dropped so
far (SO_RXQ_OVFL). The kernel stamps by the wall clock; frames carry CLOCK_MONOTONIC.
Sources: recvmmsg(2), sendmmsg(2), cmsg(3), socket(7); linux/can.h, asm-generic/socket.h.
"""

import ctypes
import errno
import os
import socket
import struct
from collections.abc import Sequence
from typing import Any, Final

from adacd_hil.clock import Clock, MonotonicClock, wall_offset_ns
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.can_interface import CANFD_MTU
from adacd_hil.wire.frame_lengths import MAX_STANDARD_ID

CAN_ERR_FLAG = 0x20000000
CAN_ID_MASK = 0x1FFFFFFF

_FRAMES: Final = 64
"""Frames per system call: three cycles of a full bus at 1 Mbit/s."""
_IS_64_BIT = ctypes.sizeof(ctypes.c_void_p) == 8
_SO_RXQ_OVFL = 40
_SO_TIMESTAMPNS = 35 if _IS_64_BIT else 64  # the second is the one with 64 bits of seconds everywhere
_MSG_DONTWAIT = 0x40
_POLLIN = 1
_HEAD = "QII" if _IS_64_BIT else "III"  # struct cmsghdr: length, level, type
_RECEIVED = struct.Struct(f"=IB3x64s {_HEAD}qq {_HEAD}I")
"""A frame, the control message of its stamp, and that of the drop count, which comes after the first drop."""
_SLOT_BYTES = CANFD_MTU + 64
_STEP_NS = 20_000_000
"""After a longer silence, or a larger step of the wall clock, the two clocks are compared again."""
_TRUST_NS = 1_000_000_000
"""Longest use of one comparison of the clocks. Slewing moves both alike; only a step sets them apart."""


class _Vector(ctypes.Structure):
    """struct iovec."""

    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Head(ctypes.Structure):
    """struct msghdr."""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint32),
        ("vectors", ctypes.c_void_p),
        ("vector_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _MessageHead(ctypes.Structure):
    """struct mmsghdr."""

    _fields_ = (("head", _Head), ("length", ctypes.c_uint))


class _Poll(ctypes.Structure):
    """struct pollfd."""

    _fields_ = (("descriptor", ctypes.c_int), ("events", ctypes.c_short), ("found", ctypes.c_short))


class _Duration(ctypes.Structure):
    """struct timespec."""

    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


_libc = ctypes.CDLL(None, use_errno=True)
_receive, _send, _poll = _libc.recvmmsg, _libc.sendmmsg, _libc.ppoll
_receive.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p)
_send.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int)
_poll.argtypes = (ctypes.c_void_p, ctypes.c_ulong, ctypes.c_void_p, ctypes.c_void_p)


class FrameReceiver:
    """Receives the frames in a CAN socket, in batches.

    `frames_lost`: frames that the kernel dropped for want of room before those of the last `take_frames`; a batch ends
    at a drop.
    """

    def __init__(self, opened: socket.socket, clock: Clock) -> None:
        """Enable stamps and drop counts of the socket.

        With a clock other than MonotonicClock, frames carry that clock's time at `take_frames` instead of the kernel's
        stamp. Raises OSError if the kernel refuses one of these options.
        """
        opened.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        opened.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
        self.frames_lost = 0
        self._held: list[tuple[int, Frame]] = []  # frames behind a drop, each with the drop count before it
        self._descriptor = opened.fileno()
        self._clock = None if isinstance(clock, MonotonicClock) else clock
        self._memory = ctypes.create_string_buffer(_FRAMES * _SLOT_BYTES)
        self._messages, self._vectors = _lay_out(ctypes.addressof(self._memory), _SLOT_BYTES, CANFD_MTU)
        for index, message in enumerate(self._messages):
            message.head.control = ctypes.addressof(self._memory) + index * _SLOT_BYTES + CANFD_MTU
            message.head.control_length = _SLOT_BYTES - CANFD_MTU
        self._place = ctypes.addressof(self._messages)
        self._fresh = bytes(self._messages)  # the kernel overwrites lengths and flags
        self._polled = _Poll(self._descriptor, _POLLIN, 0)
        self._poll_place = ctypes.addressof(self._polled)
        self._duration = _Duration(0, 0)
        self._duration_place = ctypes.addressof(self._duration)
        self._offset_ns = wall_offset_ns()
        self._trusted_ns = 0
        self._last_ns = 0

    def wait(self, timeout_s: float) -> bool:
        """Wait until `take_frames` has a frame or an error to raise; return False if it has none after `timeout_s`.

        A signal restarts the whole wait. Raises OSError if the socket can't be waited for.
        """
        if self._held:
            return True
        whole_s = int(timeout_s)
        self._duration.seconds = whole_s
        self._duration.nanoseconds = int((timeout_s - whole_s) * 1e9)
        while (found := _poll(self._poll_place, 1, self._duration_place, None)) < 0:
            error = ctypes.get_errno()
            if error != errno.EINTR:
                raise OSError(error, os.strerror(error))
        return bool(found)

    def take_frames(self) -> list[Frame]:
        """Return up to 64 received frames without waiting; those behind a drop come with the next call.

        `frames_lost` then counts the drops before them. Raises BlockingIOError if there is no frame, OSError if the
        socket fails, as when the interface is down.
        """
        if self._held:
            return self._take_held()
        count = _receive(self._descriptor, self._place, _FRAMES, _MSG_DONTWAIT, None)
        if count < 0:
            error = ctypes.get_errno()
            raise OSError(error, os.strerror(error))
        ctypes.memmove(self._place, self._fresh, count * ctypes.sizeof(_MessageHead))
        frames = [self._decode(index * _SLOT_BYTES) for index in range(count)]
        if count and self._lost_before(count - 1) > self.frames_lost:
            self._held = [(self._lost_before(index), frame) for index, frame in enumerate(frames)]
            return self._take_held()
        return frames

    def _decode(self, place: int) -> Frame:
        can_id, length, data, _, _, _, seconds, nanoseconds, *_ = _RECEIVED.unpack_from(self._memory, place)
        t_ns = self._to_clock(seconds * 1_000_000_000 + nanoseconds)
        if can_id <= MAX_STANDARD_ID:
            return Frame(can_id, data[:length], t_ns)
        return Frame(can_id & CAN_ID_MASK, data[:length], t_ns, bool(can_id & CAN_ERR_FLAG))

    def _lost_before(self, index: int) -> int:
        """Return how many frames were dropped before a frame of the batch: its count, else the last known one."""
        *_, kind, lost = _RECEIVED.unpack_from(self._memory, index * _SLOT_BYTES)
        return lost if kind == _SO_RXQ_OVFL else self.frames_lost

    def _take_held(self) -> list[Frame]:
        """Take frames out of `_held`, up to the next drop, and return them; set `frames_lost`."""
        self.frames_lost = max(self.frames_lost, self._held[0][0])
        frames = [frame for lost, frame in self._held if lost <= self.frames_lost]
        self._held = self._held[len(frames) :]
        return frames

    def _to_clock(self, wall_ns: int) -> int:
        """Return a kernel stamp in CLOCK_MONOTONIC; if the frames have another clock, that clock's present time.

        After 1 s, a longer silence than 20 ms or a step of the wall clock, the two clocks are compared again.
        """
        if self._clock is not None:
            return self._clock.now_ns()
        if not (wall_ns < self._trusted_ns and 0 <= wall_ns - self._last_ns < _STEP_NS):
            self._offset_ns = wall_offset_ns()
            self._trusted_ns = wall_ns + _TRUST_NS
        self._last_ns = wall_ns
        return wall_ns - self._offset_ns


class FrameSender:
    """Sends several packed frames in one system call."""

    def __init__(self, opened: socket.socket) -> None:
        self._descriptor = opened.fileno()
        memory = ctypes.create_string_buffer(_FRAMES * CANFD_MTU)
        self._memory = memoryview(memory).cast("B")
        self._messages, self._vectors = _lay_out(ctypes.addressof(memory), CANFD_MTU, 0)
        self._place = ctypes.addressof(self._messages)
        self._lengths = [0] * _FRAMES

    def send(self, frames: Sequence[bytes]) -> int:
        """Send packed frames, the first 64, in one system call without waiting.

        Return how many the kernel accepted, the first ones; 0 on any error.
        """
        count = 0
        for count, packed in enumerate(frames[:_FRAMES], 1):
            slot, length = count - 1, len(packed)
            if self._lengths[slot] != length:
                self._lengths[slot] = self._vectors[slot].length = length
            start = slot * CANFD_MTU
            self._memory[start : start + length] = packed
        return max(0, int(_send(self._descriptor, self._place, count, _MSG_DONTWAIT)))


def _lay_out(memory: int, slot_bytes: int, length: int) -> tuple[Any, Any]:
    """Return the mmsghdr structs of a batch and their iovecs, each for `length` bytes at the beginning of its slot.

    memory: address of the first slot.
    """
    vectors = (_Vector * _FRAMES)()
    messages = (_MessageHead * _FRAMES)()
    for index in range(_FRAMES):
        vectors[index].base = memory + index * slot_bytes
        vectors[index].length = length
        messages[index].head.vectors = ctypes.addressof(vectors[index])
        messages[index].head.vector_count = 1
    return messages, vectors
