"""The scheme's state machine: one table, and the conditions that raise its events.

INIT -> COMMISSION -> ENABLE -> ADAPT -> MONITOR -> REACT -> STOPPED -> MONITOR; MONITOR or STOPPED -> PAYLOAD -> ADAPT;
any -> FAULT, which is latched. A pair that is not in the table leaves the state as it is. One event per cycle: the
first that applies in the order of `SchemeEvent`, so a fault outranks everything.

A request is kept until it can be served, but only in the states of `_KEPT_IN`; elsewhere it is dropped, so that an
acknowledgement given too early can't release the next stop.
"""

from enum import IntEnum
from types import MappingProxyType

from adacd_hil.config import Settings
from adacd_hil.records import ArmState, FaultReason, Request, SchemeState
from adacd_hil.scheme.kernel import Observation

REST_HOLD_S = 0.05
"""How long |dq| stays below the rest velocity until the arm counts as at rest. At the reversal of a withdrawal with
700 °/s² it stays below 0.05 rad/s for 8 ms: a margin of 6."""


class SchemeEvent(IntEnum):
    """What can move the scheme to another state, in order of precedence."""

    NONE = 0
    FAULT = 1  # a check of the running arm failed, or a phase took too long
    COMPLETE = 2  # a cycle with all its data
    COMMISSIONED = 3  # enough complete cycles at rest in a row
    ENABLED = 4  # both drives report Operation enabled
    ADAPTED = 5  # eq. (15) with the evidence for it
    COLLISION = 6  # eq. (14) on any joint
    LATE = 7  # the host has missed so many deadlines that the arm is to be held
    AT_REST = 8  # the arm has come to rest and the collision's report is final
    ACKNOWLEDGED = 9  # the user has acknowledged, no joint is over its threshold and the host is on time
    PAYLOAD_ANNOUNCED = 10  # the user wants to change the payload
    PAYLOAD_CHANGED = 11  # the user has changed the payload and the arm is at rest


TRANSITIONS = MappingProxyType(
    {
        # Gathers nothing yet. Out: the first complete cycle; too late is a fault.
        SchemeState.INIT: {
            SchemeEvent.FAULT: SchemeState.FAULT,
            SchemeEvent.COMPLETE: SchemeState.COMMISSION,
        },
        # Drives off, arm must lie still. Out: enough complete cycles at rest; too late is a fault.
        SchemeState.COMMISSION: {
            SchemeEvent.FAULT: SchemeState.FAULT,
            SchemeEvent.COMMISSIONED: SchemeState.ENABLE,
        },
        # Drives are asked to enable. Out: both have; too late is a fault.
        SchemeState.ENABLE: {
            SchemeEvent.FAULT: SchemeState.FAULT,
            SchemeEvent.ENABLED: SchemeState.ADAPT,
        },
        # Moves and learns, detection off. Out: eq. (15) with evidence; too late is a fault.
        SchemeState.ADAPT: {
            SchemeEvent.FAULT: SchemeState.FAULT,
            SchemeEvent.ADAPTED: SchemeState.MONITOR,
        },
        # Moves, detection armed. Out: a collision; a host that is late; the announcement of a payload change.
        SchemeState.MONITOR: {
            SchemeEvent.FAULT: SchemeState.FAULT,
            SchemeEvent.COLLISION: SchemeState.REACT,
            SchemeEvent.LATE: SchemeState.REACT,
            SchemeEvent.PAYLOAD_ANNOUNCED: SchemeState.PAYLOAD,
        },
        # Withdraws, or brakes when nothing pushes. Out: at rest, and the link is final.
        SchemeState.REACT: {
            SchemeEvent.FAULT: SchemeState.FAULT,
            SchemeEvent.AT_REST: SchemeState.STOPPED,
        },
        # Holds its place. Out: acknowledged while nothing pushes; the announcement of a payload change.
        SchemeState.STOPPED: {
            SchemeEvent.FAULT: SchemeState.FAULT,
            SchemeEvent.ACKNOWLEDGED: SchemeState.MONITOR,
            SchemeEvent.PAYLOAD_ANNOUNCED: SchemeState.PAYLOAD,
        },
        # Parks, detection off. Out: the payload has been changed and the arm is at rest.
        SchemeState.PAYLOAD: {
            SchemeEvent.FAULT: SchemeState.FAULT,
            SchemeEvent.PAYLOAD_CHANGED: SchemeState.ADAPT,
        },
        # Latched. Out: a new run.
        SchemeState.FAULT: {},
    }
)


