"""The timing evidence of a page: its tables."""

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from adacd_hil.analysis.histogram import LOW_PERCENTILE_NAMES, PERCENTILE_NAMES
from adacd_hil.analysis.report.page import Cell, Table, make_table
from adacd_hil.analysis.report.words import NONE, number_text
from adacd_hil.analysis.timing import OLDEST_CYCLES, QUANTITIES, Quantity, TimingEvidence

_ABSENT: Final = "not in this log"
_COUNTS: Final = {
    "overruns": "periods skipped (overruns)",
    "frames_missing": "cyclic frames missing or refused",
    "commands_late": "commands late: act one SYNC later",
    "frames_lost": "received frames dropped by the kernel",
}
_QUEUES: Final = {
    "receive": "receive queue of the bus",
    "transmit": "transmit queue of the bus",
    "log": "queue to the log's writer",
}


class TimingTables(NamedTuple):
    """The tables; queues: None where there are none. is_modelled: times are those of a model."""

    is_modelled: bool
    times: Table
    counts: Table
    queues: Table | None
    ages: Table


def timing_tables(evidence: TimingEvidence) -> TimingTables | None:
    """Make the tables: percentiles, counts, queues and ages. None without a cycle."""
    if not evidence.cycles:
        return None
    return TimingTables(
        is_modelled=evidence.is_modelled,
        times=_times_table(evidence),
        counts=_counts_table(evidence),
        queues=None if evidence.is_modelled else _queues_table(evidence),
        ages=_ages_table(evidence),
    )


def _times_table(evidence: TimingEvidence) -> Table:
    """Make a row per time; slack at the end under a head of its own, because its small values are the bad ones."""
    reserves = [quantity for quantity in QUANTITIES if quantity.is_reserve]
    rows = [_time_row(quantity, evidence, PERCENTILE_NAMES) for quantity in QUANTITIES if not quantity.is_reserve]
    reaction = evidence.reaction
    if reaction is not None:
        words = f"{reaction.count} reaction{'' if reaction.count == 1 else 's'}"
        label = ("Reaction", f"detection decision to first reaction frame, {words}")
        rows.append((label, *_values(reaction.percentiles, PERCENTILE_NAMES)))
    head = [None, *(Cell(name, "head") for name in LOW_PERCENTILE_NAMES)]
    rows += [head, *(_time_row(quantity, evidence, LOW_PERCENTILE_NAMES) for quantity in reserves)]
    return make_table(("µs", *PERCENTILE_NAMES), rows)


def _time_row(quantity: Quantity, evidence: TimingEvidence, names: Sequence[str]) -> Sequence[object]:
    label = (quantity.title, quantity.meaning)
    statistics = evidence.times[quantity.name]
    if statistics is None:
        reason = NONE if evidence.is_modelled and quantity.name == "lateness" else _ABSENT
        return (label, *[""] * (len(names) - 1), reason)
    cells: list[object] = [*_values(statistics.percentiles, names)]
    if quantity.is_reserve and statistics.percentiles.get("min", 0.0) < 0.0:
        cells[-1] = Cell(cells[-1], "bad")
    return (label, *cells)


def _values(found: Mapping[str, float], names: Sequence[str]) -> list[str]:
    return [number_text(found.get(name), 1) for name in names]


def _counts_table(evidence: TimingEvidence) -> Table:
    rows: list[Sequence[object]] = []
    for name, words in _COUNTS.items():
        count = evidence.counts[name]
        if count is None:
            rows.append((words, "", _ABSENT))
            continue
        rows.append((words, Cell(count.total, "bad" if count.total else ""), number_text(count.per_100000, 1)))
    return make_table((f"in {evidence.cycles} cycles", "count", "per 100 000"), rows)


def _queues_table(evidence: TimingEvidence) -> Table:
    rows: list[Sequence[object]] = []
    for name, words in _QUEUES.items():
        depth = evidence.queues_bytes[name]
        values = ["", _ABSENT] if depth is None else [number_text(depth.get(key), 0) for key in ("p99", "max")]
        rows.append((words, *values))
    return make_table(("bytes", "p99", "max"), rows)


def _ages_table(evidence: TimingEvidence) -> Table:
    ages = evidence.data_age
    head = ("age of the oldest value used", "cycles", "share")
    if ages is None:
        return make_table(head, [("", "", _ABSENT)])
    labels = [f"{age}" if age < OLDEST_CYCLES else f"{age} or more" for age in range(len(ages))]
    shares = zip(labels, ages, strict=True)
    rows = [(label, str(count), f"{100.0 * count / evidence.cycles:.3f} %") for label, count in shares if count]
    return make_table(head, rows)
