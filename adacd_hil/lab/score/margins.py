"""Sums over a run's cycles free of contact: residuals, margins, and the paper's scheme beside.

Cycles come piece by piece, in order, each with an outline: a run that has all that happened so far, and a second or
more beyond the piece. A run in memory is one piece, and its own outline. A cycle is *free* unless it lies in
[onset, end + 10/a] of a true contact, or less than 10/a after a cycle in REACT: 10 time constants leave 0.2 mNm of
5 Nm. Without the truth, [detection - 10/a, detection + 10/a] stands for the contact. Cycles that the truth does not
cover are not free. After the request to finish the arm parks and stands, where friction may hold any torque up to F_c:
those cycles are not free.

*Margin* of a channel of the certified scheme: the smallest threshold / |residual| of any free cycle; below 1 it would
have been a false alarm. Per section, adaptations included, since detection is on there too.

**The paper's scheme beside** the certified one adapts when that one does, ends by eq. (15) and compares with its own
thresholds, but raises no alarm: the other scheme has found every contact with a reaction. So its residual is judged as
a stream (`judge.StreamJudge`), with a pause of 10 time constants; a false alarm counts until the user asks to finish.
While the payload is changed it does not detect.
"""

from collections.abc import Sequence

import numpy as np

from adacd_hil.lab.score.metrics import (
    Beside,
    BesideDetection,
    CertifiedEvidence,
    ChannelMargin,
    ParameterEstimate,
    Residual,
    certificates_in,
)
from adacd_hil.lab.score.run_arrays import CertifiedStream, Run, Section, rows_of, split_sections, stays_of
from adacd_hil.lab.score.run_judge import find_detections, placed_in, timed_contacts
from adacd_hil.log.logged_run import Mask, is_armed_in
from adacd_hil.records import JOINTS, SchemeState, Vector
from adacd_hil.scheme.model.filter_bank import channels_of
from adacd_hil.score.distribution import Distribution
from adacd_hil.score.judge import StreamJudge, TrueContact
from adacd_hil.score.smallest_push import PushGatherer
from adacd_hil.settings.configuration import Settings

SETTLING_TIME_CONSTANTS = 10.0
"""Time constants of a filter after which a contact counts as forgotten; e^-10 of 5 Nm is 0.2 mNm."""


def larger(largest: Vector | None, values: Vector) -> Vector | None:
    """Return, element by element, the larger of `largest` (…) and of all |values| (k, …); NaN stays.

    largest: of the values so far; None before the first. Without values it is returned as it is.
    """
    if values.shape[0] == 0:
        return largest
    found = np.abs(values).max(axis=0)
    return np.asarray(found if largest is None else np.maximum(largest, found))


