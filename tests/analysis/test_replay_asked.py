"""What was asked in a run, against what its configuration's script asks."""

import dataclasses
from pathlib import Path

import numpy as np
from analysis.replay_rig import record, settings_of_run

from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.device.recorded_arm import Ticks
from adacd_hil.log.reader import read_log
from adacd_hil.records import Request
from adacd_hil.replay.replay import replay
from adacd_hil.replay.scheme_comparison import RequestCheck
from adacd_hil.settings.run_settings import RequestSettings


def unexplained(logged: dict[int, Request], asked: dict[int, Request]) -> list[tuple[int, int, int]]:
    """Return cycle, logged and asked of what 100 cycles have that no script and no interrupt explains."""
    cycle = np.arange(100)
    columns = [np.array([requests.get(k, 0) for k in cycle], np.uint8) for requests in (logged, asked)]
    check = RequestCheck()
    check.compare(Ticks(cycle, cycle * 1_000_000, np.ones_like(cycle)), *columns)
    return [(k, was, is_) for k, _, was, is_ in check.unexplained]


def test_one_finish_that_is_not_in_the_script_is_an_interrupt() -> None:
    assert unexplained({20: Request.FINISH}, {}) == []


def test_an_interrupt_may_be_followed_by_the_finish_of_the_script() -> None:
    assert unexplained({20: Request.FINISH, 50: Request.FINISH}, {50: Request.FINISH}) == []


def test_the_finish_of_the_script_at_another_time_is_no_interrupt() -> None:
    assert unexplained({20: Request.FINISH}, {50: Request.FINISH}) == [(50, 0, 4), (20, 4, 0)]


def test_two_that_are_not_in_the_script_are_not_both_interrupts() -> None:
    assert unexplained({20: Request.FINISH, 30: Request.FINISH}, {}) == [(30, 4, 0)]


def test_what_the_hosts_own_checks_ask_for_is_in_no_script() -> None:
    assert unexplained({20: Request.FAULT_TORQUE}, {}) == []


def test_what_the_user_asked_before_a_fault_and_asks_again_after_it_is_the_scripts(tmp_path: Path) -> None:
    settings = settings_of_run()
    script = (RequestSettings(at_s=0.2, request="payload"), RequestSettings(at_s=1.9, request="finish"))
    operator = dataclasses.replace(settings.operator, script=script)
    path = record(tmp_path, dataclasses.replace(settings, operator=operator))
    assert np.count_nonzero(read_log(path).scheme["request"] == Request.PAYLOAD) == 2
    replayed = replay(path, script_of=ScriptedOperator)
    assert replayed.mismatches == ()
    assert replayed.compared > 1000
