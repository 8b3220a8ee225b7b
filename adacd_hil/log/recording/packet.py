"""Packets from the control process to the writer: one per cycle and one per event; they go through ring.py.

A cycle's packet: kind, count of messages, count of frames, packets dropped so far, t_ns; then per frame identifier,
count of data bytes, flags, its first 8 data bytes, t_ns; then per message channel and size; then the bodies; then the
data of FD frames beyond 8 bytes. So a cycle of classic frames has no overhead for FD frames.
"""

import functools
import struct
from collections.abc import Sequence
from typing import NamedTuple

from adacd_hil.log.types.message_types import MAX_DATA
from adacd_hil.records import Event
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.frame_lengths import CLASSIC_BYTES

CYCLE = 1
EVENT = 2

_HEAD_FORMAT = "BBHIq"
_HEAD_FIELDS = 5
_FRAME_FORMAT = "IBB2x8sq"
_FRAME_FIELDS = 5
_MESSAGE_FORMAT = "HH"
_HEAD = struct.Struct("<" + _HEAD_FORMAT)
_EVENT = struct.Struct("<BxxxIqHHI")
_IS_TX = 1
_IS_ERROR = 2
_MAX_TEXT = 4096
"""Longest name or message of an event, bytes; keeps a chunk within its size."""


@functools.cache
def _table(frame_count: int, message_count: int) -> struct.Struct:
    """Return the struct of a cycle's packet up to its bodies: the head, then so many frames, then so many messages."""
    return struct.Struct("<" + _HEAD_FORMAT + _FRAME_FORMAT * frame_count + _MESSAGE_FORMAT * message_count)


def pack_cycle(
    t_ns: int, dropped: int, messages: Sequence[tuple[int, bytes]], frames: Sequence[tuple[bool, Frame]]
) -> bytes:
    """Return the packet of a cycle: the head, then its frames, then its messages, laid out as the module says.

    messages: channel and body. frames: True if the host sent it, and the frame. dropped: number of packets lost so far.
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
    """Return the packet of an event; each of its texts is cut at 4 KiB. dropped: number of packets lost so far."""
    texts = [text.encode("utf-8", "replace")[:_MAX_TEXT] for text in event]
    return _EVENT.pack(EVENT, dropped, t_ns, *map(len, texts)) + b"".join(texts)


class Packet(NamedTuple):
    """The content of a packet: of a cycle its frames and messages as `pack_cycle` takes them, or an event.

    dropped: number of packets lost before it, since the log began.
    """

    t_ns: int
    dropped: int
    frames: Sequence[tuple[bool, Frame]] = ()
    messages: Sequence[tuple[int, bytes]] = ()
    event: Event | None = None


def unpack(data: bytes) -> Packet | None:
    """Return the content of a packet; None for inconsistent sizes, a frame over MAX_DATA bytes, or an unknown kind."""
    try:
        content, end = (_unpack_cycle if data[0] == CYCLE else _unpack_event)(data)
    except (struct.error, IndexError, ValueError):
        return None
    return content if end == len(data) else None


def _unpack_cycle(data: bytes) -> tuple[Packet, int]:
    """Return the content of a cycle's packet, and the offset of its end.

    Raises struct.error for a packet that is cut within its table, ValueError for a frame of more than MAX_DATA bytes.
    """
    _, message_count, frame_count, dropped, t_ns = _HEAD.unpack_from(data)
    table = _table(frame_count, message_count)
    values = table.unpack_from(data)
    first_message = _HEAD_FIELDS + frame_count * _FRAME_FIELDS
    place = table.size
    messages = []
    for channel, size in zip(values[first_message::2], values[first_message + 1 :: 2], strict=True):
        messages.append((channel, data[place : place + size]))
        place += size
    frames = []
    for index in range(_HEAD_FIELDS, first_message, _FRAME_FIELDS):
        can_id, length, flags, first_bytes, frame_t_ns = values[index : index + _FRAME_FIELDS]
        frame_data = first_bytes[:length]
        if length > CLASSIC_BYTES:
            rest = length - CLASSIC_BYTES
            frame_data += data[place : place + rest]
            place += rest
        if length > MAX_DATA:
            raise ValueError(f"a frame has {length} bytes, more than {MAX_DATA}")
        frames.append((bool(flags & _IS_TX), Frame(can_id, frame_data, frame_t_ns, bool(flags & _IS_ERROR))))
    return Packet(t_ns, dropped, frames, messages), place


def _unpack_event(data: bytes) -> tuple[Packet, int]:
    """Return the content of an event's packet, and the offset of its end.

    Raises struct.error for a packet that is cut within its head, ValueError for another kind of packet.
    """
    kind, dropped, t_ns, *sizes = _EVENT.unpack_from(data)
    if kind != EVENT:
        raise ValueError(f"{kind} is no kind of packet")
    texts, place = [], _EVENT.size
    for size in sizes:
        texts.append(data[place : place + size].decode("utf-8", "replace"))
        place += size
    return Packet(t_ns, dropped, event=Event(*texts)), place
