"""The attempts of a run as its log has them: which cycles follow each other, and which frames belong to them.

After an acknowledged fault everything begins anew on the same log: with the reset of communication that the master
sends first. Cycle numbers go on. In between lie cycles that the scheme has no part in: those that disable the drives
at the end, of which the log has the frames alone.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.device.arm import SYNC_OVERFLOW
from adacd_hil.device.recorded_arm import Ticks
from adacd_hil.log.reader import Piece, Series
from adacd_hil.records import SchemeState

NMT_ID, RESET_COMMUNICATION = 0x000, 0x82
"""What an attempt begins with on the bus. Source: CiA 301 (4.2), clause 7.2.8.3.1."""
SYNC_ID = 0x080

Places = NDArray[np.int64]


class Stretch(NamedTuple):
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


class Gap(NamedTuple):
    """Cycles that the log lacks, before the one given."""

    cycle: int
    t_ns: int
    missing: int


class AttemptSplitter:
    """Splits the pieces of a log, in order."""

    def __init__(self, epoch_ns: int) -> None:
        self.gaps: list[Gap] = []
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

    def split(self, piece: Piece) -> Iterator[Stretch]:
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
    ) -> Iterator[Stretch]:
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
                self.gaps.append(Gap(int(number[start]), int(t_ns[start]), int(steps[start] - 1 - skipped[start])))
            if not self._has_begun:
                self.headless_cycles += end - start
                self._attempt = 0
                continue
            yield Stretch(
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
