"""The devices of a run, from the attachments of its log: whatever became of their files."""

import dataclasses
from pathlib import Path

import pytest

from adacd_hil.device.attached_devices import device_attachments
from adacd_hil.device.device_files import load_profile, logged_devices, place_devices
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.toml_text import to_toml
from adacd_hil.wire.dbc_contract import contract_folder


def own_drive(folder: Path, name: str, eds: bytes) -> Path:
    """Write a drive's profile and its EDS."""
    folder.mkdir()
    (folder / name).write_bytes(eds)
    profile = dataclasses.replace(load_profile("stock-drive", "drive").settings, eds=name)
    (folder / "drive.toml").write_text(to_toml(profile))
    return folder / "drive.toml"


@pytest.mark.parametrize("name", ["stock", "fd", "fd_500us", "certified"])
def test_the_attached_devices_are_those_of_the_run(name: str) -> None:
    settings = load_settings(name)
    run = place_devices(settings)
    attached = logged_devices(settings, device_attachments(run))
    assert attached is not None
    for mine, theirs in zip(attached, run, strict=True):
        assert (mine.name, mine.node_id, mine.joint) == (theirs.name, theirs.node_id, theirs.joint)
        assert mine.settings == theirs.settings
        assert mine.profile.eds_bytes == theirs.profile.eds_bytes


@pytest.mark.parametrize("name", ["mine.eds", "Drive2.eds"])
def test_two_files_of_one_name_are_kept_apart(tmp_path: Path, name: str) -> None:
    eds = (contract_folder() / "stock_drive.eds").read_bytes()
    files = own_drive(tmp_path / "a", name, eds), own_drive(tmp_path / "b", name, eds + b"\n; another\n")
    stock = load_settings("stock")
    settings = dataclasses.replace(stock, devices=dataclasses.replace(stock.devices, drive=tuple(map(str, files))))
    run = place_devices(settings)
    for file in files:
        file.unlink()
    first, second, *_ = logged_devices(settings, device_attachments(run)) or ()
    assert second.profile.eds_bytes == first.profile.eds_bytes + b"\n; another\n"


@pytest.mark.parametrize(
    "change",
    [{"Drive2.toml": None}, {"stock_drive.eds": None}, {"Sensor1.toml": b"kind = "}, {"Drive1.toml": b"unknown = 1\n"}],
    ids=lambda change: str(*change),
)
def test_attachments_that_lack_a_device_give_none(change: dict[str, bytes | None]) -> None:
    settings = load_settings("stock")
    changed = {**device_attachments(place_devices(settings)), **change}
    attachments = {name: data for name, data in changed.items() if data is not None}
    assert logged_devices(settings, attachments) is None


def test_an_eds_is_found_by_its_name_alone() -> None:
    settings = load_settings("stock")
    attachments = device_attachments(place_devices(settings))
    text = attachments["Drive1.toml"].replace(b'eds = "stock_drive.eds"', b'eds = "../stock_drive.eds"')
    assert text != attachments["Drive1.toml"]
    first, *_ = logged_devices(settings, {**attachments, "Drive1.toml": text}) or ()
    assert first.profile.eds_bytes == attachments["stock_drive.eds"]
