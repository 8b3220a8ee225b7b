"""The keys of a configuration: their list, their values in words, and changes of single ones.

`known_keys` lists every key with type, default, bounds, unit and meaning. `apply_settings` changes single keys: a key
is dotted, `detector.threshold_Nm`; a value is TOML, where a word needs no quotes and a single value stands for a list,
see `apply_settings`. Settings that determined the numbers of a log can't be changed for its replay.
"""

import dataclasses
import itertools
import math
import tomllib
import typing
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

from adacd_hil.plain_values import plain_values
from adacd_hil.remedies import nearest_name
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.parsing import describe_gone, parse
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.toml_files import parse_toml
from adacd_hil.settings.toml_text import to_toml


class KnownKey(NamedTuple):
    """One setting. `key` is dotted; a key in the rows of a list has `[]` after the list's name."""

    key: str
    kind: Any
    default: str
    """As `in_words` formats it; `required` if there is no default, `none` if the setting is absent by default."""
    bounds: str
    """The choices, or the bounds with the unit; without bounds the unit alone, which may be empty."""
    meaning: str
    choices: tuple[str, ...]

    @property
    def is_in_row(self) -> bool:
        """Whether the key belongs to the rows of a list, which only a file can set."""
        return "[]" in self.key


def sections() -> Iterator[tuple[str, type[Any], str]]:
    """Yield name, class and meaning of each table of a configuration; first the top of the file, with an empty name."""
    yield "", Settings, "top of the file"
    hints = typing.get_type_hints(Settings)
    for field in dataclasses.fields(Settings):
        if dataclasses.is_dataclass(hints[field.name]):
            yield field.name, hints[field.name], field.metadata["meaning"]


def keys_of(section: type[Any], prefix: str) -> Iterator[KnownKey]:
    """Yield the settings of a section and of the rows of its lists, `prefix` before each key; no sections within it."""
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
    """Return every setting by its key, those in the rows of lists included, in the order of the declarations."""
    tables = ((f"{name}." if name else "", section) for name, section, _ in sections())
    return {known.key: known for prefix, section in tables for known in keys_of(section, prefix)}


def value_of(settings: Settings, key: str) -> Any:
    """Return the value of a dotted key. Raises AttributeError for an unknown key."""
    value: Any = settings
    for part in key.split("."):
        value = getattr(value, part)
    return value


def in_words(value: Any) -> str:
    """Return the text of a value as in a configuration; None is `none`, a float has six significant digits at most."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = ((field.name, getattr(value, field.name)) for field in dataclasses.fields(value))
        return f"{{{', '.join(f'{name} = {in_words(inner)}' for name, inner in fields)}}}"
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(in_words, value))}]"
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "none"}[value]
    return f'"{value}"' if isinstance(value, str) else f"{value:g}" if isinstance(value, float) else str(value)


def explain_unknown(key: str) -> str:
    """Return a line for a key that is not a setting: if it is a section, with that section's keys.

    Otherwise with the key's successor, the nearest known key, the other keys of its section, or all sections.
    """
    keys = [name for name, known in known_keys().items() if not known.is_in_row]
    below = [known for known in keys if known.startswith(f"{key}.")]
    if below:
        return f"`{key}` is a section; its keys are {', '.join(below)}"
    if gone := describe_gone(key):
        return gone
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
    """Return the choices of a setting, else its bounds and unit as text, by its field's metadata; "" without any."""
    if metadata["choices"]:
        return ", ".join(metadata["choices"])
    low, high, unit = metadata["low"], metadata["high"], metadata["unit"]
    if math.isinf(high):
        return str(unit) if math.isinf(low) else f"≥ {low:g} {unit}".strip()
    return f"{low:g} … {high:g} {unit}".strip()


_FACTS: Final = ("profile", "sign", "torque_offset_Nm", "torque_offset_std_Nm", "rated_torque_Nm")
"""Settings of the arm that determined the numbers of a log."""


