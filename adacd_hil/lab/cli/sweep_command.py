"""`adacd-hil sweep`: logs or scenarios, settings and seeds, every combination, on all processors or a Dask cluster."""

import os
import shlex
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from adacd_hil.cli.completion import complete_run, complete_scenario, complete_setting
from adacd_hil.cli.options import json_option, profile_option
from adacd_hil.cli.output import CommandError, ExitCode, answer, explain_statuses, explained, text_of
from adacd_hil.clock import LOCKSTEP
from adacd_hil.given_path import GIVEN_FILE, WRITTEN_FOLDER, GivenPath
from adacd_hil.log.log_files import LOG_NAME, SHOWN
from adacd_hil.printable import number_of
from adacd_hil.progress_lines import Progress

if TYPE_CHECKING:
    from adacd_hil.lab.tune.sweep import Plan, SweepRow, Task, Values

_CONFIG = "certified"
"""Configuration of simulated runs without --config."""
_SEEDS = "1"


@click.command(
    epilog=explain_statuses(
        OK="every row has a result",
        PARTIAL="some rows failed, the column `error` has the reason, or a log is damaged, see `notes`, or the disk is "
        "full",
        FAILURE="the cluster is lost, or the folder can't be written",
        USAGE="wrong usage or configuration",
        INTERRUPTED="interrupted: the same command continues",
    )
)
@click.argument("logs", nargs=-1, type=GivenPath(), shell_complete=complete_run)
@click.option(
    "--scenario",
    "scenarios",
    multiple=True,
    metavar="NAME",
    help="Play this scenario instead; repeatable.",
    shell_complete=complete_scenario,
)
@click.option("--seeds", show_default=_SEEDS, metavar="N|A:B", help="Seeds of the scenarios, A to B.")
@click.option(
    "--vary",
    multiple=True,
    metavar="KEY=A,B,...",
    help="A setting's values; every combination is a row.",
    shell_complete=complete_setting,
)
@click.option("--config", default="", metavar="NAME|FILE", help="Configuration; default: each log's own, or certified.")
@profile_option
@click.option("--workers", type=click.IntRange(1, 1024), help="Processes on this machine; default: its processors.")
@click.option(
    "--scheduler",
    default="",
    metavar="ADDRESS",
    help="Dask scheduler to use instead: tls://host:8786. At tcp:// it runs code of anybody who reaches it.",
)
@click.option("--tls-ca-file", type=GIVEN_FILE, help="For tls://: CA that signs the cluster's certificates; PEM.")
@click.option("--tls-cert", type=GIVEN_FILE, help="For tls://: this client's certificate; PEM.")
@click.option("--tls-key", type=GIVEN_FILE, help="For tls://: its key, unless the certificate's file has it; PEM.")
@click.option("--out", required=True, type=WRITTEN_FOLDER, help="Folder of the results.")
@json_option
@explained
def sweep(
    logs: tuple[Path, ...],
    scenarios: tuple[str, ...],
    seeds: str | None,
    vary: tuple[str, ...],
    config: str,
    profile: str | None,
    workers: int | None,
    scheduler: str,
    tls_ca_file: Path | None,
    tls_cert: Path | None,
    tls_key: Path | None,
    out: Path,
    as_json: bool,
) -> ExitCode:
    """Replay LOGS, or play scenarios, with every combination of settings; one table, OUT/sweep.parquet.

    A folder stands for every run.mcap below it. With the same folder again, a sweep computes only missing rows.
    """
    from adacd_hil.lab.tune.sweep import SweepStore, replay_task, run_sweep
    from adacd_hil.lab.tune.workers import NO_FILES, TLS, connect

    if bool(logs) == bool(scenarios):
        raise CommandError("a sweep is of LOGS or of --scenario, one of the two", ExitCode.USAGE)
    options = ("--seeds", seeds, logs), ("--profile", profile, logs), ("--workers", workers, scheduler)
    for name, value, other in options:
        if value is not None and other:
            raise CommandError(
                f"{name} has no effect with {'LOGS' if other is logs else '--scheduler'}", ExitCode.USAGE
            )
    tls = dict(zip(NO_FILES, (tls_ca_file, tls_cert, tls_key), strict=True))
    if any(tls.values()) and not scheduler:
        raise CommandError("a certificate has no effect without --scheduler", ExitCode.USAGE)
    plan = _plan(logs, scenarios, seeds or _SEEDS, vary, config, profile or "")
    work = replay_task if logs else simulate_task
    with Progress() as progress:
        progress(
            f"{number_of(plan.size, 'row')}: {number_of(len(plan.subjects), 'log' if logs else 'run')} × "
            f"{number_of(len(plan.variants), 'setting')}"
        )
        if scheduler and not scheduler.startswith(TLS) and not any(tls.values()):
            progress(
                f"{scheduler} is open: it runs whatever anybody sends who reaches it; tls:// asks for a certificate"
            )
        count = workers or len(os.sched_getaffinity(0))
        with connect(scheduler, min(count, plan.size), tls, (work.__module__, "adacd_hil.replay.replay")) as pool:
            store = SweepStore(out)
            outcome = run_sweep(plan, work, store, pool, progress)
        about = {"version": plan.version, "config": config, "varied": ", ".join(plan.varied)}
        table = store.join(plan.row_keys(), about)
        notes = store.notes(table)
    result = {
        "table": table,
        "rows": plan.size,
        "computed": outcome.computed,
        "found_done": outcome.found,
        "failed": outcome.failed,
        "elapsed_s": round(outcome.elapsed_s, 3),
        "rows_per_s": round(outcome.computed / outcome.elapsed_s, 2) if outcome.elapsed_s else None,
    }
    verdict = f"{plan.size - outcome.failed} of {plan.size} rows are there"
    lines = [verdict, *(f"{key}: {value}" for key, value in result.items()), *notes[:SHOWN]]
    if len(notes) > SHOWN:
        lines.append(f"and {len(notes) - SHOWN} more notes, see the table")
    answer(as_json, result | {"notes": notes}, text_of(lines), _next(table, outcome.failed))
    return ExitCode.PARTIAL if outcome.failed or notes else ExitCode.OK


