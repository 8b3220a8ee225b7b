"""The plugin of python-can for `.mcap`: `can_logger`, `can_player` and `can_logconvert` read and write our logs.

python-can finds the two classes by the entry points `can.io.message_reader` and `can.io.message_writer`. The reader's
messages carry their time in whole nanoseconds, which the writer uses; other messages have python-can's float: float64
seconds, which stand 238 ns apart at today's dates. BLF and MF4 count from the start of the recording, so we read their
nanoseconds without the start, and add the start as an integer.

A channel of digits is a number to python-can and a name here: "0" is its 0, "" its None.
"""

import io
import os
import zlib
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import IO, Any, cast

import can
import numpy as np
from can.io.blf import (
    LOG_CONTAINER,
    LOG_CONTAINER_STRUCT,
    NO_COMPRESSION,
    OBJ_HEADER_BASE_STRUCT,
    ZLIB_DEFLATE,
    BLFParseError,
    BLFReader,
)
from can.io.generic import BinaryIOMessageReader, BinaryIOMessageWriter, TextIOMessageReader
from can.io.player import MESSAGE_READERS
from numpy.typing import NDArray

from adacd_hil.file_access import open_input
from adacd_hil.log.formats.mcap_frames import FrameWriter, McapFrames, RecordedFrame
from adacd_hil.log.log_files import LogError, failing_as
from adacd_hil.log.mcap.chunks import MOST_BYTES, Opening
from adacd_hil.log.types.message_types import MAX_DATA
from adacd_hil.log.types.record_arrays import MOST_CHANNELS, MOST_NS, PIECE_FRAMES, RECORDED_FRAME_DTYPE


class McapReader(BinaryIOMessageReader):
    """The messages of an MCAP file, in its order; of a log of ours all parts.

    `problem` names afterwards the missing data, "" for a whole file.
    """

    def __init__(self, file: Any, **_: Any) -> None:
        """Open a path or take an open binary file. Raises LogError when it can't be read or isn't MCAP."""
        super().__init__(file, mode="rb")
        try:
            is_path = isinstance(file, str | os.PathLike)
            self._frames = McapFrames(Path(file) if is_path else cast("IO[bytes]", self.file))
        except Exception:
            self.file.close()
            raise

    @property
    def problem(self) -> str:
        """What is missing."""
        return self._frames.problem

    def __iter__(self) -> Generator[can.Message, None, None]:
        for frames in self._frames:
            yield from to_messages(frames, self._frames.channels, self._frames.epoch_ns)
        self.stop()


class McapWriter(BinaryIOMessageWriter):
    """Writes messages to an MCAP file with the topics and types of our logs."""

    def __init__(self, file: Any, append: bool = False, **_: Any) -> None:
        """Create a file, or take an open binary one. Raises ValueError for `append`, FileExistsError for a log."""
        if append:
            raise ValueError("nothing can be appended to an MCAP file; log to another one")
        if isinstance(file, str | os.PathLike) and Path(file).is_file() and Path(file).stat().st_size:
            raise FileExistsError(f"{os.fspath(file)} is there already; log to another file")
        super().__init__(file, mode="wb")
        self._writer = FrameWriter(cast("IO[bytes]", self.file))
        self._is_stopped = False

    def on_message_received(self, msg: can.Message) -> None:
        """Write a message."""
        is_short = not (msg.is_remote_frame or msg.is_error_frame)
        data = bytes(msg.data)
        self._writer.write(
            RecordedFrame(
                t_ns=time_ns(msg),
                can_id=msg.arbitration_id,
                data=data,
                length=len(data) if is_short else msg.dlc,
                channel=channel_name(msg.channel),
                is_tx=not msg.is_rx,
                is_error=msg.is_error_frame,
                is_extended=msg.is_extended_id,
                is_remote=msg.is_remote_frame,
                is_fd=msg.is_fd,
                has_rate_switch=msg.is_fd and msg.bitrate_switch,
                has_error_state=msg.is_fd and msg.error_state_indicator,
            )
        )

    def stop(self) -> None:
        """End the file; twice is once."""
        if not self._is_stopped:
            self._is_stopped = True
            self._writer.finish()
            super().stop()


