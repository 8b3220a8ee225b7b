"""The cycles that a replay takes from a log of ours: its attempts, their stretches, and the log's attachments.

After an acknowledged fault everything begins anew on the same log: with the reset of communication that the master
sends first. Cycle numbers go on. In between lie cycles that the scheme has no part in: those that disable the drives
at the end, of which the log has the frames alone. Settings, contract and torque offsets are those that are attached to
the log.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.device.device_files import logged_devices, place_devices
from adacd_hil.device.network import RESET_COMMUNICATION
from adacd_hil.device.profile import PlacedDevice
from adacd_hil.device.recorded_arm import Ticks
from adacd_hil.log.log_files import DBC_NAME, SHOWN, LogError
from adacd_hil.log.logged_run import settings_of
from adacd_hil.log.reader import LoggedEvent, LogStream, Piece, Series, begin_of_log, report_values
from adacd_hil.log.types.record_arrays import FRAME_TOPICS, joined_frames
from adacd_hil.log.types.topics import ARM, CONTACT, CYCLE, EVENTS, SCHEME
from adacd_hil.records import CERTIFICATE_EVENTS, ArmBatch, SchemeState
from adacd_hil.replay.logged_arms import has_arms, logged_arms
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.contract_frames import NMT_ID, SYNC_ID, SYNC_OVERFLOW
from adacd_hil.wire.dbc_contract import parse_codec

Places = NDArray[np.int64]


class CycleStretch(NamedTuple):
    """Cycles of one attempt that follow each other without a gap in the log.

    `attempt`: its number in the run, from 0; `is_begin`: it begins with this stretch. `is_exact`: the log has all of
    the attempt up to here, so that a replay must give the same. arms (n,): as the log has them, None if it lacks them.
    requests (n,) of Request, None if unknown; scheme: the records of /scheme (n,), None for a recording without a log.
    """

    attempt: int
    is_begin: bool
    is_exact: bool
    ticks: Ticks
    frames: NDArray[Any]
    arms: ArmBatch | None
    requests: NDArray[np.uint8] | None
    scheme: Series | None

    @property
    def follows_gap(self) -> bool:
        """Whether the log lacks cycles of its attempt before it; False for a recording without a log."""
        return self.scheme is not None and not self.is_exact


class AttemptSplitter:
    """Splits the pieces of a log, given in its order, into stretches of its attempts.

    /arm says with which cycle an attempt began, and how many periods were skipped. Without it, an attempt begins with
    the host's reset of communication, and skipped periods follow from /cycle's overruns and the counters of SYNC.
    """

    def __init__(self, epoch_ns: int) -> None:
        self.gaps: list[tuple[int, int]] = []
        """A cycle, and how many the log lacks before it."""
        self.headless_cycles = 0
        """Cycles at the beginning of the log, of an attempt that had begun before: a replay can't start from them."""
        self.unpaired = 0
        """Records of /scheme, /arm and /cycle without the other one of their cycle."""
        self._epoch_ns = epoch_ns
        self._has_arms = False  # the log has /arm
        self._frames: NDArray[Any] | None = None  # of an attempt whose first cycle is yet to come
        self._has_begun = False
        self._attempt = -1
        self._is_exact = False
        self._last_cycle, self._overruns, self._state = -1, 0, int(SchemeState.INIT)  # of the cycle before
        self._first_cycle = -1  # of its attempt
        self._tail = np.zeros(0, np.uint8)  # counters of the SYNCs after that cycle

    def split(self, piece: Piece) -> Iterator[CycleStretch]:
        """Yield the stretches of the log's next piece: cycles of one attempt, without a gap.

        Cycles of an attempt that began before the log are left out and counted. Frames of an attempt whose first cycle
        comes with the next piece are kept for the next call.
        """
        scheme, other = self._pair(piece)
        frames = piece.frames
        if self._frames is not None:
            frames = joined_frames((self._frames, frames))
            self._frames = None
        t_ns = other["publish_time"].astype(np.int64) - self._epoch_ns
        begins = self._begins(t_ns, scheme, other, frames)
        if len(begins) and begins[-1][0] == len(t_ns):
            self._frames = frames[begins[-1][1] :]
            frames = frames[: begins[-1][1]]
            begins = begins[:-1]
        if len(t_ns):
            yield from self._stretches(t_ns, scheme, other, frames, dict(begins))

    def _pair(self, piece: Piece) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the records of the same cycles of /scheme and /arm, in a log without /arm of /scheme and /cycle.

        Records without the other one of their cycle are left out and counted in `unpaired`.
        """
        self._has_arms = ARM.name in piece.series
        scheme = piece.series[SCHEME.name].records
        other = piece.series[ARM.name if self._has_arms else CYCLE.name].records
        theirs, own = scheme["publish_time"], other["publish_time"]
        if not np.array_equal(theirs, own):
            _, first, second = np.intersect1d(theirs, own, return_indices=True)
            self.unpaired += len(scheme) + len(other) - 2 * len(first)
            scheme, other = scheme[first], other[second]
        return scheme, other

    def _begins(
        self, t_ns: Places, scheme: NDArray[Any], other: NDArray[Any], frames: NDArray[Any]
    ) -> list[tuple[int, int]]:
        """Return for each attempt that begins in a piece the indices of its first cycle and its first frame, ascending.

        An index behind the last cycle: its first cycle comes with the next piece.
        """
        begins: dict[int, int] = {}
        resets = find_resets(frames)
        rows = np.searchsorted(t_ns, frames["cycle_t_ns"][resets])
        for row, place in zip(rows.tolist(), resets.tolist(), strict=True):
            begins[row] = place  # the last one, if the devices didn't answer to the first
        is_new = self._named_begins(other) if self._has_arms else self._shown_begins(scheme)
        for row in np.flatnonzero(is_new).tolist():
            begins.setdefault(row, int(np.searchsorted(frames["cycle_t_ns"], t_ns[row])))
        if self._has_arms:
            begins = {row: place for row, place in begins.items() if row == len(t_ns) or is_new[row]}
        return sorted(begins.items())

    def _named_begins(self, arm: NDArray[Any]) -> NDArray[np.bool_]:
        """Return for each cycle of /arm (n,) whether an attempt begins there, and store the last cycle's attempt.

        The first cycle is compared with the last one of the call before. At the log's begin it counts only if its
        attempt begins with it. Call it once per piece, in the log's order.
        """
        first = arm["first_cycle"].astype(np.int64)
        is_new = np.diff(first, prepend=self._first_cycle) != 0
        if len(first):
            is_new[0] &= self._has_begun or first[0] == arm["cycle"][0] or self._first_cycle >= 0
            self._first_cycle = int(first[-1])
        return np.asarray(is_new)

    def _shown_begins(self, scheme: NDArray[Any]) -> NDArray[np.bool_]:
        """Return for each cycle (n,) whether the scheme begins anew there: from INIT, after FAULT or with the log.

        Used for logs without /arm.
        """
        before = np.concatenate(([self._state], scheme["state"][:-1])) if len(scheme) else scheme["state"]
        is_anew = (scheme["previous_state"] == SchemeState.INIT) & (scheme["state"] <= SchemeState.COMMISSION)
        is_after_fault = before == SchemeState.FAULT
        if not self._has_begun and len(scheme):
            is_after_fault[0] = True
        return np.asarray(is_anew & is_after_fault)

    def _stretches(
        self,
        t_ns: Places,
        scheme: NDArray[Any],
        other: NDArray[Any],
        frames: NDArray[Any],
        begins: dict[int, int],
    ) -> Iterator[CycleStretch]:
        """Yield the stretches of a piece; count gaps, and leave out and count cycles before the first attempt.

        t_ns, scheme, other (n,): time and records of each cycle. begins: index of the first frame of each attempt that
        begins here, by the index of its first cycle.
        """
        is_begin = np.zeros(len(t_ns), np.bool_)
        is_begin[list(begins)] = True
        number: Places = other["cycle"].astype(np.int64)
        periods, missing = (
            self._read_periods(number, other, is_begin)
            if self._has_arms
            else self._count_periods(t_ns, number, scheme, other, frames, begins, is_begin)
        )
        is_gap = missing != 0
        cuts = np.flatnonzero(is_begin | is_gap).tolist()
        bounds = sorted({0, *cuts, len(t_ns)})
        places = [begins.get(row, int(np.searchsorted(frames["cycle_t_ns"], t_ns[row]))) for row in bounds[:-1]]
        places[0] = begins.get(0, 0)
        for start, end, first, last in zip(bounds[:-1], bounds[1:], places, [*places[1:], len(frames)], strict=True):
            if is_begin[start]:
                self._has_begun = self._is_exact = True
                self._attempt += 1
            if is_gap[start]:
                self._is_exact = False
                self.gaps.append((int(number[start]), int(missing[start])))
            if not self._has_begun:
                self.headless_cycles += end - start
                self._attempt = 0
                continue
            mine = scheme[start:end]
            ticks = Ticks(number[start:end], t_ns[start:end], periods[start:end])
            yield CycleStretch(
                attempt=self._attempt,
                is_begin=bool(is_begin[start]),
                is_exact=self._is_exact,
                ticks=ticks,
                frames=frames[first:last],
                arms=logged_arms(mine, other[start:end], ticks) if self._has_arms else None,
                requests=mine["request"],
                scheme=Series(mine, self._epoch_ns),
            )

    def _read_periods(self, number: Places, arm: NDArray[Any], is_begin: NDArray[np.bool_]) -> tuple[Places, Places]:
        """Return each cycle's periods by /arm (n,), and the number of cycles before it that the log lacks (n,).

        Behind a gap within an attempt the periods are the steps of the cycle's number, at least 1. The number of
        missing cycles is negative where the log goes back. Call it once per piece, in the log's order.
        """
        periods = np.asarray(arm["periods"], np.int64)
        steps = np.diff(number, prepend=self._last_cycle)
        missing = np.where(is_begin, number - arm["first_cycle"].astype(np.int64), steps - periods)
        if not self._has_begun and not is_begin[0]:
            missing[0] = 0
        self._last_cycle = int(number[-1])
        return np.where((missing != 0) & ~is_begin, np.maximum(steps, 1), periods), missing

    def _count_periods(
        self,
        t_ns: Places,
        number: Places,
        scheme: NDArray[Any],
        cycles: NDArray[Any],
        frames: NDArray[Any],
        begins: dict[int, int],
        is_begin: NDArray[np.bool_],
    ) -> tuple[Places, Places]:
        """Return each cycle's periods by its overruns (n,), and the number of cycles before it that the log lacks (n,).

        The periods of an attempt's first cycle depend on the counters of SYNC, too. Behind a gap, and where the log
        goes back, periods and number are as `_read_periods` returns them.
        """
        overruns = cycles["overruns"].astype(np.int64)
        skipped = np.diff(overruns, prepend=self._overruns)
        steps = np.diff(number, prepend=self._last_cycle)
        is_cut = is_begin & (scheme["previous_state"] != SchemeState.INIT)  # its first cycles are missing
        missing = np.where(~is_begin | is_cut, steps - 1 - skipped, 0)
        if not self._has_begun and not is_begin[0]:
            missing[0] = 0
        periods = np.where((missing != 0) & ~is_begin, np.maximum(steps, 1), np.maximum(1 + skipped, 1))
        for row, place in begins.items():
            before = frames[: np.searchsorted(frames["cycle_t_ns"], t_ns[row - 1], "right")] if row else frames[:0]
            counters = _sync_counters(frames[len(before) : place])
            last = int(number[row - 1]) if row else self._last_cycle
            periods[row] -= _skipped(counters if row else np.concatenate((self._tail, counters)), last)
        self._last_cycle, self._overruns, self._state = int(number[-1]), int(overruns[-1]), int(scheme["state"][-1])
        self._tail = _sync_counters(frames[np.searchsorted(frames["cycle_t_ns"], t_ns[-1], "right") :])
        return np.maximum(periods, 1), missing


def _sync_counters(frames: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the counters of the SYNCs among some frames, in the frames' order; SYNCs without data are left out."""
    is_sync = (frames["can_id"] == SYNC_ID) & ~frames["is_error"] & (frames["length"] > 0)
    return np.asarray(frames["data"][is_sync, 0])


