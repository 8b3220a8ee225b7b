"""A walk over the records of an MCAP file, whole, cut or damaged: what is intact is kept, what isn't raises nothing.

Messages of fixed size are collected per topic as arrays of whole records, one gather per topic and chunk; the only
work per message is to find where it begins. mcap's own readers build objects per message, ten times slower, and the
seeking ones return nothing of a file without its end. Layout of records: MCAP specification, section Records.
"""

import io
import os
import struct
import zlib
from collections import defaultdict
from collections.abc import Callable, Collection
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream
from numpy.typing import NDArray

from adacd_hil.log.errors import LogError

MAGIC = b"\x89MCAP0\r\n"
MESSAGE_HEAD = 31
"""Bytes of a message record before its payload: opcode, length, channel, sequence, log time, publish time."""
_RECORD_HEAD = struct.Struct("<BQ")
RECORD_HEAD_BYTES = _RECORD_HEAD.size
"""Bytes of a record that its length doesn't count."""
_MESSAGE_START = struct.Struct("<BQH")
_MAX_CHUNK = 1 << 30
_DAMAGE = (McapError, zstandard.ZstdError, struct.error, ValueError, EOFError, MemoryError, OverflowError)


class Payload(NamedTuple):
    """The layout of a topic's payloads. `has_tail`: they end in bytes, counted by the field `count`, that fill `data`.

    Records of such payloads are padded with zeros to those with the longest tail.
    """

    dtype: "np.dtype[Any]"
    has_tail: bool = False


PayloadLayout = Callable[[Channel, Schema], Payload | None]
"""Describes the payloads of a channel; None where their size varies otherwise."""


def record_dtype(payload: "np.dtype[Any]") -> "np.dtype[Any]":
    """Describe a whole message record with such a payload."""
    assert payload.names is not None
    assert payload.fields is not None
    fields = [payload.fields[name] for name in payload.names]
    layout = {
        "names": ["record_length", "log_time", "publish_time", *payload.names],
        "formats": ["<u8", "<u8", "<u8", *(field[0] for field in fields)],
        "offsets": [1, 15, 23, *(MESSAGE_HEAD + int(field[1]) for field in fields)],
        "itemsize": MESSAGE_HEAD + payload.itemsize,
    }
    return np.dtype(layout)  # type: ignore[call-overload,no-any-return]


class Topic:
    """The messages of one topic, in the order of the file."""

    def __init__(self, type_name: str, payload: Payload | None) -> None:
        self.type_name = type_name
        self.dtype = None if payload is None else record_dtype(payload.dtype)
        self.has_tail = payload is not None and payload.has_tail
        self.pieces: list[NDArray[np.uint8]] = []  # (n, size of a record): numpy would not copy what no field covers
        self.places: list[NDArray[np.int64]] = []  # where each record began, increasing over the whole file
        self.payloads: list[bytes] = []  # where the size varies

    def forget(self) -> None:
        """Forget all messages."""
        self.pieces, self.places, self.payloads = [], [], []

    def records(self) -> NDArray[Any]:
        """Return all records (n,) of `dtype`."""
        assert self.dtype is not None
        if not self.pieces:
            return np.empty(0, self.dtype)
        records: NDArray[Any] = np.concatenate(self.pieces).view(self.dtype)[:, 0]
        return records

    def join(self, other: "Topic", bytes_before: int) -> bool:
        """Add what comes after, in another file, whose places count from `bytes_before`; False for another type."""
        if (other.type_name, other.dtype) != (self.type_name, self.dtype):
            return False
        self.pieces += other.pieces
        self.places += [places + bytes_before for places in other.places]
        self.payloads += other.payloads
        return True

    def place(self) -> NDArray[np.int64]:
        """Return the place of each record (n,)."""
        return np.concatenate(self.places) if self.places else np.empty(0, np.int64)