class BesideGatherer:
    """Gathers the results of the paper's scheme that ran beside, piece by piece."""

    def __init__(self, settings: Settings) -> None:
        self._a_rad_s = settings.filter.a_rad_s
        self._judge = StreamJudge(round(SETTLING_TIME_CONSTANTS / self._a_rad_s * 1e9))
        self._adaptation_s: dict[str, float] = {}
        self._largest: dict[str, Vector | None] = {}

    def add_stream(self, piece: Run, outline: Run, sections: Sequence[Section], free: Mask) -> None:
        """Add the paper's scheme's results in the next cycles (n,) of a run; call it in the order of time.

        piece: these cycles. outline: the run, with all that has happened so far. free (n,): whether a cycle is free of
        contact.
        """
        stream, time_s, end_s = piece.beside, piece.time_s(), float(outline.time_s()[-1])
        assert stream is not None
        armed = stream.is_armed & ~_parked(time_s, sections, end_s)
        over = armed & (np.abs(stream.tau_ext_hat) > stream.threshold).any(axis=1)
        is_judged = np.ones(over.size, np.bool_) if outline.truth is None else outline.truth.span.covers(piece.cycle)
        if outline.finish_cycle is not None:
            is_judged &= piece.cycle < outline.finish_cycle
        since_s = float(time_s[0]) - SETTLING_TIME_CONSTANTS / self._a_rad_s
        self._judge.add_samples(self._contacts(outline, sections, since_s), piece.t_ns, over, is_judged)
        for section in sections:
            if section.start_s > time_s[-1]:
                break
            if section.kind == "adaptation" and section.label not in self._adaptation_s:
                # In the first cycle of ADAPT it still has its value of before.
                left_s = _left_s(section, sections)
                rows = slice(
                    np.searchsorted(time_s, section.start_s, "right"), np.searchsorted(time_s, left_s, "right")
                )
                first = np.flatnonzero(stream.is_armed[rows])
                if first.size:
                    self._adaptation_s[section.label] = float(time_s[rows][first[0]]) - section.start_s
            if section.kind == "detection" and section.end_s >= time_s[0]:
                rows = rows_of(time_s, section, end_s)
                values = stream.tau_ext_hat[rows][free[rows] & armed[rows]]
                self._largest[section.label] = larger(self._largest.get(section.label), values)

    def _contacts(self, run: Run, sections: Sequence[Section], since_s: float = -np.inf) -> Sequence[TrueContact]:
        """Return the true contacts that end at `since_s` or later, for judging the paper's scheme.

        Each has the times in which it explains that scheme's alarms. since_s: s since motion start.
        """
        assert run.beside is not None
        time_s = run.time_s()
        armed = run.beside.is_armed & ~_parked(time_s, sections, float(time_s[-1]) if time_s.size else 0.0)
        state = np.where(armed, np.uint8(SchemeState.MONITOR), np.uint8(SchemeState.ADAPT))
        threshold = np.full((len(time_s), JOINTS), np.nan)  # the configured one
        contacts = (each for each in timed_contacts(run) if each.time_s[-1] >= since_s)
        return placed_in(run, contacts, state, threshold, self._a_rad_s)

    def beside(self, run: Run, sections: Sequence[Section]) -> Beside:
        """Return the results of the paper's scheme in the cycles added; run: the whole run."""
        score = self._judge.score(self._contacts(run, sections))
        has_truth = run.truth is not None
        false_s = tuple((alarm.t_ns - run.zero_ns) * 1e-9 for alarm in score.false_alarms)
        learnt, watched = ([each.label for each in sections if each.kind == kind] for kind in _LEARNT_OR_WATCHED)
        return Beside(
            adaptation_s={label: self._adaptation_s.get(label) for label in learnt},
            frozen_residual_max_Nm={label: _pair(self._largest.get(label)) for label in watched},
            contacts=tuple(
                BesideDetection(
                    contact.number,
                    contact.is_armed,
                    None if contact.detected_ns is None else (contact.detected_ns - run.zero_ns) * 1e-9,
                    contact.delay_ms,
                )
                for contact in score.contacts
            ),
            false_alarms=len(false_s) if has_truth else None,
            false_alarms_s=false_s if has_truth else None,
            missed=score.missed if has_truth else None,
        )


_LEARNT_OR_WATCHED = ("adaptation", "detection")


def _left_s(adaptation: Section, sections: Sequence[Section]) -> float:
    """Return when an adaptation and the detection after it end, s since motion start; inf if the run ends in them."""
    later = (section for section in sections if section.start_s > adaptation.start_s and section.kind != "detection")
    return next((section.start_s for section in later), np.inf)


def _parked(time_s: Vector, sections: Sequence[Section], end_s: float) -> Mask:
    """Return for each cycle at the times `time_s` (n,) whether it is in a payload section.

    end_s: when the run ends, s since motion start.
    """
    parked = np.zeros(time_s.size, dtype=np.bool_)
    for section in sections:
        if section.kind == "payload":
            parked[rows_of(time_s, section, end_s)] = True
    return parked


def last_row(run: Run, section: Section) -> int:
    """Return the row in which an adaptation's result stands: the next section's first cycle, which still learns.

    If the run ended or failed in the adaptation, it is the adaptation's own last cycle.
    """
    time_s = run.time_s()
    end = int(rows_of(time_s, section, float(time_s[-1])).stop)
    return end - 1 + int(section.is_complete)


def _estimates(run: Run, stream: CertifiedStream, section: Section) -> dict[str, ParameterEstimate]:
    """Return the parameters at the end of an adaptation with their deviations, by name.

    They include those beyond the paper's model.
    """
    row = last_row(run, section)
    values = np.concatenate((run.theta_hat[row], stream.theta_further[row]))
    names = run.parameter_names + run.settings.further_names
    return {
        name: ParameterEstimate(float(value), float(std))
        for name, value, std in zip(names, values, stream.theta_std[row], strict=True)
    }


