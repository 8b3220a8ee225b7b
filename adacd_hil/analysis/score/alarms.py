"""Alarms of a scheme, from the arrays of a run or from decisions as they come, and of a stream that decides nothing.

A scheme raises an alarm with a transition to REACT by a contact, in whatever state: the certified scheme detects while
it adapts and while it parks, too. While it is in REACT or STOPPED it is still about the contact before. REACT without a
joint over its threshold and without a report is an arm that is held for another reason, and no alarm.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.analysis.logged_run import Mask, Run
from adacd_hil.analysis.sections import is_interrupted
from adacd_hil.records import ContactReport, SchemeState


class Alarm(NamedTuple):
    """An alarm. is_armed: raised by armed detection, which is in MONITOR; is_known: the truth covers that time."""

    t_ns: int
    is_armed: bool
    is_known: bool = True


def enters_react(previous: NDArray[np.uint8], state: NDArray[np.uint8]) -> Mask:
    """Mark the cycles (n,) that begin to react, from the states before them and their own."""
    return np.asarray((state == SchemeState.REACT) & ~is_interrupted(previous))


def begins_of(at: NDArray[Any], pause: float, last: float | None = None) -> Mask:
    """Mark of samples over a threshold, at ascending times (n,), those that begin an alarm: after more than a pause.

    last: the sample before them, of which they may go on; None: there was none.
    """
    begins = np.diff(at, prepend=at[:1] if last is None else [last]) > pause
    if last is None:
        begins[:1] = True
    return np.asarray(begins)


class Detection(NamedTuple):
    """An alarm of a run: its row, its time, and the report at the alarm and at the end of the window."""

    row: int
    detected_s: float
    raised: Alarm
    alarm: ContactReport | None
    final: ContactReport | None


def find_detections(run: Run) -> tuple[Detection, ...]:
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
        detections.append(Detection(row, float(time_s[row]), raised, alarm, final))
    return tuple(detections)
