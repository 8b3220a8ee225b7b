"""Settings made from a TOML table; an unknown key is an error that names the nearest known one."""

import dataclasses
import functools
import math
import types
import typing
from collections.abc import Iterable
from typing import Any, TypeVar

from adacd_hil.remedies import nearest_name
from adacd_hil.settings.schema import ConfigError

SUCCESSORS = {
    "certified.collision_Nm": "`detector.collision_Nm`",
    "certified.deviations": "`certified.noise_sigmas` and `certified.model_sigmas`",
    "certified.sigmas": "`certified.noise_sigmas` and `certified.model_sigmas`",
    "safety.commission_cycles": "`safety.commission_s`",
}
"""Removed keys, and the keys that replace them, as an error prints them."""
_OFFLINE = "no detector runs in the loop any more; `adacd-hil thresholds LOG... --report FOLDER` compares them on logs"
WITHDRAWN = {"detector.live": _OFFLINE, "detector.live_lag_s": _OFFLINE}
"""Removed keys without a successor, and the remedy."""


def bounds_of(section: type, name: str) -> tuple[float, float]:
    """Return the lowest and the highest value that a setting of a section may have; infinite without a bound.

    Raises ValueError if the section has no such setting.
    """
    (metadata,) = (field.metadata for field in dataclasses.fields(section) if field.name == name)
    return metadata["low"], metadata["high"]


Section = TypeVar("Section")


def parse(section: type[Section], table: dict[str, Any], where: str = "") -> Section:
    """Return a `section` made from a TOML table; where: the dotted name before its keys in messages.

    Raises ConfigError with every unknown key, missing key, wrong type and value outside its bounds; of a list of plain
    values the first. Conditions on several keys are checked only if each key is valid by itself; the first violation is
    reported.
    """
    fields = {field.name: field for field in dataclasses.fields(typing.cast(Any, section))}
    hints = _hints_of(typing.cast(Any, section))
    problems = [_unknown(key, fields, where) for key in table if key not in fields]
    values = {}
    for name, field in fields.items():
        if name in table:
            try:
                values[name] = _read_value(hints[name], table[name], f"{where}{name}", field.metadata)
            except ConfigError as error:
                problems += error.problems
        elif _is_required(field):
            problems.append(f"missing key `{where}{name}`")
    if problems:
        raise ConfigError(*problems)
    place = where.rstrip(".")
    try:
        return section(**values)
    except ConfigError as error:
        if place in str(error):
            raise
        raise ConfigError(f"`{place}`: {error}") from None
    except ValueError as error:
        raise ConfigError(f"{place}: {error}" if place else str(error)) from None


@functools.cache
def _hints_of(section: type[Any]) -> dict[str, Any]:
    """Return the types of a section's fields; taken apart anew, they would be a third of the time of `parse`."""
    return typing.get_type_hints(section)


def _read_value(hint: Any, value: Any, key: str, metadata: Any) -> Any:
    """Return a value of a TOML table converted to its type `hint`.

    key: dotted, for errors. metadata: of the setting's field: unit, bounds, choices. Raises ConfigError for another
    type or length, and for values outside their bounds or choices; of a list of tables with all problems.
    """
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        hint = next(option for option in typing.get_args(hint) if option is not type(None))
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, dict):
            raise ConfigError(f"`{key}` = {value!r} must be a table")
        return parse(typing.cast(type[Any], hint), value, f"{key}.")
    if typing.get_origin(hint) is not tuple:
        return _parse_scalar(hint, value, key, metadata)
    items: list[Any] = []
    problems: list[str] = []
    for index, (element, item) in enumerate(zip(_element_hints(hint, value, key), value, strict=True)):
        try:
            items.append(_read_value(element, item, f"{key}[{index}]", metadata))
        except ConfigError as error:
            if not dataclasses.is_dataclass(element):
                raise
            problems += error.problems
    if problems:
        raise ConfigError(*problems)
    return tuple(items)


def _unknown(key: str, known: Iterable[str], where: str) -> str:
    """Return the error of an unknown key: with its successor or remedy, else the nearest of `known`, else all of them.

    known: the section's keys. where: the section's dotted name and a dot, "" at the top.
    """
    known = list(known)
    if gone := describe_gone(f"{where}{key}"):
        return gone
    nearest = nearest_name(key, known)
    hint = f"; did you mean `{where}{nearest}`?" if nearest else f"; known: {', '.join(known)}"
    return f"unknown key `{where}{key}`{hint}"


def describe_gone(key: str) -> str:
    """Return one line that names the successor of a removed key, or the remedy; "" for any other key."""
    if key in WITHDRAWN:
        return f"unknown key `{key}`: {WITHDRAWN[key]}"
    return f"unknown key `{key}`; its successor is {SUCCESSORS[key]}" if key in SUCCESSORS else ""


def _is_required(field: "dataclasses.Field[Any]") -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _parse_scalar(hint: Any, value: Any, key: str, metadata: Any) -> Any:
    """Return a value that is no list or table, an integer as float where `hint` is that.

    Raises ConfigError for another type, and for a value outside its bounds or choices.
    """
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


def _element_hints(hint: Any, value: Any, key: str) -> tuple[Any, ...]:
    """Return the type of each element of a list, by the tuple type `hint`.

    Raises ConfigError if the value is no list, or hasn't the length that `hint` asks for.
    """
    if not isinstance(value, list | tuple):
        raise ConfigError(f"`{key}` = {value!r} must be a list")
    hints = typing.get_args(hint)
    if len(hints) == 2 and hints[1] is Ellipsis:
        return (hints[0],) * len(value)
    if len(value) != len(hints):
        raise ConfigError(f"`{key}` has {len(value)} values, {len(hints)} expected")
    return hints


def _check_bounds(value: float, key: str, metadata: Any) -> None:
    """Raise ConfigError for a number that is not finite or is outside its bounds, which are inclusive.

    The error names another unit in which the number would be within them, if there is one.
    """
    unit = f" {metadata['unit']}" if metadata["unit"] else ""
    if not math.isfinite(value):
        raise ConfigError(f"`{key}` = {value} is not finite")
    for is_outside, word, bound in (
        (value < metadata["low"], "below", metadata["low"]),
        (value > metadata["high"], "above", metadata["high"]),
    ):
        if is_outside:
            shown, limit = (f"0x{value:X}", f"0x{bound:X}") if metadata["is_hex"] else (str(value), f"{bound:g}")
            raise ConfigError(f"`{key}` = {shown}{unit} is {word} {limit}{unit}{_other_unit(value, metadata)}")


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
"""Other units in which a value may have been given by mistake, as factors to the setting's unit."""


def _other_unit(value: float, metadata: Any) -> str:
    """Return a hint if a number outside a setting's bounds would be within them, given in another unit; else ""."""
    for unit, worth in _OTHER_UNITS.get(metadata["unit"], ()):
        if value and metadata["low"] <= value * worth <= metadata["high"]:
            return f"; {value:g} {unit} are {value * worth:g} {metadata['unit']}"
    return ""
