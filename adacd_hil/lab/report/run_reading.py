"""A run read from its logs: the data that report and metrics need, in bounded memory.

A log is read once, front to back. Its cycles wait in memory until what happens around them is known; then the
gatherers sum them up, and those that are drawn are kept. A stretch of a log must cut no contact, no reaction and no
adaptation, so it takes a first reading of the log up to its end, which tells where these lie.

A run of at most `FULL_CYCLES` cycles keeps all of them. A longer one keeps:

| of a long run | cycles that are kept |
|---|---|
| outline | the first and the last of every piece; those in which the state changes, the paper's scheme is armed or |
| | disarmed, or a true contact begins, with their neighbours |
| curves | the smallest and the largest value of each in at most `BUCKETS` buckets |
| contacts | all from 0.15 s before to 0.6 s after the first `TRACED_CONTACTS` true ones, and as many detections |
| adaptations | the first `ADAPTATION_S` of the first `ADAPTATIONS` |
| times of the cycle | the smallest and the largest value of each in at most `TIME_BUCKETS` buckets |
| noise | `_NOISE_CYCLES` at the beginning of every `_NOISE_BUCKETS`-th bucket, by which the steps of the curves are |
| | chosen |

The outline suffices for sections, detections and contacts.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.lab.report.page import ADAPTATIONS, TRACED_CONTACTS
from adacd_hil.lab.report.traces import panels_of
from adacd_hil.lab.score.evaluation import QUEUES, RunGatherer
from adacd_hil.lab.score.margins import SETTLING_TIME_CONSTANTS
from adacd_hil.lab.score.metrics import ReportSource
from adacd_hil.lab.score.report_wording import lacks_text
from adacd_hil.lab.score.run_arrays import (
    EMULATOR,
    QUANTITIES,
    AttemptBegins,
    CertifiedStream,
    CheckCounts,
    CycleColumns,
    MeasuredMotion,
    PaperStream,
    Run,
    StretchOfRun,
    columns_of_series,
    host_truth,
    is_realtime,
    last_cycle,
    split_sections,
    stays_of,
    truth_rows,
)
from adacd_hil.lab.score.run_judge import find_detections, timed_contacts, uncovered_watch
from adacd_hil.log.log_files import CONFIG_DIGEST_KEY, DBC_NAME, ENDING_KEY, TRUTH_NAME, LogError
from adacd_hil.log.log_parts import CUT, PLANNED_ENDINGS, whole_number
from adacd_hil.log.logged_run import Cycles, Milestones, Progress, host_cycles, settings_of
from adacd_hil.log.reader import LoggedEvent, LogStream, Series, contacts_of, start_of_log
from adacd_hil.log.time_window import WHOLE, TimeWindow
from adacd_hil.log.types.topics import CONTACT, CYCLE, EVENTS, FRAME_CHECKS, SCHEME
from adacd_hil.printable import one_line
from adacd_hil.records import (
    JOINTS,
    LEARNING,
    MOTION_START,
    REACTING,
    ContactReport,
    CycleRecord,
    FaultReason,
    Request,
    SchemeState,
)
from adacd_hil.score.emulator_truth import Rows, TruthTable, extreme_rows, foreign_truth, read_truth
from adacd_hil.score.wording import unjudged_sentence
from adacd_hil.settings.configuration import Settings

BUSY: Final = (*LEARNING, *REACTING)
"""States that a stretch does not cut."""
MARGIN_S: Final = 0.2
"""Margin of a stretch before a contact or a reaction."""
BUCKETS: Final = 2_500
TIME_BUCKETS: Final = 4_000
FULL_CYCLES: Final = 150_000
"""Cycles that are kept and drawn one by one: 150 s at 1 kHz, about as many as are kept of hours."""
ADAPTATION_S: Final = 10.0
RUN_TOPICS: Final = (SCHEME.name, CYCLE.name, FRAME_CHECKS.name, CONTACT.name, EVENTS.name)
"""Topics that a report reads."""
AROUND_S: Final = (0.15, 0.6)
"""Time before and after a contact that is kept, and shown with it."""
_NOISE_BUCKETS: Final = 150
_NOISE_CYCLES: Final = 500
_WAITING: Final = 50_000
"""Cycles that are gathered at a time."""
_BEYOND_S: Final = 1.0
"""How much longer than the settling time cycles wait: longer than two kept rows of a truth lie apart."""

Bounds = tuple[int, int]
"""From when, and before when, ns of the run's clock."""


