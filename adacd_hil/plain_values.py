"""Plain values for JSON, made from records, arrays, paths and numbers."""

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import PurePath
from typing import Any


def plain_values(value: Any, digits: int | None = None) -> Any:
    """Return a value in JSON's types: a record by its fields, an array as lists, null for infinity and NaN.

    A path becomes text; any other value is returned as it is. digits: significant digits of floats; None: all.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    elif hasattr(value, "_asdict"):
        value = value._asdict()
    elif hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain_values(item, digits) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_values(item, digits) for item in value]
    if isinstance(value, float):
        return None if not math.isfinite(value) else value if digits is None else float(f"{value:.{digits}g}")
    return str(value) if isinstance(value, PurePath) else value


def json_text(value: Any) -> str:
    """Return a value's plain values as JSON for a file or standard output."""
    return json.dumps(plain_values(value), indent=2, allow_nan=False)
