"""The tables of a report's page, those of the timing evidence included, those of contacts not."""

from collections.abc import Mapping, Sequence
from itertools import compress, islice
from string import ascii_letters
from typing import Final

from adacd_hil.lab.report.page import (
    ADAPTATIONS,
    SECTION_TITLES,
    SECTIONS,
    Cell,
    Table,
    has_paper,
    make_table,
    stretch_text,
)
from adacd_hil.lab.score.evaluation import OLDEST_CYCLES
from adacd_hil.lab.score.metrics import (
    CertifiedEvidence,
    ChannelMargin,
    CyclicData,
    Metrics,
    ReportSource,
    Residual,
    TimingEvidence,
)
from adacd_hil.lab.score.report_wording import number_text, pair_text, percent_text, rate_sentence, signed_text
from adacd_hil.lab.score.run_arrays import QUANTITIES, Quantity, Run
from adacd_hil.lab.score.verdict import BETA, CAD_BY_SECTION, FILTERS, FROZEN_BY_SECTION, HOLD, SMALLEST_MARGIN
from adacd_hil.printable import number_of
from adacd_hil.records import PARAMETER_UNITS
from adacd_hil.score.distribution import LOW_PERCENTILE_NAMES, PERCENTILE_NAMES
from adacd_hil.score.smallest_push import PUSH_WITHIN
from adacd_hil.score.wording import NONE

_PLAIN_NAMES: Final = {
    FROZEN_BY_SECTION[0]: "Largest unexplained torque, first detection section",
    FROZEN_BY_SECTION[1]: "Largest unexplained torque, second detection section",
    CAD_BY_SECTION[0]: "The same with the CAD model, first detection section",
    CAD_BY_SECTION[1]: "The same with the CAD model, second detection section",
    BETA: "Residual that learning must come below",
    HOLD: "How long it must stay there, or was tested",
    FILTERS: "Filter of the residual",
    SMALLEST_MARGIN: "Smallest margin: threshold over unexplained torque",
}
"""Names of quantities for readers who do not know the paper; report.json keeps the paper's."""


def paper_table(metrics: Metrics) -> Table:
    """Return the table of measured quantities; quantities without any value are left out.

    If the paper's experiment was played, the paper's values stand beside them and, for a certified run, those of its
    scheme on the same stream.
    """
    is_paper, is_certified = has_paper(metrics), metrics.evidence is not None
    columns = (True, is_paper, is_paper and is_certified, True)
    head = ("", "paper (printed)", "paper's scheme, same stream", "certified")
    if not is_certified:
        head = ("", "paper", "", "measured")
    names = {} if is_paper else _PLAIN_NAMES
    rows = [
        (names.get(row.quantity, row.quantity), row.paper, row.beside, Cell(row.measured, "strong"))
        for row in metrics.paper
        if is_paper or row.measured != NONE
    ]
    return make_table(
        list(compress(head, columns)), [list(compress(row, columns)) for row in rows], left=range(len(head))
    )


def margins_table(evidence: CertifiedEvidence | None) -> Table | None:
    """Return the table of residual, threshold and margin per section and channel; None without margins.

    Sections after the first SECTIONS are left out, except the one with the smallest margin.
    """
    if evidence is None or not evidence.margins:
        return None
    head = ("section", "filter, rad/s", "", "largest residual, Nm", "threshold, Nm", "margin")
    rows: list[Sequence[object]] = []
    for label, channels in _first_and_worst(evidence).items():
        for row in channels:
            cutoff = f"{row.cutoff_rad_s:g}"
            kind = "one filter" if row.smoothing_rad_s is None else "two filters"
            margin = Cell(pair_text(row.margin, 1), "bad" if min(row.margin) < 1.0 else "strong")
            pairs = (pair_text(row.residual_max_Nm, 3), pair_text(row.threshold_Nm, 3))
            name = Cell(label, "strong") if row is channels[0] else ""
            rows.append((name, cutoff, kind, *pairs, margin))
    return make_table(head, rows, left=(0, 2))


def push_table(evidence: CertifiedEvidence | None) -> Table | None:
    """Return the table of the smallest push found within PUSH_WITHIN and the threshold in force, by joint.

    Columns: median, a high percentile and the worst, Nm. None if the run has no certified evidence of it.
    """
    push = None if evidence is None else evidence.smallest_push
    if push is None:
        return None
    median, high, *_, worst = PERCENTILE_NAMES
    names = {median: "median", high: f"{high[1:]} %", worst: "worst"}
    rows = [
        (what, *(pair_text([joint[name] for joint in joints], 3) for name in names))
        for what, joints in (
            (f"smallest push found within {PUSH_WITHIN}, estimated", push.push_Nm),
            ("threshold in force", push.threshold_Nm),
        )
    ]
    return make_table(("joint 1 / joint 2, Nm", *names.values()), rows)


