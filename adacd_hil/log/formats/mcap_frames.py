"""The frames of an MCAP file, chunk by chunk: our logs, files of the python-can plugin, and recordings of ROS 2.

A topic with `to_can_bus` in its name has frames that were sent. What the types have no field for stands in the metadata
of the MCAP channel, of which a topic may have several:

| key | is |
|---|---|
| can_channel | name of the CAN channel; without it the one in the metadata `run` |
| bit_rate_switch, error_state_indicator | "0" or "1", of all its FD frames; without them 1 and 0, as on our bus |
"""

import contextlib
import io
import struct
import zlib
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata, Schema
from numpy.typing import NDArray

from adacd_hil.input_files import open_input
from adacd_hil.log.cdr import ENCAPSULATION
from adacd_hil.log.errors import LogError
from adacd_hil.log.formats.recorded_frames import RECORDED_FRAME_DTYPE
from adacd_hil.log.mcap.opening import Opening
from adacd_hil.log.mcap.records import MAGIC, MESSAGE_HEAD, MOST_RECORD_BYTES, RECORD_HEAD_BYTES
from adacd_hil.log.mcap_file import RUN_METADATA
from adacd_hil.log.parts import find_parts
from adacd_hil.log.reader import EPOCH_KEY
from adacd_hil.log.ros_types import CAN_FRAME, FD_FRAME, MAX_DATA
from adacd_hil.wire.bus import MAX_CLASSIC_BYTES

CHANNEL_KEY = "can_channel"
RATE_SWITCH_KEY = "bit_rate_switch"
ERROR_STATE_KEY = "error_state_indicator"
SENT = "to_can_bus"
_RECORD_HEAD = struct.Struct("<BQ")
_FOOTER = struct.Struct("<BQQQI")
_MESSAGE_START = struct.Struct("<BQH")
_NAME_BYTES = struct.Struct("<I")
_DAMAGE = (McapError, struct.error, ValueError, EOFError, MemoryError, OverflowError)
_HEAD_BYTES = MESSAGE_HEAD + len(ENCAPSULATION) + 12
"""Bytes of a record up to its frame_id."""
_HEAD_DTYPE = np.dtype(
    {
        "names": ["publish_time", "sec", "nanosec"],
        "formats": ["<u8", "<u4", "<u4"],
        "offsets": [23, _HEAD_BYTES - 12, _HEAD_BYTES - 8],
        "itemsize": _HEAD_BYTES,
    }
)
_CLASSIC_DTYPE = np.dtype(
    [
        ("can_id", "<u4"),
        ("is_remote", "u1"),
        ("is_extended", "u1"),
        ("is_error", "u1"),
        ("length", "u1"),
        ("data", "u1", (MAX_CLASSIC_BYTES,)),
    ]
)
"""What follows frame_id in can_msgs/msg/Frame."""
_FD_DTYPE = np.dtype(
    [("can_id", "<u4"), ("is_extended", "u1"), ("is_error", "u1"), ("length", "u1"), ("", "u1"), ("count", "<u4")]
)
"""What follows frame_id in ros2_socketcan_msgs/msg/FdFrame, up to its data."""
_NO_FRAMES = np.zeros(0, RECORDED_FRAME_DTYPE)


class _Source(NamedTuple):
    """What an MCAP channel says of all its frames."""

    is_fd: bool
    is_tx: bool
    channel: int
    has_rate_switch: bool
    has_error_state: bool


