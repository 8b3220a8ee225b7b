"""The report of a run: one self-contained HTML page, the same numbers as JSON, and the paper's figures as PNG.

The page needs nothing from outside and allows nothing: no script, no inline style, no request (content security
policy). It follows the reader's light or dark scheme and prints in the light one. The same log gives the same bytes.
"""

import dataclasses
import hashlib
import json
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, Final

import numpy as np

from adacd_hil.analysis.drawing import Drawing
from adacd_hil.analysis.evidence import Evidence
from adacd_hil.analysis.figures import draw
from adacd_hil.analysis.metrics import Contact, Metrics, Residual, evaluate
from adacd_hil.analysis.page import NONE, Cell, document, embed, heading, make_table, number_text, wrap_section
from adacd_hil.analysis.run import CertifiedStream, PaperStream, Run, Truth
from adacd_hil.analysis.timing import columns_of_series
from adacd_hil.analysis.timing_figures import draw_timing
from adacd_hil.analysis.timing_page import timing_section
from adacd_hil.config import Settings, parse
from adacd_hil.log.errors import LogError
from adacd_hil.log.reader import RunLog, Series, read_log
from adacd_hil.records import JOINTS, PARAMETER_UNITS, Request

SCHEMA: Final = 3
"""Version of report.json; goes up when a key changes its meaning or disappears."""
HTML_NAME: Final = "report.html"
JSON_NAME: Final = "report.json"

RUN_TOPICS: Final = ("/scheme", "/cycle", "/contact")
"""Of a run's log, what a report reads."""
_PNG_FIGURES: Final = ("fig5", "fig6", "fig7")
_DIGITS: Final = 6


@dataclass(frozen=True)
class Report:
    """A report that has been written. `is_complete`: the log is whole and nothing was dropped on the way to it."""

    metrics: Metrics
    metadata: Mapping[str, str]
    log_name: str
    problem: str
    is_complete: bool
    html_path: Path
    json_path: Path
    figure_paths: tuple[Path, ...]

    def as_json(self) -> dict[str, Any]:
        """Give the content of report.json; the keys are described in `adacd_hil.analysis.metrics`."""
        return _as_json(self.metrics, self.metadata, self.log_name, self.problem, self.is_complete)

    def as_text(self) -> str:
        """Give the verdict, what the paper had, the contacts and where the report is, for a terminal."""
        lines = [self.metrics.verdict]
        if self.problem:
            lines.append(f"The log is not whole: {self.problem}")
        lines += ["", *_columns([_paper_head(self.metrics), *_paper_cells(self.metrics)])]
        if self.metrics.contacts:
            head, rows = _contact_rows(self.metrics)
            lines += ["", *_columns([head, *rows])]
        return "\n".join([*lines, "", f"Report: {self.html_path}"])


def write_report(log_path: Path, truth_path: Path | None, out_dir: Path) -> Report:
    """Read a log, and the emulator's truth if there is one, and write the report into `out_dir`.

    Raises LogError when a log can't be read or the report can't be written.
    """
    log = read_log(log_path, RUN_TOPICS)
    truth_log = None if truth_path is None else read_log(truth_path, ("/truth",))
    logs = [log] if truth_log is None else [log, truth_log]
    return write_run_report(
        run_from_log(log, truth_log),
        out_dir,
        log_name=log_path.name,
        problem="; ".join(entry.problem for entry in logs if entry.problem),
        is_complete=all(entry.is_complete for entry in logs),
    )


