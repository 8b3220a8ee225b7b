"""tools/campaigns/reached_lines.py: the scenarios that it plays."""

import reached_lines


def test_the_scenarios_that_are_played_are_those_with_faults() -> None:
    for name in reached_lines.FAULTS:
        scenario = reached_lines.resolve("certified", name, None, None).scenario
        assert scenario.faults, name
