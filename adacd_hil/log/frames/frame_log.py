"""Frames of a recording: MCAP by our reader, candump `.log`, BLF, ASC, MF4, TRC and CSV by python-can's.

Times are integer nanoseconds as exactly as the format has them: MCAP, BLF and MF4 to the ns, text to its digits, as far
as python-can's float holds them (238 ns at today's dates). MCAP is counted from the epoch of the run; BLF, candump,
TRC, CSV and MF4 from 1970; ASC from its beginning.

A line of a candump log, `candump -L`, is `(1436509052.249713) vcan0 044#2A366C2BBA`. An identifier of 8 digits is a
29-bit one; with bit 0x20000000 it is an error frame and the rest its class. ` T` and ` R` at the end say sent and
received, as python-can and `candump -x` write them; without them all frames count as received. Source: can-utils,
lib.h.
"""

import importlib.util
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from adacd_hil.extras import install_command
from adacd_hil.log.frames.mcap_frames import McapFrames
from adacd_hil.log.log_files import SUFFIX, LogError
from adacd_hil.log.types.record_arrays import RECORDED_FRAME_DTYPE, FrameLog
from adacd_hil.remedies import nearest_name

if TYPE_CHECKING:
    from adacd_hil.log.frames.can_io import PythonCanFrames

SUFFIXES = (SUFFIX, ".log", ".blf", ".asc", ".mf4", ".trc", ".csv")


def open_frames(path: Path) -> "McapFrames | PythonCanFrames":
    """Open a recording of CAN frames, whose format is that of its suffix. Iterate once, for arrays of frames.

    `channels`, `epoch_ns` and `problem` are complete after the iteration. Raises LogError for an unknown suffix, a
    missing package, or a file that can't be read, the last also from the iteration.
    """
    suffix = path.suffix.lower()
    if suffix == SUFFIX:
        return McapFrames(path)
    if suffix not in SUFFIXES:
        near = nearest_name(suffix, SUFFIXES)
        hint = ", unpack it with gunzip" if suffix == ".gz" else f", did you mean {near}" if near else ""
        raise LogError(
            f"{path}: no frames are read from {suffix or 'a file without suffix'}{hint}; known: {' '.join(SUFFIXES)}"
        )
    if suffix == ".mf4" and importlib.util.find_spec("asammdf") is None:
        raise LogError(f"{path}: MF4 is read with asammdf: {install_command('mf4')}")
    # python-can costs 0.1 s, and with asammdf beside it 0.3 s.
    from adacd_hil.log.frames.can_io import PythonCanFrames

    return PythonCanFrames(path)


def read_frames(path: Path) -> FrameLog:
    """Return all frames of a recording, the names of its channels, its epoch, and its problem, "" without one.

    Raises LogError for an unknown suffix, a missing package, or a file that can't be read.
    """
    source = open_frames(path)
    pieces = [np.zeros(0, RECORDED_FRAME_DTYPE), *source]
    return FrameLog(tuple(source.channels), np.concatenate(pieces), source.epoch_ns, source.problem)


def of_one_channel(pieces: Iterable[NDArray[Any]], channels: Sequence[str], path: Path) -> Iterator[NDArray[Any]]:
    """Yield the arrays of frames, chosen from a recording, as long as all are of one of its CAN channels.

    channels: names, complete up to the frames yielded. Raises LogError, before it yields them, for frames of a second.
    """
    met: set[int] = set()
    for frames in pieces:
        met.update(np.unique(frames["channel"]).tolist())
        if len(met) > 1:
            names = " and ".join(channels[number] or "one without a name" for number in sorted(met))
            raise LogError(f"{path} has frames of more than one CAN channel, {names}: give a recording of one bus")
        yield frames
