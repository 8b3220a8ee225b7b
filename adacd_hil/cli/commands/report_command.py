"""Reports of logs and of folders of runs: the command's work."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from adacd_hil.analysis.report.report_files import INDEX_NAME, IndexEntry, Report, count_text, index_page, write_report
from adacd_hil.cli.output import CommandError, ExitCode, Progress
from adacd_hil.file_access import replace_file
from adacd_hil.log.log_files import LOG_NAME, TRUTH_NAME, LogError, TimeWindow, failing_as, log_in
from adacd_hil.settings.schema import ConfigError
from adacd_hil.terminal import one_line

DEEPEST = 4
"""Levels below a folder in which its runs are looked for."""


class Index(NamedTuple):
    """What was reported of a folder of runs, and the page over it."""

    path: Path
    entries: tuple[IndexEntry, ...]

    def as_text(self) -> str:
        """Give a line for each run."""
        lines = [f"{count_text(self.entries)}", ""]
        for entry in self.entries:
            lines.append(f"{entry.name}: {'good' if entry.is_clean else 'NOT GOOD'}: {one_line(entry.verdict)}")
        return "\n".join([*lines, "", f"Index: {self.path}"])


Reported = Report | Index


def report_logs(logs: tuple[Path, ...], out: Path | None, stretch: TimeWindow) -> tuple[list[Reported], ExitCode]:
    """Report each log, or a stretch of it, beside it or in `out`; of several logs in folders of `out`.

    A folder stands for the run log in it, or without one for the runs in its folders; of those one that can't be read
    does not keep the others from being reported. Raises LogError, ConfigError, CommandError.
    """
    places: dict[Path, tuple[Path, tuple[Path, ...]]] = {}  # by folder of the report
    for given in logs:
        runs = runs_in(given)
        if given.is_dir() and not runs and not (given / LOG_NAME).exists():
            raise LogError(f"{given} has no {LOG_NAME}, nor has any folder in it")
        own = given if runs else log_in(given).parent
        folder = own if out is None else out if len(logs) == 1 else out / own.name
        if folder in places:
            raise CommandError(f"two reports would go to {folder}; report these logs one by one", ExitCode.USAGE)
        places[folder] = given, runs
    reported: list[Reported] = []
    codes = []
    with Progress() as progress:
        for folder, (given, runs) in places.items():
            if runs:
                index = _report_runs(given, runs, folder, stretch, progress)
                reported.append(index)
                codes += [_code(entry.report) for entry in index.entries]
            else:
                report = _report_one(log_in(given), folder, stretch, progress)
                reported.append(report)
                codes.append(_code(report))
    return reported, ExitCode.OK if set(codes) <= {ExitCode.OK} else ExitCode.PARTIAL


def runs_in(given: Path) -> tuple[Path, ...]:
    """List the folders with a run below a folder that has none itself, by name; links are left alone."""
    if not given.is_dir() or (given / LOG_NAME).exists():
        return ()
    found = []
    for folder, names, files in os.walk(given):
        here = Path(folder)
        if LOG_NAME in files:
            found.append(here)
        if len(here.relative_to(given).parts) >= DEEPEST:
            names.clear()
        names.sort()
    return tuple(found)


def _report_runs(given: Path, runs: Sequence[Path], out: Path, stretch: TimeWindow, progress: Progress) -> Index:
    """Report the runs of a folder, and write the page over them."""
    entries = []
    for number, run in enumerate(runs, start=1):
        name = run.relative_to(given)
        progress(f"{number} of {len(runs)}: {run}")
        try:
            entries.append(IndexEntry(name.as_posix(), _report_one(run / LOG_NAME, out / name, stretch, progress)))
        except (LogError, ConfigError) as error:
            progress(one_line(error))
            entries.append(IndexEntry(name.as_posix(), None, one_line(error)))
    index = Index(out / INDEX_NAME, tuple(entries))
    with failing_as(f"{index.path} can't be written"):
        out.mkdir(parents=True, exist_ok=True)  # as after no run could be reported
        replace_file(index.path, index_page(out, entries))
    return index


def as_json(reported: Sequence[Reported]) -> list[dict[str, Any]]:
    """Give the content of each report.json; of a run that could not be reported its folder and why."""
    tables = []
    for each in reported:
        for entry in each.entries if isinstance(each, Index) else (IndexEntry("", each),):
            table = {"problem": entry.problem} if entry.report is None else entry.report.as_json()
            tables.append({"folder": entry.name, **table} if isinstance(each, Index) else table)
    return tables


def _report_one(path: Path, folder: Path, stretch: TimeWindow, progress: Progress) -> Report:
    truth = path.parent / TRUTH_NAME
    truth_path = truth if truth.exists() else None
    return write_report(path, truth_path, folder, is_printed=True, stretch=stretch, progress=progress)


def _code(report: Report | None) -> ExitCode:
    return ExitCode.OK if report is not None and report.is_complete else ExitCode.PARTIAL
