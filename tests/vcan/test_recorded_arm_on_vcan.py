"""A host against an arm that another bus has recorded, as two processes on real SocketCAN in lockstep."""

import json
from pathlib import Path

import pytest
from experiment_runs import firmware_sim, run_on_vcan
from rig import play_lockstep
from topic_bytes import topic_bytes

from adacd_hil.settings.arm_settings import LockstepSettings
from adacd_hil.settings.run_settings import OperatorSettings, RequestSettings

pytestmark = [pytest.mark.vcan, pytest.mark.slow, pytest.mark.long]

AT_S = 0.1


def test_a_host_against_the_recorded_arm_logs_the_same_decisions(tmp_path: Path) -> None:
    operator = OperatorSettings(script=(RequestSettings(at_s=AT_S, request="finish"),))
    first, _ = play_lockstep(tmp_path / "embedded", operator, LockstepSettings())
    config = tmp_path / "short.toml"
    config.write_text(f'[operator]\nscript = [{{ at_s = {AT_S}, request = "finish" }}]\n')
    with firmware_sim("play", first.path, "-i", "socketcan", "-c", "vcan0", "--json") as arm:
        again = run_on_vcan(tmp_path, "--clock", "lockstep", "--config", str(config))
    assert again.status == 0, again.stderr
    differing = [topic for topic in TOPICS if topic_bytes(first.path, topic) != topic_bytes(again.log, topic)]
    assert differing == []
    played = json.loads(arm.said[0])
    assert (played["problem"], played["rejected_commands"]) == ("", [0, 0])
    assert played["answered"] == again.json["cycles"]


TOPICS = ("/scheme", "/control", "/cycle", "/to_can_bus", "/from_can_bus")
