"""What the paper's scheme made of the same stream, where it ran beside the certified one.

It adapts when that one does, ends by eq. (15) and compares with its own thresholds, but decides nothing: a contact that
is reacted to has been found by the other. So a *detection* of it is the first sample over its threshold, while it is
armed, that a true contact explains; a *false alarm* is one that none explains, counted once in 10 time constants. While
the payload is changed it does not detect.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adacd_hil.analysis.run import Mask, PaperStream, Run
from adacd_hil.analysis.score.touches import Touch, forgotten_s, row_at, true_contacts
from adacd_hil.analysis.sections import Section, rows_of
from adacd_hil.records import Vector

SETTLING_TIME_CONSTANTS = 10.0
"""Time constants of a filter after which a contact counts as forgotten; e^-10 of 5 Nm is 0.2 mNm."""


@dataclass(frozen=True)
class BesideContact:
    """A true contact as the paper's scheme would have seen it; number as in the list of contacts."""

    number: int
    is_armed: bool
    detected_s: float | None
    delay_ms: float | None


@dataclass(frozen=True)
class Beside:
    """What the paper's scheme would have come to, by the definitions of the module's first lines.

    Without the truth there are no contacts, and false alarms and misses are None.
    """

    adaptation_s: dict[str, float | None]
    frozen_residual_max_Nm: dict[str, tuple[float, float] | None]
    contacts: tuple[BesideContact, ...]
    false_alarms: int | None
    false_alarms_s: tuple[float, ...] | None
    missed: int | None


@dataclass(frozen=True)
class Reached:
    """What the paper's scheme reached over all cycles: see `Beside`; of each contact when it detected it, s."""

    adaptation_s: dict[str, float | None]
    frozen_residual_max_Nm: dict[str, tuple[float, float] | None]
    detected_s: tuple[float | None, ...]
    false_alarms_s: tuple[float, ...]


def evaluate_beside(run: Run, stream: PaperStream, sections: Sequence[Section], reached: Reached) -> Beside:
    """Judge the paper's scheme. reached: by all its cycles, see `untouched`."""
    time_s = run.time_s()
    armed = stream.is_armed & ~_parked(time_s, sections, float(time_s[-1]))
    contacts = [
        BesideContact(
            number=number,
            is_armed=bool(armed[max(row_at(run, touch.onset_s) - 1, 0)]),
            detected_s=detected_s,
            delay_ms=None if detected_s is None else (detected_s - touch.onset_s) * 1e3,
        )
        for number, (touch, detected_s) in enumerate(
            zip(true_contacts(run), reached.detected_s, strict=True), run.first_contact
        )
    ]
    has_truth = run.truth is not None
    return Beside(
        adaptation_s=reached.adaptation_s,
        frozen_residual_max_Nm=reached.frozen_residual_max_Nm,
        contacts=tuple(contacts),
        false_alarms=len(reached.false_alarms_s) if has_truth else None,
        false_alarms_s=reached.false_alarms_s if has_truth else None,
        missed=sum(contact.is_armed and contact.detected_s is None for contact in contacts) if has_truth else None,
    )


def larger(largest: Vector | None, values: Vector) -> Vector | None:
    """Give the larger of the sizes of `values` (k, …) and of what was the largest of each so far (…).

    None so far: none. NaN stays.
    """
    if values.shape[0] == 0:
        return largest
    found = np.abs(values).max(axis=0)
    return np.asarray(found if largest is None else np.maximum(largest, found))


