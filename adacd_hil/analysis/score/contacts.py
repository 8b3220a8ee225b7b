"""The contacts of a run: each true one, its detection, what the scheme reports of it and what an ideal detector would.

Which are armed and what found them: `adacd_hil.analysis.score.judge`. `law_ms` and `ideal_ms` are those of the paper's
filter, or of the fastest channel of the certified scheme's bank.
"""

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.analysis.logged_run import Mask, Run, Section, section_at
from adacd_hil.analysis.score.judge import Detection, JudgedContact, Score, TouchWindow, judge
from adacd_hil.analysis.score.timing import Cycles
from adacd_hil.records import JOINTS, ContactReport, Location, SchemeState, Vector
from adacd_hil.scheme.contact.contact_report import WINDOW_S
from adacd_hil.scheme.model.filter_bank import channels_of, step_response


class Touch(NamedTuple):
    """A true contact: its number, its rows [first, last] of the truth, and times since motion start."""

    number: int
    first: int
    last: int
    link: int
    onset_s: float
    end_s: float


def true_contacts(run: Run) -> tuple[Touch, ...]:
    """Find the true contacts in the truth record; without one there are none to be known."""
    truth = run.truth
    if truth is None or truth.cycle.size == 0 or run.cycle.size == 0:
        return ()
    time_s, last = run.truth_time_s(), truth.cycle.size - 1
    return tuple(
        Touch(
            number, start, end - 1, int(truth.contact_link[start]), float(time_s[start]), float(time_s[min(end, last)])
        )
        for number, (start, end) in enumerate(contact_rows(truth.contact_index, truth.attempt), run.first_contact)
    )


def contact_rows(index: NDArray[Any], attempt: Cycles | None) -> list[tuple[int, int]]:
    """Give from which row to before which each contact of a truth lasts; index, attempt (m,): of its rows.

    Another index is another contact, though nobody lets go in between. What goes on as an attempt begins is another
    one, too: the scheme begins anew.
    """
    is_edge = index[1:] != index[:-1]
    if attempt is not None:
        is_edge |= attempt[1:] != attempt[:-1]
    bounds = [0, *(np.flatnonzero(is_edge) + 1).tolist(), len(index)]
    return [(start, end) for start, end in pairwise(bounds) if end > start and index[start] >= 0]


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


def two_pole_delay_s(tau_ext_Nm: float, threshold_Nm: float, a_rad_s: float, b_rad_s: float) -> float | None:
    """Give the delay of a torque step behind two first-order low-passes; None if it never crosses.

    The response rises steadily, so that bisection finds the crossing.
    """
    if not abs(tau_ext_Nm) > threshold_Nm:
        return None
    wanted = threshold_Nm / abs(tau_ext_Nm)
    low_s, high_s = 0.0, 40.0 / min(a_rad_s, b_rad_s)
    for _ in range(60):
        middle_s = 0.5 * (low_s + high_s)
        is_below = step_response(middle_s, a_rad_s, b_rad_s) < wanted
        low_s, high_s = (middle_s, high_s) if is_below else (low_s, middle_s)
    return high_s


@dataclass(frozen=True)
class Channel:
    """A filter with its threshold, Nm (2,): first order, and with `smoothing_rad_s` a second one behind it."""

    cutoff_rad_s: float
    smoothing_rad_s: float | None
    threshold: Vector

    def step_delay_s(self, tau_ext: Vector) -> float | None:
        """Give how long steps of each joint's torque (2,) take over the threshold, the faster joint; None: never."""
        delays_s = []
        for joint in range(JOINTS):
            tau, h = float(tau_ext[joint]), float(self.threshold[joint])
            if self.smoothing_rad_s is None:
                delays_s.append(detection_delay_s(tau, h, self.cutoff_rad_s))
            else:
                delays_s.append(two_pole_delay_s(tau, h, self.cutoff_rad_s, self.smoothing_rad_s))
        return min((delay_s for delay_s in delays_s if delay_s is not None), default=None)

    def respond(self, tau_ext: Vector, cycle: Cycles, period_s: float) -> Vector:
        """Filter a true torque (n, 2), at rest at the first sample; see `filtered`."""
        response = filtered(tau_ext, cycle, period_s, self.cutoff_rad_s)
        if self.smoothing_rad_s is None:
            return response
        return filtered(response, cycle, period_s, self.smoothing_rad_s)


