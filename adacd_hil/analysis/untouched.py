"""What a run's cycles come to where nobody touches the arm: residuals, margins, and the paper's scheme beside.

Cycles are taken piece by piece, in order; a run in memory is one piece. A cycle is *free* unless it lies in
[onset, end + 10/a] of a true contact, or less than 10/a after a cycle in REACT: 10 time constants leave 0.2 mNm of
5 Nm. Without the truth, [detection - 10/a, detection + 10/a] stands for the contact; of what a truth doesn't cover
nobody knows whether it is free, so it isn't. After the request to finish the
arm parks and stands, where friction may hold any torque up to F_c: those cycles are not free.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from adacd_hil.analysis.logged_run import Mask, Run
from adacd_hil.analysis.margin_evidence import ChannelMargin, MarginGatherer
from adacd_hil.analysis.score.alarms import Detection, find_detections
from adacd_hil.analysis.score.paper_beside import SETTLING_TIME_CONSTANTS, Beside, BesideGatherer, larger
from adacd_hil.analysis.score.touches import Touch, true_contacts
from adacd_hil.analysis.sections import Section, rows_of, split_sections
from adacd_hil.analysis.smallest_push import PushGatherer, SmallestPush
from adacd_hil.records import SchemeState, Vector


@dataclass(frozen=True)
class Residual:
    """Largest |tau_ext_hat| of a section, Nm per joint, over `cycles` cycles free of contact; None if none."""

    identified: tuple[float, float] | None
    cad: tuple[float, float] | None
    cycles: int


@dataclass(frozen=True)
class Untouched:
    """What was gathered, by section. promotions: refined models that took over; beside: None where none ran.

    smallest_push: None of the paper's scheme, and where nothing was armed.
    """

    residuals: dict[str, Residual]
    margins: dict[str, tuple[ChannelMargin, ...]]
    promotions: int
    beside: Beside | None
    smallest_push: SmallestPush | None


def gather_untouched(run: Run, pieces: Iterable[Run]) -> Untouched:
    """Gather what the cycles of a run come to.

    run: has the cycles in which something begins or ends; pieces: together all of its cycles, in order.
    """
    gatherer = UntouchedGatherer(run)
    for piece in pieces:
        gatherer.add(piece)
    return gatherer.gathered()


class UntouchedGatherer:
    """Gathers pieces of a run, whose contacts, detections and sections are known."""

    def __init__(self, run: Run) -> None:
        """Take from `run` when something begins or ends."""
        self._sections = split_sections(run)
        touches = true_contacts(run)
        self._free = _Free(run, touches, find_detections(run))
        self._end_s = float(run.time_s()[-1]) if run.cycle.size else 0.0
        self._residuals: dict[str, _Largest] = {}
        self._margins: dict[str, MarginGatherer] = {}
        self._done: dict[str, tuple[ChannelMargin, ...]] = {}
        self._push = PushGatherer(run.settings)
        self._promotions = 0
        self._promoted = 0.0  # the count so far
        self._beside = None if run.beside is None else BesideGatherer(run, self._sections, touches)

    def add(self, piece: Run) -> None:
        """Take in the next cycles."""
        if piece.cycle.size == 0:
            return
        time_s = piece.time_s()
        free = self._free.mask(piece, time_s)
        for section in self._sections:
            if section.start_s > time_s[-1]:
                break
            if section.end_s < time_s[0] or section.kind not in ("adaptation", "detection"):
                continue
            rows = rows_of(time_s, section, self._end_s)
            self._add_residual(piece, section, rows, free[rows])
            if piece.certified is not None:
                self._add_margin(piece, section, rows, free[rows])
            if section.end_s <= time_s[-1]:
                self._close(section.label)
        if piece.certified is not None:
            self._count_promotions(piece.certified.promotions)
        if self._beside is not None:
            self._beside.add(piece, time_s, free)

    def _add_residual(self, piece: Run, section: Section, rows: slice, free: Mask) -> None:
        is_frozen = section.kind == "detection"
        if is_frozen:
            free = free & (piece.state[rows] == SchemeState.MONITOR)
        largest = self._residuals.setdefault(section.label, _Largest())
        largest.cycles += int(free.sum())
        if is_frozen:
            largest.identified = larger(largest.identified, piece.tau_ext_hat[rows][free])
        if piece.has_cad:
            largest.cad = larger(largest.cad, piece.tau_ext_hat_cad[rows][free])

    def _add_margin(self, piece: Run, section: Section, rows: slice, free: Mask) -> None:
        assert piece.certified is not None
        threshold = piece.certified.threshold[rows]
        chosen = free & np.isfinite(threshold).all(axis=(1, 2))
        if chosen.any():
            margin = self._margins.setdefault(section.label, MarginGatherer(piece.settings))
            margin.add(piece.certified.tau_ext[rows][chosen], threshold[chosen])
        armed = chosen & (piece.state[rows] == SchemeState.MONITOR)
        if armed.any():
            self._push.add(piece.certified.tau_ext[rows][armed], threshold[armed])

    def _close(self, label: str) -> None:
        """Sum up a section that nothing will be added to: its values need not be kept."""
        if label in self._margins:
            self._done[label] = self._margins.pop(label).margins()

    def _count_promotions(self, promotions: Vector) -> None:
        steps = np.diff(promotions, prepend=self._promoted)
        self._promotions += int(np.maximum(steps, 0.0).sum())
        self._promoted = float(promotions[-1])

    def gathered(self) -> Untouched:
        """Sum up what has been taken in."""
        for label in list(self._margins):
            self._close(label)
        labels = [section.label for section in self._sections]
        residuals = {label: self._residuals[label].residual() for label in labels if label in self._residuals}
        margins = {label: self._done[label] for label in labels if label in self._done}
        beside = None if self._beside is None else self._beside.beside()
        return Untouched(residuals, margins, self._promotions, beside, self._push.smallest_push())


class _Largest:
    """Of a section: the largest residuals so far, over how many cycles."""

    def __init__(self) -> None:
        self.identified: Vector | None = None
        self.cad: Vector | None = None
        self.cycles = 0

    def residual(self) -> Residual:
        return Residual(_pair(self.identified), _pair(self.cad), self.cycles)


def _pair(values: Vector | None) -> tuple[float, float] | None:
    return None if values is None else (float(values[0]), float(values[1]))


class _Free:
    """Tells which cycles are free of contact, piece by piece."""

    def __init__(self, run: Run, touches: Sequence[Touch], detections: Sequence[Detection]) -> None:
        self._settling_s = SETTLING_TIME_CONSTANTS / run.a_rad_s
        if run.truth is None:
            around = [(d.detected_s - self._settling_s, d.detected_s + self._settling_s) for d in detections]
        else:
            around = [(touch.onset_s, touch.end_s + self._settling_s) for touch in touches]
        self._windows = np.array(around).reshape(-1, 2)
        self._span = None if run.truth is None else run.truth.span
        self._finish_cycle = run.finish_cycle
        self._last_react_s = -np.inf

    def mask(self, piece: Run, time_s: Vector) -> Mask:
        """Mark the cycles (n,) of a piece, at such times (n,)."""
        finish = self._finish_cycle
        free = np.ones(time_s.size, dtype=np.bool_) if finish is None else piece.cycle < finish
        if self._span is not None:
            free &= self._span.covers(piece.cycle)
        is_here = (self._windows[:, 0] <= time_s[-1]) & (self._windows[:, 1] >= time_s[0])
        for start_s, end_s in self._windows[is_here].tolist():
            free[np.searchsorted(time_s, start_s) : np.searchsorted(time_s, end_s, side="right")] = False
        reacted_s = np.where(piece.state == SchemeState.REACT, time_s, -np.inf)
        reacted_s[0] = max(reacted_s[0], self._last_react_s)
        last_react_s = np.maximum.accumulate(reacted_s)
        self._last_react_s = float(last_react_s[-1])
        return np.asarray(free & (time_s - last_react_s > self._settling_s))
