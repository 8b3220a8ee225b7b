"""The cycles that a replay takes from a log of ours: its attempts, their stretches, and the log's attachments.

After an acknowledged fault everything begins anew on the same log: with the reset of communication that the master
sends first. Cycle numbers go on. In between lie cycles that the scheme has no part in: those that disable the drives
at the end, of which the log has the frames alone. Settings, contract and torque offsets are those that are attached to
the log.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from adacd_hil.device.recorded_arm import Ticks
from adacd_hil.log.log_files import LogError
from adacd_hil.log.logged_run import SHOWN, settings_of
from adacd_hil.log.reader import LoggedEvent, LogStream, Piece, Series, begin_of_log
from adacd_hil.records import CERTIFICATE_EVENTS, ContactReport, SchemeState
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.toml_files import parse_toml
from adacd_hil.wire.codec import Codec, parse_codec
from adacd_hil.wire.contract_frames import SYNC_OVERFLOW

NMT_ID, RESET_COMMUNICATION = 0x000, 0x82
"""What an attempt begins with on the bus. Source: CiA 301 (4.2), clause 7.2.8.3.1."""
SYNC_ID = 0x080

Places = NDArray[np.int64]


class CycleStretch(NamedTuple):
    """Cycles of one attempt that follow each other without a gap in the log.

    `attempt`: its number in the run, from 0; `is_begin`: it begins with this. `is_exact`: nothing of it is missing so
    far, so that a replay has to come to the same. requests (n,) of Request, None where nobody knows them; scheme: the
    records of /scheme (n,).
    """

    attempt: int
    is_begin: bool
    is_exact: bool
    ticks: Ticks
    frames: NDArray[Any]
    requests: NDArray[np.uint8] | None
    scheme: Series | None


class LogGap(NamedTuple):
    """Cycles that the log lacks, before the one given."""

    cycle: int
    t_ns: int
    missing: int


class AttemptSplitter:
    """Splits the pieces of a log, in order."""

    def __init__(self, epoch_ns: int) -> None:
        self.gaps: list[LogGap] = []
        self.headless_cycles = 0
        """Cycles at the beginning of the log, of an attempt that had begun before: there is nothing to replay from."""
        self.unpaired = 0
        """Records of /scheme and /cycle without the other one of their cycle."""
        self._epoch_ns = epoch_ns
        self._frames: NDArray[Any] | None = None  # of an attempt whose first cycle is yet to come
        self._has_begun = False
        self._attempt = -1
        self._is_exact = False
        self._last = (-1, 0, int(SchemeState.INIT))  # cycle, overruns and state before
        self._tail = np.zeros(0, np.uint8)  # counters of the SYNCs after that cycle

    def split(self, piece: Piece) -> Iterator[CycleStretch]:
        """Give the stretches of the next piece."""
        scheme, cycle = _paired(piece)
        self.unpaired += len(piece.series["/scheme"]) + len(piece.series["/cycle"]) - 2 * len(cycle)
        frames = piece.frames
        if self._frames is not None:
            frames = _join(self._frames, frames)
            self._frames = None
        resets = _resets(frames)
        t_ns = cycle["publish_time"].astype(np.int64) - self._epoch_ns
        begins = self._begins(t_ns, scheme, frames, resets)
        if len(begins) and begins[-1][0] == len(t_ns):
            self._frames = frames[begins[-1][1] :]
            frames = frames[: begins[-1][1]]
            begins = begins[:-1]
        if len(t_ns):
            yield from self._stretches(t_ns, scheme, cycle, frames, dict(begins))

    def _begins(
        self, t_ns: Places, scheme: NDArray[Any], frames: NDArray[Any], resets: Places
    ) -> list[tuple[int, int]]:
        """List the rows with which attempts begin, and the frame with which each does."""
        begins: dict[int, int] = {}
        rows = np.searchsorted(t_ns, frames["cycle_t_ns"][resets])
        for row, place in zip(rows.tolist(), resets.tolist(), strict=True):
            begins[row] = place  # the last one, if the devices didn't answer to the first
        before = np.concatenate(([self._last[2]], scheme["state"][:-1])) if len(scheme) else scheme["state"]
        is_anew = (scheme["previous_state"] == SchemeState.INIT) & (scheme["state"] <= SchemeState.COMMISSION)
        is_after_fault = before == SchemeState.FAULT
        if not self._has_begun and len(scheme):
            is_after_fault[0] = True
        for row in np.flatnonzero(is_anew & is_after_fault).tolist():
            begins.setdefault(row, int(np.searchsorted(frames["cycle_t_ns"], t_ns[row])))
        return sorted(begins.items())

    def _stretches(
        self, t_ns: Places, scheme: NDArray[Any], cycle: NDArray[Any], frames: NDArray[Any], begins: dict[int, int]
    ) -> Iterator[CycleStretch]:
        number = cycle["cycle"].astype(np.int64)
        overruns = cycle["overruns"].astype(np.int64)
        skipped = np.diff(overruns, prepend=self._last[1])
        steps = np.diff(number, prepend=self._last[0])
        is_begin = np.zeros(len(number), np.bool_)
        is_begin[list(begins)] = True
        is_jump = steps != 1 + skipped
        is_cut = is_begin & (scheme["previous_state"] != SchemeState.INIT)  # its first cycles are missing
        is_gap = is_jump & (~is_begin | is_cut)
        if not self._has_begun and not is_begin[0]:
            is_gap[0] = False
        periods = np.where(is_gap & ~is_begin, np.maximum(steps, 1), np.maximum(1 + skipped, 1))
        cuts = np.flatnonzero(is_begin | is_gap).tolist()
        bounds = sorted({0, *cuts, len(number)})
        places = [begins.get(row, int(np.searchsorted(frames["cycle_t_ns"], t_ns[row]))) for row in bounds[:-1]]
        places[0] = begins.get(0, 0)
        for row, place in begins.items():
            before = frames[: np.searchsorted(frames["cycle_t_ns"], t_ns[row - 1], "right")] if row else frames[:0]
            counters = _sync_counters(frames[len(before) : place])
            last = int(number[row - 1]) if row else self._last[0]
            periods[row] -= _skipped(counters if row else np.concatenate((self._tail, counters)), last)
        periods = np.maximum(periods, 1)
        for start, end, first, last in zip(bounds[:-1], bounds[1:], places, [*places[1:], len(frames)], strict=True):
            if is_begin[start]:
                self._has_begun = self._is_exact = True
                self._attempt += 1
            if is_gap[start]:
                self._is_exact = False
                self.gaps.append(LogGap(int(number[start]), int(t_ns[start]), int(steps[start] - 1 - skipped[start])))
            if not self._has_begun:
                self.headless_cycles += end - start
                self._attempt = 0
                continue
            yield CycleStretch(
                attempt=self._attempt,
                is_begin=bool(is_begin[start]),
                is_exact=self._is_exact,
                ticks=Ticks(number[start:end], t_ns[start:end], periods[start:end]),
                frames=frames[first:last],
                requests=scheme["request"][start:end],
                scheme=Series(scheme[start:end], self._epoch_ns),
            )
        self._last = (int(number[-1]), int(overruns[-1]), int(scheme["state"][-1]))
        self._tail = _sync_counters(frames[np.searchsorted(frames["cycle_t_ns"], t_ns[-1], "right") :])


def _paired(piece: Piece) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the records of /scheme and /cycle that belong to one cycle each, in order."""
    scheme, cycle = piece.series["/scheme"].records, piece.series["/cycle"].records
    theirs, own = scheme["publish_time"], cycle["publish_time"]
    if np.array_equal(theirs, own):
        return scheme, cycle
    _, first, second = np.intersect1d(theirs, own, return_indices=True)
    return scheme[first], cycle[second]


