"""The outcome of a replay, gathered stretch by stretch in constant memory, and replays side by side.

The judge of a run's alarms (`adacd_hil.score.judge`) judges those of a replay too. As the arm's motion is that
of the log, a scheme with other settings may still be in REACT when the next contact comes: the first sample over a
threshold then finds it.
"""

import itertools
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.device.recorded_arm import Ticks
from adacd_hil.log.logged_run import Mismatch, begins_alarm, host_span, is_armed_in, last_armed, sections_in
from adacd_hil.records import JOINTS, PARAMETER_UNITS, FaultReason, SchemeState
from adacd_hil.scheme.pipeline.pipeline import SchemeBatch, layout_of
from adacd_hil.score.distribution import Distribution
from adacd_hil.score.emulator_truth import HostCycles, KnownTruth, placed_contacts
from adacd_hil.score.judge import Detection, Score, TrueContact, is_about_weight, judge
from adacd_hil.score.smallest_push import PUSH_WITHIN, PushGatherer
from adacd_hil.score.wording import NONE, found_text, why_not_found
from adacd_hil.settings.configuration import Settings


class StateChange(NamedTuple):
    """A change of the scheme's state in a cycle; fault: its reason if the new state is FAULT."""

    cycle: int
    t_ns: int
    previous: SchemeState
    state: SchemeState
    fault: FaultReason


class _Moment(NamedTuple):
    """The cycle of an alarm, the state before it, and the last cycle in MONITOR before it, -1: there is none."""

    cycle: int
    before: int
    armed: int


