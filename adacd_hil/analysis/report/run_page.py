"""The page of a report, put together."""

from collections.abc import Sequence
from html import escape

import numpy as np

from adacd_hil.analysis.cyclic_data import percent_text
from adacd_hil.analysis.drawing import Drawing
from adacd_hil.analysis.evidence import Evidence
from adacd_hil.analysis.metrics import Metrics
from adacd_hil.analysis.report.contacts_page import contact_cards, contacts_table
from adacd_hil.analysis.report.definitions import definitions
from adacd_hil.analysis.report.page import document, embed, heading, wrap_section
from adacd_hil.analysis.report.reading import Source
from adacd_hil.analysis.report.tables import (
    data_table,
    further_table,
    margins_table,
    paper_table,
    parameters_table,
    push_table,
    run_table,
    sections_table,
)
from adacd_hil.analysis.report.timeline import timeline
from adacd_hil.analysis.report.timing_page import timing_section
from adacd_hil.analysis.report.traces_page import SCRIPTS, STYLES, traces_section
from adacd_hil.analysis.report.words import NONE, has_paper, number_text, stretch_text
from adacd_hil.analysis.run import Run
from adacd_hil.analysis.verdict import LISTED


def report_page(
    metrics: Metrics, run: Run, source: Source, drawings: Sequence[Drawing], timing: Sequence[Drawing]
) -> str:
    """Write the page. drawings, timing: the figures of the run and of its times."""
    figures = {drawing.name: embed(drawing) for drawing in drawings}
    adaptations = "".join(figure for name, figure in figures.items() if name.removeprefix("fig") not in (name, "5"))
    traces = traces_section(run, metrics)
    parts = [
        _header(metrics, run, source),
        _tiles(metrics),
        timeline(run, metrics),
        figures.get("fig5", ""),
        wrap_section("Paper against measured" if has_paper(metrics) else "Measured", paper_table(metrics)),
        wrap_section("Sections", sections_table(metrics, run)),
        wrap_section("Margins", margins_table(metrics.evidence), push_table(metrics)),
        wrap_section("Contacts", figures.get("contacts", ""), contacts_table(metrics), contact_cards(metrics, run)),
        wrap_section("Model identification", adaptations, parameters_table(metrics, run), further_table(metrics)),
        traces,
        wrap_section("Cyclic data", data_table(metrics)),
        timing_section(metrics.timing, timing),
        wrap_section("Run", run_table(metrics, run, source)),
        definitions(run),
    ]
    title = f"{_name(run, source)} – run report"
    return document(title, parts, STYLES, SCRIPTS) if traces else document(title, parts)


def _name(run: Run, source: Source) -> str:
    words = [run.metadata.get("config", ""), run.metadata.get("profile", "")]
    return " ".join(filter(None, words)) or source.log_name


def _header(metrics: Metrics, run: Run, source: Source) -> str:
    meta = [
        ("configuration", "config"), ("profile", "profile"), ("clock", "clock"), ("interface", "interface"),
        ("version", "version"),
    ]  # fmt: skip
    words = [f"{label} {run.metadata[key]}" for label, key in meta if run.metadata.get(key)]
    if run.stretch is not None:
        words.append(stretch_text(run.stretch))
    problems = [f"The log is not whole: {source.problem}"] if source.problem else []
    if not problems and metrics.dropped:
        problems = [f"{metrics.dropped} packets are not in the log."]
    over = f"adacd-hil run report · {' · '.join(words)}"
    return heading(over, metrics.verdict, problems, metrics.is_clean)


def _tiles(metrics: Metrics) -> str:
    """Write the handful of numbers to be read first."""
    armed = [contact for contact in metrics.contacts if contact.is_armed]
    seen = [contact for contact in armed if contact.detected_s is not None]
    times_s = _listed([number_text(value, 2) for value in metrics.adaptation_s.values()])
    delays_ms = [contact.delay_ms for contact in seen if contact.delay_ms is not None]
    laws_ms = [contact.law_ms for contact in seen if contact.law_ms is not None]
    frozen = [max(r.identified) for r in metrics.frozen_residual_max_Nm.values() if r.identified is not None]
    links = [contact for contact in seen if contact.link is not None]
    right = sum(contact.link == contact.link_detected for contact in links)
    has_truth, evidence = metrics.missed is not None, metrics.evidence
    tiles = [
        ("identified in" if evidence is None else "certified in", " · ".join(times_s) or NONE, "s"),
        ("the paper's, same stream", _beside_times(evidence), "s"),
        ("contacts detected", f"{len(seen)} of {len(armed)}", "") if has_truth else ("detections", str(len(seen)), ""),
        ("false alarms", NONE if metrics.false_alarms is None else str(metrics.false_alarms), ""),
        ("link right", f"{right} of {len(links)}" if links else NONE, ""),
        ("median delay", number_text(float(np.median(delays_ms)), 1) if delays_ms else NONE, "ms"),
        ("of which by law", number_text(float(np.median(laws_ms)), 1) if laws_ms else NONE, "ms"),
        ("largest frozen residual", number_text(max(frozen), 3) if frozen else NONE, "Nm"),
        ("incomplete cycles", _share_number(metrics.data.incomplete), "%"),
        ("smallest margin", NONE if evidence is None else number_text(evidence.smallest_margin, 2), "×"),
    ]
    tiles = [tile for tile in tiles if tile[1] != NONE]
    cells = "".join(
        f"<div><dt>{escape(label)}</dt><dd>{escape(value)}{f' <small>{unit}</small>' if unit else ''}</dd></div>"
        for label, value, unit in tiles
    )
    return f'<dl class="tiles">{cells}</dl>'


def _share_number(share: float | None) -> str:
    return NONE if share is None else percent_text(share).removesuffix(" %")


def _beside_times(evidence: Evidence | None) -> str:
    if evidence is None or evidence.paper_beside is None:
        return NONE
    times_s = [number_text(time_s, 2) for time_s in evidence.paper_beside.adaptation_s.values()]
    return " · ".join(_listed(times_s)) or NONE


def _listed(times: list[str]) -> list[str]:
    """Leave out all but the first of many."""
    return times if len(times) <= LISTED else [*times[:LISTED], "…"]