def threshold_at(run: Run, time_s: float) -> Vector:
    """Give the threshold of `tau_ext_hat` in force at a time, Nm (2,); the configured one where detection is off."""
    row = row_at(run, time_s)
    configured = np.array(run.settings.detector.threshold_Nm)
    return np.where(np.isfinite(run.threshold[row]), run.threshold[row], configured)


def row_at(run: Run, time_s: float) -> int:
    """Give the first cycle's row that is not before a time; the last one after the end."""
    t_ns, zero_ns = run.t_ns, run.zero_ns
    row = bisect_left(range(len(t_ns)), time_s, key=lambda row: float((t_ns[row] - zero_ns) * 1e-9))
    return min(row, len(t_ns) - 1)


def channels_at(run: Run, time_s: float) -> tuple[Channel, ...]:
    """Give what detects at a time: the paper's one filter, or the bank with its thresholds."""
    if run.certified is None:
        return (Channel(run.a_rad_s, None, threshold_at(run, time_s)),)
    thresholds = run.certified.threshold[row_at(run, time_s)]
    return tuple(
        Channel(cutoff, smoothing, threshold)
        for (cutoff, smoothing), threshold in zip(channels_of(run.settings), thresholds, strict=True)
    )


def ideal_response(run: Run, touch: Touch, channel: Channel) -> Vector:
    """Filter a contact's true torque by a channel, from its first row to the one after its last (k, 2)."""
    truth = run.truth
    assert truth is not None
    rows = slice(touch.first, touch.last + 2)
    return channel.respond(truth.tau_ext[rows], truth.cycle[rows], run.settings.bus.period_s)


def forgotten_after_s(tau_ext: Vector, cycle: Cycles, period_s: float, a_rad_s: float, threshold: Vector) -> float:
    """Give how long after its end an alarm may still stem from a contact, s.

    One time constant after its true torque (k, 2), filtered with `a_rad_s`, is back within the threshold (2,).
    """
    response = filtered(tau_ext, cycle, period_s, a_rad_s)[-1]
    excess = float(np.max(np.abs(response) / threshold))
    return (1.0 + math.log(max(1.0, excess))) / a_rad_s


def touch_window(run: Run, touch: Touch, a_rad_s: float, threshold: Vector, armed: Mask) -> TouchWindow:
    """Give a contact as it is judged; armed (n,): the cycles of the run in which detection is armed."""
    truth = run.truth
    assert truth is not None
    rows = slice(touch.first, touch.last + 2)
    after_s = forgotten_after_s(truth.tau_ext[rows], truth.cycle[rows], run.settings.bus.period_s, a_rad_s, threshold)
    row = row_at(run, touch.onset_s)
    onset_ns, forgotten_ns = (run.zero_ns + round(at_s * 1e9) for at_s in (touch.onset_s, touch.end_s + after_s))
    is_armed = bool(row > 0 and armed[row - 1])
    return TouchWindow(touch.number, touch.link, onset_ns, forgotten_ns, is_armed)


def judge_run(run: Run, touches: Sequence[Touch], detections: Sequence[Detection]) -> Score:
    """Judge the alarms of a run's own scheme."""
    armed = run.state == SchemeState.MONITOR
    windows = [touch_window(run, touch, run.a_rad_s, threshold_at(run, touch.onset_s), armed) for touch in touches]
    return judge(windows, [detection.raised for detection in detections])


@dataclass(frozen=True, kw_only=True)
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
    section: str | None = None
    state: str
    link: int | None = None
    onset_s: float | None = None
    end_s: float | None = None
    is_armed: bool
    detected_s: float | None = None
    delay_ms: float | None = None
    law_ms: float | None = None
    ideal_ms: float | None = None
    link_at_alarm: int | None = None
    link_detected: int | None = None
    direction: tuple[int, int] | None = None
    direction_ok: bool | None = None
    tau_ext_Nm: tuple[float, float] | None = None
    tau_ext_peak_hat_Nm: tuple[float, float] | None = None
    torque_error_ratio: float | None = None
    true_force_N: float | None = None
    level: str | None = None
    kind: str | None = None
    reaction: str | None = None
    location: str | None = None
    is_two_sided: bool | None = None
    tau_ext_peak_sigma_Nm: tuple[float | None, float | None] | None = None
    impulse_Nm_s: tuple[float, float] | None = None
    impulse_sigma_Nm_s: tuple[float | None, float | None] | None = None
    force_N: float | None = None
    force_sigma_N: float | None = None
    lever_m: float | None = None
    lever_sigma_m: float | None = None
    blind_deg: float | None = None

    @property
    def at_s(self) -> float:
        """Its onset, or its detection where the onset is not known."""
        at_s = self.onset_s if self.onset_s is not None else self.detected_s
        assert at_s is not None
        return at_s


