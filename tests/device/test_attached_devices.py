"""The devices of a run, from the attachments of its log: whatever became of their files."""

import dataclasses
from pathlib import Path

import pytest

from adacd_hil.device.attached_devices import device_attachments, with_attached_devices
from adacd_hil.device.profile import load_profile, place_devices
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.toml_text import to_toml
from adacd_hil.wire.dbc_contract import contract_folder


def with_drives(settings: Settings, first: Path, second: Path) -> Settings:
    return dataclasses.replace(settings, devices=dataclasses.replace(settings.devices, drive=(str(first), str(second))))


def own_drive(folder: Path, eds: bytes) -> Path:
    """Write a drive's profile and its EDS, which has the same name in every folder."""
    folder.mkdir()
    (folder / "mine.eds").write_bytes(eds)
    profile = dataclasses.replace(load_profile("stock-drive", "drive").settings, eds="mine.eds")
    (folder / "drive.toml").write_text(to_toml(profile))
    return folder / "drive.toml"


@pytest.mark.parametrize("name", ["stock", "fd", "fd_500us", "certified"])
def test_the_attached_devices_are_those_of_the_run(tmp_path: Path, name: str) -> None:
    settings = load_settings(name)
    attached = with_attached_devices(settings, device_attachments(settings), tmp_path)
    assert {Path(file).parent for file in (*attached.devices.drive, *attached.devices.sensor)} == {tmp_path}
    for mine, theirs in zip(place_devices(attached), place_devices(settings), strict=True):
        assert (mine.name, mine.node_id, mine.joint) == (theirs.name, theirs.node_id, theirs.joint)
        assert mine.settings == theirs.settings
        assert mine.profile.eds.read_bytes() == theirs.profile.eds.read_bytes()


def test_two_files_of_one_name_are_kept_apart(tmp_path: Path) -> None:
    eds = (contract_folder() / "stock_drive.eds").read_bytes()
    files = own_drive(tmp_path / "a", eds), own_drive(tmp_path / "b", eds + b"\n; another\n")
    settings = with_drives(load_settings("stock"), *files)
    attachments = device_attachments(settings)
    for file in files:
        file.unlink()
    there = tmp_path / "there"
    there.mkdir()
    first, second, *_ = place_devices(with_attached_devices(settings, attachments, there))
    assert second.profile.eds.read_bytes() == first.profile.eds.read_bytes() + b"\n; another\n"


@pytest.mark.parametrize(
    "change",
    [{"Drive2.toml": None}, {"stock_drive.eds": None}, {"Sensor1.toml": b"kind = "}, {"Drive1.toml": b"unknown = 1\n"}],
    ids=lambda change: str(*change),
)
def test_attachments_that_lack_a_device_leave_the_settings_as_they_are(
    tmp_path: Path, change: dict[str, bytes | None]
) -> None:
    settings = load_settings("stock")
    changed = {**device_attachments(settings), **change}
    attachments = {name: data for name, data in changed.items() if data is not None}
    assert with_attached_devices(settings, attachments, tmp_path) == settings


def test_no_attachment_is_written_outside_the_folder(tmp_path: Path) -> None:
    settings = load_settings("stock")
    attachments = device_attachments(settings)
    text = attachments["Drive1.toml"].replace(b'eds = "stock_drive.eds"', b'eds = "../stock_drive.eds"')
    assert text != attachments["Drive1.toml"]
    there = tmp_path / "there"
    there.mkdir()
    with_attached_devices(settings, {**attachments, "Drive1.toml": text}, there)
    assert list(tmp_path.iterdir()) == [there]
