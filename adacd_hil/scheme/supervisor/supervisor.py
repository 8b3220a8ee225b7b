"""The scheme's state machine: what raises the events of its table, `adacd_hil.scheme.supervisor.transitions`.

INIT -> COMMISSION -> ENABLE -> ADAPT (-> CERTIFY) -> MONITOR; motion in ENABLE -> COMMISSION; a contact in any of
ENABLE, ADAPT, CERTIFY, MONITOR and PAYLOAD -> REACT, and from there back; MONITOR or STOPPED -> PAYLOAD -> ADAPT;
any -> FAULT, which is latched. A pair that is not in the table leaves the state as it is. One event per cycle: the
first that applies in the order of `SchemeEvent`, so a fault outranks everything.

A collision is latched: REACT -> STOPPED until the user acknowledges. So are a host that was late, a contact that has
grown into a collision, and one that has lasted too long. Any other contact clears itself: REACT -> where it came from.
From CERTIFY that is ADAPT: the fit is forgotten, and an arm that still stands would pass a test of no model at all.

A request is kept until it can be served, but only in the states of `KEPT_IN`; elsewhere it is dropped. No word that was
given before a stop releases it: an acknowledgement is dropped, and a change of payload waits until the stop has been
acknowledged, but for one that is announced in STOPPED itself. `KeptRequest` outlives a fault that is acknowledged.
"""

from collections.abc import Iterable
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from adacd_hil.records import ArmState, FaultReason, Request, SchemeState
from adacd_hil.scheme.supervisor.transitions import (
    ADAPTED,
    ANY_CONTACT,
    AT_REST,
    CERTIFIED,
    COLLISION,
    CONTACT,
    FITTED,
    NEVER,
    NOT_A_NUMBER,
    OVER_LIMIT,
    OVER_SPEED,
    REFUTED,
    TRANSITIONS,
    UNLOADED,
    UNSEEN,
    WITHHELD,
    ArmFinding,
    Calm,
    SchemeEvent,
    next_state,
)
from adacd_hil.settings.configuration import Settings

REST_HOLD_S = 0.05
"""How long |dq| stays below the rest velocity until the arm counts as at rest. At the reversal of a withdrawal with
700 °/s² it stays below 0.05 rad/s for 8 ms: a margin of 6."""

UNREST_S = 0.02
"""How long an arm may move while its drives are asked to enable: one whose brakes have opened sags until it is held."""

_REST_UNLOADED = AT_REST | UNLOADED

POWERED = frozenset(
    (
        SchemeState.ADAPT,
        SchemeState.CERTIFY,
        SchemeState.MONITOR,
        SchemeState.REACT,
        SchemeState.STOPPED,
        SchemeState.PAYLOAD,
    )
)
"""Where the drives are enabled and may have torque."""
_CHECKED = POWERED | {SchemeState.ENABLE}
LEARNING = frozenset((SchemeState.ADAPT, SchemeState.CERTIFY))
REACTING = frozenset((SchemeState.REACT, SchemeState.STOPPED))
_HELD_FROM = frozenset((SchemeState.MONITOR, SchemeState.REACT, SchemeState.STOPPED))
"""Where a host that is late holds the arm, or does so already; elsewhere there is no way to, and it is a fault."""

KEPT_IN = MappingProxyType(
    {
        Request.ACKNOWLEDGE: frozenset((SchemeState.STOPPED,)),
        Request.PAYLOAD: POWERED - {SchemeState.PAYLOAD},
        Request.PAYLOAD_CHANGED: frozenset((SchemeState.PAYLOAD,)),
        Request.FINISH: frozenset[SchemeState](),
        Request.ACCEPT: frozenset[SchemeState](),
        Request.RELEARN: frozenset((SchemeState.STOPPED,)),
        Request.FAULT_TORQUE: frozenset[SchemeState](),
        Request.FAULT_FOLLOWING: frozenset[SchemeState](),
        Request.FAULT_TAMPERED: frozenset[SchemeState](),
        Request.FAULT_MISCONFIGURED: frozenset[SchemeState](),
    }
)
"""Where a request waits to be served. FINISH is the control layer's; ACCEPT and a fault are served at once, or
not at all."""
_FAULT_ASKED = MappingProxyType(
    {
        Request.FAULT_TORQUE: FaultReason.TORQUE,
        Request.FAULT_FOLLOWING: FaultReason.FOLLOWING,
        Request.FAULT_TAMPERED: FaultReason.TAMPERED,
        Request.FAULT_MISCONFIGURED: FaultReason.MISCONFIGURED,
    }
)

