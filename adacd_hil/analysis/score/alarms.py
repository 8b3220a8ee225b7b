"""Detections of a run, and the true contacts that explain them.

A *detection* is a transition to REACT by a contact, in whatever state. It belongs to a true contact if it falls between
the onset and one time constant after the true torque, filtered, is back within the threshold; else it is a false alarm.
"""

from typing import NamedTuple

import numpy as np

from adacd_hil.analysis.run import Run
from adacd_hil.analysis.score.touches import Touch, forgotten_s, threshold_at
from adacd_hil.analysis.sections import is_interrupted
from adacd_hil.records import ContactReport, SchemeState


class Detection(NamedTuple):
    """A transition to REACT: its row of the run, its time, and the report at the alarm and at the end of the window."""

    row: int
    detected_s: float
    alarm: ContactReport | None
    final: ContactReport | None


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
    """Give for each detection the index of the true contact that explains it, the last of several, or None."""
    starts_s = np.array([touch.onset_s for touch in touches])
    ends_s = np.array([forgotten_s(run, touch, run.a_rad_s, threshold_at(run, touch.onset_s)) for touch in touches])
    owners = []
    for detection in detections:
        fitting = np.flatnonzero((starts_s <= detection.detected_s) & (detection.detected_s <= ends_s))
        owners.append(int(fitting[-1]) if fitting.size else None)
    return tuple(owners)
