"""The page over a folder of runs: a row for each with its verdict and a link to its report."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple
from urllib.parse import quote

from adacd_hil.analysis.report.page import Heading, render_page
from adacd_hil.analysis.report.report_files import Report
from adacd_hil.analysis.report.words import NONE

INDEX_NAME: Final = "index.html"
_ORIGIN: Final = ("config", "profile", "interface")
"""Metadata with a column each."""


class Entry(NamedTuple):
    """A run of the folder: its name there, and its report, or why it has none."""

    name: str
    report: Report | None
    problem: str = ""

    @property
    def is_clean(self) -> bool:
        """Whether the run was good and its log is whole."""
        return self.report is not None and self.report.metrics.is_clean and self.report.is_complete

    @property
    def verdict(self) -> str:
        """What is to be said of it in a line."""
        if self.report is None:
            return f"The log can't be reported: {self.problem}"
        missing = f" The log is not whole: {self.report.source.problem}" if self.report.source.problem else ""
        return self.report.metrics.verdict + missing


def count_text(entries: Sequence[Entry]) -> str:
    """Say how many runs there are and how many of them are not good."""
    bad = sum(not entry.is_clean for entry in entries)
    runs = "1 run" if len(entries) == 1 else f"{len(entries)} runs"
    return f"{runs}, {'all good' if bad == 0 else f'{bad} not good'}"


class _IndexRow(NamedTuple):
    """A run in the table: the place of its report, how long it lasted, and what it was made with."""

    entry: Entry
    place: str
    lasts: str
    origin: Sequence[str]


def index_page(folder: Path, entries: Sequence[Entry]) -> str:
    """Write the page, which lies in `folder`."""
    count = count_text(entries)
    heading = Heading("adacd-hil run reports", f"{count}.", (), all(entry.is_clean for entry in entries))
    rows = [_row(folder, entry) for entry in entries]
    return render_page("index_page.html.j2", f"{count} – run reports", heading, rows=rows)


def _row(folder: Path, entry: Entry) -> _IndexRow:
    if entry.report is None:
        return _IndexRow(entry, "", NONE, [NONE] * len(_ORIGIN))
    place = quote(entry.report.html_path.relative_to(folder).as_posix())
    origin = [entry.report.metadata.get(key) or NONE for key in _ORIGIN]
    return _IndexRow(entry, place, f"{entry.report.metrics.cycle.duration_s:.1f}", origin)