class ReadRun(NamedTuple):
    """A run with the cycles that are drawn, the sums over all of its cycles, and facts on its log."""

    run: Run
    gathered: RunGatherer
    source: ReportSource


def read_run(
    log_path: Path,
    truth_path: Path | None,
    stretch: TimeWindow = WHOLE,
    progress: Progress = lambda _: None,
    full_cycles: int = FULL_CYCLES,
) -> ReadRun:
    """Return the run in a log, or in a stretch of it, with the emulator's truth if there is one.

    A stretch is widened as by `_widened`. A truth that is of another run, or no log, is left out, and named as a
    problem of the source. Raises LogError if the log can't be read or has no valid settings, or if the stretch has no
    cycle. progress: called with a line on the cycles read. full_cycles: the run of a log with more cycles has only some
    of them.
    """
    problem = "" if truth_path is None else foreign_truth(log_path, truth_path)
    truth = None if truth_path is None or problem else read_truth(truth_path)
    stream = LogStream(log_path, RUN_TOPICS)
    shell = _shell(stream, truth)
    reading = RunReading(shell, stream.empty().series, truth, full_cycles)
    if stretch.is_whole:
        _read(stream, reading, progress)
    else:
        start_ns = shell.log_start_ns
        if start_ns is None:
            raise LogError(f"log {log_path} has no message")
        _read(stream, reading, progress, until_ns=stretch.bounds_ns(start_ns)[1])
        shell, bounds_ns = _widened(reading.outline(), shell, stretch, start_ns)
        stream = LogStream(log_path, RUN_TOPICS)
        reading = RunReading(shell, stream.empty().series, None, full_cycles)
        _read(stream, reading, progress, bounds_ns)
    run = reading.finished()
    if run.cycle.size == 0 and run.stretch is not None:
        raise LogError(f"log {log_path} has no cycle {stretch.text}")
    return _with_ending(run, reading.sums, stream, truth, problem)


def _shell(stream: LogStream, truth: TruthTable | None) -> Run:
    """Return a run without a cycle, with metadata, settings and start of the log.

    Metadata of the truth that the log lacks are there as `EMULATOR` + key, except the digest of the host's
    configuration. If the log has a DBC, its digest is there as "dbc_sha256".
    """
    metadata = dict(stream.metadata)
    if DBC_NAME in stream.attachments:
        metadata["dbc_sha256"] = hashlib.sha256(stream.attachments[DBC_NAME]).hexdigest()
    if truth is not None:
        told = {key: value for key, value in truth.metadata.items() if key not in (*metadata, CONFIG_DIGEST_KEY)}
        metadata |= {EMULATOR + key: value for key, value in told.items()}
    nothing = np.empty((0, JOINTS))
    return Run(
        cycle=np.empty(0, np.int64),
        t_ns=np.empty(0, np.int64),
        state=np.empty(0, np.uint8),
        fault=np.empty(0, np.uint8),
        tau_ext_hat=nothing,
        tau_ext_hat_cad=nothing,
        theta_hat=nothing,
        threshold=nothing,
        reports=(),
        timing=columns_of_series(stream.empty().series[CYCLE.name]),
        truth=None,
        settings=settings_of(stream.path, stream.attachments),
        metadata=metadata,
        frames=None,
        dropped=None,
        contact_joints=np.empty(0, np.uint8),
        motion=MeasuredMotion(nothing, nothing, nothing),
        log_start_ns=start_of_log(stream.path),
    )


