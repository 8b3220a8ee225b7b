"""Frames of a recording, chosen by sender, identifier and time, to BLF, ASC and candump files.

The export counts data that a format can't hold. Times are exact to what the format has: BLF 1 ns, ASC and candump 1 µs.
BLF and ASC begin at a whole millisecond; a time before 1990, as of a run in lockstep, has no date in BLF and counts
from 0.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, Protocol

import can
import numpy as np
from numpy.typing import NDArray

from adacd_hil.file_access import placing
from adacd_hil.log.frames.can_io import to_messages
from adacd_hil.log.frames.frame_log import FrameSource, candump_channel, candump_line
from adacd_hil.log.log_files import failing_as
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.dbc_decoder import DbcDecoder

_MS_NS = 1_000_000
_US_NS = 1_000
_OLDEST_BLF_NS = 631_152_000 * 1_000_000_000
"""Before it BLF has no date: python-can takes it for a clock of its own."""
_DATED_LINES = {"asc": 1}
"""The first line of ASC has the date of writing."""
_HALF_NS_S = 0.25e-9
"""Keeps a product that python-can cuts to whole ns from falling below them."""


class ExportSummary(NamedTuple):
    """The written frames; `losses` name, a line each, the data that the format couldn't hold."""

    frames: int
    losses: tuple[str, ...]


_Loss = tuple[str, NDArray[np.bool_]]
"""What is lost, and of which frames."""


class _FrameTarget(Protocol):
    """A file of one format."""

    def write(self, frames: NDArray[Any], channels: list[str], epoch_ns: int) -> "list[_Loss]":
        """Write frames; say of which of them something is lost."""

    def close(self) -> None:
        """End the file."""


def export_frames(
    source: FrameSource,
    pieces: Iterable[NDArray[Any]],
    path: Path,
    kind: str,
    progress: Callable[[int], None] = lambda _: None,
    has_direction: bool = False,
) -> ExportSummary:
    """Write the chosen pieces of a recording; `progress` is told the frames so far.

    `has_direction`: candump says of each frame whether it was sent; BLF and ASC always do.

    Raises LogError when the recording can't be read or the file not be written, as where another one is that isn't the
    same.
    """
    losses: Counter[str] = Counter()
    count = 0
    with (
        failing_as(f"{path} can't be written"),
        placing(path, _DATED_LINES.get(kind, 0)) as beside,
        closing(_open(kind, beside, has_direction)) as target,
    ):
        for frames in pieces:
            for what, is_lost in target.write(frames, source.channels, source.epoch_ns):
                losses[what] += int(np.count_nonzero(is_lost))
            count += len(frames)
            progress(count)
    return ExportSummary(count, tuple(f"{number} {what}" for what, number in losses.items() if number))


