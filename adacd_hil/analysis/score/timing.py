"""Timing evidence: wake-up lateness, times within the cycle, slack, data age, queue depths and losses.

All values come from the columns of /cycle, records.CycleRecord. Percentiles are values that occurred: of what must be
small p50, p99, p99.9 and the largest; of slack, which must be large, p50, p1, p0.1 and the smallest. *Reaction latency*
is the compute time of each cycle in which the state becomes REACT: from the data that decided to the first command that
reacts.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from adacd_hil.analysis.logged_run import COMPUTE, LATENESS, QUANTITIES, CycleColumns, Cycles, Quantity
from adacd_hil.analysis.score.distribution import EXACT, Distribution, LogHistogram, log_histogram
from adacd_hil.analysis.score.metrics import Count, ReactionLatency, TimeStatistics, TimingEvidence
from adacd_hil.records import SchemeState

OLDEST_CYCLES: Final = 10
"""Data ages from here on are counted as one."""
PER_CYCLES: Final = 100_000
"""Counts are given per so many cycles, too."""


QUEUES: Final = {"receive": "receive_queue_bytes", "transmit": "transmit_queue_bytes", "log": "log_queue_bytes"}
"""Queues and their columns."""
_RUNNING: Final = ("overruns", "frames_lost")
"""Columns that count since the run began."""
_PER_CYCLE: Final = ("frames_missing", "commands_late")
"""Columns that count within a cycle."""


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
            reaction=None if reactions is None else ReactionLatency(reactions.count, reactions.percentiles()),
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
