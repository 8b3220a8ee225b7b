"""Contracts composed from device profiles, against the DBC files written by hand."""

import dataclasses
import warnings
from pathlib import Path

import cantools
import pytest
from loaded import loaded_contract

import adacd_hil
from adacd_hil.control.session import write_contract
from adacd_hil.device.contract import compose
from adacd_hil.device.device_files import place_devices
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.schema import ConfigError
from adacd_hil.wire.budget import compute_budget
from adacd_hil.wire.dbc_contract import contract_folder, load_codec

DRIVE_PROFILE = Path(adacd_hil.__file__).parent / "device_profiles" / "adacd-drive.toml"
CONFIGURATIONS = ("paper", "fd", "fd_500us", "stock")


def layout(path_or_text: str) -> dict[str, object]:
    """What cantools reads of a DBC: when each frame is sent, where each signal lies and what it is worth."""
    database = cantools.database.load_string(path_or_text, "dbc")
    return {
        message.name: (
            message.frame_id,
            message.length,
            message.senders,
            message.dbc.attributes["Trigger"].value,
            [
                (s.name, s.start, s.length, s.is_signed, s.byte_order, float(s.scale), float(s.offset), s.unit or "")
                for s in sorted(message.signals, key=lambda s: s.start)
            ],
        )
        for message in database.messages
    }


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_profiles_compose_to_the_dbc_bit_for_bit(name: str) -> None:
    settings = load_settings(name)
    by_hand = load_codec(contract_folder() / f"{settings.devices.contract}.dbc")
    composed = compose(settings, place_devices(settings))
    assert layout(composed.text.decode()) == layout(by_hand.text.decode())
    assert composed.layout_digest == by_hand.layout_digest
    assert compute_budget(composed).frames == compute_budget(by_hand).frames


def test_cantools_reads_a_composed_contract_without_a_warning() -> None:
    settings = load_settings("paper")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        text = compose(settings, place_devices(settings)).text.decode()
        database = cantools.database.load_string(text, "dbc", strict=True)
    assert database.dbc.attributes["BusPeriod_us"].value == 1000


@pytest.mark.slow
@pytest.mark.parametrize("config", CONFIGURATIONS)
def test_a_contract_moves_to_the_configured_node_ids_and_is_what_the_profiles_say(config: str) -> None:
    bus, devices = load_settings(config).bus, load_settings(config).devices
    bus = dataclasses.replace(bus, host_node=126)
    devices = dataclasses.replace(devices, drive_node=(5, 6), sensor_node=(7, 8))
    named = dataclasses.replace(load_settings(config), bus=bus, devices=devices)
    composed = dataclasses.replace(named, devices=dataclasses.replace(devices, contract=""))
    codec = loaded_contract(named)
    assert (codec.message("Sensor2Torque").can_id, codec.message("HostHeartbeat").can_id) == (0x188, 0x77E)
    assert codec.layout_digest == loaded_contract(composed).layout_digest


def test_a_contract_without_a_file_gets_one_for_the_log_and_is_not_mistaken_for_another(tmp_path: Path) -> None:
    codec = loaded_contract(parse(Settings, {"devices": {"drive_node": [5, 6], "sensor_node": [7, 8]}}))
    written = write_contract(codec, tmp_path)
    assert written == tmp_path / "arm.dbc"
    assert load_codec(written).layout_digest == codec.layout_digest
    assert write_contract(codec, tmp_path) == written
    (tmp_path / "arm.dbc").write_bytes(load_codec().text)
    with pytest.raises(FileExistsError, match="another one is there already"):
        write_contract(codec, tmp_path)
    assert written.read_bytes() == load_codec().text
    composed = loaded_contract(parse(Settings, {"devices": {"contract": ""}}))
    assert write_contract(composed, tmp_path) == tmp_path / "contract.dbc"
    assert load_codec(tmp_path / "contract.dbc").layout_digest == load_codec().layout_digest
    assert write_contract(load_codec(), tmp_path) == load_codec().path  # it has a file


def test_a_misspelt_contract_is_told_the_nearest() -> None:
    with pytest.raises(ConfigError, match="did you mean 'arm'"):
        loaded_contract(parse(Settings, {"devices": {"contract": "amr"}}))


@pytest.mark.parametrize(
    ("devices", "change", "line"),
    [
        (
            {},
            ("(1e-06,0)", "(1e-05,0)"),
            "Sensor1Torque: scales torque .* by the device profile, torque .* by contract",
        ),
        ({}, ("(1e-06,0)", "(1e999,0)"), "torque inf by contract"),  # 0 counts would be NaN
        ({"drive_node": [1, 7]}, ("", ""), "Drive2.*: identifier 0x.* by the device profile"),
        ({}, ("SG_ torque_actual", "SG_ torque"), "Drive1Status: signals statusword, mode_display, torque_actual"),
        ({}, ("f5ddf3da", "f5ddf3db"), "data ids or places of signals differ"),
    ],
)
def test_a_contract_that_says_otherwise_than_the_profiles_is_named(
    tmp_path: Path, devices: dict[str, object], change: tuple[str, str], line: str
) -> None:
    text = load_codec().text.decode()
    path = tmp_path / "other.dbc"
    path.write_text(text.replace(*change) if change[0] else text)
    with pytest.raises(ConfigError, match=line):
        loaded_contract(parse(Settings, {"devices": {"contract": str(path), **devices}}))


def writes(name: str, value: int) -> tuple[str, str]:
    """Return the change that gives the profile an extra write at set-up."""
    return "[scale]", f'setup = [{{object = "{name}", value = {value}}}]\n[scale]'


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (("cob_id = 0x280", "cob_id = 0x180"), "both have identifier 0x181"),
        (("0x603F", "0x603E"), r"object 0x603E is not in /.*/drive\.eds"),
        (writes("0x3333", 1), "object 0x3333 is not in"),
        (writes("0x6502", 1), "0x6502 .*AccessType"),
        (writes("0x1008", 1), "0x1008 .* is no number"),
        (writes("0x605A", 40000), "0x605A .* -32768 to 32767"),  # INTEGER16
        (writes("0x2200", 0), "0x2200 .* 1 to 255"),  # LowLimit, HighLimit
        (writes("0x2200", 256), "0x2200 .* 1 to 255"),
    ],
)
def test_a_profile_that_no_contract_can_be_composed_of_is_named(
    tmp_path: Path, change: tuple[str, str], line: str
) -> None:
    path = tmp_path / "own.toml"
    path.write_text(DRIVE_PROFILE.read_text().replace(*change))
    settings = parse(Settings, {"devices": {"drive": [str(path), "adacd-drive"], "contract": ""}})
    with pytest.raises(ConfigError, match=line):
        loaded_contract(settings)