def _read(
    stream: LogStream,
    reading: "RunReading",
    progress: Progress,
    bounds_ns: Bounds | None = None,
    until_ns: int | None = None,
) -> None:
    """Add the pieces of a log to `reading`: all, those within `bounds_ns`, or until it is settled at `until_ns`.

    progress: called with a line on the cycles read. Raises LogError as `_checked`.
    """
    milestones = Milestones(lambda count: progress(f"{stream.path}: {count} cycles read"))
    cycles, last = 0, (-1, -1)
    for piece in stream:
        scheme = piece.series[SCHEME.name]
        last = _checked(stream.path, scheme, last)
        cycles += len(scheme)
        milestones.reach(cycles)
        series = piece.series
        if bounds_ns is not None:
            if len(scheme) and scheme.t_ns[0] >= bounds_ns[1]:
                return
            series = {name: each.between(*bounds_ns) for name, each in series.items()}
        reading.add_piece(series, stream.events(piece))
        if until_ns is not None and len(scheme) and reading.is_settled(until_ns, int(scheme.t_ns[-1])):
            return


_STATES: Final = {"state": SchemeState, "previous_state": SchemeState, "fault": FaultReason}


def _checked(path: Path, scheme: Series, last: tuple[int, int]) -> tuple[int, int]:
    """Return number and time, ns, of the last cycle so far; last: those of the one before the piece.

    Raises LogError for a record of /scheme with an unknown state or fault, or that is not after the one before.
    """
    cycle = scheme.records["cycle"].astype(np.int64)
    for name, kind in _STATES.items():
        if name in scheme.fields:
            odd = np.flatnonzero(~np.isin(scheme.records[name], [int(member) for member in kind]))
            if odd.size:
                value = scheme.records[name][odd[0]]
                raise LogError(
                    f"{SCHEME.name} has {name} {value} in cycle {cycle[odd[0]]}, which this version does not know"
                )
    return last_cycle(path, scheme, last)


def _with_ending(
    run: Run, gathered: RunGatherer, stream: LogStream, truth: TruthTable | None, truth_problem: str
) -> ReadRun:
    """Return a run with `broken_off`, if the log ended unplanned, `is_cut`, and the counts of the log's summary.

    The run of a stretch has no counts. The source has the problems of log and truth, unjudged alarms, and the bounds of
    a cut, which is complete all the same.
    """
    ending = stream.summary.get(ENDING_KEY, "")
    if ending and ending not in PLANNED_ENDINGS:
        run = replace(run, broken_off=one_line(ending))
    run = replace(run, is_cut=ending == CUT)
    unjudged = unjudged_sentence(sum(not detection.is_known for detection in find_detections(run)))
    if not unjudged and uncovered_watch(run).any():
        unjudged = f"{TRUTH_NAME} doesn't cover all of MONITOR"
    damage = f"{TRUTH_NAME} is not whole: {truth.problem}" if truth is not None and truth.problem else ""
    of_truth = "; ".join(filter(None, (truth_problem, damage, unjudged)))
    needed = (CONTACT.name, EVENTS.name) if run.cycle.size else (SCHEME.name,) if CYCLE.name in stream.topics else ()
    log_problem = "; ".join(filter(None, (stream.problem, lacks_text(needed, stream.topics))))
    is_complete = not (log_problem or of_truth)
    if run.is_cut:
        bounds_s = ((word, stream.summary.get(f"{word}_s", "inf")) for word in ("from", "until"))
        words = ("the log is a cut of its run", *(f"{word} {at_s} s" for word, at_s in bounds_s if "inf" not in at_s))
        of_truth = "; ".join(filter(None, (of_truth, " ".join(words))))
    source = ReportSource(stream.path.name, log_problem, is_complete, of_truth)
    if run.stretch is None:
        frames, dropped = (whole_number(stream.summary.get(key, "")) for key in ("frames", "dropped"))
        run = replace(run, frames=frames, dropped=dropped)
    return ReadRun(run, gathered, source)


