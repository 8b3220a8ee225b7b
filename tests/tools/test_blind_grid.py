"""tools/campaigns/blind_grid.py: what it makes of a push, and a row without a fault."""

from pathlib import Path

import blind_grid
import pytest
from blind_grid import SHORT, Row
from made_run import Made, states
from run_rules import Case

from adacd_hil.log.types.truth_topic import TRUTH_LAYOUT
from adacd_hil.records import SchemeState

PUSH = 700  # cycles
TOUCH = range(PUSH, PUSH + 500)


def _pushed_run(*changes: tuple[int, SchemeState]) -> Case:
    played = Made(cycles=1500, state=states(*changes), tau_ext=lambda k: 1.0 if k in TOUCH else 0.0).play()
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
