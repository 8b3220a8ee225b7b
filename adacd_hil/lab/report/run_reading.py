"""A run read from its logs: the data that report and metrics need, in bounded memory.

A log is read twice, whatever its length: once for the beginnings and ends of contacts and adaptations (`outline`), then
piece by piece through the gatherers, which sum up all cycles and keep those that are drawn (`KeptCycles`). A stretch of
a log is first widened by the outline of the whole log, so that it cuts no contact and no adaptation.

A run of at most `FULL_CYCLES` cycles keeps all of them. A longer one keeps, besides the cycles of the outline:

| of a long run | cycles that are kept |
|---|---|
| curves | the smallest and the largest value of each in `BUCKETS` buckets |
| contacts | all from 0.15 s before to 0.6 s after the first `TRACED_CONTACTS` |
| adaptations | all of the first `ADAPTATIONS` that last at most `ADAPTATION_CYCLES` |
| times of the cycle | the smallest and the largest value of each in `TIME_BUCKETS` buckets |
| noise | `_NOISE_STRETCHES` stretches of `_NOISE_CYCLES` cycles, by which the steps of the curves are chosen |
"""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from adacd_hil.lab.report.outline import Outline, SchemeRows, run_of_piece, settling_s, widen
from adacd_hil.lab.report.page import ADAPTATIONS, TRACED_CONTACTS
from adacd_hil.lab.report.traces import panels_of
from adacd_hil.lab.score.evaluation import QUEUES, RunGatherer
from adacd_hil.log.log_files import CONFIG_DIGEST_KEY, ENDING_KEY, PLANNED_ENDINGS, WHOLE, LogError, TimeWindow
from adacd_hil.log.logged_run import (
    QUANTITIES,
    CycleColumns,
    Milestones,
    Progress,
    Run,
    StretchOfRun,
    Truth,
    columns_of_series,
    settings_of,
    split_sections,
)
from adacd_hil.log.reader import LogStream, Piece, Series, check_states, start_of_log
from adacd_hil.records import JOINTS, Vector
from adacd_hil.score.emulator_truth import (
    Rows,
    TruthTable,
    extreme_rows,
    foreign_truth,
    read_truth,
)
from adacd_hil.score.judge import find_detections, true_contacts
from adacd_hil.score.metrics import Gathered, ReportSource
from adacd_hil.score.wording import unjudged_sentence
from adacd_hil.terminal import one_line

BUCKETS: Final = 2_500
TIME_BUCKETS: Final = 4_000
ADAPTATION_CYCLES: Final = 10_000
_AROUND_S: Final = (0.15, 0.6)
_AFTER_ADAPTATION: Final = 0.1
"""Share of an adaptation's length that its figure shows after its end."""
_ROOM: Final = 200_000
"""Rows to allocate at first; most runs keep fewer."""
_NOISE_STRETCHES: Final = 16
_NOISE_CYCLES: Final = 500


