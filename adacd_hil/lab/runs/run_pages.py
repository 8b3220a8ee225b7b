"""Pages over many runs: the list that leads to their reports, and the trend of an arm's figures from run to run."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple
from urllib.parse import quote

import numpy as np

from adacd_hil.lab.report.page import Table, make_table, render_page
from adacd_hil.lab.report.traces import Trace, TracePanel, Track, pack_tracks
from adacd_hil.lab.runs.run_summary import BROKEN, RunSummary
from adacd_hil.lab.runs.run_table import HEAD, NUMBERS, count_text, row_texts
from adacd_hil.lab.runs.run_trend import Trend
from adacd_hil.records import JOINTS

INDEX_NAME: Final = "index.html"
_SIGMAS: Final = 2.0
"""Half the width of the band around a value, in deviations of the certificate."""
_FINEST: Final = 1e-5
_SHORTEST_S: Final = 60.0
"""An eighth of the shortest part of a trend that is shown."""
_SHOWN: Final = 60
"""Changes of a quantity that a page lists, the last ones."""


class ListedRun(NamedTuple):
    """A run of the list.

    report: path of its page; None without one. problem: reason why the log can't be reported, "" if it can.
    """

    run: RunSummary
    report: Path | None
    problem: str = ""

    @property
    def verdict(self) -> str:
        """One line: the run's verdict, or why the log can't be reported."""
        return f"The log can't be reported: {self.problem}" if self.problem else self.run.verdict


def runs_page(folder: Path, listed: Sequence[ListedRun]) -> str:
    """Return the HTML of the list of runs; links to the reports are relative to `folder`."""
    runs = [each.run for each in listed]
    count = count_text(runs)
    return render_page(
        "runs_page.html.j2",
        f"{count} – runs",
        over="adacd-hil runs",
        headline=f"{count[0].upper()}{count[1:]}.",
        is_good=all(run.is_clean for run in runs),
        rows=[(each, _place(folder, each.report), row_texts(each.run)[1:]) for each in listed],
        head=HEAD[1:],
        right=[place - 1 for place in NUMBERS],
    )


def _place(folder: Path, report: Path | None) -> str:
    """Return the link to a report, relative to a folder, percent-encoded; "" without a report."""
    return "" if report is None else quote(Path(os.path.relpath(report, folder)).as_posix())


def trend_page(found: Sequence[Trend]) -> str:
    """Return the HTML of the trends, a section for each arm.

    Runs with a broken log are named at the top, and the page is then not marked as good.
    """
    sections = [
        (trend, f"trend{number}", _changes_table(trend), _runs_table(trend)) for number, trend in enumerate(found)
    ]
    broken = [run.name for trend in found for run in trend.left_out if run.status == BROKEN]
    problems = (f"Left out, as the log is broken: {', '.join(broken)}",) if broken else ()
    return render_page(
        "trend_page.html.j2",
        "Trend over runs",
        over="adacd-hil trend",
        headline=found[0].sentence if len(found) == 1 else f"{len(found)} arms",
        is_good=not broken,
        problems=problems,
        traces=pack_tracks([_track_of(trend, track) for trend, track, *_ in sections], _SHORTEST_S, is_dated=True),
        sections=sections,
    )


def _track_of(trend: Trend, name: str) -> Track:
    """Return a track with the curves of thresholds, friction, offsets and margins over the dates of the runs.

    Runs without a date are left out; dashed curves are `_SIGMAS` deviations apart from a value.
    """
    dated = [row for row, run in enumerate(trend.runs) if run.started is not None]
    at_s = [run.started.timestamp() for run in trend.runs if run.started is not None]
    panels = []
    for number, each in enumerate(trend.quantities):
        traces = []
        for joint in range(JOINTS):
            colour, value, spread = f"joint{joint + 1}", each.values[dated, joint], _SIGMAS * each.std[dated, joint]
            traces.append(Trace(f"joint {joint + 1}", value, _FINEST, colour))
            if np.isfinite(spread).any():
                traces.append(Trace("from", value - spread, _FINEST, colour, is_dashed=True))
                traces.append(Trace("to", value + spread, _FINEST, colour, is_dashed=True))
        panels.append(TracePanel(f"{name}-{number}", each.title, "", tuple(traces)))
    margin = (Trace("run", trend.margins[dated], _FINEST, "beside"),)
    panels.append(TracePanel(f"{name}-margin", "Margin: smallest threshold over residual", "×", margin, levels=(1.0,)))
    return Track(name, np.array(at_s, np.float64), tuple(panels))


def _changes_table(trend: Trend) -> Table:
    rows = [
        (each.title, change.run.name, str(change.joint), f"{change.value_before:.4f}", f"{change.value:.4f}",
         "–" if change.sigmas is None else f"{change.sigmas:.1f}", change.before.name)
        for each in trend.quantities
        for change in each.changes[-_SHOWN:]
    ]  # fmt: skip
    return make_table(("quantity", "changed with", "joint", "from", "to", "deviations", "since"), rows, left=(0, 1, 6))


def _runs_table(trend: Trend) -> Table:
    runs = (*trend.runs, *trend.left_out)
    left = [place for place in range(len(HEAD)) if place not in NUMBERS]
    return make_table(HEAD, [row_texts(run) for run in runs], left=left)
