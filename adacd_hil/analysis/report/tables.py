"""The tables of a report's page, but that of the contacts."""

from collections.abc import Sequence
from html import escape
from itertools import islice
from string import ascii_letters
from typing import Final

from adacd_hil.analysis.cyclic_data import percent_text
from adacd_hil.analysis.evidence import ChannelMargin, Evidence
from adacd_hil.analysis.metrics import Metrics
from adacd_hil.analysis.report.bounds import ADAPTATIONS, SECTIONS
from adacd_hil.analysis.report.page import Cell, make_table
from adacd_hil.analysis.report.reading import Source
from adacd_hil.analysis.report.words import (
    NONE,
    number_text,
    pair_text,
    paper_cells,
    paper_head,
    signed_text,
    stretch_text,
)
from adacd_hil.analysis.run import Run
from adacd_hil.analysis.untouched import Residual
from adacd_hil.records import PARAMETER_UNITS


def paper_table(metrics: Metrics) -> str:
    """Write what the paper printed beside what was measured."""
    rows: list[Sequence[Cell]] = [
        [*map(escape, cells[:-1]), (escape(cells[-1]), "strong")] for cells in paper_cells(metrics)
    ]
    head = ("quantity", *paper_head(metrics)[1:])
    return make_table(head, rows, left=range(len(head)))


def margins_table(evidence: Evidence | None) -> str:
    """Write threshold over residual of each channel and section."""
    if evidence is None or not evidence.margins:
        return ""
    head = ("section", "filter, rad/s", "", "largest residual, Nm", "threshold, Nm", "margin")
    rows: list[Sequence[Cell]] = []
    for label, channels in _first_and_worst(evidence).items():
        for row in channels:
            cutoff = f"{row.cutoff_rad_s:g}"
            kind = "bare" if row.smoothing_rad_s is None else "smoothed"
            margin = (pair_text(row.margin, 1), "bad" if min(row.margin) < 1.0 else "strong")
            pairs = (pair_text(row.residual_max_Nm, 3), pair_text(row.threshold_Nm, 3))
            name = (label, "strong") if row is channels[0] else ""
            rows.append((name, cutoff, kind, *pairs, margin))
    note = (
        "Joint 1 / joint 2, where nothing touches the arm. Threshold: median. Margin: the smallest threshold over "
        "residual of any cycle; below 1 it would have been a false alarm. In an adaptation the threshold is as high as "
        "the model is uncertain."
    )
    if len(evidence.margins) > SECTIONS:
        note += f" The first {SECTIONS} of {len(evidence.margins)} sections, and the one with the smallest margin."
    return make_table(head, rows, left=(0, 2)) + f'<p class="note">{note}</p>'


def push_table(metrics: Metrics) -> str:
    """Write how small a push is found, and the threshold in force."""
    push = None if metrics.evidence is None else metrics.evidence.smallest_push
    if push is None:
        return ""
    names = {"p50": "median", "p99": "99 %", "max": "worst"}
    head = ("joint 1 / joint 2, Nm", *names.values())
    rows: list[Sequence[Cell]] = [
        (what, *(pair_text([joint[name] for joint in joints], 3) for name in names))
        for what, joints in (
            ("smallest push found within 100 ms, estimated", push.push_Nm),
            ("threshold in force", push.threshold_Nm),
        )
    ]
    note = (
        f"Over {60.0 * push.hours:.2f} min of MONITOR in which nothing touches the arm. Push: a constant external "
        "torque that some filter is over its threshold with after 100 ms, whatever its sign, with the residual of that "
        "moment against it, if thresholds and residual stay as they are meanwhile. What is as large as at the worst "
        "moment is found at each. In force: the smallest threshold of all filters."
    )
    bound = metrics.false_alarm_bound_per_h
    if bound is not None:
        count = metrics.armed_false_alarms
        alarms = f"{count or 'No'} false alarm{'' if count == 1 else 's'}"
        note += f" {alarms} in that time: by counting alone, at most {bound:.3g} per hour at 95 %; "
        note += f"{push.tail_rate_per_h:.2g} per hour if residuals have the tail of a Gaussian."
    return make_table(head, rows) + f'<p class="note">{note}</p>'


def _first_and_worst(evidence: Evidence) -> dict[str, tuple[ChannelMargin, ...]]:
    """Choose the first sections, and the one with the smallest margin."""
    labels = list(evidence.margins)
    worst = min(labels, key=lambda label: min(min(row.margin) for row in evidence.margins[label]))
    shown = {*labels[:SECTIONS], worst}
    return {label: margins for label, margins in evidence.margins.items() if label in shown}


def further_table(metrics: Metrics) -> str:
    """Write all parameters of the certified scheme with the standard deviations that it gives them."""
    if metrics.evidence is None or not metrics.evidence.estimates:
        return ""
    estimates = dict(islice(metrics.evidence.estimates.items(), ADAPTATIONS))
    head = ["", "unit"]
    for label in estimates:
        head += [f"certified ({label})", "±"]
    rows = []
    for name in next(iter(estimates.values())):
        cells: list[Cell] = [_symbol(name), escape(PARAMETER_UNITS.get(name, "Nm"))]
        for found in estimates.values():
            cells += [(number_text(found[name].value, 5), "strong"), number_text(found[name].std, 5)]
        rows.append(cells)
    note = "±: standard deviation that the scheme gives its own estimate." + _first_adaptations(metrics)
    return make_table(head, rows, left=(0, 1)) + f'<p class="note">{note}</p>'