def write_run_report(run: Run, out_dir: Path, *, log_name: str, problem: str = "", is_complete: bool = True) -> Report:
    """Write the report of a run that is in memory. Raises LogError when it can't be written."""
    metrics = evaluate(run)
    drawings = draw(run, metrics)
    timing = draw_timing(run.timing, metrics.timing, run.zero_ns, "motion start")
    pngs = {drawing.name: drawing.png() for drawing in drawings if drawing.name in _PNG_FIGURES}
    report = Report(
        metrics=metrics,
        metadata=run.metadata,
        log_name=log_name,
        problem=problem,
        is_complete=is_complete,
        html_path=out_dir / HTML_NAME,
        json_path=out_dir / JSON_NAME,
        figure_paths=tuple(out_dir / f"{name}.png" for name in pngs),
    )
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
        for name, png in pngs.items():
            (out_dir / f"{name}.png").write_bytes(png)
        text = json.dumps(report.as_json(), indent=2, ensure_ascii=False, allow_nan=False)
        report.json_path.write_text(text + "\n", encoding="utf-8")
        report.html_path.write_text(page(report, run, drawings, timing), encoding="utf-8")
    except OSError as error:
        raise LogError(f"report in {out_dir} can't be written: {error.strerror}") from None
    return report


def run_from_log(log: RunLog, truth_log: RunLog | None) -> Run:
    """Take what the metrics need out of a log and the emulator's own log. Raises LogError."""
    scheme, settings = log.scheme, _settings(log)
    metadata = dict(log.metadata)
    if "arm.dbc" in log.attachments:
        metadata["dbc_sha256"] = hashlib.sha256(log.attachments["arm.dbc"]).hexdigest()
    if truth_log is not None:
        metadata |= {f"emulator_{key}": value for key, value in truth_log.metadata.items() if key not in metadata}
    return Run(
        cycle=scheme["cycle"].astype(np.int64),
        t_ns=scheme.t_ns,
        state=scheme["state"],
        fault=scheme["fault"],
        tau_ext_hat=scheme["tau_ext_hat"],
        tau_ext_hat_cad=scheme["tau_ext_hat_cad"],
        theta_hat=scheme["theta_hat"],
        threshold=scheme["threshold"],
        quiet_s=scheme["quiet_s"],
        reports=tuple(entry.report for entry in log.contacts),
        timing=columns_of_series(log.cycle),
        finish_cycle=_finish_cycle(scheme),
        contact_joints=scheme["contact_joints"],
        truth=_truth(truth_log),
        settings=settings,
        metadata=metadata,
        frames=_count(log.summary, "frames"),
        dropped=_count(log.summary, "dropped"),
        certified=_certified_stream(scheme, settings),
        beside=_paper_stream(scheme),
    )


def _certified_stream(scheme: Series, settings: Settings) -> CertifiedStream | None:
    """Take out what only the certified scheme records; None of a log without it."""
    if "tau_ext_bank" not in scheme.fields:
        return None
    shape = (-1, settings.channel_count, JOINTS)
    return CertifiedStream(
        tau_ext=scheme["tau_ext_bank"].reshape(shape),
        threshold=scheme["threshold_bank"].reshape(shape),
        theta_further=scheme["theta_further"],
        theta_std=scheme["theta_std"],
        condition=scheme["condition"],
        promotions=scheme["promotions"],
    )


def _paper_stream(scheme: Series) -> PaperStream | None:
    """Take out what the paper's scheme beside records; None of a log without it."""
    if "paper_is_armed" not in scheme.fields:
        return None
    return PaperStream(
        is_armed=scheme["paper_is_armed"] > 0.5,
        tau_ext_hat=scheme["paper_tau_ext_hat"],
        threshold=scheme["paper_threshold"],
        theta_hat=scheme["paper_theta_hat"],
    )


def _finish_cycle(scheme: Series) -> int | None:
    """Find the cycle in which the user asked to finish."""
    asked = np.flatnonzero(scheme["request"] == Request.FINISH)
    return int(scheme["cycle"][asked[0]]) if asked.size else None


def _truth(log: RunLog | None) -> Truth | None:
    if log is None or len(log.truth) == 0:
        return None
    truth = log.truth
    return Truth(
        cycle=truth["cycle"].astype(np.int64),
        tau_ext=truth["tau_ext"],
        contact_link=truth["contact_link"],
        contact_index=truth["contact_index"],
        payload_kg=truth["payload"],
        theta=truth["theta"],
        force_N=truth["contact_force"] if "contact_force" in truth.fields else None,
    )