class MarginGatherer:
    """Gathers the margins of one section, piece by piece."""

    def __init__(self, settings: Settings) -> None:
        self._channels = channels_of(settings)
        self._residual: Vector | None = None  # largest (channels, 2)
        self._share: Vector | None = None  # largest residual / threshold (channels, 2)
        self._thresholds = [[Distribution() for _ in range(JOINTS)] for _ in self._channels]

    def add_residuals(self, tau_ext: Vector, threshold: Vector) -> None:
        """Add residuals and thresholds, Nm (k, channels, 2), k > 0, of cycles free of contact."""
        self._residual = larger(self._residual, tau_ext)
        self._share = larger(self._share, np.abs(tau_ext) / threshold)
        for place, distributions in enumerate(self._thresholds):
            for joint, distribution in enumerate(distributions):
                distribution.add_values(threshold[:, place, joint])

    def margins(self) -> tuple[ChannelMargin, ...]:
        """Return the margins of each channel over all cycles added so far; () before the first."""
        if self._residual is None or self._share is None:
            return ()
        return tuple(
            ChannelMargin(
                cutoff_rad_s=cutoff,
                smoothing_rad_s=smoothing,
                residual_max_Nm=self._residual[place].tolist(),
                threshold_Nm=[distribution.median() for distribution in self._thresholds[place]],
                margin=[1.0 / share if share > 0.0 else np.inf for share in self._share[place].tolist()],
            )
            for place, (cutoff, smoothing) in enumerate(self._channels)
        )


