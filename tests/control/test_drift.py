"""A sensor whose zero moves: the arm stops, and the log says why and what takes the certificate back."""

from pathlib import Path

import pytest

from adacd_hil.cli.commands.demo_command import resolve, run_embedded
from adacd_hil.log.reader import read_log


@pytest.mark.slow
def test_an_arm_whose_offset_leaves_its_anchor_stops_and_says_which(tmp_path: Path) -> None:
    file = tmp_path / "drift.toml"
    file.write_text("lasts_s = 9.0\n[sensors]\noffset_drift_Nm_s = [0.015, 0.0]\n")
    told: list[str] = []
    summary, _ = run_embedded(resolve("certified", str(file), None, None), "lockstep", tmp_path, told.append)
    events = [entry.event for entry in read_log(summary.log.path).events]
    stopped = [event.message for event in events if event.name == "supervisor" and "MONITOR -> REACT" in event.message]
    assert stopped == ["MONITOR -> REACT: what was learnt since contradicts the certificate"]
    (revoked,) = [event.message for event in events if event.name == "revoked"]
    assert revoked.startswith("joint 1 has a fitted torque offset of 0.0")
    assert "by the reading at rest it is" in revoked
    assert any(line.endswith(revoked) for line in told)
