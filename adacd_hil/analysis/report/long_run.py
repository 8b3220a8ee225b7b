"""The second reading of a long run: what all of its cycles come to, and the cycles that are kept of it.

Kept are, besides those of the outline: of every bucket of cycles those in which a curve of the report is smallest or
largest, so that no peak is lost; all cycles around the first contacts and of the first adaptations; and some stretches
for the noise to be told from. The report draws these as they are, so its size is bounded, whatever the length.

| of a long run | is kept |
|---|---|
| curves | the extremes of each in `BUCKETS` buckets |
| contacts | every cycle from 0.15 s before to 0.6 s after the first `CONTACTS` |
| adaptations | every cycle of those with a figure, where they are no longer than `ADAPTATION_CYCLES` |
| times of the cycle | their extremes in `TIME_BUCKETS` buckets |
"""

import dataclasses
from collections.abc import Iterator
from typing import Final

import numpy as np

from adacd_hil.analysis.cyclic_data import CyclicDataGatherer
from adacd_hil.analysis.logged_run import Run
from adacd_hil.analysis.metrics import Gathered, is_realtime
from adacd_hil.analysis.report.bounds import ADAPTATIONS
from adacd_hil.analysis.report.scheme_rows import SchemeRows, run_of_piece
from adacd_hil.analysis.report.traces import panels_of
from adacd_hil.analysis.score.alarms import find_detections
from adacd_hil.analysis.score.touches import true_contacts
from adacd_hil.analysis.sections import split_sections
from adacd_hil.analysis.thinning import Rows, extreme_rows
from adacd_hil.analysis.timing import (
    QUANTITIES,
    QUEUES,
    CycleColumns,
    TimingGatherer,
    columns_of_series,
    find_reactions,
)
from adacd_hil.analysis.untouched import UntouchedGatherer
from adacd_hil.log.reader import Piece, Series
from adacd_hil.records import SchemeState, Vector

BUCKETS: Final = 2_500
TIME_BUCKETS: Final = 4_000
CONTACTS: Final = 60
ADAPTATION_CYCLES: Final = 10_000
_AROUND_S: Final = (0.15, 0.6)
_AFTER_ADAPTATION: Final = 0.1
"""Share of an adaptation's length by which its figure goes on."""
_ROOM: Final = 500_000
"""Rows that memory is asked for at once, more than are kept of most runs."""
_NOISE_STRETCHES: Final = 16
_NOISE_CYCLES: Final = 500


class LongRun:
    """Takes in the pieces of a run whose outline is known."""

    def __init__(self, outline: Run, indexes: Rows, cycles: int, empty: Piece) -> None:
        """`indexes`: which of the run's `cycles` cycles the outline has; empty: a piece without messages."""
        self._outline = outline
        self._indexes = indexes
        self._cycles = cycles
        self._shell = dataclasses.replace(outline, truth=None, reports=(), events=())
        self._rows = SchemeRows(empty.series["/scheme"], _ROOM)
        self._columns: list[CycleColumns] = [columns_of_series(empty.series["/cycle"])]
        self._untouched = UntouchedGatherer(outline)
        self._data = CyclicDataGatherer(outline.settings)
        self._timing = TimingGatherer(outline.settings.bus.period_us, not is_realtime(outline))
        self._windows = np.array(list(_windows(outline))).reshape(-1, 2)
        self._noise_starts = np.linspace(0, cycles, _NOISE_STRETCHES, endpoint=False).astype(np.int64)
        self._read = 0
        self._timed = 0
        self._overruns = 0
        self._state = int(SchemeState.INIT)

    @property
    def bucket(self) -> int:
        """Cycles of a bucket."""
        return -(-self._cycles // BUCKETS)

    def add(self, piece: Piece) -> None:
        """Take in the next piece."""
        scheme = piece.series["/scheme"]
        self._add_times(columns_of_series(piece.series["/cycle"]), scheme)
        if not len(scheme):
            return
        run = run_of_piece(scheme, self._shell)
        self._untouched.add(run)
        self._rows.add(scheme, self._chosen(run))
        self._read += len(scheme)

    def _chosen(self, run: Run) -> Rows:
        """Choose the rows of a piece that are kept."""
        count, first = run.cycle.size, self._read
        is_kept = np.zeros(count, np.bool_)
        is_kept[[0, -1]] = True
        here = self._indexes[np.searchsorted(self._indexes, first) : np.searchsorted(self._indexes, first + count)]
        is_kept[here - first] = True
        time_s = run.time_s()
        for start_s, end_s in self._windows[(self._windows[:, 0] <= time_s[-1]) & (self._windows[:, 1] >= time_s[0])]:
            is_kept[np.searchsorted(time_s, start_s) : np.searchsorted(time_s, end_s, side="right")] = True
        for start in self._noise_starts.tolist():
            is_kept[max(start - first, 0) : max(start + _NOISE_CYCLES - first, 0)] = True
        starts = np.unique(np.append(0, np.arange(-first % self.bucket, count, self.bucket)))
        is_kept[extreme_rows(_curves(run), starts)] = True
        return np.flatnonzero(is_kept)

    def _add_times(self, columns: CycleColumns, scheme: Series) -> None:
        """Sum up the times of a piece, and keep their extremes."""
        state = scheme.records["state"]
        cycle = scheme.records["cycle"].astype(np.int64)
        self._timing.add(columns, find_reactions(columns, cycle, state, self._state))
        self._data.add(columns, cycle, state)
        if len(state):
            self._state = int(state[-1])
        if not len(columns):
            return
        bucket = -(-self._cycles // TIME_BUCKETS)
        starts = np.unique(np.append(0, np.arange(-self._timed % bucket, len(columns), bucket)))
        names = (*(quantity.column for quantity in QUANTITIES), *QUEUES.values(), "overruns")
        series = [columns[name].astype(np.float64) for name in names if name in columns]
        self._columns.append(columns.rows(extreme_rows(series, starts)))
        self._timed += len(columns)

    def done(self) -> tuple[Run, Gathered]:
        """Give the run with the rows that were kept, and what all of them come to."""
        run = self._rows.fill(self._outline)
        timing = CycleColumns.joined(self._columns)
        run = dataclasses.replace(run, timing=timing, all_cycles=self._cycles, bucket=self.bucket)
        return run, Gathered(self._untouched.gathered(), self._timing.evidence(), self._data.data(run))


def _curves(run: Run) -> Iterator[Vector]:
    """Give what the report draws over the whole run."""
    for panel in panels_of(run):
        for trace in panel.traces:
            yield trace.values


def _windows(run: Run) -> Iterator[tuple[float, float]]:
    """Give the stretches of time, s, of which every cycle is kept."""
    onsets_s = [touch.onset_s for touch in true_contacts(run)] if run.truth is not None else []
    found_s = [detection.detected_s for detection in find_detections(run)]
    for at_s in (*onsets_s[:CONTACTS], *found_s[:CONTACTS]):
        yield at_s - _AROUND_S[0], at_s + _AROUND_S[1]
    adaptations = [section for section in split_sections(run) if section.kind == "adaptation"]
    for section in adaptations[:ADAPTATIONS]:
        if section.duration_s <= ADAPTATION_CYCLES * run.settings.bus.period_s:
            yield section.start_s, section.end_s + _AFTER_ADAPTATION * section.duration_s
