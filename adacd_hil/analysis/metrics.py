"""What a run achieved, in numbers: adaptation times, residuals, contacts, false alarms, cycle statistics.

Pure functions from a run's arrays to frozen results. Times in s count from *motion start*: the first cycle in ADAPT.
Torques in Nm, joint arrays (2,), histories time-first (n, 2); `tau_ext_hat` has the filter's DC gain taken out, so
that a torque step tau crosses the threshold h after t = -ln(1 - h / |tau|) / a.

**Sections** are lettered A, B, C, … in order, see `adacd_hil.analysis.sections`. An adaptation's time is that of its
section: up to MONITOR, the test of the frozen model and what a contact on the way costs included.

**Frozen residual**: largest |tau_ext_hat| of each joint where nobody touches the arm. A cycle counts unless it lies in
[onset, end + 10/a] of a true contact, or less than 10/a after a cycle in REACT: 10 time constants leave 0.2 mNm of
5 Nm. In a detection section only armed cycles (MONITOR) count; in an adaptation section all do, and only the CAD
model's residual is given, because theta_hat still moves. Without the truth, [detection - 10/a, detection + 10/a]
stands for the contact. After the request to finish the arm parks and stands, where friction may hold any torque up
to F_c: those cycles don't count.

**A detection** is a transition to REACT by a contact, in whatever state: the certified scheme detects while it adapts
and while it parks, too. It belongs to a true contact if it falls between the onset and one time constant after the true
torque, filtered, is back within the threshold; else it is a false alarm. A true contact is *armed* if the scheme is in
MONITOR at its onset; it is *missed* if it is armed and has no detection.

**Certified scheme.** The residual is that of its slowest filter, `a` that filter's cut-off; `law_ms` and `ideal_ms` are
those of the fastest channel of its bank. What else it has: `adacd_hil.analysis.evidence`; the paper's scheme that ran
beside it on the same stream: `adacd_hil.analysis.beside`.
"""

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from adacd_hil.analysis.beside import SETTLING_TIME_CONSTANTS, Beside, evaluate_beside, largest_of
from adacd_hil.analysis.evidence import Evidence, evaluate_certified, last_row
from adacd_hil.analysis.run import Mask, Run
from adacd_hil.analysis.sections import Section, is_interrupted, rows_of, section_at, split_sections
from adacd_hil.analysis.timing import TimingEvidence, collect_evidence, find_reactions
from adacd_hil.analysis.touches import (
    Touch,
    channels_at,
    forgotten_s,
    ideal_response,
    row_at,
    threshold_at,
    true_contacts,
)
from adacd_hil.records import JOINTS, PARAMETER_NAMES, ContactReport, FaultReason, Location, SchemeState, Vector
from adacd_hil.scheme.classification import WINDOW_S


@dataclass(frozen=True)
class Residual:
    """Largest |tau_ext_hat| of a section, Nm per joint, over `cycles` cycles free of contact; None if none."""

    identified: tuple[float, float] | None
    cad: tuple[float, float] | None
    cycles: int


@dataclass(frozen=True)
class Contact:
    """A true contact and its detection, or on a real arm a detection alone.

    state: of the scheme at the onset, on a real arm at the detection.
    law_ms: closed-form delay of a step of the largest torque up to the detection, the faster joint; None if never.
    ideal_ms: delay that the filter alone gives to the true torque as it was; None if never.
    link_at_alarm, link_detected: isolated at detection and at the end of the isolation window.
    torque_error_ratio: peak with the filter undone over the true peak, at the joint with the larger true torque.
    true_force_N: size of the true force, at whatever angle.
    level to blind_deg: what the last report says, in the names of `records`; None where it doesn't say. A sigma is a
    standard deviation.
    """

    number: int
    section: str | None
    state: str
    link: int | None
    onset_s: float | None
    end_s: float | None
    is_armed: bool
    detected_s: float | None
    delay_ms: float | None
    law_ms: float | None
    ideal_ms: float | None
    link_at_alarm: int | None
    link_detected: int | None
    direction: tuple[int, int] | None
    direction_ok: bool | None
    tau_ext_Nm: tuple[float, float] | None
    tau_ext_peak_hat_Nm: tuple[float, float] | None
    torque_error_ratio: float | None
    true_force_N: float | None
    level: str | None
    kind: str | None
    reaction: str | None
    location: str | None
    is_two_sided: bool | None
    tau_ext_peak_sigma_Nm: tuple[float | None, float | None] | None
    impulse_Nm_s: tuple[float, float] | None
    impulse_sigma_Nm_s: tuple[float | None, float | None] | None
    force_N: float | None
    force_sigma_N: float | None
    lever_m: float | None
    lever_sigma_m: float | None
    blind_deg: float | None

    @property
    def at_s(self) -> float:
        """Its onset, or its detection where the onset is not known."""
        at_s = self.onset_s if self.onset_s is not None else self.detected_s
        assert at_s is not None
        return at_s


