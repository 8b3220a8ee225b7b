"""Files found by their built-in names, and TOML files, read within limits."""

import re
import tomllib
from collections.abc import Callable
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from adacd_hil.file_access import exists, read_input
from adacd_hil.printable import one_line
from adacd_hil.remedies import nearest_name
from adacd_hil.settings.schema import ConfigError

_MOST_TOML_BYTES = 1 << 20
_DEEPEST = 16
_LONGEST_KEY = 80
_TOO_DEEP = re.compile(r"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*"|'[^'\n]*')[ \t]*\.[ \t]*){64}""")
_DECIMAL_COMMA = re.compile(r"[\w-]++[ \t]*=[ \t]*[-+]?\d++,\d++")
_MOST_NAMES = 12
"""Most built-in names that an error message lists."""


def read_toml(path: Path, kind: str = "configuration") -> dict[str, Any]:
    """Return the table of one TOML file; errors call it `kind`.

    Raises ConfigError if it can't be read, or is not a regular file, too large or not TOML.
    """
    try:
        return parse_toml(read_input(path, _MOST_TOML_BYTES))
    except FileNotFoundError:
        raise ConfigError(f"{kind} {path} does not exist{_instead(path, kind)}") from None
    except (OSError, ConfigError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(f"{kind} {path}: {reason}") from None


def _instead(path: Path, kind: str) -> str:
    """Return a hint for a missing file: the TOML file with the nearest name beside it, else the command for a new one.

    "" without a near name if `kind` is no configuration.
    """
    try:
        beside = sorted(other.name for other in path.parent.glob("*.toml") if exists(other))
    except OSError:
        beside = []
    if nearest := nearest_name(path.name, beside):
        return f"; did you mean {str(path.parent / nearest)!r}?"
    return "; `adacd-hil init` writes one" if kind == "configuration" else ""


def parse_toml(text: bytes | str) -> dict[str, Any]:
    """Return the table of a TOML text, at most 16 deep, with integers of 64 bits.

    A byte order mark at the beginning, as editors on Windows write it, is ignored. Raises ConfigError with the reason;
    its cause is a TOMLDecodeError for a text that is no TOML, else None.
    """
    try:
        decoded = (text if isinstance(text, str) else text.decode("utf-8")).removeprefix("\ufeff")
    except UnicodeDecodeError as error:
        raise ConfigError(f"byte {error.start} is not UTF-8; save the file as UTF-8") from None
    try:
        if _TOO_DEEP.search(decoded):  # tomllib takes quadratic time for such a key
            raise RecursionError
        table = tomllib.loads(decoded)
    except RecursionError:
        raise ConfigError(f"more than {_DEEPEST} tables or lists within each other") from None
    except tomllib.TOMLDecodeError as error:
        comma = _DECIMAL_COMMA.search(decoded)
        hint = f"; `{comma[0]}`: a decimal point, not a comma?" if comma else ""
        raise ConfigError(f"{one_line(error)}{hint}") from error
    except ValueError:  # too many digits for Python
        raise ConfigError("an integer has more than 64 bits") from None
    _check_extent(table)
    return table


def _check_extent(table: dict[str, Any]) -> None:
    """Raise ConfigError for tables or lists that are too deep, and for integers of more than 64 bits."""
    waiting: list[tuple[str, Any, int]] = [("", table, 0)]
    while waiting:
        key, value, depth = waiting.pop()
        if depth > _DEEPEST:
            raise ConfigError(f"`{key}`: more than {_DEEPEST} tables or lists within each other")
        if isinstance(value, dict):
            waiting += [(f"{key}.{name}".lstrip(".")[:_LONGEST_KEY], item, depth + 1) for name, item in value.items()]
        elif isinstance(value, list):
            waiting += [(key, item, depth + 1) for item in value]
        elif isinstance(value, int) and not -(2**63) <= value < 2**63:
            raise ConfigError(f"`{key}` is an integer of more than 64 bits")


def builtin_folder() -> Traversable:
    """Return the folder of the built-in configurations."""
    return resources.files("adacd_hil") / "configs"


def builtin_names() -> list[str]:
    """Return the names of the built-in configurations."""
    return toml_names(builtin_folder())


def toml_names(folder: Traversable, suffix: str = ".toml") -> list[str]:
    """Return the names of the TOML files in a package's folder, or of files with another suffix, without that."""
    return sorted(entry.name.removesuffix(suffix) for entry in folder.iterdir() if entry.name.endswith(suffix))


def find_named(
    kind: str,
    name_or_file: str,
    folder: Traversable,
    suffix: str = ".toml",
    is_shown: Callable[[str], bool] = lambda _: True,
) -> Path:
    """Return the file of a built-in name in `folder`, or the given path; a path with a suffix may be missing.

    Raises ConfigError for any other name, with the nearest built-in one. kind: of the file, for the error. suffix: of
    the files in the folder. is_shown: whether that error may show a built-in name.
    """
    names = toml_names(folder, suffix)
    if name_or_file in names:
        return Path(str(folder / f"{name_or_file}{suffix}"))
    path = Path(name_or_file)
    if not name_or_file or (not path.suffix and not exists(path)):
        names = [name for name in names if is_shown(name)]
        nearest = nearest_name(name_or_file, names)
        some = ", ".join(names) if len(names) <= _MOST_NAMES else f"{len(names)}, such as {', '.join(names[:3])}"
        hint = f"; did you mean {nearest!r}?" if nearest else f"; built in: {some}"
        raise ConfigError(f"{kind} {name_or_file!r} is neither built in nor a file{hint}")
    return path
