"""Where a run can be cut: not within a contact, a reaction or an adaptation: a stretch has them whole or not at all."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from adacd_hil.analysis.logged_run import Run
from adacd_hil.analysis.report.outline import BUSY
from adacd_hil.analysis.score.paper_beside import SETTLING_TIME_CONSTANTS
from adacd_hil.analysis.score.touches import true_contacts

MARGIN_S: Final = 0.2
"""Before what a stretch would cut."""


def settling_s(run: Run) -> float:
    """Give after how long a contact or a reaction is forgotten."""
    return SETTLING_TIME_CONSTANTS / run.a_rad_s


def widen(run: Run, start_s: float, end_s: float) -> tuple[float, float]:
    """Give the smallest stretch of a run, s since motion start, that holds another one and cuts nothing.

    run: has the cycles in which something begins or ends.
    """
    if run.cycle.size == 0:
        return start_s, end_s
    busy = sorted(_busy(run))
    for first_s, last_s in reversed(busy):
        if first_s < start_s < last_s:
            start_s = first_s
    for first_s, last_s in busy:
        if first_s < end_s < last_s:
            end_s = last_s
    return start_s, end_s


def _busy(run: Run) -> Iterator[tuple[float, float]]:
    """Give when something is going on, s."""
    time_s, later_s = run.time_s(), settling_s(run)
    is_busy = np.concatenate(([False], np.isin(run.state, BUSY), [False]))
    edges = np.flatnonzero(is_busy[1:] != is_busy[:-1])
    for first, end in edges.reshape(-1, 2).tolist():
        yield float(time_s[first]) - MARGIN_S, float(time_s[min(end, len(time_s) - 1)]) + later_s
    for touch in true_contacts(run):
        yield touch.onset_s - MARGIN_S, touch.end_s + later_s
