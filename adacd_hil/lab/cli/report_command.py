"""Reports of logs and of folders of runs, for the command `report`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from adacd_hil.cli.output import CommandError, ExitCode, one_by_one
from adacd_hil.file_replacement import replace_file
from adacd_hil.lab.report.report_files import Report, write_report
from adacd_hil.lab.runs.run_pages import INDEX_NAME, ListedRun, runs_page
from adacd_hil.lab.runs.run_summary import BROKEN, RunSummary, find_runs, reported
from adacd_hil.lab.runs.run_table import count_text
from adacd_hil.log.log_files import LOG_NAME, TRUTH_NAME, LogError, failing_as
from adacd_hil.log.log_parts import log_in
from adacd_hil.log.time_window import TimeWindow
from adacd_hil.printable import one_line
from adacd_hil.progress_lines import Progress
from adacd_hil.settings.schema import ConfigError


class Index(NamedTuple):
    """Runs of a folder, each with its report, None if it can't be reported. path: of the page that lists them."""

    path: Path
    entries: list[tuple[ListedRun, Report | None]]

    def as_text(self) -> str:
        """Return the index as text: the number of runs, a line for each with its verdict, and the page's path."""
        lines = [count_text([listed.run for listed, _ in self.entries]), ""]
        for listed, _ in self.entries:
            run = listed.run
            lines.append(f"{run.name}: {'good' if run.is_clean else 'NOT GOOD'}: {one_line(listed.verdict)}")
        return "\n".join([*lines, "", f"Index: {self.path}"])


Reported = Report | Index


def report_logs(
    logs: tuple[Path, ...], out: Path | None, stretch: TimeWindow
) -> tuple[list[Reported], list[Exception], ExitCode]:
    """Write a report of each log, or of a stretch of it, beside it or in `out`; return reports, errors, exit status.

    Reports of several logs are in subfolders of `out`. A folder stands for the run log in it, or without one for the
    runs in its folders: these give one `Index`, which has a page, and each run's report or problem. An error doesn't
    stop the others. The exit status is PARTIAL if a report is incomplete, or a run in a folder has none, else OK; the
    returned errors, those of given logs, don't change it.

    Raises CommandError if two reports would go to one folder.
    """
    found, refused = one_by_one(logs, _runs_in)
    places: dict[Path, tuple[Path, tuple[Path, ...]]] = {}  # by folder of the report
    for given, runs in found:
        own = given if runs else log_in(given).parent
        folder = own if out is None else out if len(logs) == 1 else out / own.name
        if folder in places:
            raise CommandError(f"two reports would go to {folder}; report these logs one by one", ExitCode.USAGE)
        places[folder] = given, runs
    with Progress() as progress:

        def report(place: tuple[Path, tuple[Path, tuple[Path, ...]]]) -> Reported:
            folder, (given, runs) = place
            if runs:
                return _report_runs(given, runs, folder, stretch, progress)
            return _report_one(log_in(given), folder, stretch, progress)

        reported, failed = one_by_one(places.items(), report)
    code = ExitCode.OK if all(map(_is_complete, reported)) else ExitCode.PARTIAL
    return reported, refused + failed, code


def _runs_in(given: Path) -> tuple[Path, tuple[Path, ...]]:
    """Return the given path, and the folders with a run below it, () for a file or a folder that itself has a run.

    Folders below it that can't be read are among them. Raises LogError for a folder without a run, OSError for one that
    can't be listed.
    """
    if not given.is_dir() or (given / LOG_NAME).exists():
        return given, ()
    runs = tuple(find_runs(given))
    if not runs:
        raise LogError(f"{given} has no {LOG_NAME}, nor has any folder in it")
    return given, runs


def _report_runs(given: Path, runs: Sequence[Path], out: Path, stretch: TimeWindow, progress: Progress) -> Index:
    """Write a report of each run of a folder, and an index page of all in `out`; return the index.

    A run that can't be reported is listed with its problem. Raises LogError if the page can't be written.
    """
    entries: list[tuple[ListedRun, Report | None]] = []
    for number, run in enumerate(runs, start=1):
        name = run.relative_to(given).as_posix()
        progress(f"{number} of {len(runs)}: {run}")
        try:
            report = _report_one(run / LOG_NAME, out / name, stretch, progress)
            listed = ListedRun(reported(run, name, report.content), report.html_path)
            entries.append((listed, report))
        except (LogError, ConfigError) as error:
            problem = one_line(error)
            progress(problem)
            broken = RunSummary(name, run / LOG_NAME, BROKEN, problem)
            entries.append((ListedRun(broken, None, problem), None))
    index = Index(out / INDEX_NAME, entries)
    with failing_as(f"{index.path} can't be written"):
        out.mkdir(parents=True, exist_ok=True)  # missing if no run could be reported
        replace_file(index.path, runs_page(out, [listed for listed, _ in entries]))
    return index


def as_json(reported: Sequence[Reported]) -> list[dict[str, Any]]:
    """Return the content of each report.json; in its place, for a run that can't be reported, its folder and problem.

    The runs of an index are listed one by one, each with its folder.
    """
    tables = []
    for each in reported:
        if isinstance(each, Report):
            tables.append(each.content)
            continue
        for listed, report in each.entries:
            table = {"problem": listed.problem} if report is None else report.content
            tables.append({"folder": listed.run.name, **table})
    return tables


def _report_one(path: Path, folder: Path, stretch: TimeWindow, progress: Progress) -> Report:
    truth = path.parent / TRUTH_NAME
    truth_path = truth if truth.exists() else None
    return write_report(path, truth_path, folder, stretch=stretch, progress=progress)


def _is_complete(reported: Reported | None) -> bool:
    """Return whether a report is complete, of an index all reports; False for None, a run without one."""
    if isinstance(reported, Index):
        return all(_is_complete(report) for _, report in reported.entries)
    return reported is not None and reported.is_complete
