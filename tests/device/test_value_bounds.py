"""Bounds that a profile sets to further values: the arm stops outside them, and where the values stay away."""

import contextlib
import math
import shutil
import tomllib
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from called import called
from click.testing import Result
from own_arm import OWN_ARM, eds_of_two_channels

from adacd_hil.device.profile import ProfileSettings
from adacd_hil.device.value_bounds import ValueBound
from adacd_hil.log.reader import read_log
from adacd_hil.records import FaultReason, SchemeState
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.toml_text import to_toml
from adacd_hil.wire.dbc_contract import contract_folder

DEVICES = '[devices]\ndrive = ["drive.toml", "drive.toml"]\nsensor = ["sensor.toml", "sensor.toml"]\n'
ARM = OWN_ARM.replace("[devices]\n", DEVICES)
TEMPERATURE = {"object": "0x2031", "signal": "temperature", "unit": "degC", "scale": 0.1, "high": 85.0}
SECOND_TORQUE = {"object": "0x9130:2", "signal": "torque_2", "unit": "Nm", "scale": 2e-5, "of": "torque"}
SECOND_TORQUE |= {"low": -0.2, "high": 0.2}
COLD = {"object": "0x2111", "signal": "temperature", "unit": "degC", "scale": 0.01, "low": -10.0}
HOT_WINDING = 'kind = "object_value", node = "drive2", index = 0x2031, raw = 912'
TWIN = 'kind = "object_value", node = "sensor1", index = 0x9130, sub = 2, raw = 300000'
COLD_SENSOR = 'kind = "object_value", node = "sensor2", index = 0x2111, raw = -2000'
MUTE_STATUS = 'kind = "lose", node = "sensor1", frame = "status"'
ONSET_S = 0.1


def table_of(name: str) -> dict[str, Any]:
    return tomllib.loads((resources.files("adacd_hil") / "device_profiles" / f"{name}.toml").read_text())


def add_signal(profile: dict[str, Any], message: str, row: dict[str, object]) -> None:
    (pdo,) = (pdo for pdo in profile["pdo"] if pdo["message"] == message)
    pdo["signals"].append(row)


def drive_with_a_temperature() -> tuple[dict[str, Any], str]:
    profile = table_of("stock-drive") | {"eds": "drive.eds"}
    add_signal(profile, "Status", TEMPERATURE)
    profile["pdo"][1]["signals"] = [row for row in profile["pdo"][1]["signals"] if row["signal"] != "torque_actual"]
    eds = (contract_folder() / "stock_drive.eds").read_text()
    eds = eds.replace("SupportedObjects=2\n1=0x2211\n2=0x2212", "SupportedObjects=3\n1=0x2211\n2=0x2212\n3=0x2031")
    return (
        profile,
        f"{eds}\n\n[2031]\nParameterName=Winding\nObjectType=0x7\nDataType=0x0003\nAccessType=ro\nPDOMapping=1\n",
    )


def sensor_with_two_channels() -> tuple[dict[str, Any], str]:
    profile = table_of("int32-sensor") | {"eds": "sensor.eds"}
    add_signal(profile, "Torque", SECOND_TORQUE)
    return profile, eds_of_two_channels()


def with_16_bits(eds: str) -> str:
    head = eds.index("[9130sub2]")
    return (eds[:head] + eds[head:].replace("DataType=0x0004", "DataType=0x0003", 1)).replace(
        "0x91300220", "0x91300210"
    )


def sensor_with_a_temperature() -> tuple[dict[str, Any], str]:
    profile = table_of("adacd-sensor") | {"eds": "sensor.eds"}
    add_signal(profile, "Status", COLD)
    return profile, (contract_folder() / "torque_sensor.eds").read_text()


