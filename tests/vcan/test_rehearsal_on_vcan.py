"""The arm of `init` on vcan: the emulator plays it, the host rehearses with the same file."""

from pathlib import Path

import pytest
from experiment_runs import adacd_hil, emulator, run_on_vcan
from own_arm import LINKS, describe_arm, touches

from adacd_hil.log.reader import read_log

pytestmark = [pytest.mark.vcan, pytest.mark.slow]


def test_the_rehearsal_of_an_own_arm_certifies_it_and_finds_the_touches(tmp_path: Path) -> None:
    written = adacd_hil(tmp_path, "init", *describe_arm(tmp_path))
    assert written.status == 0, written.stderr
    (tmp_path / "touches.toml").write_text(touches(2))
    play = ("--config", str(tmp_path / "my-arm.toml"), "--scenario", str(tmp_path / "touches.toml"))
    with emulator(tmp_path, *play):
        played = run_on_vcan(tmp_path, *play, "--clock", "lockstep")
    assert played.status == 0, played.stderr
    assert played.json["state"] == "MONITOR"
    assert "model certified" in played.stderr
    links = [report.link for _, report in read_log(played.log).contacts if report.is_final]
    assert links == LINKS[:2]