def _join(first: NDArray[Any], second: NDArray[Any]) -> NDArray[Any]:
    """Put frames behind each other, as long as the longer of them."""
    wider = max(first.dtype, second.dtype, key=lambda dtype: dtype.itemsize)
    joined = np.zeros(len(first) + len(second), wider)
    for part, frames in ((joined[: len(first)], first), (joined[len(first) :], second)):
        for name in wider.names or ():
            width = frames[name].shape[1:]
            part[name][(slice(None), *map(slice, width))] = frames[name]
    return joined


def _sync_counters(frames: NDArray[Any]) -> NDArray[np.uint8]:
    is_sync = (frames["can_id"] == SYNC_ID) & ~frames["is_error"] & (frames["length"] > 0)
    return np.asarray(frames["data"][is_sync, 0])


def _skipped(counters: NDArray[np.uint8], last: int) -> int:
    """Count the periods that were skipped between a cycle and the last of the SYNCs that came after it."""
    if counters.size == 0:
        return 0
    return (int(counters[-1]) - 1 - last) % SYNC_OVERFLOW - counters.size


def _resets(frames: NDArray[Any]) -> Places:
    is_nmt = frames["is_tx"] & (frames["can_id"] == NMT_ID) & ~frames["is_error"]
    places = np.flatnonzero(is_nmt)
    return np.asarray(places[frames["data"][places, 0] == RESET_COMMUNICATION])


