"""Messages of python-can as frames of ours, and its readers of other formats.

Our own readers of `.mcap` (`adacd_hil.lab.logs.python_can_files`) give messages their time in whole nanoseconds; other
messages have python-can's float: float64 seconds, which stand 238 ns apart at today's dates. BLF and MF4 count from the
start of the recording, so we read their nanoseconds without the start, and add the start as an integer.
"""

import io
import logging
import re
from collections.abc import Generator, Iterable, Iterator
from decimal import Decimal
from pathlib import Path
from typing import Any, cast

import can
import numpy as np
from can.io import blf
from can.io.asc import ASC_MESSAGE_REGEX
from can.io.generic import TextIOMessageReader
from can.io.player import MESSAGE_READERS
from numpy.typing import NDArray

from adacd_hil.file_access import open_input
from adacd_hil.log.frames.mcap_frames import RecordedFrame
from adacd_hil.log.log_files import LogError, failing_as
from adacd_hil.log.mcap.chunks import MOST_BYTES
from adacd_hil.log.types.message_types import MAX_DATA
from adacd_hil.log.types.record_arrays import MOST_CHANNELS, MOST_NS, PIECE_FRAMES, RECORDED_FRAME_DTYPE
from adacd_hil.wire.frame_lengths import CLASSIC_BYTES


def time_ns(message: can.Message) -> int:
    """Return the time of a message, ns: its exact `t_ns` if that is equal to `timestamp`, else `timestamp`.

    0 without one.
    """
    seconds = message.timestamp or 0.0
    t_ns = getattr(message, "t_ns", None)
    if t_ns is not None and t_ns / 1_000_000_000 == seconds:
        return int(t_ns)
    return round(Decimal(repr(seconds)) * 1_000_000_000)  # the digits that a text had


def to_frame(message: can.Message, start_ns: int = 0) -> RecordedFrame:
    """Convert a python-can message to a frame, and add `start_ns` to its time.

    Of remote and error frames, length and data are cut to the most that their kind of frame has. Raises ValueError for
    more data in other frames, or less than their DLC says, an identifier of more than 29 bits, or a time beyond
    `MOST_NS` or NaN.
    """
    most = MAX_DATA if message.is_fd else CLASSIC_BYTES
    data = bytes(message.data)
    length = len(data)
    if message.is_remote_frame or message.is_error_frame:  # their DLC goes up to 15
        data, length = data[:most], min(message.dlc, most)
    if not min(message.dlc, most) <= length <= most:
        raise ValueError(f"frame 0x{message.arbitration_id:X} has {length} bytes of data, its DLC is {message.dlc}")
    if not 0 <= message.arbitration_id < 1 << 29:
        raise ValueError(f"identifier 0x{message.arbitration_id:X} has more than 29 bits")
    if not abs(message.timestamp or 0.0) + start_ns * 1e-9 < MOST_NS * 1e-9:  # nor is NaN
        raise ValueError(f"time {message.timestamp:g} s is beyond the year 2116")
    return RecordedFrame(
        t_ns=time_ns(message) + start_ns,
        can_id=message.arbitration_id,
        data=data,
        length=length,
        channel="" if message.channel is None else str(message.channel),
        is_tx=not message.is_rx,
        is_error=message.is_error_frame,
        is_extended=message.is_extended_id,
        is_remote=message.is_remote_frame,
        is_fd=message.is_fd,
        has_rate_switch=message.is_fd and message.bitrate_switch,
        has_error_state=message.is_fd and message.error_state_indicator,
    )


class _BlfReader(can.BLFReader):
    """python-can's BLF reader, which fails at an object of no size, where the original hangs.

    It fails at a container of more than MOST_BYTES, too, and warns of frames that python-can skips.
    """

    def _parse_container(self, data: bytes) -> Iterator[can.Message]:
        if len(data) > MOST_BYTES:
            raise blf.BLFParseError(f"a container opens to {len(data)} bytes, more than {MOST_BYTES}")
        objects, position, head = self._tail + data, 0, blf.OBJ_HEADER_BASE_STRUCT
        while 0 <= (position := objects.find(b"LOBJ", position, position + 8)) <= len(objects) - head.size:
            _, _, version, size, kind = head.unpack_from(objects, position)
            if size < head.size:
                raise blf.BLFParseError(f"an object of {size} bytes")
            position += size
            if position <= len(objects) and kind in _BLF_FRAMES and version not in (1, 2):
                _LOGGER.warning("a frame of header version %d is not read", version)
        yield from super()._parse_container(data)


_BLF_FRAMES = (blf.CAN_MESSAGE, blf.CAN_MESSAGE2, blf.CAN_ERROR_EXT, blf.CAN_FD_MESSAGE, blf.CAN_FD_MESSAGE_64)


