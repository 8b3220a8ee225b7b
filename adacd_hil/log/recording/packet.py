"""Packets from the control process to the writer: one per cycle and one per event; they go through ring.py.

A cycle's packet: kind, count of messages, count of frames, packets dropped so far, t_ns; then per frame identifier,
count of data bytes, flags, its first 8 data bytes, t_ns; then per message channel and size; then the bodies; then the
data of FD frames beyond 8 bytes. So a cycle of classic frames has no overhead for FD frames.
The control process packs one packet at a time; the writer unpacks hundreds at once, into arrays.
"""

import functools
import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.log.types.message_types import MAX_DATA
from adacd_hil.records import Event
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.frame_lengths import CLASSIC_BYTES

CYCLE = 1
EVENT = 2

_HEAD_FORMAT = "BBHIq"
_FRAME_FORMAT = "IBB2x8sq"
_MESSAGE_FORMAT = "HH"
_EVENT_FORMAT = "BxxxIqHHI"
HEAD = struct.Struct("<" + _HEAD_FORMAT)
_EVENT = struct.Struct("<" + _EVENT_FORMAT)
IS_TX = 1
IS_ERROR = 2
_MAX_TEXT = 4096
"""Longest name or message of an event, bytes; keeps a chunk within its size."""

HEAD_DTYPE = np.dtype(
    [("kind", "u1"), ("messages", "u1"), ("frames", "<u2"), ("dropped", "<u4"), ("t_ns", "<i8")],
)
FRAME_DTYPE = np.dtype(
    {
        "names": ["can_id", "length", "flags", "data", "t_ns"],
        "formats": ["<u4", "u1", "u1", ("u1", (CLASSIC_BYTES,)), "<i8"],
        "offsets": [0, 4, 5, 8, 16],
        "itemsize": 24,
    }
)
"""A frame of a packet: `flags` of IS_TX and IS_ERROR; `data`: the first 8 of `length` bytes."""
MESSAGE_DTYPE = np.dtype([("channel", "<u2"), ("size", "<u2")])
ROOM = MAX_DATA
"""Bytes behind the last packet that `unpack` may read."""


@functools.cache
def _table(frame_count: int, message_count: int) -> struct.Struct:
    """Return the struct of a packet without its bodies, which packs them in one call per cycle."""
    return struct.Struct("<" + _HEAD_FORMAT + _FRAME_FORMAT * frame_count + _MESSAGE_FORMAT * message_count)


def pack_cycle(
    t_ns: int, dropped: int, messages: Sequence[tuple[int, bytes]], frames: Sequence[tuple[bool, Frame]]
) -> bytes:
    """Return the packet of a cycle: its messages (channel, body), and its frames, each with True if it was sent.

    dropped: number of packets lost so far.
    """
    values: list[int | bytes] = [CYCLE, len(messages), len(frames), dropped, t_ns]
    rests = []
    for is_tx, (can_id, data, frame_t_ns, is_error) in frames:
        length = len(data)
        values += (can_id, length, is_tx | is_error << 1, data, frame_t_ns)
        if length > CLASSIC_BYTES:
            rests.append(data[CLASSIC_BYTES:])
    parts = [b""]
    for channel, body in messages:
        values += (channel, len(body))
        parts.append(body)
    parts[0] = _table(len(frames), len(messages)).pack(*values)
    return b"".join((*parts, *rests)) if rests else b"".join(parts)


def pack_event(t_ns: int, dropped: int, event: Event) -> bytes:
    """Return the packet of an event; longer texts are cut at 4 KiB. dropped: number of packets lost so far."""
    texts = [text.encode("utf-8", "replace")[:_MAX_TEXT] for text in event]
    return _EVENT.pack(EVENT, dropped, t_ns, *map(len, texts)) + b"".join(texts)


class Columns(NamedTuple):
    """The content of many packets, as arrays; rows are in the order of the packets and, within a packet, as packed."""

    data: NDArray[np.uint8]  # the packets' bytes, with room after the last
    starts: NDArray[np.int64]  # (n,) where each packet begins
    sizes: NDArray[np.int64]  # (n,)
    heads: NDArray[Any]  # (n,) of HEAD_DTYPE
    frames: NDArray[Any]  # (f,) of FRAME_DTYPE
    frame_counts: NDArray[np.int64]  # (n,) frames of each packet
    rest_starts: NDArray[np.int64]  # (f,) where the bytes of each frame beyond 8 begin
    messages: NDArray[Any]  # (m,) of MESSAGE_DTYPE
    message_counts: NDArray[np.int64]  # (n,)
    body_starts: NDArray[np.int64]  # (m,)