@dataclass(frozen=True)
class CycleStatistics:
    """How many cycles, for how long, and what drove them."""

    count: int
    duration_s: float
    clock: str | None
    scheduler: str | None


@dataclass(frozen=True)
class PaperRow:
    """One line of *paper against measured*; `beside`: the paper's scheme on the same stream, None where none ran."""

    quantity: str
    paper: str
    beside: str | None
    measured: str


@dataclass(frozen=True)
class Metrics:
    """Everything that the report says, see the module's first lines for the definitions."""

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
    frames: int | None
    dropped: int | None
    evidence: Evidence | None
    paper: tuple[PaperRow, ...]
    verdict: str
    is_clean: bool


class Detection(NamedTuple):
    """A transition to REACT: its row of the run, its time, and the report at the alarm and at the end of the window."""

    row: int
    detected_s: float
    alarm: ContactReport | None
    final: ContactReport | None


def evaluate(run: Run) -> Metrics:
    """Compute all metrics of a run."""
    touches = true_contacts(run)
    detections = find_detections(run)
    owners = assign(run, touches, detections)
    sections = split_sections(run)
    contacts = _contacts(run, sections, touches, detections, owners)
    free = untouched(run, touches, detections)
    residuals = frozen_residuals(run, sections, free)
    evidence = _evidence(run, sections, touches, free)
    adaptation_s = {
        section.label: section.duration_s if section.is_complete else None
        for section in sections
        if section.kind == "adaptation"
    }
    has_truth = run.truth is not None
    false_s = tuple(d.detected_s for d, owner in zip(detections, owners, strict=True) if owner is None)
    missed = sum(contact.is_armed and contact.detected_s is None for contact in contacts)
    faults = np.flatnonzero(run.state == SchemeState.FAULT)
    fault = FaultReason(int(run.fault[faults[0]])).name if faults.size else None
    fault_s = float(run.time_s()[faults[0]]) if faults.size else None
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
        fault=fault,
        fault_s=fault_s,
        cycle=cycle_statistics(run),
        timing=timing_evidence(run),
        frames=run.frames,
        dropped=run.dropped,
        evidence=evidence,
        paper=_paper_rows(run, sections, adaptation_s, residuals, contacts, len(false_s), payload_kg, evidence),
        verdict=_verdict(run, contacts, false_s, missed, adaptation_s, payload_kg, evidence, fault, fault_s),
        is_clean=fault is None and is_identified and missed == 0 and not has_false,
    )


def _evidence(run: Run, sections: tuple[Section, ...], touches: tuple[Touch, ...], free: Mask) -> Evidence | None:
    if run.certified is None:
        return None
    beside = None if run.beside is None else evaluate_beside(run, run.beside, sections, touches, free)
    return evaluate_certified(run, run.certified, sections, free, beside)


def find_detections(run: Run) -> tuple[Detection, ...]:
    """Find the transitions to REACT by a contact and the reports that belong to them by their cycle."""
    is_react = run.state == SchemeState.REACT
    rows = np.flatnonzero(is_react[1:] & ~is_interrupted(run.state[:-1])) + 1
    alarms = {report.cycle: report for report in reversed(run.reports) if not report.is_final}
    finals = {report.cycle: report for report in run.reports if report.is_final}
    time_s = run.time_s()
    detections = []
    for row in rows:
        cycle = int(run.cycle[row])
        final = finals.get(cycle)
        alarm = alarms.get(cycle, final)
        if alarm is None and run.contact_joints is not None and not run.contact_joints[row]:
            continue  # held because the host was late
        detections.append(Detection(int(row), float(time_s[row]), alarm, final))
    return tuple(detections)


