"""Device profiles: what is wrong with one is one line that names it."""

import dataclasses
import tomllib
from importlib import resources
from pathlib import Path

import pytest
from eds_variants import EdsVariant
from loaded import loaded_contract
from own_arm import OWN_SENSOR

from adacd_hil.device.device_files import load_profile, profile_names
from adacd_hil.device.eds_file import read_eds
from adacd_hil.device.profile import ProfileSettings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.toml_files import parse_toml
from adacd_hil.settings.toml_text import to_short_toml, to_toml
from adacd_hil.wire.dbc_contract import contract_folder

HEADED = OWN_SENSOR.replace(
    "[scale]", 'protection = "P05"\nheader = ["0x2100:1", "0x2100:2", "0x2100:3"]\n[scale]'
).replace('signal = "torque" }', 'signal = "torque" }, { object = "0x2111", signal = "e2e_counter" }')
HEADED += 'data_ids = ["0001", "0002"]\n'


def profile_file(folder: Path, text: str) -> str:
    path = folder / "mine.toml"
    path.write_text(text)
    return str(path)


@pytest.mark.parametrize("name", profile_names())
def test_a_profile_written_as_toml_reads_back_to_the_same(name: str) -> None:
    profile = load_profile(name, "sensor" if "sensor" in name else "drive").settings
    for write in (to_toml, to_short_toml):
        assert parse(ProfileSettings, parse_toml(write(profile))) == profile


def test_a_users_file_is_a_profile_and_an_eds_beside_it_comes_first(tmp_path: Path) -> None:
    profile = load_profile(profile_file(tmp_path, OWN_SENSOR), "sensor")
    assert (profile.name, profile.eds.name, profile.settings.pdo[0].mapping_index) == (
        "mine",
        "torque_sensor.eds",
        0x1A00,
    )
    (tmp_path / "torque_sensor.eds").write_text("")
    assert load_profile(profile_file(tmp_path, OWN_SENSOR), "sensor").eds == tmp_path / "torque_sensor.eds"


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (("kind", "kin"), "unknown key `kin`; did you mean `kind`?"),
        (('"sensor"', '"senor"'), "`kind` = 'senor' must be one of drive, sensor; did you mean 'sensor'?"),
        (("torque_sensor.eds", "none.eds"), "eds = 'none.eds' is neither beside it nor in dbc/"),
        (("0x9130:1", "9130h"), "object '9130h' must be like 0x6064 or 0x9130:1"),
        (("0x9130:1", "0x19130:1"), "must be within 0x0001 to 0xFFFF:255"),
        (('"torque"', '"load"'), "no frame carries torque"),
        (('"Torque"', '"Feedback"'), "a sensor needs Torque"),
        (("cob_id = 0x180", "cob_id = 0x80"), "= 0x80 is below 0x180"),
        (("torque_Nm = 1e-6", ""), "a sensor needs torque_Nm"),
        (("[scale]", 'protection = "P02"\n[scale]'), "header has 0 objects, P02 takes 2"),
        (("cob_id", 'data_ids = ["00", "11"]\ncob_id'), "data_ids need protection P02 or P05"),
        ((OWN_SENSOR, HEADED), "signal 'e2e_counter' has the name of a part of the header"),
        (("[scale]", "features = ['sync_conter']\n[scale]"), "did you mean 'sync_counter'?"),
        (("[scale]", "serial = [1]\n[scale]"), "serial has 1 numbers, 2 expected"),
        (("[scale]", "[scale]\ngear_ratio = 2"), "`scale.gear_ratio` has no effect: this is a sensor"),
        (("[scale]", "quick_stop_option = 2\n[scale]"), "`quick_stop_option` has no effect: this is a sensor"),
        (('"0x9130:1", signal = "torque"', '"0x6064", signal = "velocity"'), "'velocity': object 0x6064 is 'position'"),
        (("[scale]", 'setup = [{object = "0x6040", value = 6}]\n[scale]'), "object '0x6040' commands the drive"),
        (("[scale]", 'setup = [{object = "0x60B2", value = 9}]\n[scale]'), "object '0x60B2' commands the drive"),
    ],
)
def test_a_profile_that_cant_be_used_is_one_line(tmp_path: Path, change: tuple[str, str], line: str) -> None:
    with pytest.raises(ConfigError) as raised:
        load_profile(profile_file(tmp_path, OWN_SENSOR.replace(*change)), "sensor")
    assert line in str(raised.value)
    assert "\n" not in str(raised.value)


DRIVE = resources.files("adacd_hil") / "device_profiles" / "stock-drive.toml"