class McapFrames:
    """The frames of a log with all its parts: iterate once; `channels`, `epoch_ns` and `problem` grow meanwhile."""

    def __init__(self, source: Path | IO[bytes]) -> None:
        """Look at the file, or take an open one, of one part. Raises LogError when it can't be read or isn't MCAP."""
        self.channels: list[str] = []
        self.epoch_ns = 0
        self.problem = ""
        self._bus = ""
        self._schemas: dict[int, Schema] = {}
        self._sources: dict[int, _Source | None] = {}
        self._opening = Opening()
        self._files = _parts(source) if isinstance(source, Path) else [source]
        first = self._files[0]
        try:
            if isinstance(first, Path):
                with open_input(first) as file:
                    _check_magic(file, str(first))
            else:
                _check_magic(first, "the file")
                first.seek(0)
        except OSError as error:
            raise LogError(f"log {source} can't be read: {error.strerror or error}") from None

    def __iter__(self) -> Iterator[NDArray[Any]]:
        """Give the frames of each chunk, (n,) of RECORDED_FRAME_DTYPE."""
        for source in self._files:
            if not isinstance(source, Path):
                yield from self._read(source, "the file")
                continue
            try:
                with open_input(source) as file:
                    yield from self._read(file, source.name)
            except OSError as error:
                self._note(f"{source.name} can't be read: {error.strerror or error}")

    def _note(self, problem: str) -> None:
        self.problem = self.problem or problem

    def _read(self, file: IO[bytes], name: str) -> Iterator[NDArray[Any]]:
        """Walk over the records of a part."""
        size = file.seek(0, io.SEEK_END)
        file.seek(0)
        self._schemas, self._sources, self._opening = {}, {}, Opening()
        crc = zlib.crc32(file.read(len(MAGIC)))
        position = len(MAGIC)
        opcode = 0
        while opcode != Opcode.FOOTER:
            head = file.read(_RECORD_HEAD.size)
            position += len(head)
            opcode, length = _RECORD_HEAD.unpack(head) if len(head) == _RECORD_HEAD.size else (0, 0)
            if opcode == 0 or length > size - position:
                self._note(f"{name} is cut after {size} bytes")
                return
            if length > MOST_RECORD_BYTES:
                self._note(f"{name}: the record at byte {position} has {length} bytes, more than {MOST_RECORD_BYTES}")
                return
            body = file.read(length)
            position += length
            if opcode == Opcode.DATA_END and int.from_bytes(body[:4], "little") not in (0, crc):
                self._note(f"{name}: the data section fails its CRC")
            crc = zlib.crc32(body, zlib.crc32(head, crc))
            if opcode == Opcode.CHUNK and not self._sources:
                self._define_from_summary(file, size)
                file.seek(position)
            try:
                frames = self._take(opcode, head + body)
            except _DAMAGE:
                self._note(f"{name} is damaged at byte {position - length}")
                continue
            if len(frames):
                yield frames
        if file.read(len(MAGIC)) != MAGIC:
            self._note(f"{name} is cut after {size} bytes")

    def _define_from_summary(self, file: IO[bytes], size: int) -> None:
        """Take in the definitions that the end of the file repeats, for the case that their chunk is damaged."""
        place = size - len(MAGIC) - _FOOTER.size
        file.seek(max(place, 0))
        footer = file.read(_FOOTER.size)
        opcode, _, position, _, _ = _FOOTER.unpack(footer) if len(footer) == _FOOTER.size else (0, 0, 0, 0, 0)
        if opcode != Opcode.FOOTER or not max(0, place - MOST_RECORD_BYTES) < position <= place:
            return
        file.seek(position)
        summary = file.read(place - position)
        position = 0
        with contextlib.suppress(*_DAMAGE):
            while position < len(summary):
                opcode, length = _RECORD_HEAD.unpack_from(summary, position)
                position += _RECORD_HEAD.size + length
                self._define(opcode, summary[position - length : position])

    def _take(self, opcode: int, record: bytes) -> NDArray[Any]:
        """Take in a record outside chunks, or a chunk; return the frames in it."""
        stream = ReadDataStream(io.BytesIO(record[_RECORD_HEAD.size :]))
        if opcode == Opcode.CHUNK:
            chunk = Chunk.read(stream)
            return self._frames(self._opening.open_checked(chunk))
        if opcode in (Opcode.MESSAGE, Opcode.CHANNEL, Opcode.SCHEMA):
            return self._frames(record)
        if opcode == Opcode.METADATA:
            metadata = Metadata.read(stream)
            if metadata.name == RUN_METADATA:
                self._bus = metadata.metadata.get("channel", "")
                epoch_ns = metadata.metadata.get(EPOCH_KEY, "")
                self.epoch_ns = int(epoch_ns) if epoch_ns.isdecimal() else 0
        return _NO_FRAMES

    def _define(self, opcode: int, body: bytes) -> None:
        """Take in a schema or a channel."""
        stream = ReadDataStream(io.BytesIO(body))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            self._sources[channel.id] = self._source(channel)

    def _source(self, channel: Channel) -> _Source | None:
        schema = self._schemas.get(channel.schema_id)
        if schema is None or schema.name not in (CAN_FRAME.name, FD_FRAME.name):
            return None
        name = channel.metadata.get(CHANNEL_KEY, self._bus)
        if name not in self.channels:
            self.channels.append(name)
        is_fd = schema.name == FD_FRAME.name
        return _Source(
            is_fd=is_fd,
            is_tx=SENT in channel.topic,
            channel=self.channels.index(name),
            has_rate_switch=is_fd and channel.metadata.get(RATE_SWITCH_KEY, "1") == "1",
            has_error_state=is_fd and channel.metadata.get(ERROR_STATE_KEY, "0") == "1",
        )

    def _frames(self, data: bytes) -> NDArray[Any]:
        """Read the frames of a chunk in the order of the file."""
        found: defaultdict[tuple[_Source, int, int], list[int]] = defaultdict(list)
        position = 0
        while position < len(data):
            opcode, length, channel_id = _MESSAGE_START.unpack_from(data, position)
            end = position + RECORD_HEAD_BYTES + length
            if opcode == Opcode.MESSAGE:
                source = self._sources.get(channel_id)
                if source is not None:
                    (name_bytes,) = _NAME_BYTES.unpack_from(data, position + _HEAD_BYTES - _NAME_BYTES.size)
                    found[source, end - position, name_bytes].append(position)
            else:
                self._define(opcode, data[position + RECORD_HEAD_BYTES : end])
            position = end
        groups = [
            (_unpack(source, data, np.array(starts), size, name_bytes, self.epoch_ns), starts)
            for (source, size, name_bytes), starts in found.items()
        ]
        if not groups:
            return _NO_FRAMES
        places = np.concatenate([starts for _, starts in groups])
        frames: NDArray[Any] = np.concatenate([frames for frames, _ in groups])[np.argsort(places)]
        return frames