def assign(run: Run, touches: tuple[Touch, ...], detections: tuple[Detection, ...]) -> tuple[int | None, ...]:
    """Give for each detection the index of the true contact that explains it, or None."""
    windows = [
        (touch.onset_s, forgotten_s(run, touch, run.a_rad_s, threshold_at(run, touch.onset_s))) for touch in touches
    ]
    owners = []
    for detection in detections:
        fitting = [k for k, (start, end) in enumerate(windows) if start <= detection.detected_s <= end]
        owners.append(fitting[-1] if fitting else None)
    return tuple(owners)


def _contacts(
    run: Run,
    sections: tuple[Section, ...],
    touches: tuple[Touch, ...],
    detections: tuple[Detection, ...],
    owners: tuple[int | None, ...],
) -> tuple[Contact, ...]:
    if run.truth is None:
        return tuple(_unproven(run, number, sections, d) for number, d in enumerate(detections, start=1))
    first = {owner: detection for detection, owner in reversed(list(zip(detections, owners, strict=True)))}
    return tuple(_contact(run, number, sections, touch, first.get(number - 1)) for number, touch in _count(touches))


def _count(touches: tuple[Touch, ...]) -> Iterable[tuple[int, Touch]]:
    return enumerate(touches, start=1)


def _reported(detection: Detection | None) -> dict[str, Any]:
    """Give what the reports of a detection say."""
    alarm = detection.alarm if detection else None
    last = (detection.final or alarm) if detection else None
    said: dict[str, Any] = {
        "detected_s": detection.detected_s if detection else None,
        "link_at_alarm": alarm.link if alarm else None,
        "link_detected": last.link if last else None,
        "direction": last.direction if last else None,
        "tau_ext_peak_hat_Nm": last.tau_ext_peak if last else None,
        "impulse_Nm_s": last.impulse if last else None,
    }
    is_told = last is not None and last.location is not Location.NOT_SOUGHT
    return said | (_told(last) if last is not None and is_told else dict.fromkeys(_TOLD))


_TOLD = (
    "level", "kind", "reaction", "location", "is_two_sided", "tau_ext_peak_sigma_Nm", "impulse_sigma_Nm_s",
    "force_N", "force_sigma_N", "lever_m", "lever_sigma_m", "blind_deg",
)  # fmt: skip
"""Of a contact, what only the certified scheme tells."""


def _told(report: ContactReport) -> dict[str, Any]:
    has_force, has_lever = math.isfinite(report.force_sigma), math.isfinite(report.lever_sigma)
    peak_1, peak_2 = map(_finite, report.tau_ext_peak_sigma)
    impulse_1, impulse_2 = map(_finite, report.impulse_sigma)
    values = (
        report.level.name, report.kind.name, report.reaction.name, report.location.name, report.is_two_sided,
        (peak_1, peak_2), (impulse_1, impulse_2),
        report.force_N if has_force else None, _finite(report.force_sigma),
        report.lever_m if has_lever else None, _finite(report.lever_sigma),
        math.degrees(report.blind_rad),
    )  # fmt: skip
    return dict(zip(_TOLD, values, strict=True))


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _state_at(run: Run, time_s: float) -> SchemeState:
    """Give the state in the cycle before a time."""
    return SchemeState(run.state[max(row_at(run, time_s) - 1, 0)])


def _unproven(run: Run, number: int, sections: tuple[Section, ...], detection: Detection) -> Contact:
    return Contact(
        number=number,
        section=section_at(sections, detection.detected_s),
        state=_state_at(run, detection.detected_s).name,
        link=None,
        onset_s=None,
        end_s=None,
        is_armed=True,
        delay_ms=None,
        law_ms=None,
        ideal_ms=None,
        direction_ok=None,
        tau_ext_Nm=None,
        torque_error_ratio=None,
        true_force_N=None,
        **_reported(detection),
    )