def _settings(log: RunLog) -> Settings:
    text = log.attachments.get("config.toml")
    if text is None:
        raise LogError(f"log {log.path} has no attachment config.toml")
    try:
        return parse(Settings, tomllib.loads(text.decode("utf-8")))
    except ValueError as error:  # what is wrong with the text, the TOML or a setting is a ValueError each
        raise LogError(f"log {log.path}, attachment config.toml: {error}") from None


def _count(summary: Mapping[str, str], key: str) -> int | None:
    """Give a number of the log's summary; a cut file has none."""
    return int(summary[key]) if key in summary else None


def _as_json(
    metrics: Metrics, metadata: Mapping[str, str], log_name: str, problem: str, is_complete: bool
) -> dict[str, Any]:
    fault = None if metrics.fault is None else {"reason": metrics.fault, "at_s": metrics.fault_s}
    plain: dict[str, Any] = _plain(
        {
            "schema": SCHEMA,
            "verdict": metrics.verdict,
            "is_clean": metrics.is_clean,
            "time_zero": "first cycle in ADAPT (motion start)",
            "adaptation_s": metrics.adaptation_s,
            "sections": {
                section.label: {**dataclasses.asdict(section), "duration_s": section.duration_s}
                for section in metrics.sections
            },
            "frozen_residual_max_Nm": {
                label: dataclasses.asdict(residual) for label, residual in metrics.frozen_residual_max_Nm.items()
            },
            "contacts": [dataclasses.asdict(contact) for contact in metrics.contacts],
            "false_alarms": metrics.false_alarms,
            "false_alarms_s": metrics.false_alarms_s,
            "missed": metrics.missed,
            "parameters": metrics.parameters,
            "payload_kg": metrics.payload_kg,
            "certified": None if metrics.evidence is None else _evidence_json(metrics.evidence),
            "fault": fault,
            "cycle": dataclasses.asdict(metrics.cycle),
            "timing": metrics.timing.as_json(),
            "log": {
                "name": log_name,
                "frames": metrics.frames,
                "dropped": metrics.dropped,
                "is_complete": is_complete,
                "problem": problem,
            },
            "paper": [dataclasses.asdict(row) for row in metrics.paper],
            "run": dict(sorted(metadata.items())),
        }
    )
    return plain


def _evidence_json(evidence: Evidence) -> dict[str, Any]:
    """Give what only the certified scheme has; the keys are described in `adacd_hil.analysis.evidence`."""
    return {**dataclasses.asdict(evidence), "smallest_margin": evidence.smallest_margin}


def _plain(value: Any) -> Any:
    """Make a value of JSON's types: numbers with six digits, null for what is not finite."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None
    return value


def _pair(values: Sequence[float] | None, digits: int) -> str:
    return NONE if values is None else " / ".join(number_text(value, digits) for value in values)


def _yes(value: bool | None) -> str:
    return NONE if value is None else "yes" if value else "no"


def _signs(direction: tuple[int, int] | None) -> str:
    return NONE if direction is None else " / ".join({1: "+", -1: "−", 0: "0"}[sign] for sign in direction)


_CONTACT_HEAD: Final = (
    "contact", "section", "link", "found", "at alarm", "onset s", "delay ms", "law ms", "ideal ms", "direction",
    "right", "true Nm", "peak ratio",
)  # fmt: skip


def _contact_words(contact: Contact) -> tuple[str, ...]:
    delay = number_text(contact.delay_ms, 0)
    if contact.detected_s is None:
        delay = "missed" if contact.is_armed else "not armed"
    onset_s = contact.detected_s if contact.onset_s is None else contact.onset_s
    return (
        str(contact.number),
        contact.section or NONE,
        number_text(contact.link, 0),
        number_text(contact.link_detected, 0),
        number_text(contact.link_at_alarm, 0),
        number_text(onset_s, 3),
        delay,
        number_text(contact.law_ms, 1),
        number_text(contact.ideal_ms, 0),
        _signs(contact.direction),
        _yes(contact.direction_ok),
        _pair(contact.tau_ext_Nm, 2),
        number_text(contact.torque_error_ratio, 2),
    )


def _contact_rows(metrics: Metrics) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Give head and rows of the list of contacts, where it is known with the delay of the paper's scheme beside."""
    rows = [_contact_words(contact) for contact in metrics.contacts]
    beside = None if metrics.evidence is None else metrics.evidence.paper_beside
    if beside is None or not beside.contacts:
        return _CONTACT_HEAD, rows
    delays = [number_text(c.delay_ms, 0) if c.is_armed else "not armed" for c in beside.contacts]
    return (*_CONTACT_HEAD, "paper's ms"), [(*row, delay) for row, delay in zip(rows, delays, strict=True)]


