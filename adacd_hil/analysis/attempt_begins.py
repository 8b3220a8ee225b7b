"""Where the attempts of a run begin, by the states in its log."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adacd_hil.analysis.timing import Cycles
from adacd_hil.records import SchemeState

_BEGINNING: Final = (SchemeState.INIT, SchemeState.COMMISSION)


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
