"""What a run achieved, in numbers: adaptation times, residuals, contacts, false alarms, cycle statistics.

Pure functions from a run's arrays to frozen results. Times in s count from *motion start*: the first cycle in ADAPT.
Torques in Nm, joint arrays (2,), histories time-first (n, 2); `tau_ext_hat` has the filter's DC gain taken out, so
that a torque step tau crosses the threshold h after t = -ln(1 - h / |tau|) / a.

**Sections** are lettered A, B, C, … in order, see `adacd_hil.analysis.logged_run`. An adaptation's time is that of its
section: up to MONITOR, the test of the frozen model and what a contact on the way costs included.

**Frozen residual**: largest |tau_ext_hat| of each joint where nobody touches the arm. A cycle counts unless it lies in
[onset, end + 10/a] of a true contact, or less than 10/a after a cycle in REACT: 10 time constants leave 0.2 mNm of
5 Nm. In a detection section only armed cycles (MONITOR) count; in an adaptation section all do, and only the CAD
model's residual is given, because theta_hat still moves. Without the truth, [detection - 10/a, detection + 10/a]
stands for the contact. After the request to finish the arm parks and stands, where friction may hold any torque up
to F_c: those cycles don't count.

**A detection** is an alarm of `adacd_hil.analysis.score.judge`. Which contacts were found or missed, and which
detections are false alarms: `adacd_hil.analysis.score.judge`; detection is armed in MONITOR.

**Certified scheme.** The residual is that of its slowest filter, `a` that filter's cut-off; `law_ms` and `ideal_ms` are
those of the fastest channel of its bank. What else it has: `adacd_hil.analysis.score.margins`; the paper's
scheme that ran beside it on the same stream: `adacd_hil.analysis.score.margins`.
"""

from dataclasses import dataclass
from typing import NamedTuple

from adacd_hil.analysis.logged_run import Run, Section, rows_of, split_sections
from adacd_hil.analysis.score.contacts import Contact, judge_run, list_contacts, true_contacts
from adacd_hil.analysis.score.judge import find_detections, rate_bound_per_h
from adacd_hil.analysis.score.margins import (
    Evidence,
    Residual,
    Untouched,
    evaluate_certified,
    gather_untouched,
    last_row,
)
from adacd_hil.analysis.score.run_faults import CyclicData, find_causes, find_faults, gather_data
from adacd_hil.analysis.score.timing import TimingEvidence, collect_evidence, find_reactions
from adacd_hil.analysis.score.verdict import PaperRow, compare_with_paper, give_verdict, is_margin_below_1, is_revoked
from adacd_hil.records import PARAMETER_NAMES


@dataclass(frozen=True)
class CycleStatistics:
    """How many cycles, for how long, and what drove them."""

    count: int
    duration_s: float
    clock: str | None
    scheduler: str | None


@dataclass(frozen=True)
class Metrics:
    """Everything that the report says, see the module's first lines for the definitions.

    fault, fault_s: the first one of the run.
    """

    sections: tuple[Section, ...]
    adaptation_s: dict[str, float | None]
    frozen_residual_max_Nm: dict[str, Residual]
    contacts: tuple[Contact, ...]
    false_alarms: int | None
    false_alarms_s: tuple[float, ...] | None
    missed: int | None
    parameters: dict[str, dict[str, tuple[float | None, float]]]
    payload_kg: dict[str, float | None]
    fault: str | None
    fault_s: float | None
    cycle: CycleStatistics
    timing: TimingEvidence
    data: CyclicData
    frames: int | None
    dropped: int | None
    evidence: Evidence | None
    paper: tuple[PaperRow, ...]
    verdict: str
    is_clean: bool
    armed_false_alarms: int | None  # of them those in MONITOR

    @property
    def false_alarm_bound_per_h(self) -> float | None:
        """Upper 95 % bound of the certified scheme's rate of false alarms in MONITOR, by counting; None: not known."""
        push = None if self.evidence is None else self.evidence.smallest_push
        if push is None or self.armed_false_alarms is None:
            return None
        return rate_bound_per_h(self.armed_false_alarms, push.hours)


class Gathered(NamedTuple):
    """What takes all cycles of a run to say."""

    untouched: Untouched
    timing: TimingEvidence
    data: CyclicData