def _parts(path: Path) -> list[Path | IO[bytes]]:
    try:
        return list(find_parts(path).values()) or [path]
    except OSError:
        return [path]


def _check_magic(file: IO[bytes], name: str) -> None:
    if file.read(len(MAGIC)) != MAGIC:
        raise LogError(f"{name} is not an MCAP file")


def _unpack(
    source: _Source, data: bytes, starts: NDArray[np.int64], size: int, name_bytes: int, epoch_ns: int
) -> NDArray[Any]:
    """Unpack the messages of `size` bytes that begin at `starts`, whose frame_id has `name_bytes` bytes.

    Raises ValueError where they are shorter than their type.
    """
    body_start = _HEAD_BYTES + name_bytes
    body_start += -(body_start - MESSAGE_HEAD - len(ENCAPSULATION)) % 4
    body = _FD_DTYPE if source.is_fd else _CLASSIC_DTYPE
    if body_start + body.itemsize > size:
        raise ValueError("a frame is shorter than its type")
    rows = np.lib.stride_tricks.sliding_window_view(np.frombuffer(data, np.uint8), size)[starts]
    heads = rows[:, :_HEAD_BYTES].copy().view(_HEAD_DTYPE)[:, 0]
    bodies = rows[:, body_start : body_start + body.itemsize].copy().view(body)[:, 0]
    frames = np.zeros(len(starts), RECORDED_FRAME_DTYPE)
    frames["t_ns"] = heads["sec"].astype(np.int64) * 1_000_000_000 + heads["nanosec"] - epoch_ns
    frames["cycle_t_ns"] = heads["publish_time"].astype(np.int64) - epoch_ns
    frames["is_tx"] = source.is_tx
    frames["channel"] = source.channel
    for name in ("can_id", "length", "is_error", "is_extended"):
        frames[name] = bodies[name]
    if source.is_fd:
        frames["is_fd"] = True
        frames["has_rate_switch"] = source.has_rate_switch
        frames["has_error_state"] = source.has_error_state
        count = min(size - body_start - body.itemsize, MAX_DATA)
        data_bytes = rows[:, body_start + body.itemsize :][:, :count]
    else:
        frames["is_remote"] = bodies["is_remote"]
        data_bytes = bodies["data"]
    frames["length"] = np.minimum(frames["length"], MAX_DATA if source.is_fd else MAX_CLASSIC_BYTES)
    counts = np.where(frames["is_remote"], 0, frames["length"])
    is_data = np.arange(data_bytes.shape[1]) < counts[:, np.newaxis]
    frames["data"][:, : data_bytes.shape[1]] = np.where(is_data, data_bytes, 0)
    return frames
