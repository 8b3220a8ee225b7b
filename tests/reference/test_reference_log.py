"""A log that the host of November 2026 wrote (0.1.0, log format 1) replays to the same decisions for ever.

Users have such logs, so `logs/recovery.mcap` is never renewed; a log of a later format stands beside it. It is a run of
`certified` in lockstep at 5 ms, 3.7 s, with fit and test far too short: a push in MONITOR, a drive that faults in the
reaction, an acknowledgement, a second attempt, and torque frames that get lost.
"""

import json
from pathlib import Path

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


@pytest.mark.slow
def test_a_log_of_today_replays_to_the_same_decisions() -> None:
    """Bit for bit where the numbers are computed as they were; else within the tolerance that `replay` chooses."""
    done = called("replay", str(LOG), "--json")
    assert done.exit_code == 0, done.output
    (found,) = json.loads(done.stdout)
    assert (found["cycles"], found["compared"], found["attempts"]) == (655, 655, 2)
    assert (found["identical"], found["notes"]) == (True, [])
    states = found["original"]["states"]
    assert [(each["cycle"], each["to"]) for each in states] == STATES
    assert [each["fault"] for each in states if each["to"] == "FAULT"] == ["DRIVE"]
    assert len(found["original"]["detections_s"]) == 1
