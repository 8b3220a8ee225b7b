"""The device profiles and EDS files of a run as attachments of its log."""

import dataclasses
from collections.abc import Iterable, Mapping

from adacd_hil.device.profile import PlacedDevice
from adacd_hil.settings.toml_text import to_toml


def device_attachments(devices: Iterable[PlacedDevice]) -> dict[str, bytes]:
    """Return each device's profile as TOML, by a name such as `Drive1.toml`, and its EDS, unchanged, by its file name.

    If two devices have different EDS files of one name, the second gets another name, which its profile then names.
    """
    attachments: dict[str, bytes] = {}
    for device in devices:
        eds = device.profile.eds_bytes
        name = _free_name(device, eds, attachments)
        attachments[name] = eds
        attachments[f"{device.name}.toml"] = to_toml(dataclasses.replace(device.settings, eds=name)).encode()
    return attachments


def _free_name(device: PlacedDevice, eds: bytes, attachments: Mapping[str, bytes]) -> str:
    """Return the file name of a device's EDS, with the device's name before it if another EDS has that file name."""
    name = device.profile.eds.name
    return name if attachments.get(name, eds) == eds else f"{device.name}-{name}"
