"""The stored log replays to the same decisions for ever, in whatever way a user gives it."""

import json
from pathlib import Path
from typing import Any

import pytest
from called import called
from stored_log import ALONE, AS_IT_IS, VARIED, WAYS

STATES = [
    (0, "COMMISSION"),
    (40, "ENABLE"),
    (46, "ADAPT"),
    (112, "CERTIFY"),
    (132, "MONITOR"),
    (138, "REACT"),
    (165, "FAULT"),
    (321, "COMMISSION"),
    (361, "ENABLE"),
    (369, "ADAPT"),
    (433, "CERTIFY"),
    (453, "MONITOR"),
]
THRESHOLDS_NM = {"original": [0.44060, 0.50450], "12": [0.44196, 0.50815], "13": [0.44229, 0.50846]}
"""As logged, and by the value of `certified.noise_sigmas`."""

pytestmark = pytest.mark.slow


def replayed(way: str, folder: Path) -> dict[str, Any]:
    """Replay by the command; give what it found."""
    done = called("replay", *WAYS[way](folder), "--json")
    assert done.exit_code == 0, done.output
    (found,) = json.loads(done.stdout)
    assert (found["attempts"], found["notes"]) == (2, [])
    return found


@pytest.mark.parametrize("way", WAYS)
def test_the_log_replays_to_the_same_decisions(way: str, tmp_path: Path) -> None:
    """Bit for bit where the numbers are computed as they were; else within the tolerance that `replay` chooses."""
    found = replayed(way, tmp_path)
    states = found["original"]["states"]
    assert [(each["cycle"], each["to"]) for each in states] == STATES
    assert [each["fault"] for each in states if each["to"] == "FAULT"] == ["DRIVE"]
    assert found["original"]["detections_s"] == [0.46]
    compared = (0, False) if way == ALONE else (655, True)
    assert (found["compared"], found["identical"]) == compared


def test_other_settings_come_to_other_thresholds(tmp_path: Path) -> None:
    found = replayed(VARIED, tmp_path)
    assert found["original"]["threshold_Nm"] == pytest.approx(THRESHOLDS_NM["original"], rel=1e-4)
    for variant, sigmas in zip(found["variants"], ("12", "13"), strict=True):
        assert variant["threshold_Nm"] == pytest.approx(THRESHOLDS_NM[sigmas], rel=1e-4)
        assert variant["detections_s"] == found["original"]["detections_s"]


def test_a_table_shows_them_side_by_side(tmp_path: Path) -> None:
    shown = called("replay", *WAYS[VARIED](tmp_path)).stdout
    (line,) = (line for line in shown.splitlines() if line.startswith("threshold, Nm"))
    assert line.split()[2:] == ["0.441", "/", "0.504", "0.442", "/", "0.508", "0.442", "/", "0.508"]


def test_a_stretch_of_it_is_compared_alone(tmp_path: Path) -> None:
    found = json.loads(called("replay", *WAYS[AS_IT_IS](tmp_path), "--from", "1", "--until", "3", "--json").stdout)[0]
    assert (found["cycles"], found["compared"], found["identical"]) == (345, 345, True)
