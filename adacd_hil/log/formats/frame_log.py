"""Frames of a recording, whatever format it has: MCAP, candump `.log`, BLF, ASC, MF4, TRC or CSV.

Times are integer nanoseconds as exactly as the format has them: MCAP, BLF and MF4 to the ns, candump and ASC to the
digits that they write, TRC and CSV to python-can's float (238 ns at today's dates). MCAP is counted from the epoch of
the run; BLF, candump, TRC, CSV and MF4 from 1970; ASC from its beginning.

A line of a candump log, `candump -L`, is `(1436509052.249713) vcan0 044#2A366C2BBA`:

| after the identifier | is |
|---|---|
| #11223344 | data |
| #R, #R3 | remote frame, with its DLC |
| ##1 and data | CAN FD; flags BRS 1, ESI 2 |
| _9 behind the data | a raw DLC beyond 8, which has no meaning for us |

An identifier of 8 digits is a 29-bit one; with bit 0x20000000 it is an error frame and the rest its class. ` T` and
` R` at the end say sent and received, as python-can and `candump -x` write them; they are read, and written if asked
for, because Wireshark takes no file that has them. Source: can-utils, lib.h.
"""

import importlib.util
import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from adacd_hil.file_access import open_input
from adacd_hil.log.formats.mcap_frames import McapFrames
from adacd_hil.log.log_files import LogError, failing_as
from adacd_hil.log.types.record_arrays import MOST_CHANNELS, MOST_NS, PIECE_FRAMES, RECORDED_FRAME_DTYPE, FrameLog
from adacd_hil.remedies import install_command, nearest_name

PYTHON_CAN_SUFFIXES = (".blf", ".asc", ".mf4", ".trc", ".csv")
SUFFIXES = (".mcap", ".log", *PYTHON_CAN_SUFFIXES)
_LONGEST_LINE = 1 << 16


class FrameSource(Protocol):
    """The frames of a recording in pieces: iterate once; all else is complete afterwards."""

    channels: list[str]
    epoch_ns: int
    problem: str

    def __iter__(self) -> Iterator[NDArray[Any]]:
        """Give the frames, (n,) of RECORDED_FRAME_DTYPE, in the order of the recording."""


def open_frames(path: Path) -> FrameSource:
    """Open a recording; its suffix says what it is.

    Raises LogError when it can't be read, also from the iteration.
    """
    suffix = path.suffix.lower()
    if suffix == ".mcap":
        return McapFrames(path)
    if suffix == ".log":
        return CandumpFrames(path)
    if suffix not in PYTHON_CAN_SUFFIXES:
        near = nearest_name(suffix, SUFFIXES)
        raise LogError(
            f"{path}: no frames are read from {suffix or 'a file without suffix'}"
            f"{f', did you mean {near}' if near else ''}; known: {' '.join(SUFFIXES)}"
        )
    # python-can costs 0.1 s, and with asammdf beside it 0.3 s.
    from adacd_hil.log.formats.can_io import PythonCanFrames

    if suffix == ".mf4":
        _need_asammdf(path)
    return PythonCanFrames(path)


def read_frames(path: Path) -> FrameLog:
    """Read all frames of a recording. Raises LogError when it can't be read."""
    source = open_frames(path)
    pieces = [np.zeros(0, RECORDED_FRAME_DTYPE), *source]
    return FrameLog(tuple(source.channels), np.concatenate(pieces), source.epoch_ns, source.problem)


class CandumpFrames:
    """The frames of a candump log. Lines that aren't frames are counted in `problem`."""

    def __init__(self, path: Path) -> None:
        """Look at the file. Raises LogError when it can't be read."""
        self.channels: list[str] = []
        self.epoch_ns = 0
        self.problem = ""
        self._path = path
        with failing_as(f"{path} can't be read"):
            open_input(path).close()

    def __iter__(self) -> Iterator[NDArray[Any]]:
        """Give the frames, (n,) of RECORDED_FRAME_DTYPE."""
        rows: list[tuple[Any, ...]] = []
        places: dict[str, int] = {}
        first_wrong, wrong, right = "", 0, 0
        with io.TextIOWrapper(open_input(self._path), encoding="ascii", errors="replace") as file:
            for number, line in enumerate(iter(lambda: file.readline(_LONGEST_LINE), ""), 1):
                if not line.strip():
                    continue
                try:
                    name, row = parse_line(line)
                    if name not in places and len(places) == MOST_CHANNELS:
                        raise ValueError(f"there are more than {MOST_CHANNELS} channels")
                except ValueError as error:
                    wrong += 1
                    first_wrong = first_wrong or f"line {number}: {error}"
                    continue
                right += 1
                rows.append(row)
                if name not in places:
                    places[name] = len(places)
                    self.channels.append(name)
                if places[name]:
                    rows[-1] = (*row[:7], places[name], *row[8:])
                if len(rows) == PIECE_FRAMES:
                    yield np.array(rows, RECORDED_FRAME_DTYPE)
                    rows = []
        if wrong and not right:
            raise LogError(f"{self._path} is not a candump log: {first_wrong}")
        if wrong:
            self.problem = f"{self._path.name}: {wrong} lines are no frames, the first is {first_wrong}"
        if rows:
            yield np.array(rows, RECORDED_FRAME_DTYPE)