def _paper_head(metrics: Metrics) -> tuple[str, ...]:
    if metrics.evidence is None:
        return ("", "paper", "measured")
    return ("", "paper (printed)", "paper's scheme, same stream", "certified")


def _paper_cells(metrics: Metrics) -> list[tuple[str, ...]]:
    if metrics.evidence is None:
        return [(row.quantity, row.paper, row.measured) for row in metrics.paper]
    return [(row.quantity, row.paper, row.beside or NONE, row.measured) for row in metrics.paper]


def _columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Align rows of words for a terminal."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def page(report: Report, run: Run, drawings: Sequence[Drawing], timing: Sequence[Drawing]) -> str:
    """Write the page. drawings, timing: the figures of the run and of its times."""
    figures = {drawing.name: embed(drawing) for drawing in drawings}
    metrics = report.metrics
    adaptations = "".join(figure for name, figure in figures.items() if name.removeprefix("fig") not in (name, "5"))
    parts = [
        _header(report),
        _tiles(metrics),
        figures.get("fig5", ""),
        wrap_section("Paper against measured", _paper_table(metrics)),
        wrap_section("Sections", _sections_table(metrics, run)),
        wrap_section("Margins", _margins_table(metrics.evidence)),
        wrap_section("Contacts", figures.get("contacts", ""), _contacts_table(metrics), _cards(metrics)),
        wrap_section("Model identification", adaptations, _parameters_table(metrics, run), _further_table(metrics)),
        timing_section(metrics.timing, timing),
        wrap_section("Run", _run_table(report)),
        _definitions(run),
    ]
    return document(f"{_name(report)} – run report", parts)


def _name(report: Report) -> str:
    words = [report.metadata.get("config", ""), report.metadata.get("profile", "")]
    return " ".join(filter(None, words)) or report.log_name


def _header(report: Report) -> str:
    meta = [
        ("configuration", "config"), ("profile", "profile"), ("clock", "clock"), ("interface", "interface"),
        ("version", "version"),
    ]  # fmt: skip
    words = [f"{label} {report.metadata[key]}" for label, key in meta if report.metadata.get(key)]
    problems = [f"The log is not whole: {report.problem}"] if report.problem else []
    if not problems and report.metrics.dropped:
        problems = [f"{report.metrics.dropped} packets are not in the log."]
    over = f"adacd-hil run report · {' · '.join(words)}"
    return heading(over, report.metrics.verdict, problems, report.metrics.is_clean)


def _tiles(metrics: Metrics) -> str:
    """Write the handful of numbers to be read first."""
    armed = [contact for contact in metrics.contacts if contact.is_armed]
    seen = [contact for contact in armed if contact.detected_s is not None]
    times_s = [number_text(value, 2) for value in metrics.adaptation_s.values()]
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
        ("smallest margin", NONE if evidence is None else number_text(evidence.smallest_margin, 2), "×"),
    ]
    tiles = [tile for tile in tiles if tile[1] != NONE]
    cells = "".join(
        f"<div><dt>{escape(label)}</dt><dd>{escape(value)}{f' <small>{unit}</small>' if unit else ''}</dd></div>"
        for label, value, unit in tiles
    )
    return f'<dl class="tiles">{cells}</dl>'