class RunReading:
    """Makes a run of the pieces of a log, front to back.

    `sums` are over all cycles; of a long run only some cycles are kept.
    """

    def __init__(self, shell: Run, empty: Mapping[str, Series], truth: TruthTable | None, full_cycles: int) -> None:
        """`shell`: a run with empty arrays, but settings, metadata, and a truth on the host's cycles if there is one.

        empty: for each topic a series without records, which shows its fields. truth: rows whose host cycle is still to
        be found; None: the shell's truth, if any. full_cycles: up to so many all are kept.
        """
        self._shell = shell
        self._truth = truth
        self._clock = None if truth is None else TruthClock(truth)
        rows = shell.truth if truth is None else truth.rows
        index = np.empty(0) if rows is None else rows.contact_index
        self._is_onset = (index >= 0.0) & (np.concatenate(([-1.0], index))[:-1] != index)
        self._rows = KeptRows(empty[SCHEME.name], _FIELDS, BUCKETS)
        self._times = KeptRows(empty[CYCLE.name], CycleRecord._fields, TIME_BUCKETS)
        self._thinned = self._waiting = 0  # rows of /cycle that have been thinned, and those that wait
        self.sums = RunGatherer(shell.settings, not is_realtime(shell))
        self._full_cycles = full_cycles
        self._settled = 0  # rows that have been gathered
        self._last: tuple[int, bool] | None = None  # state of the row before, and whether the paper's scheme was armed
        self._busy_ns = 0  # time of the last cycle in a state of `BUSY`, or of a later row of the truth
        self._attempts = AttemptBegins()
        self._reports: list[ContactReport] = []
        self._events: list[LoggedEvent] = []
        self._checks: list[CheckCounts] = []
        self._finish_cycle: int | None = None  # of the first request to finish
        self._zero_ns = None if shell.stretch is None else shell.zero_ns
        self._first_ns: int | None = None
        self._last_cycle = -1

    def add_piece(self, series: Mapping[str, Series], events: list[LoggedEvent]) -> None:
        """Add the next piece of the log: its records by topic, and its events.

        Add the cycles' times to `sums` at once. Once more than `_WAITING` cycles wait for the rest, add those older
        than the settling time and `_BEYOND_S`; of a long run drop those of them that aren't drawn.
        """
        self._reports += [report for _, report in contacts_of(series[CONTACT.name])]
        self._events += events
        self._checks += _checks_of(series[FRAME_CHECKS.name])
        scheme, columns = series[SCHEME.name], columns_of_series(series[CYCLE.name])
        cycle, state = scheme.records["cycle"].astype(np.int64), scheme.records["state"]
        self.sums.add_times(columns, cycle, state)
        self._times.add_records(series[CYCLE.name], [])
        self._waiting += len(columns)
        if self._waiting > _WAITING:
            self._thin_times()
        if not len(scheme):
            return
        self._attempts.add_cycles(cycle, state)
        self._add_facts(scheme, cycle, state)
        rows = np.concatenate((self._edges(scheme), self._onset_rows(scheme, cycle)))
        self._rows.add_records(scheme, rows[(rows >= 0) & (rows < len(scheme))])
        self._last_cycle = int(cycle[-1])
        if self._rows.count - self._settled > _WAITING:
            beyond_ns = round((self._settling_s + _BEYOND_S) * 1e9)
            self._settle(int(np.searchsorted(self._rows.column("t_ns"), scheme.t_ns[-1] - beyond_ns)))

    def _add_facts(self, scheme: Series, cycle: Cycles, state: NDArray[np.uint8]) -> None:
        """Store the first cycle, motion start, the first request to finish, and the last cycle in a state of `BUSY`.

        Facts that the piece lacks stay as they were.
        """
        if self._first_ns is None:
            self._first_ns = int(scheme.t_ns[0])
        adapting = np.flatnonzero(state == MOTION_START)
        if self._zero_ns is None and adapting.size:
            self._zero_ns = int(scheme.t_ns[adapting[0]])
        asked = np.flatnonzero(scheme.records["request"] == Request.FINISH)
        if self._finish_cycle is None and asked.size:
            self._finish_cycle = int(cycle[asked[0]])
        busy = np.flatnonzero(np.isin(state, BUSY))
        if busy.size:
            self._busy_ns = max(self._busy_ns, int(scheme.t_ns[busy[-1]]))

    def _edges(self, scheme: Series) -> Rows:
        """Return the first and last row of a piece, and rows around changes of the state or of the paper's arming.

        Rows beyond the piece may be among them. Stores state and arming of the last row for the next piece.
        """
        state = scheme.records["state"].astype(np.int64)
        is_armed = np.zeros(len(state), np.bool_)
        if "paper_is_armed" in scheme.fields:
            is_armed = scheme.records["paper_is_armed"] > 0.5
        last_state, was_armed = self._last or (int(state[0]), bool(is_armed[0]))
        self._last = int(state[-1]), bool(is_armed[-1])
        changes = np.flatnonzero(np.diff(state, prepend=last_state))
        switches = np.flatnonzero(np.diff(is_armed.astype(np.int8), prepend=np.int8(was_armed)))
        ends = np.array([0, len(state) - 1])
        return np.concatenate((ends, changes - 1, changes, changes + 1, switches - 1, switches))

    def _onset_rows(self, scheme: Series, cycle: Cycles) -> Rows:
        """Return the rows of a piece in which true contacts begin, and the rows before them; none without a truth.

        Rows beyond the piece may be among them. With a truth whose host cycles are still to be found, set the times of
        its rows in this piece, and count the latest of them as busy.
        """
        if self._clock is not None:
            rows, cycles = self._clock.place_rows(scheme, self._attempts.begins)
            onsets = cycles[self._is_onset[rows]]
            if rows.size:
                self._busy_ns = max(self._busy_ns, int(self._clock.t_ns[rows].max()))
        elif self._shell.truth is not None:
            onsets = self._shell.truth.cycle[self._is_onset]
            onsets = onsets[(onsets >= cycle[0]) & (onsets <= cycle[-1])]
        else:
            return np.empty(0, np.int64)
        found = np.searchsorted(cycle, onsets)
        return np.concatenate((found - 1, found))

    @property
    def _settling_s(self) -> float:
        return SETTLING_TIME_CONSTANTS / self._shell.settings.cutoff_rad_s

    def is_settled(self, until_ns: int, last_ns: int) -> bool:
        """Return whether contacts, reactions and adaptations from before `until_ns` are over at the cycle at `last_ns`.

        They are if the settling time before `last_ns` begins after `until_ns`, and has no cycle in a state of `BUSY`
        and no row of the truth.
        """
        before_ns = last_ns - round(self._settling_s * 1e9)
        return before_ns > until_ns and self._busy_ns < before_ns

    def outline(self) -> Run:
        """Return the run so far with the cycles that are in memory: those kept, and those not summed up yet."""
        zero_ns = next((t_ns for t_ns in (self._zero_ns, self._first_ns) if t_ns is not None), 0)
        run = replace(
            self._rows.run(self._shell),
            reports=tuple(self._reports),
            events=tuple(self._events),
            finish_cycle=self._finish_cycle,
            checks=_joined(self._checks),
            zero_ns=zero_ns,
        )
        if self._truth is None or self._clock is None:
            return run
        time_s = np.asarray((self._clock.t_ns - zero_ns) * 1e-9, np.float64)
        return replace(run, truth=host_truth(self._truth, self._attempts.begins, self._last_cycle, time_s))

    def _settle(self, end: int) -> None:
        """Add the kept rows before `end` to `sums`, each once. Of a long run, drop then those that are not drawn."""
        outline = self.outline()
        shell = replace(self._shell, truth=None, zero_ns=outline.zero_ns)
        self.sums.untouched.add_untouched(self._rows.run(shell, slice(self._settled, end)), outline)
        first, cycles = self._settled, self._rows.cycles
        self._settled = end
        if cycles <= self._full_cycles or first == end:
            return
        around_ns = _around(outline)
        self._settled -= self._rows.thin(first, end, lambda rows: self._curves(shell, rows), around_ns, _NOISE_CYCLES)

    def _thin_times(self) -> None:
        """Of a long run, drop rows of /cycle in which no time, queue or overrun is smallest or largest in its bucket.

        Only rows read since it last dropped any are judged, or all if the buckets double.
        """
        self._waiting = 0
        if self._times.cycles > self._full_cycles:
            self._times.thin(self._thinned, self._times.count, self._time_curves)
            self._thinned = self._times.count

    def _time_curves(self, rows: slice) -> Iterator[NDArray[np.float64]]:
        """Yield the cycles' times, queues and skipped periods in these rows, a curve (n,) each."""
        for name in (*(quantity.column for quantity in QUANTITIES), *QUEUES.values(), "overruns"):
            yield self._times.column(name)[rows].astype(np.float64)

    def _curves(self, shell: Run, rows: slice) -> Iterator[NDArray[np.float64]]:
        """Yield the curves (n,) that the report draws over /scheme, in these of the kept rows; shell: as of `run`."""
        for panel in panels_of(self._rows.run(shell, rows)):
            for trace in panel.traces:
                yield trace.values

    def finished(self) -> Run:
        """Return the run with the kept cycles; sum up the last ones, so that `sums` has all.

        Call it once, at the end.
        """
        self._settle(self._rows.count)
        if self._waiting:
            self._thin_times()
        columns = {name: self._times.column(name).astype(np.int64) for name in self._times.names}
        timing = CycleColumns(self._times.column("t_ns").copy(), columns)
        return replace(self.outline(), timing=timing, all_cycles=self._rows.cycles, bucket=self._rows.bucket)


