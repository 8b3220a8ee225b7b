"""What the paper's scheme made of the same stream, where it ran beside the certified one.

It adapts when that one does, ends by eq. (15) and compares with its own thresholds, but decides nothing: a contact that
is reacted to has been found by the other. So its residual is judged as a stream (`judge.StreamJudge`), with a pause
of 10 time constants; a false alarm counts until the user asks to finish. While the payload is changed it does not
detect.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adacd_hil.analysis.logged_run import Mask, Run
from adacd_hil.analysis.score.judge import StreamJudge
from adacd_hil.analysis.score.touches import Touch, touch_window
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
        assert run.beside is not None
        a = run.settings.filter.a_rad_s
        threshold = np.array(run.settings.detector.threshold_Nm)
        time_s = run.time_s()
        armed = run.beside.is_armed & ~_parked(time_s, sections, float(time_s[-1]) if time_s.size else 0.0)
        windows = [touch_window(run, touch, a, threshold, armed) for touch in touches]
        self._judge = StreamJudge(windows, round(SETTLING_TIME_CONSTANTS / a * 1e9))
        self._zero_ns, self._has_truth = run.zero_ns, run.truth is not None
        self._sections = sections
        self._finish_cycle = run.finish_cycle
        self._span = None if run.truth is None else run.truth.span
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

    def add(self, piece: Run, time_s: Vector, free: Mask) -> None:
        """Take in the next cycles, at such times (n,); free: those in which nothing touches the arm (n,)."""
        stream = piece.beside
        assert stream is not None
        armed = stream.is_armed & ~_parked(time_s, self._sections, self._end_s)
        over = armed & (np.abs(stream.tau_ext_hat) > stream.threshold).any(axis=1)
        is_judged = np.ones(over.size, np.bool_) if self._span is None else self._span.covers(piece.cycle)
        if self._finish_cycle is not None:
            is_judged &= piece.cycle < self._finish_cycle
        self._judge.add(piece.t_ns, over, is_judged)
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

    def beside(self) -> Beside:
        """Sum up what has been taken in."""
        score = self._judge.score()
        zero_ns = self._zero_ns
        false_s = tuple((alarm.t_ns - zero_ns) * 1e-9 for alarm in score.false_alarms)
        return Beside(
            adaptation_s=self._adaptation_s,
            frozen_residual_max_Nm={
                label: None if values is None else (float(values[0]), float(values[1]))
                for label, values in self._largest.items()
            },
            contacts=tuple(
                BesideContact(
                    contact.number,
                    contact.is_armed,
                    None if contact.detected_ns is None else (contact.detected_ns - zero_ns) * 1e-9,
                    contact.delay_ms,
                )
                for contact in score.contacts
            ),
            false_alarms=len(false_s) if self._has_truth else None,
            false_alarms_s=false_s if self._has_truth else None,
            missed=score.missed if self._has_truth else None,
        )


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
