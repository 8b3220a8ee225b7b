"""The contacts of a run: each true one with its detection and what the scheme reports of it.

Which are armed and what found them: `adacd_hil.analysis.score.judge`. `law_ms` and `ideal_ms` are those of the paper's
filter, or of the fastest channel of the certified scheme's bank.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from adacd_hil.analysis.logged_run import Run
from adacd_hil.analysis.score.alarms import Detection
from adacd_hil.analysis.score.judge import JudgedContact, Score
from adacd_hil.analysis.score.touches import Touch, channels_at, ideal_response, row_at
from adacd_hil.analysis.sections import Section, section_at
from adacd_hil.records import JOINTS, ContactReport, Location, SchemeState, Vector
from adacd_hil.scheme.contact.classification import WINDOW_S


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
