"""The scheme's state machine: raises the events of the table in `adacd_hil.scheme.supervisor.transitions`.

INIT -> COMMISSION -> ENABLE -> ADAPT (-> CERTIFY) -> MONITOR; motion in ENABLE -> COMMISSION; a contact in any of
ENABLE, ADAPT, CERTIFY, MONITOR and PAYLOAD -> REACT, and from there back; MONITOR or STOPPED -> PAYLOAD -> ADAPT;
any -> FAULT, which is latched. A pair that is not in the table leaves the state as it is. Each cycle has one event:
`_event` chooses a fault first, then a contact, then the progress of the state.

A collision is latched: REACT -> STOPPED until the user acknowledges. So are a late host, a contradiction of the
certificate, and a contact that has grown into a collision, has lasted too long, or that the user attributes to a
changed payload. Any other contact clears itself: REACT returns to the state before.
CERTIFY is the exception: REACT leads to ADAPT and the fit is forgotten, because an arm that still stands would pass the
test without a model.

A request is kept until it can be served, but only in the states of `KEPT_IN`; elsewhere it is dropped. A request from
before a stop cannot release the stop: an acknowledgement is dropped, and a change of payload waits until the user has
acknowledged the stop. A change of payload announced in STOPPED is served at once.

`supervise` is compiled; its whole memory is one record of whole numbers, `SupervisorMemory`. With all fields 0 it is in
INIT.
"""

from collections.abc import Collection
from types import MappingProxyType
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import compiled
from adacd_hil.records import BEGINNING, LEARNING, REACTING, FaultReason, Request, SchemeState
from adacd_hil.scheme.memory import Sample
from adacd_hil.scheme.supervisor.findings import (
    ADAPTED,
    ANY_CONTACT,
    AT_REST,
    CERTIFIED,
    COLLISION,
    FITTED,
    NOT_A_NUMBER,
    OVER_LIMIT,
    OVER_SPEED,
    REFUTED,
    UNLOADED,
    UNSEEN,
    WITHHELD,
)
from adacd_hil.scheme.supervisor.transitions import SchemeEvent, leads_on, next_state
from adacd_hil.settings.arm_settings import OLD_CYCLES
from adacd_hil.settings.configuration import Settings

REST_HOLD_S = 0.05
"""The arm counts as at rest once |dq| has stayed below the rest velocity this long. At the reversal of a withdrawal
with 700 °/s² it stays below 0.05 rad/s for 8 ms: a margin of 6."""

UNREST_S = 0.02
"""How long an arm may move while its drives enable: an arm whose brakes have opened sags until the drives hold it."""

POWERED = frozenset((*LEARNING, *REACTING, SchemeState.MONITOR, SchemeState.PAYLOAD))
"""States in which the drives are enabled and may have torque."""

KEPT_IN = MappingProxyType(
    {
        Request.ACKNOWLEDGE: frozenset((SchemeState.STOPPED,)),
        Request.PAYLOAD: POWERED - {SchemeState.PAYLOAD},
        Request.PAYLOAD_CHANGED: frozenset((SchemeState.PAYLOAD,)),
        Request.RELEARN: frozenset((SchemeState.STOPPED,)),
    }
)
"""States in which a request waits to be served. The control layer serves FINISH; ACCEPT and a fault are served at once
or dropped."""


def among(states: Collection[SchemeState]) -> NDArray[np.bool_]:
    """Return, by number of each state, whether it is in `states`."""
    return np.array([state in states for state in SchemeState])


_IS_POWERED = among(POWERED)
_IS_CHECKED = among(POWERED | {SchemeState.ENABLE})
IS_LEARNING = among(LEARNING)
IS_REACTING = among(REACTING)
_IS_HELD_FROM = among((SchemeState.MONITOR, *REACTING))
"""States in which a late host makes the arm hold, or in which it holds already; in the others a late host is a
fault."""
_IS_KEPT = np.array([among(KEPT_IN.get(request, ())) for request in Request])
"""Whether a request waits in a state (requests, states)."""
_FAULT_ASKED = np.zeros(len(Request), np.int64)
_FAULT_ASKED[Request.FAULT_TORQUE] = FaultReason.TORQUE
_FAULT_ASKED[Request.FAULT_FOLLOWING] = FaultReason.FOLLOWING
_FAULT_ASKED[Request.FAULT_TAMPERED] = FaultReason.TAMPERED
_FAULT_ASKED[Request.FAULT_MISCONFIGURED] = FaultReason.MISCONFIGURED
_OVERDUE = np.zeros(len(SchemeState), np.int64)
_OVERDUE[list(BEGINNING)] = FaultReason.COMMISSION_TIMEOUT
_OVERDUE[SchemeState.ENABLE] = FaultReason.ENABLE_TIMEOUT
_OVERDUE[IS_LEARNING] = FaultReason.ADAPT_TIMEOUT
"""Fault of a phase that takes too long, by state; NONE for a phase without a time limit."""