def _paper_table(metrics: Metrics) -> str:
    rows: list[Sequence[Cell]] = [
        [*map(escape, cells[:-1]), (escape(cells[-1]), "strong")] for cells in _paper_cells(metrics)
    ]
    head = ("quantity", *_paper_head(metrics)[1:])
    return make_table(head, rows, left=range(len(head)))


def _margins_table(evidence: Evidence | None) -> str:
    """Write threshold over residual of each channel and section."""
    if evidence is None or not evidence.margins:
        return ""
    head = ("section", "filter, rad/s", "", "largest residual, Nm", "threshold, Nm", "margin")
    rows: list[Sequence[Cell]] = []
    for label, channels in evidence.margins.items():
        for row in channels:
            cutoff = f"{row.cutoff_rad_s:g}"
            kind = "bare" if row.smoothing_rad_s is None else "smoothed"
            margin = (_pair(row.margin, 1), "bad" if min(row.margin) < 1.0 else "strong")
            pairs = (_pair(row.residual_max_Nm, 3), _pair(row.threshold_Nm, 3))
            name = (label, "strong") if row is channels[0] else ""
            rows.append((name, cutoff, kind, *pairs, margin))
    note = (
        "Joint 1 / joint 2, where nothing touches the arm. Threshold: median. Margin: the smallest threshold over "
        "residual of any cycle; below 1 it would have been a false alarm. In an adaptation the threshold is as high as "
        "the model is uncertain."
    )
    return make_table(head, rows, left=(0, 2)) + f'<p class="note">{note}</p>'


def _cards(metrics: Metrics) -> str:
    """Write what the reports say of each contact, with its uncertainty and the truth."""
    told = [contact for contact in metrics.contacts if contact.location is not None]
    return f'<div class="cards">{"".join(map(_card, told))}</div>' if told else ""


_PLACES: Final = {
    "KNOWN": "one contact on the link",
    "LINK_1": "only the moment is known: the least force that has it",
    "SINGULAR": "not known: the elbow stands square",
    "UNCERTAIN": "too weak for a lever arm",
    "BEYOND_TIP": "lever arm past the tip",
    "INCONSISTENT": "no single contact without friction",
}


def _card(contact: Contact) -> str:
    words = [contact.level, contact.kind if contact.kind != "UNKNOWN" else None, contact.reaction]
    kind = " · ".join(word.lower().replace("_", " ") for word in words if word)
    if contact.is_two_sided:
        kind += " · two-sided"
    lever_m, sigma_m = contact.lever_m, contact.lever_sigma_m
    lever = _uncertain(_scaled(lever_m, 100.0), _scaled(sigma_m, 100.0), 1, "cm")
    true_force = "" if contact.true_force_N is None else f", true {number_text(contact.true_force_N, 1)}"
    entries = [
        ("found after", number_text(contact.delay_ms, 0, "ms")),
        ("force", _uncertain(contact.force_N, contact.force_sigma_N, 1, "N") + true_force),
        ("lever arm", lever),
        ("place", _PLACES.get(contact.location or "", NONE)),
        ("blind within", number_text(contact.blind_deg, 1, "°")),
    ]
    peaks, peak_sigmas = contact.tau_ext_peak_hat_Nm or (), contact.tau_ext_peak_sigma_Nm or ()
    impulses, impulse_sigmas = contact.impulse_Nm_s or (), contact.impulse_sigma_Nm_s or ()
    for joint in range(len(peaks)):
        peak = _uncertain(peaks[joint], peak_sigmas[joint], 2, "Nm")
        impulse = _uncertain(impulses[joint], impulse_sigmas[joint], 3, "Nm s")
        entries.append((f"joint {joint + 1}", f"peak {peak}, impulse {impulse}"))
    link = number_text(contact.link_detected, 0)
    items = "".join(f"<dt>{escape(term)}</dt><dd>{escape(text)}</dd>" for term, text in entries)
    return f"<div><h3>{contact.number}  link {link}</h3><p>{escape(kind)}</p><dl>{items}</dl></div>"


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else factor * value


