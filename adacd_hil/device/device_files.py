"""The devices of an arm, loaded: by the profiles that the configuration names, or by those that a log has.

A run loads them once: a profile or EDS that is changed meanwhile counts from the next run on.
"""

from collections.abc import Callable, Mapping
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from adacd_hil.device.eds_file import eds_bytes, parse_eds
from adacd_hil.device.profile import MERGED, DeviceProfile, PlacedDevice, ProfileSettings, device_name
from adacd_hil.records import JOINTS
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.toml_files import find_named, parse_toml, read_toml, toml_names
from adacd_hil.wire.dbc_contract import contract_folder

_MOST_EXTENDED = 8


def _builtin_folder() -> Traversable:
    return resources.files("adacd_hil") / "device_profiles"


def profile_names() -> list[str]:
    """Return the names of the device profiles that come with the package."""
    return toml_names(_builtin_folder())


def load_profile(name_or_file: str, kind: str) -> DeviceProfile:
    """Load a device profile by built-in name or file; `kind`: the required kind, drive or sensor.

    Its EDS is looked for beside it, beside the profiles that it extends, then in dbc/. Raises ConfigError for an
    unknown name or key, a value outside its bounds, an EDS that is missing or can't be read, another kind. The EDS is
    not parsed.
    """
    folder = _builtin_folder()
    path = find_named(
        "device profile",
        name_or_file,
        folder,
        is_shown=lambda name: _read_profile(Path(str(folder / f"{name}.toml")))[0]["kind"] == kind,
    )
    try:
        table, folders = _read_profile(path)
        settings = parse(ProfileSettings, table)
    except ConfigError as error:
        place = "" if str(error).startswith("device profile") else f"device profile {name_or_file}: "
        raise ConfigError(f"{place}{error}") from None
    if settings.kind != kind:
        raise ConfigError(f"device profile {name_or_file} is a {settings.kind}, a {kind} is needed")
    places = (folder / settings.eds for folder in (*folders, contract_folder()))
    eds = next((place for place in places if place.is_file()), None)
    if eds is None:
        raise ConfigError(f"device profile {name_or_file}: eds = {settings.eds!r} is neither beside it nor in dbc/")
    return DeviceProfile(path.stem, eds, eds_bytes(eds), settings)


def _read_profile(path: Path, depth: int = 0) -> tuple[dict[str, Any], list[Path]]:
    """Return the table of a profile merged over those that it extends, and the folders of all these, its own first.

    Sections of MERGED are merged key by key, `pdo` by message; of other keys the extending profile's value counts. Its
    own keys are no longer in `assumed`, unless it has that itself. `depth`: number of profiles that extend this one.
    Raises ConfigError for a file that can't be read, and for `extends` that is no name or goes deeper than
    _MOST_EXTENDED.
    """
    table = read_toml(path, "device profile")
    extended = table.pop("extends", None)
    if extended is None:
        return table, [path.parent]
    if not isinstance(extended, str) or depth >= _MOST_EXTENDED:
        raise ConfigError(f"`extends` = {extended!r} must be the name of a profile, at most {_MOST_EXTENDED} in a row")
    beside = path.parent / extended
    base = beside if beside.is_file() else find_named("device profile", extended, _builtin_folder())
    below, folders = _read_profile(base, depth + 1)
    merged = below | table
    for key in MERGED:
        if isinstance(below.get(key), dict) and isinstance(table.get(key), dict):
            merged[key] = below[key] | table[key]
    if isinstance(below.get("pdo"), list) and isinstance(table.get("pdo"), list):
        own = [_message(pdo) for pdo in table["pdo"]]
        merged["pdo"] = [pdo for pdo in below["pdo"] if _message(pdo) not in own] + table["pdo"]
    if "assumed" not in table:
        stated = {f"{key}.{name}" for key in MERGED if isinstance(table.get(key), dict) for name in table[key]}
        merged["assumed"] = [key for key in below.get("assumed", []) if key not in stated]
    return merged, [path.parent, *folders]


def _message(pdo: object) -> object:
    """Return the `message` of an entry of `pdo`; None if the entry has none or is no table."""
    return pdo.get("message") if isinstance(pdo, dict) else None


def place_devices(settings: Settings) -> list[PlacedDevice]:
    """Return all devices with their profiles: Drive1, Drive2, Sensor1, Sensor2, in this order.

    Raises ConfigError for a profile or EDS that can't be read or used, or a profile of the wrong kind.
    """
    names = {"drive": settings.devices.drive, "sensor": settings.devices.sensor}
    return _placed(settings, lambda kind, joint: load_profile(names[kind][joint], kind))


def logged_devices(settings: Settings, attachments: Mapping[str, bytes]) -> list[PlacedDevice] | None:
    """Return the devices of a run by the profiles and EDS files attached to its log, in the order of `place_devices`.

    None if an attachment is missing, or a profile can't be parsed, such as one with keys of another version. Raises
    ConfigError for an EDS that can't be parsed.
    """
    try:
        return _placed(settings, lambda kind, joint: _logged_profile(device_name(kind, joint), attachments))
    except KeyError:
        return None


def _logged_profile(name: str, attachments: Mapping[str, bytes]) -> DeviceProfile:
    """Return the attached profile of a device, with its EDS unread.

    Raises KeyError if the profile or the EDS is missing, or the profile can't be parsed.
    """
    try:
        settings = parse(ProfileSettings, parse_toml(attachments[f"{name}.toml"]))
    except ConfigError:
        raise KeyError(name) from None
    eds = Path(settings.eds)
    return DeviceProfile(name, eds, attachments[eds.name], settings)


def _placed(settings: Settings, profile_of: Callable[[str, int], DeviceProfile]) -> list[PlacedDevice]:
    """Return all devices in the order of `place_devices`; profile_of: returns the profile by kind and joint from 0.

    Raises ConfigError for an EDS that can't be parsed.
    """
    chosen = settings.devices
    devices = []
    for kind, nodes in (("drive", chosen.drive_node), ("sensor", chosen.sensor_node)):
        for joint in range(JOINTS):
            profile, node_id = profile_of(kind, joint), nodes[joint]
            objects = parse_eds(profile.eds_bytes, profile.eds, node_id)
            devices.append(PlacedDevice(device_name(kind, joint), joint, node_id, profile, objects))
    return devices
