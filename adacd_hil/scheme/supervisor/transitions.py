"""Rules of the scheme's state machine: for each state and event, the next state.

A pair that is not in the table leaves the state as it is. `adacd_hil.scheme.supervisor.supervisor` raises the events.
"""

from enum import IntEnum
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import compiled
from adacd_hil.records import SchemeState


class SchemeEvent(IntEnum):
    """Events that move the scheme to another state. The numbers are no order: `supervisor._event` sets precedence."""

    NONE = 0
    FAULT = 1  # a check of the running arm failed, or a phase took too long
    COLLISION = 2  # a joint is over its upper threshold
    CONTACT = 3  # a joint is over its lower threshold
    LATE = 4  # the host has missed so many deadlines that the arm must hold
    COMPLETE = 5  # a cycle with all its data
    COMMISSIONED = 6  # enough complete cycles at rest in a row
    ENABLED = 7  # both drives report Operation enabled
    ADAPTED = 8  # eq. (15) with the evidence for it
    FITTED = 9  # the estimate is ready to be tested
    CERTIFIED = 10  # the frozen model has passed its test
    REFUTED = 11  # the frozen model has failed its test
    AT_REST = 12  # the arm is at rest, the report is final, and the contact must be acknowledged
    CLEARED = 13  # the push has been over for a while, the report is final, and no acknowledgement is needed
    ACKNOWLEDGED = 14  # the user has acknowledged, no joint is over its threshold and the host is on time
    PAYLOAD_ANNOUNCED = 15  # the user wants to change the payload
    PAYLOAD_CHANGED = 16  # the user has changed the payload and the arm is at rest
    REVOKED = 17  # the user takes back the knowledge of the arm, or acknowledges that it is doubted
    DOUBTED = 18  # contacts that have cleared have one cause in common: the certificate is wrong
    MOVED = 19  # the arm moves before all its drives are enabled
    CONTRADICTED = 20  # later evidence contradicts the certificate: an anchor, a torque by place, or less sight


STAYS = -1
TO_ORIGIN = -2
"""Next state: the state from which REACT was entered."""

_TOUCHED = {SchemeEvent.COLLISION: SchemeState.REACT, SchemeEvent.CONTACT: SchemeState.REACT}

# Beside these, FAULT leads from each state to the state FAULT.
TRANSITIONS: MappingProxyType[SchemeState, dict[SchemeEvent, int]] = MappingProxyType(
    {
        # Gathers no data yet. Out: the first complete cycle; too late is a fault.
        SchemeState.INIT: {
            SchemeEvent.COMPLETE: SchemeState.COMMISSION,
        },
        # Drives off, arm must lie still. Out: enough complete cycles at rest; too late is a fault.
        SchemeState.COMMISSION: {
            SchemeEvent.COMMISSIONED: SchemeState.ENABLE,
        },
        # The host enables the drives. Out: both are enabled; an arm that moves meanwhile must lie still again; too late
        # is a fault; a contact once they are enabled.
        SchemeState.ENABLE: {
            **_TOUCHED,
            SchemeEvent.ENABLED: SchemeState.ADAPT,
            SchemeEvent.MOVED: SchemeState.COMMISSION,
        },
        # Moves and learns. Out: eq. (15) with evidence; a fit to be tested; a contact; too late is a fault.
        SchemeState.ADAPT: {
            **_TOUCHED,
            SchemeEvent.ADAPTED: SchemeState.MONITOR,
            SchemeEvent.FITTED: SchemeState.CERTIFY,
        },
        # Moves on, the model frozen and tested. Out: the test's result; a contact; too late is a fault.
        SchemeState.CERTIFY: {
            **_TOUCHED,
            SchemeEvent.CERTIFIED: SchemeState.MONITOR,
            SchemeEvent.REFUTED: SchemeState.ADAPT,
        },
        # Moves, detection armed. Out: a contact; a late host; later evidence against the certificate; the announcement
        # of a payload change; back from these, the doubt of the model.
        SchemeState.MONITOR: {
            **_TOUCHED,
            SchemeEvent.LATE: SchemeState.REACT,
            SchemeEvent.CONTRADICTED: SchemeState.REACT,
            SchemeEvent.PAYLOAD_ANNOUNCED: SchemeState.PAYLOAD,
            SchemeEvent.DOUBTED: SchemeState.STOPPED,
        },
        # Reacts. Out, once the report is final: at rest, if it is to be acknowledged; else cleared.
        SchemeState.REACT: {
            SchemeEvent.AT_REST: SchemeState.STOPPED,
            SchemeEvent.CLEARED: TO_ORIGIN,
        },
        # Holds its place. Out: acknowledged while no joint is pushed; the announcement of a payload change; a payload
        # that looked like contacts, or whose weight looks like one; the certificate taken back, even while a push seems
        # to last.
        SchemeState.STOPPED: {
            SchemeEvent.ACKNOWLEDGED: TO_ORIGIN,
            SchemeEvent.PAYLOAD_ANNOUNCED: SchemeState.PAYLOAD,
            SchemeEvent.PAYLOAD_CHANGED: SchemeState.ADAPT,
            SchemeEvent.REVOKED: SchemeState.ADAPT,
        },
        # Parks. Out: the payload has been changed and the arm is at rest; a contact.
        SchemeState.PAYLOAD: {
            **_TOUCHED,
            SchemeEvent.PAYLOAD_CHANGED: SchemeState.ADAPT,
        },
        # Latched. No way out: a recovery begins the next attempt in INIT.
        SchemeState.FAULT: {},
    }
)


def _numbered() -> NDArray[np.int64]:
    """Return `TRANSITIONS` as numbers (states, events): the next state, STAYS or TO_ORIGIN."""
    table = np.full((len(SchemeState), len(SchemeEvent)), STAYS)
    table[:, SchemeEvent.FAULT] = SchemeState.FAULT
    for state, row in TRANSITIONS.items():
        for event, following in row.items():
            table[state, event] = following
    return table


_NEXT = _numbered()


@compiled
def next_state(state: int, event: int, origin: int) -> int:
    """Return the next state from the table; a pair that is not in it leaves the state as it is.

    origin: the state to which REACT and STOPPED return.
    """
    following = int(_NEXT[state, event])
    if following == TO_ORIGIN:
        return origin
    return state if following == STAYS else following


@compiled
def leads_on(state: int, event: int) -> bool:
    """Return whether the table has a next state for the event in the state; for FAULT in FAULT that is FAULT again."""
    return bool(_NEXT[state, event] != STAYS)