def _contact(
    run: Run, number: int, sections: tuple[Section, ...], touch: Touch, detection: Detection | None
) -> Contact:
    truth = run.truth
    assert truth is not None
    rows = slice(touch.first, touch.last + 1)
    tau_ext = truth.tau_ext[rows]
    since_s = run.time_of_s(truth.cycle[rows]) - touch.onset_s
    delay_s = detection.detected_s - touch.onset_s if detection else math.inf
    # What the host can have seen: up to the detection for the delay, up to the end of the window for the rest.
    until_alarm = np.abs(tau_ext[since_s <= delay_s]).max(axis=0)
    is_seen = since_s <= delay_s + _window_s(run)
    until_final = tau_ext[is_seen]
    channels = channels_at(run, touch.onset_s)
    steps_s = [delay for channel in channels if (delay := channel.step_delay_s(until_alarm)) is not None]
    is_over = [np.abs(ideal_response(run, touch, channel)) > channel.threshold for channel in channels]
    over = np.flatnonzero(np.any(is_over, axis=(0, 2)))
    crossing_s = run.time_of_s(truth.cycle[touch.first + over[:1]])
    ideal_ms = float(crossing_s[0] - touch.onset_s) * 1e3 if over.size else None
    peak = until_final[np.argmax(np.abs(until_final), axis=0), range(JOINTS)]
    reported = _reported(detection)
    state = _state_at(run, touch.onset_s)
    return Contact(
        number=number,
        section=section_at(sections, touch.onset_s),
        state=state.name,
        link=touch.link,
        onset_s=touch.onset_s,
        end_s=touch.end_s,
        is_armed=state is SchemeState.MONITOR,
        delay_ms=delay_s * 1e3 if detection else None,
        law_ms=min(steps_s) * 1e3 if steps_s else None,
        ideal_ms=ideal_ms,
        direction_ok=_is_direction_right(reported["direction"], until_final.sum(axis=0)),
        tau_ext_Nm=(float(peak[0]), float(peak[1])),
        torque_error_ratio=_torque_ratio(reported["tau_ext_peak_hat_Nm"], peak),
        true_force_N=None if truth.force_N is None else float(truth.force_N[rows][is_seen].max()),
        **reported,
    )


def _window_s(run: Run) -> float:
    """Give how long after the detection a report is made final."""
    return run.settings.detector.isolation_window_s if run.certified is None else WINDOW_S


def _is_direction_right(direction: tuple[int, int] | None, impulse: Vector) -> bool | None:
    """Tell whether every joint with a direction was pushed that way, and one at least has a direction."""
    if direction is None:
        return None
    told = [joint for joint in range(JOINTS) if direction[joint]]
    return bool(told) and all(direction[joint] == np.sign(impulse[joint]) for joint in told)


def _torque_ratio(peak_hat: tuple[float, float] | None, peak: Vector) -> float | None:
    joint = int(np.argmax(np.abs(peak)))
    if peak_hat is None or peak[joint] == 0.0:
        return None
    return float(peak_hat[joint] / peak[joint])


def untouched(run: Run, touches: tuple[Touch, ...], detections: tuple[Detection, ...]) -> Mask:
    """Mark the cycles (n,) that are free of contact, as the module's first lines define it."""
    time_s = run.time_s()
    settling_s = SETTLING_TIME_CONSTANTS / run.a_rad_s
    free = np.ones(time_s.size, dtype=np.bool_) if run.finish_cycle is None else run.cycle < run.finish_cycle
    if run.truth is None:
        windows = [(d.detected_s - settling_s, d.detected_s + settling_s) for d in detections]
    else:
        windows = [(touch.onset_s, touch.end_s + settling_s) for touch in touches]
    for start_s, end_s in windows:
        free &= (time_s < start_s) | (time_s > end_s)
    is_react = run.state == SchemeState.REACT
    last_react_s = np.maximum.accumulate(np.where(is_react, time_s, -np.inf)) if time_s.size else time_s
    free &= time_s - last_react_s > settling_s
    return free


