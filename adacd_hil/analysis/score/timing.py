"""Timing evidence: wake-up lateness, times within the cycle, slack, data age, queue depths and what was lost.

All from the columns of /cycle, records.CycleRecord. Percentiles are values that occurred: of what must be small p50,
p99, p99.9 and the largest; of slack, which must be large, p50, p1, p0.1 and the smallest. *Reaction latency* is the
compute time of each cycle in which the state becomes REACT: from the data that decided to the first command that
reacts.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.analysis.score.distribution import EXACT, Distribution, LogHistogram, log_histogram
from adacd_hil.log.reader import Series
from adacd_hil.records import CycleRecord, SchemeState, Vector

Cycles = NDArray[np.int64]

OLDEST_CYCLES: Final = 10
"""Data ages from here on are counted as one."""
PER_CYCLES: Final = 100_000
"""Counts are given per so many cycles, too."""


class Quantity(NamedTuple):
    """A time of each cycle: its column in /cycle, ns. `is_reserve`: it must be large, not small."""

    name: str
    column: str
    title: str
    meaning: str
    is_reserve: bool = False


LATENESS: Final = Quantity("lateness", "lateness_ns", "Lateness", "wake-up after the grid point")
COMPUTE: Final = Quantity("compute", "compute_ns", "Compute", "last cyclic frame received to last command handed over")
SYNC_TO_COMMAND: Final = Quantity(
    "sync_to_command", "command_ns", "SYNC → command", "SYNC sent to last command handed over"
)
SLACK: Final = Quantity(
    "slack", "slack_ns", "Slack", "last command to the next grid point; negative: overrun", is_reserve=True
)
QUANTITIES: Final = (
    LATENESS,
    Quantity("sync_to_feedback", "feedback_ns", "SYNC → feedback", "SYNC sent to last cyclic frame decoded"),
    COMPUTE,
    SYNC_TO_COMMAND,
    SLACK,
)
QUEUES: Final = {"receive": "receive_queue_bytes", "transmit": "transmit_queue_bytes", "log": "log_queue_bytes"}
"""Queues and their columns."""
_RUNNING: Final = ("overruns", "frames_lost")
"""Columns that count since the run began."""
_PER_CYCLE: Final = ("frames_missing", "commands_late")
"""Columns that count within a cycle."""


@dataclass(frozen=True)
class CycleColumns:
    """The columns of /cycle over n cycles, int64 (n,); a column that the log does not have is not in `columns`."""

    t_ns: Cycles
    columns: Mapping[str, Cycles]

    def __len__(self) -> int:
        return self.t_ns.size

    def __getitem__(self, name: str) -> Cycles:
        return self.columns[name]

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def rows(self, rows: Cycles) -> "CycleColumns":
        """Give some of the cycles."""
        return CycleColumns(self.t_ns[rows], {name: column[rows] for name, column in self.columns.items()})

    @staticmethod
    def joined(parts: "Sequence[CycleColumns]") -> "CycleColumns":
        """Put parts with the same columns one after the other."""
        names = parts[0].columns
        columns = {name: np.concatenate([part.columns[name] for part in parts]) for name in names}
        return CycleColumns(np.concatenate([part.t_ns for part in parts]), columns)

    def times_us(self, quantity: Quantity) -> Vector | None:
        """Give a time of the cycles that have it, µs; None where the log does not have it."""
        if quantity.column not in self:
            return None
        values_ns = self[quantity.column]
        if quantity.column == "feedback_ns":
            values_ns = values_ns[self["frames_missing"] == 0]  # else it is when the host gave up
        return np.asarray(values_ns / 1000.0, dtype=np.float64)

    def steps(self, name: str, before: int = 0) -> Cycles:
        """Give what each cycle added to a running count (n,); a count that began anew begins at 0.

        before: the count in the cycle before the first.
        """
        count = self[name]
        added = np.diff(count, prepend=before)
        return np.where(added < 0, count, added)


def columns_of_series(series: Series) -> CycleColumns:
    """Take the columns out of a log's /cycle; one of an older version lacks some."""
    names = [name for name in CycleRecord._fields if name in series.fields]
    return CycleColumns(series.t_ns, {name: series[name].astype(np.int64) for name in names})


def columns_of_records(t_ns: Sequence[int], records: Sequence[CycleRecord]) -> CycleColumns:
    """Make the columns of records at times t_ns."""
    table = np.array(records, dtype=np.int64).reshape(len(records), len(CycleRecord._fields))
    columns = {name: table[:, place].copy() for place, name in enumerate(CycleRecord._fields)}
    return CycleColumns(np.array(t_ns, dtype=np.int64), columns)


@dataclass(frozen=True)
class TimeStatistics:
    """Percentiles by name, µs, and the histogram of a time; both empty without a value."""

    percentiles: Mapping[str, float]
    histogram: LogHistogram


class Count(NamedTuple):
    """How often something happened, in all and per 100 000 cycles; None without a cycle."""

    total: int
    per_100000: float | None


@dataclass(frozen=True)
class Reaction:
    """Latency from the decision to the first command that reacts, over `count` reactions; percentiles in µs."""

    count: int
    percentiles: Mapping[str, float]