class BesideGatherer:
    """Gathers what the paper's scheme reached, piece by piece."""

    def __init__(self, run: Run, sections: Sequence[Section], touches: Sequence[Touch]) -> None:
        a = run.settings.filter.a_rad_s
        threshold = np.array(run.settings.detector.threshold_Nm)
        self._sections = sections
        self._windows = [(touch.onset_s, forgotten_s(run, touch, a, threshold)) for touch in touches]
        self._finish_cycle = run.finish_cycle
        self._span = None if run.truth is None else run.truth.span
        self._pause_s = SETTLING_TIME_CONSTANTS / a
        self._end_s = float(run.time_s()[-1]) if run.cycle.size else 0.0
        self._adaptations = [
            (section.label, section.start_s, _left_s(section, sections))
            for section in sections
            if section.kind == "adaptation"
        ]
        self._adaptation_s: dict[str, float | None] = dict.fromkeys(label for label, _, _ in self._adaptations)
        self._largest: dict[str, Vector | None] = dict.fromkeys(
            section.label for section in sections if section.kind == "detection"
        )
        self._detected_s: list[float | None] = [None] * len(touches)
        self._false_s: list[float] = []
        self._last_s = -np.inf  # of what no contact explains

    def add(self, piece: Run, time_s: Vector, free: Mask) -> None:
        """Take in the next cycles, at such times (n,); free: those in which nothing touches the arm (n,)."""
        stream = piece.beside
        assert stream is not None
        armed = stream.is_armed & ~_parked(time_s, self._sections, self._end_s)
        over = armed & (np.abs(stream.tau_ext_hat) > stream.threshold).any(axis=1)
        unexplained = over if self._finish_cycle is None else over & (piece.cycle < self._finish_cycle)
        unexplained = unexplained.copy()
        if self._span is not None:  # of what the emulator didn't record nobody knows
            unexplained &= self._span.covers(piece.cycle)
        for number, (start_s, end_s) in enumerate(self._windows):
            if start_s > time_s[-1] or end_s < time_s[0]:
                continue
            explained = slice(np.searchsorted(time_s, start_s), np.searchsorted(time_s, end_s, side="right"))
            unexplained[explained] = False
            first = np.flatnonzero(over[explained])
            if first.size and self._detected_s[number] is None:
                self._detected_s[number] = float(time_s[explained][first[0]])
        self._add_false_alarms(time_s[unexplained])
        for label, start_s, left_s in self._adaptations:
            if self._adaptation_s[label] is None and start_s <= time_s[-1] and left_s >= time_s[0]:
                # In the first cycle of ADAPT it is still what it was before.
                rows = slice(np.searchsorted(time_s, start_s, "right"), np.searchsorted(time_s, left_s, "right"))
                first = np.flatnonzero(stream.is_armed[rows])
                if first.size:
                    self._adaptation_s[label] = float(time_s[rows][first[0]]) - start_s
        for section in self._sections:
            if section.label in self._largest and section.start_s <= time_s[-1] and section.end_s >= time_s[0]:
                rows = rows_of(time_s, section, self._end_s)
                values = stream.tau_ext_hat[rows][free[rows] & armed[rows]]
                self._largest[section.label] = larger(self._largest[section.label], values)

    def _add_false_alarms(self, times_s: Vector) -> None:
        """Take in when it was over its threshold and no contact explains it: each that comes after a pause counts."""
        if times_s.size:
            begins = np.diff(times_s, prepend=self._last_s) > self._pause_s
            self._false_s += times_s[begins].tolist()
            self._last_s = float(times_s[-1])

    def reached(self) -> Reached:
        """Sum up what has been taken in."""
        largest = {
            label: None if values is None else (float(values[0]), float(values[1]))
            for label, values in self._largest.items()
        }
        return Reached(self._adaptation_s, largest, tuple(self._detected_s), tuple(self._false_s))


def _left_s(adaptation: Section, sections: Sequence[Section]) -> float:
    """Give when an adaptation and the detection after it are left, s; infinite at the end of the run."""
    later = (section for section in sections if section.start_s > adaptation.start_s and section.kind != "detection")
    return next((section.start_s for section in later), np.inf)


def _parked(time_s: Vector, sections: Sequence[Section], end_s: float) -> Mask:
    """Mark the cycles at such times (n,) in which the payload is changed. end_s: when the run ends."""
    parked = np.zeros(time_s.size, dtype=np.bool_)
    for section in sections:
        if section.kind == "payload":
            parked[rows_of(time_s, section, end_s)] = True
    return parked
