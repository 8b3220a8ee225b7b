"""Configurations from files: a built-in name or a TOML file, merged over the files that it extends."""

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from adacd_hil.file_access import exists
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.parsing import WITHDRAWN, parse
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.stated import ARM_PROFILES
from adacd_hil.settings.toml_files import builtin_folder, builtin_names, find_named, read_toml

_LONGEST_CHAIN = 8
"""Most configurations that one configuration may extend, directly and by those that it extends."""


def with_todays_keys(table: dict[str, Any]) -> dict[str, Any]:
    """Return a log's configuration table with some old keys changed to today's; `parse` refuses other removed keys.

    An integer `safety.commission_cycles` becomes `safety.commission_s`. Withdrawn keys of `detector` are dropped. If
    the section `certified` lacks `cross_talk_std`, the version that wrote the log had no such term, so that it becomes
    0. The given table stays as it is.
    """
    certified = table.get("certified")
    if isinstance(certified, dict) and "cross_talk_std" not in certified:
        table = table | {"certified": certified | {"cross_talk_std": 0.0}}
    detector = table.get("detector")
    if isinstance(detector, dict):
        table = table | {"detector": {key: detector[key] for key in detector if f"detector.{key}" not in WITHDRAWN}}
    safety = table.get("safety")
    if not isinstance(safety, dict) or "commission_cycles" not in safety:
        return table
    bus = table.get("bus")
    period_us = bus.get("period_us", 1000) if isinstance(bus, dict) else 1000
    cycles = safety["commission_cycles"]
    if not (isinstance(cycles, int) and isinstance(period_us, int)):
        return table
    kept = {key: value for key, value in safety.items() if key != "commission_cycles"}
    return table | {"safety": kept | {"commission_s": cycles * period_us * 1e-6}}


def merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Return two TOML tables merged, with tables within them, to any depth; `over` wins. Lists are replaced whole."""
    merged = dict(base)
    for key, value in over.items():
        if isinstance(value, dict) and isinstance(merged.get(key), dict):
            merged[key] = merge(merged[key], value)
        else:
            merged[key] = value
    return merged


class ConfigurationLayer(NamedTuple):
    """Settings of one file, of one profile in it, or of `--profile`; `origin` names it."""

    origin: str
    table: dict[str, Any]


def load_settings(name_or_file: str = "paper", profile: str | None = None) -> Settings:
    """Return the settings of a configuration: a built-in name, or a TOML file merged over the one it `extends`.

    A file without `extends` extends `paper`. `profile` picks the `[profiles.X]` table; None: `arm.profile` picks it.
    Raises ConfigError for a file that can't be read, wrong `extends`, an unknown profile, and settings that `parse`
    refuses.
    """
    return parse(Settings, resolved_table(configuration_layers(name_or_file, profile)))


def resolved_table(layers: Sequence[ConfigurationLayer]) -> dict[str, Any]:
    """Return the layers of a configuration merged, later over earlier."""
    return functools.reduce(merge, (layer.table for layer in layers), {})


def configuration_layers(name_or_file: str, profile: str | None = None) -> list[ConfigurationLayer]:
    """Return the layers of a configuration and of all that it extends, the base first.

    `profile` picks the `[profiles.X]` tables, and is itself the last layer, as `arm.profile`; None: `arm.profile` of
    the files picks them. The layers of these tables precede those of the files, whose keys override them. Raises
    ConfigError for a file that can't be read, wrong `extends`, and an unknown profile.
    """
    files = _load_chain(name_or_file)
    table = resolved_table(files)
    profiles = _table_in(table, "profiles", "`profiles`")
    chosen = profile or _table_in(table, "arm", "`arm`").get("profile", ARM_PROFILES[0])
    if not isinstance(chosen, str) or chosen not in profiles:
        raise ConfigError(f"profile {chosen!r} is not in configuration {name_or_file}; known: {', '.join(profiles)}")
    layers = []
    for layer in files:
        own = _table_in(_table_in(layer.table, "profiles", "`profiles`"), chosen, f"`profiles.{chosen}`")
        if own:
            layers.append(ConfigurationLayer(f"{layer.origin} [profiles.{chosen}]", own))
    layers += [
        ConfigurationLayer(origin, {key: value for key, value in said.items() if key != "profiles"})
        for origin, said in files
    ]
    if profile is not None:
        layers.append(ConfigurationLayer("--profile", {"arm": {"profile": chosen}}))
    return layers


def profiles_of(name_or_file: str) -> list[str]:
    """Return the names of the `[profiles]` that a configuration's own file has, without those that it extends.

    Raises ConfigError for a file that can't be read, wrong `extends`, and `profiles` that is no table.
    """
    return [*_table_in(_load_chain(name_or_file)[-1].table, "profiles", "`profiles`")]


def _table_in(table: dict[str, Any], key: str, name: str) -> dict[str, Any]:
    """Return the table below `key` of a table, empty if absent. Raises ConfigError, with `name`, for another value."""
    value = table.get(key, {})
    if not isinstance(value, dict):
        raise ConfigError(f"{name} = {value!r} must be a table")
    return value


def _find_beside(table: dict[str, Any], folder: Path) -> None:
    """Change `table`: put `folder` before each name in its `devices` that has a suffix and exists in the folder."""

    def found(name: Any) -> Any:
        is_beside = isinstance(name, str) and Path(name).suffix and exists(folder / name)
        return str(folder / name) if is_beside else name

    devices = table.get("devices")
    if not isinstance(devices, dict):
        return
    for key in ("drive", "sensor", "contract"):
        if key in devices:
            value = devices[key]
            devices[key] = [found(name) for name in value] if isinstance(value, list) else found(value)


def _load_chain(name_or_file: str, seen: tuple[str, ...] = ()) -> list[ConfigurationLayer]:
    """Return the files of a configuration and of all that it extends, the base first, each table with a `name`.

    A path with a suffix starts in the folder of the file that names it, in `devices` only if it exists there. `seen`:
    those that extend this one. Raises ConfigError for a file that can't be read, and for `extends` that is no text, a
    circle or too long a chain.
    """
    if name_or_file in seen:
        raise ConfigError(f"configuration {name_or_file} extends itself")
    if len(seen) > _LONGEST_CHAIN:
        raise ConfigError(f"configuration {seen[0]} extends more than {_LONGEST_CHAIN} others, one by one")
    path = find_named("configuration", name_or_file, builtin_folder())
    table = read_toml(path)
    table.setdefault("name", path.stem)
    _find_beside(table, path.parent)
    if "extends" not in table and name_or_file in builtin_names():
        return [ConfigurationLayer(name_or_file, table)]
    extended = table.pop("extends", "paper")
    if not isinstance(extended, str):
        raise ConfigError(f"`extends` = {extended!r} must be the name of a configuration or a file")
    if extended not in builtin_names() and Path(extended).suffix:
        extended = str(path.parent / extended)
    return [*_load_chain(extended, (*seen, name_or_file)), ConfigurationLayer(name_or_file, table)]