class _AscReader(can.ASCReader):
    """python-can's ASC reader, without its silent errors.

    python-can's loses a first frame that follows a head without `internal events logged`, as BUSMASTER writes it, takes
    stamps that count from the line before for stamps from the beginning, requests to send (TxRq) for frames, and passes
    over frames with a negative stamp or a decimal comma.
    """

    def _extract_header(self) -> None:
        base = re.search(r"^\W*base\s+(hex|dec)(\s+timestamps\s+relative)?", self.file.read(_ASC_HEAD), _ASC_FLAGS)
        if base:
            self._converted_base = self._check_base(base[1].lower())
        self.file.seek(0)
        self.file = cast("Any", _asc_lines(self.file, is_relative=base is not None and base[2] is not None))


_ASC_HEAD, _ASC_FLAGS = 4096, re.IGNORECASE | re.MULTILINE
_ASC_FRAME = re.compile(r"-?\d+[.,]\d+\s+(CANFD\s+)?\d+\s+\S+\s+(Rx|Tx|TxRq)\s", re.IGNORECASE)


def _asc_lines(lines: Iterable[str], is_relative: bool) -> Iterator[str]:
    """Yield the lines of an ASC with times since its beginning, without requests to send (TxRq).

    is_relative: the file gives each time since the line before. Log a warning for each frame that python-can will skip.
    """
    time_s = Decimal(0)
    for number, text in enumerate(lines, 1):
        line = text.strip()
        if is_relative and (stamp := re.match(r"(\d+\.\d+)\s", line)):
            time_s += Decimal(stamp[1])
            line = f"{time_s} {line[stamp.end() :]}"
        if frame := _ASC_FRAME.match(line):
            if frame[2].lower() == "txrq":
                continue
            if not ASC_MESSAGE_REGEX.match(line):
                _LOGGER.warning("line %d is not read: %s", number, line)
        yield line


_ERROR_FLAG = 0x20000000
"""Of a candump log's identifiers: CAN_ERR_FLAG of the kernel."""


class _CandumpReader(can.CanutilsLogReader):
    """python-can's candump reader, which warns of lines without a frame, and keeps the class of error frames.

    Of an error frame python-can makes data of a 29-bit identifier, or drops all but the time.
    """

    _number = 0
    _line = ""
    _is_error = False

    def __iter__(self) -> Generator[can.Message, None, None]:
        file = self.file
        while True:
            self.file = cast("Any", self._lines(file))
            try:
                for message in super().__iter__():
                    if message.dlc < len(message.data):
                        raise ValueError("an odd number of digits")
                    if self._is_error:
                        message.is_error_frame, message.is_extended_id = True, False
                    yield message
            except (ValueError, IndexError):
                _LOGGER.warning("line %d is no frame: %s", self._number, self._line.strip()[:60])
            else:
                return

    def _lines(self, file: Iterable[str]) -> Iterator[str]:
        """Yield the lines in python-can's form; store each line, its number, and whether it has an error frame.

        An error frame's flag is removed from its identifier.
        """
        for self._line in file:
            self._number += 1
            error = re.search(r" ([23][0-9A-Fa-f]{7})#", self._line)
            self._is_error = error is not None
            line = self._line.replace(error[0], f" {int(error[1], 16) & ~_ERROR_FLAG:08X}#") if error else self._line
            yield re.sub(r"(#[0-9A-Fa-f]{16})_[0-9A-Fa-f]", r"\1", line)  # a raw DLC, which means 8


class _PassedOver(logging.Handler):
    """Counts the records of a file that are not read, and keeps the first one's reason.

    From python-can's warnings, too.
    """

    first = ""
    count = 0

    def emit(self, record: logging.LogRecord) -> None:
        words = record.getMessage()
        is_lost = record.levelno > logging.INFO or words.endswith(_TRC_ERRORS)
        if is_lost and not words.startswith(_HARMLESS) and not words.endswith(" ''"):  # an empty line
            self.pass_over(words)

    def pass_over(self, words: str) -> None:
        """Count a record that was not read; keep the reason of the first one."""
        self.count += 1
        self.first = self.first or " ".join(words.split())[:_LONGEST]


_LOGGER = logging.getLogger("can.io")
_LOGGER.addHandler(logging.NullHandler())  # python-can's words go through `_PassedOver`, not to the terminal
_LOGGER.setLevel(logging.INFO)
_TRC_ERRORS = ("type 'ER'", "type 'Error'")
_HARMLESS = ("Unknown object header version", "DLC vs Data Length mismatch")
"""Beginnings of warnings: on objects other than frames, or that `_BlfReader` counts; on frames that are read."""
_READERS: dict[str, Any] = {".blf": _BlfReader, ".asc": _AscReader, ".log": _CandumpReader}
_FLAGS = slice(RecordedFrame._fields.index("is_extended"), None)
"""Flags at the end of a RecordedFrame, and of a row of RECORDED_FRAME_DTYPE."""
_STATUS_ID = 0xFFFFFFFF
"""Of the lines of a TRC that tell the state of the bus."""
_FORMS = {
    ".log": "a candump log, as `candump -l` records it and SavvyCAN saves it",
    ".csv": "a CSV as python-can writes it; SavvyCAN saves a candump log, too",
    ".trc": "a TRC as PEAK's programs write it",
    ".asc": "an ASC as Vector's programs write it",
}


