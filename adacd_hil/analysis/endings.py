"""What stopped a run, by its log: its faults, and what kept it from running at all, with the logged causes."""

from typing import NamedTuple

import numpy as np

from adacd_hil.analysis.logged_run import Run
from adacd_hil.records import FaultReason, SchemeState
from adacd_hil.terminal import one_line

_RUN = "run"
"""Who says in /events what ended an attempt without a fault: no boot-up, a bus that failed."""
_SUPERVISOR = "supervisor"
_NEAR_NS = 2_000_000
"""How far the event of a fault may lie from its cycle's time."""
_MOST_LETTERS = 300


class Fault(NamedTuple):
    """A stay in FAULT. cause: the log's words for it, "" without any; is_last: the run ended in it."""

    reason: str
    at_s: float
    cause: str
    is_last: bool


def find_faults(run: Run) -> tuple[Fault, ...]:
    """List the faults of a run; it has the cycles in which the state changes."""
    is_fault = run.state == SchemeState.FAULT
    before = np.concatenate(([False], is_fault[:-1]))
    time_s = run.time_s()
    faults = []
    for row in np.flatnonzero(is_fault & ~before).tolist():
        is_last = bool(is_fault[row:].all())
        faults.append(
            Fault(FaultReason(int(run.fault[row])).name, float(time_s[row]), _cause(run, int(run.t_ns[row])), is_last)
        )
    return tuple(faults)


def _cause(run: Run, t_ns: int) -> str:
    """Find what the supervisor said of a fault, without state and reason, which are known."""
    for logged in run.events:
        event = logged.event
        if event.name == _SUPERVISOR and event.level == "error" and abs(logged.t_ns - t_ns) <= _NEAR_NS:
            return _shortened(event.message.partition("; ")[2])
    return ""


def find_causes(run: Run) -> tuple[str, ...]:
    """List what ended attempts, or the log, without a fault, each once."""
    said = [
        logged.event.message for logged in run.events if logged.event.name == _RUN and logged.event.level == "error"
    ]
    if run.broken_off:
        said.append(run.broken_off)
    return tuple(dict.fromkeys(map(_shortened, said)))


def _shortened(text: str) -> str:
    line = one_line(text)
    return line if len(line) <= _MOST_LETTERS else f"{line[:_MOST_LETTERS]} …"
