"""What was asked in a run, against what its configuration's script asks."""

import dataclasses

import numpy as np
import pytest
from analysis.replay_rig import record, settings_of_run

from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.device.recorded_arm import Ticks
from adacd_hil.log.reader import read_log
from adacd_hil.records import Request
from adacd_hil.replay.replay import replay
from adacd_hil.replay.scheme_comparison import SchemeComparison
from adacd_hil.settings.run_settings import RequestSettings


@pytest.mark.parametrize(
    ("logged", "asked", "unexplained"),
    [
        ({20: Request.FINISH}, {}, []),
        ({20: Request.FINISH, 50: Request.FINISH}, {50: Request.FINISH}, []),
        ({20: Request.FINISH}, {50: Request.FINISH}, [(50, 0, 4), (20, 4, 0)]),
        ({20: Request.FINISH, 30: Request.FINISH}, {}, [(30, 4, 0)]),
        ({20: Request.FAULT_TORQUE}, {}, []),
    ],
    ids=["an interrupt", "before the script's finish", "the finish at another time", "two", "the host's own check"],
)
def test_one_finish_that_is_not_in_the_script_is_an_interrupt(logged, asked, unexplained):
    """unexplained: cycle, logged and asked."""
    cycle = np.arange(100)
    columns = [np.array([requests.get(k, 0) for k in cycle], np.uint8) for requests in (logged, asked)]
    comparison = SchemeComparison(settings_of_run())
    comparison.compare_requests(Ticks(cycle, cycle * 1_000_000, np.ones_like(cycle)), *columns)
    assert [(k, was, is_) for k, _, was, is_ in comparison.unexplained] == unexplained


def test_what_the_user_asked_before_a_fault_and_asks_again_after_it_is_the_scripts(tmp_path):
    settings = settings_of_run()
    script = (RequestSettings(at_s=0.2, request="payload"), RequestSettings(at_s=1.9, request="finish"))
    operator = dataclasses.replace(settings.operator, script=script)
    path = record(tmp_path, dataclasses.replace(settings, operator=operator))
    assert np.count_nonzero(read_log(path).scheme["request"] == Request.PAYLOAD) == 2
    replayed = replay(path, script_of=ScriptedOperator)
    assert replayed.mismatches == ()
    assert replayed.compared > 1000