class _Start:
    """Times of a recording counted from the whole millisecond before its first frame."""

    def __init__(self) -> None:
        self.ns: int | None = None

    def is_early(self, times_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Say which times come before the start."""
        return np.asarray(times_ns < (self.ns or 0))

    def seconds(self, times_ns: NDArray[np.int64]) -> list[float]:
        """Return times since the start in s, those before it as 0."""
        if self.ns is None:
            self.ns = start_of(int(times_ns[0]))
        return [float(t_ns) for t_ns in np.maximum(times_ns - self.ns, 0) / 1e9]


def start_of(first_ns: int) -> int:
    """Return where a recording begins whose first frame has this time."""
    return first_ns // _MS_NS * _MS_NS if first_ns >= _OLDEST_BLF_NS else 0


class _Blf:
    def __init__(self, path: Path) -> None:
        self._writer = can.BLFWriter(path)
        self._writer.start_timestamp = 0.0
        self._start = _Start()
        self._last_s = 0.0

    def write(self, frames: NDArray[Any], channels: list[str], epoch_ns: int) -> list[_Loss]:
        seconds = self._start.seconds(frames["t_ns"] + epoch_ns)
        for message, second in zip(to_messages(frames, channels), seconds, strict=True):
            message.timestamp = second + _HALF_NS_S
            self._writer.on_message_received(message)
        self._last_s = seconds[-1]
        return [
            *_losses_of_both(frames, channels, self._start.is_early(frames["t_ns"] + epoch_ns)),
            ("error frames lose that they were sent", frames["is_error"] & frames["is_tx"]),
            _fd_errors(frames),
        ]

    def close(self) -> None:
        start_s = (self._start.ns or 0) / 1_000_000_000
        self._writer.start_timestamp = start_s
        self._writer.stop_timestamp = start_s + self._last_s
        self._writer.stop()


class _Asc:
    def __init__(self, path: Path) -> None:
        self._writer = can.ASCWriter(path)
        self._start = _Start()

    def write(self, frames: NDArray[Any], channels: list[str], epoch_ns: int) -> list[_Loss]:
        seconds = self._start.seconds(frames["t_ns"] + epoch_ns)
        if not self._writer.header_written:
            self._writer.log_event("Start of measurement", (self._start.ns or 0) / 1_000_000_000)
            self._writer.started = 0.0
        for message, second in zip(to_messages(frames, channels), seconds, strict=True):
            message.timestamp = second
            self._writer.on_message_received(message)
        is_empty_fd = frames["is_fd"] & ~frames["is_error"] & (frames["length"] == 0)
        return [
            *_losses_of_both(frames, channels, self._start.is_early(frames["t_ns"] + epoch_ns)),
            _nanoseconds(frames, epoch_ns),
            ("error frames lose class, data and direction", frames["is_error"]),
            ("FD frames without data will read as remote frames", is_empty_fd),
        ]

    def close(self) -> None:
        self._writer.stop()


class _Candump:
    def __init__(self, path: Path, has_direction: bool) -> None:
        self._file = path.open("w", encoding="ascii", errors="replace", newline="\n")
        self._has_direction = has_direction

    def write(self, frames: NDArray[Any], channels: list[str], epoch_ns: int) -> list[_Loss]:
        names = [candump_channel(name) for name in channels]
        self._file.writelines(candump_line(row, names[row["channel"]], epoch_ns, self._has_direction) for row in frames)
        is_sent = frames["is_tx"] & (not self._has_direction)
        return [_nanoseconds(frames, epoch_ns), _fd_errors(frames), ("frames lose that they were sent", is_sent)]

    def close(self) -> None:
        self._file.close()


def _open(kind: str, path: Path, has_direction: bool) -> _FrameTarget:
    if kind == "candump":
        return _Candump(path, has_direction)
    return _Blf(path) if kind == "blf" else _Asc(path)


def _losses_of_both(frames: NDArray[Any], channels: list[str], is_early: NDArray[np.bool_]) -> list[_Loss]:
    """Say what BLF and ASC lose alike."""
    is_named = np.array([bool(name) and not name.isdecimal() for name in channels])
    return [
        ("frames keep of their channel's name no more than its number", is_named[frames["channel"]]),
        ("frames that precede the first one move up to the beginning", is_early),
    ]


def _nanoseconds(frames: NDArray[Any], epoch_ns: int) -> _Loss:
    return "frames lose what their times have below 1 µs", (frames["t_ns"] + epoch_ns) % _US_NS != 0


def _fd_errors(frames: NDArray[Any]) -> _Loss:
    return "error frames lose that they were FD", frames["is_error"] & frames["is_fd"]


Side = Literal["host", "devices", "both"]
HOST: Final = "HOST"
"""Name of the host among a DBC's nodes."""


@dataclass(frozen=True)
class FrameChoice:
    """A choice of frames. The contract gives the sender by the identifier; for an unknown one the direction does.

    `start_ns`, `end_ns` count from the first frame of the recording; `can_ids` empty: all.
    """

    only: Side = "both"
    host_ids: frozenset[int] = frozenset()
    device_ids: frozenset[int] = frozenset()
    can_ids: frozenset[int] = frozenset()
    start_ns: int | None = None
    end_ns: int | None = None

    def pieces(self, source: FrameSource) -> Iterator[NDArray[Any]]:
        """Give what is chosen of each piece of a recording."""
        first_ns = None
        for frames in source:
            if first_ns is None and len(frames):
                first_ns = int(frames["t_ns"][0])
            chosen = frames[self._is_chosen(frames, first_ns or 0)]
            if len(chosen):
                yield chosen

    def _is_chosen(self, frames: NDArray[Any], first_ns: int) -> NDArray[np.bool_]:
        t_ns = frames["t_ns"] - first_ns
        is_chosen = np.ones(len(frames), np.bool_)
        if self.start_ns is not None:
            is_chosen &= t_ns >= self.start_ns
        if self.end_ns is not None:
            is_chosen &= t_ns < self.end_ns
        if self.can_ids:
            is_chosen &= np.isin(frames["can_id"], list(self.can_ids))
        if self.only != "both":
            is_hosts = self._is_hosts(frames)
            is_chosen &= is_hosts if self.only == "host" else ~is_hosts
        return is_chosen

    def _is_hosts(self, frames: NDArray[Any]) -> NDArray[np.bool_]:
        is_known = ~frames["is_error"] & ~frames["is_remote"]
        is_host = is_known & np.isin(frames["can_id"], list(self.host_ids))
        is_device = is_known & np.isin(frames["can_id"], list(self.device_ids))
        return np.asarray(is_host | (frames["is_tx"] & ~is_device))


def sides(codec: Codec | DbcDecoder) -> tuple[frozenset[int], frozenset[int]]:
    """List the identifiers that a contract's host and its devices send."""
    return (
        _ids(message.can_id for message in codec.messages.values() if HOST in message.senders),
        _ids(message.can_id for message in codec.messages.values() if HOST not in message.senders),
    )


def _ids(can_ids: Iterable[int]) -> frozenset[int]:
    return frozenset(can_ids)
