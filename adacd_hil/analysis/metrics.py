"""What a run achieved, in numbers: adaptation times, residuals, contacts, false alarms, cycle statistics.

Pure functions from a run's arrays to frozen results. Times in s count from *motion start*: the first cycle in ADAPT.
Torques in Nm, joint arrays (2,), histories time-first (n, 2); `tau_ext_hat` has the filter's DC gain taken out, so
that a torque step tau crosses the threshold h after t = -ln(1 - h / |tau|) / a.

**Sections** are lettered A, B, C, … in order: *adaptation* is a stay in ADAPT, *detection* lasts from its end to the
announcement of a payload change (MONITOR, REACT, STOPPED), *payload* is a stay in PAYLOAD, *fault* is FAULT. The
paper's experiment gives A to E.

**Frozen residual**: largest |tau_ext_hat| of each joint where nobody touches the arm. A cycle counts unless it lies in
[onset, end + 10/a] of a true contact, or less than 10/a after a cycle in REACT: 10 time constants leave 0.2 mNm of
5 Nm. In a detection section only armed cycles (MONITOR) count; in an adaptation section all do, and only the CAD
model's residual is given, because theta_hat still moves. Without the truth, [detection - 10/a, detection + 10/a]
stands for the contact. After the request to finish the arm parks and stands, where friction may hold any torque up
to F_c: those cycles don't count.

**A detection** is a transition from MONITOR to REACT. It belongs to a true contact if it falls between the onset and
one time constant after the true torque, filtered, is back within the threshold; else it is a false alarm. A true
contact is *armed* if the scheme is in MONITOR at its onset; it is *missed* if it is armed and has no detection.
"""

import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.analysis.timing import CycleColumns, Cycles, TimingEvidence, collect_evidence, find_reactions
from adacd_hil.config import Settings
from adacd_hil.records import JOINTS, PARAMETER_NAMES, ContactReport, FaultReason, SchemeState, Vector

Mask = NDArray[np.bool_]

SETTLING_TIME_CONSTANTS: Final = 10.0
"""Time constants of the filter after which a contact counts as forgotten; e^-10 of 5 Nm is 0.2 mNm."""


@dataclass(frozen=True)
class Truth:
    """What the emulator knows, on its own cycles (m,): external torque (m, 2), contact, payload, parameters (m, 7)."""

    cycle: Cycles
    tau_ext: Vector
    contact_link: Vector
    contact_index: Vector
    payload_kg: Vector
    theta: Vector