class SupervisorConstants:
    """Counts of cycles and periods.

    max_age_cycles: largest age of a value; blind_limit: cycles in a row without a new sample. clear_cycles: cycles
    without contact that clear it; patience_cycles: periods after which a contact is latched; rebound_cycles: first
    periods of REACT, in which OVER_SPEED is no fault. limit_periods: longest stay, by state; only some states have one.
    """

    has_gravity: int
    max_age_cycles: int
    blind_limit: int
    commission_cycles: int
    rest_cycles: int
    unrest_cycles: int
    clear_cycles: int
    patience_cycles: int
    rebound_cycles: int
    limit_periods: Annotated[NDArray[np.int64], "states"]


class SupervisorMemory:
    """State of the supervisor.

    origin: state to which REACT or STOPPED returns: the state before, or ADAPT after a broken test. cause: the event by
    which the state was entered. is_latched: the user must acknowledge the cause of REACT or STOPPED. is_doubted:
    contacts with a common cause show that the model is wrong. pending: bits of the requests that wait.
    is_weight_announced: the user has announced the payload's weight since REACT began. is_announced_here: the user has
    announced a new payload in this state. `phase_periods`, `learning_periods`: periods in this state, and in the
    learning states. Cycles in a row, `_cycles`: all checks of COMMISSION passed, at rest, in motion, without contact,
    without a new sample, with old data.
    """

    state: int
    origin: int
    cause: int
    fault: int
    is_latched: int
    is_doubted: int
    pending: int
    is_weight_announced: int
    is_announced_here: int
    phase_periods: int
    learning_periods: int
    commissioned_cycles: int
    still_cycles: int
    moving_cycles: int
    cleared_cycles: int
    blind_cycles: int
    stale_cycles: int


def fill_constants(settings: Settings, k: SupervisorConstants) -> None:
    """Fill `k` in place with the limits and waiting times of the settings, in cycles or periods."""
    period_s, safety = settings.bus.period_s, settings.safety
    k.has_gravity = settings.estimator.gravity
    k.max_age_cycles = settings.bus.max_age_cycles
    k.blind_limit = settings.blind_cycles
    k.commission_cycles = settings.commission_cycles
    k.rest_cycles = round(REST_HOLD_S / period_s)
    k.unrest_cycles = round(UNREST_S / period_s)
    k.clear_cycles = round(settings.reaction.clear_s / period_s)
    k.patience_cycles = round(settings.reaction.patience_s / period_s)
    k.rebound_cycles = round(settings.reaction.rebound_s / period_s)
    limits = k.limit_periods
    limits[list(BEGINNING)] = round(safety.phase_timeout_s / period_s)
    limits[SchemeState.ENABLE] = round((safety.enable_timeout_s or safety.phase_timeout_s) / period_s)
    limits[IS_LEARNING] = round(settings.termination.timeout_s / period_s)


@compiled
def supervise(
    k: SupervisorConstants, m: SupervisorMemory, arm: Sample, observation: int, is_reporting: bool, goes_on: bool
) -> None:
    """Advance the supervisor in `m` by a cycle.

    Count findings, keep or drop the request, and latch a contact that has grown. Change the state at most once: for a
    fault, else a contact, else progress. observation: bits of the findings, see `findings`. is_reporting: a
    contact's report is not final yet, so REACT can't end as settled. goes_on: the reaction in force lets the arm move
    on, so that a contact clears without rest.
    """
    _count(m, arm, observation)
    if arm.request != Request.NONE:
        _take(m, arm.request)
    if m.state == SchemeState.REACT and _has_grown(k, m, arm, observation):
        m.is_latched = 1
    event = _event(k, m, arm, observation, is_reporting, goes_on)
    if event != SchemeEvent.NONE:
        _enter(m, next_state(m.state, event, m.origin), event)


@compiled
def doubt(m: SupervisorMemory) -> None:
    """Move from MONITOR to STOPPED, or stay stopped, and latch it, because contacts show that the model is wrong.

    The arm holds until the user decides. An acknowledgement then takes back the knowledge of the arm; a payload may
    change without an announcement.
    """
    event: int = SchemeEvent.DOUBTED
    _enter(m, next_state(m.state, event, m.origin), event)
    m.is_latched = 1
    m.is_doubted = 1


