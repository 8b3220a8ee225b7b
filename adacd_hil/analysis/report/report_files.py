"""The report of a run: one self-contained HTML page, the same numbers as JSON and CSV, and the paper's figures as PNG.

Where it is asked for, it is printed, too: report.pdf and report.png have the words and all figures.

The same log gives the same bytes.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from adacd_hil.analysis.figures import draw
from adacd_hil.analysis.logged_run import Run, StretchOfRun
from adacd_hil.analysis.metrics import Gathered, Metrics, evaluate
from adacd_hil.analysis.report.bounds import PRINTED_CONTACTS
from adacd_hil.analysis.report.csv_tables import report_tables
from adacd_hil.analysis.report.json_form import report_json
from adacd_hil.analysis.report.print_form import report_pdf, report_png
from adacd_hil.analysis.report.reading import Progress, Source, read_run
from adacd_hil.analysis.report.run_page import report_page
from adacd_hil.analysis.report.words import (
    contact_rows,
    left_out_text,
    paper_cells,
    paper_head,
    shown_contacts,
)
from adacd_hil.analysis.timing_figures import draw_timing
from adacd_hil.log.log_files import LogError
from adacd_hil.log.time_window import WHOLE, TimeWindow
from adacd_hil.output_files import replace_file
from adacd_hil.terminal import fit_table, in_line, terminal_columns

HTML_NAME: Final = "report.html"
JSON_NAME: Final = "report.json"
_PNG_FIGURES: Final = ("fig5", "fig6", "fig7")


@dataclass(frozen=True)
class Report:
    """A report that has been written."""

    metrics: Metrics
    metadata: Mapping[str, str]
    source: Source
    html_path: Path
    json_path: Path
    figure_paths: tuple[Path, ...]
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


def _tables(metrics: Metrics, source: Source, width: int | None = None) -> list[str]:
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
    run: Run, out_dir: Path, source: Source, gathered: Gathered | None = None, *, is_printed: bool = False
) -> Report:
    """Write the report of a run that is in memory. Raises LogError when it can't be written.

    gathered: what all of its cycles come to, where it does not have all of them.
    """
    metrics = evaluate(run, gathered)
    drawings = draw(run, metrics)
    timing = draw_timing(run.timing, metrics.timing, run.zero_ns, "motion start")
    pngs = {drawing.name: drawing.png() for drawing in drawings if drawing.name in _PNG_FIGURES}
    report = Report(
        metrics=metrics,
        metadata=run.metadata,
        source=source,
        html_path=out_dir / HTML_NAME,
        json_path=out_dir / JSON_NAME,
        figure_paths=tuple(out_dir / f"{name}.png" for name in pngs),
        stretch=run.stretch,
    )
    table = json.dumps(report.as_json(), indent=2, ensure_ascii=False, allow_nan=False)
    texts = {
        **report_tables(run, metrics),
        report.json_path.name: table + "\n",
        report.html_path.name: report_page(metrics, run, source, drawings, timing),
    }
    files = {f"{name}.png": png for name, png in pngs.items()}
    files |= {name: text.encode() for name, text in texts.items()}
    if is_printed:
        shown, verdict = [*drawings, *timing], (metrics.verdict, metrics.is_clean)
        files["report.pdf"] = report_pdf(*verdict, _tables(metrics, source), shown)
        files["report.png"] = report_png(*verdict, shown)
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            replace_file(out_dir / name, content)
    except OSError as error:
        raise LogError(f"report in {out_dir} can't be written: {error.strerror}") from None
    return report
