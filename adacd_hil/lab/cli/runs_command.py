"""`adacd-hil runs` and `trend`: the runs of a folder, and the changes of an arm's figures from run to run."""

import dataclasses
import functools
from collections.abc import Callable, Iterable
from datetime import datetime, timedelta
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from adacd_hil.cli.options import FiniteRange, json_option, with_options
from adacd_hil.cli.output import (
    RUNS,
    CommandError,
    ExitCode,
    answer,
    explain_statuses,
    explained,
    format_table,
)
from adacd_hil.given_path import WRITTEN_FILE, GivenPath
from adacd_hil.lab.stated_bounds import MEANT_SHARE, STATUSES, THRESHOLD_SHARE
from adacd_hil.log.log_files import LOG_NAME, LogError
from adacd_hil.printable import in_line, number_of
from adacd_hil.progress_lines import Progress
from adacd_hil.remedies import nearest_name
from adacd_hil.settings.toml_files import toml_names

if TYPE_CHECKING:
    from adacd_hil.lab.runs.run_summary import RunSummary
    from adacd_hil.lab.runs.run_table import RunFilter
    from adacd_hil.lab.runs.run_trend import Trend

_EPILOG = explain_statuses(
    OK="done",
    FAILURE="no run there, or a file can't be written",
    USAGE="wrong usage",
    PARTIAL="the log of a run is broken, the others are listed",
    INTERRUPTED="interrupted",
)
_DATE_FORMS = "2026-11-25, 2026-11-25T14:22 or 2026-11-25T14:22:33"


def _local_date(text: str, of_a_day: timedelta = timedelta()) -> datetime:
    """Return the time that an ISO text gives in this machine's time zone, or in its own if it names one.

    of_a_day: added to a date without a time. Raises BadParameter for any other text.
    """
    try:
        found = datetime.fromisoformat(text)
        if len(text) <= len("2026-11-25"):
            found += of_a_day
        return found.astimezone()
    except (ValueError, OverflowError, OSError):
        raise click.BadParameter(f"{text!r} is no date such as {_DATE_FORMS}") from None


def _end_of_date(text: str) -> datetime:
    return _local_date(text, timedelta(days=1, microseconds=-1))


def _filtered(command: Callable[..., ExitCode]) -> Callable[..., Any]:
    """Return a command with added options that choose runs; it receives them as `asked`, a `RunFilter`.

    It ends the process with its exit status, as `explained`. A --since after --until is a CommandError.
    """

    @functools.wraps(command)
    def chosen(
        *args: Any,
        arms: tuple[str, ...],
        scenarios: tuple[str, ...],
        since: datetime | None,
        until: datetime | None,
        statuses: tuple[str, ...] = (),
        **own: Any,
    ) -> ExitCode:
        from adacd_hil.lab.runs.run_table import RunFilter

        if since is not None and until is not None and until < since:
            raise CommandError(f"--since {since} is after --until {until}", ExitCode.USAGE)
        return command(*args, asked=RunFilter(arms, statuses, scenarios, since, until), **own)

    return with_options(
        explained(chosen),
        click.option(
            "--arm",
            "arms",
            multiple=True,
            metavar="NAME",
            help="Runs of this arm or configuration, or a pattern; repeatable.",
        ),
        click.option(
            "--scenario", "scenarios", multiple=True, metavar="NAME", help="Runs of this scenario; repeatable."
        ),
        click.option("--since", type=_local_date, metavar="DATE", help="Runs begun since then."),
        click.option("--until", type=_end_of_date, metavar="DATE", help="Runs begun until then, that day included."),
    )


_folder_argument = click.argument("folder", type=GivenPath(file_okay=False), default=RUNS, required=False)


@click.command(epilog=_EPILOG)
@_folder_argument
@click.option(
    "--verdict", "statuses", multiple=True, type=click.Choice(STATUSES), help="Runs with this verdict; repeatable."
)
@click.option("--judge", "is_judging", is_flag=True, help="Read the whole log of each run without a report.")
@click.option("--csv", "csv_path", type=WRITTEN_FILE, help="Write the table here.")
@click.option(
    "--parquet",
    "parquet_path",
    type=WRITTEN_FILE,
    help="Write the table here as Parquet, for DuckDB and others.",
)
@click.option("--html", "html_path", type=WRITTEN_FILE, help="Write a page that leads to the reports.")
@json_option
@_filtered
def runs(
    folder: Path,
    is_judging: bool,
    csv_path: Path | None,
    parquet_path: Path | None,
    html_path: Path | None,
    as_json: bool,
    asked: "RunFilter",
) -> ExitCode:
    """List the runs in FOLDER, default `runs`: verdict, certificate, thresholds, margin, contacts; oldest first.

    Figures come from the report beside a log. A run without one is described by its events, and not judged: `adacd-hil
    report FOLDER` reports all, --judge reads their logs and stores nothing. Links, and folders deep below FOLDER, are
    skipped.
    """
    from adacd_hil.lab.runs import run_table

    with Progress() as progress:
        found = _chosen(folder, asked, is_judging, progress)
        if csv_path is not None:
            run_table.write_result(run_table.as_csv(found), csv_path)
        if parquet_path is not None:
            run_table.write_parquet(found, parquet_path)
        if html_path is not None:
            run_table.write_result(_page(found, html_path), html_path)
    described = [run_table.values_of(run) for run in found]
    answer(as_json, {"folder": folder, "runs": described}, _as_text(found))
    return _code(found)


