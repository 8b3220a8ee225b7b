"""The emulator's own log: the truth, what happened, and the scenario that explains both."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from test_faults import example, scenario_of

from adacd_hil.log.log_files import SCENARIO_NAME
from adacd_hil.log.reader import read_log
from adacd_hil.log.types.truth_topic import TRUTH_LAYOUT
from adacd_hil.settings.parsing import parse
from firmware_sim.bench.bench_time import TruthLog
from firmware_sim.scenario.scenario import Scenario

pytestmark = pytest.mark.slow

FAULTS = scenario_of(example("lose"), example("wrong_node_id"), example("silence", since="power_on"))


def test_the_log_has_truth_events_the_scenario_and_a_name_for_each_bit(tmp_path: Path) -> None:
    path = tmp_path / "truth.mcap"
    block = np.zeros(TRUTH_LAYOUT.size)
    with TruthLog(path, blocking=True, scenario=FAULTS, metadata={"profile": "P"}) as truth:
        for cycle in range(3):
            block[TRUTH_LAYOUT.slices["faults"]] = cycle
            truth.write(cycle, cycle * 1_000_000, block)
        truth.write_event(2_000_000, "warning", "faults", "begins: lose torque of sensor1")
    log = read_log(path)
    (entry,) = log.events
    assert (entry.t_ns, entry.event) == (2_000_000, ("warning", "faults", "begins: lose torque of sensor1"))
    assert log.truth["faults"].tolist() == [0.0, 1.0, 2.0]
    assert parse(Scenario, tomllib.loads(log.attachments[SCENARIO_NAME].decode())) == FAULTS
    assert {key: value for key, value in log.metadata.items() if key.startswith("fault_")} == {
        "fault_0": "lose torque of sensor1, duration_s 2, probability 0.1, at 1 s since enabled",
        "fault_1": "wrong_node_id of drive1, node_id 9, from power on",
        "fault_2": "silence of sensor2, at 1 s since power on",
    }
    assert log.metadata["profile"] == "P"