def test_a_drive_has_no_key_of_a_sensor() -> None:
    table = tomllib.loads(DRIVE.read_text())
    table["plausibility"]["torque_range_Nm"] = 9.0
    with pytest.raises(ConfigError, match=r"`plausibility.torque_range_Nm` has no effect: this is a drive"):
        parse(ProfileSettings, table)


@pytest.mark.parametrize(
    ("signal", "frame", "line"),
    [
        ("velocity", "Status", "pdo Status: velocity must be in Feedback, in one PDO with position"),
        ("position", "Status", "pdo Status: position must be in Feedback, in one PDO with velocity"),
        ("target_torque", "Feedback", "pdo Feedback: target_torque must be in Command, in one PDO with controlword"),
        ("controlword", "Status", "pdo Status: controlword must be in Command, in one PDO with target_torque"),
    ],
)
def test_what_is_one_sample_or_one_command_travels_in_one_frame(
    tmp_path: Path, signal: str, frame: str, line: str
) -> None:
    table = tomllib.loads(DRIVE.read_text())
    rows = {pdo["message"]: pdo["signals"] for pdo in table["pdo"]}
    (moved,) = (row for signals in rows.values() for row in signals if row["signal"] == signal)
    for signals in rows.values():
        if moved in signals:
            signals.remove(moved)
    rows[frame].append(moved)
    with pytest.raises(ConfigError) as caught:
        parse(ProfileSettings, table)
    assert line in str(caught.value)


@pytest.mark.parametrize("transmission", [0, 2, 255])
def test_a_sample_comes_on_every_sync(transmission: int) -> None:
    table = tomllib.loads(DRIVE.read_text())
    (feedback,) = (pdo for pdo in table["pdo"] if pdo["message"] == "Feedback")
    feedback["transmission"] = transmission
    with pytest.raises(ConfigError, match=f"transmission = {transmission} must be 1, on every SYNC"):
        parse(ProfileSettings, table)


def test_a_misspelt_name_is_told_the_nearest() -> None:
    with pytest.raises(ConfigError, match="did you mean 'stock-drive'"):
        load_profile("stock-drvie", "drive")


def test_a_sensor_is_no_drive() -> None:
    with pytest.raises(ConfigError, match="int32-sensor is a sensor, a drive is needed"):
        load_profile("int32-sensor", "drive")


def test_two_devices_cant_share_a_node_id(tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_text("[devices]\ndrive_node = [1, 3]\n")
    with pytest.raises(ConfigError, match="node ids 1, 3, 3, 4 of drives and sensors must differ"):
        load_settings(str(path))


EDS = (contract_folder() / "torque_sensor.eds").read_text()
VENDOR = "[1018sub1]"


def with_default(value: str) -> str:
    """Give the sensor's EDS with another default of its vendor id."""
    head, section, tail = EDS.partition(VENDOR)
    assert section
    return head + section + tail.replace("DefaultValue=0x41444143", f"DefaultValue={value}", 1)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (with_default("0x4144zz"), r"\[1018sub1\] DefaultValue = '0x4144zz' is no integer"),
        (with_default("ten"), r"\[1018sub1\] DefaultValue = 'ten' is no integer"),
        (with_default("1e5"), r"\[1018sub1\] DefaultValue = '1e5' is no integer"),
        (with_default("1\nLowLimit=--1"), r"\[1018sub1\] LowLimit = '--1' is no integer"),
        (EDS.replace("VendorName=", "VendorName=\x1b[2J", 1), r"line \d+ has the control character 0x1B"),
        (EDS.encode("utf-16-le").decode("latin-1"), "line 1 has the control character 0x00"),
        (EDS.replace("DataType=0x0007", "DataType=UNSIGNED32", 1), r"\[1000\] DataType = 'UNSIGNED32' is no integer"),
        ("", "no object is in it"),
    ],
)
def test_what_canopen_would_read_over_in_an_eds_is_one_line(text: str, line: str, tmp_path: Path) -> None:
    path = tmp_path / "x.eds"
    path.write_text(text, newline="")
    with pytest.raises(ConfigError, match=rf"^EDS {path}: {line}$"):
        read_eds(path, 3)


NUMBERS = {"0": 0, "-5": -5, "0X41": 0x41, "$NODEID+0x180": 0x183, "0x180 + $NODEID": 0x183, "0x1 ; say": 1}
NUMBERS |= dict.fromkeys(("", "010", "$NODEID"))  # canopen makes nothing of these, and doesn't refuse them


