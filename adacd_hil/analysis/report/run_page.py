"""The page of a report, put together."""

from collections.abc import Sequence

import numpy as np

from adacd_hil.analysis.drawing import Drawing
from adacd_hil.analysis.logged_run import Run
from adacd_hil.analysis.report.contact_cards import contact_cards, contacts_table
from adacd_hil.analysis.report.page import (
    CONTACTS,
    TRACED_CONTACTS,
    Heading,
    has_paper,
    left_out_text,
    render_page,
    stretch_text,
)
from adacd_hil.analysis.report.report_tables import (
    counted_sentence,
    data_table,
    further_table,
    margins_table,
    origin_table,
    paper_table,
    parameters_table,
    push_table,
    sections_table,
    timing_tables,
)
from adacd_hil.analysis.report.timeline import SCRIPTS, STYLES, state_key, timeline_of, traces_of
from adacd_hil.analysis.score.metrics import CertifiedEvidence, Metrics, ReportSource
from adacd_hil.analysis.score.verdict import LISTED
from adacd_hil.analysis.score.wording import NONE, number_text, percent_text


def report_page(
    metrics: Metrics, run: Run, source: ReportSource, drawings: Sequence[Drawing], timing: Sequence[Drawing]
) -> str:
    """Write the page. drawings, timing: the figures of the run and of its times."""
    figures = {drawing.name: drawing for drawing in drawings}
    traces = traces_of(run, metrics)
    since_ns = None if run.log_start_ns is None else run.zero_ns - run.log_start_ns
    return render_page(
        "run_page.html.j2",
        f"{_name(run, source)} – run report",
        _heading(metrics, run, source),
        STYLES if traces else (),
        SCRIPTS if traces else (),
        run=run,
        metrics=metrics,
        tiles=_tiles(metrics),
        timeline=timeline_of(run, metrics),
        state_key=state_key(run),
        residuals=figures.get("fig5"),
        has_paper=has_paper(metrics),
        paper=paper_table(metrics),
        sections=sections_table(metrics, run),
        margins=margins_table(metrics.evidence),
        push=push_table(metrics.evidence),
        counted=counted_sentence(metrics),
        close_ups=figures.get("contacts"),
        contacts=contacts_table(metrics),
        left_out=left_out_text(metrics, CONTACTS),
        cards=contact_cards(metrics, run),
        adaptations=[figures[name] for name in figures if name.removeprefix("fig") not in (name, "5")],
        parameters=parameters_table(metrics, run),
        further=further_table(metrics.evidence),
        traces=traces,
        traced_contacts=TRACED_CONTACTS,
        data=data_table(metrics.data),
        timing=timing_tables(metrics.timing),
        timing_figures=timing,
        origin=origin_table(metrics, run, source),
        settling_s=f"{10.0 / run.a_rad_s:g}",
        motion_start_s=None if since_ns is None else since_ns * 1e-9,
    )


def _name(run: Run, source: ReportSource) -> str:
    words = [run.metadata.get("config", ""), run.metadata.get("profile", "")]
    return " ".join(filter(None, words)) or source.log_name


def _heading(metrics: Metrics, run: Run, source: ReportSource) -> Heading:
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
    return Heading(over, metrics.verdict, problems, metrics.is_clean)


def _tiles(metrics: Metrics) -> list[tuple[str, str, str]]:
    """Give the handful of numbers to be read first: what each is, the number, its unit."""
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
    return [tile for tile in tiles if tile[1] != NONE]


def _share_number(share: float | None) -> str:
    return NONE if share is None else percent_text(share).removesuffix(" %")


def _beside_times(evidence: CertifiedEvidence | None) -> str:
    if evidence is None or evidence.paper_beside is None:
        return NONE
    times_s = [number_text(time_s, 2) for time_s in evidence.paper_beside.adaptation_s.values()]
    return " · ".join(_listed(times_s)) or NONE


def _listed(times: list[str]) -> list[str]:
    """Leave out all but the first of many."""
    return times if len(times) <= LISTED else [*times[:LISTED], "…"]
