"""Frozen settings with unit and bounds: a section is a frozen dataclass whose fields are made by `setting`.

Field names carry their unit. `adacd_hil.settings.parsing` makes sections from TOML tables.
"""

import dataclasses
import math
from typing import Any


class ConfigError(ValueError):
    """Settings that can't be used. The message is the first problem, one line: key, value, bound, unit.

    problems: all of them, a line each.
    """

    def __init__(self, *problems: str) -> None:
        super().__init__(*problems[:1])
        self.problems = problems


class DetectorError(ConfigError):
    """A package's detector that can't be used: it can't be imported, or breaks the detectors' contract."""


def setting(
    default: Any = dataclasses.MISSING,
    *,
    unit: str = "",
    low: float = -math.inf,
    high: float = math.inf,
    choices: tuple[str, ...] = (),
    is_hex: bool = False,
    meaning: str,
) -> Any:
    """Return the dataclass field of one setting; it is required if `default` is missing.

    If `default` is a class, such as a section, the default value is a new instance of it. The rest is stored for
    `parse`, which checks it. low, high: bounds, inclusive, also of each number of a tuple. choices: permitted texts;
    (): any. meaning: for the user. is_hex: an integer that everybody writes in hexadecimal, such as an index; messages
    do, too.
    """
    metadata = {"unit": unit, "low": low, "high": high, "choices": choices, "is_hex": is_hex, "meaning": meaning}
    if isinstance(default, type):
        return dataclasses.field(default_factory=default, metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)
