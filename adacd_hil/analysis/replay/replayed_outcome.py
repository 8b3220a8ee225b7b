"""What a replay came to, gathered stretch by stretch in constant memory: states, contacts, adaptations, parameters.

Alarms are judged as those of a run (`adacd_hil.analysis.score.judge`). As the arm in the log moved as it did, a scheme
with other settings may still be in REACT when the next contact comes: the first sample over a threshold then finds it.
"""

from typing import NamedTuple

import numpy as np

from adacd_hil.analysis.logged_run import host_span
from adacd_hil.analysis.score.emulator_truth import HostCycles, TrueContact, TrueContacts, windows_of
from adacd_hil.analysis.score.judge import Alarm, Score, TouchWindow, enters_react, judge
from adacd_hil.device.recorded_arm import Ticks
from adacd_hil.log.reader import LoggedContact
from adacd_hil.records import FaultReason, SchemeState, Vector
from adacd_hil.scheme.pipeline.pipeline import SchemeBatch, layout_of
from adacd_hil.scheme.supervisor.supervisor import LEARNING
from adacd_hil.settings.configuration import Settings


class Transition(NamedTuple):
    """A change of state."""

    cycle: int
    t_ns: int
    previous: SchemeState
    state: SchemeState
    fault: FaultReason


class Adaptation(NamedTuple):
    """An adaptation: its beginning, how long it took to MONITOR, None if it never got there, and what it came to."""

    t_ns: int
    took_s: float | None
    theta_hat: tuple[float, ...]


class OutcomeGatherer:
    """Takes in the decisions of one replay. `truth`: the true contacts, None where nobody knows them."""

    def __init__(self, settings: Settings, truth: TrueContacts | None) -> None:
        self.transitions: list[Transition] = []
        self.reports: list[LoggedContact] = []
        self.adaptations: list[Adaptation] = []
        self.theta_hat: tuple[float, ...] = ()
        self.state = SchemeState.INIT
        self._settings = settings
        self._truth = truth
        self._contacts: list[TrueContact] = []  # of this attempt, on the host's cycles
        self._kept: list[HostCycles] = []  # of this attempt
        self._touches: list[TouchWindow] = []
        self._alarms: list[tuple[int, Alarm]] = []  # with the cycle of each
        self._begins: list[int] = []  # first cycle of each attempt
        self._theta = layout_of(settings).slices["theta_hat"]
        self._threshold = layout_of(settings).slices["threshold"]
        self._began: tuple[int, int] | None = None  # cycle and time of the adaptation in progress
        self._crossings: list[int] = []  # times at which some joint crosses its threshold
        self._was_over = False

    def take(self, ticks: Ticks, batch: SchemeBatch) -> None:
        """Take in a stretch."""
        count = len(batch.cycle)
        if count == 0:
            return
        over = batch.contact_joints != 0
        self._keep(ticks, batch)
        rises = np.flatnonzero(over & ~np.concatenate(([self._was_over], over[:-1])))
        self._was_over = bool(over[-1])
        self._crossings += ticks.t_ns[rises].tolist()
        over[batch.contact_places] |= np.array([r.cycle for r in batch.contacts]) == ticks.cycle[batch.contact_places]
        for row in np.flatnonzero(enters_react(batch.previous_state, batch.state) & over).tolist():
            is_armed = bool(batch.previous_state[row] == SchemeState.MONITOR)
            self._alarms.append((int(ticks.cycle[row]), Alarm(int(ticks.t_ns[row]), is_armed)))
        for row in np.flatnonzero(batch.state != batch.previous_state).tolist():
            self._enter(
                Transition(
                    int(ticks.cycle[row]),
                    int(ticks.t_ns[row]),
                    SchemeState(batch.previous_state[row]),
                    SchemeState(batch.state[row]),
                    FaultReason(batch.fault[row]),
                ),
                batch.block[row, self._theta],
            )
        for row, report in zip(batch.contact_places.tolist(), batch.contacts, strict=True):
            self.reports.append(LoggedContact(int(ticks.t_ns[row]), report))
        self.theta_hat = tuple(batch.block[-1, self._theta].tolist())
        self.state = SchemeState(batch.state[-1])

    def _keep(self, ticks: Ticks, batch: SchemeBatch) -> None:
        """Keep the cycles between which true contacts begin and end, and the first and the last one."""
        if self._truth is None:
            return
        instants = [(contact.onset, contact.end) for contact in self._contacts]
        after = np.searchsorted(ticks.cycle, np.array(instants, np.int64).reshape(-1))
        rows = np.unique(np.clip(np.concatenate((after - 1, after, [0, len(ticks.cycle)])), 0, len(ticks.cycle) - 1))
        threshold = batch.block[rows, self._threshold]
        self._kept.append(HostCycles(ticks.cycle[rows], ticks.t_ns[rows], batch.previous_state[rows], threshold))

    def _enter(self, transition: Transition, theta_hat: Vector) -> None:
        self.transitions.append(transition)
        state = transition.state
        if state is SchemeState.ADAPT and self._began is None:
            self._began = transition.cycle, transition.t_ns
        elif state is SchemeState.MONITOR and transition.previous in LEARNING and self._began is not None:
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
        self.end()
        self._begins += [cycle] * (attempt + 1 - len(self._begins))  # also of those that a recording lacks
        if self._truth is not None:
            mine = (contact for contact in self._truth.contacts if contact.attempt == attempt)
            self._contacts = [contact.counted_from(cycle) for contact in mine]
        self._was_over = False

    def end(self) -> None:
        """Take note that an attempt, or the log, has ended."""
        self._give_up()
        if self._kept:
            host = HostCycles(*map(np.concatenate, zip(*self._kept, strict=True)))
            self._touches += windows_of(self._contacts, host, self._settings)
            self._kept = []

    @property
    def detections_ns(self) -> list[int]:
        """Times of all alarms."""
        return [alarm.t_ns for _, alarm in self._alarms]

    def score(self) -> Score | None:
        """Judge the alarms; None without the truth."""
        if self._truth is None:
            return None
        span = host_span(self._truth.span, np.array(self._begins or [0]))
        is_known = span.covers(np.array([cycle for cycle, _ in self._alarms], np.int64)).tolist()
        alarms = [alarm._replace(is_known=known) for (_, alarm), known in zip(self._alarms, is_known, strict=True)]
        return judge(self._touches, alarms, self._crossings)
