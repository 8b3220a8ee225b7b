"""The device profiles and EDS files of a run as attachments of its log, and a replay's devices made of them.

The files that the configuration names may have changed since the run, or lie elsewhere.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from adacd_hil.device.profile import PlacedDevice, ProfileSettings, place_devices
from adacd_hil.records import JOINTS
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.toml_files import parse_toml
from adacd_hil.settings.toml_text import to_toml


def device_attachments(settings: Settings) -> dict[str, bytes]:
    """Return each device's profile, `Drive1.toml`, and the EDS that it names. Raises ConfigError, OSError."""
    attachments: dict[str, bytes] = {}
    for device in place_devices(settings):
        eds = device.profile.eds.read_bytes()
        name = _free_name(device, eds, attachments)
        attachments[name] = eds
        attachments[f"{device.name}.toml"] = to_toml(dataclasses.replace(device.settings, eds=name)).encode()
    return attachments


def _free_name(device: PlacedDevice, eds: bytes, attachments: Mapping[str, bytes]) -> str:
    """Return the name of a device's EDS, or one of its own if another EDS has it."""
    name = device.profile.eds.name
    return name if attachments.get(name, eds) == eds else f"{device.name}.eds"


def with_attached_devices(settings: Settings, attachments: Mapping[str, bytes], folder: Path) -> Settings:
    """Return settings whose device profiles are those attached to a log, written to `folder`.

    If an attachment is missing or is of a version that wrote other keys, the settings are returned unchanged. Raises
    OSError.
    """
    names = [f"{kind}{joint + 1}" for kind in ("Drive", "Sensor") for joint in range(JOINTS)]
    if not all(_write_profile(name, attachments, folder) for name in names):
        return settings
    drive1, drive2, sensor1, sensor2 = (str(folder / f"{name}.toml") for name in names)
    devices = dataclasses.replace(settings.devices, drive=(drive1, drive2), sensor=(sensor1, sensor2))
    return dataclasses.replace(settings, devices=devices)


def _write_profile(device: str, attachments: Mapping[str, bytes], folder: Path) -> bool:
    """Write the attached profile of a device with its EDS; return False, and write nothing, if one is missing."""
    try:
        profile = parse(ProfileSettings, parse_toml(attachments[f"{device}.toml"]))
        name = Path(profile.eds).name
        eds = attachments[name]
    except (KeyError, ConfigError):
        return False
    (folder / name).write_bytes(eds)
    (folder / f"{device}.toml").write_text(to_toml(dataclasses.replace(profile, eds=name)))
    return True