_RAISED_BY = MappingProxyType(
    {
        SchemeEvent.COLLISION: COLLISION,
        SchemeEvent.CONTACT: CONTACT,
        SchemeEvent.LATE: int(ArmFinding.LATE),
        SchemeEvent.COMPLETE: int(ArmFinding.COMPLETE),
        SchemeEvent.ENABLED: int(ArmFinding.ENABLED),
        SchemeEvent.ADAPTED: ADAPTED,
        SchemeEvent.FITTED: FITTED,
        SchemeEvent.CERTIFIED: CERTIFIED,
        SchemeEvent.REFUTED: REFUTED,
        SchemeEvent.CONTRADICTED: WITHHELD,
    }
)
"""Findings without which an event doesn't come. Those that are not here come by counting, or by a request."""
_NOT_WELL = int(ArmFinding.FAULTY | ArmFinding.OLD | ArmFinding.LATE) | NOT_A_NUMBER | OVER_LIMIT | OVER_SPEED | UNSEEN
"""Findings without which `_check` finds nothing in an arm that is enabled."""


def _calm_in(state: SchemeState) -> tuple[int, int]:
    """Return the findings that matter in a state, and what they have to be to leave it as it is."""
    watched, expected = 0, 0
    for event in TRANSITIONS[state]:
        watched |= _RAISED_BY.get(event, 0)
    if state in _CHECKED or state is SchemeState.COMMISSION:
        watched |= _NOT_WELL
    if state is SchemeState.INIT:
        watched |= int(ArmFinding.OLD)
    if state in POWERED:
        expected |= int(ArmFinding.ENABLED)
    if state in (SchemeState.COMMISSION, SchemeState.ADAPT):
        watched |= WITHHELD
    if state is SchemeState.COMMISSION:
        expected |= int(ArmFinding.COMPLETE) | _REST_UNLOADED
    if state is SchemeState.ENABLE:
        expected |= AT_REST
    return watched | expected, expected


_CALM = MappingProxyType({state: _calm_in(state) for state in SchemeState})


def _run_at_end(holds: NDArray[np.bool_], before: int) -> int:
    """Count for how many cycles something has held without a break up to the last; `before`: up to the first."""
    breaks = np.flatnonzero(~holds)
    return holds.size - int(breaks[-1]) - 1 if breaks.size else before + holds.size


def _verdict(state: SchemeState, observation: int) -> SchemeEvent:
    """Return what the numbers say of a model that is learnt or tested, or none."""
    if state is SchemeState.ADAPT:
        if observation & ADAPTED:
            return SchemeEvent.ADAPTED
        return SchemeEvent.FITTED if observation & FITTED else SchemeEvent.NONE
    if observation & REFUTED:
        return SchemeEvent.REFUTED
    return SchemeEvent.CERTIFIED if observation & CERTIFIED else SchemeEvent.NONE