@dataclass(frozen=True)
class Run:
    """A run as plain arrays over its n cycles; `truth` is None on a real arm."""

    cycle: Cycles
    t_ns: Cycles
    state: NDArray[np.uint8]
    fault: NDArray[np.uint8]
    tau_ext_hat: Vector
    tau_ext_hat_cad: Vector
    theta_hat: Vector
    threshold: Vector
    quiet_s: Vector
    reports: tuple[ContactReport, ...]
    timing: CycleColumns
    truth: Truth | None
    settings: Settings
    metadata: Mapping[str, str]
    frames: int | None
    dropped: int | None
    finish_cycle: int | None = None  # in which the user asked to finish; None if nobody did
    contact_joints: NDArray[np.uint8] | None = None  # bit i: joint i is over its threshold

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the columns of `theta_hat`."""
        return self.settings.estimator.parameter_names

    @property
    def has_cad(self) -> bool:
        """Whether the configuration gives a CAD model."""
        return len(self.settings.arm.cad_theta) > 0

    @property
    def zero_ns(self) -> int:
        """Motion start: the first cycle in ADAPT, else the first cycle."""
        if self.t_ns.size == 0:
            return 0
        adapting = self.state == SchemeState.ADAPT
        return int(self.t_ns[int(np.argmax(adapting)) if adapting.any() else 0])

    def time_s(self) -> Vector:
        """Give the time of every cycle since motion start, s (n,)."""
        # Subtracted as integers: float64 resolves only 256 ns of an absolute time.
        return np.asarray((self.t_ns - self.zero_ns) * 1e-9, dtype=np.float64)

    def time_of_s(self, cycle: NDArray[Any]) -> Vector:
        """Give the time of any cycle numbers since motion start, s; between logged cycles by interpolation."""
        if self.cycle.size == 0:
            return np.zeros(len(cycle))
        return np.asarray(np.interp(cycle, self.cycle, self.time_s()), dtype=np.float64)


@dataclass(frozen=True)
class Section:
    """One part of a run; `is_complete` is False if the run ended, or failed, in it."""

    label: str
    kind: str  # "adaptation", "detection", "payload", "fault"
    start_s: float
    end_s: float
    is_complete: bool

    @property
    def duration_s(self) -> float:
        """Length in s."""
        return self.end_s - self.start_s


@dataclass(frozen=True)
class Residual:
    """Largest |tau_ext_hat| of a section, Nm per joint, over `cycles` cycles free of contact; None if none."""

    identified: tuple[float, float] | None
    cad: tuple[float, float] | None
    cycles: int


@dataclass(frozen=True)
class Contact:
    """A true contact and its detection, or on a real arm a detection alone.

    law_ms: closed-form delay of a step of the largest torque up to the detection, the faster joint; None if never.
    ideal_ms: delay that the filter alone gives to the true torque as it was; None if never.
    link_at_alarm, link_detected: isolated at detection and at the end of the isolation window.
    torque_error_ratio: peak with the filter undone over the true peak, at the joint with the larger true torque.
    """

    number: int
    section: str | None
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


@dataclass(frozen=True)
class CycleStatistics:
    """How many cycles, for how long, and what drove them."""

    count: int
    duration_s: float
    clock: str | None
    scheduler: str | None


@dataclass(frozen=True)
class PaperRow:
    """One line of *paper against measured*."""

    quantity: str
    paper: str
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
    paper: tuple[PaperRow, ...]
    verdict: str
    is_clean: bool


class Touch(NamedTuple):
    """A true contact: its rows [first, last] of the truth, and times since motion start."""

    first: int
    last: int
    link: int
    onset_s: float
    end_s: float


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
    residuals = frozen_residuals(run, sections, touches, detections)
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
        paper=_paper_rows(run, sections, adaptation_s, residuals, contacts, payload_kg),
        verdict=_verdict(run, contacts, false_s, missed, adaptation_s, payload_kg, fault, fault_s),
        is_clean=fault is None and is_identified and missed == 0 and not has_false,
    )


_KINDS: Final = {
    SchemeState.ADAPT: "adaptation",
    SchemeState.CERTIFY: "adaptation",
    SchemeState.MONITOR: "detection",
    SchemeState.REACT: "detection",
    SchemeState.STOPPED: "detection",
    SchemeState.PAYLOAD: "payload",
    SchemeState.FAULT: "fault",
}


def section_label(index: int) -> str:
    """Name a section by its place: A to Z, then AA, AB and so on."""
    letter = chr(ord("A") + index % 26)
    return letter if index < 26 else section_label(index // 26 - 1) + letter


def split_sections(run: Run) -> tuple[Section, ...]:
    """Split a run into lettered sections; what comes before the first ADAPT belongs to none."""
    if run.state.size == 0:
        return ()
    kinds = np.array([_KINDS.get(SchemeState(value), "") for value in range(len(SchemeState))])[run.state]
    starts = np.concatenate(([0], np.flatnonzero(kinds[1:] != kinds[:-1]) + 1))
    time_s = run.time_s()
    sections: list[Section] = []
    for start, end in zip(starts, [*starts[1:], None], strict=True):
        kind = str(kinds[start])
        if not kind:
            continue
        end_s = float(time_s[-1] if end is None else time_s[end])
        is_complete = end is not None and kinds[end] not in ("", "fault")  # "": begun again after a bus that failed
        sections.append(Section(section_label(len(sections)), kind, float(time_s[start]), end_s, is_complete))
    return tuple(sections)


def _section_at(sections: Iterable[Section], time_s: float) -> str | None:
    return next((section.label for section in sections if section.start_s <= time_s <= section.end_s), None)


def _rows(run: Run, section: Section) -> Mask:
    """Mark the cycles of a section; the last one of the run belongs to it, the first one of the next does not."""
    time_s = run.time_s()
    is_last = bool(section.end_s >= time_s[-1])
    inside: Mask = (time_s >= section.start_s) & ((time_s <= section.end_s) if is_last else (time_s < section.end_s))
    return inside


def true_contacts(run: Run) -> tuple[Touch, ...]:
    """Find the true contacts in the truth record; without one there are none to be known."""
    truth = run.truth
    if truth is None or truth.cycle.size == 0 or run.cycle.size == 0:
        return ()
    index = truth.contact_index
    edges = np.flatnonzero(index[1:] != index[:-1]) + 1
    starts = np.concatenate(([0], edges))
    ends = np.concatenate((edges, [index.size]))
    time_s = run.time_of_s(truth.cycle)
    return tuple(
        Touch(
            int(start),
            int(end) - 1,
            int(truth.contact_link[start]),
            float(time_s[start]),
            float(time_s[min(end, index.size - 1)]),
        )
        for start, end in zip(starts, ends, strict=True)
        if index[start] >= 0
    )


def find_detections(run: Run) -> tuple[Detection, ...]:
    """Find the transitions from MONITOR to REACT and the reports that belong to them by their cycle."""
    is_react = run.state == SchemeState.REACT
    rows = np.flatnonzero(is_react[1:] & (run.state[:-1] == SchemeState.MONITOR)) + 1
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


def detection_delay_s(tau_ext_Nm: float, threshold_Nm: float, a_rad_s: float) -> float | None:
    """Give the closed-form delay of a torque step, t = -ln(1 - h / |tau|) / a; None if it never crosses."""
    if not abs(tau_ext_Nm) > threshold_Nm:
        return None
    return -math.log1p(-threshold_Nm / abs(tau_ext_Nm)) / a_rad_s


def filtered(tau_ext: Vector, cycle: Cycles, period_s: float, a_rad_s: float) -> Vector:
    """Filter a true torque (n, 2) as an ideal detector would see it: first order, at rest at the first sample.

    Each sample is held until the next one; cycle (n,): when they were taken, in periods.
    """
    response = np.zeros_like(tau_ext)
    decays = np.exp(-a_rad_s * period_s * np.diff(cycle).astype(np.float64)).tolist()
    for joint in range(tau_ext.shape[1]):
        value = 0.0
        for row, (sample, decay) in enumerate(zip(tau_ext[:-1, joint].tolist(), decays, strict=True), start=1):
            value = sample + (value - sample) * decay
            response[row, joint] = value
    return response


def _ideal_response(run: Run, touch: Touch) -> Vector:
    """Filter a contact's true torque, from its first row to the one after its last."""
    truth = run.truth
    assert truth is not None
    rows = slice(touch.first, touch.last + 2)
    return filtered(truth.tau_ext[rows], truth.cycle[rows], run.settings.bus.period_s, run.settings.filter.a_rad_s)


