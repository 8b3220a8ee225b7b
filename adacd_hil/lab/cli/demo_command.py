"""A scenario in one process, then the report."""

import functools
from pathlib import Path
from typing import TYPE_CHECKING

from adacd_hil.cli.embedded_run import SCENARIO, resolve, run_embedded
from adacd_hil.cli.output import CommandError, ExitCode, exit_code, run_folder
from adacd_hil.control.session import LiveView
from adacd_hil.error_texts import error_text
from adacd_hil.log.log_files import LOG_NAME, TRUTH_NAME, LogError
from adacd_hil.progress_lines import Progress

if TYPE_CHECKING:
    from adacd_hil.lab.report.report_files import Report


def play(
    config: str,
    scenario: str,
    profile: str | None,
    seed: int | None,
    clock: str,
    out: Path | None,
    live: LiveView | None = None,
    truth: str | None = None,
) -> tuple["Report", ExitCode]:
    """Play a scenario with an emulated arm, and write log and report; return report and exit status.

    config, scenario, truth: names or files; truth: how the real arm differs from the configuration. profile, seed:
    None: those of configuration and scenario. clock: "lockstep" or "realtime". out: folder; None: a new one by
    date. live: shows the run. Raises ConfigError, CodecError for names or files that can't be used, LogError, OSError
    if log or report can't be written, CommandError for a run that failed.
    """
    cast = resolve(config, scenario, profile, seed, truth)
    settings = cast.settings
    what = "experiment" if scenario == SCENARIO else f"scenario {cast.scenario.name}"
    with run_folder(out, (LOG_NAME, TRUTH_NAME), "demo") as folder, Progress() as progress:
        arm = f"profile {settings.arm.profile}" if cast.scenario.own_arm is None else "its own arm"
        progress(f"{what} of configuration {settings.name}, {arm}, in {folder.path}")
        for line in cast.assumed:
            progress(line)
        on_started = functools.partial(folder.link, progress)
        summary, truth_path = run_embedded(cast, clock, folder.path, progress, live, on_started)
        if summary.result is not None:
            played_s = summary.result.cycles * settings.bus.period_s
            pace = played_s / summary.elapsed_s
            progress(f"{played_s:.1f} s played in {summary.elapsed_s:.1f} s: {pace:.1f} x real time")
        progress("drawing the report")
        from adacd_hil.lab.report.report_files import write_report

        try:
            report = write_report(
                summary.log.path, truth_path, folder.path, config=config, scenario=scenario, truth=truth or ""
            )
        except (OSError, LogError) as error:
            status = exit_code(summary)
            if status is ExitCode.OK:
                raise
            ending = summary.error or "the run did not end well"
            raise CommandError(f"{ending}; nor can the report be written: {error_text(error)}", status) from None
        progress(f"report: {report.html_path}")
    if summary.error:
        raise CommandError(summary.error, exit_code(summary))
    return report, exit_code(summary)