@compiled
def _count(m: SupervisorMemory, arm: Sample, observation: int) -> None:
    """Count periods in the state and in learning states, and cycles in a row by the findings of this one.

    The cycles: at rest, in motion, without contact, without a new sample, with data older than one cycle. observation:
    bits of the findings.
    """
    m.phase_periods += arm.periods
    if IS_LEARNING[m.state]:
        m.learning_periods += arm.periods
    m.still_cycles = m.still_cycles + 1 if observation & AT_REST else 0
    m.moving_cycles = 0 if observation & AT_REST else m.moving_cycles + 1
    m.cleared_cycles = 0 if observation & ANY_CONTACT else m.cleared_cycles + 1
    m.blind_cycles = m.blind_cycles + 1 if observation & UNSEEN else 0
    m.stale_cycles = m.stale_cycles + 1 if arm.age > OLD_CYCLES else 0


@compiled
def _take(m: SupervisorMemory, request: int) -> None:
    """Set the request's bit in `pending` if it may wait in this state; else drop it.

    A kept PAYLOAD sets `is_announced_here`, a kept PAYLOAD_CHANGED `is_weight_announced`.
    """
    if _keeps(m, request, m.state):
        m.pending |= 1 << request
        if request == Request.PAYLOAD:
            m.is_announced_here = 1
        if request == Request.PAYLOAD_CHANGED:
            m.is_weight_announced = 1


@compiled
def _keeps(m: SupervisorMemory, request: int, state: int) -> bool:
    """Return whether a request stays pending in a state.

    PAYLOAD_CHANGED waits during a reaction only if the model is in doubt or the payload was being changed: an operator
    who changes it may touch the arm.
    """
    if request == Request.PAYLOAD_CHANGED and IS_REACTING[state]:
        return bool(m.is_doubted or m.origin == SchemeState.PAYLOAD)
    return bool(_IS_KEPT[request, state])


@compiled
def _is_pending(m: SupervisorMemory, request: int) -> bool:
    return bool(m.pending & 1 << request)


@compiled
def _has_grown(k: SupervisorConstants, m: SupervisorMemory, arm: Sample, observation: int) -> bool:
    """Return whether a contact that clears itself must be acknowledged from this cycle on.

    It must after a collision, a late host, or `patience_cycles`, or if the user has attributed it to a changed payload.
    """
    is_over = observation & COLLISION or arm.is_late or m.phase_periods >= k.patience_cycles
    return bool(is_over or _is_payload_announced(k, m))


@compiled
def _is_announced(m: SupervisorMemory) -> bool:
    """Return whether an announced change of payload ends MONITOR or STOPPED, in which it is called.

    STOPPED only if the change was announced in this stay there.
    """
    is_awaited = _is_pending(m, Request.PAYLOAD) and m.state == SchemeState.MONITOR
    return bool(m.is_announced_here or is_awaited)


@compiled
def _is_payload_announced(k: SupervisorConstants, m: SupervisorMemory) -> bool:
    """Return whether the user has announced a changed payload to which the contact is attributed.

    PAYLOAD_CHANGED must be pending. The model must be in doubt, or, with gravity, the weight announced since the
    contact began: an earlier announcement cannot exclude a person's touch.
    """
    is_weight = k.has_gravity and m.is_weight_announced
    return bool((m.is_doubted or is_weight) and _is_pending(m, Request.PAYLOAD_CHANGED))


@compiled
def _enter(m: SupervisorMemory, state: int, event: int) -> None:
    """Enter another state by `event`, reset its counts, and drop the requests that don't wait there.

    Do nothing if `state` is the present one. REACT stores its origin, ADAPT in place of CERTIFY, and is latched for any
    event but CONTACT. An adaptation by PAYLOAD_CHANGED or REVOKED gets its full time. A doubt of the model ends.
    """
    if state == m.state:
        return
    if state == SchemeState.REACT:
        m.origin = SchemeState.ADAPT if m.state == SchemeState.CERTIFY else m.state
        m.is_latched = event != SchemeEvent.CONTACT
        m.is_weight_announced = 0
    elif event in (SchemeEvent.PAYLOAD_CHANGED, SchemeEvent.REVOKED):
        m.learning_periods = 0
    m.cause = event
    m.is_doubted = 0
    m.state = state
    m.is_announced_here = 0
    m.phase_periods = 0
    m.commissioned_cycles = 0
    for request in range(len(_IS_KEPT)):
        if not _keeps(m, request, state):
            m.pending &= ~(1 << request)