def threshold_at(run: Run, time_s: float) -> Vector:
    """Give the threshold in force at a time, Nm (2,); the configured one where detection is off."""
    row = min(int(np.searchsorted(run.time_s(), time_s)), len(run.cycle) - 1)
    configured = np.array(run.settings.detector.threshold_Nm)
    return np.where(np.isfinite(run.threshold[row]), run.threshold[row], configured)


def assign(run: Run, touches: tuple[Touch, ...], detections: tuple[Detection, ...]) -> tuple[int | None, ...]:
    """Give for each detection the index of the true contact that explains it, or None."""
    a = run.settings.filter.a_rad_s
    windows = []
    for touch in touches:
        excess = np.max(np.abs(_ideal_response(run, touch)[-1]) / threshold_at(run, touch.onset_s))
        windows.append((touch.onset_s, touch.end_s + (1.0 + math.log(max(1.0, excess))) / a))
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
        return tuple(_unproven(number, sections, d) for number, d in enumerate(detections, start=1))
    first = {owner: detection for detection, owner in reversed(list(zip(detections, owners, strict=True)))}
    return tuple(_contact(run, number, sections, touch, first.get(number - 1)) for number, touch in _count(touches))


def _count(touches: tuple[Touch, ...]) -> Iterable[tuple[int, Touch]]:
    return enumerate(touches, start=1)


def _reported(detection: Detection | None) -> dict[str, Any]:
    """Give what the reports of a detection say."""
    alarm = detection.alarm if detection else None
    last = (detection.final or alarm) if detection else None
    return {
        "detected_s": detection.detected_s if detection else None,
        "link_at_alarm": alarm.link if alarm else None,
        "link_detected": last.link if last else None,
        "direction": last.direction if last else None,
        "tau_ext_peak_hat_Nm": last.tau_ext_peak if last else None,
    }


