"""Two runs beside each other: settings, decisions field by field, states, contacts, parameters, timing.

Cycles are compared that lie equally long after *motion start*, the first cycle in ADAPT; where there is none, after the
first of the log. Contacts are matched by the time of their detection since then.
"""

import math
from bisect import bisect_left
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.analysis.replay.run_digest import Detection, RunDigest, RunReader
from adacd_hil.analysis.replay.what_if import changed_keys
from adacd_hil.log.log_files import LogError
from adacd_hil.log.reader import begin_of_log
from adacd_hil.log.time_window import WHOLE, TimeWindow

PROGRESS_CYCLES: Final = 1_000_000
MATCH_S: Final = 0.5
"""Detections of one contact in two runs lie closer together than this."""


class FieldDifference(NamedTuple):
    """A field of /scheme that differs: first where, s since motion start, in how many cycles, and by how much at most.

    largest: 0.0 for values that are named, infinite where one is not a number and the other is.
    """

    field: str
    first_cycle: int
    first_s: float
    cycles: int
    largest: float

    def as_json(self) -> dict[str, Any]:
        """Give it in plain values; `largest` is None where it is infinite."""
        return self._asdict() | {"largest": self.largest if math.isfinite(self.largest) else None}


class ContactPair(NamedTuple):
    """A contact in both runs, or in one."""

    first: Detection | None
    second: Detection | None


@dataclass(frozen=True)
class LogComparison:
    """How two runs differ. settings, metadata: by key, both values. cycles: compared, of `only` in one of them.

    stretch: of the first log, to which all but settings and metadata is limited.
    """

    first: RunDigest
    second: RunDigest
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
        """Whether both runs decided the same in the same cycles."""
        return not self.fields and self.only == (0, 0)

    def as_json(self) -> dict[str, Any]:
        """Give it in plain values."""
        runs = [
            {
                "log": str(run.path),
                "cycles": run.cycles,
                "problem": run.problem,
                "states": run.states,
                "parameters": run.parameters,
                "timing_us": run.timing_us,
            }
            for run in (self.first, self.second)
        ]
        return {
            **self.stretch.as_json(),
            "runs": runs,
            "is_same": self.is_same,
            "settings": self.settings,
            "metadata": self.metadata,
            "cycles": self.cycles,
            "only": list(self.only),
            "fields": [field.as_json() for field in self.fields],
            "contacts": [{"first": a and a._asdict(), "second": b and b._asdict()} for a, b in self.contacts],
            "notes": list(self.notes),
        }


class _Differences:
    """Counts what differs, field by field."""

    def __init__(self, period_s: float, zero_cycle: int) -> None:
        self.found: dict[str, FieldDifference] = {}
        self.missing: set[str] = set()
        self._period_s = period_s
        self._zero_cycle = zero_cycle

    def take(self, first: NDArray[Any], second: NDArray[Any], since: NDArray[np.int64]) -> None:
        """Compare rows of equal cycles since motion start (n,)."""
        names, others = _fields(first), _fields(second)
        self.missing |= set(names) ^ set(others)
        for name in names:
            if name in others:
                self._compare(name, first[name], second[name], since)

    def _compare(self, name: str, first: NDArray[Any], second: NDArray[Any], since: NDArray[np.int64]) -> None:
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
    first: Path, second: Path, progress: Callable[[str], None] = lambda _: None, stretch: TimeWindow = WHOLE
) -> LogComparison:
    """Compare two logs. Raises LogError, ConfigError.

    stretch: of the first log; of the second the cycles that lie equally long after its motion start. LogError is also
    raised when one of them has none.
    """
    readers = RunReader(first), RunReader(second)
    period_s = readers[0].settings.bus.period_s
    if not stretch.is_whole:
        since_ns = [bound_ns - readers[0].zero_ns for bound_ns in stretch.bounds_ns(begin_of_log(first))]
        bounds = [math.ceil(bound_ns * 1e-9 / period_s - 1e-6) for bound_ns in since_ns]
        for reader in readers:
            reader.only(*bounds)
    differences = _Differences(period_s, readers[0].zero_cycle)
    cycles, only = _walk_together(readers, differences, progress)
    one, two = (reader.digest() for reader in readers)
    for run in (one, two):
        if not stretch.is_whole and not run.cycles:
            raise LogError(f"log {run.path} has no cycle {stretch.text}")
    keys = [*one.metadata, *(key for key in two.metadata if key not in one.metadata)]
    metadata = {key: (one.metadata.get(key, ""), two.metadata.get(key, "")) for key in keys}
    notes = [f"{run.path}: {run.problem}" for run in (one, two) if run.problem]
    if differences.missing:
        notes.append(f"not in both, or not of one size: {', '.join(sorted(differences.missing))}")
    return LogComparison(
        one,
        two,
        changed_keys(one.settings, two.settings),
        {key: pair for key, pair in metadata.items() if pair[0] != pair[1]},
        tuple(sorted(differences.found.values(), key=lambda field: (field.first_s, field.field))),
        tuple(match_contacts(one.contacts, two.contacts)),
        cycles,
        only,
        tuple(notes),
        stretch,
    )


def _walk_together(
    readers: tuple[RunReader, RunReader], differences: _Differences, progress: Callable[[str], None]
) -> tuple[int, tuple[int, int]]:
    """Compare what both logs have; return how many cycles that were, and how many only one of them has."""
    streams = iter(readers[0]), iter(readers[1])
    first, second = (_next_rows(stream) for stream in streams)
    common = told = 0
    while first is not None and second is not None:
        mine, theirs = (
            rows["cycle"].astype(np.int64) - reader.zero_cycle
            for rows, reader in zip((first, second), readers, strict=True)
        )
        end = min(mine[-1], theirs[-1])
        numbers, ours, others = np.intersect1d(mine, theirs, return_indices=True)
        common += len(numbers)
        if len(numbers):
            differences.take(first[ours], second[others], numbers)
        if common - told >= PROGRESS_CYCLES:
            told = common
            progress(f"{common} cycles compared")
        first = first[mine > end] if mine[-1] > end else _next_rows(streams[0])
        second = second[theirs > end] if theirs[-1] > end else _next_rows(streams[1])
    for stream in streams:
        for _ in stream:
            progress(f"{common} cycles compared")
    return common, (readers[0].cycles - common, readers[1].cycles - common)


def _next_rows(stream: Iterator[NDArray[Any]]) -> NDArray[Any] | None:
    """Return the next rows that there are; None at the end."""
    return next((rows for rows in stream if len(rows)), None)


def match_contacts(first: list[Detection], second: list[Detection]) -> list[ContactPair]:
    """Match detections by time, the nearest ones first; what has no counterpart stands alone. In order of time."""
    order = sorted(range(len(second)), key=lambda k: second[k].time_s)
    times_s = [second[k].time_s for k in order]
    distances = []
    for i, a in enumerate(first):
        for place in range(bisect_left(times_s, a.time_s - MATCH_S), len(order)):
            if times_s[place] - a.time_s > MATCH_S:
                break
            distances.append((abs(a.time_s - times_s[place]), i, order[place]))
    partner: dict[int, int] = {}
    taken: set[int] = set()
    for distance, i, k in sorted(distances):
        if distance <= MATCH_S and i not in partner and k not in taken:
            partner[i] = k
            taken.add(k)
    pairs = [ContactPair(a, second[partner[i]] if i in partner else None) for i, a in enumerate(first)]
    pairs += [ContactPair(None, b) for k, b in enumerate(second) if k not in taken]
    return sorted(pairs, key=lambda pair: min(each.time_s for each in pair if each is not None))