_MOST_DIGITS = 9
"""Of a channel that is a number."""


class TimedMessage(can.Message):
    """A message with its time in whole nanoseconds, besides python-can's `timestamp`."""

    def __init__(self, t_ns: int, **fields: Any) -> None:
        super().__init__(timestamp=t_ns / 1_000_000_000, **fields)
        self.t_ns = t_ns


def time_ns(message: can.Message) -> int:
    """Return the time of a message: in whole nanoseconds if it knows it and nobody has changed `timestamp` since."""
    seconds = message.timestamp or 0.0
    t_ns = getattr(message, "t_ns", None)
    if t_ns is not None and t_ns / 1_000_000_000 == seconds:
        return int(t_ns)
    whole, rest = divmod(seconds, 1.0)
    return int(whole) * 1_000_000_000 + round(rest * 1e9)


def channel_name(channel: object) -> str:
    """Name a channel of python-can."""
    return "" if channel is None else str(channel)


def to_row(message: can.Message, channel: int = 0, start_ns: int = 0) -> tuple[Any, ...]:
    """Make a row of RECORDED_FRAME_DTYPE; `start_ns` is added to its time.

    Raises LogError for data or an identifier that no frame has.
    """
    data = bytes(message.data)
    length = len(data) if not (message.is_remote_frame or message.is_error_frame) else message.dlc
    if max(len(data), length) > (MAX_DATA if message.is_fd else 8):
        raise LogError(f"frame 0x{message.arbitration_id:X} has {max(len(data), length)} bytes of data")
    if not 0 <= message.arbitration_id < 1 << 29:
        raise LogError(f"identifier 0x{message.arbitration_id:X} has more than 29 bits")
    t_ns = time_ns(message) + start_ns
    if abs(t_ns) > MOST_NS:
        raise LogError(f"time {t_ns * 1e-9:g} s is beyond the year 2116")
    return (
        t_ns,
        t_ns,
        message.arbitration_id,
        not message.is_rx,
        message.is_error_frame,
        length,
        list(data.ljust(MAX_DATA, b"\0")),
        channel,
        message.is_extended_id,
        message.is_remote_frame,
        message.is_fd,
        message.is_fd and message.bitrate_switch,
        message.is_fd and message.error_state_indicator,
    )


def to_messages(frames: NDArray[Any], channels: list[str], epoch_ns: int = 0) -> Iterator[TimedMessage]:
    """Make a message of each row; `epoch_ns` is added to its time."""
    names = [int(name) if name.isdecimal() and len(name) < _MOST_DIGITS else name or None for name in channels]
    for row in frames:
        (t_ns, _, can_id, is_tx, is_error, length, _, channel, is_extended, is_remote, is_fd, has_switch, has_error) = (
            row.item()
        )
        yield TimedMessage(
            t_ns + epoch_ns,
            arbitration_id=can_id,
            is_extended_id=is_extended,
            is_remote_frame=is_remote,
            is_error_frame=is_error,
            channel=names[channel],
            dlc=length,
            data=b"" if is_remote else row["data"][:length].tobytes(),
            is_fd=is_fd,
            is_rx=not is_tx,
            bitrate_switch=has_switch,
            error_state_indicator=has_error,
        )


class _BlfReader(BLFReader):
    """python-can's, but for sizes that lie: it would stay for ever at an object of size 0, and open any bomb."""

    def __iter__(self) -> Generator[can.Message, None, None]:
        opening = Opening()
        while head := self.file.read(OBJ_HEADER_BASE_STRUCT.size):
            signature, _, _, size, kind = OBJ_HEADER_BASE_STRUCT.unpack(head)
            if signature != b"LOBJ" or not len(head) <= size <= MOST_BYTES:
                raise BLFParseError(f"an object of {size} bytes")
            body = self.file.read(size - len(head))
            self.file.read(size % 4)  # padding
            if kind == LOG_CONTAINER:
                yield from self._parse_container(_open_container(body, opening))

    def _parse_container(self, data: bytes) -> Iterator[can.Message]:
        _check_objects(self._tail + data)
        yield from super()._parse_container(data)


