"""True contacts of a run, detections of its scheme, and what an ideal detector with its filters would see."""

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from adacd_hil.analysis.logged_run import Cycles, Mask, Run, enters_react
from adacd_hil.analysis.score.judge import Alarm, Score, TouchWindow, contact_bounds, filtered, forgotten_after_s, judge
from adacd_hil.records import JOINTS, ContactReport, SchemeState, Vector
from adacd_hil.scheme.model.filter_bank import channels_of, step_response


class LoggedDetection(NamedTuple):
    """An alarm of a run: its row, its time, and the report at the alarm and at the end of the window."""

    row: int
    detected_s: float
    raised: Alarm
    alarm: ContactReport | None
    final: ContactReport | None


def find_detections(run: Run) -> tuple[LoggedDetection, ...]:
    """Find the alarms of a run and the reports that belong to them by their cycle."""
    rows = np.flatnonzero(enters_react(run.state[:-1], run.state[1:])) + 1
    alarms = {report.cycle: report for report in reversed(run.reports) if not report.is_final}
    finals = {report.cycle: report for report in run.reports if report.is_final}
    time_s = run.time_s()
    detections = []
    for row in rows.tolist():
        cycle = int(run.cycle[row])
        final = finals.get(cycle)
        alarm = alarms.get(cycle, final)
        if alarm is None and run.contact_joints is not None and not run.contact_joints[row]:
            continue
        raised = Alarm(
            int(run.t_ns[row]),
            bool(run.state[row - 1] == SchemeState.MONITOR),
            run.truth is None or run.truth.covers(cycle),
        )
        detections.append(LoggedDetection(row, float(time_s[row]), raised, alarm, final))
    return tuple(detections)


class TruthTouch(NamedTuple):
    """A true contact: its number, its rows [first, last] of the truth, and times since motion start."""

    number: int
    first: int
    last: int
    link: int
    onset_s: float
    end_s: float


def true_contacts(run: Run) -> tuple[TruthTouch, ...]:
    """Find the true contacts in the truth record; without one there are none to be known."""
    truth = run.truth
    if truth is None or truth.cycle.size == 0 or run.cycle.size == 0:
        return ()
    time_s, last = run.truth_time_s(), truth.cycle.size - 1
    return tuple(
        TruthTouch(
            number, start, end - 1, int(truth.contact_link[start]), float(time_s[start]), float(time_s[min(end, last)])
        )
        for number, (start, end) in enumerate(contact_bounds(truth.contact_index, truth.attempt), run.first_contact)
    )


def detection_delay_s(tau_ext_Nm: float, threshold_Nm: float, a_rad_s: float) -> float | None:
    """Give the closed-form delay of a torque step, t = -ln(1 - h / |tau|) / a; None if it never crosses."""
    if not abs(tau_ext_Nm) > threshold_Nm:
        return None
    return -math.log1p(-threshold_Nm / abs(tau_ext_Nm)) / a_rad_s


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
class FilterChannel:
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


def channels_at(run: Run, time_s: float) -> tuple[FilterChannel, ...]:
    """Give what detects at a time: the paper's one filter, or the bank with its thresholds."""
    if run.certified is None:
        return (FilterChannel(run.a_rad_s, None, threshold_at(run, time_s)),)
    thresholds = run.certified.threshold[row_at(run, time_s)]
    return tuple(
        FilterChannel(cutoff, smoothing, threshold)
        for (cutoff, smoothing), threshold in zip(channels_of(run.settings), thresholds, strict=True)
    )


def ideal_response(run: Run, touch: TruthTouch, channel: FilterChannel) -> Vector:
    """Filter a contact's true torque by a channel, from its first row to the one after its last (k, 2)."""
    truth = run.truth
    assert truth is not None
    rows = slice(touch.first, touch.last + 2)
    return channel.respond(truth.tau_ext[rows], truth.cycle[rows], run.settings.bus.period_s)


def touch_window(run: Run, touch: TruthTouch, a_rad_s: float, threshold: Vector, armed: Mask) -> TouchWindow:
    """Give a contact as it is judged; armed (n,): the cycles of the run in which detection is armed."""
    truth = run.truth
    assert truth is not None
    rows = slice(touch.first, touch.last + 2)
    after_s = forgotten_after_s(truth.tau_ext[rows], truth.cycle[rows], run.settings.bus.period_s, a_rad_s, threshold)
    row = row_at(run, touch.onset_s)
    onset_ns, forgotten_ns = (run.zero_ns + round(at_s * 1e9) for at_s in (touch.onset_s, touch.end_s + after_s))
    is_armed = bool(row > 0 and armed[row - 1])
    return TouchWindow(touch.number, touch.link, onset_ns, forgotten_ns, is_armed)


def judge_run(run: Run, touches: Sequence[TruthTouch], detections: Sequence[LoggedDetection]) -> Score:
    """Judge the alarms of a run's own scheme."""
    armed = run.state == SchemeState.MONITOR
    windows = [touch_window(run, touch, run.a_rad_s, threshold_at(run, touch.onset_s), armed) for touch in touches]
    return judge(windows, [detection.raised for detection in detections])
