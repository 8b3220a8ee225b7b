"""What was asked in a run, against what its configuration's script asks."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from analysis.replay_rig import record, settings_of_run

from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.device.recorded_arm import Ticks
from adacd_hil.log.reader import read_log
from adacd_hil.records import Request, SchemeState
from adacd_hil.replay.replay import replay
from adacd_hil.replay.scheme_comparison import Asking, SchemeComparison
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


def test_in_a_cycle_of_the_hosts_own_check_the_user_is_not_asked():
    """A request that is due then is made after the recovery, as in a run."""
    script = (RequestSettings(at_s=0.02, request="payload"),)
    settings = settings_of_run()
    operator = dataclasses.replace(settings.operator, script=script)
    asking = Asking(dataclasses.replace(settings, operator=operator), ScriptedOperator)
    cycle, logged = np.arange(40), np.zeros(40, np.uint8)
    logged[20] = Request.FAULT_TORQUE
    for requests, ends_in, asked_at in ((logged, SchemeState.FAULT, []), (logged * 0, SchemeState.ADAPT, [20])):
        asking.begin_attempt()
        state = np.where(cycle < 20, SchemeState.ADAPT, ends_in).astype(np.uint8)
        before = np.concatenate(([SchemeState.ENABLE], state[:-1])).astype(np.uint8)
        decided = SimpleNamespace(state=state, previous_state=before)
        asked = asking.requests(Ticks(cycle, cycle * 1_000_000, np.ones_like(cycle)), decided, requests)
        assert np.flatnonzero(asked).tolist() == asked_at


def test_what_the_user_asked_before_a_fault_and_asks_again_after_it_is_the_scripts(tmp_path):
    settings = settings_of_run()
    script = (RequestSettings(at_s=0.2, request="payload"), RequestSettings(at_s=1.9, request="finish"))
    operator = dataclasses.replace(settings.operator, script=script)
    path = record(tmp_path, dataclasses.replace(settings, operator=operator))
    assert np.count_nonzero(read_log(path).scheme["request"] == Request.PAYLOAD) == 2
    replayed = replay(path, script_of=ScriptedOperator)
    assert replayed.mismatches == ()
    assert replayed.compared > 1000
