"""Runs of the emulated arm as rows of a sweep: each is played in a folder of its own, replayed, and forgotten."""

import tempfile
from pathlib import Path

from adacd_hil.analysis.replay.replay import replay
from adacd_hil.analysis.replay.what_if import apply_settings
from adacd_hil.analysis.sweep.plan import REFUSALS, Row, Task, Values, failed, finished
from adacd_hil.cli.commands.demo_command import resolve, run_embedded
from adacd_hil.settings.configuration import Settings

DEFAULT_CONFIG = "certified"


def simulate_task(task: Task) -> list[Values]:
    """Play the scenario of a task with the settings of each row."""
    return [_simulate(task, row) for row in task.rows]


def _simulate(task: Task, row: Row) -> Values:
    subject = task.subject
    try:
        cast = resolve(task.config or DEFAULT_CONFIG, subject.scenario, task.profile or None, subject.seed)
        settings: Settings = apply_settings(cast.settings, dict(row.changes))
        with tempfile.TemporaryDirectory(prefix="adacd-hil-sweep-") as name:
            summary, _ = run_embedded(cast._replace(settings=settings), "lockstep", Path(name))
            if summary.result is None:
                return failed(subject, row, summary.error)
            return finished(subject, row, replay(summary.log.path))
    except REFUSALS as refusal:
        return failed(subject, row, str(refusal))
