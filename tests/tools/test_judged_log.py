"""tools/campaigns/judged_log.py, and the long runs on a vcan: kills, a clock that is set, hogs."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import run_rules
import timing_clock
import timing_hogs
import vcan_kills
from judged_log import judged_log
from run_rules import Violation

from adacd_hil.cli.embedded_run import Cast, run_embedded
from adacd_hil.log.reader import Series
from adacd_hil.log.types.truth_topic import TRUTH_LAYOUT
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.run_settings import OperatorSettings, RequestSettings
from firmware_sim.scenario.scenario import Scenario


@pytest.mark.long
@pytest.mark.slow
def test_a_log_and_its_truth_are_judged_as_the_wire_is(tmp_path: Path) -> None:
    push = {"at_s": 2.7, "link": 1, "point_m": 0.3, "force_N": 8.0, "duration_s": 0.3}
    scenario = parse(Scenario, {"profile": "P", "start_deg": [-30.0, -60.0], "contacts": [push]})
    operator = OperatorSettings(script=(RequestSettings(at_s=3.2, request="finish"),))
    settings = dataclasses.replace(load_settings("certified", "P"), operator=operator)
    summary, truth_path = run_embedded(Cast(settings, scenario), "lockstep", tmp_path)
    played = judged_log(summary.log.path, truth_path, settings, scenario)
    assert run_rules.judge(played) == []
    case = run_rules.Case(played)
    assert len(played.wire.sync_place) == len(played.truth.sync) == len(case.state) + 20
    assert len(run_rules.clear_contacts(case)) == 1
    played.truth.block[:, TRUTH_LAYOUT.slices["tau_ext"]] = 0.0
    assert {violation.rule for violation in run_rules.judge(played)} == {"reaction-to-nothing"}


def test_a_host_that_outlives_its_arm_or_its_logger_ends_as_documented() -> None:
    said = ["MONITOR -> FAULT: DATA_AGE; Drive1: position, velocity 4 cycles old, 3 allowed"]
    assert vcan_kills.status_violations("emulator", 4, said) == []
    assert "status 0" in vcan_kills.status_violations("emulator", 0, said)[0]
    assert vcan_kills.status_violations("emulator", 4, ["nothing"]) == ["nobody says what has gone"]
    assert vcan_kills.status_violations("logger", 3, []) == []
    assert "status 0" in vcan_kills.status_violations("logger", 0, [])[0]
    assert vcan_kills.status_violations("host", None, []) == []


def test_rest_after_a_kill_is_read_off_the_truth() -> None:
    times_ns = np.arange(100) * 10_000_000
    speed = np.where(np.arange(100) < 50, 1.0, 0.0)[:, None] * np.ones((1, 2))
    assert vcan_kills.rest_s(times_ns, speed, 300_000_000) == pytest.approx(0.2)
    assert vcan_kills.rest_s(times_ns[:45], speed[:45], 300_000_000) is None
    assert vcan_kills.rest_s(times_ns, speed, 2_000_000_000) is None


def test_a_set_clock_that_changes_a_run_is_told() -> None:
    forward = np.arange(5)
    assert timing_clock.violations_of(130, {"fault": "NONE"}, "", forward) == []
    told = timing_clock.violations_of(4, {"fault": "DATA_AGE"}, "cut", forward[::-1])
    assert told == ["exit status 4", "fault DATA_AGE", "cut", "the log's cycles go back in time"]


def test_what_follows_what_is_judged_but_for_a_second_after_missing_cycles() -> None:
    cycle = np.zeros(5, [("sec", np.int32), ("nanosec", np.uint32), ("cycle", np.uint64), ("overruns", np.uint32)])
    cycle["sec"] = range(5)
    cycle["cycle"] = 0, 1, 5, 6, 12
    cycle["overruns"] = 0, 0, 3, 3, 3  # what the host skipped, it has not lost
    assert timing_hogs.gaps_ns(Series(cycle, 0)) == [(3 * 10**9, 4 * 10**9)]
    found = [
        Violation(rule, t_s, "")
        for rule, t_s in (("torque-rate", 2.9), ("torque-rate", 4.5), ("stop-not-latched", 5.1), ("blind", 4.5))
    ]
    assert timing_hogs.outside_gaps(found, [(3.0, 4.0)]) == [found[0], *found[2:]]