class Supervisor:
    """Walks through the table, one event per cycle; counts what takes more than one cycle."""

    def __init__(self, settings: Settings) -> None:
        period_s = settings.bus.period_s
        self._max_age_cycles = settings.bus.max_age_cycles
        self._has_gravity = settings.estimator.gravity
        self._blind_limit = settings.blind_cycles
        self._commission_cycles = settings.commission_cycles
        self._rest_cycles = round(REST_HOLD_S / period_s)
        self._unrest_cycles = max(round(UNREST_S / period_s), 1)
        self._clear_cycles = round(settings.reaction.clear_s / period_s)
        self._patience_cycles = round(settings.reaction.patience_s / period_s)
        self._rebound_cycles = round(settings.reaction.rebound_s / period_s)
        safety = settings.safety
        phase_cycles = round(safety.phase_timeout_s / period_s)
        enable_cycles = round((safety.enable_timeout_s or safety.phase_timeout_s) / period_s)
        adapt_cycles = round(settings.termination.timeout_s / period_s)
        self._limits = {
            SchemeState.INIT: (phase_cycles, FaultReason.COMMISSION_TIMEOUT),
            SchemeState.COMMISSION: (phase_cycles, FaultReason.COMMISSION_TIMEOUT),
            SchemeState.ENABLE: (enable_cycles, FaultReason.ENABLE_TIMEOUT),
            SchemeState.ADAPT: (adapt_cycles, FaultReason.ADAPT_TIMEOUT),
            SchemeState.CERTIFY: (adapt_cycles, FaultReason.ADAPT_TIMEOUT),
        }
        self._state = SchemeState.INIT
        self._origin = SchemeState.MONITOR
        self._is_latched = False
        self._is_doubted = False
        self._cause = SchemeEvent.NONE
        self._fault = FaultReason.NONE
        self._pending: set[Request] = set()
        self._is_weight_told = False
        self._is_told_here = False
        self._phase_cycles = 0
        self._learning_cycles = 0
        self._commissioned_cycles = 0
        self._still_cycles = 0
        self._moving_cycles = 0
        self._cleared_cycles = 0
        self._blind_cycles = 0
        self._stale_cycles = 0

    @property
    def state(self) -> SchemeState:
        """Where the scheme stands."""
        return self._state

    @property
    def origin(self) -> SchemeState:
        """Where the arm goes on after REACT or STOPPED: where it came from, but from a broken test to learn anew."""
        return self._origin

    @property
    def is_latched(self) -> bool:
        """Whether what REACT and STOPPED are about is to be acknowledged."""
        return self._is_latched

    @property
    def cause(self) -> SchemeEvent:
        """The event by which this state was entered."""
        return self._cause

    def doubt(self) -> SchemeState:
        """Take in, once a contact is over, that the model is wrong: hold the arm until the user says how to go on.

        An acknowledgement then takes back what is known of the arm; a payload may change without an announcement.
        """
        self._enter(next_state(self._state, SchemeEvent.DOUBTED, self._origin), SchemeEvent.DOUBTED)
        self._is_latched = self._is_doubted = True
        return self._state

    @property
    def fault(self) -> FaultReason:
        """Why it stands in FAULT; NONE elsewhere."""
        return self._fault

    def step(
        self, arm: ArmState, request: Request, observation: int, is_reporting: bool, goes_on: bool = False
    ) -> SchemeState:
        """Take in one cycle and return the new state.

        observation: bits of `Observation`. is_reporting: a contact's report is not final yet. goes_on: the reaction in
        force lets the arm move on, so that a contact clears without rest.
        """
        self._phase_cycles += arm.periods
        self._learning_cycles += arm.periods if self._state in LEARNING else 0
        self._still_cycles = self._still_cycles + 1 if observation & AT_REST else 0
        self._moving_cycles = 0 if observation & AT_REST else self._moving_cycles + 1
        self._cleared_cycles = 0 if observation & ANY_CONTACT else self._cleared_cycles + 1
        self._blind_cycles = self._blind_cycles + 1 if observation & UNSEEN else 0
        is_stale = max(*arm.age_q, *arm.age_tau_J) > 1
        self._stale_cycles = self._stale_cycles + 1 if is_stale else 0
        if request is not Request.NONE:
            self._take(request)
        if self._state is SchemeState.REACT and not self._is_latched:
            self._is_latched = self._has_grown(arm, observation)
        asked = _FAULT_ASKED.get(request, FaultReason.NONE)
        event = self._event(arm, observation, is_reporting, goes_on, asked)
        if event is not SchemeEvent.NONE:
            self._enter(next_state(self._state, event, self._origin), event)
        return self._state

    def calm(self, is_reporting: bool, goes_on: bool = False) -> Calm:
        """Return bounds within which cycles without a request change nothing here but what `pass_by` counts.

        They may be too narrow: a cycle outside is one for `step`. is_reporting, goes_on: as for `step`, and staying so.
        """
        watched, expected = _CALM[self._state]
        limit = self._limits.get(self._state)
        periods = NEVER if limit is None else limit[0] - self._spent
        cycles = NEVER
        waits_for_rest = False
        match self._state:
            case SchemeState.COMMISSION:
                cycles = self._commission_cycles - self._commissioned_cycles
            case SchemeState.MONITOR | SchemeState.STOPPED if self._is_announced:
                cycles = 0
            case SchemeState.STOPPED if Request.RELEARN in self._pending or self._is_told_of_payload:
                waits_for_rest = True
            case SchemeState.STOPPED if Request.ACKNOWLEDGE in self._pending:
                watched |= CONTACT
                expected |= CONTACT
            case SchemeState.PAYLOAD:
                waits_for_rest = bool(self._pending)
            case SchemeState.REACT if self._is_told_of_payload and not self._is_latched:
                cycles = 0
            case SchemeState.REACT if self._is_latched:
                waits_for_rest = not is_reporting
            case SchemeState.REACT:
                watched |= COLLISION
                periods = self._patience_cycles - self._phase_cycles
                to_clear = self._clear_cycles - self._cleared_cycles
                if to_clear > 1 or goes_on:
                    cycles = NEVER if is_reporting else to_clear
                else:
                    waits_for_rest = not is_reporting
        if waits_for_rest and self._still_cycles:
            cycles = self._rest_cycles - self._still_cycles
        elif waits_for_rest:
            watched |= AT_REST
        return Calm(watched, expected, cycles - 1, periods)

    def pass_by(self, observations: NDArray[np.int64], periods: NDArray[np.int64]) -> None:
        """Count calm cycles; observations (n,), periods (n,)."""
        elapsed = int(periods.sum())
        self._phase_cycles += elapsed
        self._learning_cycles += elapsed if self._state in LEARNING else 0
        self._blind_cycles = _run_at_end(observations & UNSEEN != 0, self._blind_cycles)
        self._stale_cycles = 0  # where it counts, a stale value is not calm
        self._still_cycles = _run_at_end(observations & AT_REST != 0, self._still_cycles)
        self._moving_cycles = _run_at_end(observations & AT_REST == 0, self._moving_cycles)
        self._cleared_cycles = _run_at_end(observations & ANY_CONTACT == 0, self._cleared_cycles)
        if self._state is SchemeState.COMMISSION:
            self._commissioned_cycles += observations.size

    def _has_grown(self, arm: ArmState, observation: int) -> bool:
        """Tell whether a contact that would clear itself has become one to be acknowledged."""
        is_over = bool(observation & COLLISION) or arm.is_late or self._phase_cycles >= self._patience_cycles
        return is_over or self._is_told_of_payload

    def _take(self, request: Request) -> None:
        """Keep a request if this state serves it sooner or later."""
        if self._keeps(request, self._state):
            self._pending.add(request)
            self._is_told_here |= request is Request.PAYLOAD
            self._is_weight_told |= request is Request.PAYLOAD_CHANGED and self._state in REACTING

    @property
    def _is_announced(self) -> bool:
        """Whether a change of payload is to be served in MONITOR or STOPPED; a stop ends only by a word about it."""
        return self._is_told_here or (Request.PAYLOAD in self._pending and self._state is SchemeState.MONITOR)

    @property
    def _is_told_of_payload(self) -> bool:
        """Whether the user has said that what looks like a contact is the payload: its weight, where gravity acts.

        A weight is meant only by a word since the contact began: one of before knows nothing of who touches the arm.
        """
        is_weight = self._has_gravity and self._origin is SchemeState.PAYLOAD and self._is_weight_told
        return (self._is_doubted or is_weight) and Request.PAYLOAD_CHANGED in self._pending

    def _keeps(self, request: Request, state: SchemeState) -> bool:
        """Tell whether a request waits in a state; hands that change a payload may touch the arm."""
        if request is Request.PAYLOAD_CHANGED and state in REACTING:
            return self._is_doubted or self._origin is SchemeState.PAYLOAD
        return state in KEPT_IN[request]

    def _enter(self, state: SchemeState, event: SchemeEvent) -> None:
        """Go to a state, and drop the requests that it has served or that mean nothing there."""
        if state is self._state:
            return
        if state is SchemeState.REACT:
            self._origin = SchemeState.ADAPT if self._state is SchemeState.CERTIFY else self._state
            self._is_latched = event is not SchemeEvent.CONTACT
            self._is_weight_told = False
        elif event in (SchemeEvent.ENABLED, SchemeEvent.PAYLOAD_CHANGED, SchemeEvent.REVOKED):
            self._learning_cycles = 0
        self._cause = event
        self._is_doubted &= state is SchemeState.STOPPED
        self._state = state
        self._is_told_here = False
        self._phase_cycles = 0
        self._commissioned_cycles = 0
        self._pending = {request for request in self._pending if self._keeps(request, state)}

    def _event(
        self, arm: ArmState, observation: int, is_reporting: bool, goes_on: bool, asked: FaultReason
    ) -> SchemeEvent:
        """Return the first event of this cycle that means something in this state. asked: a fault that is asked for."""
        fault = (self._check(arm, observation) or asked) if self._state in _CHECKED else FaultReason.NONE
        event = self._touch(arm, observation)
        if event is SchemeEvent.NONE:
            event = self._progress(arm, observation, is_reporting, goes_on)
        if fault is FaultReason.NONE and event is SchemeEvent.NONE:
            fault = self._overdue()
        if fault is FaultReason.NONE:
            return event
        self._fault = fault
        return SchemeEvent.FAULT

    def _touch(self, arm: ArmState, observation: int) -> SchemeEvent:
        """Return COLLISION or CONTACT where this state reacts to it, or none; an arm without torque can't react."""
        if not observation & ANY_CONTACT or not arm.is_enabled:
            return SchemeEvent.NONE
        event = SchemeEvent.COLLISION if observation & COLLISION else SchemeEvent.CONTACT
        return event if event in TRANSITIONS[self._state] else SchemeEvent.NONE

    def _progress(self, arm: ArmState, observation: int, is_reporting: bool, goes_on: bool) -> SchemeEvent:
        """Return the event with which this state is left as it should be, or none."""
        event = SchemeEvent.NONE
        is_still = self._still_cycles >= self._rest_cycles
        match self._state:
            case SchemeState.MONITOR if arm.is_late or observation & WITHHELD:
                event = SchemeEvent.LATE if arm.is_late else SchemeEvent.CONTRADICTED
            case SchemeState.MONITOR | SchemeState.STOPPED if self._is_announced:
                event = SchemeEvent.PAYLOAD_ANNOUNCED
            case SchemeState.STOPPED if self._is_told_of_payload:
                event = SchemeEvent.PAYLOAD_CHANGED if is_still and not arm.is_late else SchemeEvent.NONE
            case SchemeState.STOPPED if Request.RELEARN in self._pending:
                event = SchemeEvent.REVOKED if is_still and not arm.is_late else SchemeEvent.NONE
            case SchemeState.STOPPED if Request.ACKNOWLEDGE in self._pending:
                if not (observation & ANY_CONTACT or arm.is_late):
                    event = SchemeEvent.REVOKED if self._is_doubted else SchemeEvent.ACKNOWLEDGED
            case SchemeState.ADAPT | SchemeState.CERTIFY:
                event = _verdict(self._state, observation)
            case SchemeState.REACT if not is_reporting:
                event = self._settled(is_still, goes_on)
            case SchemeState.PAYLOAD if is_still and Request.PAYLOAD_CHANGED in self._pending:
                event = SchemeEvent.PAYLOAD_CHANGED
            case SchemeState.ENABLE:
                event = self._enabled(arm)
            case SchemeState.COMMISSION if self._is_commissioned(arm, observation):
                event = SchemeEvent.COMMISSIONED
            case SchemeState.INIT if arm.is_complete:
                event = SchemeEvent.COMPLETE
        return event

    def _enabled(self, arm: ArmState) -> SchemeEvent:
        """Return how ENABLE ends in this cycle, or none."""
        if arm.is_enabled:
            return SchemeEvent.ENABLED
        return SchemeEvent.MOVED if self._moving_cycles >= self._unrest_cycles else SchemeEvent.NONE

    def _settled(self, is_still: bool, goes_on: bool) -> SchemeEvent:
        """Return how REACT ends in this cycle, or none."""
        if self._is_latched:
            return SchemeEvent.AT_REST if is_still else SchemeEvent.NONE
        has_cleared = self._cleared_cycles >= self._clear_cycles and (is_still or goes_on)
        return SchemeEvent.CLEARED if has_cleared else SchemeEvent.NONE

    def _is_commissioned(self, arm: ArmState, observation: int) -> bool:
        """Count this cycle if all is well in it, and tell whether enough have been counted in a row.

        One whose data are not complete doesn't count and breaks nothing: how many may be missing, `_check` says.
        """
        is_resting = observation & (_REST_UNLOADED | WITHHELD) == _REST_UNLOADED
        is_good = is_resting and self._check(arm, observation) is FaultReason.NONE
        self._commissioned_cycles = self._commissioned_cycles + arm.is_complete if is_good else 0
        return self._commissioned_cycles >= self._commission_cycles

    def _overdue(self) -> FaultReason:
        """Return the timeout of a phase that has taken too long, or NONE. A learning arm's clock stops in REACT."""
        limit = self._limits.get(self._state)
        if limit is None or self._spent < limit[0]:
            return FaultReason.NONE
        return limit[1]

    @property
    def _spent(self) -> int:
        """Periods that count towards this phase's timeout."""
        return self._learning_cycles if self._state in LEARNING else self._phase_cycles

    def _check(self, arm: ArmState, observation: int) -> FaultReason:
        """Return why the arm must not go on, or NONE."""
        if arm.fault is not FaultReason.NONE:
            return arm.fault
        fault = self._check_data(arm, observation)
        if fault is not FaultReason.NONE:
            return fault
        is_thrown = self._state is SchemeState.REACT and self._phase_cycles <= self._rebound_cycles
        if observation & OVER_LIMIT or (observation & OVER_SPEED and not is_thrown):
            return FaultReason.LIMIT
        if self._state in POWERED and not arm.is_enabled:
            return FaultReason.DRIVE
        return FaultReason.DEADLINE if arm.is_late and self._state not in _HELD_FROM else FaultReason.NONE

    def _check_data(self, arm: ArmState, observation: int) -> FaultReason:
        """Return why the data must not be acted on, or NONE."""
        if observation & NOT_A_NUMBER:
            return FaultReason.NOT_A_NUMBER
        if max(*arm.age_q, *arm.age_tau_J) > self._max_age_cycles or self._stale_cycles > self._blind_limit:
            return FaultReason.DATA_AGE
        return FaultReason.BLIND if self._blind_cycles >= self._blind_limit else FaultReason.NONE


class KeptRequest:
    """The end of the run, or a stop to change the payload, until it is served. One object per attempt.

    carried: what the attempt before has left; it is asked once the drives are enabled again.
    """

    def __init__(self, carried: Request = Request.NONE) -> None:
        self.request = carried
        self._carried = carried

    def take(self) -> Request:
        """Return what the attempt before has left, once; then NONE."""
        carried, self._carried = self._carried, Request.NONE
        return carried

    def ask(self, request: Request, state: SchemeState) -> None:
        """Take note of a request; state: that of the cycle before."""
        is_kept = request is Request.FINISH or (request is Request.PAYLOAD and state in KEPT_IN[request])
        if is_kept and self.request is not Request.FINISH:
            self.request = request

    def serve(self, states: Iterable[int]) -> None:
        """Take note of the states that cycles have led to."""
        if self.request is Request.PAYLOAD and SchemeState.PAYLOAD in states:
            self.request = Request.NONE