def _skipped(counters: NDArray[np.uint8], last: int) -> int:
    """Return the number of periods skipped between a cycle and the last of the SYNCs after it; 0 without a SYNC.

    last: number of that cycle. counters: those of the SYNCs, so that whole turns of SYNC_OVERFLOW periods don't count.
    """
    if counters.size == 0:
        return 0
    return (int(counters[-1]) - 1 - last) % SYNC_OVERFLOW - counters.size


def find_resets(frames: NDArray[Any]) -> Places:
    """Return the indices of the frames by which the host resets the devices' communication (NMT)."""
    is_nmt = frames["is_tx"] & (frames["can_id"] == NMT_ID) & ~frames["is_error"]
    places = np.flatnonzero(is_nmt)
    return np.asarray(places[frames["data"][places, 0] == RESET_COMMUNICATION])


_TOPICS: Final = (SCHEME.name, CONTACT.name, EVENTS.name)
CYCLES_PER_PIECE: Final = 8_000
SAID: Final = frozenset({"margin"}) | CERTIFICATE_EVENTS
"""Names of the events that the scheme itself reports."""


class Part(NamedTuple):
    """The content of one piece of a log.

    contacts: fields of each logged report, by its time, ns; events: the logged events with a name in `SAID`.
    """

    stretches: Iterable[CycleStretch]
    contacts: Mapping[int, Mapping[str, Any]]
    events: Sequence[LoggedEvent]


