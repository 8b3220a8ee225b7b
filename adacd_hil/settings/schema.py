"""Frozen settings with unit and bounds; an unknown key is an error that names the nearest known one.

A section is a frozen dataclass whose fields are made by `setting`. Field names carry their unit.
"""

import dataclasses
import math
import types
import typing
from collections.abc import Iterable
from typing import Any, TypeVar

from adacd_hil.remedies import nearest_name


class ConfigError(ValueError):
    """A setting that can't be used; the message is one line: key, value, bound, unit."""


class DetectorError(ConfigError):
    """A package's detector that can't be used: it can't be imported, or doesn't keep the contract."""


SUCCESSORS = {
    "certified.collision_Nm": "`detector.collision_Nm`",
    "certified.deviations": "`certified.noise_sigmas` and `certified.model_sigmas`",
    "certified.sigmas": "`certified.noise_sigmas` and `certified.model_sigmas`",
    "safety.commission_cycles": "`safety.commission_s`",
}
"""Keys that are gone, and by what they are replaced, as an error says it."""
_OFFLINE = "no detector runs in the loop any more; `adacd-hil thresholds LOG... --report FOLDER` compares them on logs"
WITHDRAWN = {"detector.live": _OFFLINE, "detector.live_lag_s": _OFFLINE}
"""Keys that are gone without a successor, and the remedy."""


def setting(
    default: Any = dataclasses.MISSING,
    *,
    unit: str = "",
    low: float = -math.inf,
    high: float = math.inf,
    choices: tuple[str, ...] = (),
    meaning: str,
) -> Any:
    """Declare one setting. Bounds are inclusive and hold for each element of a tuple; no default means required."""
    metadata = {"unit": unit, "low": low, "high": high, "choices": choices, "meaning": meaning}
    if isinstance(default, type):
        return dataclasses.field(default_factory=default, metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


Section = TypeVar("Section")


def parse(section: type[Section], table: dict[str, Any], where: str = "") -> Section:
    """Make a `section` from a TOML table.

    Raises ConfigError for an unknown key, a missing key, a wrong type or a value outside its bounds.
    """
    fields = {field.name: field for field in dataclasses.fields(typing.cast(Any, section))}
    hints = typing.get_type_hints(section)
    for key in table:
        if key not in fields:
            raise ConfigError(_unknown(key, fields, where))
    values = {}
    for name, field in fields.items():
        if name in table:
            values[name] = _parse_value(hints[name], table[name], f"{where}{name}", field.metadata)
        elif _is_required(field):
            raise ConfigError(f"missing key `{where}{name}`")
    place = where.rstrip(".")
    try:
        return section(**values)
    except ConfigError as error:
        if place in str(error):
            raise
        raise ConfigError(f"`{place}`: {error}") from error
    except ValueError as error:
        raise ConfigError(f"{place}: {error}" if place else str(error)) from error


def find_problems(section: type[Any], table: dict[str, Any], where: str = "") -> list[str]:
    """List everything for which `parse` would refuse a table, a line each.

    What concerns several keys of a section is looked at only where each of them is right, and then the first of it.
    """
    fields = {field.name: field for field in dataclasses.fields(section)}
    hints = typing.get_type_hints(section)
    problems = [_unknown(key, fields, where) for key in table if key not in fields]
    for name, field in fields.items():
        if name in table:
            problems += _value_problems(hints[name], table[name], f"{where}{name}", field.metadata)
        elif _is_required(field):
            problems.append(f"missing key `{where}{name}`")
    if not problems:
        try:
            parse(section, table, where)
        except ConfigError as error:
            problems.append(str(error))
    return problems


def _value_problems(hint: Any, value: Any, key: str, metadata: Any) -> list[str]:
    options = [option for option in typing.get_args(hint) if option is not type(None)]
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return _value_problems(options[0], value, key, metadata)
    if dataclasses.is_dataclass(hint) and isinstance(value, dict):
        return find_problems(typing.cast(type[Any], hint), value, f"{key}.")
    if typing.get_origin(hint) is tuple and dataclasses.is_dataclass(options[0]) and isinstance(value, list):
        rows = enumerate(value)
        return [text for index, row in rows for text in _value_problems(options[0], row, f"{key}[{index}]", metadata)]
    try:
        _parse_value(hint, value, key, metadata)
    except ConfigError as error:
        return [str(error)]
    return []


def _unknown(key: str, known: Iterable[str], where: str) -> str:
    known = list(known)
    if gone := describe_gone(f"{where}{key}"):
        return gone
    nearest = nearest_name(key, known)
    hint = f"; did you mean `{where}{nearest}`?" if nearest else f"; known: {', '.join(known)}"
    return f"unknown key `{where}{key}`{hint}"


def describe_gone(key: str) -> str:
    """Say in one line what there is in place of a key of older versions; "" for one that never was."""
    if key in WITHDRAWN:
        return f"unknown key `{key}`: {WITHDRAWN[key]}"
    return f"unknown key `{key}`; its successor is {SUCCESSORS[key]}" if key in SUCCESSORS else ""


def _is_required(field: "dataclasses.Field[Any]") -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _parse_value(hint: Any, value: Any, key: str, metadata: Any) -> Any:
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, dict):
            raise ConfigError(f"`{key}` = {value!r} must be a table")
        return parse(typing.cast(type[Any], hint), value, f"{key}.")
    if typing.get_origin(hint) is tuple:
        return _parse_tuple(hint, value, key, metadata)
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        hint = next(option for option in typing.get_args(hint) if option is not type(None))
        return _parse_value(hint, value, key, metadata)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, hint) or (hint is int and isinstance(value, bool)):
        raise ConfigError(f"`{key}` = {value!r} must be of type {hint.__name__}")
    if isinstance(value, int | float) and not isinstance(value, bool):
        _check_bounds(value, key, metadata)
    if metadata["choices"] and value not in metadata["choices"]:
        nearest = nearest_name(str(value), metadata["choices"])
        hint_text = f"; did you mean {nearest!r}?" if nearest else ""
        raise ConfigError(f"`{key}` = {value!r} must be one of {', '.join(metadata['choices'])}{hint_text}")
    return value