def apply_settings(settings: Settings, changes: Mapping[str, str]) -> Settings:
    """Return the settings with some keys changed. changes: by dotted key, a TOML value as text.

    A word needs no quotes. A single value stands for a list, unless that may be absent: it fills a list of fixed length
    and one of floats, such as `certified.prior_std`; any other list, such as `certified.friction_terms`, and an empty
    one get it alone. Raises ConfigError for an unknown key, a text that is no TOML value, and a value that `parse_toml`
    or `parse` refuses.
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


def refuse_log_settings(changes: Mapping[str, str]) -> None:
    """Raise ConfigError if one of the changed keys determined the numbers of a log; values are not looked at.

    These are all keys of `devices`, `bus.period_us`, `realtime.sample_period`, and of `arm` profile, signs, torque
    offsets and rated torques.
    """
    facts = {f"arm.{name}" for name in _FACTS} | {"bus.period_us", "realtime.sample_period"}
    for key in changes:
        if key in facts or key.startswith("devices."):
            raise ConfigError(f"`{key}` made the numbers of the log; a replay can't change it")


def _read_value(key: str, text: str) -> Any:
    """Parse a text as a TOML value.

    Return a text that is no TOML as a string, for words without quotes. Raises ConfigError for such a text if it is
    empty or holds a quote, bracket, brace, `=`, `#` or newline, and for a value that `parse_toml` refuses.
    """
    try:
        return parse_toml(f'"{key}" = {text}')[key]
    except ConfigError as error:
        if error.__cause__ is None:
            raise
        if text and not set(text) & set("\"'[]{}=\n#"):
            return text
        raise ConfigError(f"`{key}` = {text} is not a TOML value") from None


def _spread(value: Any, kind: Any, present: Any) -> Any:
    """Return a single value as a list if the setting is a list that can't be absent; else return the value.

    kind: the setting's type. present: the setting's value so far. A list of fixed length, and one of floats unless it
    is empty, keeps its length; any other list has the value alone.
    """
    if typing.get_origin(kind) is not tuple or isinstance(value, list):
        return value
    element, *others = typing.get_args(kind)
    keeps_length = element is float or Ellipsis not in others
    return [value] * (len(present) if keeps_length and present else 1)


def keep_log_settings(own: Settings, other: Settings) -> Settings:
    """Return `other` with those settings of `own`, a log's, that determined the numbers of the log.

    These are bus, devices, sample period, and of the arm profile, signs, torque offsets and rated torques: no
    configuration may change them afterwards. Holding torque and position-dependent torque come from the log, too, if
    it has them.
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
    """Return the value, still as text, by key of `key=value` texts.

    Raises ConfigError for a text without `=` or without a key, and for a key in two texts.
    """
    changes: dict[str, str] = {}
    for text in given:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"{text!r} must be key=value, such as detector.threshold_Nm=0.1")
        key = key.strip()
        if key in changes:
            raise ConfigError(f"{key} is given twice, as {changes[key]} and {value.strip()}")
        changes[key] = value.strip()
    return changes


def parse_variations(given: Sequence[str]) -> list[dict[str, str]]:
    """Return every combination of values of `key=a,b,c` texts, each as text by key; [{}] without any text.

    Commas within [], {} or quotes part nothing, so a value may be an array. The last key varies fastest. Raises
    ConfigError for a text without `=` or without a key, and for a key in two texts.
    """
    lists = [[(key, value) for value in split_list(text)] for key, text in parse_changes(given).items()]
    return [dict(choice) for choice in itertools.product(*lists)]


def split_list(text: str) -> list[str]:
    """Return the parts of a text between its commas outside [], {} and quotes, without spaces around them."""
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
    """Return the settings that differ, by dotted key: (before, after) as Python writes them; `unset` for None."""
    keys = [key for key, known in known_keys().items() if not known.is_in_row]
    pairs = {key: (_as_python(value_of(before, key)), _as_python(value_of(after, key))) for key in keys}
    return {key: pair for key, pair in pairs.items() if pair[0] != pair[1]}


def _as_python(value: Any) -> str:
    return "unset" if value is None else repr(plain_values(value))