def frozen_residuals(run: Run, sections: tuple[Section, ...], free: Mask) -> dict[str, Residual]:
    """Give the largest residual of each adaptation and detection section in the `free` cycles (n,)."""
    residuals = {}
    for section in sections:
        if section.kind not in ("adaptation", "detection"):
            continue
        rows = free & rows_of(run, section)
        is_frozen = section.kind == "detection"
        if is_frozen:
            rows &= run.state == SchemeState.MONITOR
        residuals[section.label] = Residual(
            identified=largest_of(run.tau_ext_hat[rows]) if is_frozen else None,
            cad=largest_of(run.tau_ext_hat_cad[rows]) if run.has_cad else None,
            cycles=int(rows.sum()),
        )
    return residuals


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
    if run.truth is None or run.truth.cycle.size == 0:
        return {}
    row = max(int(np.searchsorted(run.truth.cycle, cycle, side="right")) - 1, 0)
    return dict(zip(PARAMETER_NAMES, run.truth.theta[row].tolist(), strict=True))


def _payloads(run: Run, sections: tuple[Section, ...]) -> dict[str, float | None]:
    """Give the true payload at the end of each adaptation, kg."""
    payloads: dict[str, float | None] = {}
    for section in sections:
        if section.kind == "adaptation":
            row = int(np.flatnonzero(rows_of(run, section))[-1])
            payloads[section.label] = _payload_at(run, int(run.cycle[row]))
    return payloads


def _payload_at(run: Run, cycle: int) -> float | None:
    if run.truth is None or run.truth.cycle.size == 0:
        return None
    row = max(int(np.searchsorted(run.truth.cycle, cycle, side="right")) - 1, 0)
    return float(run.truth.payload_kg[row])


def is_realtime(run: Run) -> bool:
    """Tell whether the host's own clock drove the cycles."""
    return run.metadata.get("clock") == "realtime"


def cycle_statistics(run: Run) -> CycleStatistics:
    """Give the statistics of all cycles, those before motion start included."""
    return CycleStatistics(
        count=len(run.timing),
        duration_s=float((run.t_ns[-1] - run.t_ns[0]) * 1e-9) if run.t_ns.size else 0.0,
        clock=run.metadata.get("clock"),
        scheduler=run.metadata.get("scheduler"),
    )


def timing_evidence(run: Run) -> TimingEvidence:
    """Sum up the times of all cycles, those before motion start included."""
    reactions = find_reactions(run.timing, run.cycle, run.state)
    return collect_evidence(run.timing, run.settings.bus.period_us, not is_realtime(run), reactions)


