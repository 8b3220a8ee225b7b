"""Each kind of fault against its row: on the wire, in the host's reaction and in the emulator's ground truth.

`tools/campaigns/fault_campaign.py` plays all rows.
"""

from pathlib import Path

import pytest
from fault_rig import deviations, play, run_lockstep
from fault_table import Case, covering, rows_of
from long_cases import long_but

from firmware_sim.scenario.faults import KINDS


def test_every_kind_of_fault_has_a_row() -> None:
    assert {str(row["kind"]) for case, _ in covering() for row in rows_of(case)} == set(KINDS)


@pytest.mark.slow
@pytest.mark.parametrize(("case", "clock"), long_but(4, covering()), ids=lambda value: getattr(value, "name", value))
def test_the_host_makes_of_a_fault_what_its_row_says(tmp_path: Path, case: Case, clock: str) -> None:
    assert deviations(play(case, clock, tmp_path), case.expected(clock), case.wire) == []


@pytest.mark.long
@pytest.mark.slow
def test_the_truth_shows_a_fault_for_as_long_as_it_lasts(tmp_path: Path) -> None:
    row = {"kind": "lose", "node": "sensor1", "frame": "status", "at_s": 0.8, "duration_s": 0.1}
    outcome = run_lockstep(tmp_path, [row, {**row, "at_s": 0.85}], finish_s=1.2)
    masks = outcome.masks[outcome.onset - 1 : outcome.onset + 152]
    assert masks == [0] + [1] * 50 + [3] * 50 + [2] * 50 + [0] * 2


@pytest.mark.long
@pytest.mark.slow
def test_a_sensor_that_is_well_again_can_be_acknowledged(tmp_path: Path) -> None:
    rows = [{"kind": "sensor_error", "node": "sensor1", "at_s": 0.8, "duration_s": 0.1}]
    outcome = run_lockstep(tmp_path, rows, finish_s=2.0, acknowledge_faults=1)
    assert outcome.faulted == outcome.onset
    assert (outcome.fault, outcome.error) == ("NONE", "")
