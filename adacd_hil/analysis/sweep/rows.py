"""Rows of a sweep of logs: what one replay came to, in numbers that a table can hold."""

import statistics
from pathlib import Path

from adacd_hil.analysis.replay.changed_settings import apply_settings, keep_facts
from adacd_hil.analysis.replay.log_source import LogSource
from adacd_hil.analysis.replay.replay import replay_many
from adacd_hil.analysis.replay.replayed_outcome import Replay
from adacd_hil.analysis.sweep.plan import REFUSALS, Subject, SweepRow, Task, Values, failed, row_labels
from adacd_hil.records import SchemeState
from adacd_hil.settings.configuration import Settings, load_settings
from adacd_hil.settings.schema import ConfigError


def replay_task(task: Task) -> list[Values]:
    """Replay a log with the settings of each row; it is decoded once for all of them."""
    subject = task.subject
    path = Path(subject.log)
    found: dict[str, Values] = {}
    variants: dict[str, Settings] = {}
    try:
        own = LogSource(path).settings
        base = keep_facts(own, load_settings(task.config, task.profile or own.arm.profile)) if task.config else own
    except REFUSALS as refusal:
        return [failed(subject, row, str(refusal)) for row in task.rows]
    for row in task.rows:
        try:
            variants[row.key] = apply_settings(base, dict(row.changes))
        except ConfigError as refusal:
            found[row.key] = failed(subject, row, str(refusal))
    rows = [row for row in task.rows if row.key in variants]
    for row, result in zip(rows, _replay_all(path, list(variants.values())), strict=True):
        found[row.key] = failed(subject, row, result) if isinstance(result, str) else finished(subject, row, result)
    return [found[row.key] for row in task.rows]


def _replay_all(path: Path, variants: list[Settings]) -> list[Replay | str]:
    """Replay with each of the settings, or say why one can't be."""
    try:
        return list(replay_many(path, variants))
    except REFUSALS as refusal:
        if len(variants) == 1:
            return [str(refusal)]
    return [result for settings in variants for result in _replay_all(path, [settings])]


def finished(subject: Subject, row: SweepRow, found: Replay) -> Values:
    """Make a row of a replay."""
    score = found.score
    delays_ms = () if score is None else score.delays_ms
    took_s = found.adaptation_s
    last = found.states[-1] if found.states else None
    return row_labels(subject, row) | {
        "status": "ok",
        "error": None,
        "cycles": found.cycles,
        "attempts": found.attempts,
        "identical": found.is_identical if found.compared else None,
        "ends_in": last.state.name if last else SchemeState.INIT.name,
        "fault": last.fault.name if last else "NONE",
        "adaptations": sum(each is not None for each in took_s),
        "adaptation_first_s": took_s[0] if took_s else None,
        "adaptation_last_s": took_s[-1] if took_s else None,
        "monitored_s": found.monitored_s,
        "detections": len(found.detections_ns),
        "touches_armed": None if score is None else score.armed,
        "touches_found": None if score is None else len(delays_ms),
        "missed": None if score is None else score.missed,
        "false_alarms": None if score is None else len(score.false_alarms),
        "delay_median_ms": statistics.median(delays_ms) if delays_ms else None,
        "delay_max_ms": max(delays_ms, default=None),
        **{f"theta_hat.{name}": value for name, value in found.parameters.items()},
    }
