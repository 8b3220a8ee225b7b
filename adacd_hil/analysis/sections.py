"""The lettered sections of a run.

*adaptation* lasts from ADAPT until MONITOR, the test of the frozen model (CERTIFY) included; *detection* from there to
the announcement of a payload change; *payload* is PAYLOAD, *fault* is FAULT. REACT and STOPPED belong to the section
that they interrupt. The paper's experiment gives A to E.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adacd_hil.analysis.logged_run import Mask, Run
from adacd_hil.records import SchemeState, Vector


@dataclass(frozen=True)
class Section:
    """One part of a run; `is_complete` is False if the run ended, or failed, in it."""

    label: str
    kind: str  # "adaptation", "detection", "payload", "fault"
    start_s: float
    end_s: float
    is_complete: bool

    @property
    def duration_s(self) -> float:
        """Length in s."""
        return self.end_s - self.start_s


_KINDS: Final = {
    SchemeState.ADAPT: "adaptation",
    SchemeState.CERTIFY: "adaptation",
    SchemeState.MONITOR: "detection",
    SchemeState.PAYLOAD: "payload",
    SchemeState.FAULT: "fault",
}


def section_label(index: int) -> str:
    """Name a section by its place: A to Z, then AA, AB and so on."""
    letter = chr(ord("A") + index % 26)
    return letter if index < 26 else section_label(index // 26 - 1) + letter


def origins(state: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Give for each cycle (n,) the state, where it is REACT or STOPPED the one that was interrupted."""
    rows = np.arange(state.size)
    own = np.maximum.accumulate(np.where(is_interrupted(state), -1, rows))
    return np.where(own < 0, np.uint8(SchemeState.MONITOR), state[np.maximum(own, 0)])


def is_interrupted(state: NDArray[np.uint8]) -> Mask:
    """Mark the cycles (n,) of REACT and STOPPED."""
    return np.isin(state, (SchemeState.REACT, SchemeState.STOPPED))


def split_sections(run: Run) -> tuple[Section, ...]:
    """Split a run into lettered sections; what comes before the first ADAPT belongs to none."""
    if run.state.size == 0:
        return ()
    kinds = np.array([_KINDS.get(SchemeState(value), "") for value in range(len(SchemeState))])[origins(run.state)]
    starts = np.concatenate(([0], np.flatnonzero(kinds[1:] != kinds[:-1]) + 1))
    time_s = run.time_s()
    sections: list[Section] = []
    for start, end in zip(starts, [*starts[1:], None], strict=True):
        kind = str(kinds[start])
        if not kind:
            continue
        end_s = float(time_s[-1] if end is None else time_s[end])
        following = "" if end is None else str(kinds[end])
        is_complete = following == "detection" if kind == "adaptation" else following not in ("", "fault")
        sections.append(Section(section_label(len(sections)), kind, float(time_s[start]), end_s, is_complete))
    return tuple(sections)


def section_at(sections: Iterable[Section], time_s: float) -> str | None:
    """Name the section that a time belongs to, None before the first."""
    return next((section.label for section in sections if section.start_s <= time_s <= section.end_s), None)


def rows_of(time_s: Vector, section: Section, end_s: float) -> slice:
    """Give the rows of a section among cycles at such times (n,), which ascend.

    end_s: when the run ends. Its last cycle belongs to the last section; the first one of the next section to that.
    """
    is_last = bool(section.end_s >= end_s)
    first = int(np.searchsorted(time_s, section.start_s))
    return slice(first, int(np.searchsorted(time_s, section.end_s, side="right" if is_last else "left")))
