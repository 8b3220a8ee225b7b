"""Frames from and to MCAP files: our logs, files of the python-can plugin, and recordings of ROS 2.

A topic with `to_can_bus` in its name has frames that were sent. The first CAN channel that is written has the topics of
our logs, each further one its own, with its name in front. The metadata of the MCAP channel, of which a topic may have
several, hold the values that the types have no field for:

| key | is |
|---|---|
| can_channel | name of the CAN channel; without it the one in the metadata `run` |
| bit_rate_switch, error_state_indicator | "0" or "1", of all its FD frames; without them 1 and 0, as on our bus |
"""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata
from numpy.typing import NDArray

from adacd_hil.file_access import open_input
from adacd_hil.log.log_files import EPOCH_KEY, RUN_METADATA, LogError, failing_as
from adacd_hil.log.log_parts import parts_of, summary_count
from adacd_hil.log.mcap.chunks import Block, Contents, read_blocks
from adacd_hil.log.mcap.mcap_records import DEFINITIONS, Definitions, Problem, RawRecord, check_magic, parse, summary_of
from adacd_hil.log.mcap.record_layout import HEAD, MAGIC, MESSAGE_HEAD, record_dtype
from adacd_hil.log.types.message_types import (
    CAN_FRAME,
    CAN_FRAME_DTYPE,
    ENCAPSULATION,
    FD_FRAME,
    FD_FRAME_DTYPE,
)
from adacd_hil.log.types.record_arrays import RECORDED_FRAME_DTYPE, SENT, fill_times

CHANNEL_KEY = "can_channel"
RATE_SWITCH_KEY = "bit_rate_switch"
ERROR_STATE_KEY = "error_state_indicator"
_HEAD_BYTES = MESSAGE_HEAD + len(ENCAPSULATION) + 12
"""Bytes of a record up to its frame_id."""
_FRAME_ID_BYTES = 8
"""Of a frame_id in a record of ours, its length before it and padding behind it."""
_RECORDS = {False: record_dtype(CAN_FRAME_DTYPE), True: record_dtype(FD_FRAME_DTYPE)}
"""Records of ours, classic and FD."""
_NO_FRAMES = np.zeros(0, RECORDED_FRAME_DTYPE)


class _Source(NamedTuple):
    """Properties of an MCAP channel that all its frames share. channel: index of the CAN channel in `channels`."""

    is_fd: bool
    is_tx: bool
    channel: int
    has_rate_switch: bool
    has_error_state: bool


class McapFrames:
    """The frames of a log with all its parts: iterate once; `channels`, `epoch_ns` and `problem` are complete after it.

    problem: the first damage or file that can't be read; "" without one. Neither damage nor a further part that can't
    be read raises an error in the iteration.
    """

    def __init__(self, source: Path | IO[bytes]) -> None:
        """Open a log with all its parts, or an open file as the only part.

        Raises LogError if the first part can't be read or doesn't begin as MCAP.
        """
        self.channels: list[str] = []
        self.epoch_ns = 0
        self.problem = ""
        self._bus = ""
        self._definitions = Definitions()
        self._sources: dict[int, _Source | None] = {}
        self._files = list(parts_of(source).values()) if isinstance(source, Path) else [source]
        first = self._files[0]
        with failing_as(f"log {source} can't be read"):
            if isinstance(first, Path):
                with open_input(first) as file:
                    check_magic(file.read(len(MAGIC)), str(first))
            else:
                check_magic(first.read(len(MAGIC)), "the file")
                first.seek(0)

    def __iter__(self) -> Iterator[NDArray[Any]]:
        """Yield the frames of each intact chunk that has some, in an array (n,) of RECORDED_FRAME_DTYPE.

        Keep the first damage, or part that can't be opened, in `problem`. Raises LogError for a part that isn't MCAP.
        """
        for source in self._files:
            if not isinstance(source, Path):
                yield from self._read(source, "the file")
                continue
            try:
                with failing_as(f"{source.name} can't be read"), open_input(source) as file:
                    yield from self._read(file, source.name)
            except LogError as error:
                self._note(str(error))

    def _note(self, problem: str) -> None:
        self.problem = self.problem or problem

    def _read(self, file: IO[bytes], name: str) -> Iterator[NDArray[Any]]:
        """Yield the frames of one file of the log, an array for each chunk; keep the first damage in `problem`.

        name: of the file, for `problem` and errors. Raises LogError if the file isn't MCAP.
        """
        self._definitions, self._sources = Definitions(), {}
        summary = summary_of(file)  # for the case that the chunk that defines channels is damaged
        for item in read_blocks(file, name, block_bytes=1):
            if isinstance(item, Block) and not self._sources:
                with contextlib.suppress(LogError):
                    for record in summary:
                        self._define(record)
            if isinstance(item, Problem):
                self._note(f"{name} is {item.text}" if item.is_damage else f"{name}: {item.text}")
                continue
            try:
                frames = self._take(item)
            except (LogError, ValueError):
                position = item.position if isinstance(item, Block) else item.offset + HEAD.size
                self._note(f"{name} is damaged at byte {position}")
                continue
            if len(frames):
                yield frames

    def _take(self, item: Block | RawRecord) -> NDArray[Any]:
        """Return the frames in a chunk, or in a message outside chunks; none for an attachment or metadata.

        Keep definitions, and from the metadata CAN channel and epoch of the run. Raises LogError for a damaged chunk,
        definition or metadata, ValueError for a frame that is shorter than its type.
        """
        if isinstance(item, Block):
            if item.problem or item.contents.breaks:
                raise LogError("a chunk is damaged")
            for record in item.contents.definitions:
                self._define(record)
            return self._frames(item.contents)
        if item.opcode == Opcode.METADATA:
            metadata: Metadata = parse(item.opcode, item.body)
            if metadata.name == RUN_METADATA:
                self._bus = metadata.metadata.get("channel", "")
                self.epoch_ns = summary_count(metadata.metadata, EPOCH_KEY)
        return _NO_FRAMES

    def _define(self, record: RawRecord) -> None:
        """Keep the schema or channel in a record; ignore other records. Raises LogError for an invalid one."""
        if record.opcode in DEFINITIONS:
            definition = self._definitions.add_record(record)
            if isinstance(definition, Channel):
                self._sources[definition.id] = self._source(definition)

    def _source(self, channel: Channel) -> _Source | None:
        """Return the properties of an MCAP channel's frames, and add their CAN channel to `channels`.

        None for a channel of other messages.
        """
        schema = self._definitions.schemas.get(channel.schema_id)
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

    def _frames(self, contents: Contents) -> NDArray[Any]:
        """Return the frames of a chunk in the order of the file, (0,) without any.

        Raises ValueError for a frame that is shorter than its type.
        """
        places, found = [], []
        for number in np.unique(contents.channels).tolist():
            source = self._sources.get(number)
            if source is None:
                continue
            messages = np.flatnonzero(contents.channels == number)
            starts = contents.starts[messages]
            sizes = contents.ends[messages] - starts
            if (sizes < _HEAD_BYTES).any():
                raise ValueError("a frame is shorter than its type")
            name_bytes = contents.rows(starts + _HEAD_BYTES - 4, 4).view("<u4")[:, 0]
            shapes, which = np.unique(np.stack((sizes, name_bytes), axis=1), axis=0, return_inverse=True)
            for shape, (size, length) in enumerate(shapes.tolist()):
                chosen = which == shape
                places.append(messages[chosen])
                found.append(_unpack(source, contents.rows(starts[chosen], size), length, self.epoch_ns))
        if not found:
            return _NO_FRAMES
        frames: NDArray[Any] = np.concatenate(found)[np.argsort(np.concatenate(places))]
        return frames


