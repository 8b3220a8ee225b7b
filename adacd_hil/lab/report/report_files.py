"""The report's files: a self-contained HTML page, and its numbers as JSON and CSV. A browser prints the page.

The same log gives the same bytes. Tables in CSV have times in s since motion start, and units in the names.
"""

import csv
import dataclasses
import io
import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from adacd_hil.cli.output import as_called
from adacd_hil.file_access import exists
from adacd_hil.file_replacement import replace_files
from adacd_hil.lab.report.next_steps import NextStep, next_steps
from adacd_hil.lab.report.page import has_paper, went_wrong
from adacd_hil.lab.report.report_json import JSON_NAME, report_json
from adacd_hil.lab.report.run_page import report_page
from adacd_hil.lab.report.run_reading import read_run
from adacd_hil.lab.score.evaluation import RunGatherer, evaluate
from adacd_hil.lab.score.metrics import Metrics, ReportedContact, ReportSource
from adacd_hil.lab.score.report_wording import number_text
from adacd_hil.lab.score.run_arrays import Run, section_at, stays_of
from adacd_hil.lab.score.verdict import headlines, is_good
from adacd_hil.log.log_files import failing_as
from adacd_hil.log.logged_run import Progress
from adacd_hil.log.time_window import WHOLE, TimeWindow
from adacd_hil.printable import in_line, number_of
from adacd_hil.records import PARAMETER_UNITS
from adacd_hil.score.wording import NONE, why_not_found
from adacd_hil.table_layout import fit_table
from adacd_hil.terminal import terminal_columns

HTML_NAME: Final = "report.html"


@dataclass(frozen=True)
class Report:
    """A report that has been written, with its run's metrics.

    content: of report.json. next_steps: for the terminal.
    """

    metrics: Metrics
    source: ReportSource
    content: dict[str, Any]
    html_path: Path
    next_steps: tuple[NextStep, ...]

    @property
    def is_complete(self) -> bool:
        """Whether log and truth are whole, no packet was dropped on the way to them, and all alarms could be judged."""
        return self.source.is_complete

    def as_text(self) -> str:
        """Return the result of the run, the first contacts that went wrong, next steps and the report's path, as text.

        It is for a terminal, and has at most PRINTED_CONTACTS contacts.
        """
        first, *further = headlines(self.metrics, self.source)
        lines = [in_line(f"{'Good' if is_good(self.metrics, self.source) else 'NOT GOOD'}: {first}")]
        lines += [in_line(f"- {line}") for line in further]
        wrong = [contact for contact in self.metrics.contacts if went_wrong(contact)]
        if wrong:
            more = "; all contacts are in contacts.csv" if len(wrong) > PRINTED_CONTACTS else ""
            lines += ["", f"{number_of(len(wrong), 'contact')} missed or misnamed{more}:"]
            lines += _contact_lines(wrong[:PRINTED_CONTACTS], terminal_columns())
        lines.append("")
        for step in self.next_steps:
            lines += [in_line(step.text), *([f"    {in_line(as_called(step.command))}"] if step.command else [])]
        return "\n".join([*lines, in_line(f"Report: {self.html_path}")])


PRINTED_CONTACTS: Final = 8
"""Contacts that went wrong with a line in the terminal."""


def _contact_lines(contacts: Sequence[ReportedContact], width: int | None) -> list[str]:
    """Return the lines of a table of contacts, with its head, for a terminal of `width` letters; None: of any width."""
    rows: list[tuple[str, ...]] = [("contact", "at", "touched", "found on", "after")]
    for contact in contacts:
        found = NONE if contact.link_detected is None else f"link {contact.link_detected}"
        is_found = contact.detected_s is not None
        delay = number_text(contact.delay_ms, 0, "ms") if is_found else why_not_found(contact.is_armed)
        touched = NONE if contact.link is None else f"link {contact.link}"
        rows.append((str(contact.number), number_text(contact.at_s, 2, "s"), touched, found, delay))
    return fit_table(rows, width=width)


