"""Frames in batches, over a pair of local sockets that carry SocketCAN's structures; on vcan: test_bus_on_vcan.py."""

import socket
import struct
from collections.abc import Iterator

import pytest
from hang import HANG_S

from adacd_hil.clock import MonotonicClock, VirtualClock, wall_offset_ns
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.frame_batches import FrameReceiver, FrameSender

CLASSIC = struct.Struct("=IB3x8s")
FD = struct.Struct("=IBB2x64s")
STAMP_ERROR_NS = 500_000
"""The wall clock, by which the kernel stamps, is compared with the monotonic one; a busy machine may get in between."""


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    near.setblocking(False)
    with near, far:
        yield near, far


def contents(frames: list[Frame]) -> list[tuple[int, bytes, bool]]:
    return [(frame.can_id, frame.data, frame.is_error) for frame in frames]


def test_every_kind_of_frame_is_read_from_its_structure(pair: tuple[socket.socket, socket.socket]) -> None:
    near, far = pair
    long = bytes(range(1, 65))
    near.send(FD.pack(0x201, 64, 1, long))
    near.send(CLASSIC.pack(0x181, 3, b"\x01\x02\x03"))
    near.send(CLASSIC.pack(0x80000000 | 0x1ADACD00, 8, b"abcdefgh"))
    near.send(CLASSIC.pack(0x20000000 | 0x40, 8, b"ABCDEFGH"))
    near.send(CLASSIC.pack(0x7FF, 0, b""))
    assert contents(FrameReceiver(far, MonotonicClock()).take_frames()) == [
        (0x201, long, False),
        (0x181, b"\x01\x02\x03", False),
        (0x1ADACD00, b"abcdefgh", False),
        (0x40, b"ABCDEFGH", True),
        (0x7FF, b"", False),
    ]


def test_what_does_not_fit_into_a_batch_waits_for_the_next(pair: tuple[socket.socket, socket.socket]) -> None:
    near, far = pair
    far.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
    sender, receiver = FrameSender(near), FrameReceiver(far, MonotonicClock())
    seen: list[int] = []
    for first in range(0, 200, 4):  # as much at once as a local socket takes
        packed = [CLASSIC.pack(can_id, 0, b"") for can_id in range(first, first + 4)]
        assert sender.send(packed) == 4
        seen += [frame.can_id for frame in receiver.take_frames()]
    assert seen == list(range(200))


def test_where_time_is_virtual_frames_carry_it(pair: tuple[socket.socket, socket.socket]) -> None:
    near, far = pair
    clock = VirtualClock()
    clock.sleep_until_ns(42_000)
    near.send(CLASSIC.pack(0x181, 0, b""))
    (frame,) = FrameReceiver(far, clock).take_frames()
    assert frame.t_ns == 42_000


@pytest.mark.parametrize("step_ns", [-3_600_000_000_000, -30_000_000, 30_000_000, 3_600_000_000_000])
def test_a_wall_clock_that_was_set_is_compared_anew(
    pair: tuple[socket.socket, socket.socket], monkeypatch: pytest.MonkeyPatch, step_ns: int
) -> None:
    near, far = pair
    # The offset of a wall clock that is about to be set by `step_ns`: the kernel's is the clock after it.
    offset_ns = wall_offset_ns() - step_ns
    monkeypatch.setattr("adacd_hil.wire.frame_batches.wall_offset_ns", lambda: offset_ns)
    receiver = FrameReceiver(far, MonotonicClock())
    receiver._last_ns = MonotonicClock().now_ns() + offset_ns
    receiver._trusted_ns = receiver._last_ns + 1_000_000_000
    monkeypatch.setattr("adacd_hil.wire.frame_batches.wall_offset_ns", wall_offset_ns)
    before_ns = MonotonicClock().now_ns()
    near.send(CLASSIC.pack(0x181, 0, b""))
    (frame,) = receiver.take_frames()
    assert before_ns - STAMP_ERROR_NS <= frame.t_ns <= MonotonicClock().now_ns() + STAMP_ERROR_NS


def test_nothing_to_take_is_no_frame_but_an_error_of_the_socket(pair: tuple[socket.socket, socket.socket]) -> None:
    _, far = pair
    receiver = FrameReceiver(far, MonotonicClock())
    assert not receiver.wait(1e-4)
    with pytest.raises(BlockingIOError):
        receiver.take_frames()


def test_a_wait_ends_when_there_is_something(pair: tuple[socket.socket, socket.socket]) -> None:
    near, far = pair
    receiver = FrameReceiver(far, MonotonicClock())
    near.send(CLASSIC.pack(0x181, 0, b""))
    assert receiver.wait(HANG_S)


def test_a_full_queue_takes_the_first_of_what_is_sent(pair: tuple[socket.socket, socket.socket]) -> None:
    near, far = pair
    sender = FrameSender(near)
    packed = [CLASSIC.pack(can_id, 0, b"") for can_id in range(60)]
    taken = 0
    while (count := sender.send(packed)) == len(packed):
        taken += count
    taken += count
    receiver = FrameReceiver(far, MonotonicClock())
    seen: list[int] = []
    while len(seen) < taken:
        seen += [frame.can_id for frame in receiver.take_frames()]
    assert seen == [index % 60 for index in range(taken)]


def test_what_is_gone_takes_nothing(pair: tuple[socket.socket, socket.socket]) -> None:
    near, far = pair
    sender = FrameSender(near)
    far.close()
    assert sender.send([CLASSIC.pack(0x181, 0, b"")]) == 0