class KeptCycles:
    """Keeps those cycles of a run that are drawn."""

    def __init__(self, outline: Run, indexes: Rows, cycles: int, empty: Run, scheme: Series, full_cycles: int) -> None:
        """`indexes`: places of the outline's cycles among the `cycles` cycles of the run. scheme: without records."""
        self._indexes = indexes
        self._cycles = cycles
        self._bucket, self._time_bucket = (
            1 if cycles <= full_cycles else -(-cycles // buckets) for buckets in (BUCKETS, TIME_BUCKETS)
        )
        self._rows = SchemeRows(scheme, _ROOM)
        self._columns = [empty.timing]
        self._windows = np.array(list(_windows(outline))).reshape(-1, 2)
        self._noise_starts = np.linspace(0, cycles, _NOISE_STRETCHES, endpoint=False).astype(np.int64)
        self._read = 0
        self._timed = 0

    def add_piece(self, scheme: Series, piece: Run) -> None:
        """Choose from the next cycles: the records of /scheme, and the same as a run."""
        self._add_times(piece.timing)
        if len(scheme):
            self._rows.add(scheme, self._chosen(piece))
            self._read += len(scheme)

    def _chosen(self, run: Run) -> Rows:
        """Choose the rows of a piece that are kept."""
        count, first = run.cycle.size, self._read
        if self._bucket == 1:
            return np.arange(count)
        is_kept = np.zeros(count, np.bool_)
        is_kept[[0, -1]] = True
        here = self._indexes[np.searchsorted(self._indexes, first) : np.searchsorted(self._indexes, first + count)]
        is_kept[here - first] = True
        time_s = run.time_s()
        for start_s, end_s in self._windows[(self._windows[:, 0] <= time_s[-1]) & (self._windows[:, 1] >= time_s[0])]:
            is_kept[np.searchsorted(time_s, start_s) : np.searchsorted(time_s, end_s, side="right")] = True
        for start in self._noise_starts.tolist():
            is_kept[max(start - first, 0) : max(start + _NOISE_CYCLES - first, 0)] = True
        is_kept[extreme_rows(_curves(run), _bucket_starts(first, count, self._bucket))] = True
        return np.flatnonzero(is_kept)

    def _add_times(self, columns: CycleColumns) -> None:
        if not len(columns):
            return
        starts = _bucket_starts(self._timed, len(columns), self._time_bucket)
        names = (*(quantity.column for quantity in QUANTITIES), *QUEUES.values(), "overruns")
        series = [columns[name].astype(np.float64) for name in names if name in columns]
        self._columns.append(columns.rows(extreme_rows(series, starts)))
        self._timed += len(columns)

    def run(self, outline: Run) -> Run:
        """Give the run with the cycles that were kept."""
        timing = CycleColumns.joined(self._columns)
        kept = self._rows.fill(outline)
        return replace(kept, timing=timing, all_cycles=self._cycles, bucket=self._bucket)


def _bucket_starts(before: int, count: int, bucket: int) -> Rows:
    """Give the rows of a piece at which buckets begin. before: rows before the piece."""
    return np.unique(np.append(0, np.arange(-before % bucket, count, bucket)))


def _curves(run: Run) -> Iterator[Vector]:
    """Give the curves that the report draws over the whole run."""
    for panel in panels_of(run):
        for trace in panel.traces:
            yield trace.values


def _windows(run: Run) -> Iterator[tuple[float, float]]:
    """Give the stretches of time, s, of which every cycle is kept."""
    onsets_s = [touch.onset_s for touch in true_contacts(run)] if run.truth is not None else []
    found_s = [detection.detected_s for detection in find_detections(run)]
    for at_s in (*onsets_s[:TRACED_CONTACTS], *found_s[:TRACED_CONTACTS]):
        yield at_s - _AROUND_S[0], at_s + _AROUND_S[1]
    adaptations = [section for section in split_sections(run) if section.kind == "adaptation"]
    for section in adaptations[:ADAPTATIONS]:
        if section.duration_s <= ADAPTATION_CYCLES * run.settings.bus.period_s:
            yield section.start_s, section.end_s + _AFTER_ADAPTATION * section.duration_s


RUN_TOPICS: Final = ("/scheme", "/cycle", "/frame_checks", "/contact", "/events")
"""Topics that a report reads."""
FULL_CYCLES: Final = 150_000
"""Cycles that are kept and drawn one by one: 150 s at 1 kHz, about as many as are kept of hours."""
_MOST_DIGITS: Final = 18

Bounds = tuple[int, int]
"""From when, and before when, ns of the run's clock."""


class ReadRun(NamedTuple):
    """A run with the cycles that are drawn, the sums over all of its cycles, and its log."""

    run: Run
    gathered: Gathered
    source: ReportSource


def read_run(
    log_path: Path,
    truth_path: Path | None,
    stretch: TimeWindow = WHOLE,
    progress: Progress = lambda _: None,
    full_cycles: int = FULL_CYCLES,
) -> ReadRun:
    """Read a log, or a stretch of it, and the emulator's truth if there is one. Raises LogError, ConfigError.

    The truth of another run is left out, and is a problem of the source.
    full_cycles: of a log with more, some are kept.
    """
    problem = "" if truth_path is None else foreign_truth(log_path, truth_path)
    truth = None if truth_path is None or problem else read_truth(truth_path)
    reading = _Reading(log_path, truth, progress, problem)
    if stretch.is_whole:
        return reading.gather(reading.outline(), full_cycles)
    return reading.read_stretch(stretch, full_cycles)


class _Reading:
    """Reads one log, as often as it takes."""

    def __init__(self, path: Path, truth: TruthTable | None, progress: Progress, truth_problem: str = "") -> None:
        self._path = path
        self._truth_problem = truth_problem
        self._truth = truth
        self._progress = progress
        stream = LogStream(path, RUN_TOPICS)
        self._empty = stream.empty()
        self._scheme = self._empty.series["/scheme"]
        self._shell = self._begin(stream)
        self._read = stream  # that was last read to its end

    def _begin(self, stream: LogStream) -> Run:
        """Give a run without a cycle, with metadata and settings of the log."""
        metadata = dict(stream.metadata)
        if "arm.dbc" in stream.attachments:
            metadata["dbc_sha256"] = hashlib.sha256(stream.attachments["arm.dbc"]).hexdigest()
        if self._truth is not None:
            emulator = self._truth.metadata.items()
            metadata |= {
                f"emulator_{key}": value for key, value in emulator if key not in (*metadata, CONFIG_DIGEST_KEY)
            }
        nothing = np.empty((0, JOINTS))
        empty = Run(
            cycle=np.empty(0, np.int64),
            t_ns=np.empty(0, np.int64),
            state=np.empty(0, np.uint8),
            fault=np.empty(0, np.uint8),
            tau_ext_hat=nothing,
            tau_ext_hat_cad=nothing,
            theta_hat=nothing,
            threshold=nothing,
            reports=(),
            timing=columns_of_series(self._empty.series["/cycle"]),
            truth=None,
            settings=settings_of(self._path, stream.attachments),
            metadata=metadata,
            frames=None,
            dropped=None,
            log_start_ns=start_of_log(self._path),
        )
        return run_of_piece(self._scheme, empty)

    def _pieces(self, doing: str, bounds_ns: Bounds | None = None) -> Iterator[tuple[LogStream, Piece]]:
        """Read the log, or its part between two times."""
        stream = LogStream(self._path, RUN_TOPICS)
        cycles = 0
        milestones = Milestones(lambda count: self._progress(f"{self._path}: {doing}, {count} cycles"))
        for piece in stream:
            check_states(piece.series["/scheme"])
            cycles += len(piece.series["/scheme"])
            milestones.reach(cycles)
            if bounds_ns is None:
                yield stream, piece
                continue
            times_ns = piece.series["/scheme"].t_ns
            if times_ns.size and times_ns[0] >= bounds_ns[1]:
                break
            yield stream, _within(piece, bounds_ns, stream.epoch_ns)
        self._read = stream

    def _done(self, run: Run, gathered: Gathered) -> ReadRun:
        """Add the ending, the problems and the counts of the log."""
        stream, truth = self._read, self._truth
        ending = stream.summary.get(ENDING_KEY, "")
        if ending and ending not in PLANNED_ENDINGS:
            run = replace(run, broken_off=one_line(ending))
        of_truth = self._truth_problem or _unjudged(run)
        problems = [stream.problem, "" if truth is None else truth.problem, of_truth]
        is_complete = stream.is_complete and not of_truth and (truth is None or truth.is_complete)
        source = ReportSource(self._path.name, "; ".join(filter(None, problems)), is_complete)
        if run.stretch is None:
            run = replace(run, frames=_count(stream.summary, "frames"), dropped=_count(stream.summary, "dropped"))
        return ReadRun(run, gathered, source)

    def outline(
        self, bounds_ns: Bounds | None = None, shell: Run | None = None, until_ns: int | None = None
    ) -> Outline:
        """Find when contacts, adaptations and states begin and end, in all cycles or between two times.

        shell: facts about the run that are known before, its truth included. until_ns: stop reading when
        the log is past this time by the settling time, and the outline is idle since (`Outline.is_idle_since`).
        """
        outline = Outline(shell or self._shell, self._scheme, self._truth if shell is None else None)
        settling_ns = round(settling_s(self._shell) * 1e9)
        for stream, piece in self._pieces("looking for what happens", bounds_ns):
            outline.add(stream, piece)
            times_ns = piece.series["/scheme"].t_ns
            if until_ns is None or not times_ns.size:
                continue
            before_ns = int(times_ns[-1]) - settling_ns
            if before_ns > until_ns and outline.is_idle_since(before_ns):
                break
        return outline

    def gather(self, outline: Outline, full_cycles: int, bounds_ns: Bounds | None = None) -> ReadRun:
        """Pass all cycles, or those between two times, through the gatherers."""
        run = outline.done()
        shell = replace(run, truth=None, reports=(), events=())
        indexes = np.concatenate([np.empty(0, np.int64), *outline.indexes])
        kept = KeptCycles(run, indexes, outline.facts.cycles, self._shell, self._scheme, full_cycles)
        sums = RunGatherer(run)
        for _, piece in self._pieces("adding up", bounds_ns):
            scheme = piece.series["/scheme"]
            cycles = replace(run_of_piece(scheme, shell), timing=columns_of_series(piece.series["/cycle"]))
            sums.add_piece(cycles)
            kept.add_piece(scheme, cycles)
        run = kept.run(run)
        return self._done(run, sums.gathered(run))

    def read_stretch(self, stretch: TimeWindow, full_cycles: int) -> ReadRun:
        """Read a part of the log, widened to cut no contact and no adaptation.

        Raises LogError for a part without a cycle.
        """
        start_ns = self._shell.log_start_ns
        if start_ns is None:
            raise LogError(f"log {self._path} has no message")
        asked_ns = stretch.bounds_ns(start_ns)
        run = self.outline(until_ns=asked_ns[1]).done()
        zero_ns = run.zero_ns
        asked_s = ((asked_ns[0] - zero_ns) * 1e-9, (asked_ns[1] - zero_ns) * 1e-9)
        bounds_s = widen(run, *asked_s)
        bounds_ns = (round(bounds_s[0] * 1e9) + zero_ns, round(bounds_s[1] * 1e9) + zero_ns)
        found = TimeWindow(*((bound_ns - start_ns) * 1e-9 for bound_ns in bounds_ns))
        begun_s = [d.detected_s for d in find_detections(run)]
        if run.truth is not None:
            begun_s = [touch.onset_s for touch in true_contacts(run)]
        shell = replace(
            self._shell,
            motion_start_ns=zero_ns,
            truth=_truth_within(run.truth, bounds_s),
            stretch=StretchOfRun(
                stretch, found, sum(at_s < bounds_s[0] for at_s in begun_s), (zero_ns - start_ns) * 1e-9
            ),
        )
        read = self.gather(self.outline(bounds_ns, shell), full_cycles, bounds_ns)
        if read.run.cycle.size == 0:
            raise LogError(f"log {self._path} has no cycle from {stretch.start_s:g} to {stretch.end_s:g} s")
        return read


def _within(piece: Piece, bounds_ns: Bounds, epoch_ns: int) -> Piece:
    """Give a piece's messages between two times, and all of its events."""
    series = {}
    for name, values in piece.series.items():
        t_ns = values.t_ns
        series[name] = Series(values.records[(t_ns >= bounds_ns[0]) & (t_ns < bounds_ns[1])], epoch_ns)
    return piece._replace(series=series)


def _truth_within(truth: Truth | None, bounds_s: tuple[float, float]) -> Truth | None:
    """Give the rows of the truth between two times, s since motion start."""
    if truth is None or truth.time_s is None:
        return truth
    rows = (truth.time_s >= bounds_s[0]) & (truth.time_s < bounds_s[1])
    return replace(
        truth,
        cycle=truth.cycle[rows],
        tau_ext=truth.tau_ext[rows],
        contact_link=truth.contact_link[rows],
        contact_index=truth.contact_index[rows],
        force_N=None if truth.force_N is None else truth.force_N[rows],
        time_s=truth.time_s[rows],
        attempt=None if truth.attempt is None else truth.attempt[rows],
    )


def _unjudged(run: Run) -> str:
    """Return a line with the number of detections outside the time of the recorded truth; "" for 0."""
    return unjudged_sentence(sum(not detection.raised.is_known for detection in find_detections(run)))


def _count(summary: Mapping[str, str], key: str) -> int | None:
    """Return a number of the log's summary; None if it is missing (a cut file) or not a number (a damaged one)."""
    text = summary.get(key, "")
    return int(text) if text.isdecimal() and len(text) <= _MOST_DIGITS else None