def next_state(state: SchemeState, event: SchemeEvent) -> SchemeState:
    """Look up the table; a pair that is not in it leaves the state as it is."""
    return TRANSITIONS[state].get(event, state)


_NOT_A_NUMBER = int(Observation.NOT_A_NUMBER)
_OVER_LIMIT = int(Observation.OVER_LIMIT)
_AT_REST = int(Observation.AT_REST)
_REST_UNLOADED = int(Observation.AT_REST | Observation.UNLOADED)
_ADAPTED = int(Observation.ADAPTED)
_CONTACT = int(Observation.CONTACT)

_POWERED = frozenset(
    (SchemeState.ADAPT, SchemeState.MONITOR, SchemeState.REACT, SchemeState.STOPPED, SchemeState.PAYLOAD)
)
_CHECKED = _POWERED | {SchemeState.ENABLE}
_HELD_FROM = frozenset((SchemeState.MONITOR, SchemeState.REACT, SchemeState.STOPPED))
"""Where a host that is late holds the arm, or does so already; elsewhere there is no way to, and it is a fault."""

_KEPT_IN = MappingProxyType(
    {
        Request.ACKNOWLEDGE: frozenset((SchemeState.STOPPED,)),
        Request.PAYLOAD: frozenset((SchemeState.ADAPT, SchemeState.MONITOR, SchemeState.REACT, SchemeState.STOPPED)),
        Request.PAYLOAD_CHANGED: frozenset((SchemeState.PAYLOAD,)),
        Request.FINISH: frozenset[SchemeState](),
    }
)
"""Where a request waits to be served. FINISH is the control layer's."""