def evaluate(run: Run, gathered: Gathered | None = None) -> Metrics:
    """Compute all metrics of a run. gathered: of a run that does not have all of its cycles."""
    gathered = gathered or Gathered(gather_untouched(run, [run]), timing_evidence(run), gather_data(run))
    touches = true_contacts(run)
    detections = find_detections(run)
    score = judge_run(run, touches, detections)
    sections = split_sections(run)
    contacts = list_contacts(run, sections, touches, detections, score)
    residuals = gathered.untouched.residuals
    evidence = _evidence(run, sections, gathered.untouched)
    adaptation_s = {
        section.label: section.duration_s if section.is_complete else None
        for section in sections
        if section.kind == "adaptation"
    }
    has_truth = run.truth is not None
    false_s = tuple((alarm.t_ns - run.zero_ns) * 1e-9 for alarm in score.false_alarms)
    missed = score.missed
    faults, causes, data = find_faults(run), find_causes(run), gathered.data
    payload_kg = _payloads(run, sections)
    is_identified = bool(adaptation_s) and all(value is not None for value in adaptation_s.values())
    has_false = has_truth and len(false_s) > 0
    return Metrics(
        sections=sections,
        adaptation_s=adaptation_s,
        frozen_residual_max_Nm=residuals,
        contacts=contacts,
        false_alarms=len(false_s) if has_truth else None,
        false_alarms_s=false_s if has_truth else None,
        missed=missed if has_truth else None,
        parameters=_parameters(run, sections),
        payload_kg=payload_kg,
        fault=faults[0].reason if faults else None,
        fault_s=faults[0].at_s if faults else None,
        cycle=cycle_statistics(run, gathered.timing.cycles),
        timing=gathered.timing,
        data=data,
        frames=run.frames,
        dropped=run.dropped,
        evidence=evidence,
        paper=compare_with_paper(run, sections, adaptation_s, residuals, contacts, len(false_s), payload_kg, evidence),
        verdict=give_verdict(run, sections, score, adaptation_s, payload_kg, evidence, faults, causes, data),
        is_clean=is_identified
        and missed == 0
        and not (has_false or faults or causes or data.excesses or is_margin_below_1(evidence) or is_revoked(evidence)),
        armed_false_alarms=score.armed_false_alarms if has_truth else None,
    )


def _evidence(run: Run, sections: tuple[Section, ...], untouched: Untouched) -> Evidence | None:
    if run.certified is None:
        return None
    return evaluate_certified(
        run,
        run.certified,
        sections,
        untouched.margins,
        untouched.promotions,
        untouched.beside,
        untouched.smallest_push,
    )


def _parameters(run: Run, sections: tuple[Section, ...]) -> dict[str, dict[str, tuple[float | None, float]]]:
    """Give true and identified parameters at the end of each adaptation."""
    found = {}
    for section in sections:
        if section.kind != "adaptation":
            continue
        row = last_row(run, section)
        theta = true_parameters(run, int(run.cycle[row]))
        found[section.label] = {
            name: (theta.get(name), float(run.theta_hat[row, column]))
            for column, name in enumerate(run.parameter_names)
        }
    return found


def true_parameters(run: Run, cycle: int) -> dict[str, float]:
    """Give the true parameters in a cycle by name; empty without the truth."""
    row = None if run.truth is None else run.truth.model_row(cycle)
    if run.truth is None or row is None:
        return {}
    return dict(zip(PARAMETER_NAMES, run.truth.theta[row].tolist(), strict=True))


def _payloads(run: Run, sections: tuple[Section, ...]) -> dict[str, float | None]:
    """Give the true payload at the end of each adaptation, kg."""
    payloads: dict[str, float | None] = {}
    time_s = run.time_s()
    for section in sections:
        if section.kind == "adaptation":
            row = rows_of(time_s, section, float(time_s[-1])).stop - 1
            payloads[section.label] = _payload_at(run, int(run.cycle[row]))
    return payloads


def _payload_at(run: Run, cycle: int) -> float | None:
    row = None if run.truth is None else run.truth.model_row(cycle)
    return None if run.truth is None or row is None else float(run.truth.payload_kg[row])


def is_realtime(run: Run) -> bool:
    """Tell whether the host's own clock drove the cycles."""
    return run.metadata.get("clock") == "realtime"


def cycle_statistics(run: Run, count: int) -> CycleStatistics:
    """Give the statistics of all cycles, `count` of them, those before motion start included."""
    return CycleStatistics(
        count=count,
        duration_s=float((run.t_ns[-1] - run.t_ns[0]) * 1e-9) if run.t_ns.size else 0.0,
        clock=run.metadata.get("clock"),
        scheduler=run.metadata.get("scheduler"),
    )


def timing_evidence(run: Run) -> TimingEvidence:
    """Sum up the times of all cycles, those before motion start included."""
    reactions = find_reactions(run.timing, run.cycle, run.state)
    return collect_evidence(run.timing, run.settings.bus.period_us, not is_realtime(run), reactions)
