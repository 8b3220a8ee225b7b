"""The report's files: a self-contained HTML page, its numbers as JSON and CSV, the index of a folder.

`adacd-hil report` draws figures as PNG, too, and report.png with the verdict and all figures. A browser prints.

The same log gives the same bytes. Tables in CSV have times in s since motion start, and units in the names.
"""

import csv
import dataclasses
import io
import json
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imsave
from numpy.typing import NDArray

from adacd_hil.file_access import replace_files
from adacd_hil.lab.drawing import COLOURS, Drawing, style
from adacd_hil.lab.report.page import (
    PRINTED_CONTACTS,
    contact_rows,
    has_paper,
    left_out_text,
    paper_cells,
    paper_head,
    shown_contacts,
)
from adacd_hil.lab.report.report_json import JSON_NAME, report_json
from adacd_hil.lab.report.run_figures import draw
from adacd_hil.lab.report.run_page import report_page
from adacd_hil.lab.report.run_reading import read_run
from adacd_hil.lab.report.timeline import stays_of
from adacd_hil.lab.report.timing_figures import draw_timing
from adacd_hil.lab.score.evaluation import evaluate
from adacd_hil.log.log_files import WHOLE, TimeWindow, failing_as
from adacd_hil.log.logged_run import Progress, Run, StretchOfRun, section_at
from adacd_hil.records import PARAMETER_UNITS
from adacd_hil.score.metrics import Gathered, Metrics, ReportedContact, ReportSource
from adacd_hil.table_layout import fit_table
from adacd_hil.terminal import in_line, terminal_columns

HTML_NAME: Final = "report.html"
_PNG_FIGURES: Final = ("fig5", "fig6", "fig7")


@dataclass(frozen=True)
class Report:
    """A report that has been written."""

    metrics: Metrics
    metadata: Mapping[str, str]
    source: ReportSource
    html_path: Path
    json_path: Path
    stretch: StretchOfRun | None = None

    @property
    def is_complete(self) -> bool:
        """Whether the log is whole and nothing was dropped on the way to it."""
        return self.source.is_complete

    def as_json(self) -> dict[str, Any]:
        """Give the content of report.json."""
        return report_json(self.metrics, self.metadata, self.source, self.stretch)

    def as_text(self) -> str:
        """Give the verdict, what the paper had, the contacts and where the report is, for a terminal of its width."""
        lines = [in_line(self.metrics.verdict), *_tables(self.metrics, self.source, terminal_columns())]
        return "\n".join([*lines, "", in_line(f"Report: {self.html_path}")])


def _tables(metrics: Metrics, source: ReportSource, width: int | None = None) -> list[str]:
    """Give what the log lacks, what the paper had and the contacts, line by line."""
    lines = [in_line(f"The log is not whole: {source.problem}")] if source.problem else []
    lines += ["", *fit_table([paper_head(metrics), *paper_cells(metrics)], width=width)]
    if metrics.contacts:
        head, rows = contact_rows(metrics, shown_contacts(metrics, PRINTED_CONTACTS))
        left_out = left_out_text(metrics, PRINTED_CONTACTS)
        lines += ["", *fit_table([head, *rows], width=width), *([left_out] if left_out else [])]
    return lines


def write_report(
    log_path: Path,
    truth_path: Path | None,
    out_dir: Path,
    *,
    is_printed: bool = False,
    stretch: TimeWindow = WHOLE,
    progress: Progress = lambda _: None,
) -> Report:
    """Read a log, or a stretch of it, and the emulator's truth if there is one, and write the report into `out_dir`.

    Raises LogError, ConfigError when a log can't be read, and LogError when the report can't be written.
    """
    run, gathered, source = read_run(log_path, truth_path, stretch, progress)
    return write_run_report(run, out_dir, source, gathered, is_printed=is_printed)


