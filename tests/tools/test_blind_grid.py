"""tools/campaigns/blind_grid.py: its rows, what it makes of a push, and the scenario that began it."""

from pathlib import Path

import blind_grid
import pytest
from blind_grid import FIRST, SHORT, Row
from made_run import Made, states
from run_rules import Case

from adacd_hil.log.types.truth_topic import TRUTH_LAYOUT
from adacd_hil.records import SchemeState

ROW = Row("certified", "arm", "torque", "sensor1", 550, 1.0, "random")
PUSH = 700  # cycles
TOUCH = range(PUSH, PUSH + 500)


def test_a_row_is_played_as_it_says() -> None:
    scenario = blind_grid.scenario_of(ROW, FIRST)
    (fault,) = scenario.faults
    assert (fault.frame, fault.node, fault.delay_us) == ("torque", "sensor1", 550.0)
    assert (fault.at_s, fault.chance) == (FIRST.fault_s, 1.0)
    assert [(contact.at_s, contact.force_N) for contact in scenario.contacts] == [(8.0, 8.0), (9.5, 3.0)]


def test_a_contiguous_share_begins_just_before_each_push_and_is_that_share_of_the_time() -> None:
    row = Row("paper", "arm_fd", "feedback", "drive2", 800, 0.1, "contiguous")
    faults = blind_grid.scenario_of(row, SHORT).faults
    assert [fault.at_s for fault in faults] == [pytest.approx(at_s - 0.005) for at_s in SHORT.pushes_s]
    whole_s = SHORT.pushes_s[1] + 0.5 - SHORT.fault_s
    assert sum(fault.duration_s or 0.0 for fault in faults) == pytest.approx(0.1 * whole_s, abs=1e-3)


def _pushed_run(*changes: tuple[int, SchemeState], events: tuple[tuple[int, str, str, str], ...] = ()) -> Case:
    played = Made(
        cycles=1500,
        state=states(*changes),
        tau_ext=lambda k: 1.0 if k in TOUCH else 0.0,
        events=list(events),
    ).play()
    played.truth.block[:, TRUTH_LAYOUT.slices["contact_index"]] = -1.0
    played.truth.block[list(TOUCH), TRUTH_LAYOUT.slices["contact_index"]] = 0.0
    return Case(played)


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ((), "missed"),
        (((PUSH + 40, SchemeState.REACT),), "found"),
        (((PUSH + 40, SchemeState.FAULT),), "fault"),
        (((PUSH - 50, SchemeState.FAULT),), "not armed"),
        (((PUSH + 800, SchemeState.REACT),), "missed"),
    ],
)
def test_a_push_is_found_if_the_arm_reacts_while_it_lasts(
    changes: tuple[tuple[int, SchemeState], ...], verdict: str
) -> None:
    assert blind_grid.push_verdict(_pushed_run(*changes), 0) == verdict
    assert blind_grid.push_verdict(_pushed_run(*changes), 1) == "not armed"  # this push never came


@pytest.mark.long
@pytest.mark.slow
def test_without_a_fault_both_pushes_are_found_and_nothing_is_bad(tmp_path: Path) -> None:
    outcome = blind_grid.play_row(Row("certified", "arm", "torque", "sensor1", 0, 1.0, "random"), SHORT, tmp_path)
    assert outcome.pushes == ["found", "found"]
    assert (outcome.end, outcome.rules, outcome.is_bad) == ("MONITOR NONE", [], False)
