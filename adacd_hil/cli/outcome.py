"""What a run of a scenario came to, from its logs, to be compared with what the scenario expects."""

from pathlib import Path

from adacd_hil.analysis.metrics import evaluate
from adacd_hil.analysis.report.reading import RUN_TOPICS, run_from_log
from adacd_hil.control.session import SessionSummary
from adacd_hil.log.reader import read_log
from adacd_hil.records import FaultReason
from firmware_sim.expectation import Outcome


def outcome_of(summary: SessionSummary, truth_path: Path) -> Outcome:
    """Read the logs of a run that has ended. Raises LogError."""
    truth = read_log(truth_path, ("/truth",))
    metrics = evaluate(run_from_log(read_log(summary.log.path, RUN_TOPICS), truth))
    took_s = list(metrics.adaptation_s.values())
    found = [contact for contact in metrics.contacts if contact.delay_ms is not None]
    return Outcome(
        end=_end(summary),
        fault=metrics.fault,
        fault_s=metrics.fault_s,
        adaptations=sum(time_s is not None for time_s in took_s),
        adaptation_s=took_s[0] if took_s else None,
        contacts=len(found),
        false_alarms=metrics.false_alarms or 0,
        missed=metrics.missed or 0,
        delay_ms=max((contact.delay_ms for contact in found if contact.delay_ms is not None), default=None),
        force_N=float(truth.truth["contact_force"].max(initial=0.0)),
    )


def _end(summary: SessionSummary) -> str:
    """Say how the run ended, by the names of `firmware_sim.expectation`."""
    if not summary.has_started:
        return "refused"
    if summary.result is None:
        return "lost"
    return "finished" if summary.result.fault is FaultReason.NONE else "fault"
