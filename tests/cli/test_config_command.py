"""`config show|check|docs`: where each value is from, all that is wrong at once, what a key means."""

import json
from pathlib import Path

import pytest
from called import called
from click.testing import Result

from adacd_hil.lab.commission.host_checks import Status, configuration_checks
from adacd_hil.settings.configuration_files import configuration_layers, load_settings
from adacd_hil.settings.toml_files import builtin_names
from adacd_hil.wire.dbc_contract import contract_folder

USAGE = 2


def config(*arguments: str) -> Result:
    return called("config", *arguments)


def shown(*arguments: str) -> dict[str, tuple[str, str]]:
    """Value and origin of each key that `show` tells."""
    result = config("show", "--json", *arguments)
    assert result.exit_code == 0
    return {row["key"]: (row["value"], row["origin"]) for row in json.loads(result.stdout)}


def test_each_value_is_told_with_where_it_is_from(tmp_path):
    own_arm = str(tmp_path / "my-arm.toml")
    Path(own_arm).write_text('extends = "certified"\n[arm]\nlink_length_m = [0.4, 0.25]\ncad_theta = []\n')
    told = shown("--config", own_arm, "--set", "filter.a_rad_s=12")
    assert told["arm.link_length_m"] == ("[0.4, 0.25]", own_arm)
    assert told["filter.a_rad_s"] == ("12", "--set")
    assert told["reaction.start"] == ('"measured"', "certified")
    assert told["filter.b_rad_s"] == ("10", "paper")
    assert told["controller.Kp"] == ("[250, 20]", "paper [profiles.P]")
    assert told["log.part_MiB"] == ("512", "default")
    changed = shown("--config", own_arm, "--changed", "arm", "log")
    assert changed == {"arm.link_length_m": ("[0.4, 0.25]", own_arm)}
    told = shown("--profile", "S", "arm.profile", "controller.Kp")
    assert told == {"arm.profile": ('"S"', "--profile"), "controller.Kp": ("[500, 40]", "paper [profiles.S]")}


@pytest.mark.parametrize("name", builtin_names())
def test_what_comes_with_the_package_has_no_error_and_no_unknown_warning(name):
    drives = ("Drive1", "Drive2") if name == "fd_500us" else ()  # what the loop needs, and no more
    warned = [
        f"{name}: warning: no frame of {drive} carries `torque_actual`: nothing watches for the fault TORQUE"
        for drive in drives
    ]
    result = config("check", name)
    assert (result.exit_code, result.stdout.splitlines()) == (0, [*warned, f"{name}: 0 errors, {len(warned)} warnings"])


def test_a_contract_without_a_bit_rate_is_an_error_of_its_configuration_alone(tmp_path):
    dbc = (contract_folder() / "arm.dbc").read_text().replace('BA_ "Baudrate" 1000000;', 'BA_ "Baudrate" 0;')
    (tmp_path / "slow.dbc").write_text(dbc)
    (tmp_path / "slow.toml").write_text('extends = "certified"\n[devices]\ncontract = "slow.dbc"\n')
    result = config("check", str(tmp_path / "slow.toml"), "certified")
    assert result.exit_code == USAGE
    assert ["Baudrate" in line for line in result.stdout.splitlines()] == [True, False, False]


