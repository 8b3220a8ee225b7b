"""Settings written as TOML that `adacd_hil.settings.parsing` reads back to the same value."""

import dataclasses
from typing import Any


def to_toml(settings: Any) -> str:
    """Return settings as TOML that `parse` reads back to the same value; those that are None are left out."""
    lines: list[str] = []
    _write_section(settings, "", lines)
    return "\n".join(lines).strip() + "\n"


def to_short_toml(settings: Any) -> str:
    """Return the settings that differ from their defaults as TOML that `parse` reads back to the same settings.

    Each row of a list of tables has a line.
    """
    lines: list[str] = []
    _write_section(settings, "", lines, is_short=True)
    return "\n".join(lines).strip() + "\n"


def is_default(field: "dataclasses.Field[Any]", value: Any) -> bool:
    """Return whether a setting's value equals its default; False for a setting without one."""
    if field.default_factory is not dataclasses.MISSING:
        return bool(value == field.default_factory())
    return field.default is not dataclasses.MISSING and bool(value == field.default)


def _write_section(section: Any, prefix: str, lines: list[str], is_short: bool = False) -> None:
    """Append a section's settings that aren't None, without its own heading, then each section within it with heading.

    prefix: the section's dotted name and a dot, "" at the top. is_short: leave out defaults, give each row of a list a
    line.
    """
    nested = []
    for field in dataclasses.fields(section):
        value = getattr(section, field.name)
        if is_short and is_default(field, value):
            continue
        if dataclasses.is_dataclass(value):
            nested.append((field.name, value))
        elif isinstance(value, tuple) and value and dataclasses.is_dataclass(value[0]):
            if is_short:
                rows = (f"    {toml_value(item, is_short)}," for item in value)
                lines.extend((f"{field.name} = [", *rows, "]"))
            else:
                lines.append(f"{field.name} = {toml_value(value)}")
        elif value is not None:
            lines.append(f"{field.name} = {toml_value(value)}")
    for name, value in nested:
        lines.extend(("", f"[{prefix}{name}]"))
        _write_section(value, f"{prefix}{name}.", lines, is_short)


_TOML_ESCAPES = {code: f"\\u{code:04X}" for code in (*range(0x20), 0x7F)} | {
    ord('"'): '\\"',
    ord("\\"): "\\\\",
}


def toml_value(value: Any, is_short: bool = False) -> str:
    """Return a number, a text, settings, or a tuple of such values as TOML in one line that reads back to the same.

    is_short: leave out defaults of settings.
    """
    if dataclasses.is_dataclass(value):
        entries = [
            f"{field.name} = {toml_value(one, is_short)}"
            for field in dataclasses.fields(value)
            if (one := getattr(value, field.name)) is not None and not (is_short and is_default(field, one))
        ]
        return "{" + ", ".join(entries) + "}"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + value.translate(_TOML_ESCAPES) + '"'
    if isinstance(value, tuple):
        return "[" + ", ".join(toml_value(item, is_short) for item in value) + "]"
    return repr(value)