class LogSource:
    """The cycles and decisions of a log of ours, with its settings and codec."""

    is_recording = False

    def __init__(self, path: Path, cycles_per_piece: int = CYCLES_PER_PIECE) -> None:
        """Open the log, to be read in pieces of `cycles_per_piece` cycles.

        Raises LogError if it can't be read or has no valid settings or no DBC, CodecError for an invalid DBC.
        """
        self.has_arms = has_arms(path)
        self._partner = ARM.name if self.has_arms else CYCLE.name
        self._path = path
        self._cycles_per_piece = cycles_per_piece
        self._stream = self._open(with_frames=False)
        self.metadata: Mapping[str, str] = self._stream.metadata
        self.settings = settings_of(path, self._stream.attachments)
        self.codec = codec_of(path, self._stream.attachments)
        self._splitter = AttemptSplitter(self._stream.epoch_ns)

    def _open(self, with_frames: bool) -> LogStream:
        topics = (*_TOPICS, self._partner, *(FRAME_TOPICS if with_frames else ()))
        return LogStream(self._path, topics, self._cycles_per_piece, is_ahead=False)  # replay reads in a thread

    def devices(self, settings: Settings) -> list[PlacedDevice]:
        """Return the devices that the settings name.

        They come from the log if the settings name the run's devices. They come from their files if the settings name
        others, if the log lacks one, or if a profile in the log can't be parsed. Raises ConfigError if a profile or EDS
        can't be used.
        """
        is_own = settings.devices == self.settings.devices
        own = logged_devices(settings, self._stream.attachments) if is_own else None
        return place_devices(settings) if own is None else own

    def parts(self, with_frames: bool) -> Iterator[Part]:
        """Yield the content of the log piece by piece from front to end; call it once.

        Attempts and gaps are counted from piece to piece. with_frames: read the frames, too; else stretches have none.
        Raises LogError if they are wanted and the log has no topic for them.
        """
        self._stream = self._open(with_frames)
        for read in self._stream:
            if with_frames and not (self.is_recording or any(topic in self._stream.topics for topic in FRAME_TOPICS)):
                lacks = "no frames" if self.has_arms else f"neither {ARM.name} nor frames"
                raise LogError(f"log {self._path} has {lacks}: it can't be replayed so")
            piece = self._piece(read)
            events = [logged for logged in self._stream.events(piece) if logged.event.name in SAID]
            reports = piece.series[CONTACT.name]
            contacts = dict(zip(reports.t_ns.tolist(), report_values(reports), strict=True))
            yield Part(self._splitter.split(piece), contacts, events)

    @property
    def start_ns(self) -> int:
        """Time of the log's first message, ns of the run's clock. Raises LogError if the log has no message."""
        return begin_of_log(self._path)

    def _piece(self, piece: Piece) -> Piece:
        """Return the content of a piece that is replayed: all of it. A subclass may choose."""
        return piece

    def notes(self) -> list[str]:
        """Return the gaps and defects of the log that can't be replayed or compared, as lines.

        At most SHOWN gaps have a line each; one more line counts the rest. Complete after the last of `parts`.
        """
        splitter = self._splitter
        notes = [f"the log is not whole: {self._stream.problem}"] if self._stream.problem else []
        if splitter.headless_cycles:
            notes.append(
                f"{splitter.headless_cycles} cycles at its beginning can't be replayed: the attempt began before"
            )
        for cycle, missing in splitter.gaps[:SHOWN]:
            lacks = f"{missing} cycles with their frames are missing before" if missing > 0 else "the log goes back to"
            notes.append(f"{lacks} cycle {cycle}: what follows in that attempt is replayed but can't be compared")
        if len(splitter.gaps) > SHOWN:
            notes.append(f"and {len(splitter.gaps) - SHOWN} more gaps")
        if splitter.unpaired:
            notes.append(
                f"{splitter.unpaired} records of {SCHEME.name} or {self._partner} lack the other one of their cycle"
            )
        return notes


def codec_of(path: Path, attachments: Mapping[str, bytes]) -> Codec:
    """Return the codec of a run's DBC, from the attachment arm.dbc of its log.

    Raises LogError, which names the log's `path`, without the attachment, CodecError for an invalid one.
    """
    if DBC_NAME not in attachments:
        raise LogError(f"log {path} has no {DBC_NAME} attached: its frames can't be decoded")
    return parse_codec(attachments[DBC_NAME], path.with_name(DBC_NAME))
