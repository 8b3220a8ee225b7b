"""Frames of a recording, whatever format it has: MCAP, candump `.log`, BLF, ASC, MF4, TRC or CSV.

Times are integer nanoseconds as exactly as the format has them: MCAP, BLF and MF4 to the ns, candump and ASC to the
digits that they write, TRC and CSV to python-can's float (238 ns at today's dates). MCAP is counted from the epoch of
the run; BLF, candump, TRC, CSV and MF4 from 1970; ASC from its beginning.
"""

import importlib.util
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from adacd_hil.extras import install_command
from adacd_hil.input_files import open_input
from adacd_hil.log.errors import LogError
from adacd_hil.log.formats import candump
from adacd_hil.log.formats.mcap_frames import McapFrames
from adacd_hil.log.formats.recorded_frames import MOST_CHANNELS, RECORDED_FRAME_DTYPE, FrameLog
from adacd_hil.nearest_name import nearest_name

PYTHON_CAN_SUFFIXES = (".blf", ".asc", ".mf4", ".trc", ".csv")
SUFFIXES = (".mcap", ".log", *PYTHON_CAN_SUFFIXES)
_PIECE = 10_000
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
    from adacd_hil.log.formats.can_messages import PythonCanFrames

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
        try:
            open_input(path).close()
        except OSError as error:
            raise LogError(f"{path} can't be read: {error.strerror}") from None

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
                    name, row = candump.parse(line)
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
                if len(rows) == _PIECE:
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