@compiled
def _event(
    k: SupervisorConstants, m: SupervisorMemory, arm: Sample, observation: int, is_reporting: bool, goes_on: bool
) -> int:
    """Return the event of this cycle: a fault, else a contact, else progress of the state; else NONE.

    Faults of arm, finding and request count in the states that are checked; without any event, a state that has lasted
    too long is a fault. Store the fault's reason in `m.fault`; without a fault keep it. observation: bits found.
    is_reporting, goes_on: as of `supervise`.
    """
    fault = 0
    if _IS_CHECKED[m.state]:
        fault = _check(k, m, arm, observation)
        if fault == FaultReason.NONE:
            fault = _FAULT_ASKED[arm.request]
    event = _touch(m, arm, observation)
    if event == SchemeEvent.NONE:
        event = _progress(k, m, arm, observation, is_reporting, goes_on)
    if fault == FaultReason.NONE and event == SchemeEvent.NONE:
        fault = _overdue(k, m)
    if fault == FaultReason.NONE:
        return event
    m.fault = fault
    return SchemeEvent.FAULT


@compiled
def _touch(m: SupervisorMemory, arm: Sample, observation: int) -> int:
    """Return COLLISION or CONTACT if a joint is over its threshold and this state reacts to it; else NONE.

    COLLISION goes before CONTACT, also where the state reacts to CONTACT alone. NONE also while the drives aren't
    enabled: an arm without torque can't react. observation: bits of the findings.
    """
    if not (observation & ANY_CONTACT and arm.is_enabled):
        return SchemeEvent.NONE
    event = SchemeEvent.COLLISION if observation & COLLISION else SchemeEvent.CONTACT
    return event if leads_on(m.state, event) else SchemeEvent.NONE


@compiled
def _progress(
    k: SupervisorConstants, m: SupervisorMemory, arm: Sample, observation: int, is_reporting: bool, goes_on: bool
) -> int:
    """Return the event other than fault and contact that ends the state in this cycle, or NONE.

    observation: bits of the findings. is_reporting, goes_on: as of `supervise`.
    """
    state = m.state
    event: int = SchemeEvent.NONE
    is_still = m.still_cycles >= k.rest_cycles
    if state == SchemeState.MONITOR and arm.is_late:
        event = SchemeEvent.LATE
    elif state == SchemeState.MONITOR and observation & WITHHELD:
        event = SchemeEvent.CONTRADICTED
    elif state in (SchemeState.MONITOR, SchemeState.STOPPED) and _is_announced(m):
        event = SchemeEvent.PAYLOAD_ANNOUNCED
    elif state == SchemeState.STOPPED:
        event = _released(k, m, arm, observation, is_still)
    elif IS_LEARNING[state]:
        event = _verdict(state, observation)
    elif state == SchemeState.REACT and not is_reporting:
        event = _settled(k, m, is_still, goes_on)
    elif state == SchemeState.PAYLOAD and is_still and _is_pending(m, Request.PAYLOAD_CHANGED):
        event = SchemeEvent.PAYLOAD_CHANGED
    elif not _IS_POWERED[state]:
        event = _begun(k, m, arm, observation)
    return event


@compiled
def _released(k: SupervisorConstants, m: SupervisorMemory, arm: Sample, observation: int, is_still: bool) -> int:
    """Return the event by which the user's request ends STOPPED in this cycle, or NONE.

    No request does while the host is late. A changed payload and RELEARN need an arm at rest (is_still), an
    acknowledgement joints below their thresholds; it waits while one of the others does. In doubt of the model an
    acknowledgement is REVOKED.
    """
    event: int = SchemeEvent.NONE
    if arm.is_late:
        return event
    if _is_payload_announced(k, m):
        if is_still:
            event = SchemeEvent.PAYLOAD_CHANGED
    elif _is_pending(m, Request.RELEARN):
        if is_still:
            event = SchemeEvent.REVOKED
    elif _is_pending(m, Request.ACKNOWLEDGE) and not observation & ANY_CONTACT:
        event = SchemeEvent.REVOKED if m.is_doubted else SchemeEvent.ACKNOWLEDGED
    return event


