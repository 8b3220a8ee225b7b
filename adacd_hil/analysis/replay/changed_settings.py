"""Other settings for a log: changed keys, variations, and the kept part of the log's own settings.

A key is dotted, `detector.threshold_Nm`; a value is TOML, where a word may go without quotes and a number stands for a
list of such numbers.
"""

import dataclasses
import itertools
import tomllib
import typing
from collections.abc import Mapping, Sequence
from typing import Any, Final

from adacd_hil.settings.configuration import Settings, explain_unknown, known_keys
from adacd_hil.settings.schema import ConfigError, parse
from adacd_hil.settings.toml_files import parse_toml, to_toml

_FACTS: Final = ("profile", "sign", "torque_offset_Nm", "torque_offset_std_Nm", "rated_torque_Nm")
"""Settings of the arm that made the numbers of a log."""


def apply_settings(settings: Settings, changes: Mapping[str, str]) -> Settings:
    """Return the settings with some keys changed, each `section.key` to a TOML value.

    Raises ConfigError, of an unknown key with the nearest known one.
    """
    table = tomllib.loads(to_toml(settings))
    known = known_keys()
    for key, text in changes.items():
        if key not in known or known[key].is_in_row:
            raise ConfigError(explain_unknown(key))
        parts = key.split(".")
        section: dict[str, Any] = table
        for part in parts[:-1]:
            section = section.setdefault(part, {})
        section[parts[-1]] = _spread(_read_value(key, text), known[key].kind, section.get(parts[-1]))
    return parse(Settings, table)


def refuse_facts(changes: Mapping[str, str]) -> None:
    """Raise ConfigError if a key is what made the numbers of a log: no other value can be given to it afterwards."""
    facts = {f"arm.{name}" for name in _FACTS} | {"bus.period_us", "realtime.sample_period"}
    for key in changes:
        if key in facts or key.startswith("devices."):
            raise ConfigError(f"`{key}` made the numbers of the log; a replay can't change it")


def _read_value(key: str, text: str) -> Any:
    try:
        return parse_toml(f"value = {text}")["value"]
    except ConfigError:
        if text and not set(text) & set("\"'[]{}=\n#"):
            return text
        raise ConfigError(f"`{key}` = {text} is not a TOML value") from None


def _spread(value: Any, kind: Any, present: Any) -> Any:
    """Let a single value stand for a list of it, as long as the one that is there."""
    if typing.get_origin(kind) is tuple and not isinstance(value, list):
        elements = [element for element in typing.get_args(kind) if element is not Ellipsis]
        count = len(present) if isinstance(present, list) else len(elements)
        return [value] * count
    return value


def keep_facts(own: Settings, other: Settings) -> Settings:
    """Return other settings with what a log says of its arm, bus and devices, and of how time went.

    Signs, torque offsets, rated torques, the contract and the sample period made the numbers of the log: no
    configuration changes them afterwards. What the motors hold without power, and how much torque depends on the place,
    are the arm's, if the log says it.
    """
    facts = {name: getattr(own.arm, name) for name in _FACTS}
    if own.arm.holding_torque_Nm is not None:
        facts["holding_torque_Nm"] = own.arm.holding_torque_Nm
    if own.arm.position_torque_Nm > 0.0:
        facts["position_torque_Nm"] = own.arm.position_torque_Nm
    realtime = dataclasses.replace(other.realtime, sample_period=own.realtime.sample_period)
    arm = dataclasses.replace(other.arm, **facts)
    return dataclasses.replace(other, arm=arm, bus=own.bus, devices=own.devices, realtime=realtime)


def parse_changes(given: Sequence[str]) -> dict[str, str]:
    """Read `key=value` of several options. Raises ConfigError."""
    changes: dict[str, str] = {}
    for text in given:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"{text!r} must be key=value, such as detector.threshold_Nm=0.1")
        changes[key.strip()] = value.strip()
    return changes


def parse_variations(given: Sequence[str]) -> list[dict[str, str]]:
    """Read `key=a,b,c` of several options and return every combination. Raises ConfigError."""
    lists = [[(key, value) for value in split_list(text)] for key, text in parse_changes(given).items()]
    return [dict(choice) for choice in itertools.product(*lists)]


def split_list(text: str) -> list[str]:
    """Split at the commas that are outside brackets and quotes."""
    parts, depth, quote, start = [], 0, "", 0
    for place, letter in enumerate(text):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        elif letter in "[{":
            depth += 1
        elif letter in "]}":
            depth -= 1
        elif letter == "," and depth == 0:
            parts.append(text[start:place].strip())
            start = place + 1
    return [*parts, text[start:].strip()]


def changed_keys(before: Settings, after: Settings) -> dict[str, tuple[str, str]]:
    """Return the settings that differ, in words, by their keys."""
    tables = [_flat(tomllib.loads(to_toml(settings)), "") for settings in (before, after)]
    keys = [*tables[0], *(key for key in tables[1] if key not in tables[0])]
    words = {key: (tables[0].get(key, "unset"), tables[1].get(key, "unset")) for key in keys}
    return {key: pair for key, pair in words.items() if pair[0] != pair[1]}


def _flat(table: Mapping[str, Any], prefix: str) -> dict[str, str]:
    flat: dict[str, str] = {}
    for key, value in table.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = repr(value)
    return flat