def _unproven(number: int, sections: tuple[Section, ...], detection: Detection) -> Contact:
    return Contact(
        number=number,
        section=_section_at(sections, detection.detected_s),
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
    threshold = threshold_at(run, touch.onset_s)
    a = run.settings.filter.a_rad_s
    # What the host can have seen: up to the detection for the delay, up to the end of the window for the rest.
    until_alarm = tau_ext[since_s <= delay_s]
    until_final = tau_ext[since_s <= delay_s + run.settings.detector.isolation_window_s]
    steps = [
        delay
        for joint in range(JOINTS)
        if (delay := detection_delay_s(np.abs(until_alarm[:, joint]).max(), threshold[joint], a)) is not None
    ]
    over = np.flatnonzero((np.abs(_ideal_response(run, touch)) > threshold).any(axis=1))
    crossing_s = run.time_of_s(truth.cycle[touch.first + over[:1]])
    ideal_ms = float(crossing_s[0] - touch.onset_s) * 1e3 if over.size else None
    peak = until_final[np.argmax(np.abs(until_final), axis=0), range(JOINTS)]
    reported = _reported(detection)
    row = min(int(np.searchsorted(run.time_s(), touch.onset_s)), len(run.cycle) - 1)
    return Contact(
        number=number,
        section=_section_at(sections, touch.onset_s),
        link=touch.link,
        onset_s=touch.onset_s,
        end_s=touch.end_s,
        is_armed=bool(run.state[max(row - 1, 0)] == SchemeState.MONITOR),
        delay_ms=delay_s * 1e3 if detection else None,
        law_ms=min(steps) * 1e3 if steps else None,
        ideal_ms=ideal_ms,
        direction_ok=_is_direction_right(reported["direction"], until_final.sum(axis=0)),
        tau_ext_Nm=(float(peak[0]), float(peak[1])),
        torque_error_ratio=_torque_ratio(reported["tau_ext_peak_hat_Nm"], peak),
        **reported,
    )


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
    settling_s = SETTLING_TIME_CONSTANTS / run.settings.filter.a_rad_s
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


def frozen_residuals(
    run: Run, sections: tuple[Section, ...], touches: tuple[Touch, ...], detections: tuple[Detection, ...]
) -> dict[str, Residual]:
    """Give the largest residual of each adaptation and detection section where nobody touches the arm."""
    free = untouched(run, touches, detections)
    residuals = {}
    for section in sections:
        if section.kind not in ("adaptation", "detection"):
            continue
        rows = free & _rows(run, section)
        is_frozen = section.kind == "detection"
        if is_frozen:
            rows &= run.state == SchemeState.MONITOR
        residuals[section.label] = Residual(
            identified=_largest(run.tau_ext_hat[rows]) if is_frozen else None,
            cad=_largest(run.tau_ext_hat_cad[rows]) if run.has_cad else None,
            cycles=int(rows.sum()),
        )
    return residuals


def _largest(residual: Vector) -> tuple[float, float] | None:
    if residual.shape[0] == 0:
        return None
    largest = np.abs(residual).max(axis=0)
    return float(largest[0]), float(largest[1])


def _parameters(run: Run, sections: tuple[Section, ...]) -> dict[str, dict[str, tuple[float | None, float]]]:
    """Give true and identified parameters at the end of each adaptation."""
    found = {}
    for section in sections:
        if section.kind != "adaptation":
            continue
        row = int(np.flatnonzero(_rows(run, section))[-1])
        if section.is_complete:
            row += 1  # the cycle that enters MONITOR still learns
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
            row = int(np.flatnonzero(_rows(run, section))[-1])
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
    payload_kg: dict[str, float | None],
) -> tuple[PaperRow, ...]:
    settings = run.settings
    times_s = list(adaptation_s.values())
    frozen = [residuals[section.label] for section in sections if section.kind == "detection"]
    adaptations = [section.label for section in sections if section.kind == "adaptation"]
    payload = payload_kg.get(adaptations[1]) if len(adaptations) > 1 else None
    law = {"least_squares": "least squares", "gradient": "gradient"}[settings.estimator.law]
    a, b = settings.filter.a_rad_s, settings.filter.b_rad_s
    within = "within ±0.15"
    seen = [contact.detected_s for contact in contacts if contact.detected_s is not None]
    rows = [
        ("First adaptation", "5.2 s", _seconds(times_s, 0)),
        ("Adaptation after the payload change", "about 5.3 s", _seconds(times_s, 1)),
        ("Payload", "1 kg", "–" if payload is None else f"{payload:g} kg"),
        ("Frozen residual without payload, joints 1 / 2", within, _residual_text(frozen, 0, "identified")),
        ("Frozen residual with payload, joints 1 / 2", within, _residual_text(frozen, 1, "identified")),
        ("The CAD model's, without payload", "larger; joint 2 good", _residual_text(frozen, 0, "cad")),
        ("The CAD model's, with payload", "much larger, both joints", _residual_text(frozen, 1, "cad")),
        ("First contact detected at", "10 s", f"{seen[0]:.2f} s" if seen else "–"),
        ("Bound β of eq. (15)", "0.1 Nm", f"{settings.termination.beta_Nm:g} Nm"),
        ("Hold T of eq. (15)", "5 s", f"{settings.termination.hold_s:g} s"),
        ("Threshold, joints 1 / 2", "0.15 Nm", _pair(settings.detector.threshold_Nm)),
        ("Filter a / b", "10 / 10 rad/s", f"{a:g} / {b:g} rad/s"),
        ("Estimator", "least squares", law),
        ("Control rate", "1 kHz", f"{1e3 / settings.bus.period_us:g} kHz"),
    ]
    return tuple(PaperRow(*row) for row in rows)


