"""The emulator's own log: the truth, what happened, and the scenario that explains both."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from test_faults import example, scenario_of

from adacd_hil.log.reader import read_log
from adacd_hil.records import TRUTH_LAYOUT
from adacd_hil.settings.schema import parse
from firmware_sim.bench.bench_time import SCENARIO_NAME, TruthLog
from firmware_sim.scenario.scenario import Scenario

pytestmark = pytest.mark.slow

FAULTS = scenario_of(example("lose"), example("wrong_node_id"), example("silence", since="power_on"))


def written(folder: Path, scenario: Scenario | None) -> Path:
    path = folder / "truth.mcap"
    block = np.zeros(TRUTH_LAYOUT.size)
    with TruthLog(path, blocking=True, scenario=scenario, metadata={"profile": "P"}) as log:
        for cycle in range(3):
            block[TRUTH_LAYOUT.slices["faults"]] = cycle
            log.write(cycle, cycle * 1_000_000, block)
        log.event(2_000_000, "warning", "faults", "begins: lose torque of sensor1")
    return path


def test_a_fault_that_begins_is_in_the_log_at_its_time(tmp_path: Path) -> None:
    (entry,) = read_log(written(tmp_path, FAULTS)).events
    assert entry.t_ns == 2_000_000
    assert entry.event == ("warning", "faults", "begins: lose torque of sensor1")


def test_the_truth_says_which_faults_are_active(tmp_path: Path) -> None:
    assert read_log(written(tmp_path, FAULTS)).truth["faults"].tolist() == [0.0, 1.0, 2.0]


def test_the_log_carries_the_scenario_it_was_made_with(tmp_path: Path) -> None:
    text = read_log(written(tmp_path, FAULTS)).attachments[SCENARIO_NAME].decode()
    assert parse(Scenario, tomllib.loads(text)) == FAULTS


def test_each_bit_of_the_truth_has_its_name(tmp_path: Path) -> None:
    metadata = read_log(written(tmp_path, FAULTS)).metadata
    assert {key: value for key, value in metadata.items() if key.startswith("fault_")} == {
        "fault_0": "lose torque of sensor1, duration_s 2, probability 0.1, at 1 s since enabled",
        "fault_1": "wrong_node_id of drive1, node_id 9, from power on",
        "fault_2": "silence of sensor2, at 1 s since power on",
    }
    assert metadata["profile"] == "P"


def test_a_log_without_scenario_is_what_it_was(tmp_path: Path) -> None:
    log = read_log(written(tmp_path, None))
    assert SCENARIO_NAME not in log.attachments
    assert [key for key in log.metadata if key.startswith("fault_")] == []
