"""Two runs beside each other: settings, decisions field by field, states, contacts, parameters, timing.

The comparison pairs cycles that lie equally long after *motion start*, the first cycle in ADAPT; in a log without one,
after its first cycle. It matches contacts by the time of their detection since then. It reads logs in pieces and
keeps a digest of each run.
"""

import math
from bisect import bisect_left
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.lab.score.run_arrays import columns_of_series, last_cycle
from adacd_hil.log.log_files import LogError
from adacd_hil.log.logged_run import Milestones, Progress, settings_of
from adacd_hil.log.reader import LogStream, Series, begin_of_log, each_once, report_values
from adacd_hil.log.time_window import WHOLE, TimeWindow
from adacd_hil.log.types.topics import CONTACT, CYCLE, SCHEME
from adacd_hil.records import MOTION_START, ContactReport, SchemeState
from adacd_hil.score.distribution import Distribution
from adacd_hil.settings.setting_keys import changed_keys

_TOPICS: Final = (SCHEME.name, CYCLE.name, CONTACT.name)
_TIMES: Final = ("lateness_ns", "feedback_ns", "command_ns", "compute_ns", "slack_ns")
_NOT_METADATA: Final = ("epoch_ns",)


Contact = tuple[float, ContactReport]
"""When a contact was found, s since motion start, and its last report, with the log's own numbers for its enums."""