def test_all_errors_are_told_at_once(tmp_path):
    path = tmp_path / "bad.toml"
    path.write_text(
        "[arm]\nlink_length_m = [350, 300]\nrated_torque = [12, 6]\n[bus]\nperiod_us = 1\n"
        "[certified]\nsigmas = 5.0\n[safety]\ncommission_cycles = 200\n"
        "[operator]\nscript = [{ at_s = -1, request = 'finsh' }, { request = 'finish' }]\n"
    )
    result = config("check", str(path))
    assert result.exit_code == USAGE
    lines = [line.removeprefix(f"{path}: ") for line in result.stdout.splitlines()]
    assert lines == [
        "error: unknown key `arm.rated_torque`; did you mean `arm.rated_torque_Nm`?",
        "error: `arm.link_length_m[0]` = 350.0 m is above 5 m; 350 mm are 0.35 m",
        "error: `bus.period_us` = 1 µs is below 500 µs; 1 ms are 1000 µs",
        "error: unknown key `certified.sigmas`; its successor is `certified.noise_sigmas` and `certified.model_sigmas`",
        "error: `operator.script[0].at_s` = -1.0 s is below 0 s",
        "error: `operator.script[0].request` = 'finsh' must be one of payload, payload_changed, finish; "
        "did you mean 'finish'?",
        "error: missing key `operator.script[1].at_s`",
        "error: unknown key `safety.commission_cycles`; its successor is `safety.commission_s`",
        "8 errors, 0 warnings",
    ]


LENGTHS = "[arm]\nlink_length_m = [0.4, 0.3]"


@pytest.mark.parametrize(
    ("text", "status", "line"),
    [
        (
            "[arm]\ntorque_limit_Nm = [12, 7]",
            0,
            "`arm.torque_limit_Nm[1]` = 7 Nm exceeds `arm.rated_torque_Nm[1]` = 6 Nm",
        ),
        (
            "[detector]\nthreshold_Nm = [1, 7]",
            0,
            "`detector.threshold_Nm[1]` = 7 Nm exceeds `arm.rated_torque_Nm[1]` = 6 Nm",
        ),
        ("[reaction]\nvelocity_limit_deg_s = [300, 300]", 0, "`reaction.velocity_limit_deg_s[0]` = 300 deg/s exceeds"),
        (
            "[reaction]\ncollision = ['none', 'none']",
            0,
            "`reaction.collision` = ['none', 'none'] has no effect: with scheme paper",
        ),
        (LENGTHS, 0, "`arm.cad_theta` is that of an emulated arm, from paper [profiles.P]"),
        (LENGTHS, 0, "`controller.Kp` is that of an emulated arm"),
        ("[filter]\na_rad_s = 11", 0, "the scheme is the paper's"),
        ("[devices]\nbitrate = 500000", 0, "`devices.contract` = 'arm' has 1000000 bit/s"),
        ("assumed = ['arm.link_length_m']", 0, "assumed, not known: `arm.link_length_m`"),
        ("assumed = ['arm.link_length']", 0, "`assumed` names no setting: unknown key `arm.link_length`; did you mean"),
        ("[arm]\nposition_limit_deg = [1.31, 2.09]", USAGE, "looks like rad; in degrees that would be 75.1 and 120"),
        ("[arm]\nposition_limit_deg = [25, 120]", USAGE, "`arm.position_limit_deg[0]` = 25 deg"),
        ("[arm]\nvelocity_limit_deg_s = [90, 300]", USAGE, "`arm.velocity_limit_deg_s[0]` = 90 deg/s"),
        ("[trajectory]\nhalf_period_s = [0.5, 4.5]", USAGE, "`reaction.acceleration_limit_deg_s2[0]` = 700 deg/s²"),
        (
            "[excitation]\nperiod_s = 3.0\nsine = [[2.0, -1.0], [0.0, 0.0]]\ncosine = [[0.0, 0.0], [0.0, 0.0]]\n",
            USAGE,
            "`arm.position_limit_deg[0]` = 75 deg",
        ),
    ],
)
def test_a_likely_mistake_is_a_warning_and_a_motion_that_leaves_the_arm_s_limits_an_error(tmp_path, text, status, line):
    path = tmp_path / "odd.toml"
    path.write_text(text)
    result = config("check", str(path))
    assert result.exit_code == status
    assert line in result.stdout


