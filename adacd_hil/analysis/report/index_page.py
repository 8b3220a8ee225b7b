"""The page over a folder of runs: a row for each with its verdict and a link to its report."""

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Final, NamedTuple
from urllib.parse import quote

from adacd_hil.analysis.report.page import Cell, document, heading, make_table
from adacd_hil.analysis.report.report import Report
from adacd_hil.analysis.report.words import NONE

INDEX_NAME: Final = "index.html"


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


def index_page(folder: Path, entries: Sequence[Entry]) -> str:
    """Write the page, which lies in `folder`."""
    rows: list[Sequence[Cell]] = [(_link(folder, entry), _verdict(entry), *_told(entry)) for entry in entries]
    head = ("run", "verdict", "lasts, s", "configuration", "profile", "interface")
    title = f"{count_text(entries)}."
    parts = [
        heading("adacd-hil run reports", title, (), all(entry.is_clean for entry in entries)),
        make_table(head, rows, left=(0, 1, 3, 4, 5)),
    ]
    return document(f"{count_text(entries)} – run reports", parts)


def _link(folder: Path, entry: Entry) -> Cell:
    name = escape(entry.name)
    if entry.report is None:
        return name
    place = entry.report.html_path.relative_to(folder).as_posix()
    return f'<a href="{escape(quote(place))}">{name}</a>'


def _told(entry: Entry) -> Sequence[Cell]:
    if entry.report is None:
        return NONE, NONE, NONE, NONE
    metadata = entry.report.metadata
    words = [escape(metadata.get(key) or NONE) for key in ("config", "profile", "interface")]
    return f"{entry.report.metrics.cycle.duration_s:.1f}", *words


def _verdict(entry: Entry) -> Cell:
    word, tone = ("good", "strong") if entry.is_clean else ("not good", "bad")
    return f'<b class="{tone}">{word}</b> {escape(entry.verdict)}', "wide"