class RunReader:
    """One of the compared logs. Iterate once for its records of /scheme; then its figures are complete.

    zero_cycle, zero_ns: of motion start. states: (s since motion start, name) of each entered one. parameters: by name,
    theta_hat at each entry of MONITOR, else at the end. problem: known after the iteration.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.zero_cycle, self.zero_ns = _motion_start(path)
        self._stream = LogStream(path, _TOPICS)
        self.settings = settings_of(path, self._stream.attachments)
        self.metadata = {key: value for key, value in self._stream.metadata.items() if key not in _NOT_METADATA}
        self.cycles = 0
        self.states: list[tuple[float, str]] = []
        self.parameters: dict[str, list[float]] = {}
        self._contacts: list[Contact] = []
        self.contact_fields: set[str] = set()
        """Fields of /contact in the log, which an earlier version may have written; known after the iteration."""
        self._times = {name: Distribution() for name in _TIMES}
        self._bounds: tuple[int, int] | None = None

    def only(self, first: int, end: int) -> None:
        """Limit the reading to the cycles from `first` to before `end`, counted since motion start.

        Call it before the iteration.
        """
        self._bounds = first + self.zero_cycle, end + self.zero_cycle

    def _wanted(self, series: Series) -> Series:
        """Return the records in the cycles set by `only`; all records without limits or without a field `cycle`."""
        if self._bounds is None or "cycle" not in series.fields:
            return series
        cycle = series.records["cycle"].astype(np.int64)
        return series.part((cycle >= self._bounds[0]) & (cycle < self._bounds[1]))

    def _is_over(self, series: Series) -> bool:
        """Return whether the records begin after the cycles set by `only`; False without limits or records."""
        return self._bounds is not None and bool(len(series)) and int(series.records["cycle"][0]) >= self._bounds[1]

    def __iter__(self) -> Iterator[NDArray[Any]]:
        """Yield the records of /scheme, piece by piece, and gather states, parameters, contacts and times.

        Raises LogError if the log can't be read, or as `last_cycle` and `columns_of_series`.
        """
        at = (-1, -1)
        for piece in self._stream:
            at = last_cycle(self.path, piece.series[SCHEME.name], at)
            if self._is_over(piece.series[SCHEME.name]):
                break
            scheme = self._wanted(piece.series[SCHEME.name])
            t_s = (scheme.t_ns - self.zero_ns) * 1e-9
            records = scheme.records
            self.cycles += len(records)
            for row in np.flatnonzero(records["state"] != records["previous_state"]).tolist():
                self.states.append((float(t_s[row]), _name_of(int(records["state"][row]))))
                if records["state"][row] == SchemeState.MONITOR:
                    self._keep_parameters(records[row])
            if len(records):
                last = records[-1].copy()
            contacts = self._wanted(piece.series[CONTACT.name])
            self.contact_fields.update(contacts.fields)
            times_s = ((contacts.t_ns - self.zero_ns) * 1e-9).tolist()
            reports = (ContactReport(**values) for values in report_values(contacts))  # enums stay numbers
            self._contacts = each_once((*self._contacts, *zip(times_s, reports, strict=True)))
            cycles = columns_of_series(self._wanted(piece.series[CYCLE.name]))
            for name in _TIMES:
                self._times[name].add_values(cycles[name] / 1e3)
            yield records
        if not self.parameters and self.cycles:
            self._keep_parameters(last)

    def _keep_parameters(self, record: Any) -> None:
        for name, value in zip(self.settings.estimator.parameter_names, record["theta_hat"].tolist(), strict=False):
            self.parameters.setdefault(name, []).append(value)

    @property
    def problem(self) -> str:
        """One line on damage or missing parts of the log; "" if it is whole. Known after the iteration."""
        return self._stream.problem

    @property
    def contacts(self) -> list[Contact]:
        """Each contact once, by time: (its detection, s since motion start; its last report)."""
        return sorted(self._contacts, key=lambda contact: contact[0])

    @property
    def timing_us(self) -> dict[str, dict[str, float]]:
        """Percentiles, µs, of the cycles' times read so far, by name ("lateness", …); of slack the low ones.

        {} for each without a cycle.
        """
        return {
            name.removesuffix("_ns"): times.low_percentiles() if name == "slack_ns" else times.percentiles()
            for name, times in self._times.items()
        }


def _name_of(state: int) -> str:
    return SchemeState(state).name if state in SchemeState.__members__.values() else str(state)


def _motion_start(path: Path) -> tuple[int, int]:
    """Return cycle and time `t_ns` of the log, ns, of the first cycle in ADAPT, else of the first cycle.

    Raises LogError if the log has no /scheme or can't be read.
    """
    first: tuple[int, int] | None = None
    for piece in LogStream(path, (SCHEME.name,)):
        scheme = piece.series[SCHEME.name]
        if not len(scheme):
            continue
        rows = np.flatnonzero(scheme.records["state"] == MOTION_START)
        row = int(rows[0]) if rows.size else 0
        here = int(scheme.records["cycle"][row]), int(scheme.t_ns[row])
        first = first or here
        if rows.size:
            return here
    if first is None:
        raise LogError(f"log {path} has no {SCHEME.name}")
    return first


MATCH_S: Final = 0.5
"""Detections of one contact in two runs lie closer together than this."""


class FieldDifference(NamedTuple):
    """A field of /scheme that differs between two logs. cycles: in how many it differs.

    first_cycle: of the first log; first_s: s since motion start. largest: difference; 0.0 for integers, inf where one
    value is NaN and the other isn't. A field of /contact is named "contact.<field>", counted once for each contact;
    its difference is 0.0. For a contact that only the second log has, first_cycle and first_s are of that log.
    """

    field: str
    first_cycle: int
    first_s: float
    cycles: int
    largest: float


ContactPair = tuple[Contact | None, Contact | None]
"""A contact in both runs, or in one."""


@dataclass(frozen=True)
class LogComparison:
    """How two runs differ.

    settings, metadata: both values of each key that differs. cycles: number of compared ones. only: numbers of cycles
    that just the first, and just the second log has. stretch: of the first log, to which all but settings and metadata
    is limited.
    """

    first: RunReader
    second: RunReader
    settings: dict[str, tuple[str, str]]
    metadata: dict[str, tuple[str, str]]
    fields: tuple[FieldDifference, ...]
    contacts: tuple[ContactPair, ...]
    cycles: int
    only: tuple[int, int]
    notes: tuple[str, ...]
    stretch: TimeWindow = WHOLE

    @property
    def is_same(self) -> bool:
        """Whether no field that both logs have of /scheme and /contact differs, and no cycle is in one log only.

        Settings, metadata and timing may differ. Fields that only one log has, or that differ in size, don't count;
        `notes` names them.
        """
        return not self.fields and self.only == (0, 0)

    @property
    def is_same_where_whole(self) -> bool:
        """Whether cycles were compared, no field that both logs have differs, and only damaged logs lack cycles.

        Fields that differ in size don't count, see `is_same`.
        """
        damages = self.second.problem, self.first.problem
        lacks = any(count and not damage for count, damage in zip(self.only, damages, strict=True))
        return self.cycles > 0 and not self.fields and not lacks

    def by_key(self) -> dict[str, Any]:
        """Return the comparison by the keys of `compare --json`: both runs, differences, contacts in pairs, notes."""
        runs = [
            {
                "log": run.path,
                "cycles": run.cycles,
                "problem": run.problem,
                "states": run.states,
                "parameters": run.parameters,
                "timing_us": run.timing_us,
            }
            for run in (self.first, self.second)
        ]
        return {
            **self.stretch.named_bounds,
            "runs": runs,
            "is_same": self.is_same,
            "settings": self.settings,
            "metadata": self.metadata,
            "cycles": self.cycles,
            "only": self.only,
            "fields": self.fields,
            "contacts": [{"first": _contact_json(a), "second": _contact_json(b)} for a, b in self.contacts],
            "notes": self.notes,
        }


def _contact_json(contact: Contact | None) -> dict[str, Any] | None:
    if contact is None:
        return None
    names = ("link", "level", "kind", "tau_ext_peak", "force_N", "location")
    return {"time_s": contact[0], **{name: getattr(contact[1], name) for name in names}}


class _Differences:
    """Counts the differences of two logs, field by field.

    found: by field. missing: fields that one log lacks, or that differ in size.
    """

    def __init__(self, period_s: float, zero_cycle: int) -> None:
        self.found: dict[str, FieldDifference] = {}
        self.missing: set[str] = set()
        self._period_s = period_s
        self._zero_cycle = zero_cycle

    def take(self, first: NDArray[Any], second: NDArray[Any], since: NDArray[np.int64]) -> None:
        """Compare records of the same cycles, and count differences in `found`; since (n,): cycles since motion start.

        Fields that one of both lacks, or that differ in size, are added to `missing`, not to `found`.
        """
        names, others = _fields(first), _fields(second)
        self.missing |= set(names) ^ set(others)
        for name in names:
            if name in others:
                self._compare(name, first[name], second[name], since)

    def _compare(self, name: str, first: NDArray[Any], second: NDArray[Any], since: NDArray[np.int64]) -> None:
        """Count the differences of one field in `found`; add it to `missing` if its sizes differ. NaN equals NaN.

        first, second (n, ...): its values. since (n,): cycles since motion start.
        """
        if first.shape != second.shape:
            self.missing.add(name)
            return
        is_real = first.dtype.kind == "f"
        differs = (first != second) & ~((first != first) & (second != second))  # noqa: PLR0124 (not a number)
        rows = np.flatnonzero(differs.reshape(len(first), -1).any(axis=1))
        if not rows.size:
            return
        largest = 0.0
        if is_real:
            with np.errstate(invalid="ignore"):
                off = np.abs(first[differs] - second[differs])
            largest = float(np.where(np.isnan(off), np.inf, off).max())
        row = int(rows[0])
        before = self.found.get(name)
        place = (int(since[row]) + self._zero_cycle, float(since[row]) * self._period_s)
        if before is not None:
            place = before.first_cycle, before.first_s
        count = len(rows) + (before.cycles if before else 0)
        self.found[name] = FieldDifference(name, *place, count, max(largest, before.largest if before else 0.0))


def _fields(records: NDArray[Any]) -> list[str]:
    skipped = ("record_length", "log_time", "publish_time", "sec", "nanosec", "cycle")
    return [name for name in records.dtype.names or () if name not in skipped]


def compare_logs(
    first: Path, second: Path, progress: Progress = lambda _: None, stretch: TimeWindow = WHOLE
) -> LogComparison:
    """Compare two logs: settings, metadata, the fields of /scheme cycle by cycle, and contacts.

    Cycles are paired by their number since motion start; none is if the logs' periods differ. stretch: of the first
    log; the second is read over the same time after its own motion start. progress: called with a line on the cycles
    compared. Raises LogError if a log can't be read, lacks /scheme or usable settings, or has no cycle in the stretch.
    """
    readers = RunReader(first), RunReader(second)
    one, two = readers
    if not stretch.is_whole:
        since_ns = [bound_ns - one.zero_ns for bound_ns in stretch.bounds_ns(begin_of_log(first))]
        for reader in readers:
            period_s = reader.settings.bus.period_s
            start, end = (math.ceil(bound_ns * 1e-9 / period_s - 1e-6) for bound_ns in since_ns)
            reader.only(start, end)
    differences = _Differences(one.settings.bus.period_s, one.zero_cycle)
    cycles, only = _walk_together(readers, differences, progress)
    for run in readers:
        if not stretch.is_whole and not run.cycles:
            raise LogError(f"log {run.path} has no cycle {stretch.text}")
    keys = [*one.metadata, *(key for key in two.metadata if key not in one.metadata)]
    metadata = {key: (one.metadata.get(key, ""), two.metadata.get(key, "")) for key in keys}
    notes = [f"{run.path}: {run.problem}" for run in readers if run.problem]
    periods_us = [run.settings.bus.period_us for run in readers]
    if periods_us[0] != periods_us[1]:
        notes.append(f"cycles of {periods_us[0]} µs in 1, of {periods_us[1]} µs in 2: none is paired with another")
    contacts = tuple(match_contacts(one.contacts, two.contacts))
    fields = one.contact_fields & two.contact_fields
    found = [*differences.found.values(), *_contact_differences(contacts, fields, only == (0, 0))]
    missing = {*differences.missing, *(f"contact.{name}" for name in one.contact_fields ^ two.contact_fields)}
    if missing:
        notes.append(f"not in both, or not of one size: {', '.join(sorted(missing))}")
    return LogComparison(
        one,
        two,
        changed_keys(one.settings, two.settings),
        {key: pair for key, pair in metadata.items() if pair[0] != pair[1]},
        tuple(sorted(found, key=lambda field: (field.first_s, field.field))),
        contacts,
        cycles,
        only,
        tuple(notes),
        stretch,
    )


def _walk_together(
    readers: tuple[RunReader, RunReader], differences: _Differences, progress: Progress
) -> tuple[int, tuple[int, int]]:
    """Compare the cycles that both logs have, by cycles since motion start; none if their periods differ.

    Counts into `differences`, and reads both logs to their ends, so that the readers' figures are complete. Return the
    number of compared cycles, and the numbers of cycles that only the first, and only the second log has.
    """
    streams = iter(readers[0]), iter(readers[1])
    first, second = (_next_rows(stream) for stream in streams)
    common = 0
    milestones = Milestones(lambda count: progress(f"{count} cycles compared"))
    are_paired = readers[0].settings.bus.period_us == readers[1].settings.bus.period_us
    while are_paired and first is not None and second is not None:
        mine, theirs = (
            rows["cycle"].astype(np.int64) - reader.zero_cycle
            for rows, reader in zip((first, second), readers, strict=True)
        )
        end = min(mine[-1], theirs[-1])
        numbers, ours, others = np.intersect1d(mine, theirs, return_indices=True)
        common += len(numbers)
        if len(numbers):
            differences.take(first[ours], second[others], numbers)
        milestones.reach(common)
        first = first[mine > end] if mine[-1] > end else _next_rows(streams[0])
        second = second[theirs > end] if theirs[-1] > end else _next_rows(streams[1])
    for stream in streams:
        for _ in stream:
            progress(f"{common} cycles compared")
    return common, (readers[0].cycles - common, readers[1].cycles - common)


def _next_rows(stream: Iterator[NDArray[Any]]) -> NDArray[Any] | None:
    """Return the next array of the stream that isn't empty; None at its end."""
    return next((rows for rows in stream if len(rows)), None)