@pytest.mark.parametrize(
    ("text", "status", "reason"),
    [
        ("", Status.OK, ""),
        ("[arm]\ntorque_limit_Nm = [13.0, 6.0]\n", Status.WARNING, "`arm.torque_limit_Nm[0]` = 13 Nm exceeds"),
        (LENGTHS, Status.WARNING, "`arm.cad_theta` is that of an emulated arm"),
        ("[arm]\nvelocity_limit_deg_s = [90, 300]\n", Status.FAILED, "`arm.velocity_limit_deg_s[0]` = 90 deg/s"),
    ],
)
def test_doctor_doubts_a_configuration_as_this_command_does(tmp_path, text, status, reason):
    path = tmp_path / "mine.toml"
    path.write_text(f'extends = "certified"\n{text}')
    layers = configuration_layers(str(path))
    finding = configuration_checks(load_settings(str(path)), layers)[0].run(load_settings(str(path)))
    assert finding.status is status
    assert reason in finding.reason


def test_devices_and_contract_are_looked_at(tmp_path):
    path = tmp_path / "devices.toml"
    path.write_text('[devices]\ndrive = ["stok-drive", "int32-sensor"]\n')
    result = config("check", str(path))
    assert result.exit_code == USAGE
    assert "did you mean 'stock-drive'?" in result.stdout
    assert "int32-sensor is a sensor, a drive is needed" in result.stdout
    path.write_text('[devices]\ndrive = ["stock-drive", "stock-drive"]\n')
    assert "Drive1" in config("check", str(path)).stdout


def test_the_guesses_of_a_device_s_profile_are_those_of_the_configuration(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('extends = "certified"\n[devices]\ndrive = ["geared.toml", "maxon-epos4"]\ncontract = ""\n')
    (tmp_path / "geared.toml").write_text('extends = "maxon-epos4"\n[scale]\ngear_ratio = 30\n')
    (warning,) = [line for line in config("check", str(path)).stdout.splitlines() if "assumed" in line]
    assert "`geared.toml: scale.increments_per_joint_rev`" in warning
    assert "`maxon-epos4: scale.gear_ratio`" in warning
    assert "`geared.toml: scale.gear_ratio`" not in warning
    checks = {check.name: check for check in configuration_checks(load_settings(str(path)))}
    outcome = checks["`maxon-epos4: scale.gear_ratio`"].run(load_settings(str(path)))
    assert outcome.status is Status.WARNING
    assert outcome.reason == "26 is a guess"


def test_several_files_are_checked_each():
    result = config("check", "certified", "papper")
    assert result.exit_code == USAGE
    assert result.stdout.splitlines()[0] == "certified: 0 errors, 0 warnings"
    assert "did you mean 'paper'?" in result.stdout


def test_the_profiles_that_are_not_chosen_are_looked_at_too(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("[profiles.bench.arm]\ntypo = 1\n[profiles.S.controller]\nKd = [3, 4]\n")
    result = config("check", str(path))
    assert result.exit_code == USAGE
    found = [line.split(": ") for line in result.stdout.splitlines() if "error: " in line]
    assert {parts[2] for parts in found} == {"--profile bench"}
    assert any("arm.typo" in parts[3] for parts in found)
    assert config("check", str(path), "--profile", "S").exit_code == 0


def test_the_groups_a_group_and_a_key_are_explained():
    assert "certified" in config("docs").stdout
    assert "arm.position_limit_deg" in config("docs", "arm").stdout
    assert config("docs", "certified.noise_sigmas").stdout == (
        "certified.noise_sigmas\n  threshold in deviations of the torque's noise\n  default: 6.5\n  bounds: 1 … 50\n"
    )


def test_the_profile_is_that_of_the_file_and_the_files_outweigh_it(tmp_path):
    base, top = tmp_path / "base.toml", tmp_path / "top.toml"
    base.write_text("[controller]\nKp = [1, 2]\n[profiles.S]\ncontroller.Kd = [3, 4]\n")
    top.write_text('extends = "base.toml"\n[arm]\nprofile = "S"\n')
    settings = load_settings(str(top))
    assert settings.arm.profile == "S"
    assert (settings.controller.Kp, settings.controller.Kd) == ((1.0, 2.0), (3.0, 4.0))
    assert settings.name == "top"