def _uncertain(value: float | None, sigma: float | None, digits: int, unit: str) -> str:
    """Write a value with its standard deviation; a dash where either is not known."""
    if value is None or sigma is None:
        return NONE
    return f"{number_text(value, digits)} ± {number_text(sigma, digits)} {unit}"


def _further_table(metrics: Metrics) -> str:
    """Write all parameters of the certified scheme with the standard deviations that it gives them."""
    if metrics.evidence is None or not metrics.evidence.estimates:
        return ""
    estimates = metrics.evidence.estimates
    head = ["", "unit"]
    for label in estimates:
        head += [f"certified ({label})", "±"]
    rows = []
    for name in next(iter(estimates.values())):
        cells: list[Cell] = [_symbol(name), escape(PARAMETER_UNITS.get(name, "Nm"))]
        for found in estimates.values():
            cells += [(number_text(found[name].value, 5), "strong"), number_text(found[name].std, 5)]
        rows.append(cells)
    note = '<p class="note">±: standard deviation that the scheme gives its own estimate.</p>'
    return make_table(head, rows, left=(0, 1)) + note


def _beside_times(evidence: Evidence | None) -> str:
    if evidence is None or evidence.paper_beside is None:
        return NONE
    return " · ".join(number_text(time_s, 2) for time_s in evidence.paper_beside.adaptation_s.values()) or NONE


_KINDS: Final = {
    "adaptation": "adaptation",
    "detection": "collision detection",
    "payload": "payload change",
    "fault": "fault",
}


def _sections_table(metrics: Metrics, run: Run) -> str:
    threshold = run.settings.detector.threshold_Nm
    rows = []
    for section in metrics.sections:
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
    return make_table(head, rows, left=(0, 1)) + f'<p class="note">{note}</p>'


def _judged(values: tuple[float, float] | None, threshold: tuple[float, float]) -> Cell:
    if values is None:
        return NONE
    is_over = any(value > bound for value, bound in zip(values, threshold, strict=True))
    return (_pair(values, 3), "bad" if is_over else "")


def _contacts_table(metrics: Metrics) -> str:
    if not metrics.contacts:
        return '<p class="note">None.</p>'
    rows: list[Sequence[Cell]] = []
    head, words = _contact_rows(metrics)
    for contact, row in zip(metrics.contacts, words, strict=True):
        cells: list[Cell] = [escape(word) for word in row]
        if contact.detected_s is None:
            cells[6] = (str(cells[6]), "bad")
        if contact.link is not None and contact.link_detected not in (None, contact.link):
            cells[3] = (str(cells[3]), "bad")
        if contact.direction_ok is False:
            cells[10] = (str(cells[10]), "bad")
        rows.append(cells)
    note = ""
    if metrics.false_alarms_s:
        times = ", ".join(number_text(time_s, 3) for time_s in metrics.false_alarms_s)
        note = f'<p class="note bad">False alarms at {times} s.</p>'
    return make_table(head, rows, left=()) + note


def _symbol(name: str) -> str:
    stem, index = (name[0], name[1:]) if "_" not in name else name.split("_", 1)
    return f"<i>{escape(stem)}</i><sub>{escape(index)}</sub>"