class PythonCanFrames:
    """The frames of a file that python-can reads: iterate once; `channels` and `problem` are complete after it.

    problem: records that were not read, or that there is no frame; "" without one. epoch_ns: 0.
    """

    def __init__(self, path: Path) -> None:
        """Check that the file can be opened; read nothing. Raises LogError if it can't."""
        self.channels: list[str] = []
        self.epoch_ns = 0
        self.problem = ""
        self._path = path
        with failing_as(f"{path} can't be read"):
            open_input(path).close()

    def __iter__(self) -> Iterator[NDArray[Any]]:
        """Yield the frames in arrays (n,) of RECORDED_FRAME_DTYPE; drop other records, and set `problem` at the end.

        Raises LogError for a file without a readable frame, if a record of it was not read or python-can failed.
        """
        passed_over = _PassedOver()
        rows: list[tuple[Any, ...]] = []
        count = 0
        for message, start_ns in self._messages(passed_over):
            try:
                frame = to_frame(message, start_ns)
                data = list(frame.data.ljust(MAX_DATA, b"\0"))
                head = (frame.t_ns, frame.t_ns, frame.can_id, frame.is_tx, frame.is_error, frame.length, data)
                rows.append((*head, self._channel(frame.channel), *tuple(frame)[_FLAGS]))
            except ValueError as error:
                passed_over.pass_over(str(error))
                continue
            count += 1
            if len(rows) == PIECE_FRAMES:
                yield np.array(rows, RECORDED_FRAME_DTYPE)
                rows = []
        if passed_over.count and not count:
            form = _FORMS.get(self._path.suffix.lower(), f"a whole {self._path.suffix}")
            raise LogError(f"{self._path} is not {form}: {passed_over.first}")
        if passed_over.count:
            more = f", and {passed_over.count - 1} more records" if passed_over.count > 1 else ""
            self.problem = f"{self._path.name}: {passed_over.first}{more}"
        elif not count:
            self.problem = f"{self._path.name}: there is no frame in it"
        if rows:
            yield np.array(rows, RECORDED_FRAME_DTYPE)

    def _messages(self, passed_over: _PassedOver) -> Iterator[tuple[can.Message, int]]:
        """Yield the messages up to the first error of python-can, each with a start time to add, ns.

        The error counts as a record that was not read, in `passed_over`; so does a BLF that is cut within an object.
        Lines of a TRC on the state of the bus are skipped.
        """
        suffix = self._path.suffix.lower()
        kind = _READERS.get(suffix) or MESSAGE_READERS[suffix]
        count = 0
        _LOGGER.addHandler(passed_over)
        try:
            file: Any = open_input(self._path)
            if issubclass(
                kind, TextIOMessageReader
            ):  # vendors' tools write in the code of the country; frames are ASCII
                file = io.TextIOWrapper(file, encoding="latin-1")
            with file:
                reader = kind(file)
                start_ns = _take_start(reader)
                for message in reader:
                    if message.arbitration_id != _STATUS_ID:
                        count += 1
                        yield message, start_ns
                if getattr(reader, "_tail", b"").strip(b"\0"):
                    passed_over.pass_over(f"cut within an object, behind {count} frames")
        except Exception as error:  # each reader has failures of its own
            reason = str(error) or type(error).__name__
            passed_over.pass_over(f"behind {count} frames nothing can be read: {reason}" if count else reason)
        finally:
            _LOGGER.removeHandler(passed_over)

    def _channel(self, name: str) -> int:
        """Return the index of a CAN channel in `channels`; add a new one. Raises ValueError beyond MOST_CHANNELS."""
        if name not in self.channels:
            if len(self.channels) == MOST_CHANNELS:
                raise ValueError(f"there are more than {MOST_CHANNELS} channels")
            self.channels.append(name)
        return self.channels.index(name)


def _take_start(reader: Any) -> int:
    """Set a reader's start time to 0, since it would add it to each time as a float; return the start time, ns.

    0 for a reader without one. It is rounded to ms.
    """
    for name in ("start_timestamp", "_start_timestamp"):
        if isinstance(start_s := getattr(reader, name, None), float):
            setattr(reader, name, 0.0)
            return round(start_s * 1e3) * 1_000_000
    return 0


_LONGEST = 120
"""Letters of a reason, which may hold a line of the file."""