def write_profile(folder: Path, name: str, profile: dict[str, Any], eds: str) -> None:
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.eds").write_text(eds)
    (folder / f"{name}.toml").write_text(to_toml(parse(ProfileSettings, profile)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bounds")
    profile, eds = sensor_with_two_channels()
    write_profile(folder, "drive", *drive_with_a_temperature())
    write_profile(folder, "sensor", profile, eds)
    write_profile(folder / "warm", "sensor", *sensor_with_a_temperature())
    write_profile(folder / "narrow", "sensor", profile, with_16_bits(eds))
    (folder / "arm.toml").write_text(ARM)
    for kind in ("warm", "narrow"):
        (folder / f"{kind}-arm.toml").write_text(ARM.replace('"sensor.toml"', f'"{kind}/sensor.toml"'))
    return folder


def demo(folder: Path, name: str, *faults: str, arm: str = "arm") -> Result:
    """Play half a second of the arm with faults."""
    rows = "".join(f"[[faults]]\n{fault}\n".replace(", ", "\n") for fault in faults)
    (folder / f"{name}.toml").write_text(f"lasts_s = 0.5\nstart_deg = [-30.0, -60.0]\n{rows}")
    with contextlib.chdir(folder):
        return called("demo", "--config", f"{arm}.toml", "--scenario", f"{name}.toml", "--out", name)


def play(folder: Path, name: str, *faults: str, arm: str = "arm") -> tuple[FaultReason, int | None, str]:
    """Play; return the fault, the ms from onset to it, and the text on stderr."""
    ran = demo(folder, name, *faults, arm=arm)
    scheme = read_log(folder / name / "run.mcap").scheme
    fault = FaultReason(int(scheme["fault"].max()))
    began = scheme["cycle"][np.flatnonzero(scheme["state"] == SchemeState.ADAPT)]
    ended = scheme["cycle"][np.flatnonzero(scheme["state"] == SchemeState.FAULT)]
    cycles = int(ended[0] - began[0]) - round(ONSET_S * 1000) if len(began) and len(ended) else None
    return fault, cycles, ran.stderr


def test_values_within_their_bounds_stop_no_arm(folder: Path) -> None:
    assert play(folder, "well")[0] is FaultReason.NONE
    assert play(folder, "warm-well", arm="warm-arm")[0] is FaultReason.NONE


@pytest.mark.parametrize(
    ("name", "fault", "reason", "latest", "line"),
    [
        ("hot", HOT_WINDING, FaultReason.DRIVE, 100, "Drive2: temperature 91.2 degC, at most 85 allowed"),
        ("twin", TWIN, FaultReason.SENSOR, 1, "Sensor1: torque_2 - torque"),
        ("cold", COLD_SENSOR, FaultReason.SENSOR, 100, "Sensor2: temperature -20 degC, at least -10 allowed"),
        ("mute", MUTE_STATUS, FaultReason.SENSOR, 260, "Sensor1: no status for more than 250 cycles"),
    ],
)
def test_a_value_outside_its_bounds_or_one_that_stays_away_stops_the_arm(
    folder: Path, name: str, fault: str, reason: FaultReason, latest: int, line: str
) -> None:
    arm = "warm-arm" if name in ("cold", "mute") else "arm"
    found, cycles, said = play(folder, name, f"{fault}, at_s = {ONSET_S}", arm=arm)
    assert found is reason
    assert cycles is not None
    assert -2 <= cycles <= latest  # the drives are enabled two cycles before the host moves
    assert line in said
    with contextlib.chdir(folder / name):  # the frames are decoded and judged again, by the profiles in the log
        replayed = called("replay", "--frames", "run.mcap")
    assert replayed.exit_code == 0, replayed.output


def test_no_arm_is_enabled_before_a_bounded_value_has_come(folder: Path) -> None:
    fault, cycles, said = play(folder, "never", f'{MUTE_STATUS}, since = "power_on", at_s = 0.0', arm="warm-arm")
    assert (fault, cycles) == (FaultReason.COMMISSION_TIMEOUT, None)
    assert "Sensor1: no status for more than 250 cycles" in said


def test_a_value_outside_its_bounds_before_the_start_is_named_at_once(folder: Path) -> None:
    fault, cycles, said = play(folder, "before", f'{HOT_WINDING}, since = "power_on", at_s = 0.0', arm="arm")
    assert (fault, cycles) == (FaultReason.COMMISSION_TIMEOUT, None)
    log = read_log(folder / "before" / "run.mcap")
    (told_s,) = (each.t_ns * 1e-9 for each in log.events if each.event.name == "bounds")
    assert told_s < 1.0
    assert not np.any(log.control["tau_c"])
    assert said.count("Drive2: temperature 91.2 degC, at most 85 allowed") >= 2  # at once, and as the cause


def test_a_replaced_value_ends_with_its_fault(folder: Path) -> None:
    rows = f'{HOT_WINDING}, since = "power_on", at_s = 0.0, duration_s = 0.1'
    assert play(folder, "cooled", rows)[0] is FaultReason.NONE


def test_an_emulated_second_torque_ends_at_the_range_of_its_object(folder: Path) -> None:
    assert play(folder, "narrow", arm="narrow-arm")[0] is FaultReason.SENSOR  # 16 bits are 0.66 Nm


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ('node = "sensor1", index = 0x2031, raw = 1', "faults[0]: sensor1: has no object 0x2031:0"),
        ('node = "drive1", index = 0x2031, raw = 40000', "object 0x2031:0 can't be 40000, -32768 to 32767 allowed"),
    ],
)
def test_an_object_that_no_device_can_have_is_refused(folder: Path, changes: str, line: str) -> None:
    ran = demo(folder, "wrong", f'kind = "object_value", at_s = 0.1, {changes}')
    assert ran.exit_code == 2
    assert line in ran.stderr
    assert not (folder / "wrong").exists()