def _next(table: Path, failed: int) -> str:
    if failed:
        return "the same command again: it computes what failed"
    read = f"import pandas; print(pandas.read_parquet({str(table)!r}))"
    return f"python -c {shlex.quote(read)}   # or any other reader of Parquet"


def _plan(
    logs: Sequence[Path], scenarios: Sequence[str], seeds: str, vary: Sequence[str], config: str, profile: str
) -> "Plan":
    """Return the plan of a sweep of logs or scenarios; check all settings, scenarios and seeds first.

    seeds: "N" or "A:B". vary: "KEY=A,B,..." of each setting. Raises ConfigError, CommandError for one that is wrong, or
    a log that isn't there.
    """
    from adacd_hil import __version__
    from adacd_hil.compiled import program_digest
    from adacd_hil.lab.tune.sweep import Subject, log_subjects, plan_of
    from adacd_hil.settings.configuration_files import load_settings
    from adacd_hil.settings.setting_keys import apply_settings, parse_variations

    variants = parse_variations(vary)
    base = load_settings(config or _CONFIG, profile or None)
    for changes in variants:  # refuse invalid settings before the first run
        apply_settings(base, changes)
    version = f"{__version__} {program_digest()}"
    if logs:
        return plan_of(log_subjects(_files(logs)), variants, config, profile, version)
    from firmware_sim.scenario.scenario import load_scenario

    for scenario in scenarios:
        load_scenario(scenario, base.arm.profile, None)
    numbers = _seeds(seeds)
    runs = (Subject(scenario=scenario, seed=seed) for scenario in scenarios for seed in numbers)
    return plan_of(runs, variants, config, profile, version)


def _files(logs: Sequence[Path]) -> list[Path]:
    """Return the logs; a folder stands for every run.mcap below it.

    Raises CommandError for a log that doesn't exist, or a folder without one.
    """
    found: list[Path] = []
    for given in logs:
        below = sorted(given.rglob(LOG_NAME)) if given.is_dir() else [given]
        if not below or not below[0].exists():
            raise CommandError(f"no {LOG_NAME} in {given}" if given.is_dir() else f"log {given} does not exist")
        found += below
    return found


def _seeds(text: str) -> range:
    """Return the seeds A to B, both included, of the text "A:B", or N alone of "N".

    Raises CommandError for other text.
    """
    first, colon, last = text.partition(":")
    try:
        low, high = int(first), int(last if colon else first)
    except ValueError:
        low, high = 1, 0
    if not 0 <= low <= high:
        raise CommandError(f"--seeds {text!r} is neither a number nor A:B with 0 <= A <= B", ExitCode.USAGE)
    return range(low, high + 1)


def simulate_task(task: "Task") -> "list[Values]":
    """Play a task's scenario with the settings of each row; return a row of results or of an error for each, in order.

    The results are those of a replay of the run's log, which is then deleted. A run that didn't start or broke off, and
    errors of configuration, contract or log, become rows; other errors are raised.
    """
    return [_simulate(task, row) for row in task.rows]


def _simulate(task: "Task", row: "SweepRow") -> "Values":
    from adacd_hil.cli.embedded_run import resolve, run_embedded
    from adacd_hil.lab.tune.sweep import REFUSALS, failed, finished
    from adacd_hil.replay.replay import replay
    from adacd_hil.settings.setting_keys import apply_settings

    subject = task.subject
    try:
        cast = resolve(task.config or _CONFIG, subject.scenario, task.profile or None, subject.seed)
        settings = apply_settings(cast.settings, dict(row.changes))
        with tempfile.TemporaryDirectory(prefix="adacd-hil-sweep-") as name:
            summary, _ = run_embedded(cast._replace(settings=settings), LOCKSTEP, Path(name))
            if summary.result is None:
                return failed(subject, row, summary.error)
            return finished(subject, row, replay(summary.log.path))
    except REFUSALS as refusal:
        return failed(subject, row, str(refusal))
