"""The devices of one arm in their places: name in the contract, node id, profile, objects.

Order: Drive1, Drive2, Sensor1, Sensor2.
"""

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from adacd_hil.device.canopen_bus import Variable, find_variable, read_eds
from adacd_hil.device.profile import ObjectName, PdoSettings, Profile, ProfileSettings, SignalSettings, load_profile
from adacd_hil.records import JOINTS
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.schema import ConfigError


@dataclass(frozen=True)
class Device:
    """One device of the arm. `joint` counts from 0."""

    name: str
    joint: int
    node_id: int
    profile: Profile

    @property
    def settings(self) -> ProfileSettings:
        """What its profile says."""
        return self.profile.settings

    @property
    def objects(self) -> Any:
        """The object dictionary of its EDS. Raises ConfigError when it can't be read."""
        return _objects(self.profile.eds, self.node_id)

    def has(self, index: int, sub: int = 0) -> bool:
        """Whether the EDS lists an object."""
        return find_variable(self.objects, index, sub) is not None

    def can(self, feature: str) -> bool:
        """Whether the profile names a feature."""
        return feature in self.settings.features

    def pdo(self, message: str) -> PdoSettings | None:
        """Return the PDO that is this message of the contract, None when the device has none."""
        return next((pdo for pdo in self.settings.pdo if pdo.message == message), None)

    def can_id(self, pdo: PdoSettings) -> int:
        """Return the identifier of a PDO."""
        return pdo.cob_id + self.node_id

    def variable(self, name: ObjectName) -> Variable:
        """Describe an object of the EDS. Raises ConfigError when it lists none or one that fits no PDO."""
        found = find_variable(self.objects, name.index, name.sub)
        if found is None:
            raise ConfigError(f"device profile {self.profile.name}: object {name} is not in {self.profile.eds.name}")
        if not found.bits:
            raise ConfigError(f"device profile {self.profile.name}: object {name} ({found.name}) fits no PDO")
        return found

    def mapping(self, pdo: PdoSettings) -> list[int]:
        """Return the mapping entries of a PDO, CiA 301 figure 70: index, sub-index, bits. Raises ConfigError."""
        names = [signal.name for signal in self.header(pdo)] + [signal.name for signal in pdo.signals]
        return [name.index << 16 | name.sub << 8 | self.variable(name).bits for name in names]

    def header(self, pdo: PdoSettings) -> list[SignalSettings]:
        """Return the header objects of a PDO; none where it is unprotected."""
        if not pdo.data_ids:
            return []
        return [SignalSettings(object=text, signal="e2e") for text in self.settings.header]


@functools.lru_cache(maxsize=32)
def _objects(path: Path, node_id: int) -> Any:
    return read_eds(path, node_id)


def place_devices(settings: Settings) -> list[Device]:
    """Load the profiles of all devices of the arm. Raises ConfigError."""
    chosen = settings.devices
    devices = []
    for kind, names, nodes in (
        ("drive", chosen.drive, chosen.drive_node),
        ("sensor", chosen.sensor, chosen.sensor_node),
    ):
        for joint in range(JOINTS):
            profile = load_profile(names[joint], kind)
            devices.append(Device(f"{kind.capitalize()}{joint + 1}", joint, nodes[joint], profile))
    return devices