FRAME_TOPICS: Final = ("/to_can_bus", "/from_can_bus", "/to_can_bus_fd", "/from_can_bus_fd")
TOPICS: Final = (*FRAME_TOPICS, "/scheme", "/cycle", "/contact", "/events")
CYCLES_PER_PIECE: Final = 8_000
_SAID_BEFORE_ANCHORS: Final = frozenset({"margin"})
_SAID: Final = _SAID_BEFORE_ANCHORS | CERTIFICATE_EVENTS
"""Names of the events that the scheme itself says."""


class ReplaySource(Protocol):
    """Where stretches come from: a log of ours, or a recording by others. Iterated once; notes are complete then."""

    settings: Settings
    codec: Codec
    metadata: Mapping[str, str]

    def __iter__(self) -> Iterator["Part"]:
        """Give the parts, in order."""

    @property
    def start_ns(self) -> int:
        """When it begins, ns of the clock of its cycles."""

    def notes(self) -> list[str]:
        """Say what is missing."""


class Part(NamedTuple):
    """The content of one piece of a log. contacts: logged reports by time, ns; events: of the names in `said`."""

    stretches: Iterable[CycleStretch]
    contacts: Mapping[int, Mapping[str, Any]]
    events: Sequence[LoggedEvent]
    said: frozenset[str]


class LogSource:
    """A log of ours."""

    def __init__(self, path: Path, cycles_per_piece: int = CYCLES_PER_PIECE) -> None:
        """Open the log. Raises LogError, ConfigError, CodecError."""
        self._stream = LogStream(path, TOPICS, cycles_per_piece, is_ahead=False)  # replay reads in a thread
        self._path = path
        self.metadata: Mapping[str, str] = self._stream.metadata
        self.settings = settings_of(path, self._stream.attachments)
        self.codec = codec_of(path, self._stream.attachments)
        self._said = _SAID if _has_anchors(self._stream.attachments) else _SAID_BEFORE_ANCHORS
        self._splitter = AttemptSplitter(self._stream.epoch_ns)

    def __iter__(self) -> Iterator[Part]:
        """Give the parts, in order."""
        for read in self._stream:
            piece = self._piece(read)
            events = [logged for logged in self._stream.events(piece) if logged.event.name in self._said]
            yield Part(self._splitter.split(piece), contact_records(piece.series["/contact"]), events, self._said)

    @property
    def start_ns(self) -> int:
        """When the log's first message was, ns of the run's clock. Raises LogError."""
        return begin_of_log(self._path)

    def _piece(self, piece: Piece) -> Piece:
        """Return what is to be replayed of a piece: all of it."""
        return piece

    def notes(self) -> list[str]:
        """Say what is missing."""
        splitter = self._splitter
        notes = [f"the log is not whole: {self._stream.problem}"] if self._stream.problem else []
        dropped = self._stream.summary.get("dropped", "0")
        if dropped != "0":
            notes.append(f"{dropped} packets never reached the log")
        if splitter.headless_cycles:
            notes.append(
                f"{splitter.headless_cycles} cycles at its beginning can't be replayed: the attempt began before"
            )
        for gap in splitter.gaps[:SHOWN]:
            notes.append(
                f"{gap.missing} cycles with their frames are missing before cycle {gap.cycle}: what follows in that "
                "attempt is replayed but can't be compared"
            )
        if len(splitter.gaps) > SHOWN:
            notes.append(f"and {len(splitter.gaps) - SHOWN} more gaps")
        if splitter.unpaired:
            notes.append(f"{splitter.unpaired} records of /scheme or /cycle lack the other one of their cycle")
        return notes


def codec_of(path: Path, attachments: Mapping[str, bytes]) -> Codec:
    """Generate the codec of the DBC that a run had. Raises LogError, CodecError."""
    if "arm.dbc" not in attachments:
        raise LogError(f"log {path} has no arm.dbc attached: its frames can't be decoded")
    return parse_codec(attachments["arm.dbc"], path.with_name("arm.dbc"))


def _has_anchors(attachments: Mapping[str, bytes]) -> bool:
    """Tell whether the run that the settings are of knew anchors: since then they say how a zero drifts."""
    tare = parse_toml(attachments["config.toml"]).get("tare")
    return isinstance(tare, dict) and "drift_Nm_sqrt_s" in tare


def contact_records(series: Series) -> dict[int, dict[str, Any]]:
    """Return the logged reports by the time at which they were made, ns."""
    names = [name for name in ContactReport._fields if name in series.fields]
    rows = zip(series.t_ns.tolist(), series.records, strict=True)
    return {t_ns: {name: record[name].tolist() for name in names} for t_ns, record in rows}
