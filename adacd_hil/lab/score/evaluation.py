"""The evaluation of a run: pure functions from its arrays to the results that `metrics` defines.

Timing evidence comes from the columns of /cycle, records.CycleRecord. Percentiles are values that occurred: of
times that must be small p50, p99, p99.9 and the largest; of slack, which must be large, p50, p1, p0.1 and the smallest.
*Reaction latency* is the compute time of each cycle in which the state becomes REACT: from the data that decided to
the first command that reacts.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adacd_hil.lab.score.histogram import histogram_by_key, log_counts
from adacd_hil.lab.score.margins import UntouchedGatherer, evaluate_certified, last_row
from adacd_hil.lab.score.metrics import (
    Count,
    Metrics,
    ReportedContact,
    TimingEvidence,
)
from adacd_hil.lab.score.run_arrays import (
    COMPUTE,
    LATENESS,
    QUANTITIES,
    CycleColumns,
    Quantity,
    Run,
    Section,
    section_at,
    split_sections,
)
from adacd_hil.lab.score.run_faults import CyclicDataGatherer, find_breaks, find_faults
from adacd_hil.lab.score.run_judge import (
    channels_at,
    contacts_of,
    find_detections,
    ideal_response,
    row_at,
    step_delay_s,
)
from adacd_hil.lab.score.verdict import compare_with_paper, list_findings
from adacd_hil.log.logged_run import Cycles, enters_react
from adacd_hil.records import JOINTS, PARAMETER_NAMES, ContactReport, Location, SchemeState, Vector
from adacd_hil.score.distribution import Distribution
from adacd_hil.score.judge import Detection, Score, TrueContact, judge
from adacd_hil.settings.configuration import Settings


class RunGatherer:
    """Sums over a run, gathered piece by piece in bounded memory.

    `add_times` adds times and cyclic data; `untouched.add_untouched` adds residuals.
    """

    def __init__(self, settings: Settings, is_modelled: bool) -> None:
        self.untouched = UntouchedGatherer(settings)
        self.data = CyclicDataGatherer(settings)
        self.timing = TimingGatherer(settings.bus.period_us, is_modelled)
        self._state = int(SchemeState.INIT)  # of the last cycle so far

    def add_times(self, timing: CycleColumns, cycle: Cycles, state: NDArray[np.uint8]) -> None:
        """Add the times and the cyclic data of the next cycles, in the order of the run: the last state is kept.

        timing: columns of /cycle. cycle, state: of /scheme (k,), for the same cycles.
        """
        self.timing.add_columns(timing, find_reactions(timing, cycle, state, self._state))
        self.data.add_columns(timing, cycle, state)
        if state.size:
            self._state = int(state[-1])


def evaluate(run: Run, gathered: RunGatherer) -> Metrics:
    """Return all metrics of a run; gathered: the sums over all cycles."""
    timing, data = gathered.timing.evidence(), gathered.data.data(run)
    detections = find_detections(run)
    score = judge(contacts_of(run), detections)
    sections = split_sections(run)
    adaptation_s: dict[str, float | None] = {}
    parameters: dict[str, dict[str, tuple[float | None, float]]] = {}
    payload_kg: dict[str, float | None] = {}
    for section in (section for section in sections if section.kind == "adaptation"):
        adaptation_s[section.label] = section.duration_s if section.is_complete else None
        row = last_row(run, section)
        theta, _ = _model_in(run, row)
        _, payload_kg[section.label] = _model_in(run, row - int(section.is_complete))  # its own last cycle
        estimates = zip(run.parameter_names, run.theta_hat[row].tolist(), strict=True)
        parameters[section.label] = {name: (theta.get(name), value) for name, value in estimates}
    has_truth = run.truth is not None
    false_s = tuple((alarm.t_ns - run.zero_ns) * 1e-9 for alarm in score.false_alarms)
    faults = find_faults(run)
    metrics = Metrics(
        sections=sections,
        adaptation_s=adaptation_s,
        frozen_residual_max_Nm=gathered.untouched.residuals(sections),
        contacts=list_contacts(run, sections, detections, score),
        false_alarms_s=false_s if has_truth else None,
        missed=score.missed if has_truth else None,
        parameters=parameters,
        payload_kg=payload_kg,
        fault=faults[0].reason if faults else None,
        fault_s=faults[0].at_s if faults else None,
        cycle={
            "count": timing.cycles,  # those before motion start, too
            "duration_s": float((run.t_ns[-1] - run.t_ns[0]) * 1e-9) if run.t_ns.size else 0.0,
            "clock": run.metadata.get("clock"),
            "scheduler": run.metadata.get("scheduler"),
        },
        timing=timing,
        data=data,
        frames=run.frames,
        dropped=run.dropped,
        evidence=evaluate_certified(run, sections, gathered.untouched),
        armed_false_alarms=score.armed_false_alarms if has_truth else None,
    )
    findings = list_findings(run, metrics, score, faults, find_breaks(run))
    return replace(metrics, paper=compare_with_paper(run, metrics), findings=findings)


def _model_in(run: Run, row: int) -> tuple[dict[str, float], float | None]:
    """Return the true parameters in the cycle of a row by name, and the true payload, kg.

    {} and None without the truth, or if it has no parameters.
    """
    place = None if run.truth is None else run.truth.model_row(int(run.cycle[row]))
    if run.truth is None or place is None:
        return {}, None
    theta = dict(zip(PARAMETER_NAMES, run.truth.theta[place].tolist(), strict=True))
    return theta, float(run.truth.payload_kg[place])


def list_contacts(
    run: Run, sections: tuple[Section, ...], detections: tuple[Detection, ...], score: Score
) -> tuple[ReportedContact, ...]:
    """Return the true contacts with the detection that found each; without the truth, each detection as a contact."""
    if run.truth is None:
        return tuple(_unproven(run, number, sections, d) for number, d in enumerate(detections, run.first_contact))
    raised: dict[int | None, Detection] = {detection.t_ns: detection for detection in detections}
    return tuple(_contact(run, sections, contact, raised.get(contact.detected_ns)) for contact in score.contacts)


def _reported(run: Run, detection: Detection | None) -> dict[str, Any]:
    """Return those fields of a `ReportedContact`, by name, that its detection and reports give.

    {} without a detection; without a report of it, only `detected_s`.
    """
    if detection is None:
        return {}
    said: dict[str, Any] = {"detected_s": (detection.t_ns - run.zero_ns) * 1e-9}
    first, last = detection.first, detection.last
    if first is None or last is None:
        return said
    said |= {
        "link_at_alarm": first.link,
        "link_detected": last.link,
        "direction": last.direction,
        "tau_ext_peak_hat_Nm": last.tau_ext_peak,
        "impulse_Nm_s": last.impulse,
    }
    return said if last.location is Location.NOT_SOUGHT else said | _told(last)


def _told(report: ContactReport) -> dict[str, Any]:
    """Return those fields of a `ReportedContact`, by name, that only the certified scheme reports.

    A force, a lever arm and a standard deviation are None if that deviation isn't finite.
    """
    return {
        "level": report.level.name,
        "kind": report.kind.name,
        "reaction": report.reaction.name,
        "location": report.location.name,
        "is_two_sided": report.is_two_sided,
        "tau_ext_peak_sigma_Nm": tuple(map(_finite, report.tau_ext_peak_sigma)),
        "impulse_sigma_Nm_s": tuple(map(_finite, report.impulse_sigma)),
        "force_N": report.force_N if math.isfinite(report.force_sigma) else None,
        "force_sigma_N": _finite(report.force_sigma),
        "lever_m": report.lever_m if math.isfinite(report.lever_sigma) else None,
        "lever_sigma_m": _finite(report.lever_sigma),
        "blind_deg": math.degrees(report.blind_rad),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _state_at(run: Run, time_s: float) -> SchemeState:
    """Return the state in the cycle before a time, s since motion start; in the first cycle at the earliest."""
    return SchemeState(run.state[max(row_at(run, time_s) - 1, 0)])


def _unproven(run: Run, number: int, sections: tuple[Section, ...], detection: Detection) -> ReportedContact:
    """Return a detection as a contact of a run without the truth; number: of the contact."""
    reported = _reported(run, detection)
    return ReportedContact(
        number=number,
        section=section_at(sections, reported["detected_s"]),
        state=_state_at(run, reported["detected_s"]).name,
        is_armed=True,
        **reported,
    )


def _contact(
    run: Run, sections: tuple[Section, ...], contact: TrueContact, detection: Detection | None
) -> ReportedContact:
    """Return a true contact with its delays and peaks, and whether its detection named link and direction rightly.

    The detection's reports are in it, too. detection: None: it was not detected. The run must have the truth.
    """
    time_s = contact.time_s
    onset_s, touched = float(time_s[0]), slice(contact.rows)
    tau_ext, since_s = contact.tau_ext[touched], time_s[touched] - onset_s
    reported = _reported(run, detection)
    delay_s = reported["detected_s"] - onset_s if reported else math.inf
    # The host sees samples up to the detection for the delay, up to the end of the window for the rest.
    until_alarm = np.abs(tau_ext[since_s <= delay_s]).max(axis=0)
    report_s = run.settings.report_s
    is_seen = since_s <= delay_s + report_s
    until_final, links = _touches(run, onset_s, onset_s + delay_s + report_s if reported else float(time_s[-1]))
    channels = channels_at(run, onset_s)
    steps_s = [step_delay_s(until_alarm, threshold, a_rad_s, b_rad_s) for a_rad_s, b_rad_s, threshold in channels]
    crossed_s = [delay for delay in steps_s if delay is not None]
    period_s = run.settings.bus.period_s
    is_over = [
        np.abs(ideal_response(contact.tau_ext, contact.cycle, period_s, a_rad_s, b_rad_s)) > threshold
        for a_rad_s, b_rad_s, threshold in channels
    ]
    over = np.flatnonzero(np.any(is_over, axis=(0, 2)))
    peak = until_final[np.argmax(np.abs(until_final), axis=0), range(JOINTS)]
    return ReportedContact(
        number=contact.number,
        section=section_at(sections, onset_s),
        state=_state_at(run, onset_s).name,
        link=contact.link,
        onset_s=onset_s,
        end_s=float(time_s[-1]),
        is_armed=contact.is_armed,
        delay_ms=contact.delay_ms,
        law_ms=min(crossed_s) * 1e3 if crossed_s else None,
        ideal_ms=float(time_s[over[0]] - onset_s) * 1e3 if over.size else None,
        link_ok=None if reported.get("link_detected") is None else reported["link_detected"] in links,
        direction_ok=_is_direction_right(reported.get("direction"), until_final.sum(axis=0)),
        tau_ext_Nm=(float(peak[0]), float(peak[1])),
        torque_error_ratio=_torque_ratio(reported.get("tau_ext_peak_hat_Nm"), peak),
        true_force_N=float(contact.force_N[touched][is_seen].max()),
        **reported,
    )


def _touches(run: Run, from_s: float, until_s: float) -> tuple[Vector, Cycles]:
    """Return the true torque, Nm (k, 2), and the touched link (k,) of all cycles with any contact between two times.

    So a second person who touches the arm meanwhile is included.
    """
    assert run.truth is not None
    time_s = run.truth.time_s
    rows = slice(np.searchsorted(time_s, from_s), np.searchsorted(time_s, until_s, side="right"))
    is_touched = run.truth.contact_index[rows] >= 0.0
    return run.truth.tau_ext[rows][is_touched], run.truth.contact_link[rows][is_touched].astype(np.int64)


def _is_direction_right(direction: tuple[int, int] | None, impulse: Vector) -> bool | None:
    """Return whether the reported direction names a joint, and its sign is right at each joint that it names.

    direction: reported sign of each joint, 0: not named; None: not reported, and so is the result. impulse (2,): its
    sign is the true direction.
    """
    if direction is None:
        return None
    told = [joint for joint in range(JOINTS) if direction[joint]]
    return bool(told) and all(direction[joint] == np.sign(impulse[joint]) for joint in told)


def _torque_ratio(peak_hat: tuple[float, float] | None, peak: Vector) -> float | None:
    """Return the reported over the true peak torque, at the joint with the larger true one.

    None if no peak was reported, or if the true one is 0.
    """
    joint = int(np.argmax(np.abs(peak)))
    if peak_hat is None or peak[joint] == 0.0:
        return None
    return float(peak_hat[joint] / peak[joint])


OLDEST_CYCLES: Final = 10
"""Data ages from here on are counted as one."""
PER_CYCLES: Final = 100_000
"""Counts are given per so many cycles, too."""


QUEUES: Final = {"receive": "receive_queue_bytes", "transmit": "transmit_queue_bytes", "log": "log_queue_bytes"}
"""Queues and their columns."""
_RUNNING: Final = ("overruns", "frames_lost")
"""Columns that count since the run began."""
_PER_CYCLE: Final = ("frames_missing", "commands_late")
"""Columns that count within a cycle."""


class TimingGatherer:
    """Sums over /cycle, gathered piece by piece in bounded memory."""

    def __init__(self, period_us: float, is_modelled: bool) -> None:
        self._period_us = period_us
        self._is_modelled = is_modelled
        self._cycles = 0
        # Lockstep has no grid to be late on, and no queues.
        quantities = [quantity for quantity in QUANTITIES if not (is_modelled and quantity is LATENESS)]
        self._times = {quantity: Distribution() for quantity in quantities}
        self._histograms = {quantity.name: log_counts(np.empty(0)) for quantity in quantities}
        self._depths = {} if is_modelled else {name: Distribution() for name in QUEUES}
        self._ages = np.zeros(OLDEST_CYCLES + 1, np.int64)
        self._totals = dict.fromkeys((*_RUNNING, *_PER_CYCLE), 0)
        self._last = dict.fromkeys(_RUNNING, 0)  # value of each running count
        self._reactions: Distribution | None = None

    def add_columns(self, columns: CycleColumns, reactions: NDArray[np.bool_] | None = None) -> None:
        """Add times, queues, data ages and counts of the next cycles.

        Call it in the order of the run: the last values of running counts are kept. If the times are modelled, lateness
        and queues are left out. reactions (n,): whether the state becomes REACT in a cycle; None without states.
        """
        self._cycles += len(columns)
        for quantity, times in self._times.items():
            values_us = columns.times_us(quantity)
            times.add_values(values_us)
            self._histograms[quantity.name] += log_counts(values_us)
        for name, depths in self._depths.items():
            depths.add_values(columns[QUEUES[name]])
        self._ages += np.bincount(np.minimum(columns["data_age"], OLDEST_CYCLES), minlength=OLDEST_CYCLES + 1)
        for name in self._totals:
            added = columns.steps(name, self._last[name]) if name in _RUNNING else columns[name]
            self._totals[name] += int(added.sum())
        if len(columns):
            self._last = {name: int(columns[name][-1]) for name in _RUNNING}
        if reactions is not None:
            self._reactions = self._reactions or Distribution()
            self._reactions.add_values(columns.times_us(COMPUTE)[reactions])

    def evidence(self) -> TimingEvidence:
        """Return the statistics of all cycles added so far: times, reactions, ages of data, queues, counts."""
        reactions = self._reactions
        return TimingEvidence(
            period_us=self._period_us,
            is_modelled=self._is_modelled,
            cycles=self._cycles,
            times={quantity.name: self._percentiles(quantity) for quantity in QUANTITIES},
            histograms={name: histogram_by_key(counts) for name, counts in self._histograms.items()},
            reaction=None if reactions is None else {"count": reactions.count, **reactions.percentiles()},
            data_age=tuple(self._ages.tolist()),
            queues_bytes={name: self._depths[name].percentiles() if name in self._depths else None for name in QUEUES},
            counts={name: self._count(total) for name, total in self._totals.items()},
        )

    def _percentiles(self, quantity: Quantity) -> Mapping[str, float] | None:
        values = self._times.get(quantity)
        if values is None:
            return None
        return values.low_percentiles() if quantity.is_reserve else values.percentiles()

    def _count(self, total: int) -> Count:
        return Count(total, total * PER_CYCLES / self._cycles if self._cycles else None)


def collect_evidence(columns: CycleColumns, period_us: float) -> TimingEvidence:
    """Return the statistics of the measured times in the columns of a log without states: reactions are left out."""
    gatherer = TimingGatherer(period_us, is_modelled=False)
    gatherer.add_columns(columns)
    return gatherer.evidence()


def find_reactions(
    columns: CycleColumns, cycle: Cycles, state: NDArray[np.uint8], before: int = SchemeState.INIT
) -> NDArray[np.bool_]:
    """Return for each cycle of `columns` (n,) whether a reaction begins in it.

    cycle, state: those of /scheme (k,). before: the state in the cycle before the first.
    """
    return np.isin(columns["cycle"], cycle[enters_react(np.concatenate(([before], state))[:-1], state)])
