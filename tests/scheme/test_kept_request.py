"""Requests that outlive an attempt: the end of the run, and a stop to change the payload."""

import pytest

from adacd_hil.records import Request, SchemeState
from adacd_hil.scheme.supervisor.kept_request import KeptRequest

NONE, FINISH, PAYLOAD = Request.NONE, Request.FINISH, Request.PAYLOAD
MONITOR = SchemeState.MONITOR


def kept_after(*asked: Request, state: SchemeState = MONITOR, carried: Request = NONE) -> Request:
    kept = KeptRequest(carried)
    for request in asked:
        kept.ask(request, state)
    return kept.request


@pytest.mark.parametrize("state", SchemeState)
@pytest.mark.parametrize("request_", Request)
def test_the_end_is_kept_always_and_a_payload_in_the_states_that_serve_it(request_, state):
    serving = ("ADAPT", "CERTIFY", "MONITOR", "REACT", "STOPPED")
    is_kept = request_ is FINISH or (request_ is PAYLOAD and state.name in serving)
    assert kept_after(request_, state=state) is (request_ if is_kept else NONE)


def test_a_request_replaces_another_but_nothing_replaces_the_end():
    assert kept_after(PAYLOAD, FINISH) is FINISH
    assert kept_after(FINISH, PAYLOAD) is FINISH
    assert kept_after(PAYLOAD, Request.ACKNOWLEDGE) is PAYLOAD
    assert kept_after(PAYLOAD, carried=FINISH) is FINISH


@pytest.mark.parametrize("request_", [NONE, FINISH, PAYLOAD])
def test_a_request_of_the_attempt_before_is_taken_once_and_stays_until_it_is_served(request_):
    kept = KeptRequest(request_)
    assert [kept.take_carried(), kept.take_carried()] == [request_, NONE]
    assert kept.request is request_


@pytest.mark.parametrize(
    ("request_", "states", "expected"),
    [
        (PAYLOAD, (MONITOR, SchemeState.PAYLOAD), NONE),
        (PAYLOAD, (MONITOR, SchemeState.FAULT), PAYLOAD),
        (PAYLOAD, (), PAYLOAD),
        (FINISH, (SchemeState.PAYLOAD,), FINISH),
        (NONE, (SchemeState.PAYLOAD,), NONE),
    ],
)
def test_a_payload_is_served_once_the_arm_stops_for_it(request_, states, expected):
    kept = KeptRequest(request_)
    kept.serve(states)
    assert kept.request is expected


def test_a_new_attempt_has_no_request():
    kept = KeptRequest()
    assert (kept.request, kept.take_carried()) == (NONE, NONE)