def write_report(
    log_path: Path,
    truth_path: Path | None,
    out_dir: Path,
    *,
    stretch: TimeWindow = WHOLE,
    progress: Progress = lambda _: None,
    config: str = "",
    scenario: str = "",
    truth: str = "",
) -> Report:
    """Read a log, or a stretch of it, with the emulator's truth if there is one; write and return its report.

    Raises LogError as `read_run`, or if the report can't be written. progress: called with a line on the cycles read.
    config, scenario, truth: as of `ReportSource`, for the next steps that are returned, which name the log by
    `log_path`.
    """
    run, gathered, source = read_run(log_path, truth_path, stretch, progress)
    report = write_run_report(run, out_dir, source, gathered)
    here = source._replace(log_name=str(log_path), config=config, scenario=scenario, truth=truth)
    return dataclasses.replace(report, next_steps=tuple(map(_placed, next_steps(report.metrics, run, here)[0])))


def _placed(step: NextStep) -> NextStep:
    """Return a next step whose text names the TOML files of its command that aren't where it is typed.

    Unchanged if all are there.
    """
    missing = [word for word in shlex.split(step.command) if word.endswith(".toml") and not exists(Path(word))]
    return step._replace(text=f"{step.text} In the folder of {' and '.join(missing)}:") if missing else step


def write_run_report(run: Run, out_dir: Path, source: ReportSource, gathered: RunGatherer) -> Report:
    """Write the report of a run that is in memory into `out_dir`, over an earlier one; return it.

    gathered: the sums over all cycles. Raises LogError if it can't be written.
    """
    metrics = evaluate(run, gathered)
    shown_run = run if has_paper(metrics) else dataclasses.replace(run, beside=None)
    content = report_json(metrics, run.metadata, source, run.stretch)
    files: dict[str, bytes | str] = {
        **report_tables(run, metrics),
        JSON_NAME: json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n",
        HTML_NAME: report_page(metrics, shown_run, source),
    }
    with failing_as(f"report in {out_dir} can't be written"):
        replace_files(out_dir, files)
    steps = tuple(next_steps(metrics, run, source)[0])
    return Report(metrics, source, content, out_dir / HTML_NAME, steps)


_PARAMETERS: Final = ("section", "parameter", "unit", "true", "identified", "std", "cad")
_STATES: Final = ("state", "section", "start_s", "end_s", "duration_s")
_CSV_DIGITS: Final = 9


def report_tables(run: Run, metrics: Metrics) -> dict[str, str]:
    """Return contacts.csv, parameters.csv and states.csv as texts by file name."""
    names = [field.name for field in dataclasses.fields(ReportedContact)]
    pairs = [name for name in names if any(isinstance(getattr(c, name), tuple) for c in metrics.contacts)]
    head = [column for name in names for column in ((f"{name}_1", f"{name}_2") if name in pairs else (name,))]
    contacts = ([cell for name in names for cell in _cells(getattr(c, name), name in pairs)] for c in metrics.contacts)
    return {
        "contacts.csv": _table(head, contacts),
        "parameters.csv": _table(_PARAMETERS, _parameters(run, metrics)),
        "states.csv": _table(_STATES, _states(run, metrics)),
    }


def _cells(value: Any, is_pair: bool) -> Sequence[Any]:
    """Return a value as cells: one, or, with `is_pair`, one per joint, both None for the value None."""
    if not is_pair:
        return (value,)
    return (None, None) if value is None else tuple(value)


def _parameters(run: Run, metrics: Metrics) -> Iterable[Sequence[Any]]:
    cad: Mapping[str, float] = (
        dict(zip(run.parameter_names, run.settings.arm.cad_theta, strict=True)) if run.has_cad else {}
    )
    for label, found in metrics.parameters.items():
        estimates = {} if metrics.evidence is None else metrics.evidence.estimates.get(label, {})
        for name, (true, identified) in found.items():
            std = estimates[name].std if name in estimates else None
            yield label, name, PARAMETER_UNITS[name], true, identified, std, cad.get(name)
        for name in (name for name in estimates if name not in found):
            yield label, name, PARAMETER_UNITS.get(name, "Nm"), None, estimates[name].value, estimates[name].std, None


def _states(run: Run, metrics: Metrics) -> Iterable[Sequence[Any]]:
    for stay in stays_of(run):
        label = section_at(metrics.sections, 0.5 * (stay.start_s + stay.end_s))
        yield stay.state.name, label, stay.start_s, stay.end_s, stay.end_s - stay.start_s


def _table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(head)
    writer.writerows([f"{cell:.{_CSV_DIGITS}g}" if isinstance(cell, float) else cell for cell in row] for row in rows)
    return out.getvalue()
