"""Packets between the control process and the writer: one per cycle, one per event, one to end.

A cycle's packet: kind, count of messages, count of frames, packets dropped so far, t_ns; then per frame identifier,
count of data bytes, flags, the first 8 of them, t_ns; then per message channel and size; then the bodies; then what FD
frames have beyond 8 bytes. So a cycle of classic frames pays nothing for the others.
"""

import functools
import struct
from collections.abc import Sequence
from typing import NamedTuple

from adacd_hil.records import Event
from adacd_hil.wire.bus import MAX_CLASSIC_BYTES, Frame

CYCLE = 1
EVENT = 2
END = 3

_HEAD_FORMAT = "BBHIq"
_FRAME_FORMAT = "IBB2x8sq"
_MESSAGE_FORMAT = "HH"
_HEAD = struct.Struct("<" + _HEAD_FORMAT)
_FRAME = struct.Struct("<" + _FRAME_FORMAT)
_MESSAGE = struct.Struct("<" + _MESSAGE_FORMAT)
_EVENT = struct.Struct("<BxxxIqHHI")
_IS_TX = 1
_IS_ERROR = 2
_MAX_TEXT = 4096
"""Longest name or message of an event, bytes; keeps a chunk within its size."""


class LoggedFrame(NamedTuple):
    """A frame on its way to the log."""

    can_id: int
    length: int
    is_tx: bool
    is_error: bool
    data: bytes  # 8 bytes, of which `length` count; all of them when there are more
    t_ns: int


class CyclePacket(NamedTuple):
    """A cycle's packet, unpacked."""

    t_ns: int
    dropped: int
    frames: list[LoggedFrame]
    messages: list[tuple[int, bytes]]  # channel, body


class EventPacket(NamedTuple):
    """An event's packet, unpacked."""

    t_ns: int
    dropped: int
    event: Event


@functools.cache
def _table(frame_count: int, message_count: int) -> struct.Struct:
    """Make the packer of everything but the bodies: one call per cycle."""
    return struct.Struct("<" + _HEAD_FORMAT + _FRAME_FORMAT * frame_count + _MESSAGE_FORMAT * message_count)


def pack_cycle(
    t_ns: int, dropped: int, messages: Sequence[tuple[int, bytes]], frames: Sequence[tuple[bool, Frame]]
) -> bytes:
    """Pack a cycle."""
    values: list[int | bytes] = [CYCLE, len(messages), len(frames), dropped, t_ns]
    rests = []
    for is_tx, (can_id, data, frame_t_ns, is_error) in frames:
        length = len(data)
        values += (can_id, length, is_tx | is_error << 1, data, frame_t_ns)
        if length > MAX_CLASSIC_BYTES:
            rests.append(data[MAX_CLASSIC_BYTES:])
    parts = [b""]
    for channel, body in messages:
        values += (channel, len(body))
        parts.append(body)
    parts[0] = _table(len(frames), len(messages)).pack(*values)
    return b"".join((*parts, *rests)) if rests else b"".join(parts)


def pack_event(t_ns: int, dropped: int, event: Event) -> bytes:
    """Pack an event; longer texts are cut at 4 KiB."""
    texts = [text.encode("utf-8", "replace")[:_MAX_TEXT] for text in event]
    return _EVENT.pack(EVENT, dropped, t_ns, *map(len, texts)) + b"".join(texts)


def pack_end(dropped: int) -> bytes:
    """Pack the last packet."""
    return _HEAD.pack(END, 0, 0, dropped, 0)


def unpack(packet: bytes) -> CyclePacket | EventPacket | None:
    """Unpack a packet; None is the end. Raises struct.error when it is too short."""
    kind = packet[0]
    if kind == EVENT:
        _, dropped, t_ns, *sizes = _EVENT.unpack_from(packet)
        texts, position = [], _EVENT.size
        for size in sizes:
            texts.append(packet[position : position + size].decode("utf-8", "replace"))
            position += size
        return EventPacket(t_ns, dropped, Event(*texts))
    kind, message_count, frame_count, dropped, t_ns = _HEAD.unpack_from(packet)
    if kind == END:
        return None
    tables = _HEAD.size + frame_count * _FRAME.size
    frames = [
        LoggedFrame(can_id, length, bool(flags & _IS_TX), bool(flags & _IS_ERROR), data, frame_t_ns)
        for can_id, length, flags, data, frame_t_ns in _FRAME.iter_unpack(packet[_HEAD.size : tables])
    ]
    position = tables + message_count * _MESSAGE.size
    messages = []
    for channel, size in _MESSAGE.iter_unpack(packet[tables:position]):
        messages.append((channel, packet[position : position + size]))
        position += size
    if position < len(packet):
        _join_rests(frames, packet[position:])
    return CyclePacket(t_ns, dropped, frames, messages)


def _join_rests(frames: list[LoggedFrame], rests: bytes) -> None:
    """Give the FD frames what they have beyond 8 bytes."""
    position = 0
    for index, frame in enumerate(frames):
        if frame.length > MAX_CLASSIC_BYTES:
            end = position + frame.length - MAX_CLASSIC_BYTES
            frames[index] = frame._replace(data=frame.data + rests[position:end])
            position = end