class Supervisor:
    """Walks through the table, one event per cycle; counts what takes more than one cycle."""

    def __init__(self, settings: Settings) -> None:
        period_s = settings.bus.period_s
        self._max_age_cycles = settings.bus.max_age_cycles
        self._commission_cycles = settings.safety.commission_cycles
        self._rest_cycles = round(REST_HOLD_S / period_s)
        phase_cycles = round(settings.safety.phase_timeout_s / period_s)
        self._limits = {
            SchemeState.INIT: (phase_cycles, FaultReason.COMMISSION_TIMEOUT),
            SchemeState.COMMISSION: (phase_cycles, FaultReason.COMMISSION_TIMEOUT),
            SchemeState.ENABLE: (phase_cycles, FaultReason.ENABLE_TIMEOUT),
            SchemeState.ADAPT: (round(settings.termination.timeout_s / period_s), FaultReason.ADAPT_TIMEOUT),
        }
        self._state = SchemeState.INIT
        self._fault = FaultReason.NONE
        self._pending = Request.NONE
        self._state_cycles = 0
        self._commissioned_cycles = 0
        self._still_cycles = 0

    @property
    def state(self) -> SchemeState:
        """Where the scheme stands."""
        return self._state

    @property
    def fault(self) -> FaultReason:
        """Why it stands in FAULT; NONE elsewhere."""
        return self._fault

    def step(self, arm: ArmState, request: Request, observation: int, is_reporting: bool) -> SchemeState:
        """Take in one cycle and return the new state.

        observation: bits of `Observation`. is_reporting: a collision's report is not final yet.
        """
        self._state_cycles += arm.periods
        self._still_cycles = self._still_cycles + 1 if observation & _AT_REST else 0
        if request is not Request.NONE:
            self._take(request)
        event = self._event(arm, observation, is_reporting)
        if event is not SchemeEvent.NONE:
            self._enter(next_state(self._state, event))
        return self._state

    def _take(self, request: Request) -> None:
        """Keep a request if this state serves it sooner or later."""
        if self._state in _KEPT_IN[request]:
            self._pending = request

    def _enter(self, state: SchemeState) -> None:
        """Go to a state, and drop the request that it has served or that means nothing there."""
        if state is self._state:
            return
        self._state = state
        self._state_cycles = 0
        self._commissioned_cycles = 0
        if self._pending is not Request.NONE and state not in _KEPT_IN[self._pending]:
            self._pending = Request.NONE

    def _event(self, arm: ArmState, observation: int, is_reporting: bool) -> SchemeEvent:
        """Return the first event of this cycle that means something in this state."""
        fault = self._check(arm, observation) if self._state in _CHECKED else FaultReason.NONE
        event = self._progress(arm, observation, is_reporting)
        if fault is FaultReason.NONE and event is SchemeEvent.NONE:
            fault = self._overdue()
        if fault is FaultReason.NONE:
            return event
        self._fault = fault
        return SchemeEvent.FAULT

    def _progress(self, arm: ArmState, observation: int, is_reporting: bool) -> SchemeEvent:
        """Return the event with which this state is left as it should be, or none."""
        event = SchemeEvent.NONE
        is_still = self._still_cycles >= self._rest_cycles
        match self._state:
            case SchemeState.MONITOR if observation & _CONTACT:
                event = SchemeEvent.COLLISION
            case SchemeState.MONITOR if arm.is_late:
                event = SchemeEvent.LATE
            case SchemeState.MONITOR | SchemeState.STOPPED if self._pending is Request.PAYLOAD:
                event = SchemeEvent.PAYLOAD_ANNOUNCED
            case SchemeState.STOPPED if self._pending is Request.ACKNOWLEDGE:
                if not (observation & _CONTACT or arm.is_late):
                    event = SchemeEvent.ACKNOWLEDGED
            case SchemeState.ADAPT if observation & _ADAPTED:
                event = SchemeEvent.ADAPTED
            case SchemeState.REACT if is_still and not is_reporting:
                event = SchemeEvent.AT_REST
            case SchemeState.PAYLOAD if is_still and self._pending is Request.PAYLOAD_CHANGED:
                event = SchemeEvent.PAYLOAD_CHANGED
            case SchemeState.ENABLE if arm.is_enabled:
                event = SchemeEvent.ENABLED
            case SchemeState.COMMISSION if self._is_commissioned(arm, observation):
                event = SchemeEvent.COMMISSIONED
            case SchemeState.INIT if arm.is_complete:
                event = SchemeEvent.COMPLETE
        return event

    def _is_commissioned(self, arm: ArmState, observation: int) -> bool:
        """Count this cycle if all is well in it, and tell whether enough have been counted in a row."""
        is_good = (
            arm.is_complete
            and observation & _REST_UNLOADED == _REST_UNLOADED
            and self._check(arm, observation) is FaultReason.NONE
        )
        self._commissioned_cycles = self._commissioned_cycles + 1 if is_good else 0
        return self._commissioned_cycles >= self._commission_cycles

    def _overdue(self) -> FaultReason:
        """Return the timeout of a phase that has taken too long, or NONE."""
        limit = self._limits.get(self._state)
        if limit is None or self._state_cycles < limit[0]:
            return FaultReason.NONE
        return limit[1]

    def _check(self, arm: ArmState, observation: int) -> FaultReason:
        """Return why the arm must not go on, or NONE."""
        if arm.fault is not FaultReason.NONE:
            return arm.fault
        if observation & _NOT_A_NUMBER:
            return FaultReason.NOT_A_NUMBER
        if max(*arm.age_q, *arm.age_tau_J) > self._max_age_cycles:
            return FaultReason.DATA_AGE
        if observation & _OVER_LIMIT:
            return FaultReason.LIMIT
        if self._state in _POWERED and not arm.is_enabled:
            return FaultReason.DRIVE
        return FaultReason.DEADLINE if arm.is_late and self._state not in _HELD_FROM else FaultReason.NONE
