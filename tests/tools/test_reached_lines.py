"""tools/campaigns/reached_lines.py: what it counts is what runs on an arm and replays its logs."""

import pytest
import reached_lines


@pytest.mark.parametrize(
    ("path", "is_counted"),
    [
        ("adacd_hil/control/session.py", True),
        ("adacd_hil/cli/commands/run_command.py", True),
        ("adacd_hil/lab/report/page.py", False),
        ("adacd_hil/lab/score/verdict.py", False),
    ],
)
def test_what_runs_on_an_arm_counts_and_the_laboratory_does_not(path: str, is_counted: bool) -> None:
    assert reached_lines.is_counted(path) == is_counted


def test_the_scenarios_that_are_played_are_those_with_faults() -> None:
    for name in reached_lines.FAULTS:
        scenario = reached_lines.resolve("certified", name, None, None).scenario
        assert scenario.faults, name