@pytest.mark.parametrize(("value", "default"), NUMBERS.items())
def test_numbers_as_vendors_write_them_are_no_error(value: str, default: int | None, tmp_path: Path) -> None:
    (tmp_path / "x.eds").write_bytes(b"\xef\xbb\xbf" + with_default(value).encode())
    assert read_eds(tmp_path / "x.eds", 3)[0x1018][1].default == default


def test_a_float_is_not_read_as_an_integer(tmp_path: Path) -> None:
    eds = (contract_folder() / "int32_sensor.eds").read_text()
    torque = eds.index("[9130sub1]")
    (tmp_path / "torque_sensor.eds").write_text(
        eds[:torque] + eds[torque:].replace("DataType=0x0004", "DataType=0x0008")
    )
    sensor = profile_file(tmp_path, OWN_SENSOR.replace("1e-6", "1.0"))
    devices = dataclasses.replace(load_settings("certified").devices, sensor=(sensor, sensor), contract="")
    with pytest.raises(
        ConfigError, match=r"0x9130:1 \(AI input PV 32 bit, AI input PV 1\) is a float, REAL32; .* integers"
    ):
        loaded_contract(dataclasses.replace(load_settings("certified"), devices=devices))


@pytest.mark.parametrize("section", ["2100sub1", "9130sub1"])
def test_an_object_of_a_frame_that_its_eds_lets_no_pdo_carry_is_named(section: str, tmp_path: Path) -> None:
    EdsVariant("torque_sensor.eds").with_value("0", section, key="PDOMapping").write(tmp_path / "torque_sensor.eds")
    own = (resources.files("adacd_hil") / "device_profiles" / "adacd-sensor.toml").read_text()
    sensor = profile_file(tmp_path, own)
    settings = load_settings("certified")
    devices = dataclasses.replace(settings.devices, sensor=(sensor, sensor))
    with pytest.raises(
        ConfigError, match=rf"0x{section[:4]}:1 \(.*\) fits no PDO: PDOMapping=0 in .*torque_sensor.eds"
    ):
        loaded_contract(dataclasses.replace(settings, devices=devices))


def test_a_profile_extends_another_section_by_section(tmp_path: Path) -> None:
    (tmp_path / "base.toml").write_text(
        DRIVE.read_text().replace("[scale]", 'assumed = ["scale.gear_ratio", "scale.velocity_rad_s"]\n\n[scale]')
    )
    mine = profile_file(tmp_path, 'extends = "base.toml"\n[scale]\ngear_ratio = 26\n')
    settings = load_profile(mine, "drive").settings
    assert (settings.scale.gear_ratio, settings.scale.increments_per_joint_rev) == (26.0, 1048576)
    assert settings.assumed == ("scale.velocity_rad_s",)
    assert [pdo.message for pdo in settings.pdo] == ["Feedback", "Status", "Command"]


STATUS = """
[[pdo]]
message = "Status"
number = {}
cob_id = 0x280
transmission = 255
signals = [{{ object = "0x6041", signal = "statusword" }}]
"""


def test_a_frame_of_an_extending_profile_replaces_that_one_alone(tmp_path: Path) -> None:
    base = load_profile("stock-drive", "drive").settings
    mine = profile_file(tmp_path, 'extends = "stock-drive"\n' + STATUS.format(3))
    found = {pdo.message: pdo for pdo in load_profile(mine, "drive").settings.pdo}
    assert (found["Feedback"], found["Command"]) == (base.pdo[0], base.pdo[2])
    assert (found["Status"].number, len(found["Status"].signals), len(found)) == (3, 1, 3)


@pytest.mark.parametrize(
    ("frames", "line"),
    [
        (STATUS.format(1), "pdo Status: number = 1 is that of Feedback, too"),
        (STATUS.format(2) * 2, "a drive has Feedback, Command and perhaps Status, once each"),
        (STATUS.format(2).replace("Status", "State"), "must be one of Feedback, Status, Command, Torque"),
        ("pdo = [1]\n", "must be a table"),
    ],
)
def test_a_frame_of_an_extending_profile_that_cant_be_is_one_line(tmp_path: Path, frames: str, line: str) -> None:
    with pytest.raises(ConfigError, match=line):
        load_profile(profile_file(tmp_path, 'extends = "stock-drive"\n' + frames), "drive")


def test_profiles_that_extend_each_other_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "other.toml").write_text('extends = "mine.toml"\n')
    with pytest.raises(ConfigError, match="at most 8 in a row"):
        load_profile(profile_file(tmp_path, 'extends = "other.toml"\n'), "drive")