@click.command(epilog=_EPILOG)
@_folder_argument
@click.option(
    "--share",
    type=FiniteRange(0.0, 10.0, min_open=True),
    default=THRESHOLD_SHARE,
    show_default=True,
    help=f"A threshold that differs by more than this share has changed; {MEANT_SHARE:g} of it where settings have.",
)
@click.option("--out", type=WRITTEN_FILE, metavar="FILE.html", help="Write a page with its curves and tables.")
@json_option
@_filtered
def trend(folder: Path, share: float, out: Path | None, as_json: bool, asked: "RunFilter") -> ExitCode:
    """Find when thresholds, friction and torque offsets of an arm last changed over the runs in FOLDER; draw them.

    Runs without a report are judged first, which reads their logs. A friction or an offset has changed if it differs by
    more than the standard deviations of both certificates explain.
    """
    from adacd_hil.lab.runs.run_pages import trend_page
    from adacd_hil.lab.runs.run_summary import with_devices
    from adacd_hil.lab.runs.run_table import write_result
    from adacd_hil.lab.runs.run_trend import trends

    if out is not None and out.suffix.lower() != ".html":
        raise CommandError(
            f"--out {out} doesn't end in .html: a trend is a page, which a browser prints", ExitCode.USAGE
        )
    with Progress() as progress:
        found = list(map(with_devices, _chosen(folder, asked, True, progress)))
        made = trends(found, share)
        if out is not None:
            write_result(trend_page(made), out)
    described = {"folder": folder, "arms": [each.by_key() for each in made]}
    answer(as_json, described, "\n\n".join(map(_trend_text, made)) or "no run")
    return _code(found)


def _chosen(folder: Path, asked: "RunFilter", is_judging: bool, progress: Progress) -> list["RunSummary"]:
    """Return the runs of a folder that meet the conditions `asked`, oldest first; [] if none does.

    is_judging: judge runs without a report by their logs, before the verdict is looked at; nothing is stored. Raises
    LogError for a folder that is missing or has no run, CommandError if one of the arms in `asked` has no run there, or
    one of its scenarios has none and isn't built in either.
    """
    from adacd_hil.lab.runs import run_table
    from adacd_hil.lab.runs.run_summary import NOT_JUDGED, find_runs, judged, summarise

    if not folder.is_dir():
        what = (
            "does not exist; `adacd-hil demo` and `run` make runs in `runs`" if not folder.exists() else "is no folder"
        )
        raise LogError(f"{folder} {what}")
    found = [summarise(each, each.relative_to(folder).as_posix()) for each in find_runs(folder)]
    if not found:
        raise LogError(f"{folder} has no {LOG_NAME}, nor has any folder in it")
    for arm in asked.arms:
        if not any(run_table.is_arm(run, arm) for run in found):
            raise _no_run_of("arm", arm, folder, {run.arm for run in found}, {run.config for run in found})
    for scenario in asked.scenarios:
        known, builtin = {run.scenario for run in found}, toml_names(resources.files("firmware_sim") / "scenarios")
        if scenario not in (*known, *builtin):
            raise _no_run_of("scenario", scenario, folder, known, builtin)
    if is_judging:  # which may change the verdict: it is filtered afterwards
        with_any_verdict = dataclasses.replace(asked, statuses=())
        found = [run for run in found if with_any_verdict.takes(run)]
        if waiting := sum(run.status == NOT_JUDGED for run in found):
            progress(f"reading {number_of(waiting, 'log')} without a report; `adacd-hil report` keeps the figures")
        found = [judged(run) for run in found]
    return [run for run in run_table.in_order(found) if asked.takes(run)]


def _no_run_of(what: str, name: str, folder: Path, named: Iterable[str], others: Iterable[str] = ()) -> CommandError:
    """Return the error for a name that no run has: with the nearest of `named` and `others`, else all of `named`."""
    known = sorted(filter(None, named))
    near = nearest_name(name, [*known, *sorted(filter(None, others))])
    hint = f"did you mean {near!r}?" if near else f"there are {', '.join(known) or 'none that is named'}"
    return CommandError(f"no run of {what} {name!r} in {folder}; {hint}", ExitCode.USAGE)


def _page(found: list["RunSummary"], path: Path) -> str:
    from adacd_hil.lab.report.report_files import HTML_NAME
    from adacd_hil.lab.runs.run_pages import ListedRun, runs_page

    listed = []
    for run in found:
        report = run.log.parent / HTML_NAME
        listed.append(ListedRun(run, report if report.is_file() else None))
    return runs_page(path.parent, listed)


def _as_text(found: list["RunSummary"]) -> str:
    from adacd_hil.lab.runs.run_table import HEAD, NUMBERS, count_text, row_texts

    if not found:
        return "no run is as asked for"
    lines = [format_table(HEAD, [row_texts(run) for run in found], right=NUMBERS), "", f"{count_text(found)}"]
    lines += [in_line(f"{run.name}: {run.status}: {run.verdict}") for run in found if run.verdict and not run.is_clean]
    return "\n".join(lines)


def _trend_text(made: "Trend") -> str:
    from adacd_hil.lab.runs.run_table import HEAD, NUMBERS, row_texts

    left = f", {len(made.left_out)} left out" if made.left_out else ""
    lines = [in_line(line) for line in (f"{made.arm}: {number_of(len(made.runs), 'run')}{left}", made.sentence)]
    lines += [in_line(line) for line in (*made.further, made.assumed) if line]
    lines += [in_line(f"left out: {run.name}: {run.status}: {run.verdict}") for run in made.left_out]
    if made.runs:
        lines += ["", format_table(HEAD[:6], [row_texts(run)[:6] for run in made.runs], right=NUMBERS[:1])]
    return "\n".join(lines)


def _code(found: list["RunSummary"]) -> ExitCode:
    return ExitCode.PARTIAL if any(run.status == "broken" for run in found) else ExitCode.OK