@pytest.mark.parametrize(
    ("message", "changes", "line"),
    [
        ("Status", {"of": "torque_2"}, "of = 'torque_2' must be another signal of the frame: statusword, "),
        ("Status", {"of": "temperature"}, "of = 'temperature' must be another signal of the frame"),
        ("Status", {"low": 90.0}, "low = 90 is above high = 85"),
        ("Command", {}, "is the host's own, and can't have `low` or `high`"),
        ("Feedback", {"high": None, "of": "position"}, "`of` needs `low` or `high`"),
        ("Feedback", {"of": "position", "unit": "deg"}, "unit = 'deg' must be that of 'position', 'rad'"),
        ("Status", {"of": "torque_actual"}, "unit = 'degC' must be that of 'torque_actual', 'permille'"),
        ("Feedback", {"unit": 'a"b'}, "unit = 'a\"b' can't have"),
        ("Feedback", {"signal": "wärme"}, "signal 'wärme' must be a name"),
        ("Feedback", {"signal": "SG_"}, "signal 'SG_' must be a name"),
    ],
)
def test_bounds_that_cant_be_are_one_line(message: str, changes: dict[str, object], line: str) -> None:
    profile = table_of("stock-drive")
    row = {key: value for key, value in (TEMPERATURE | changes).items() if value is not None}
    add_signal(profile, message, row)
    with pytest.raises(ConfigError) as raised:
        parse(ProfileSettings, profile)
    assert line in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_bounded_value_of_a_frame_without_a_period_is_refused() -> None:
    profile = table_of("maxon-epos4")
    add_signal(profile, "Status", TEMPERATURE)
    with pytest.raises(ConfigError, match="'temperature': `low` and `high` need event_timer_ms"):
        parse(ProfileSettings, profile)


@pytest.mark.parametrize(
    ("key", "row", "bound"),
    [("high", TEMPERATURE, 3277.0), ("low", TEMPERATURE, -3277.0), ("high", SECOND_TORQUE, 9e4)],
)
def test_a_bound_that_no_value_can_reach_is_refused(
    folder: Path, tmp_path: Path, key: str, row: dict[str, object], bound: float
) -> None:
    file, make, at = (
        ("drive", drive_with_a_temperature, 1) if row is TEMPERATURE else ("sensor", sensor_with_two_channels, 0)
    )
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    profile, _ = make()
    profile["pdo"][at]["signals"][-1] = row | {key: bound}
    (tmp_path / f"{file}.toml").write_text(to_toml(parse(ProfileSettings, profile)))
    with contextlib.chdir(tmp_path):
        checked = called("config", "check", "arm.toml")
    assert checked.exit_code == 2
    assert f"{key} = {bound:g} is outside its range" in checked.output


def test_a_value_without_a_unit_has_no_gap_in_its_line() -> None:
    assert ValueBound("errors", "", 0, None, -math.inf, 3.0).describe([5.0]).startswith("errors 5, ")


def test_a_drive_without_a_scale_is_named_before_its_bounds_are_compared() -> None:
    profile = table_of("stock-drive") | {"scale": {}}
    add_signal(profile, "Feedback", TEMPERATURE | {"of": "position"})
    with pytest.raises(ConfigError, match="a drive needs increments_per_joint_rev"):
        parse(ProfileSettings, profile)