def _contact_differences(
    pairs: Sequence[ContactPair], fields: Collection[str], have_same_cycles: bool
) -> Iterator[FieldDifference]:
    """Yield each of the `fields` of /contact that differs in the last reports of a contact, but not `cycle`.

    "report" stands for a contact that only one log has. Unless the logs have the same cycles, a missing report, or one
    that is final in one log only, may be lost, and is no difference.
    """
    differs: dict[str, list[Contact]] = {}
    for pair in pairs:
        first, second = pair
        if first is None or second is None:
            names = ["report"] * have_same_cycles
        elif have_same_cycles or first[1].is_final == second[1].is_final:
            texts = [(repr(getattr(first[1], name)), repr(getattr(second[1], name))) for name in ContactReport._fields]
            compared = zip(ContactReport._fields, texts, strict=True)
            names = [name for name, (one, two) in compared if one != two and name in fields and name != "cycle"]
        else:
            names = []
        for name in names:
            differs.setdefault(f"contact.{name}", []).append(next(filter(None, pair)))
    for name, contacts in differs.items():
        time_s, report = contacts[0]
        yield FieldDifference(name, report.cycle, time_s, len(contacts), 0.0)


def match_contacts(first: list[Contact], second: list[Contact]) -> list[ContactPair]:
    """Return pairs of contacts of two runs, in order of time; None in place of a missing partner.

    Contacts are partners if their detections are within MATCH_S of each other; the nearest ones are matched first.
    """
    order = sorted(range(len(second)), key=lambda k: second[k][0])
    times_s = [second[k][0] for k in order]
    distances = []
    for i, a in enumerate(first):
        for place in range(bisect_left(times_s, a[0] - MATCH_S), len(order)):
            if times_s[place] - a[0] > MATCH_S:
                break
            distances.append((abs(a[0] - times_s[place]), i, order[place]))
    partner: dict[int, int] = {}
    taken: set[int] = set()
    for distance, i, k in sorted(distances):
        if distance <= MATCH_S and i not in partner and k not in taken:
            partner[i] = k
            taken.add(k)
    pairs: list[ContactPair] = [(a, second[partner[i]] if i in partner else None) for i, a in enumerate(first)]
    pairs += [(None, b) for k, b in enumerate(second) if k not in taken]
    return sorted(pairs, key=lambda pair: min(each[0] for each in pair if each is not None))
