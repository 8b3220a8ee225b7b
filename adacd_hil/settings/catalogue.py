"""Catalogue of settings: every key of a configuration with its type, default, bounds, unit and meaning, as declared."""

import dataclasses
import math
import typing
from collections.abc import Iterator
from typing import Any, NamedTuple

from adacd_hil.remedies import nearest_name
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.schema import SUCCESSORS


class KnownKey(NamedTuple):
    """One setting. `key` is dotted; one of a row in a list has `[]` behind the list's name."""

    key: str
    kind: Any
    default: str
    """As TOML has it; `required` where there is none, `none` where it is absent."""
    bounds: str
    """The choices, or the bounds with the unit; empty where there are none."""
    meaning: str
    choices: tuple[str, ...]

    @property
    def is_in_row(self) -> bool:
        """Whether it belongs to a row of a list, which only a file can give."""
        return "[]" in self.key


def sections() -> Iterator[tuple[str, type[Any], str]]:
    """Give name, class and meaning of each table of a configuration; the first, without a name, is the top."""
    yield "", Settings, "top of the file"
    hints = typing.get_type_hints(Settings)
    for field in dataclasses.fields(Settings):
        if dataclasses.is_dataclass(hints[field.name]):
            yield field.name, hints[field.name], field.metadata["meaning"]


def keys_of(section: type[Any], prefix: str) -> Iterator[KnownKey]:
    """Give the settings of a table, rows within it included; tables within it are sections of their own."""
    hints = typing.get_type_hints(section)
    for field in dataclasses.fields(section):
        kind = hints[field.name]
        if dataclasses.is_dataclass(kind):
            continue
        default = "required" if field.default is dataclasses.MISSING else in_words(field.default)
        meta = field.metadata
        yield KnownKey(prefix + field.name, kind, default, _bounds(meta), meta["meaning"], meta["choices"])
        for inner in typing.get_args(kind):
            if dataclasses.is_dataclass(inner) and isinstance(inner, type):
                yield from keys_of(inner, f"{prefix}{field.name}[].")


def known_keys() -> dict[str, KnownKey]:
    """Return every setting by its key, in the order of the declarations."""
    tables = ((f"{name}." if name else "", section) for name, section, _ in sections())
    return {known.key: known for prefix, section in tables for known in keys_of(section, prefix)}


def value_of(settings: Settings, key: str) -> Any:
    """Return the value of a dotted key."""
    value: Any = settings
    for part in key.split("."):
        value = getattr(value, part)
    return value


def in_words(value: Any) -> str:
    """Write a value as a configuration would, numbers as short as they can be told."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = ((field.name, getattr(value, field.name)) for field in dataclasses.fields(value))
        return f"{{{', '.join(f'{name} = {in_words(inner)}' for name, inner in fields)}}}"
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(in_words, value))}]"
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "none"}[value]
    return f'"{value}"' if isinstance(value, str) else f"{value:g}" if isinstance(value, float) else str(value)


def explain_unknown(key: str) -> str:
    """Say in one line that a key is unknown, with its successor, the nearest known one, or those of its section."""
    keys = [name for name, known in known_keys().items() if not known.is_in_row]
    below = [known for known in keys if known.startswith(f"{key}.")]
    if below:
        return f"`{key}` is a section; its keys are {', '.join(below)}"
    if key in SUCCESSORS:
        return f"unknown key `{key}`; its successor is {SUCCESSORS[key]}"
    section, _, last = key.rpartition(".")
    by_name = {known.rpartition(".")[2]: known for known in reversed(keys)}
    found = nearest_name(key, keys) or by_name.get(nearest_name(last, by_name) or "")
    if found:
        return f"unknown key `{key}`; did you mean `{found}`?"
    beside = [known.rpartition(".")[2] for known in keys if section and known.rpartition(".")[0] == section]
    if beside:
        return f"unknown key `{key}`; `{section}` has {', '.join(beside)}"
    names = [field.name for field in dataclasses.fields(Settings)]
    return f"unknown key `{key}`; it begins with a section: {', '.join(names)}"


def _bounds(metadata: Any) -> str:
    if metadata["choices"]:
        return ", ".join(metadata["choices"])
    low, high, unit = metadata["low"], metadata["high"], metadata["unit"]
    if math.isinf(high):
        return str(unit) if math.isinf(low) else f"≥ {low:g} {unit}".strip()
    return f"{low:g} … {high:g} {unit}".strip()