def _unpack(source: _Source, rows: NDArray[np.uint8], name_bytes: int, epoch_ns: int) -> NDArray[Any]:
    """Return the frames (n,) in the message records `rows` (n, size), whose frame_id has `name_bytes` bytes.

    epoch_ns: subtracted from their times. Raises ValueError where they are shorter than their type.
    """
    body_start = _HEAD_BYTES + name_bytes
    body_start += -(body_start - MESSAGE_HEAD - len(ENCAPSULATION)) % 4
    layout = _RECORDS[source.is_fd]
    places: Any = layout.fields
    name_start, own_start = _HEAD_BYTES - 4, _HEAD_BYTES - 4 + _FRAME_ID_BYTES
    bodies = rows[:, body_start:][:, : layout.itemsize - own_start]
    if own_start + bodies.shape[1] < (places["data"][1] if source.is_fd else layout.itemsize):
        raise ValueError("a frame is shorter than its type")
    own = np.zeros((len(rows), layout.itemsize), np.uint8)
    own[:, :name_start] = rows[:, :name_start]
    own[:, own_start : own_start + bodies.shape[1]] = bodies
    records = own.view(layout)[:, 0]
    frames = np.zeros(len(rows), RECORDED_FRAME_DTYPE)
    fill_times(frames, records, epoch_ns)
    frames["is_tx"] = source.is_tx
    frames["channel"] = source.channel
    frames["can_id"] = records["can_id"]
    for name in ("is_error", "is_extended") if source.is_fd else ("is_error", "is_extended", "is_remote"):
        frames[name] = records[name].view(np.uint8) != 0
    if source.is_fd:
        frames["is_fd"] = True
        frames["has_rate_switch"] = source.has_rate_switch
        frames["has_error_state"] = source.has_error_state
    data_bytes = records["data"]
    most = data_bytes.shape[1]
    frames["length"] = np.minimum(records["length"], most)
    counts = np.where(frames["is_remote"], 0, frames["length"])
    frames["data"][:, :most] = np.where(np.arange(most) < counts[:, np.newaxis], data_bytes, 0)
    return frames


class RecordedFrame(NamedTuple):
    """A frame as recordings have it; its fields mean the same as those of RECORDED_FRAME_DTYPE."""

    t_ns: int  # since the file's epoch
    can_id: int
    data: bytes
    length: int
    channel: str = ""
    is_tx: bool = False
    is_error: bool = False
    is_extended: bool = False
    is_remote: bool = False
    is_fd: bool = False
    has_rate_switch: bool = False
    has_error_state: bool = False
