"""The alarms and the true contacts of a whole run, and the response of an ideal detector with its filters.

Shapes and units as in `adacd_hil.lab.score.run_arrays`.
"""

import math
from bisect import bisect_left
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from adacd_hil.lab.score.run_arrays import Run
from adacd_hil.log.logged_run import Cycles, Mask, begins_alarm, is_armed_in, last_armed
from adacd_hil.records import SchemeState, Vector
from adacd_hil.scheme.model.filter_bank import channels_of, step_response
from adacd_hil.score.emulator_truth import HostCycles, placed_contact, threshold_in_force
from adacd_hil.score.judge import Detection, TrueContact, filtered, is_about_weight, true_contacts


def find_detections(run: Run) -> tuple[Detection, ...]:
    """Return the alarms of a run, the earliest first, each with the first and last report of its cycle, or None."""
    alarms = {report.cycle: report for report in reversed(run.reports) if not report.is_final}
    finals = {report.cycle: report for report in run.reports if report.is_final}
    detections = []
    is_reported = np.isin(run.cycle, [*alarms, *finals])
    begins = begins_alarm(run.state[:-1], run.state[1:], run.contact_joints[1:] != 0, is_reported[1:])
    armed = last_armed(run.cycle, run.state)
    for row in (np.flatnonzero(begins) + 1).tolist():
        cycle = int(run.cycle[row])
        final = finals.get(cycle)
        first = alarms.get(cycle, final)
        is_armed = bool(is_armed_in(run.state[row - 1]))
        is_known = run.truth is None or run.truth.covers(cycle)
        before = int(run.state[row - 1]), int(armed[row])
        is_weight = run.truth is not None and is_about_weight(run.truth, run.settings, cycle, *before)
        detections.append(Detection(int(run.t_ns[row]), is_armed, is_known, row, first, final or first, is_weight))
    return tuple(detections)


def uncovered_watch(run: Run) -> Mask:
    """Return for each cycle (n,) whether it is in MONITOR and not covered by the truth.

    All False without a truth.
    """
    watched = is_armed_in(run.state)
    if run.truth is None:
        return np.zeros_like(watched)
    return np.asarray(watched & ~run.truth.span.covers(run.cycle))


def timed_contacts(run: Run) -> tuple[TrueContact, ...]:
    """Return the true contacts of a run, with the times of their rows; () without the truth."""
    return true_contacts(run.truth, run.first_contact)


def contacts_of(run: Run) -> tuple[TrueContact, ...]:
    """Return the true contacts of a run, with the times in which they explain alarms of its own scheme."""
    return placed_in(run, timed_contacts(run), run.state, run.threshold, run.settings.cutoff_rad_s)


def placed_in(
    run: Run, contacts: Iterable[TrueContact], state: NDArray[np.uint8], threshold: Vector, a_rad_s: float
) -> tuple[TrueContact, ...]:
    """Return timed contacts with the times, on the run's clock, in which they explain alarms of a scheme.

    state (n,), threshold (n, 2), a_rad_s: of that scheme, in the run's cycles; a_rad_s: cut-off of its slowest filter.
    """
    host = HostCycles(run.cycle, run.t_ns, np.concatenate(([SchemeState.INIT], state[:-1])), threshold)
    placed = []
    for contact in contacts:
        onset_ns, end_ns = (run.zero_ns + round(float(at_s) * 1e9) for at_s in contact.time_s[[0, -1]])
        row = row_at(run, float(contact.time_s[0]))
        placed.append(placed_contact(contact, (onset_ns, end_ns), host, row, run.settings, a_rad_s))
    return tuple(placed)


def step_delay_s(tau_ext: Vector, threshold: Vector, a_rad_s: float, b_rad_s: float | None) -> float | None:
    """Return after how long a torque step, Nm (2,), crosses the threshold, Nm (2,), at the faster joint, s.

    None if never. a_rad_s: cut-off of a first-order low-pass; b_rad_s: of a second one behind it, None without it: then
    t = -ln(1 - h / |tau|) / a. The response rises steadily, so that there is one crossing.
    """
    pairs = zip(np.abs(tau_ext).tolist(), threshold.tolist(), strict=True)
    shares = [h / tau for tau, h in pairs if tau > h]
    if b_rad_s is None:
        return min((-math.log1p(-share) / a_rad_s for share in shares), default=None)
    longest_s = 40.0 / min(a_rad_s, b_rad_s)
    found = (
        brentq(lambda t_s, share: step_response(t_s, a_rad_s, b_rad_s) - share, 0.0, longest_s, (share,))
        for share in shares
    )
    return min(map(float, found), default=None)


def ideal_response(tau_ext: Vector, cycle: Cycles, period_s: float, a_rad_s: float, b_rad_s: float | None) -> Vector:
    """Return a true torque, Nm (n, 2), behind one low-pass or, unless `b_rad_s` is None, two; from rest.

    Each sample is held until the next one. cycle (n,): numbers of their cycles.
    """
    response = filtered(tau_ext, cycle, period_s, a_rad_s)
    return response if b_rad_s is None else filtered(response, cycle, period_s, b_rad_s)


def row_at(run: Run, time_s: float) -> int:
    """Return the row of the first cycle at `time_s`, s since motion start, or after it.

    The last row if there is none; -1 for a run without cycles.
    """
    t_ns, zero_ns = run.t_ns, run.zero_ns
    row = bisect_left(range(len(t_ns)), time_s, key=lambda row: float((t_ns[row] - zero_ns) * 1e-9))
    return min(row, len(t_ns) - 1)


def channels_at(run: Run, time_s: float) -> list[tuple[float, float | None, Vector]]:
    """Return the filters that detect at `time_s`, s since motion start: the paper's, or the bank.

    Of each its cut-off and, unless it is None, that of a second one behind it, rad/s, and its threshold, Nm (2,).
    """
    row = row_at(run, time_s)
    if run.certified is None:
        return [(run.settings.cutoff_rad_s, None, threshold_in_force(run.threshold[row], run.settings))]
    thresholds = run.certified.threshold[row]
    return [(*cutoffs, threshold) for cutoffs, threshold in zip(channels_of(run.settings), thresholds, strict=True)]