def _around(run: Run) -> list[Bounds]:
    """Return spans of time, ns of the run's clock, whose cycles are all kept.

    These are `AROUND_S` around the first `TRACED_CONTACTS` contacts and as many detections, and the first
    `ADAPTATION_S` of the first `ADAPTATIONS` adaptations.
    """
    onsets_s = [float(each.time_s[0]) for each in timed_contacts(run)]
    found_s = [(detection.t_ns - run.zero_ns) * 1e-9 for detection in find_detections(run)]
    around = [
        (at_s - AROUND_S[0], at_s + AROUND_S[1]) for at_s in (*onsets_s[:TRACED_CONTACTS], *found_s[:TRACED_CONTACTS])
    ]
    adaptations = [section for section in split_sections(run) if section.kind == "adaptation"]
    around += [(each.start_s, min(each.end_s, each.start_s + ADAPTATION_S)) for each in adaptations[:ADAPTATIONS]]
    return [(run.zero_ns + round(start_s * 1e9), run.zero_ns + round(end_s * 1e9)) for start_s, end_s in around]


_CHECKS: Final = "_checks"
"""How the field of a device's counts in /frame_checks ends."""


def _checks_of(series: Series) -> list[CheckCounts]:
    """Return the counts of a piece of /frame_checks as one element; [] if it has none."""
    devices = tuple(name.removesuffix(_CHECKS) for name in series.fields if name.endswith(_CHECKS))
    if not len(series) or not devices:
        return []
    counts = np.stack([series[device + _CHECKS].astype(np.int64) for device in devices], axis=1)
    return [CheckCounts(devices, series["cycle"].astype(np.int64), counts)]


