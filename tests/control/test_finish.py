"""The end of a run that the user has asked for: it outlives a fault, and it comes within a time."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from rig import SessionRig, messages

from adacd_hil.cli.embedded_run import resolve, run_embedded
from adacd_hil.control.cycle import FINISH_S
from adacd_hil.log.reader import RunLog, read_log
from adacd_hil.records import FaultReason, Request, SchemeState

pytestmark = pytest.mark.slow

FAULT_WHILE_PARKING = """
lasts_s = 1.0
start_deg = [0.0, 0.0]
acknowledge_faults = 1

[[faults]]
kind = "drive_fault"
node = "drive1"
code = 0x2310
at_s = 1.05
duration_s = 0.1
"""


def test_a_fault_while_parking_is_acknowledged_and_the_arm_is_parked_and_the_run_ends(tmp_path: Path) -> None:
    scenario = tmp_path / "parking.toml"
    scenario.write_text(FAULT_WHILE_PARKING)
    summary, _ = run_embedded(resolve("paper", str(scenario), None, None), "lockstep", tmp_path)
    assert summary.result is not None
    assert (summary.recoveries, summary.result.fault) == (1, FaultReason.NONE)
    log = read_log(summary.log.path)
    scheme = log.scheme
    asked = scheme["cycle"][scheme["request"] == Request.FINISH]
    assert len(asked) == 2
    again = int(np.flatnonzero(scheme["state"] == SchemeState.FAULT)[-1]) + 1
    states = [SchemeState(int(state)).name for state in np.unique(scheme["state"][again:])]
    assert states == ["COMMISSION", "ENABLE", "ADAPT"]
    np.testing.assert_allclose(np.degrees(scheme["q"][-1]), [-30.0, -60.0], atol=1.0)
    assert len(scheme) < 10_000


def run_by_script(tmp_path: Path, fault_s: float, script: tuple[tuple[float, str], ...]) -> RunLog:
    """Play the script with a fault of drive 1 that is acknowledged, and read the log."""
    scenario = tmp_path / "announced.toml"
    lasts_s = str(script[-1][0])
    scenario.write_text(
        FAULT_WHILE_PARKING.replace("lasts_s = 1.0", f"lasts_s = {lasts_s}").replace("1.05", str(fault_s))
    )
    cast = resolve("paper", str(scenario), None, None)
    words = tuple(
        dataclasses.replace(cast.settings.operator.script[0], at_s=at_s, request=request) for at_s, request in script
    )
    operator = dataclasses.replace(cast.settings.operator, script=words)
    cast = cast._replace(settings=dataclasses.replace(cast.settings, operator=operator))
    summary, _ = run_embedded(cast, "lockstep", tmp_path)
    return read_log(summary.log.path)


@pytest.mark.long
def test_a_payload_that_was_announced_and_not_yet_served_is_announced_again(tmp_path: Path) -> None:
    log = run_by_script(tmp_path, 1.05, ((0.9, "payload"), (9.0, "finish")))
    asked = log.scheme["cycle"][log.scheme["request"] == Request.PAYLOAD]
    assert len(asked) == 2
    assert np.any(log.scheme["state"] == SchemeState.PAYLOAD)


@pytest.mark.long
def test_a_payload_announced_where_that_means_nothing_is_not_announced_again(tmp_path: Path) -> None:
    log = run_by_script(tmp_path, 8.0, ((5.8, "payload"), (6.2, "payload"), (7.2, "payload_changed"), (11.0, "finish")))
    asked = log.scheme["state"][log.scheme["request"] == Request.PAYLOAD]
    assert [SchemeState(int(state)).name for state in asked] == ["PAYLOAD", "PAYLOAD"]
    faulted = int(np.flatnonzero(log.scheme["state"] == SchemeState.FAULT)[-1])
    assert np.any(log.scheme["state"][faulted:] == SchemeState.ADAPT)


@pytest.mark.long
def test_an_arm_that_cannot_be_parked_is_disabled_where_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("adacd_hil.control.reference.Reference.is_parked", lambda *_: False)
    rig = SessionRig(tmp_path, finish_s=0.5)
    result, log = rig.play()
    assert result.fault is FaultReason.NONE
    finish = int(np.flatnonzero(log.scheme["request"] == Request.FINISH)[0])
    assert 0 <= len(log.scheme) - finish - FINISH_S * 1000 < 5
    (said,) = messages(log, "run")
    assert said == "not parked within 10 s: the drives are disabled where the arm is"