class Walk:
    """What a file holds. `problem` says in one line what is missing, "" for a whole file."""

    def __init__(self, path: Path, layout: PayloadLayout, topics: Collection[str] | None = None) -> None:
        """Read `path`, of the messages only those of `topics` when given.

        Raises LogError when the file can't be read or isn't MCAP.
        """
        self.attachments: dict[str, bytes] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.topics: dict[str, Topic] = {}
        self.problem = ""
        self._layout = layout
        self._wanted = topics
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Topic | None] = {}  # None: not wanted
        self.record_bytes = 0
        """Bytes of the chunks so far: the places of their records are counted by it."""
        self._is_undefined_used = False
        try:
            with path.open("rb") as file:
                self._read(file, path)
                if self._is_undefined_used and self._channels:
                    # The chunk with the definitions is damaged, but the summary repeats them.
                    for topic in self.topics.values():
                        topic.forget()
                    file.seek(0)
                    self._read(file, path)
        except OSError as error:
            raise LogError(f"log {path} can't be read: {error.strerror}") from None

    def _note(self, problem: str) -> None:
        self.problem = self.problem or problem

    def _read(self, file: IO[bytes], path: Path) -> None:
        size = os.fstat(file.fileno()).st_size
        magic = file.read(len(MAGIC))
        if not MAGIC.startswith(magic):
            raise LogError(f"{path} is not an MCAP file")
        crc = zlib.crc32(magic)
        position = len(magic)
        while True:
            head = file.read(_RECORD_HEAD.size)
            opcode, length = _RECORD_HEAD.unpack(head) if len(head) == _RECORD_HEAD.size else (0, 0)
            position += _RECORD_HEAD.size
            if opcode == 0 or length > size - position:
                self._note(f"cut after {size} bytes")
                return
            body = file.read(length)
            if opcode == Opcode.DATA_END and int.from_bytes(body[:4], "little") not in (0, crc):
                self._note("the data section fails its CRC")
            try:
                self._take(opcode, head + body)
            except _DAMAGE:
                self._note(f"damaged at byte {position}")
            if opcode == Opcode.FOOTER:
                if file.read(len(MAGIC)) != MAGIC:
                    self._note(f"cut after {size} bytes")
                return
            crc = zlib.crc32(body, zlib.crc32(head, crc))
            position += length

    def _take(self, opcode: int, record: bytes) -> None:
        """Take in a record outside chunks, or a chunk."""
        stream = ReadDataStream(io.BytesIO(record[_RECORD_HEAD.size :]))
        if opcode == Opcode.CHUNK:
            chunk = Chunk.read(stream)
            if chunk.uncompressed_size > _MAX_CHUNK:
                raise ValueError("chunk too large")
            data_stream, size = get_chunk_data_stream(chunk, validate_crc=True)
            self._take_messages(data_stream.read(size))
        elif opcode in (Opcode.MESSAGE, Opcode.CHANNEL, Opcode.SCHEMA):
            self._take_messages(record)
        elif opcode == Opcode.ATTACHMENT:
            attachment = Attachment.read(stream)
            if zlib.crc32(record[_RECORD_HEAD.size : -4]) != int.from_bytes(record[-4:], "little"):
                raise ValueError("attachment fails its CRC")
            self.attachments[attachment.name] = attachment.data
        elif opcode == Opcode.METADATA:
            metadata = Metadata.read(stream)
            self.metadata[metadata.name] = metadata.metadata

    def _take_messages(self, data: bytes) -> None:
        """Take in what a chunk holds."""
        found: defaultdict[int, list[int]] = defaultdict(list)
        unpack = _MESSAGE_START.unpack_from
        position = 0
        while position < len(data):
            opcode, length, channel_id = unpack(data, position)
            if opcode == Opcode.MESSAGE:
                found[channel_id].append(position)
            else:
                self._take_definition(opcode, data[position + _RECORD_HEAD.size : position + 9 + length])
            position += 9 + length
        for channel_id, places in found.items():
            self._is_undefined_used |= channel_id not in self._channels
            topic = self._channels.get(channel_id)
            if topic is not None:
                self._gather(topic, data, np.array(places))
        self.record_bytes += len(data)

    def _take_definition(self, opcode: int, body: bytes) -> None:
        stream = ReadDataStream(io.BytesIO(body))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            is_wanted = self._wanted is None or channel.topic in self._wanted
            schema = self._schemas.get(channel.schema_id, Schema(0, b"", "", ""))
            if is_wanted and channel.topic not in self.topics:
                self.topics[channel.topic] = Topic(schema.name, self._layout(channel, schema))
            self._channels[channel.id] = self.topics[channel.topic] if is_wanted else None

    def _gather(self, topic: Topic, data: bytes, places: NDArray[np.int64]) -> None:
        """Collect the records that begin at `places`."""
        if topic.dtype is None:
            for place in places.tolist():
                _, length, _ = _MESSAGE_START.unpack_from(data, place)
                topic.payloads.append(data[place + MESSAGE_HEAD : place + _RECORD_HEAD.size + length])
            return
        rows, is_right = (
            _rows_with_tail(topic.dtype, data, places) if topic.has_tail else _rows(topic.dtype, data, places)
        )
        topic.pieces.append(rows[is_right])
        topic.places.append(places[: len(rows)][is_right] + self.record_bytes)
        if len(places) != len(topic.pieces[-1]):
            self._note("a message is not as long as its schema says")


def _rows(
    dtype: "np.dtype[Any]", data: bytes, places: NDArray[np.int64]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Gather the records at increasing `places` that lie within `data` (n, size), and which of them are that long."""
    fitting = places[places + dtype.itemsize <= len(data)]
    if not len(fitting):
        return np.empty((0, dtype.itemsize), np.uint8), np.empty(0, np.bool_)
    rows = np.lib.stride_tricks.sliding_window_view(np.frombuffer(data, np.uint8), dtype.itemsize)[fitting]
    return rows, rows.view(dtype)[:, 0]["record_length"] == dtype.itemsize - _RECORD_HEAD.size


def _rows_with_tail(
    dtype: "np.dtype[Any]", data: bytes, places: NDArray[np.int64]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Gather as `_rows` does, with what lies beyond the tail zeroed."""
    assert dtype.fields is not None
    tail = int(dtype.fields["data"][1])
    rows, _ = _rows(dtype, data + bytes(dtype.itemsize - tail), places)
    records = rows.view(dtype)[:, 0]
    counts = records["count"]
    records["data"][np.arange(dtype.itemsize - tail) >= counts[:, np.newaxis]] = 0
    is_right = (records["record_length"] == tail - _RECORD_HEAD.size + counts) & (counts <= dtype.itemsize - tail)
    return rows, is_right
