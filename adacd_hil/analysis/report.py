"""The report of a run: one self-contained HTML page, the same numbers as JSON, and the paper's figures as PNG.

The page needs nothing from outside and allows nothing: no script, no inline style, no request (content security
policy). It follows the reader's light or dark scheme and prints in the light one. The same log gives the same bytes.
"""

import dataclasses
import hashlib
import json
import math
import re
import tomllib
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np

from adacd_hil.analysis.figures import Drawing, draw
from adacd_hil.analysis.metrics import Contact, Metrics, Percentiles, Residual, Run, Timing, Truth, evaluate
from adacd_hil.config import Settings, parse
from adacd_hil.log.errors import LogError
from adacd_hil.log.reader import RunLog, Series, read_log
from adacd_hil.records import PARAMETER_UNITS, Request

SCHEMA: Final = 1
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
        rows = [("", "paper", "measured")]
        rows += [(row.quantity, row.paper, row.measured) for row in self.metrics.paper]
        lines += ["", *_columns(rows)]
        if self.metrics.contacts:
            lines += ["", *_columns([_CONTACT_HEAD, *map(_contact_words, self.metrics.contacts)])]
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
        report.html_path.write_text(page(report, run, drawings), encoding="utf-8")
    except OSError as error:
        raise LogError(f"report in {out_dir} can't be written: {error.strerror}") from None
    return report


def run_from_log(log: RunLog, truth_log: RunLog | None) -> Run:
    """Take what the metrics need out of a log and the emulator's own log. Raises LogError."""
    scheme, cycle = log.scheme, log.cycle
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
        timing=Timing(
            cycle=cycle["cycle"].astype(np.int64),
            lateness_ns=cycle["lateness_ns"],
            feedback_ns=cycle["feedback_ns"],
            command_ns=cycle["command_ns"],
            overruns=cycle["overruns"].astype(np.int64),
            frames_missing=cycle["frames_missing"].astype(np.int64),
            commands_late=cycle["commands_late"].astype(np.int64),
        ),
        finish_cycle=_finish_cycle(scheme),
        contact_joints=scheme["contact_joints"],
        truth=_truth(truth_log),
        settings=_settings(log),
        metadata=metadata,
        frames=_count(log.summary, "frames"),
        dropped=_count(log.summary, "dropped"),
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
    cycle = dataclasses.asdict(metrics.cycle)
    latency = {"feedback": cycle.pop("feedback_us"), "command": cycle.pop("command_us")}
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
            "fault": fault,
            "cycle": {**cycle, "latency_us": latency},
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