def _open_container(body: bytes, opening: Opening) -> bytes:
    """Decompress the objects of a container. Raises BLFParseError, ChunkError, zlib.error, struct.error."""
    method, _ = LOG_CONTAINER_STRUCT.unpack_from(body)
    packed = body[LOG_CONTAINER_STRUCT.size :]
    if method not in (NO_COMPRESSION, ZLIB_DEFLATE):
        raise BLFParseError(f"unknown compression {method}")
    data = packed if method == NO_COMPRESSION else zlib.decompressobj().decompress(packed, MOST_BYTES + 1)
    opening.allow(len(body), len(data))
    return data


def _check_objects(data: bytes) -> None:
    """Raise BLFParseError for an object that can't be: shorter than its head, endless, of an unknown version."""
    position = data.find(b"LOBJ", 0, 8)
    while 0 <= position <= len(data) - OBJ_HEADER_BASE_STRUCT.size:
        _, _, version, size, _ = OBJ_HEADER_BASE_STRUCT.unpack_from(data, position)
        if version not in (1, 2) or not OBJ_HEADER_BASE_STRUCT.size <= size <= MOST_BYTES:
            raise BLFParseError(f"an object of {size} bytes and version {version}")
        position = data.find(b"LOBJ", position + size, position + size + 8)


class PythonCanFrames:
    """The frames of a file that python-can reads: iterate once; `channels` and `problem` grow meanwhile."""

    def __init__(self, path: Path) -> None:
        """Open the file. Raises LogError when it can't be read or isn't of its format."""
        self.channels: list[str] = []
        self.epoch_ns = 0
        self.problem = ""
        self._path = path
        kind: Any = _BlfReader if path.suffix.lower() == ".blf" else MESSAGE_READERS[path.suffix.lower()]
        with failing_as(f"{path} can't be read"):
            binary = open_input(path)
            # Vendors' tools write their texts in the Windows of the country; frames are ASCII.
            file: Any = (
                io.TextIOWrapper(binary, encoding="latin-1") if issubclass(kind, TextIOMessageReader) else binary
            )
        try:
            self._reader = kind(file)
            self._start_ns = _take_start(self._reader)
        except Exception as error:  # each reader has failures of its own
            file.close()
            raise LogError(f"{path} can't be read as {path.suffix}: {_line(error)}") from None

    def __iter__(self) -> Iterator[NDArray[Any]]:
        """Give the frames, (n,) of RECORDED_FRAME_DTYPE; what can't be read ends them and is the problem."""
        rows: list[tuple[Any, ...]] = []
        count = 0
        with self._reader:
            try:
                for message in self._reader:
                    rows.append(to_row(message, self._channel(message), self._start_ns))
                    count += 1
                    if len(rows) == PIECE_FRAMES:
                        yield np.array(rows, RECORDED_FRAME_DTYPE)
                        rows = []
            except Exception as error:  # each reader has failures of its own
                if not count:
                    raise LogError(f"{self._path} can't be read as {self._path.suffix}: {_line(error)}") from None
                self.problem = f"{self._path.name} is damaged after {count} frames: {_line(error)}"
        if rows:
            yield np.array(rows, RECORDED_FRAME_DTYPE)

    def _channel(self, message: can.Message) -> int:
        name = channel_name(message.channel)
        if name not in self.channels:
            if len(self.channels) == MOST_CHANNELS:
                raise LogError(f"there are more than {MOST_CHANNELS} channels")
            self.channels.append(name)
        return self.channels.index(name)


def _take_start(reader: Any) -> int:
    """Take the start out of a reader that would add it to each time as a float; return it in ns."""
    for name in ("start_timestamp", "_start_timestamp"):
        if isinstance(start_s := getattr(reader, name, None), float):
            setattr(reader, name, 0.0)
            return round(start_s * 1e3) * 1_000_000
    return 0


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