def _parameters_table(metrics: Metrics, run: Run) -> str:
    if not metrics.parameters:
        return ""
    cad = dict(zip(run.parameter_names, run.settings.arm.cad_theta, strict=True)) if run.has_cad else {}
    head = ["", "unit", "CAD"]
    for label, payload_kg in metrics.payload_kg.items():
        with_payload = "" if payload_kg is None else f", {payload_kg:g} kg"
        head += [f"true ({label}{with_payload})", f"identified ({label})", "error"]
    rows = []
    for name in run.parameter_names:
        cells: list[Cell] = [_symbol(name), escape(PARAMETER_UNITS[name]), number_text(cad.get(name), 4)]
        for found in metrics.parameters.values():
            true, identified = found[name]
            error = f"{_signed(100.0 * (identified - true) / true)} %" if true else NONE
            cells += [number_text(true, 4), (number_text(identified, 4), "strong"), error]
        rows.append(cells)
    note = (
        '<p class="note">Least squares stops when the residual is small enough, not when the parameters are exact: '
        "what the motion hardly excites is hardly identified, and hardly matters to it.</p>"
    )
    return make_table(head, rows, left=(0, 1)) + note


def _signed(value: float) -> str:
    return f"{value:+.1f}".replace("-", "−")


def _run_table(report: Report) -> str:
    log = [("log", report.log_name), ("frames", report.metrics.frames), ("packets dropped", report.metrics.dropped)]
    rows = [(label, NONE if value is None else str(value)) for label, value in log]
    rows += [(key.replace("_", " "), value or NONE) for key, value in sorted(report.metadata.items())]
    return make_table(("", ""), [(escape(key), escape(value)) for key, value in rows], left=(0, 1))


_CERTIFIED_DEFINITIONS: Final = (
    (
        "Certified",
        "an adaptation lasts until detection is armed: fit, test of the frozen model on motion that it was not fitted "
        "to, and what contacts on the way cost. Residual: of the slowest filter. Law and ideal: of the fastest channel "
        "of the bank.",
    ),
    (
        "Paper's scheme, same stream",
        "it adapts beside, ends by eq. (15) and compares with its own thresholds, but decides nothing. Its detection "
        "is the first sample over its threshold while it is armed, though the arm may already react to the other's.",
    ),
    (
        "Force, lever arm, blind within",
        "at right angles to the link, for one contact without friction; the lever arm counts from joint 2. A force "
        "nearer to link 2's axis than the angle reads as one on link 1.",
    ),
)


def _definitions(run: Run) -> str:
    settling_s = 10.0 / run.a_rad_s
    entries: tuple[tuple[str, str], ...] = (
        ("Times", "count from motion start, the first cycle of the first adaptation."),
        (
            "Frozen residual",
            "largest estimated external torque while detection is armed and nobody touches the arm: outside "
            f"each contact and {settling_s:g} s (10/a) after it, and outside each withdrawal and {settling_s:g} s "
            "after it. In an adaptation the parameters still move, so only the CAD model has one.",
        ),
        (
            "Law",
            "delay of a torque step, −ln(1 − h/τ)/a, for the largest true torque up to the detection; ideal: "
            "the true torque as it was, through the filter alone, to the cycle in which it is over the threshold. "
            "What the delay has beyond that is bus, sensor lag and model error.",
        ),
        (
            "False alarm, missed",
            "a detection that no contact explains: each explains those from its onset until one time constant "
            "after the true torque, filtered, is back within the threshold. Missed is a contact that began while "
            "detection was armed and was not detected.",
        ),
        (
            "Found, at alarm",
            "the link at the end of the isolation window and at the moment of detection. Peak ratio: estimated peak "
            "torque, filter undone, over the true one, at the joint with more of it.",
        ),
    )
    if run.certified is not None:
        entries += _CERTIFIED_DEFINITIONS
    items = "".join(f"<dt>{escape(term)}</dt><dd>{escape(text)}</dd>" for term, text in entries)
    return f'<section class="definitions">\n<h2>How it is computed</h2>\n<dl>{items}</dl>\n</section>'