def _need_asammdf(path: Path) -> None:
    if importlib.util.find_spec("asammdf") is None:
        raise LogError(f"{path}: MF4 is read with asammdf: {install_command('mf4')}")


ERROR_FLAG = 0x20000000
_LINE = re.compile(
    r"\((?P<s>\d{1,20})\.(?P<fraction>\d{1,9})\)\s+(?P<channel>\S{1,255})\s+(?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#"
    r"(?:(?P<remote>[Rr])(?P<dlc>[0-8]?)|#(?P<flags>[0-9A-Fa-f])(?P<fd>(?:[0-9A-Fa-f]{2}\.?)*)"
    r"|(?P<data>(?:[0-9A-Fa-f]{2}\.?)*))(?:_[0-9A-Fa-f])?(?:\s+(?P<way>[RrTt]))?"
)
_RATE_SWITCH = 1
_ERROR_STATE = 2


def parse_line(line: str) -> tuple[str, tuple[Any, ...]]:
    """Read a line: name of the channel, and a row of RECORDED_FRAME_DTYPE with channel 0. Raises ValueError."""
    match = _LINE.fullmatch(line.strip())
    if match is None:
        raise ValueError(f"no frame: {line.strip()[:60]}")
    t_ns = int(match["s"]) * 1_000_000_000 + int(match["fraction"].ljust(9, "0"))
    if t_ns > MOST_NS:
        raise ValueError(f"time {match['s']} s is beyond the year 2116")
    can_id = int(match["id"], 16)
    is_wide = len(match["id"]) == 8
    is_error = is_wide and bool(can_id & ERROR_FLAG)
    is_remote, is_fd = match["remote"] is not None, match["flags"] is not None
    data = bytes.fromhex((match["fd"] or match["data"] or "").replace(".", ""))
    if len(data) > (64 if is_fd else 8):
        raise ValueError(f"{len(data)} bytes of data in {line.strip()[:60]}")
    flags = int(match["flags"] or "0", 16)
    length = int(match["dlc"] or "0") if is_remote else len(data)
    row = (
        t_ns,
        t_ns,
        can_id & 0x1FFFFFFF,
        (match["way"] or "R") in "Tt",
        is_error,
        length,
        list(data.ljust(64, b"\0")),
        0,
        is_wide and not is_error,
        is_remote,
        is_fd,
        bool(flags & _RATE_SWITCH),
        bool(flags & _ERROR_STATE),
    )
    assert len(row) == len(RECORDED_FRAME_DTYPE.names or ())
    return match["channel"], row


def candump_channel(name: str) -> str:
    """Spell a channel for a line; a number is that of an interface, as in python-can."""
    spelled = re.sub(r"\s+", "_", name)
    return f"can{spelled}" if spelled.isdecimal() or not spelled else spelled


def candump_line(row: Any, channel: str, epoch_ns: int = 0, has_direction: bool = False) -> str:
    """Write a row of RECORDED_FRAME_DTYPE, its time cut to the µs that canplayer reads."""
    seconds, rest_ns = divmod(int(row["t_ns"]) + epoch_ns, 1_000_000_000)
    can_id, length = int(row["can_id"]), int(row["length"])
    if row["is_error"]:
        identifier = f"{ERROR_FLAG | can_id:08X}"
    else:
        identifier = f"{can_id:08X}" if row["is_extended"] else f"{can_id:03X}"
    if row["is_remote"]:
        content = f"R{length or ''}"
    else:
        content = row["data"][:length].tobytes().hex().upper()
        if row["is_fd"] and not row["is_error"]:
            flags = _RATE_SWITCH * bool(row["has_rate_switch"]) | _ERROR_STATE * bool(row["has_error_state"])
            content = f"#{flags:X}{content}"
    way = (" T" if row["is_tx"] else " R") if has_direction else ""
    return f"({seconds}.{rest_ns // 1000:06d}) {channel} {identifier}#{content}{way}\n"