def counted_sentence(metrics: Metrics) -> str:
    """Return a sentence with the number of false alarms in MONITOR and the bound of their rate; "" without a bound."""
    bound = metrics.false_alarm_bound_per_h
    return "" if bound is None else rate_sentence(metrics.armed_false_alarms or 0, bound)


def _first_and_worst(evidence: CertifiedEvidence) -> dict[str, tuple[ChannelMargin, ...]]:
    """Return the margins of the first SECTIONS sections, and of the one with the smallest margin, by label.

    evidence: with margins of at least one section.
    """
    labels = list(evidence.margins)
    worst = min(labels, key=lambda label: min(min(row.margin) for row in evidence.margins[label]))
    shown = {*labels[:SECTIONS], worst}
    return {label: margins for label, margins in evidence.margins.items() if label in shown}


def further_table(evidence: CertifiedEvidence | None) -> Table | None:
    """Return the table of the certified scheme's parameters with their standard deviations; None without any.

    Columns are the first ADAPTATIONS adaptations.
    """
    if evidence is None or not evidence.estimates:
        return None
    estimates = dict(islice(evidence.estimates.items(), ADAPTATIONS))
    head = ["", "unit"]
    for label in estimates:
        head += [f"certified ({label})", "±"]
    rows = []
    for name in next(iter(estimates.values())):
        cells: list[object] = [_symbol(name), PARAMETER_UNITS.get(name, "Nm")]
        for found in estimates.values():
            cells += [Cell(f"{found[name].value:.3g}", "strong"), f"{found[name].std:.2g}"]
        rows.append(cells)
    return make_table(head, rows, left=(0, 1))


def sections_table(metrics: Metrics, run: Run) -> Table:
    """Return a table of the first SECTIONS sections: kind, times, largest residuals of frozen models, judged cycles."""
    threshold = run.settings.detector.threshold_Nm
    rows = []
    for section in metrics.sections[:SECTIONS]:
        residual = metrics.frozen_residual_max_Nm.get(section.label, Residual(None, None, 0))
        rows.append(
            (
                Cell(section.label, "strong"),
                SECTION_TITLES[section.kind]
                + ("" if section.is_complete or section.kind != "adaptation" else ", not finished"),
                number_text(section.start_s, 3),
                number_text(section.end_s, 3),
                number_text(section.duration_s, 3),
                _judged(residual.identified, threshold),
                _judged(residual.cad, threshold),
                str(residual.cycles) if residual.cycles else NONE,
            )
        )
    head = (
        "section", "", "from, s", "to, s", "lasts, s", "largest unexplained torque, Nm", "with the CAD model, Nm",
        "cycles judged",
    )  # fmt: skip
    return make_table(head, rows, left=(0, 1))


def _judged(values: tuple[float, float] | None, threshold: tuple[float, float]) -> Cell:
    """Return the cell of both joints' residuals, "bad" if one is over its threshold; a dash for None."""
    if values is None:
        return Cell(NONE)
    is_over = any(value > bound for value, bound in zip(values, threshold, strict=True))
    return Cell(pair_text(values, 3), "bad" if is_over else "")


def _symbol(name: str) -> tuple[str, str]:
    """Return stem and index of a parameter's name: ("F", "v1") of F_v1, ("a", "1") of a1."""
    stem, index = name.split("_", 1) if "_" in name else (name.rstrip("0123456789"), name.lstrip(ascii_letters))
    return stem, index


def parameters_table(metrics: Metrics, run: Run) -> Table | None:
    """Return the table of identified, true and CAD parameters; None without identified ones.

    Columns are those of the first ADAPTATIONS adaptations.
    """
    if not metrics.parameters:
        return None
    cad = dict(zip(run.parameter_names, run.settings.arm.cad_theta, strict=True)) if run.has_cad else {}
    head = ["", "unit", "CAD"]
    for label, payload_kg in islice(metrics.payload_kg.items(), ADAPTATIONS):
        with_payload = "" if payload_kg is None else f", {payload_kg:g} kg"
        head += [f"true ({label}{with_payload})", f"identified ({label})", "error"]
    rows = []
    for name in run.parameter_names:
        cells: list[object] = [_symbol(name), PARAMETER_UNITS[name], number_text(cad.get(name), 4)]
        for found in islice(metrics.parameters.values(), ADAPTATIONS):
            true, identified = found[name]
            error = f"{signed_text(100.0 * (identified - true) / true)} %" if true else NONE
            cells += [number_text(true, 4), Cell(number_text(identified, 4), "strong"), error]
        rows.append(cells)
    return make_table(head, rows, left=(0, 1))