def is_whole(data: NDArray[np.uint8], starts: NDArray[np.int64], sizes: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return for each packet (n,) whether it has a whole head of a known kind.

    data: bytes of all packets, with ROOM bytes after the last. starts, sizes: of each packet in `data`.
    """
    kinds = data[starts]
    return np.asarray((sizes >= HEAD.size) & ((kinds == CYCLE) | (kinds == EVENT)))


def times_ns(data: NDArray[np.uint8], starts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return t_ns of packets (n,), whose heads must be whole; starts: where each begins in `data`."""
    heads: NDArray[Any] = gather(data, starts, HEAD.size).view(HEAD_DTYPE)
    return np.asarray(heads["t_ns"])


def unpack(data: NDArray[np.uint8], starts: NDArray[np.int64], sizes: NDArray[np.int64]) -> Columns:
    """Return the contents of the packets that begin at `starts` as columns; leave out packets with inconsistent sizes.

    `data` has ROOM bytes after the last packet.
    """
    columns, is_right = _unpack(data, starts, sizes)
    return columns if is_right.all() else _unpack(data, columns.starts[is_right], columns.sizes[is_right])[0]


def _unpack(
    data: NDArray[np.uint8], starts: NDArray[np.int64], sizes: NDArray[np.int64]
) -> tuple[Columns, NDArray[np.bool_]]:
    """Unpack packets whose tables lie within them; also tell which of these are exactly as long as their parts."""
    heads: NDArray[Any] = gather(data, starts, HEAD.size).view(HEAD_DTYPE)
    is_cycle = heads["kind"] == CYCLE
    frame_counts: NDArray[np.int64] = np.where(is_cycle, heads["frames"], 0).astype(np.int64)
    message_counts: NDArray[np.int64] = np.where(is_cycle, heads["messages"], 0).astype(np.int64)
    table_bytes = HEAD.size + frame_counts * FRAME_DTYPE.itemsize + message_counts * MESSAGE_DTYPE.itemsize
    fits = np.where(is_cycle, table_bytes, _EVENT.size) <= sizes
    if not fits.all():
        return _unpack(data, starts[fits], sizes[fits])
    first_frames = starts + HEAD.size
    first_messages = first_frames + frame_counts * FRAME_DTYPE.itemsize
    frame_starts = np.repeat(first_frames, frame_counts) + _numbers(frame_counts) * FRAME_DTYPE.itemsize
    message_starts = np.repeat(first_messages, message_counts) + _numbers(message_counts) * MESSAGE_DTYPE.itemsize
    frames = gather(data, frame_starts, FRAME_DTYPE.itemsize).view(FRAME_DTYPE)
    messages = gather(data, message_starts, MESSAGE_DTYPE.itemsize).view(MESSAGE_DTYPE)
    bodies_before, body_sums = sums_within(messages["size"], message_counts)
    rests = np.maximum(frames["length"].astype(np.int64) - CLASSIC_BYTES, 0)
    rests_before, rest_sums = sums_within(rests, frame_counts)
    is_right = ~is_cycle | (table_bytes + body_sums + rest_sums == sizes)
    columns = Columns(
        data=data,
        starts=starts,
        sizes=sizes,
        heads=heads,
        frames=frames,
        frame_counts=frame_counts,
        rest_starts=np.repeat(starts + table_bytes + body_sums, frame_counts) + rests_before,
        messages=messages,
        message_counts=message_counts,
        body_starts=np.repeat(starts + table_bytes, message_counts) + bodies_before,
    )
    return columns, is_right


def unpack_event(columns: Columns, index: int) -> Event:
    """Return the event in packet `index`, which must be an event's."""
    start = int(columns.starts[index])
    packet = columns.data[start : start + int(columns.sizes[index])].tobytes()
    _, _, _, *sizes = _EVENT.unpack_from(packet)
    texts, position = [], _EVENT.size
    for size in sizes:
        texts.append(packet[position : position + size].decode("utf-8", "replace"))
        position += size
    return Event(*texts)


def long_data(columns: Columns, frames: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Return the data of some frames (k, 64); frames: their rows in `columns.frames` (k,).

    Bytes beyond a frame's length are arbitrary.
    """
    data = np.empty((len(frames), MAX_DATA), np.uint8)
    data[:, :CLASSIC_BYTES] = columns.frames["data"][frames]
    rest_bytes = MAX_DATA - CLASSIC_BYTES
    rests = gather(columns.data, columns.rest_starts[frames], rest_bytes)
    data[:, CLASSIC_BYTES:] = rests.view(np.uint8).reshape(-1, rest_bytes)
    return data


def windows(data: NDArray[np.uint8], size: int) -> NDArray[np.void]:
    """View `data` as overlapping items of `size` bytes, one from each offset on: numpy copies such an item whole."""
    return np.ndarray((len(data) - size + 1,), f"V{size}", data, strides=(1,))


def gather(data: NDArray[np.uint8], starts: NDArray[np.int64], size: int) -> NDArray[np.void]:
    """Return copies of the `size` bytes from each offset of `starts` on, one item each (n,)."""
    return windows(data, size)[starts]


def sums_within(values: NDArray[Any], counts: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Sum values within groups: return for each value the sum of those before it in its group, and each group's total.

    The groups follow each other in `values`; counts: number of values in each.
    """
    running: NDArray[np.int64] = np.zeros(len(values) + 1, np.int64)
    np.cumsum(values, out=running[1:])
    ends = np.cumsum(counts)
    firsts = running[ends - counts]
    return running[:-1] - np.repeat(firsts, counts), running[ends] - firsts


def _numbers(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return each member's number within its group, for consecutive groups, from 0."""
    return np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