def list_contacts(
    run: Run,
    sections: tuple[Section, ...],
    touches: tuple[Touch, ...],
    detections: tuple[Detection, ...],
    score: Score,
) -> tuple[Contact, ...]:
    """List the true contacts with the detection that found each; without the truth the detections."""
    if run.truth is None:
        return tuple(_unproven(run, number, sections, d) for number, d in enumerate(detections, run.first_contact))
    raised = {detection.raised.t_ns: detection for detection in detections}
    return tuple(
        _contact(run, sections, touch, judged, None if judged.detected_ns is None else raised[judged.detected_ns])
        for touch, judged in zip(touches, score.contacts, strict=True)
    )


def _reported(detection: Detection | None) -> dict[str, Any]:
    """Give what the reports of a detection say."""
    if detection is None:
        return {}
    said: dict[str, Any] = {"detected_s": detection.detected_s}
    last = detection.final or detection.alarm
    if detection.alarm is None or last is None:
        return said
    said |= {
        "link_at_alarm": detection.alarm.link,
        "link_detected": last.link,
        "direction": last.direction,
        "tau_ext_peak_hat_Nm": last.tau_ext_peak,
        "impulse_Nm_s": last.impulse,
    }
    return said if last.location is Location.NOT_SOUGHT else said | _told(last)


def _told(report: ContactReport) -> dict[str, Any]:
    """Give what only the certified scheme tells."""
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
    """Give the state in the cycle before a time."""
    return SchemeState(run.state[max(row_at(run, time_s) - 1, 0)])


def _unproven(run: Run, number: int, sections: tuple[Section, ...], detection: Detection) -> Contact:
    return Contact(
        number=number,
        section=section_at(sections, detection.detected_s),
        state=_state_at(run, detection.detected_s).name,
        is_armed=True,
        **_reported(detection),
    )


def _contact(
    run: Run, sections: tuple[Section, ...], touch: Touch, judged: JudgedContact, detection: Detection | None
) -> Contact:
    truth = run.truth
    assert truth is not None
    rows = slice(touch.first, touch.last + 1)
    tau_ext = truth.tau_ext[rows]
    since_s = run.truth_time_s(rows) - touch.onset_s
    delay_s = detection.detected_s - touch.onset_s if detection else math.inf
    # What the host can have seen: up to the detection for the delay, up to the end of the window for the rest.
    until_alarm = np.abs(tau_ext[since_s <= delay_s]).max(axis=0)
    is_seen = since_s <= delay_s + _window_s(run)
    until_final = tau_ext[is_seen]
    channels = channels_at(run, touch.onset_s)
    steps_s = [delay for channel in channels if (delay := channel.step_delay_s(until_alarm)) is not None]
    is_over = [np.abs(ideal_response(run, touch, channel)) > channel.threshold for channel in channels]
    over = np.flatnonzero(np.any(is_over, axis=(0, 2)))
    ideal_ms = None
    if over.size:
        crossing = touch.first + int(over[0])
        ideal_ms = float(run.truth_time_s(slice(crossing, crossing + 1))[0] - touch.onset_s) * 1e3
    peak = until_final[np.argmax(np.abs(until_final), axis=0), range(JOINTS)]
    reported = _reported(detection)
    return Contact(
        number=judged.number,
        section=section_at(sections, touch.onset_s),
        state=_state_at(run, touch.onset_s).name,
        link=judged.link,
        onset_s=touch.onset_s,
        end_s=touch.end_s,
        is_armed=judged.is_armed,
        delay_ms=judged.delay_ms,
        law_ms=min(steps_s) * 1e3 if steps_s else None,
        ideal_ms=ideal_ms,
        direction_ok=_is_direction_right(reported.get("direction"), until_final.sum(axis=0)),
        tau_ext_Nm=(float(peak[0]), float(peak[1])),
        torque_error_ratio=_torque_ratio(reported.get("tau_ext_peak_hat_Nm"), peak),
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