def _first_adaptations(metrics: Metrics) -> str:
    count = len(metrics.adaptation_s)
    return f" The first {ADAPTATIONS} of {count} adaptations." if count > ADAPTATIONS else ""


_KINDS: Final = {
    "adaptation": "adaptation",
    "detection": "collision detection",
    "payload": "payload change",
    "fault": "fault",
}


def sections_table(metrics: Metrics, run: Run) -> str:
    """Write a row per section, with its frozen residuals."""
    threshold = run.settings.detector.threshold_Nm
    rows = []
    for section in metrics.sections[:SECTIONS]:
        residual = metrics.frozen_residual_max_Nm.get(section.label, Residual(None, None, 0))
        rows.append(
            (
                (section.label, "strong"),
                _KINDS[section.kind]
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
        "section", "", "from, s", "to, s", "lasts, s", "largest residual, frozen, Nm", "with CAD, Nm", "over cycles",
    )  # fmt: skip
    note = "Residuals of joint 1 / joint 2 where nobody touches the arm; marked where over the threshold."
    if len(metrics.sections) > SECTIONS:
        note += f" The first {SECTIONS} of {len(metrics.sections)} sections; all are in report.json."
    return make_table(head, rows, left=(0, 1)) + f'<p class="note">{note}</p>'


def _judged(values: tuple[float, float] | None, threshold: tuple[float, float]) -> Cell:
    if values is None:
        return NONE
    is_over = any(value > bound for value, bound in zip(values, threshold, strict=True))
    return (pair_text(values, 3), "bad" if is_over else "")


def _symbol(name: str) -> str:
    """Write a parameter's name with its index below: F_v1, a1, offset1."""
    stem, index = name.split("_", 1) if "_" in name else (name.rstrip("0123456789"), name.lstrip(ascii_letters))
    return f"<i>{escape(stem)}</i><sub>{escape(index)}</sub>"


def parameters_table(metrics: Metrics, run: Run) -> str:
    """Write the identified parameters beside the true ones and the CAD model's."""
    if not metrics.parameters:
        return ""
    cad = dict(zip(run.parameter_names, run.settings.arm.cad_theta, strict=True)) if run.has_cad else {}
    head = ["", "unit", "CAD"]
    for label, payload_kg in islice(metrics.payload_kg.items(), ADAPTATIONS):
        with_payload = "" if payload_kg is None else f", {payload_kg:g} kg"
        head += [f"true ({label}{with_payload})", f"identified ({label})", "error"]
    rows = []
    for name in run.parameter_names:
        cells: list[Cell] = [_symbol(name), escape(PARAMETER_UNITS[name]), number_text(cad.get(name), 4)]
        for found in islice(metrics.parameters.values(), ADAPTATIONS):
            true, identified = found[name]
            error = f"{signed_text(100.0 * (identified - true) / true)} %" if true else NONE
            cells += [number_text(true, 4), (number_text(identified, 4), "strong"), error]
        rows.append(cells)
    note = (
        '<p class="note">Least squares stops when the residual is small enough, not when the parameters are exact: '
        "what the motion hardly excites is hardly identified, and hardly matters to it."
        f"{_first_adaptations(metrics)}</p>"
    )
    return make_table(head, rows, left=(0, 1)) + note


def data_table(metrics: Metrics) -> str:
    """Write how much of the cyclic data came in time, and what is over its limit."""
    data = metrics.data
    if not data.cycles:
        return ""
    rows: list[Sequence[Cell]] = [
        (name, _share(share), _share(worst))
        for name, share, worst in (
            ("cycles that lacked a frame in time", data.incomplete, data.worst_incomplete),
            ("cycles that went by older data", data.aged, None),
        )
    ]
    for name, shares in data.devices.items():
        device = escape(name)
        rows.append((f"{device}: no new data", _share(shares.no_new_data), _share(shares.worst_no_new_data)))
        rows.append((f"{device}: repeated", _share(shares.repeated), _share(shares.worst_repeated)))
    note = f"Of {data.cycles} cycles with powered drives."
    over = "".join(f'<p class="note bad">{escape(line)}.</p>' for line in data.excesses)
    return make_table(("", "share", "worst second"), rows) + f'<p class="note">{note}</p>{over}'


def _share(share: float | None) -> str:
    return NONE if share is None else percent_text(share)


def run_table(metrics: Metrics, run: Run, source: Source) -> str:
    """Write where the run comes from."""
    log = [("log", source.log_name), ("frames", metrics.frames), ("packets dropped", metrics.dropped)]
    if run.stretch is not None:
        log.append(("stretch", stretch_text(run.stretch)))
    rows = [(label, NONE if value is None else str(value)) for label, value in log]
    rows += [(key.replace("_", " "), value or NONE) for key, value in sorted(run.metadata.items())]
    return make_table(("", ""), [(escape(key), escape(value)) for key, value in rows], left=(0, 1))