@compiled
def _verdict(state: int, observation: int) -> int:
    """Return the event of a completed fit (ADAPTED, FITTED) or test (REFUTED, CERTIFIED) in this cycle, or NONE."""
    event: int = SchemeEvent.NONE
    if state == SchemeState.ADAPT and observation & ADAPTED:
        event = SchemeEvent.ADAPTED
    elif state == SchemeState.ADAPT and observation & FITTED:
        event = SchemeEvent.FITTED
    elif state == SchemeState.CERTIFY and observation & REFUTED:
        event = SchemeEvent.REFUTED
    elif state == SchemeState.CERTIFY and observation & CERTIFIED:
        event = SchemeEvent.CERTIFIED
    return event


@compiled
def _begun(k: SupervisorConstants, m: SupervisorMemory, arm: Sample, observation: int) -> int:
    """Return the event that ends INIT, COMMISSION or ENABLE in this cycle, or NONE."""
    state = m.state
    event: int = SchemeEvent.NONE
    if state == SchemeState.INIT and arm.is_complete:
        event = SchemeEvent.COMPLETE
    elif state == SchemeState.COMMISSION and _is_commissioned(k, m, arm, observation):
        event = SchemeEvent.COMMISSIONED
    elif state == SchemeState.ENABLE and arm.is_enabled:
        event = SchemeEvent.ENABLED
    elif state == SchemeState.ENABLE and m.moving_cycles >= k.unrest_cycles:
        event = SchemeEvent.MOVED
    return event


@compiled
def _settled(k: SupervisorConstants, m: SupervisorMemory, is_still: bool, goes_on: bool) -> int:
    """Return the event that ends REACT in this cycle, or NONE.

    AT_REST if the contact is latched and the arm at rest (is_still). CLEARED if it isn't latched, `clear_cycles` in a
    row were without contact, and the arm is at rest or its reaction lets it go on (goes_on).
    """
    event: int = SchemeEvent.NONE
    if m.is_latched:
        if is_still:
            event = SchemeEvent.AT_REST
    elif m.cleared_cycles >= k.clear_cycles and (is_still or goes_on):
        event = SchemeEvent.CLEARED
    return event


@compiled
def _is_commissioned(k: SupervisorConstants, m: SupervisorMemory, arm: Sample, observation: int) -> bool:
    """Count this cycle if all its checks pass, and return whether enough cycles in a row have passed.

    The checks: at rest, unloaded, no reading refused, no fault. A cycle with incomplete data doesn't count but doesn't
    break the row: `_check` limits how many may be missing.
    """
    is_resting = observation & AT_REST and observation & UNLOADED and not observation & WITHHELD
    is_good = is_resting and _check(k, m, arm, observation) == FaultReason.NONE
    m.commissioned_cycles = m.commissioned_cycles + arm.is_complete if is_good else 0
    return bool(m.commissioned_cycles >= k.commission_cycles)


@compiled
def _overdue(k: SupervisorConstants, m: SupervisorMemory) -> int:
    """Return the fault of a state that has lasted too long, or NONE.

    Learning states share one time limit, in which REACT and STOPPED don't count.
    """
    spent = m.learning_periods if IS_LEARNING[m.state] else m.phase_periods
    is_over = spent >= k.limit_periods[m.state]
    return int(_OVERDUE[m.state]) if is_over else FaultReason.NONE


@compiled
def _check(k: SupervisorConstants, m: SupervisorMemory, arm: Sample, observation: int) -> int:
    """Return the first fault in this cycle, or NONE.

    In this order: the arm's own; a value that isn't a number; a late host, except where the arm holds for it; old data;
    no new sample for too long; position or speed over a limit, OVER_SPEED not in the first periods of REACT; drives
    that aren't enabled in a powered state. observation: bits of the findings.
    """
    state = m.state
    fault: int = FaultReason.NONE
    is_thrown = state == SchemeState.REACT and m.phase_periods <= k.rebound_cycles
    if arm.fault != FaultReason.NONE:
        fault = arm.fault
    elif observation & NOT_A_NUMBER:
        fault = FaultReason.NOT_A_NUMBER
    elif arm.is_late and not _IS_HELD_FROM[state]:
        fault = FaultReason.DEADLINE  # outranks its effects: old data, drives that drop out
    elif arm.age > k.max_age_cycles or m.stale_cycles > k.blind_limit:
        fault = FaultReason.DATA_AGE
    elif m.blind_cycles >= k.blind_limit:
        fault = FaultReason.BLIND
    elif observation & OVER_LIMIT or (observation & OVER_SPEED and not is_thrown):
        fault = FaultReason.LIMIT
    elif _IS_POWERED[state] and not arm.is_enabled:
        fault = FaultReason.DRIVE
    return fault
