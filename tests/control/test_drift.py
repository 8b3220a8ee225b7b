"""A sensor whose zero moves: the arm stops, and the log says why and what takes the certificate back."""

import re
from pathlib import Path

import pytest
from rig import messages

from adacd_hil.cli.embedded_run import resolve, run_embedded
from adacd_hil.log.reader import read_log


@pytest.mark.slow
def test_an_arm_whose_sensor_drifts_stops_and_says_that_it_may(tmp_path: Path) -> None:
    file = tmp_path / "drift.toml"
    file.write_text("lasts_s = 9.0\n[sensors]\noffset_drift_Nm_s = [0.015, 0.0]\n")
    told: list[str] = []
    summary, _ = run_embedded(resolve("certified", str(file), None, None), "lockstep", tmp_path, told.append)
    log = read_log(summary.log.path)
    (revoked,) = messages(log, "revoked")
    assert re.match(r"\d contacts came to less than 1.5 times their threshold, and no one error explains them", revoked)
    assert "a torque sensor that has moved" in revoked
    states = [text for text in messages(log, "supervisor") if " -> " in text]
    assert states[-1] == "REACT -> STOPPED"
    assert any(line.endswith(revoked) for line in told)