def _seconds(times_s: list[float | None], index: int) -> str:
    if index >= len(times_s):
        return "–"
    value = times_s[index]
    return "not finished" if value is None else f"{value:.2f} s"


def _pair(values: tuple[float, float] | None) -> str:
    if values is None:
        return "–"
    return f"{values[0]:g} Nm" if values[0] == values[1] else f"{values[0]:g} / {values[1]:g} Nm"


def _residual_text(frozen: list[Residual], index: int, model: str) -> str:
    values = getattr(frozen[index], model) if index < len(frozen) else None
    return "–" if values is None else f"{values[0]:.3f} / {values[1]:.3f} Nm"


def _verdict(
    run: Run,
    contacts: tuple[Contact, ...],
    false_s: tuple[float, ...],
    missed: int,
    adaptation_s: dict[str, float | None],
    payload_kg: dict[str, float | None],
    fault: str | None,
    fault_s: float | None,
) -> str:
    text = f"{_contacts_text(run, contacts, false_s, missed)}; {_identified_text(adaptation_s, payload_kg)}"
    if fault is not None:
        text = f"the run ended in FAULT ({fault}) at {fault_s:.2f} s; {text}"
    return text[:1].upper() + text[1:] + "."


def _contacts_text(run: Run, contacts: tuple[Contact, ...], false_s: tuple[float, ...], missed: int) -> str:
    if run.truth is None:
        return f"{_number(len(contacts), 'detection')}, whose truth is not recorded"
    armed = [contact for contact in contacts if contact.is_armed]
    if not armed:
        found = "no contact while detection was armed"
    elif missed:
        found = f"{len(armed) - missed} of {_number(len(armed), 'contact')} detected, {missed} missed"
    else:
        found = "the one contact detected" if len(armed) == 1 else f"all {len(armed)} contacts detected"
    false = "none false" if not false_s else _number(len(false_s), "false alarm")
    if not armed and not false_s:
        false = "no false alarm"
    disarmed = len(contacts) - len(armed)
    outside = f", {disarmed} more while it was not armed" if disarmed else ""
    return f"{found}{outside}, {false}"


def _number(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _identified_text(adaptation_s: dict[str, float | None], payload_kg: dict[str, float | None]) -> str:
    if not adaptation_s:
        return "the arm never moved to adapt"
    labels = list(adaptation_s)
    if adaptation_s[labels[0]] is None:
        return "the model was not identified"
    text = f"the model was identified in {adaptation_s[labels[0]]:.2f} s"
    for before, label in itertools.pairwise(labels):
        old, new, time_s = payload_kg[before], payload_kg[label], adaptation_s[label]
        change = "the payload change"
        if old is not None and new is not None and new != old:
            change = f"{new - old:g} kg" if new > old else f"taking off {old - new:g} kg"
        text += f", but not again after {change}" if time_s is None else f" and again in {time_s:.2f} s after {change}"
    return text