def write_run_report(
    run: Run, out_dir: Path, source: ReportSource, gathered: Gathered | None = None, *, is_printed: bool = False
) -> Report:
    """Write the report of a run that is in memory. Raises LogError when it can't be written.

    gathered: what all of its cycles come to, where it does not have all of them.
    """
    metrics = evaluate(run, gathered)
    shown_run = run if has_paper(metrics) else dataclasses.replace(run, beside=None)
    drawings = draw(shown_run, metrics)
    timing = draw_timing(run.timing, metrics.timing, run.zero_ns, "motion start")
    report = Report(
        metrics=metrics,
        metadata=run.metadata,
        source=source,
        html_path=out_dir / HTML_NAME,
        json_path=out_dir / JSON_NAME,
        stretch=run.stretch,
    )
    table = json.dumps(report.as_json(), indent=2, ensure_ascii=False, allow_nan=False)
    files: dict[str, bytes | str] = {
        **report_tables(run, metrics),
        report.json_path.name: table + "\n",
        report.html_path.name: report_page(metrics, shown_run, source, drawings, timing),
    }
    if is_printed:
        files |= {f"{drawing.name}.png": drawing.png() for drawing in drawings if drawing.name in _PNG_FIGURES}
        files["report.png"] = report_png(metrics.verdict, metrics.is_clean, [*drawings, *timing])
    with failing_as(f"report in {out_dir} can't be written"):
        replace_files(out_dir, files)
    return report


_PARAMETERS: Final = ("section", "parameter", "unit", "true", "identified", "std", "cad")
_STATES: Final = ("state", "section", "start_s", "end_s", "duration_s")
_CSV_DIGITS: Final = 9


def report_tables(run: Run, metrics: Metrics) -> dict[str, str]:
    """Write each table, by its file's name."""
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
    """Give a value, or that of each joint."""
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


_WIDTH_IN: Final = 10.0
"""That of all figures."""
_VERDICT_LETTERS: Final = 96
_PNG_DOTS_PER_INCH: Final = 110
_ROOM_IN: Final = 0.32
"""Above each figure, for its title."""


def report_png(verdict: str, is_good: bool, drawings: Sequence[Drawing]) -> bytes:
    """Draw the verdict and all figures below one another, each with its title."""
    with style():
        strips = [_pixels(_head(verdict, is_good))]
        for drawing in drawings:
            strips += [_pixels(_title(drawing.title)), _pixels(drawing.figure)]
    width = max(strip.shape[1] for strip in strips)
    sheet = np.full((sum(len(strip) for strip in strips), width, 4), 255, np.uint8)
    row = 0
    for strip in strips:
        sheet[row : row + len(strip), : strip.shape[1]] = strip
        row += len(strip)
    out = io.BytesIO()
    without_versions: Any = {"Software": None}
    imsave(out, sheet, format="png", metadata=without_versions)
    return out.getvalue()


def _pixels(figure: Figure) -> NDArray[np.uint8]:
    canvas: Any = FigureCanvasAgg(figure)
    figure.dpi = _PNG_DOTS_PER_INCH
    canvas.draw()
    return np.array(canvas.buffer_rgba())


def _head(verdict: str, is_good: bool) -> Figure:
    """Write the verdict, in the colour and the words of whether it is good."""
    words = textwrap.wrap(verdict, _VERDICT_LETTERS)
    figure = Figure(figsize=(_WIDTH_IN, 0.55 + 0.24 * len(words)))
    colour = COLOURS["good" if is_good else "alarm"]
    height_in = figure.get_figheight()
    text = "\n".join([("Good: " if is_good else "Not good: ") + words[0], *words[1:]])
    figure.text(
        0.04, 1.0 - 0.35 / height_in, text, fontsize=12, fontweight="bold", color=colour, va="top", parse_math=False
    )
    return figure


def _title(title: str) -> Figure:
    figure = Figure(figsize=(_WIDTH_IN, _ROOM_IN))
    figure.text(0.04, 0.25, title, fontsize=10.5, fontweight="bold", va="bottom", parse_math=False)
    return figure
