"""The outcome of a played scenario, as its `expect` describes it."""

from pathlib import Path

from adacd_hil.control.session import SessionSummary
from adacd_hil.lab.report.run_reading import read_run
from adacd_hil.lab.score.evaluation import evaluate
from adacd_hil.records import FaultReason
from firmware_sim.scenario.scenario import ScenarioOutcome


def outcome_of(summary: SessionSummary, truth_path: Path) -> ScenarioOutcome:
    """Return the outcome of a finished run by its logs, as a scenario's `expect` describes it. Raises LogError."""
    run, gathered, _ = read_run(summary.log.path, truth_path)
    metrics = evaluate(run, gathered)
    force_N = None if run.truth is None else run.truth.force_N
    took_s = list(metrics.adaptation_s.values())
    found = [contact for contact in metrics.contacts if contact.delay_ms is not None]
    return ScenarioOutcome(
        end=_end(summary),
        fault=metrics.fault,
        fault_s=metrics.fault_s,
        adaptations=sum(time_s is not None for time_s in took_s),
        adaptation_s=took_s[0] if took_s else None,
        contacts=len(found),
        false_alarms=metrics.false_alarms or 0,
        missed=metrics.missed or 0,
        delay_ms=max((contact.delay_ms for contact in found if contact.delay_ms is not None), default=None),
        force_N=0.0 if force_N is None else float(force_N.max(initial=0.0)),
    )


def _end(summary: SessionSummary) -> str:
    """Return the name of the run's end, as in `firmware_sim.scenario.scenario`."""
    if not summary.has_started:
        return "refused"
    if summary.result is None:
        return "lost"
    return "finished" if summary.result.fault is FaultReason.NONE else "fault"
