"""Expectations of a scenario: what is refused, and which runs differ from what is expected."""

import pytest
from played_outcome import ScenarioOutcome, deviations, expected_of

from adacd_hil.settings.parsing import parse
from firmware_sim.scenario.scenario import ExpectSettings, Scenario

EXPECTED = ExpectSettings(
    adaptations=1, contacts=2, false_alarms=1, false_alarms_most=3, adaptation_s=(5.0, 6.0), delay_ms=30.0, force_N=80.0
)
AS_EXPECTED = ScenarioOutcome("finished", None, None, 1, 5.2, 2, 2, 0, 12.0, 60.0)
FEW = {"adaptations": 1, "contacts": 1}


def test_a_run_as_expected_has_no_deviation():
    assert deviations(EXPECTED, AS_EXPECTED) == ()
    assert AS_EXPECTED.text == "1 adapted, 2 detected, 2 false"
    assert EXPECTED.text == "1 adapted, 2 detected, 1-3 false"


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        *[({"false_alarms": count}, "") for count in (1, 3)],  # bounds are inclusive
        *[({"delay_ms": delay_ms}, "") for delay_ms in (30.0, None)],  # a delay needs a contact
        ({"end": "lost"}, "end: lost, expected finished"),
        ({"fault": "DRIVE"}, "fault: DRIVE, expected none"),
        ({"adaptations": 0}, "adaptations: 0, expected 1"),
        ({"contacts": 1}, "contacts: 1, expected 2"),
        ({"contacts": 3}, "contacts: 3, expected 2"),
        ({"missed": 1}, "missed: 1, expected 0"),
        ({"false_alarms": 0}, "false_alarms: 0, expected 1 to 3"),
        ({"false_alarms": 4}, "false_alarms: 4, expected 1 to 3"),
        ({"adaptation_s": 4.99}, "adaptation_s: 4.99 s, expected 5 to 6 s"),
        ({"adaptation_s": 6.01}, "adaptation_s: 6.01 s, expected 5 to 6 s"),
        ({"adaptation_s": None}, "adaptation_s: none s, expected 5 to 6 s"),
        ({"delay_ms": 30.1}, "delay_ms: 30.1 ms, expected at most 30 ms"),
        ({"force_N": 80.1}, "force_N: 80.1 N, expected at most 80 N"),
    ],
)
def test_each_difference_is_told_with_what_was_expected(changes, text):
    assert deviations(EXPECTED, AS_EXPECTED._replace(**changes)) == ((text,) if text else ())


def test_an_arm_that_may_be_learnt_anew_has_room_in_its_adaptations():
    expected = ExpectSettings(adaptations=1, adaptations_most=2, contacts=2, false_alarms=2)
    assert [deviations(expected, AS_EXPECTED._replace(adaptations=count)) for count in range(4)] == [
        ("adaptations: 0, expected 1 to 2",),
        (),
        (),
        ("adaptations: 3, expected 1 to 2",),
    ]
    assert expected.text == "1-2 adapted, 2 detected, 2 false"


def test_a_fault_is_expected_with_its_time():
    expected = ExpectSettings(adaptations=0, contacts=0, end="fault", fault="DRIVE", fault_s=(1.0, 1.2))
    faulted = ScenarioOutcome("fault", "DRIVE", 1.1, 0, None, 0, 0, 0, None, 0.0)
    assert deviations(expected, faulted) == ()
    assert deviations(expected, faulted._replace(fault_s=1.3)) == ("fault_s: 1.3 s, expected 1 to 1.2 s",)


def test_a_certified_host_has_its_own_expectation_where_there_is_one():
    both = parse(Scenario, {"expect": FEW, "expect_certified": FEW | {"contacts": 2}})
    assert (expected_of(both, "paper").contacts, expected_of(both, "certified").contacts) == (1, 2)


def test_without_an_own_expectation_a_certified_host_is_to_do_what_the_papers_does():
    one = parse(Scenario, {"expect": FEW})
    assert expected_of(one, "certified") == one.expect
    assert expected_of(parse(Scenario, {}), "certified") is None
