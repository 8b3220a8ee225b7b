"""A host against an arm that another bus has recorded, as two processes on real SocketCAN in lockstep."""

import contextlib
import json
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from experiment_runs import BIN, run_on_vcan
from hang import HANG_S
from rig import play_lockstep

from adacd_hil.log.reader import topic_bytes
from adacd_hil.settings.arm_settings import LockstepSettings
from adacd_hil.settings.run_settings import OperatorSettings, RequestSettings

pytestmark = [pytest.mark.vcan, pytest.mark.slow, pytest.mark.long]

AT_S = 0.1


@contextlib.contextmanager
def recorded_arm(log: Path, said: list[str]) -> Iterator[None]:
    """Play a recorded arm on vcan0 while the block lasts; `said` gets what it prints at the end."""
    command = [BIN / "firmware-sim", "play", log, "-i", "socketcan", "-c", "vcan0", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            for line in process.stderr:
                if line.strip() == "ready":
                    break
            yield
        finally:
            process.terminate()
            said.append(process.communicate(timeout=HANG_S)[0])


def test_a_host_against_the_recorded_arm_logs_the_same_decisions(tmp_path: Path) -> None:
    operator = OperatorSettings(script=(RequestSettings(at_s=AT_S, request="finish"),))
    first, _ = play_lockstep(tmp_path / "embedded", operator, LockstepSettings())
    config = tmp_path / "short.toml"
    config.write_text(f'[operator]\nscript = [{{ at_s = {AT_S}, request = "finish" }}]\n')
    said: list[str] = []
    with recorded_arm(first.path, said):
        again = run_on_vcan(tmp_path, "--clock", "lockstep", "--config", str(config))
    assert again.status == 0, again.stderr
    differing = [topic for topic in TOPICS if topic_bytes(first.path, topic) != topic_bytes(again.log, topic)]
    assert differing == []
    played = json.loads(said[0])
    assert (played["problem"], played["rejected_commands"]) == ("", [0, 0])
    assert played["answered"] == again.json["cycles"]


TOPICS = ("/scheme", "/control", "/cycle", "/to_can_bus", "/from_can_bus")
