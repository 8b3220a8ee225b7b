"""What a replay came to, gathered stretch by stretch in constant memory: states, contacts, adaptations, parameters.

A *detection* is a transition to REACT by a contact. It belongs to the true contact between whose onset and forgetting
it falls (`touches.forgotten_s`), else it is a false alarm, unless the emulator didn't record what was true then: as in
`adacd_hil.analysis.metrics`. As the arm in the log moved as it did, a scheme with other settings may still be in REACT
when the next contact comes. That contact then counts as detected with the first sample over a threshold.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from adacd_hil.analysis.host_cycles import host_span
from adacd_hil.analysis.replay.truth_contacts import TrueContact, TrueContacts
from adacd_hil.config import Settings
from adacd_hil.device.recorded_arm import Ticks
from adacd_hil.log.reader import LoggedContact
from adacd_hil.records import FaultReason, SchemeState, Vector
from adacd_hil.scheme.batch import SchemeBatch
from adacd_hil.scheme.selection import layout_of

_BUSY = (SchemeState.REACT, SchemeState.STOPPED)
_LEARNING = (SchemeState.ADAPT, SchemeState.CERTIFY)


class Transition(NamedTuple):
    """A change of state. `is_contact`: a contact is over a threshold in that cycle."""

    cycle: int
    t_ns: int
    previous: SchemeState
    state: SchemeState
    fault: FaultReason
    is_contact: bool


class Adaptation(NamedTuple):
    """An adaptation: its beginning, how long it took to MONITOR, None if it never got there, and what it came to."""

    t_ns: int
    took_s: float | None
    theta_hat: tuple[float, ...]


@dataclass(frozen=True)
class ContactOutcome:
    """What became of a true contact. delay_ms: None if it was not detected; is_armed: in MONITOR at its onset."""

    number: int
    link: int
    onset_ns: int
    is_armed: bool
    detected_ns: int | None

    @property
    def delay_ms(self) -> float | None:
        """Time from onset to detection."""
        return None if self.detected_ns is None else (self.detected_ns - self.onset_ns) * 1e-6


class _Mark(NamedTuple):
    t_ns: int
    is_armed: bool
    threshold: Vector


class OutcomeGatherer:
    """Takes in the decisions of one replay. `truth`: the true contacts, None where nobody knows them."""

    def __init__(self, settings: Settings, truth: TrueContacts | None) -> None:
        self.transitions: list[Transition] = []
        self.reports: list[LoggedContact] = []
        self.adaptations: list[Adaptation] = []
        self.theta_hat: tuple[float, ...] = ()
        self.state = SchemeState.INIT
        self._settings = settings
        self._contacts = None if truth is None else list(truth.contacts)
        self._span = None if truth is None else truth.span
        self._attempt = 0
        self._begins: list[int] = []  # first cycle of each attempt
        self._theta = layout_of(settings).slices["theta_hat"]
        self._threshold = layout_of(settings).slices["threshold"]
        self._began: tuple[int, int] | None = None  # cycle and time of the adaptation in progress
        self._crossings: list[tuple[int, int]] = []  # cycles and times at which some joint crosses its threshold
        self._was_over = False
        self._marks: dict[int, _Mark] = {}
        self._next = 0  # contact whose onset is yet to come

    def take(self, ticks: Ticks, batch: SchemeBatch) -> None:
        """Take in a stretch."""
        count = len(batch.cycle)
        if count == 0:
            return
        over = batch.contact_joints != 0
        self._mark_onsets(ticks, batch)
        rises = np.flatnonzero(over & ~np.concatenate(([self._was_over], over[:-1])))
        self._was_over = bool(over[-1])
        self._crossings += zip(ticks.cycle[rises].tolist(), ticks.t_ns[rises].tolist(), strict=True)
        for row in np.flatnonzero(batch.state != batch.previous_state).tolist():
            self._enter(
                Transition(
                    int(ticks.cycle[row]),
                    int(ticks.t_ns[row]),
                    SchemeState(batch.previous_state[row]),
                    SchemeState(batch.state[row]),
                    FaultReason(batch.fault[row]),
                    bool(over[row]),
                ),
                batch.block[row, self._theta],
            )
        for row, report in zip(batch.contact_places.tolist(), batch.contacts, strict=True):
            self.reports.append(LoggedContact(int(ticks.t_ns[row]), report))
        self.theta_hat = tuple(batch.block[-1, self._theta].tolist())
        self.state = SchemeState(batch.state[-1])

    def _mark_onsets(self, ticks: Ticks, batch: SchemeBatch) -> None:
        contacts = self._contacts or []
        while self._next < len(contacts) and contacts[self._next].attempt < self._attempt:
            self._next += 1  # nobody cycled
        while self._next < len(contacts) and self._is_by(contacts[self._next], int(ticks.cycle[-1])):
            row = int(np.searchsorted(ticks.cycle, contacts[self._next].onset))
            configured = np.array(self._settings.detector.threshold_Nm)
            threshold = batch.block[row, self._threshold]
            self._marks[self._next] = _Mark(
                int(ticks.t_ns[row]),
                bool(batch.previous_state[row] == SchemeState.MONITOR),
                np.where(np.isfinite(threshold), threshold, configured),
            )
            self._next += 1

    def _is_by(self, contact: TrueContact, cycle: int) -> bool:
        return contact.attempt == self._attempt and contact.onset <= cycle

    def _enter(self, transition: Transition, theta_hat: Vector) -> None:
        self.transitions.append(transition)
        state = transition.state
        if state is SchemeState.ADAPT and self._began is None:
            self._began = transition.cycle, transition.t_ns
        elif state is SchemeState.MONITOR and transition.previous in _LEARNING and self._began is not None:
            took_s = (transition.t_ns - self._began[1]) * 1e-9
            self.adaptations.append(Adaptation(self._began[1], took_s, tuple(theta_hat.tolist())))
            self._began = None
        elif state in (SchemeState.FAULT, SchemeState.PAYLOAD):
            self._give_up()

    def _give_up(self) -> None:
        """End an adaptation that came to nothing."""
        if self._began is not None:
            self.adaptations.append(Adaptation(self._began[1], None, self.theta_hat))
            self._began = None

    def begin(self, attempt: int, cycle: int) -> None:
        """Begin an attempt, by its number in the run and its first cycle."""
        self._give_up()
        self._attempt = attempt
        self._begins += [cycle] * (attempt + 1 - len(self._begins))  # also of those that a recording lacks
        if self._contacts is not None:
            self._contacts = [
                contact.counted_from(cycle) if contact.attempt == attempt else contact for contact in self._contacts
            ]
        self._was_over = False

    def end(self) -> None:
        """Take note that the log has ended."""
        self._give_up()

    @property
    def detections(self) -> list[Transition]:
        """Transitions to REACT by a contact."""
        return [
            each
            for each in self.transitions
            if each.state is SchemeState.REACT and each.previous not in _BUSY and each.is_contact
        ]

    @property
    def unjudged(self) -> list[Transition]:
        """Detections before or after what the emulator recorded: nobody knows whether they were right."""
        detections = self.detections
        if self._span is None or not detections:
            return []
        is_known = host_span(self._span, np.array(self._begins)).covers(np.array([each.cycle for each in detections]))
        return [each for each, known in zip(detections, is_known.tolist(), strict=True) if not known]

    def judge(self) -> tuple[tuple[ContactOutcome, ...], tuple[int, ...]] | None:
        """Return what became of each true contact, and the times of false alarms, ns; None without the truth."""
        if self._contacts is None:
            return None
        period_s = self._settings.bus.period_s
        is_certified = self._settings.scheme == "certified"
        a_rad_s = self._settings.certified.cutoffs_rad_s[0] if is_certified else self._settings.filter.a_rad_s
        outcomes = []
        explained = {each.cycle for each in self.unjudged}
        detections = self.detections
        for number, mark in self._marks.items():
            contact = self._contacts[number]
            forgotten_s = contact.forgotten_after_s(period_s, a_rad_s, mark.threshold)
            last = contact.end + forgotten_s / period_s
            mine = [each for each in detections if contact.onset <= each.cycle <= last]
            explained |= {each.cycle for each in mine}
            seen = [t_ns for cycle, t_ns in self._crossings if contact.onset <= cycle <= last]
            first = [each.t_ns for each in mine] or (seen if self._is_busy(contact.onset) else [])
            outcomes.append(
                ContactOutcome(number + 1, contact.link, mark.t_ns, mark.is_armed, min(first, default=None))
            )
        false_alarms = tuple(each.t_ns for each in detections if each.cycle not in explained)
        return tuple(outcomes), false_alarms

    def _is_busy(self, cycle: int) -> bool:
        """Whether the scheme was reacting to something when a cycle came."""
        before = [each.state for each in self.transitions if each.cycle < cycle]
        return bool(before) and before[-1] in _BUSY
