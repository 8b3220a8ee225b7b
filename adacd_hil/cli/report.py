"""Reports of logs that lie on disk."""

from pathlib import Path

from adacd_hil.analysis.report.report import Report, write_report
from adacd_hil.cli.exit_codes import CommandError, ExitCode
from adacd_hil.cli.progress import Progress
from adacd_hil.log.run_folder import TRUTH_NAME, log_in
from adacd_hil.log.stretch import Stretch


def report_logs(logs: tuple[Path, ...], out: Path | None, stretch: Stretch) -> tuple[list[Report], ExitCode]:
    """Report each log, or a stretch of it, beside it or in `out`; a folder stands for the run log in it.

    Raises LogError, ConfigError.
    """
    reports = []
    progress = Progress()
    is_complete = True
    names: set[Path] = set()
    for given in logs:
        path = log_in(given)
        folder = path.parent if out is None else out if len(logs) == 1 else out / path.parent.name
        if folder in names:
            raise CommandError(f"two reports would go to {folder}; report these logs one by one", ExitCode.USAGE)
        names.add(folder)
        truth = path.parent / TRUTH_NAME
        truth_path = truth if truth.exists() else None
        report = write_report(path, truth_path, folder, is_printed=True, stretch=stretch, progress=progress)
        is_complete = is_complete and report.is_complete
        reports.append(report)
    progress.close()
    return reports, ExitCode.OK if is_complete else ExitCode.PARTIAL