class OutcomeGatherer:
    """Gathers the outcome of one replay from its decisions: states, alarms, adaptations, sensitivity, score.

    `truth`: the true contacts, None if unknown. behind_gap_ns, detections_ns: times of alarms, ns.
    """

    def __init__(self, settings: Settings, truth: KnownTruth | None) -> None:
        self.transitions: list[StateChange] = []
        self.theta_hat: tuple[float, ...] = ()
        self._settings = settings
        self._truth = truth
        self._contacts: list[TrueContact] = []  # of this attempt, on the host's cycles
        self._kept: list[HostCycles] = []  # of this attempt
        self._placed: list[TrueContact] = []  # on the host's clock
        self._alarms: list[tuple[Detection, _Moment]] = []
        self._armed = -1  # last cycle in MONITOR
        self.behind_gap_ns: set[int] = set()
        """Times of the alarms before which the log lacks cycles of their attempt."""
        self._begins: list[int] = []  # first cycle of each attempt
        slices = layout_of(settings).slices
        self._theta = slices["theta_hat"]
        self._threshold = slices["threshold"]
        self._bank = (slices["tau_ext_bank"], slices["threshold_bank"]) if "threshold_bank" in slices else None
        self._push = PushGatherer(settings) if self._bank else None
        self._thresholds = tuple(Distribution() for _ in range(JOINTS))
        self._crossings: list[int] = []  # times at which some joint crosses its threshold
        self._was_over = False

    def add_stretch(self, ticks: Ticks, batch: SchemeBatch, follows_gap: bool = False) -> None:
        """Gather states and alarms of the next cycles, from the scheme's decisions in them.

        follows_gap: the log lacks cycles of the attempt before them; the times of their alarms then also go into
        `behind_gap_ns`, as they may stem from the jump.
        """
        count = len(batch.cycle)
        if count == 0:
            return
        over = batch.contact_joints != 0
        self._keep(ticks, batch)
        self._watch(batch, ~over)
        rises = np.flatnonzero(over & ~np.concatenate(([self._was_over], over[:-1])))
        self._was_over = bool(over[-1])
        self._crossings += ticks.t_ns[rises].tolist()
        is_reported = np.zeros(count, np.bool_)
        is_reported[batch.contact_places] = [report.cycle for report in batch.contacts] == ticks.cycle[
            batch.contact_places
        ]
        armed = last_armed(ticks.cycle, batch.state, self._armed)
        self._armed = int(armed[-1])
        for row in np.flatnonzero(begins_alarm(batch.previous_state, batch.state, over, is_reported)).tolist():
            moment = _Moment(int(ticks.cycle[row]), int(batch.previous_state[row]), int(armed[row]))
            is_armed = bool(is_armed_in(batch.previous_state[row]))
            self._alarms.append((Detection(int(ticks.t_ns[row]), is_armed), moment))
            if follows_gap:
                self.behind_gap_ns.add(int(ticks.t_ns[row]))
        for row in np.flatnonzero(batch.state != batch.previous_state).tolist():
            self.transitions.append(
                StateChange(
                    int(ticks.cycle[row]),
                    int(ticks.t_ns[row]),
                    SchemeState(batch.previous_state[row]),
                    SchemeState(batch.state[row]),
                    FaultReason(batch.fault[row]),
                )
            )
        self.theta_hat = tuple(batch.block[-1, self._theta].tolist())

    def _keep(self, ticks: Ticks, batch: SchemeBatch) -> None:
        """Keep the host's cycles next to the begin and end of each true contact, and the first and last of the stretch.

        Of each: number, time, state before it, thresholds. Do nothing if the truth is unknown.
        """
        if self._truth is None:
            return
        instants = [(contact.onset, contact.end) for contact in self._contacts]
        after = np.searchsorted(ticks.cycle, np.array(instants, np.int64).reshape(-1))
        rows = np.unique(np.clip(np.concatenate((after - 1, after, [0, len(ticks.cycle)])), 0, len(ticks.cycle) - 1))
        threshold = batch.block[rows, self._threshold]
        self._kept.append(HostCycles(ticks.cycle[rows], ticks.t_ns[rows], batch.previous_state[rows], threshold))

    def _watch(self, batch: SchemeBatch, is_quiet: NDArray[np.bool_]) -> None:
        """Gather thresholds of the cycles in MONITOR in which no joint is over its threshold, where `is_quiet` (n,).

        In the certified scheme gather the residuals of these cycles, too.
        """
        monitors = is_armed_in(batch.state) & is_armed_in(batch.previous_state)
        block = batch.block[monitors & is_quiet]
        if not len(block):
            return
        if self._push is not None and self._bank is not None:
            self._push.add_residuals(*(block[:, place].reshape(len(block), -1, JOINTS) for place in self._bank))
        for joint, kept in enumerate(self._thresholds):
            kept.add_values(block[:, self._threshold][:, joint])

    def sensitivity_Nm(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return, per joint, the medians of the threshold and of the smallest push found: see `Replay`.

        They are over the cycles in MONITOR without contact. Thresholds are nan where the joint was never monitored;
        pushes are () in the paper's scheme, or then.
        """
        pushes = None if self._push is None else self._push.smallest_push()
        if pushes is None:
            return tuple(kept.percentiles().get("p50", math.nan) for kept in self._thresholds), ()
        threshold, push = (tuple(joint["p50"] for joint in each) for each in (pushes.threshold_Nm, pushes.push_Nm))
        return threshold, push

    @property
    def adaptations(self) -> list[tuple[int, float | None]]:
        """Beginning, ns, and duration, s, of each adaptation so far; None: it never got to MONITOR."""
        t_ns = [change.t_ns for change in self.transitions]
        return [
            (t_ns[rows.first], (t_ns[rows.end] - t_ns[rows.first]) * 1e-9 if rows.is_complete else None)
            for rows in sections_in(np.array([change.state for change in self.transitions], np.uint8))
            if rows.kind == "adaptation"
        ]

    def begin_attempt(self, attempt: int, cycle: int) -> None:
        """End the attempt in progress and begin another.

        attempt: its number in the run, from 0. cycle: its first cycle.
        """
        self.end_attempt()
        self._begins += [cycle] * (attempt + 1 - len(self._begins))  # also of those that a recording lacks
        if self._truth is not None:
            mine = (contact for contact in self._truth.contacts if contact.attempt == attempt)
            self._contacts = [contact.counted_from(cycle) for contact in mine]
        self._was_over = False

    def end_attempt(self) -> None:
        """Place the true contacts of the attempt on the host's clock.

        Call it at the end of the log, too, before `score`.
        """
        if self._kept:
            host = HostCycles(*map(np.concatenate, zip(*self._kept, strict=True)))
            self._placed += placed_contacts(self._contacts, host, self._settings)
            self._kept = []

    @property
    def detections_ns(self) -> list[int]:
        """Times of all alarms, ns, the ones behind gaps included."""
        return [alarm.t_ns for alarm, _ in self._alarms]

    def uncovered(self, cycle: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return for each cycle (n,) of the attempts so far whether the truth lacks it; all False without a truth."""
        if self._truth is None:
            return np.zeros(len(cycle), np.bool_)
        return ~host_span(self._truth.span, np.array(self._begins or [0])).covers(cycle)

    def score(self) -> Score | None:
        """Return which true contacts were detected and which alarms were false; None if the truth is not known.

        An alarm behind a gap, or in a cycle that the emulator didn't record, is never false; it may find a contact.
        """
        if self._truth is None:
            return None
        is_known = (~self.uncovered(np.array([moment.cycle for _, moment in self._alarms], np.int64))).tolist()
        rows = self._truth.rows.with_host_models(np.array(self._begins or [0]))
        alarms = [
            replace(
                alarm,
                is_known=known and alarm.t_ns not in self.behind_gap_ns,
                is_weight=is_about_weight(rows, self._settings, *moment),
            )
            for (alarm, moment), known in zip(self._alarms, is_known, strict=True)
        ]
        return judge(self._placed, alarms, self._crossings)


@dataclass(frozen=True)
class Replay:
    """The outcome of one replay.

    cycles: replayed in the stretch, of which `compared` were compared with the log; compared is 0 if the settings are
    not the log's. arms_compared: cycles whose state, decoded from frames, was compared with the log's. monitored_s: in
    MONITOR. mismatches: the first ones, `mismatch_count` of them in all, by field in `mismatched_fields`. parameters:
    the estimate of the last cycle. score: of contacts and alarms that begin in the stretch, None if the truth is not
    known. adaptation_s: duration of each adaptation that begins in it, None if it never got to MONITOR. zero_ns: time
    of the first ADAPT of the log, 0 without one. ending: the last change of state, which may be before the stretch,
    None without one. threshold_Nm: median in MONITOR of each joint's lowest threshold of all channels, nan if it never
    monitored; push_Nm: of the smallest push found within `PUSH_WITHIN`, an estimate, () in the paper's scheme.
    attempts, threshold_Nm, push_Nm: from the log's beginning.
    """

    settings: Settings
    cycles: int
    monitored_s: float
    compared: int
    arms_compared: int
    attempts: int
    states: tuple[StateChange, ...]
    adaptation_s: tuple[float | None, ...]
    parameters: dict[str, float]
    score: Score | None
    detections_ns: tuple[int, ...]
    mismatches: tuple[Mismatch, ...]
    mismatch_count: int
    mismatched_fields: dict[str, int]
    tolerance: float
    zero_ns: int
    ending: StateChange | None
    threshold_Nm: tuple[float, ...]
    push_Nm: tuple[float, ...]
    notes: tuple[str, ...] = ()
    """Parts of the log that could not be compared or judged, a line each."""

    @property
    def is_identical(self) -> bool:
        """Whether at least one cycle was compared and no value differed."""
        return self.compared > 0 and self.mismatch_count == 0

    @property
    def is_whole(self) -> bool:
        """Whether there are no `notes`: all that the log should have could be compared and judged."""
        return not self.notes

    def time_s(self, t_ns: int) -> float:
        """Return a time in s since the first ADAPT, from ns of the run's clock.

        Without an ADAPT, return it in s of that clock.
        """
        return (t_ns - self.zero_ns) * 1e-9


NOTE: Final = (
    "The arm in the log moved as it did, and the user asked for what was asked: what another scheme would have done "
    "about a contact, and all that would have followed from it, is not in here."
)

Row = tuple[str, ...]


def side_by_side(replays: Sequence[Replay]) -> list[Row]:
    """Return a table of the replays, a row per quantity: its name, then its value in each replay, as texts.

    Rows: time watched, contacts with their delays, missed ones, false alarms, thresholds, smallest pushes, adaptations,
    parameters, the last state. "–" stands for a value that is unknown or missing.
    """
    rows = [("watched, s", *(f"{each.monitored_s:.2f}" for each in replays))]
    rows.append(("contacts detected", *map(_detected, replays)))
    if any(each.score is None for each in replays):
        rows.append(("detections at", *(_times(each, each.detections_ns) for each in replays)))
    rows += _contact_rows(replays)
    rows += [
        ("missed", *map(_missed, replays)),
        ("false alarms", *map(_false_alarms, replays)),
        ("median delay, ms", *map(_median_delay, replays)),
    ]
    rows.append(("threshold, Nm", *(_by_joint(each.threshold_Nm) for each in replays)))
    if any(each.push_Nm for each in replays):
        rows.append((f"smallest push in {PUSH_WITHIN}, Nm", *(_by_joint(each.push_Nm) for each in replays)))
    for index in range(max(len(each.adaptation_s) for each in replays)):
        rows.append((f"adaptation {index + 1}, s", *(_adaptation(each, index) for each in replays)))
    for name in dict.fromkeys(itertools.chain.from_iterable(each.parameters for each in replays)):
        unit = PARAMETER_UNITS.get(name, "")
        rows.append((f"{name}, {unit}", *(_number(each.parameters.get(name)) for each in replays)))
    rows.append(("ends in", *map(_end, replays)))
    return rows


def _contact_rows(replays: Sequence[Replay]) -> list[Row]:
    """Return a row per true contact: its delay in each replay, or why it was not found."""
    contacts = [
        {contact.number: contact for contact in (each.score.contacts if each.score else ())} for each in replays
    ]
    rows = []
    for number in sorted(set().union(*contacts)):
        known = [each.get(number) for each in contacts]
        first = next(contact for contact in known if contact is not None)
        name = f"contact {number}, link {first.link}, at {replays[0].time_s(first.onset_ns):.2f} s"
        cells = (
            NONE if contact is None
            else f"after {contact.delay_ms:.1f} ms" if contact.delay_ms is not None
            else why_not_found(contact.is_armed)
            for contact in known
        )  # fmt: skip
        rows.append((name, *cells))
    return rows


def _detected(found: Replay) -> str:
    """Return how many true contacts were detected, of how many; the number of alarms where the truth is not known."""
    if found.score is None:
        return str(len(found.detections_ns))
    return found_text(len(found.score.delays_ms), len(found.score.contacts))


def _times(found: Replay, times_ns: Sequence[int]) -> str:
    return ", ".join(f"{found.time_s(t_ns):.2f} s" for t_ns in times_ns) or NONE


def _missed(found: Replay) -> str:
    return NONE if found.score is None or not found.monitored_s else str(found.score.missed)


def _false_alarms(found: Replay) -> str:
    if found.score is None or not (found.monitored_s or found.score.false_alarms):
        return NONE
    times_ns = [alarm.t_ns for alarm in found.score.false_alarms]
    count = len(times_ns)
    return f"{count}, at {_times(found, times_ns[:3])}{', …' if count > 3 else ''}" if count else "0"


def _median_delay(found: Replay) -> str:
    delays = () if found.score is None else found.score.delays_ms
    return f"{statistics.median(delays):.1f}" if delays else NONE


def _adaptation(found: Replay, index: int) -> str:
    if index >= len(found.adaptation_s):
        return NONE
    took_s = found.adaptation_s[index]
    return "not finished" if took_s is None else f"{took_s:.3f}"


def _by_joint(values_Nm: Sequence[float]) -> str:
    known = [value for value in values_Nm if math.isfinite(value)]
    return " / ".join(f"{value:.3f}" for value in known) or NONE


def _number(value: float | None) -> str:
    return NONE if value is None else f"{value:.6g}"


def _end(found: Replay) -> str:
    last = found.ending
    if last is None:
        return SchemeState.INIT.name
    fault = f" ({last.fault.name})" if last.state is SchemeState.FAULT else ""
    return f"{last.state.name}{fault} since {found.time_s(last.t_ns):.2f} s"


def as_json(found: Replay) -> dict[str, Any]:
    """Return a replay's outcome in plain values for JSON; times in s since the first ADAPT, see `Replay.time_s`.

    Contacts are the true ones; they, false alarms and missed contacts are None if the truth is not known. Left out are
    thresholds that aren't finite, the comparison with the log, and notes.
    """
    return {
        "cycles": found.cycles,
        "attempts": found.attempts,
        "monitored_s": found.monitored_s,
        "contacts": None
        if found.score is None
        else [
            {
                "number": contact.number,
                "link": contact.link,
                "onset_s": found.time_s(contact.onset_ns),
                "is_armed": contact.is_armed,
                "detected_s": None if contact.detected_ns is None else found.time_s(contact.detected_ns),
                "delay_ms": contact.delay_ms,
            }
            for contact in found.score.contacts
        ],
        "detections_s": [found.time_s(t_ns) for t_ns in found.detections_ns],
        "false_alarms_s": None
        if found.score is None
        else [found.time_s(alarm.t_ns) for alarm in found.score.false_alarms],
        "missed": None if found.score is None else found.score.missed,
        "adaptation_s": found.adaptation_s,
        "threshold_Nm": [value for value in found.threshold_Nm if math.isfinite(value)],
        "smallest_push_Nm": found.push_Nm,
        "parameters": found.parameters,
        "states": [
            {
                "cycle": each.cycle,
                "time_s": found.time_s(each.t_ns),
                "from": each.previous.name,
                "to": each.state.name,
                "fault": each.fault.name,
            }
            for each in found.states
        ],
    }