def _paper_rows(
    run: Run,
    sections: tuple[Section, ...],
    adaptation_s: dict[str, float | None],
    residuals: dict[str, Residual],
    contacts: tuple[Contact, ...],
    false_alarms: int,
    payload_kg: dict[str, float | None],
    evidence: Evidence | None,
) -> tuple[PaperRow, ...]:
    settings = run.settings
    times_s = list(adaptation_s.values())
    detections = [section.label for section in sections if section.kind == "detection"]
    frozen = [residuals[label] for label in detections]
    identified, cad = [residual.identified for residual in frozen], [residual.cad for residual in frozen]
    adaptations = list(adaptation_s)
    payload = payload_kg.get(adaptations[1]) if len(adaptations) > 1 else None
    law = {"least_squares": "least squares", "gradient": "gradient"}[settings.estimator.law]
    a, b = settings.filter.a_rad_s, settings.filter.b_rad_s
    within = "within ±0.15"
    seen = [contact.detected_s for contact in contacts if contact.detected_s is not None]
    first = f"{seen[0]:.2f} s" if seen else "–"
    kilograms = "–" if payload is None else f"{payload:g} kg"
    settled = (
        ("Bound β of eq. (15)", "0.1 Nm", f"{settings.termination.beta_Nm:g} Nm"),
        ("Hold T of eq. (15)", "5 s", f"{settings.termination.hold_s:g} s"),
        ("Threshold, joints 1 / 2", "0.15 Nm", _pair(settings.detector.threshold_Nm)),
        ("Filter a / b", "10 / 10 rad/s", f"{a:g} / {b:g} rad/s"),
        ("Estimator", "least squares", law),
    )
    rate = f"{1e3 / settings.bus.period_us:g} kHz"
    names = (
        ("First adaptation", "5.2 s"),
        ("Adaptation after the payload change", "about 5.3 s"),
        ("Payload", "1 kg"),
        ("Frozen residual without payload, joints 1 / 2", within),
        ("Frozen residual with payload, joints 1 / 2", within),
        ("The CAD model's, without payload", "larger; joint 2 good"),
        ("The CAD model's, with payload", "much larger, both joints"),
        ("First contact detected at", "10 s"),
    )
    measured = (
        _seconds(times_s, 0),
        _seconds(times_s, 1),
        kilograms,
        _residual_text(identified, 0),
        _residual_text(identified, 1),
        _residual_text(cad, 0),
        _residual_text(cad, 1),
        first,
    )
    if evidence is None:
        plain = [(*name, value) for name, value in zip(names, measured, strict=True)]
        plain += [*settled, ("Control rate", "1 kHz", rate)]
        return tuple(PaperRow(quantity, paper, None, value) for quantity, paper, value in plain)
    beside = _beside_values(evidence.paper_beside, detections, (kilograms, *measured[5:7]))
    rows = [(*name, theirs, value) for name, theirs, value in zip(names, beside[:8], measured, strict=True)]
    armed = [contact for contact in contacts if contact.is_armed]
    found = [contact for contact in armed if contact.delay_ms is not None]
    has_truth = run.truth is not None
    rows += [
        ("Contacts detected", "–", beside[8], f"{len(found)} of {len(armed)}" if has_truth else str(len(contacts))),
        ("Median delay", "–", beside[9], _median_text([c.delay_ms for c in found if c.delay_ms is not None])),
        ("False alarms", "–", beside[10], str(false_alarms) if has_truth else "–"),
    ]
    ours = (
        f"{settings.certified.beta_Nm:g} Nm, of the frozen model",
        "test of " + (" and ".join("–" if t is None else f"{t:.2f} s" for t in evidence.test_s.values()) or "–"),
        _threshold_text(evidence, detections),
        f"{', '.join(f'{cutoff:g}' for cutoff in settings.certified.cutoffs_rad_s)} rad/s",
        "least squares from a prior",
    )
    rows += [(quantity, paper, theirs, value) for (quantity, paper, theirs), value in zip(settled, ours, strict=True)]
    margin = evidence.smallest_margin
    rows.append(("Smallest threshold / residual", "–", "–", "–" if margin is None else f"{margin:.2f}"))
    rows.append(("Control rate", "1 kHz", rate, rate))
    return tuple(PaperRow(*row) for row in rows)


def _beside_values(beside: Beside | None, detections: list[str], same: tuple[str, str, str]) -> tuple[str, ...]:
    """Give the column of the paper's scheme on the same stream; same: payload and the CAD model's residuals."""
    if beside is None:
        return ("–",) * 11
    times_s = list(beside.adaptation_s.values())
    frozen = [beside.frozen_residual_max_Nm[label] for label in detections]
    armed = [contact for contact in beside.contacts if contact.is_armed]
    found = [contact for contact in armed if contact.detected_s is not None]
    seen = [contact.detected_s for contact in beside.contacts if contact.detected_s is not None]
    return (
        _seconds(times_s, 0),
        _seconds(times_s, 1),
        same[0],
        _residual_text(frozen, 0),
        _residual_text(frozen, 1),
        *same[1:],
        f"{seen[0]:.2f} s" if seen else "–",
        "–" if beside.missed is None else f"{len(found)} of {len(armed)}",
        _median_text([contact.delay_ms for contact in found if contact.delay_ms is not None]),
        "–" if beside.false_alarms is None else str(beside.false_alarms),
    )


def _threshold_text(evidence: Evidence, detections: list[str]) -> str:
    """Say where the thresholds of the slowest channel lie: the smallest and the largest median of a section."""
    found = [h for label in detections for row in evidence.margins.get(label, ())[:1] for h in row.threshold_Nm]
    return f"{min(found):.3f} to {max(found):.3f} Nm" if found else "–"


