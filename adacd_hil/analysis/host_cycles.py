"""Where the attempts of a run begin, by the states in its log, and the emulator's cycles counted as the host does.

The emulator counts by the counter of SYNC, anew after each reset: in every attempt of a run it begins with the first
cycle's number less all whole rounds of the counter.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.analysis.timing import Cycles
from adacd_hil.device.arm import SYNC_OVERFLOW
from adacd_hil.records import SchemeState

_BEGINNING: Final = (SchemeState.INIT, SchemeState.COMMISSION)
_NEVER: Final = 1 << 62

EmulatorSpan = tuple[tuple[int, int], tuple[int, int]]
"""Attempt and cycle, as the emulator counts, of the first and the last one that it recorded."""


class AttemptBegins:
    """Finds them, piece by piece."""

    def __init__(self) -> None:
        self._begins: list[int] = []
        self._was_beginning: bool | None = None  # None before the first cycle

    def add(self, cycle: NDArray[Any], state: NDArray[np.uint8]) -> None:
        """Take in the next cycles (k,), k > 0."""
        is_beginning = np.isin(state, _BEGINNING)
        if self._was_beginning is None and not is_beginning[0]:
            self._begins.append(0)
        before = np.concatenate(([bool(self._was_beginning)], is_beginning[:-1]))
        self._begins += cycle[is_beginning & ~before].astype(np.int64).tolist()
        self._was_beginning = bool(is_beginning[-1])

    @property
    def begins(self) -> Cycles:
        """First cycle of each attempt so far; of one that began before the log, 0."""
        return np.array(self._begins or [0], np.int64)


class Span(NamedTuple):
    """The first and the last cycle of the host that the emulator recorded."""

    first: int
    last: int

    def covers(self, cycle: Cycles) -> NDArray[np.bool_]:
        """Mark those of some cycles (n,) that the emulator recorded."""
        return np.asarray((cycle >= self.first) & (cycle <= self.last))


def host_cycles(cycle: Cycles, attempt: Cycles, begins: Cycles) -> Cycles:
    """Turn the emulator's cycles (m,) of attempts (m,) into the host's; begins: first cycle of each attempt."""
    return np.asarray(cycle + whole_rounds(begins)[np.minimum(attempt, len(begins) - 1)])


def host_span(span: EmulatorSpan, begins: Cycles) -> Span:
    """Turn what the emulator recorded into the host's cycles; what goes on after the host's log has no last one."""
    attempts, cycles = (np.array(column) for column in zip(*span, strict=True))
    first, last = host_cycles(cycles, attempts, begins).tolist()
    return Span(first, last if attempts[1] < len(begins) else _NEVER)


def whole_rounds(begins: Cycles) -> Cycles:
    """Give what the emulator's cycles lack of the host's, in attempts that begin with such cycles (k,)."""
    return np.asarray(begins - begins % SYNC_OVERFLOW)
