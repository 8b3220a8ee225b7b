"""Bad input gets one clear line and a documented exit status; the log is closed and readable."""

import re

import pytest
from called import called, complaints
from experiment_runs import PAPER, emulator, other_contract, run_on_vcan, run_while_killing

from adacd_hil.log.reader import read_log
from adacd_hil.wire.dbc_contract import contract_folder

pytestmark = pytest.mark.slow

USAGE, SAFETY_STOP, BUS_MISSING = 2, 4, 5


def test_a_bus_without_devices_says_who_is_missing_and_leaves_a_readable_log_with_the_reason(tmp_path):
    result = called("run", "-i", "virtual", "-c", "empty", *PAPER, "--out", tmp_path)
    missing = "no boot-up from Drive1 (node 1), Drive2 (node 2), Sensor1 (node 3), Sensor2 (node 4)"
    assert result.exit_code == BUS_MISSING
    (complaint,) = complaints(result)
    assert missing in complaint
    log = read_log(tmp_path / "run.mcap")
    assert log.is_complete
    assert any(missing in entry.event.message for entry in log.events)


def test_a_dbc_that_says_otherwise_than_the_device_profiles_is_refused_before_the_bus_is_opened(tmp_path):
    text = (contract_folder() / "arm.dbc").read_text()
    other = tmp_path / "other.dbc"
    other.write_text(text.replace("SG_ torque : 16|32@1- (1e-06,0)", "SG_ torque : 16|32@1- (1e-05,0)"))
    result = called("run", "-i", "virtual", "-c", "x", *PAPER, "--dbc", other, "--out", tmp_path / "run")
    assert result.exit_code == USAGE
    (complaint,) = complaints(result)
    assert "Sensor1Torque: scales" in complaint
    assert not (tmp_path / "run").exists()


def test_a_scale_that_the_sensors_own_eds_contradicts_is_refused_before_the_arm_moves(tmp_path):
    result = called("demo", "--config", other_contract(tmp_path), "--out", tmp_path / "run")
    assert result.exit_code == BUS_MISSING
    (complaint,) = complaints(result)
    assert "decimal digits 0x6132:1 = 6, 5 expected; correct `scale.torque_Nm`" in complaint


@pytest.mark.long
@pytest.mark.vcan
def test_devices_with_another_contract_are_refused_before_the_arm_moves(tmp_path):
    config = other_contract(tmp_path)
    with emulator(tmp_path, "--scenario", "idle"):
        played = run_on_vcan(tmp_path, "--config", config, "--clock", "lockstep")
    (complaint,) = played.error_lines
    assert played.status == BUS_MISSING
    assert re.search(r"layout digest 0x[0-9A-F]{8} is not the DBC's 0x[0-9A-F]{8}", complaint)
    assert read_log(played.log).is_complete


@pytest.mark.long
@pytest.mark.vcan
def test_an_emulator_that_stops_mid_run_is_a_safety_stop_in_lockstep(tmp_path):
    with emulator(tmp_path, "--scenario", "idle") as process:
        played = run_while_killing(tmp_path, process, "--clock", "lockstep")
    assert played.status == SAFETY_STOP
    (complaint,) = played.error_lines
    assert "no answer from Drive1, Drive2, Sensor1, Sensor2 to SYNC of cycle" in complaint
    assert read_log(played.log).is_complete