def _plain(value: Any) -> Any:
    """Make a value of JSON's types: numbers with six digits, null for what is not finite."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None
    return value


_NONE: Final = "–"
_UNIT: Final = re.compile(r"(?<=\d) (?=(?:s|kg)\b)")
"""The space between a number and its unit, where a line must not end."""


def _number(value: float | None, digits: int, unit: str = "") -> str:
    """Write a number with a fixed count of decimals and a true minus sign; a dash for None."""
    if value is None or not math.isfinite(value):
        return _NONE
    text = f"{value:.{digits}f}".replace("-", "−")
    return f"{text} {unit}" if unit else text


def _pair(values: Sequence[float] | None, digits: int) -> str:
    return _NONE if values is None else " / ".join(_number(value, digits) for value in values)


def _yes(value: bool | None) -> str:
    return _NONE if value is None else "yes" if value else "no"


def _signs(direction: tuple[int, int] | None) -> str:
    return _NONE if direction is None else " / ".join({1: "+", -1: "−", 0: "0"}[sign] for sign in direction)


_CONTACT_HEAD: Final = (
    "contact", "section", "link", "found", "at alarm", "onset s", "delay ms", "law ms", "ideal ms", "direction",
    "right", "true Nm", "peak ratio",
)  # fmt: skip


def _contact_words(contact: Contact) -> tuple[str, ...]:
    delay = _number(contact.delay_ms, 0)
    if contact.detected_s is None:
        delay = "missed" if contact.is_armed else "not armed"
    onset_s = contact.detected_s if contact.onset_s is None else contact.onset_s
    return (
        str(contact.number),
        contact.section or _NONE,
        _number(contact.link, 0),
        _number(contact.link_detected, 0),
        _number(contact.link_at_alarm, 0),
        _number(onset_s, 3),
        delay,
        _number(contact.law_ms, 1),
        _number(contact.ideal_ms, 0),
        _signs(contact.direction),
        _yes(contact.direction_ok),
        _pair(contact.tau_ext_Nm, 2),
        _number(contact.torque_error_ratio, 2),
    )


def _columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Align rows of words for a terminal."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def page(report: Report, run: Run, drawings: Sequence[Drawing]) -> str:
    """Write the page."""
    style = resources.files("adacd_hil.analysis").joinpath("report.css").read_text(encoding="utf-8").strip()
    digest = b64encode(hashlib.sha256(f"\n{style}\n".encode()).digest()).decode()
    policy = f"default-src 'none'; style-src 'sha256-{digest}'; base-uri 'none'; form-action 'none'"
    figures = {drawing.name: _figure(drawing) for drawing in drawings}
    metrics = report.metrics
    adaptations = "".join(figure for name, figure in figures.items() if name.removeprefix("fig") not in (name, "5"))
    parts = [
        _header(report),
        _tiles(metrics),
        figures.get("fig5", ""),
        _section("Paper against measured", _paper_table(metrics)),
        _section("Sections", _sections_table(metrics, run)),
        _section("Contacts", figures.get("contacts", ""), _contacts_table(metrics)),
        _section("Model identification", adaptations, _parameters_table(metrics, run)),
        _section("Cycle", figures.get("cycle", ""), _cycle_table(metrics)),
        _section("Run", _run_table(report)),
        _definitions(run),
    ]
    body = "\n".join(part for part in parts if part)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{escape(_name(report))} – run report</title>\n"
        f"<style>\n{style}\n</style>\n</head>\n<body>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )


def _name(report: Report) -> str:
    words = [report.metadata.get("config", ""), report.metadata.get("profile", "")]
    return " ".join(filter(None, words)) or report.log_name


def _header(report: Report) -> str:
    tone = "good" if report.metrics.is_clean else "bad"
    meta = [
        ("configuration", "config"), ("profile", "profile"), ("clock", "clock"), ("interface", "interface"),
        ("version", "version"),
    ]  # fmt: skip
    words = [f"{label} {report.metadata[key]}" for label, key in meta if report.metadata.get(key)]
    problem = f'<p class="problem">The log is not whole: {escape(report.problem)}</p>' if report.problem else ""
    verdict = _UNIT.sub("&nbsp;", escape(report.metrics.verdict))
    if not problem and report.metrics.dropped:
        problem = f'<p class="problem">{report.metrics.dropped} packets are not in the log.</p>'
    return (
        f'<header class="{tone}">\n<p class="over">adacd-hil run report · {escape(" · ".join(words))}</p>\n'
        f"<h1>{verdict}</h1>\n{problem}</header>"
    )


def _tiles(metrics: Metrics) -> str:
    """Write the handful of numbers to be read first."""
    armed = [contact for contact in metrics.contacts if contact.is_armed]
    seen = [contact for contact in armed if contact.detected_s is not None]
    times_s = [_number(value, 2) for value in metrics.adaptation_s.values()]
    delays_ms = [contact.delay_ms for contact in seen if contact.delay_ms is not None]
    laws_ms = [contact.law_ms for contact in seen if contact.law_ms is not None]
    frozen = [max(r.identified) for r in metrics.frozen_residual_max_Nm.values() if r.identified is not None]
    links = [contact for contact in seen if contact.link is not None]
    right = sum(contact.link == contact.link_detected for contact in links)
    has_truth = metrics.missed is not None
    tiles = [
        ("identified in", " · ".join(times_s) or _NONE, "s"),
        ("contacts detected", f"{len(seen)} of {len(armed)}", "") if has_truth else ("detections", str(len(seen)), ""),
        ("false alarms", _NONE if metrics.false_alarms is None else str(metrics.false_alarms), ""),
        ("link right", f"{right} of {len(links)}" if links else _NONE, ""),
        ("median delay", _number(float(np.median(delays_ms)), 1) if delays_ms else _NONE, "ms"),
        ("of which by law", _number(float(np.median(laws_ms)), 1) if laws_ms else _NONE, "ms"),
        ("largest frozen residual", _number(max(frozen), 3) if frozen else _NONE, "Nm"),
    ]
    tiles = [tile for tile in tiles if tile[1] != _NONE]
    cells = "".join(
        f"<div><dt>{escape(label)}</dt><dd>{escape(value)}{f' <small>{unit}</small>' if unit else ''}</dd></div>"
        for label, value, unit in tiles
    )
    return f'<dl class="tiles">{cells}</dl>'


def _figure(drawing: Drawing) -> str:
    caption = f"<b>{escape(drawing.title)}.</b> {escape(drawing.caption)}"
    return (
        f'<figure id="{drawing.name}">\n<div class="scroll">{drawing.svg()}</div>\n'
        f"<figcaption>{caption}</figcaption>\n</figure>\n"
    )


def _section(title: str, *content: str) -> str:
    inner = "\n".join(part for part in content if part)
    return f"<section>\n<h2>{escape(title)}</h2>\n{inner}\n</section>" if inner else ""


Cell = str | tuple[str, str]
"""Text, already escaped, or the text and the class of its cell."""


def _table(head: Sequence[str], rows: Iterable[Sequence[Cell]], left: Sequence[int] = (0,)) -> str:
    """Write a table; columns are aligned right but those of `left`."""

    def cell(tag: str, content: Cell, column: int) -> str:
        text, kind = content if isinstance(content, tuple) else (content, "")
        names = " ".join(filter(None, ("l" if column in left else "", kind)))
        kinds = f' class="{names}"' if names else ""
        return f"<{tag}{kinds}>{text}</{tag}>"

    def line(tag: str, cells: Sequence[Cell]) -> str:
        return "<tr>" + "".join(cell(tag, content, column) for column, content in enumerate(cells)) + "</tr>"

    body = "\n".join(line("td", row) for row in rows)
    top = f"<thead>{line('th', head)}</thead>\n" if any(head) else ""
    return f'<div class="scroll card"><table>\n{top}<tbody>\n{body}\n</tbody>\n</table></div>'


def _paper_table(metrics: Metrics) -> str:
    rows = [(escape(row.quantity), escape(row.paper), (escape(row.measured), "strong")) for row in metrics.paper]
    return _table(("quantity", "paper", "measured"), rows, left=(0, 1, 2))


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
                _number(section.start_s, 3),
                _number(section.end_s, 3),
                _number(section.duration_s, 3),
                _judged(residual.identified, threshold),
                _judged(residual.cad, threshold),
                str(residual.cycles) if residual.cycles else _NONE,
            )
        )
    head = (
        "section", "", "from, s", "to, s", "lasts, s", "largest residual, frozen, Nm", "with CAD, Nm", "over cycles",
    )  # fmt: skip
    note = "Residuals of joint 1 / joint 2 where nobody touches the arm; marked where over the threshold."
    return _table(head, rows, left=(0, 1)) + f'<p class="note">{note}</p>'


def _judged(values: tuple[float, float] | None, threshold: tuple[float, float]) -> Cell:
    if values is None:
        return _NONE
    is_over = any(value > bound for value, bound in zip(values, threshold, strict=True))
    return (_pair(values, 3), "bad" if is_over else "")


def _contacts_table(metrics: Metrics) -> str:
    if not metrics.contacts:
        return '<p class="note">None.</p>'
    rows: list[Sequence[Cell]] = []
    for contact in metrics.contacts:
        cells: list[Cell] = [escape(word) for word in _contact_words(contact)]
        if contact.detected_s is None:
            cells[6] = (str(cells[6]), "bad")
        if contact.link is not None and contact.link_detected not in (None, contact.link):
            cells[3] = (str(cells[3]), "bad")
        if contact.direction_ok is False:
            cells[10] = (str(cells[10]), "bad")
        rows.append(cells)
    note = ""
    if metrics.false_alarms_s:
        times = ", ".join(_number(time_s, 3) for time_s in metrics.false_alarms_s)
        note = f'<p class="note bad">False alarms at {times} s.</p>'
    return _table(_CONTACT_HEAD, rows, left=()) + note


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
        cells: list[Cell] = [_symbol(name), escape(PARAMETER_UNITS[name]), _number(cad.get(name), 4)]
        for found in metrics.parameters.values():
            true, identified = found[name]
            error = f"{_signed(100.0 * (identified - true) / true)} %" if true else _NONE
            cells += [_number(true, 4), (_number(identified, 4), "strong"), error]
        rows.append(cells)
    note = (
        '<p class="note">Least squares stops when the residual is small enough, not when the parameters are exact: '
        "what the motion hardly excites is hardly identified, and hardly matters to it.</p>"
    )
    return _table(head, rows, left=(0, 1)) + note


def _signed(value: float) -> str:
    return f"{value:+.1f}".replace("-", "−")


def _cycle_table(metrics: Metrics) -> str:
    cycle = metrics.cycle
    facts = [
        f"{cycle.count} cycles in {_number(cycle.duration_s, 1)} s",
        f"{cycle.overruns} overruns",
        f"{cycle.frames_missing} frames missing",
        f"{cycle.commands_late} commands late",
        f"clock {cycle.clock or _NONE}",
        f"scheduler {cycle.scheduler or _NONE}",
    ]
    named: list[tuple[str, Percentiles | None]] = [
        ("SYNC to last feedback decoded", cycle.feedback_us),
        ("SYNC to last command sent", cycle.command_us),
        ("wake-up after the grid point", cycle.lateness_us),
    ]
    rows = [
        (label, *(_number(value, 0) for value in dataclasses.astuple(times)))
        for label, times in named
        if times is not None
    ]
    text = f"<p>{escape('; '.join(facts))}.</p>"
    return text + (_table(("µs", "50 %", "99 %", "99.9 %", "largest"), rows) if rows else "")


def _run_table(report: Report) -> str:
    log = [("log", report.log_name), ("frames", report.metrics.frames), ("packets dropped", report.metrics.dropped)]
    rows = [(label, _NONE if value is None else str(value)) for label, value in log]
    rows += [(key.replace("_", " "), value or _NONE) for key, value in sorted(report.metadata.items())]
    return _table(("", ""), [(escape(key), escape(value)) for key, value in rows], left=(0, 1))


def _definitions(run: Run) -> str:
    settling_s = 10.0 / run.settings.filter.a_rad_s
    entries = (
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
    items = "".join(f"<dt>{escape(term)}</dt><dd>{escape(text)}</dd>" for term, text in entries)
    return f'<section class="definitions">\n<h2>How it is computed</h2>\n<dl>{items}</dl>\n</section>'
