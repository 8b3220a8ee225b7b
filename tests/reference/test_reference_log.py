"""A log that the host of November 2026 wrote (0.1.0, log format 1) replays to the same decisions for ever.

Users have such logs, so `logs/recovery.mcap` is never renewed; a log of a later format stands beside it. It is a run of
`certified` in lockstep at 5 ms, 3.7 s, with fit and test far too short: a push in MONITOR, a drive that faults in the
reaction, an acknowledgement, a second attempt, and torque frames that get lost.
"""

import json
from pathlib import Path
from typing import Any

import can
import pytest
from called import called

LOG = Path(__file__).parent / "logs" / "recovery.mcap"
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
THRESHOLD_NM = [0.44060, 0.50450]
THRESHOLD_AT_13_SIGMAS_NM = [0.44229, 0.50846]

pytestmark = pytest.mark.slow


def replayed(path: Path, *options: object) -> dict[str, Any]:
    """Replay by the command; give what it found."""
    done = called("replay", path, "--json", *options)
    assert done.exit_code == 0, done.output
    (found,) = json.loads(done.stdout)
    assert (found["cycles"], found["compared"], found["attempts"]) == (655, 655, 2)
    assert (found["identical"], found["notes"]) == (True, [])
    return found


def test_a_log_of_today_replays_to_the_same_decisions() -> None:
    """Bit for bit where the numbers are computed as they were; else within the tolerance that `replay` chooses."""
    found = replayed(LOG)
    states = found["original"]["states"]
    assert [(each["cycle"], each["to"]) for each in states] == STATES
    assert [each["fault"] for each in states if each["to"] == "FAULT"] == ["DRIVE"]
    assert len(found["original"]["detections_s"]) == 1


def test_its_frames_in_another_programs_recording_come_to_the_same_decisions(tmp_path: Path) -> None:
    recording = tmp_path / "candump.log"
    with can.LogReader(LOG) as reader, can.Logger(recording) as writer:
        for message in reader:
            writer(message)
    found = replayed(recording, "--against", LOG)
    assert found["original"]["detections_s"] == [0.46]


def test_other_settings_come_to_other_thresholds() -> None:
    found = replayed(LOG, "--set", "certified.noise_sigmas=13")
    (variant,) = found["variants"]
    assert found["original"]["threshold_Nm"] == pytest.approx(THRESHOLD_NM, rel=1e-4)
    assert variant["threshold_Nm"] == pytest.approx(THRESHOLD_AT_13_SIGMAS_NM, rel=1e-4)
    assert variant["detections_s"] == found["original"]["detections_s"]