class UntouchedGatherer:
    """Gathers residuals, margins and pushes over a run's cycles free of contact, and the paper's scheme beside."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._last_react_ns: int | None = None
        self._residuals: dict[str, Residual] = {}
        self._margins: dict[str, MarginGatherer] = {}
        self._done: dict[str, tuple[ChannelMargin, ...]] = {}
        self.push = PushGatherer(settings)
        self.promotions = 0
        """Refined models that took over."""
        self._promoted = 0.0  # the count so far
        self._beside: BesideGatherer | None = None

    def add_untouched(self, piece: Run, outline: Run) -> None:
        """Add the next piece of a run: of its cycles free of contact the residuals, margins and pushes, by section.

        Only sections of the kinds adaptation and detection count, and pushes only in MONITOR. Call it in the order of
        time. outline: the run, with all that has happened so far, and a second or more beyond the piece. Promotions and
        the paper's scheme beside are gathered from all cycles.
        """
        if piece.cycle.size == 0:
            return
        time_s, end_s = piece.time_s(), float(outline.time_s()[-1])
        free = self._free(piece, outline)
        sections = split_sections(outline)
        for section in sections:
            if section.start_s > time_s[-1]:
                break
            if section.end_s < time_s[0] or section.kind not in _LEARNT_OR_WATCHED:
                continue
            rows = rows_of(time_s, section, end_s)
            self._add_residual(piece, section, rows, free[rows])
            if piece.certified is not None:
                self._add_margin(piece, section, rows, free[rows])
            if section.end_s <= time_s[-1]:
                self._close(section.label)
        if piece.certified is not None:
            self._count_promotions(piece.certified.promotions)
        if piece.beside is not None:
            self._beside = self._beside or BesideGatherer(self._settings)
            self._beside.add_stream(piece, outline, sections, free)

    def _free(self, piece: Run, outline: Run) -> Mask:
        """Return for each cycle (n,) of a piece whether it is free of contact and, with a truth, covered by it.

        Cycles in a true contact, in REACT, or in the settling time after either are not free. Cycles from the request
        to finish on are not free, either. Without a truth, the settling time before and after each detection stands for
        the contact. Call it once per piece, in the order of time: it stores the piece's last cycle in REACT.
        """
        settling_ns = round(SETTLING_TIME_CONSTANTS / outline.settings.cutoff_rad_s * 1e9)
        t_ns, truth, finish = piece.t_ns, outline.truth, outline.finish_cycle
        free = np.ones(t_ns.size, dtype=np.bool_) if finish is None else piece.cycle < finish
        if truth is None:
            around = [(found.t_ns - settling_ns, found.t_ns + settling_ns) for found in find_detections(outline)]
        else:
            zero_ns = outline.zero_ns
            spans_s = [contact.time_s[[0, -1]] for contact in timed_contacts(outline)]
            around = [(zero_ns + round(a * 1e9), zero_ns + round(b * 1e9) + settling_ns) for a, b in spans_s]
            free &= truth.span.covers(piece.cycle)
        for start_ns, end_ns in around:
            free[np.searchsorted(t_ns, start_ns) : np.searchsorted(t_ns, end_ns, side="right")] = False
        never = np.iinfo(np.int64).min // 2
        reacted_ns = np.where(piece.state == SchemeState.REACT, t_ns, never)
        reacted_ns[0] = max(reacted_ns[0], never if self._last_react_ns is None else self._last_react_ns)
        last_ns = np.maximum.accumulate(reacted_ns)
        self._last_react_ns = int(last_ns[-1])
        return np.asarray(free & (t_ns - last_ns > settling_ns))

    def _add_residual(self, piece: Run, section: Section, rows: slice, free: Mask) -> None:
        is_frozen = section.kind == "detection"
        if is_frozen:
            free = free & is_armed_in(piece.state[rows])
        before = self._residuals.get(section.label, Residual(None, None, 0))
        self._residuals[section.label] = Residual(
            _larger_pair(before.identified, piece.tau_ext_hat[rows][free]) if is_frozen else None,
            _larger_pair(before.cad, piece.tau_ext_hat_cad[rows][free]) if piece.has_cad else None,
            before.cycles + int(free.sum()),
        )

    def _add_margin(self, piece: Run, section: Section, rows: slice, free: Mask) -> None:
        assert piece.certified is not None
        threshold = piece.certified.threshold[rows]
        chosen = free & np.isfinite(threshold).all(axis=(1, 2))
        if chosen.any():
            margin = self._margins.setdefault(section.label, MarginGatherer(self._settings))
            margin.add_residuals(piece.certified.tau_ext[rows][chosen], threshold[chosen])
        armed = chosen & is_armed_in(piece.state[rows])
        if armed.any():
            self.push.add_residuals(piece.certified.tau_ext[rows][armed], threshold[armed])

    def _close(self, label: str) -> None:
        """Store the margins of the section `label`, which is complete, and drop the sums that they come from."""
        if label in self._margins:
            self._done[label] = self._margins.pop(label).margins()

    def _count_promotions(self, promotions: Vector) -> None:
        steps = np.diff(promotions, prepend=self._promoted)
        self.promotions += int(np.maximum(steps, 0.0).sum())
        self._promoted = float(promotions[-1])

    def residuals(self, sections: Sequence[Section]) -> dict[str, Residual]:
        """Return the largest residuals of the cycles added, by label of the section.

        Sections without any are left out.
        """
        return {each.label: self._residuals[each.label] for each in sections if each.label in self._residuals}

    def margins(self, sections: Sequence[Section]) -> dict[str, tuple[ChannelMargin, ...]]:
        """Return the margins of the cycles added, by label of the section; sections without any are left out.

        Call it after the last piece.
        """
        for label in list(self._margins):
            self._close(label)
        return {each.label: self._done[each.label] for each in sections if each.label in self._done}

    def beside(self, run: Run, sections: Sequence[Section]) -> Beside | None:
        """Return the results of the paper's scheme beside; None if it didn't run. run: the whole run."""
        return None if self._beside is None else self._beside.beside(run, sections)


def evaluate_certified(run: Run, sections: Sequence[Section], untouched: UntouchedGatherer) -> CertifiedEvidence | None:
    """Return tests, estimates, margins and certificates of a run; None if the paper's scheme ran alone.

    untouched: the sums over all of its cycles.
    """
    stream = run.certified
    if stream is None:
        return None
    adaptations = [section for section in sections if section.kind == "adaptation"]
    tests = [stay for stay in stays_of(run) if stay.state is SchemeState.CERTIFY]
    lengths_s = {
        each.label: [stay.end_s - stay.start_s for stay in tests if each.start_s <= stay.start_s <= each.end_s]
        for each in adaptations
    }
    return CertifiedEvidence(
        tests={label: len(found_s) for label, found_s in lengths_s.items()},
        test_s={label: found_s[-1] if found_s else None for label, found_s in lengths_s.items()},
        estimates={section.label: _estimates(run, stream, section) for section in adaptations},
        margins=untouched.margins(sections),
        promotions=untouched.promotions,
        paper_beside=untouched.beside(run, sections),
        is_anchored=all(event.level == "info" for _, event in run.events if event.name == "certificate"),
        revoked=tuple(event.message for _, event in run.events if event.name == "revoked"),
        smallest_push=untouched.push.smallest_push(),
        certificates=tuple(certificates_in((event.name, event.message) for _, event in run.events)),
    )


def _pair(values: Vector | None) -> tuple[float, float] | None:
    return None if values is None else (float(values[0]), float(values[1]))


def _larger_pair(largest: tuple[float, float] | None, values: Vector) -> tuple[float, float] | None:
    return _pair(larger(None if largest is None else np.array(largest), values))