@dataclass(frozen=True)
class TimingEvidence:
    """What the times of a run come to; None is what the log does not have, or what lockstep has no meaning for.

    is_modelled: lockstep, the times are those of the model of bus and host, not of this machine. data_age: cycles by
    the age of the oldest value used; the last entry counts all from OLDEST_CYCLES on.
    """

    period_us: float
    is_modelled: bool
    cycles: int
    times: Mapping[str, TimeStatistics | None]
    reaction: Reaction | None
    data_age: tuple[int, ...] | None
    queues_bytes: Mapping[str, Mapping[str, float] | None]
    counts: Mapping[str, Count | None]

    def as_json(self) -> dict[str, Any]:
        """Give the evidence in plain values."""
        times = {name: found for name, found in self.times.items() if found is not None}
        absent = dict.fromkeys(self.times)
        reaction = self.reaction
        return {
            "is_modelled": self.is_modelled,
            "period_us": self.period_us,
            "cycles": self.cycles,
            "times_us": {**absent, **{name: dict(found.percentiles) for name, found in times.items()}},
            "reaction_us": None if reaction is None else {"count": reaction.count, **reaction.percentiles},
            "data_age_cycles": None if self.data_age is None else list(self.data_age),
            "queues_bytes": {name: None if depth is None else dict(depth) for name, depth in self.queues_bytes.items()},
            "counts": {name: None if count is None else count._asdict() for name, count in self.counts.items()},
            "histograms_us": {**absent, **{name: found.histogram.as_json() for name, found in times.items()}},
        }


class TimingGatherer:
    """Sums up /cycle piece by piece, in bounded memory; `exact` as in `Distribution`."""

    def __init__(self, period_us: float, is_modelled: bool, exact: int = EXACT) -> None:
        self._period_us = period_us
        self._is_modelled = is_modelled
        self._exact = exact
        self._cycles = 0
        self._times: dict[str, Distribution] = {}
        self._histograms: dict[str, LogHistogram] = {}
        self._depths: dict[str, Distribution] = {}
        self._ages: Cycles | None = None
        self._totals: dict[str, int] = {}
        self._last: dict[str, int] = {}  # value of each running count
        self._reactions: Distribution | None = None

    def add(self, columns: CycleColumns, reactions: NDArray[np.bool_] | None = None) -> None:
        """Take in the next cycles. reactions: see `collect_evidence`."""
        self._cycles += len(columns)
        for quantity in QUANTITIES:
            self._add_times(quantity, columns)
        for name, column in QUEUES.items():
            if column in columns and not self._is_modelled:  # lockstep has no queues
                self._depths.setdefault(name, Distribution(self._exact)).add(columns[column])
        if "data_age" in columns:
            ages = np.bincount(np.minimum(columns["data_age"], OLDEST_CYCLES), minlength=OLDEST_CYCLES + 1)
            self._ages = ages if self._ages is None else self._ages + ages
        for name in (name for name in (*_RUNNING, *_PER_CYCLE) if name in columns):
            added = columns.steps(name, self._last.get(name, 0)) if name in _RUNNING else columns[name]
            self._totals[name] = self._totals.get(name, 0) + int(added.sum())
            if len(columns):
                self._last[name] = int(columns[name][-1])
        if reactions is not None and (compute_us := columns.times_us(COMPUTE)) is not None:
            self._reactions = self._reactions or Distribution(self._exact)
            self._reactions.add(compute_us[reactions])

    def _add_times(self, quantity: Quantity, columns: CycleColumns) -> None:
        values_us = columns.times_us(quantity)
        if values_us is None or (self._is_modelled and quantity is LATENESS):  # lockstep has no grid to be late on
            return
        self._times.setdefault(quantity.name, Distribution(self._exact)).add(values_us)
        found = log_histogram(values_us)
        before = self._histograms.get(quantity.name)
        self._histograms[quantity.name] = found if before is None else before.joined(found)

    def evidence(self) -> TimingEvidence:
        """Sum up what has been taken in."""
        reactions = self._reactions
        return TimingEvidence(
            period_us=self._period_us,
            is_modelled=self._is_modelled,
            cycles=self._cycles,
            times={quantity.name: self._statistics(quantity) for quantity in QUANTITIES},
            reaction=None if reactions is None else Reaction(reactions.count, reactions.percentiles()),
            data_age=None if self._ages is None else tuple(self._ages.tolist()),
            queues_bytes={name: self._depths[name].percentiles() if name in self._depths else None for name in QUEUES},
            counts={name: self._count(name) for name in (*_RUNNING, *_PER_CYCLE)},
        )

    def _statistics(self, quantity: Quantity) -> TimeStatistics | None:
        values = self._times.get(quantity.name)
        if values is None:
            return None
        found = values.low_percentiles() if quantity.is_reserve else values.percentiles()
        return TimeStatistics(found, self._histograms[quantity.name])

    def _count(self, name: str) -> Count | None:
        if name not in self._totals:
            return None
        total = self._totals[name]
        return Count(total, total * PER_CYCLES / self._cycles if self._cycles else None)


def collect_evidence(
    columns: CycleColumns, period_us: float, is_modelled: bool, reactions: NDArray[np.bool_] | None = None
) -> TimingEvidence:
    """Sum up the columns. reactions: the cycles in which the state becomes REACT (n,); None where there is no state."""
    gatherer = TimingGatherer(period_us, is_modelled)
    gatherer.add(columns, reactions)
    return gatherer.evidence()


def find_reactions(
    columns: CycleColumns, cycle: Cycles, state: NDArray[np.uint8], before: int = SchemeState.INIT
) -> NDArray[np.bool_]:
    """Mark the cycles of `columns` in which the state becomes REACT; cycle, state: those of /scheme (k,).

    before: the state in the cycle before the first.
    """
    is_reacting = state == SchemeState.REACT
    begins = is_reacting & ~np.concatenate(([before == SchemeState.REACT], is_reacting[:-1]))
    return np.isin(columns["cycle"], cycle[begins])