def _joined(parts: list[CheckCounts]) -> CheckCounts | None:
    if not parts:
        return None
    cycle = np.concatenate([part.cycle for part in parts])
    return CheckCounts(parts[0].devices, cycle, np.concatenate([part.counts for part in parts]))


class TruthClock:
    """Finds the host's time, `t_ns`, of each row of the truth, as the log is read: interpolated between its cycles."""

    def __init__(self, truth: TruthTable) -> None:
        self._cycle, self._attempt = truth.rows.cycle, truth.rows.attempt
        self.t_ns = np.zeros(len(self._cycle), np.int64)
        self._pending = np.arange(len(self._cycle))
        self._before: tuple[int, int] | None = None  # cycle and time of the last row before the piece

    def place_rows(self, scheme: Series, begins: Cycles) -> tuple[Rows, Cycles]:
        """Set the times of the truth's rows that fall into a piece of the log; return these rows and their host cycles.

        Each row is returned once. begins: first host cycle of each attempt so far.
        """
        cycle, t_ns = scheme.records["cycle"].astype(np.int64), scheme.t_ns
        pending = self._pending
        known = host_cycles(self._cycle[pending], self._attempt[pending], begins)
        is_told = (self._attempt[pending] < len(begins)) & (known <= cycle[-1])
        rows, cycles = pending[is_told], known[is_told]
        self.t_ns[rows] = self._times_ns(cycles, cycle, t_ns)
        self._pending = pending[~is_told]
        self._before = int(cycle[-1]), int(t_ns[-1])
        return rows, cycles

    def _times_ns(self, wanted: Cycles, cycle: Cycles, t_ns: Cycles) -> Cycles:
        if self._before is not None:
            cycle, t_ns = np.append(self._before[0], cycle), np.append(self._before[1], t_ns)
        since_ns = np.interp(wanted, cycle, (t_ns - t_ns[0]).astype(np.float64))
        return np.asarray(t_ns[0] + np.rint(since_ns).astype(np.int64))


