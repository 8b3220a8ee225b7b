"""All devices lose their power while the arm moves, and get it back: what waits in the host's queue stays there."""

import numpy as np
import pytest
from rig import play_lockstep

from adacd_hil.log.reader import RunLog
from adacd_hil.settings.arm_settings import LockstepSettings
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.run_settings import OperatorSettings, RequestSettings
from adacd_hil.wire.bus import Frame
from firmware_sim.scenario.scenario import Scenario

pytestmark = pytest.mark.slow

COMMANDS = (0x201, 0x202)
NMT = 0x000
OUTAGE_S = 0.3
SCENARIO = {
    "start_deg": [-30.0, -60.0],
    "faults": [{"kind": "power_loss", "at_s": 1.0, "duration_s": OUTAGE_S}],
}


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunLog, list[Frame]]:
    operator = OperatorSettings(
        script=(RequestSettings(at_s=2.0, request="finish"),), acknowledge_faults=1, acknowledge_fault_after_s=0.5
    )
    folder = tmp_path_factory.mktemp("power loss")
    return play_lockstep(folder, operator, LockstepSettings(), parse(Scenario, dict(SCENARIO)))


def test_not_one_old_command_reaches_a_drive_when_power_returns(played: tuple[RunLog, list[Frame]]) -> None:
    _, arrived = played
    resets = [place for place, frame in enumerate(arrived) if frame.can_id == NMT and frame.data[0] == 130]
    assert len(resets) == 2
    before = arrived[: resets[1]]
    last_sync = max(place for place, frame in enumerate(before) if frame.can_id == 0x080)
    assert [frame for frame in before[last_sync + 1 :] if frame.can_id in COMMANDS] == []


def test_the_run_says_so_and_the_pause_is_no_overrun(played: tuple[RunLog, list[Frame]]) -> None:
    log, _ = played
    said = [entry.event.message for entry in log.events]
    assert "transmit queue of embedded is full with 10 frames: nobody acknowledges" in said
    assert (int(log.cycle["overruns"][-1]), int(log.cycle["lateness_ns"].max())) == (0, 0)


def test_the_arm_is_enabled_again_only_when_it_has_come_to_rest(played: tuple[RunLog, list[Frame]]) -> None:
    log, _ = played
    again = np.flatnonzero(np.diff(log.cycle["cycle"]) > 1)[0] + 1
    enabled = again + np.argmax(log.scheme["state"][again:] == 3)
    assert np.abs(log.scheme["dq"][again]).max() > 0.2
    assert np.abs(log.scheme["dq"][enabled - 200 : enabled]).max() <= 0.05