def _parse_tuple(hint: Any, value: Any, key: str, metadata: Any) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise ConfigError(f"`{key}` = {value!r} must be a list")
    arguments = typing.get_args(hint)
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        element_hints: tuple[Any, ...] = (arguments[0],) * len(value)
    else:
        element_hints = arguments
    if len(value) != len(element_hints):
        raise ConfigError(f"`{key}` has {len(value)} values, {len(element_hints)} expected")
    return tuple(
        _parse_value(element, item, f"{key}[{index}]", metadata)
        for index, (element, item) in enumerate(zip(element_hints, value, strict=True))
    )


def _check_bounds(value: float, key: str, metadata: Any) -> None:
    unit = f" {metadata['unit']}" if metadata["unit"] else ""
    if not math.isfinite(value):
        raise ConfigError(f"`{key}` = {value} is not finite")
    for is_outside, word, bound in (
        (value < metadata["low"], "below", metadata["low"]),
        (value > metadata["high"], "above", metadata["high"]),
    ):
        if is_outside:
            raise ConfigError(f"`{key}` = {value}{unit} is {word} {bound:g}{unit}{_other_unit(value, metadata)}")


_OTHER_UNITS = {
    "m": (("mm", 1e-3), ("cm", 1e-2)),
    "kg": (("g", 1e-3),),
    "Nm": (("Nmm", 1e-3), ("Ncm", 1e-2)),
    "s": (("ms", 1e-3), ("µs", 1e-6)),
    "ms": (("s", 1e3),),
    "µs": (("ms", 1e3), ("s", 1e6)),
    "deg": (("rad", math.degrees(1.0)),),
    "deg/s": (("rad/s", math.degrees(1.0)),),
    "rad": (("deg", math.radians(1.0)),),
    "rad/s": (("Hz", math.tau), ("deg/s", math.radians(1.0))),
}
"""Units that a value may have been meant in, with their worth in the setting's own."""


def _other_unit(value: float, metadata: Any) -> str:
    """Say what a value out of bounds would be in another unit, if it is within them then."""
    for unit, worth in _OTHER_UNITS.get(metadata["unit"], ()):
        if value and metadata["low"] <= value * worth <= metadata["high"]:
            return f"; {value:g} {unit} are {value * worth:g} {metadata['unit']}"
    return ""