_PLAIN: Final = ("state", "fault", "contact_joints", "tau_ext_hat", "tau_ext_hat_cad", "theta_hat", "threshold")
_MOTION: Final = ("q", "dq", "tau_J")
_CERTIFIED: Final = ("tau_ext_bank", "threshold_bank", "theta_further", "theta_std", "promotions")
_PAPER: Final = ("paper_is_armed", "paper_tau_ext_hat", "paper_threshold")
_FIELDS: Final = ("cycle", *_PLAIN, *_MOTION, *_CERTIFIED, *_PAPER)
_ROOM: Final = 1 << 16
"""Rows to allocate at first."""


class KeptRows:
    """Rows of a topic, gathered piece by piece: only the fields that a report reads, of a long run only some rows.

    One block of memory holds them: columns that are gathered apart and joined at the end need the memory twice, and
    fragment it. `index`: number of a row among all that were read; `is_kept`: never dropped.
    """

    def __init__(self, empty: Series, fields: Sequence[str], most_buckets: int) -> None:
        self.bucket = 1
        """Cycles of a bucket, of which there are at most `most_buckets`."""
        self._fields, self._most_buckets = fields, most_buckets
        self.count = 0
        self.cycles = 0
        """All that were read, of which `count` are here."""
        self._begin(empty)

    def _begin(self, scheme: Series) -> None:
        """Allocate the block of rows with those of the wanted fields that `scheme` has; rows so far are lost."""
        names = [name for name in self._fields if name in scheme.fields]
        own = [("t_ns", np.dtype(np.int64)), ("index", np.dtype(np.int64)), ("is_kept", np.dtype(np.bool_))]
        fields = [*own, *((name, scheme.records.dtype[name]) for name in names)]
        self.names = names
        self._rows = np.empty(_ROOM, np.dtype(fields, align=True))

    def add_records(self, scheme: Series, kept: Rows | list[int]) -> None:
        """Append the records of a piece of the topic. kept: numbers of its rows that are never dropped."""
        if self.count == 0:
            self._begin(scheme)  # only a record shows the fields of a log
        end = self.count + len(scheme)
        if end > len(self._rows):
            more = np.empty(max(end, 2 * len(self._rows)), self._rows.dtype)
            more[: self.count] = self._rows[: self.count]
            self._rows = more
        here = self._rows[self.count : end]
        here["t_ns"] = scheme.t_ns
        here["index"] = np.arange(self.cycles, self.cycles + len(scheme))
        here["is_kept"] = False
        here["is_kept"][kept] = True
        for name in self.names:
            here[name] = scheme.records[name]
        self.count = end
        self.cycles += len(scheme)

    def column(self, name: str) -> NDArray[Any]:
        """Return a column (n,), as a view that the next piece or `thin` makes invalid."""
        return self._rows[name][: self.count]

    def thin(
        self,
        first: int,
        end: int,
        curves: Callable[[slice], Iterable[NDArray[np.float64]]],
        around_ns: Sequence[Bounds] = (),
        noise_cycles: int = 0,
    ) -> int:
        """Drop the rows from `first` to before `end` in which no curve is smallest or largest in its bucket.

        Buckets double once there are more than `most_buckets`; then rows before `first` are thinned, too. curves:
        returns the curves (k,) of k rows. Rows that `add_records` marked as kept, and those within `around_ns`, first
        and last ns each, are never dropped; in every `_NOISE_BUCKETS`-th bucket the first `noise_cycles` are left, too.
        Return the number of dropped rows.
        """
        while self.cycles > self._most_buckets * self.bucket:
            first, self.bucket = 0, 2 * self.bucket
        rows = slice(first, end)
        t_ns, index, is_kept = (self.column(name)[rows] for name in ("t_ns", "index", "is_kept"))
        for start_ns, end_ns in around_ns:
            is_kept[np.searchsorted(t_ns, start_ns) : np.searchsorted(t_ns, end_ns, side="right")] = True
        is_left = is_kept | (index % (_NOISE_BUCKETS * self.bucket) < noise_cycles)
        is_left[extreme_rows(curves(rows), np.flatnonzero(np.diff(index // self.bucket, prepend=-1)))] = True
        left = np.delete(self._rows[: self.count], first + np.flatnonzero(~is_left))
        dropped, self.count = self.count - len(left), len(left)
        self._rows[: self.count] = left
        return dropped

    def run(self, shell: Run, rows: slice = slice(None)) -> Run:
        """Return a run with the cycles of the gathered rows, of those in the slice `rows` only.

        shell: a run without cycles; it gives all other fields, such as settings and motion start.
        """
        columns = {name: self.column(name)[rows] for name in ("t_ns", *self.names)}
        return replace(shell, **_arrays(columns, shell.settings))


def _arrays(columns: dict[str, NDArray[Any]], settings: Settings) -> dict[str, Any]:
    """Return those fields of `Run`, by name, that come from columns of /scheme.

    Fields of schemes that the log lacks are left out.
    """
    arrays: dict[str, Any] = {name: columns[name] for name in _PLAIN}
    arrays |= {"cycle": columns["cycle"].astype(np.int64), "t_ns": columns["t_ns"]}
    arrays["motion"] = MeasuredMotion(*(columns[name] for name in _MOTION))
    if "tau_ext_bank" in columns:
        shape = (-1, settings.channel_count, JOINTS)
        arrays["certified"] = CertifiedStream(
            tau_ext=columns["tau_ext_bank"].reshape(shape),
            threshold=columns["threshold_bank"].reshape(shape),
            theta_further=columns["theta_further"],
            theta_std=columns["theta_std"],
            promotions=columns["promotions"],
        )
    if "paper_is_armed" in columns:
        arrays["beside"] = PaperStream(
            is_armed=columns["paper_is_armed"] > 0.5,
            tau_ext_hat=columns["paper_tau_ext_hat"],
            threshold=columns["paper_threshold"],
        )
    return arrays


def _widened(run: Run, shell: Run, stretch: TimeWindow, start_ns: int) -> tuple[Run, Bounds]:
    """Widen a stretch so that it cuts no true contact, reaction or adaptation.

    Return `shell` for reading it, and its bounds, ns.

    run: has the cycles in which contacts and adaptations begin or end. start_ns: beginning of the log. The returned run
    has motion start, truth and stretch.
    """
    zero_ns = run.zero_ns
    motion_start_s = (zero_ns - start_ns) * 1e-9
    first_s, last_s = ((bound_ns - zero_ns) * 1e-9 for bound_ns in stretch.bounds_ns(start_ns))
    found, busy = stretch, sorted(_busy(run))
    for begin_s, end_s in reversed(busy):
        if begin_s < first_s < end_s:
            first_s, found = begin_s, found._replace(start_s=motion_start_s + begin_s)
    for begin_s, end_s in busy:
        if begin_s < last_s < end_s:
            last_s, found = end_s, found._replace(end_s=motion_start_s + end_s)
    begun_s = [float(each.time_s[0]) for each in timed_contacts(run)]
    if run.truth is None:
        begun_s = [(detection.t_ns - zero_ns) * 1e-9 for detection in find_detections(run)]
    known = StretchOfRun(stretch, found, sum(at_s < first_s for at_s in begun_s), motion_start_s)
    truth = run.truth
    if truth is not None:
        truth = truth_rows(truth, (truth.time_s >= first_s) & (truth.time_s < last_s))
    return replace(shell, zero_ns=zero_ns, truth=truth, stretch=known), found.bounds_ns(start_ns)


def _busy(run: Run) -> Iterator[tuple[float, float]]:
    """Yield start and end, s since motion start, of each true contact and each stay in a state of `BUSY`.

    A margin before and the settling time after are included.
    """
    later_s = SETTLING_TIME_CONSTANTS / run.settings.cutoff_rad_s
    for stay in stays_of(run):
        if stay.state in BUSY:
            yield stay.start_s - MARGIN_S, stay.end_s + later_s
    for contact in timed_contacts(run):
        yield float(contact.time_s[0]) - MARGIN_S, float(contact.time_s[-1]) + later_s