def data_table(data: CyclicData) -> Table | None:
    """Return the table of shares of cyclic data that was missing, old or repeated, with the worst second.

    None without a cycle with powered drives.
    """
    if not data.cycles:
        return None
    rows: list[tuple[str, float | None, float | None]] = [
        ("cycles that lacked a frame in time", data.incomplete, data.worst_incomplete),
        ("cycles that went by older data", data.aged, None),
    ]
    for name, shares in data.devices.items():
        rows.append((f"{name}: no new data", shares.no_new_data, shares.worst_no_new_data))
        rows.append((f"{name}: repeated", shares.repeated, shares.worst_repeated))
    return make_table(("", "share", "worst second"), [(name, *map(_share, values)) for name, *values in rows])


def _share(share: float | None) -> str:
    return NONE if share is None else percent_text(share)


def origin_table(metrics: Metrics, run: Run, source: ReportSource) -> Table:
    """Return the table of a run's origin: log, number of frames and drops, stretch, and the log's metadata."""
    log = [("log", source.log_name), ("frames", metrics.frames), ("packets dropped", metrics.dropped)]
    if run.stretch is not None:
        log.append(("stretch", stretch_text(run.stretch)))
    rows = [(label, NONE if value is None else str(value)) for label, value in log]
    rows += [(key.replace("_", " "), value or NONE) for key, value in sorted(run.metadata.items())]
    return make_table(("", ""), rows, left=(0, 1))


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


def timing_tables(evidence: TimingEvidence) -> dict[str, Table | bool | None] | None:
    """Return the tables of `timing.html.j2` by name: times, counts, queues and ages; None without a cycle.

    is_modelled: the times come from a model; then "queues" is None, since it has none.
    """
    if not evidence.cycles:
        return None
    return {
        "is_modelled": evidence.is_modelled,
        "times": _times_table(evidence),
        "counts": _counts_table(evidence),
        "queues": None if evidence.is_modelled else _queues_table(evidence),
        "ages": _ages_table(evidence),
    }


def _times_table(evidence: TimingEvidence) -> Table:
    """Return the table of times, µs.

    Slack comes last, under a head of low percentiles, since its small values are bad.
    """
    reserves = [quantity for quantity in QUANTITIES if quantity.is_reserve]
    rows = [_time_row(quantity, evidence, PERCENTILE_NAMES) for quantity in QUANTITIES if not quantity.is_reserve]
    reaction = evidence.reaction
    if reaction is not None:
        label = (
            "Reaction",
            f"detection decision to first reaction frame, {number_of(int(reaction['count']), 'reaction')}",
        )
        rows.append((label, *_values(reaction, PERCENTILE_NAMES)))
    head = [None, *(Cell(name, "head") for name in LOW_PERCENTILE_NAMES)]
    rows += [head, *(_time_row(quantity, evidence, LOW_PERCENTILE_NAMES) for quantity in reserves)]
    return make_table(("µs", *PERCENTILE_NAMES), rows)


def _time_row(quantity: Quantity, evidence: TimingEvidence, names: Sequence[str]) -> Sequence[object]:
    label = (quantity.title, quantity.meaning)
    statistics = evidence.times[quantity.name]
    if statistics is None:
        return (label, *[""] * (len(names) - 1), NONE)
    cells: list[object] = [*_values(statistics, names)]
    if quantity.is_reserve and statistics.get("min", 0.0) < 0.0:
        cells[-1] = Cell(cells[-1], "bad")
    return (label, *cells)


def _values(found: Mapping[str, float], names: Sequence[str]) -> list[str]:
    return [number_text(found.get(name), 1) for name in names]


def _counts_table(evidence: TimingEvidence) -> Table:
    rows: list[Sequence[object]] = []
    for name, words in _COUNTS.items():
        count = evidence.counts[name]
        rows.append((words, Cell(count.total, "bad" if count.total else ""), number_text(count.per_100000, 1)))
    return make_table((f"in {evidence.cycles} cycles", "count", "per 100 000"), rows)


def _queues_table(evidence: TimingEvidence) -> Table:
    rows: list[Sequence[object]] = []
    names = PERCENTILE_NAMES[1], PERCENTILE_NAMES[-1]
    for name, words in _QUEUES.items():
        depth = evidence.queues_bytes[name] or {}
        rows.append((words, *(number_text(depth.get(key), 0) for key in names)))
    return make_table(("bytes", *names), rows)


def _ages_table(evidence: TimingEvidence) -> Table:
    rows = [
        (f"{age}" if age < OLDEST_CYCLES else f"{age} or more", str(count), f"{100.0 * count / evidence.cycles:.3f} %")
        for age, count in enumerate(evidence.data_age)
        if count
    ]
    return make_table(("age of the oldest value used", "cycles", "share"), rows)
