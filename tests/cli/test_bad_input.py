"""Bad input gets one clear line and a documented exit status; the log is closed and readable."""

import re
from pathlib import Path

import pytest
from experiment_runs import PAPER, adacd_hil, demo, emulator, other_contract, run_on_vcan, run_while_killing
from long_cases import long_but

from adacd_hil.log.reader import read_log
from adacd_hil.wire.codec import contract_folder

pytestmark = pytest.mark.slow

USAGE, SAFETY_STOP, BUS_MISSING, FAILURE = 2, 4, 5, 1


def settings_file(folder: Path, text: str) -> str:
    path = folder / "settings.toml"
    path.write_text(text)
    return str(path)


@pytest.mark.parametrize(
    ("text", "line"),
    long_but(
        3,
        [
            ("[filtr]\na_rad_s = 10.0\n", "unknown key `filtr`; did you mean `filter`?"),
            ("[filter]\na_rads = 10.0\n", "unknown key `filter.a_rads`; did you mean `filter.a_rad_s`?"),
            ("[filter]\na_rad_s = -1.0\n", "`filter.a_rad_s` = -1.0 rad/s is below 0.1 rad/s"),
            ("[filter]\na_rad_s = nan\n", "`filter.a_rad_s` = nan is not finite"),
            ('[filter]\na_rad_s = "ten"\n', "`filter.a_rad_s` = 'ten' must be of type float"),
            ("[detector]\nthreshold_Nm = [0.1]\n", "`detector.threshold_Nm` has 1 values, 2 expected"),
            ('[estimator]\nlaw = "least_square"\n', "did you mean 'least_squares'?"),
            ("[filter\n", "settings.toml"),
            ('extends = "papper"\n', "did you mean 'paper'?"),
        ],
    ),
)
def test_a_setting_that_cant_be_used_is_named_with_its_bound(tmp_path: Path, text: str, line: str) -> None:
    played = demo(tmp_path, "--config", settings_file(tmp_path, text))
    assert (played.status, played.stdout) == (USAGE, "")
    (complaint,) = played.stderr.splitlines()
    assert line in complaint


@pytest.mark.parametrize(
    ("arguments", "status", "line"),
    long_but(
        4,
        [
            (("demo", "--config", "papper"), USAGE, "did you mean 'paper'?"),
            (("demo", "--scenario", "papr"), USAGE, "did you mean 'paper'?"),
            (("demo", "--scenario", "nowhere.toml"), USAGE, "nowhere.toml does not exist"),
            (("demo", "--config", "none.toml"), USAGE, "configuration none.toml does not exist"),
            (("run", "-i", "sockecan", "-c", "x"), BUS_MISSING, "did you mean 'socketcan'?"),
            (("run", "-i", "socketcan", "-c", "can77"), BUS_MISSING, "can77"),
            (("run", "-i", "virtual", "-c", "x", "--dbc", "none.dbc"), USAGE, "none.dbc: No such file"),
            (("run", "-i", "slcan", "-c", "ttyX", "--clock", "lockstep"), USAGE, "lockstep is for emulated arms"),
            (("report", "none.mcap"), FAILURE, "none.mcap"),
        ],
    ),
)
def test_a_wrong_argument_is_one_line(tmp_path: Path, arguments: tuple[str, ...], status: int, line: str) -> None:
    played = adacd_hil(tmp_path, *arguments)
    assert (played.status, played.stdout) == (status, "")
    (complaint,) = played.stderr.splitlines()
    assert line in complaint


def test_an_option_that_does_not_exist_is_usage(tmp_path: Path) -> None:
    played = adacd_hil(tmp_path, "demo", "--profil", "P")
    assert played.status == USAGE
    assert "--profile" in played.stderr


def test_a_log_that_is_no_log_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_text("hello")
    played = adacd_hil(tmp_path, "report", str(tmp_path / "run.mcap"))
    assert played.status == FAILURE
    assert len(played.stderr.splitlines()) == 1


def test_a_folder_that_cant_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    played = adacd_hil(tmp_path, "demo", "--out", str(tmp_path / "taken"))
    assert played.status in (USAGE, FAILURE)
    assert "Traceback" not in played.stderr


def test_a_bus_without_devices_says_who_is_missing(tmp_path: Path) -> None:
    played = adacd_hil(tmp_path, "run", "-i", "virtual", "-c", "empty", *PAPER, "--out", str(tmp_path))
    assert played.status == BUS_MISSING
    (complaint,) = played.error_lines
    assert "no boot-up from Drive1 (node 1), Drive2 (node 2), Sensor1 (node 3), Sensor2 (node 4)" in complaint


@pytest.mark.long
def test_a_run_that_never_started_leaves_a_readable_log_with_the_reason(tmp_path: Path) -> None:
    adacd_hil(tmp_path, "run", "-i", "virtual", "-c", "empty", *PAPER, "--out", str(tmp_path))
    log = read_log(tmp_path / "run.mcap")
    assert log.is_complete
    assert any("no boot-up" in entry.event.message for entry in log.events)


def test_a_dbc_that_says_otherwise_than_the_device_profiles_is_refused_before_the_bus_is_opened(tmp_path: Path) -> None:
    text = (contract_folder() / "arm.dbc").read_text()
    other = tmp_path / "other.dbc"
    other.write_text(text.replace("SG_ torque : 16|32@1- (1e-06,0)", "SG_ torque : 16|32@1- (1e-05,0)"))
    played = run_on_vcan(tmp_path, "--dbc", str(other), "--clock", "lockstep")
    (complaint,) = played.error_lines
    assert played.status == USAGE
    assert "Sensor1Torque: scales" in complaint
    assert not played.log.exists()


def test_a_scale_that_the_sensors_own_eds_contradicts_is_refused_before_the_arm_moves(tmp_path: Path) -> None:
    played = adacd_hil(tmp_path, "demo", "--config", str(other_contract(tmp_path)), "--out", "run")
    assert played.status == BUS_MISSING
    assert "decimal digits 0x6132:1 = 6, 5 expected; correct `scale.torque_Nm`" in played.error_lines[-1]


@pytest.mark.long
@pytest.mark.vcan
def test_devices_with_another_contract_are_refused_before_the_arm_moves(tmp_path: Path) -> None:
    config = other_contract(tmp_path)
    with emulator(tmp_path, "--scenario", "idle"):
        played = run_on_vcan(tmp_path, "--config", str(config), "--clock", "lockstep")
    (complaint,) = played.error_lines
    assert played.status == BUS_MISSING
    assert re.search(r"layout digest 0x[0-9A-F]{8} is not the DBC's 0x[0-9A-F]{8}", complaint)
    assert read_log(played.log).is_complete


@pytest.mark.long
@pytest.mark.vcan
def test_an_emulator_that_stops_mid_run_is_a_safety_stop_in_lockstep(tmp_path: Path) -> None:
    with emulator(tmp_path, "--scenario", "idle") as process:
        played = run_while_killing(tmp_path, process, "--clock", "lockstep")
    assert played.status == SAFETY_STOP
    (complaint,) = played.error_lines
    assert "no answer from Drive1, Drive2, Sensor1, Sensor2 to SYNC of cycle" in complaint
    assert read_log(played.log).is_complete
