"""Prints docs/settings.md: every setting with default, bounds, unit and meaning, as the product declares it.

    python tools/settings_page.py >docs/settings.md

Exit status: 0 printed, 2 wrong usage.
"""

import argparse
import dataclasses
import math
import sys
import typing
from collections.abc import Iterator
from typing import Any

from adacd_hil.settings.configuration import Settings

HEAD = (
    "# Settings\n\n"
    "Every key that a configuration may have. `python tools/settings_page.py` prints this page from the declarations "
    "in `adacd_hil/settings`, where a new setting goes; a test compares the two. How a configuration is found, "
    "extended and overridden: [overview.md](overview.md#configuration).\n\n"
    "The default is the declaration's. The built-in configurations in `adacd_hil/configs` and their profiles override "
    "many of them, above all those of `arm`, `controller` and the thresholds.\n"
)


def sections() -> Iterator[tuple[str, type[Any], str]]:
    """Give name, class and meaning of each table of a configuration; the first, without a name, is the top."""
    yield "", Settings, ""
    hints = typing.get_type_hints(Settings)
    for field in dataclasses.fields(Settings):
        if dataclasses.is_dataclass(hints[field.name]):
            yield field.name, hints[field.name], field.metadata["meaning"]


def rows_of(section: type[Any], prefix: str) -> Iterator[tuple[str, str, str, str]]:
    """Give key, default, bounds with unit, and meaning of each setting of a table, rows within it included."""
    hints = typing.get_type_hints(section)
    for field in dataclasses.fields(section):
        if dataclasses.is_dataclass(hints[field.name]):
            continue
        yield prefix + field.name, default_of(field), bounds_of(field.metadata), field.metadata["meaning"]
        for inner in typing.get_args(hints[field.name]):
            if dataclasses.is_dataclass(inner) and isinstance(inner, type):
                yield from rows_of(inner, f"{prefix}{field.name}[].")


def default_of(field: "dataclasses.Field[Any]") -> str:
    """Return a default as TOML has it; `required` where there is none."""
    return "required" if field.default is dataclasses.MISSING else as_toml(field.default)


def as_toml(value: Any) -> str:
    """Write a value as a configuration would."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(as_toml, value))}]"
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "none"}[value]
    return f'"{value}"' if isinstance(value, str) else f"{value:g}" if isinstance(value, float) else str(value)


def bounds_of(metadata: Any) -> str:
    """Return the choices, or the bounds with the unit; empty where there are none."""
    if metadata["choices"]:
        return ", ".join(metadata["choices"])
    low, high, unit = metadata["low"], metadata["high"], metadata["unit"]
    if math.isinf(high):
        return str(unit) if math.isinf(low) else f"≥ {low:g} {unit}".strip()
    return f"{low:g} … {high:g} {unit}".strip()


def page() -> str:
    """Return the page."""
    lines = [HEAD]
    for name, section, meaning in sections():
        lines.append(f"## {name}: {meaning}\n" if name else "## Top of the file\n")
        lines += ["| key | default | bounds | meaning |", "|---|---|---|---|"]
        prefix = f"{name}." if name else ""
        for key, *cells in rows_of(section, prefix):
            lines.append(f"| `{key}` | {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
        lines.append("")
    return "\n".join(lines)


def main() -> int:
    """Run the command line."""
    argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0]).parse_args()
    sys.stdout.write(page())
    return 0


if __name__ == "__main__":
    sys.exit(main())