def _median_text(delays_ms: list[float]) -> str:
    return f"{float(np.median(delays_ms)):.1f} ms" if delays_ms else "–"


def _seconds(times_s: list[float | None], index: int) -> str:
    if index >= len(times_s):
        return "–"
    value = times_s[index]
    return "not finished" if value is None else f"{value:.2f} s"


def _pair(values: tuple[float, float] | None) -> str:
    if values is None:
        return "–"
    return f"{values[0]:g} Nm" if values[0] == values[1] else f"{values[0]:g} / {values[1]:g} Nm"


def _residual_text(frozen: list[tuple[float, float] | None], index: int) -> str:
    values = frozen[index] if index < len(frozen) else None
    return "–" if values is None else f"{values[0]:.3f} / {values[1]:.3f} Nm"


def _verdict(
    run: Run,
    contacts: tuple[Contact, ...],
    false_s: tuple[float, ...],
    missed: int,
    adaptation_s: dict[str, float | None],
    payload_kg: dict[str, float | None],
    evidence: Evidence | None,
    fault: str | None,
    fault_s: float | None,
) -> str:
    done = "identified" if evidence is None else "certified"
    text = f"{_contacts_text(run, contacts, false_s, missed)}; {_identified_text(adaptation_s, payload_kg, done)}"
    if evidence is not None and evidence.paper_beside is not None:
        text += _beside_text(list(evidence.paper_beside.adaptation_s.values()))
    if fault is not None:
        text = f"the run ended in FAULT ({fault}) at {fault_s:.2f} s; {text}"
    return text[:1].upper() + text[1:] + "."


def _beside_text(times_s: list[float | None]) -> str:
    if not any(time_s is not None for time_s in times_s):
        return ""
    took = " and ".join("did not end" if time_s is None else f"took {time_s:.2f} s" for time_s in times_s)
    return f"; the paper's scheme on the same stream {took.replace(' and took', ' and')}"


def _contacts_text(run: Run, contacts: tuple[Contact, ...], false_s: tuple[float, ...], missed: int) -> str:
    if run.truth is None:
        return f"{_number(len(contacts), 'detection')}, whose truth is not recorded"
    armed = [contact for contact in contacts if contact.is_armed]
    delays_ms = [contact.delay_ms for contact in armed if contact.delay_ms is not None]
    within = f" within {max(delays_ms):.0f} ms" if delays_ms else ""
    if not armed:
        found = "no contact while detection was armed"
    elif missed:
        found = f"{len(armed) - missed} of {_number(len(armed), 'contact')} detected{within}, {missed} missed"
    else:
        found = f"{'the one contact' if len(armed) == 1 else f'all {len(armed)} contacts'} detected{within}"
    false = "none false" if not false_s else _number(len(false_s), "false alarm")
    if not armed and not false_s:
        false = "no false alarm"
    disarmed = [contact for contact in contacts if not contact.is_armed]
    outside = f", {len(disarmed)} more while it was not armed" if disarmed else ""
    early = sum(contact.detected_s is not None for contact in disarmed)
    outside += f" ({early} of them detected)" if early else ""
    return f"{found}{outside}, {false}"


def _number(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _identified_text(adaptation_s: dict[str, float | None], payload_kg: dict[str, float | None], done: str) -> str:
    """Say how long the model took to be `done`, identified or certified."""
    if not adaptation_s:
        return "the arm never moved to adapt"
    labels = list(adaptation_s)
    if adaptation_s[labels[0]] is None:
        return f"the model was not {done}"
    text = f"the model was {done} in {adaptation_s[labels[0]]:.2f} s"
    for before, label in itertools.pairwise(labels):
        old, new, time_s = payload_kg[before], payload_kg[label], adaptation_s[label]
        change = "the payload change"
        if old is not None and new is not None and new != old:
            change = f"{new - old:g} kg" if new > old else f"taking off {old - new:g} kg"
        text += f", but not again after {change}" if time_s is None else f" and again in {time_s:.2f} s after {change}"
    return text
