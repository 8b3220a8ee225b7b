"""Structured arrays of one element: what compiled steps read and write by name, as their callers do."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

Structured = np.ndarray[Any, np.dtype[np.void]]


def packed(values: Mapping[str, ArrayLike]) -> Structured:
    """Put values of any shape into one element (1,), as float64."""
    element = zeroed({name: np.shape(value) for name, value in values.items()})
    for name, value in values.items():
        element[name] = value
    return element


def zeroed(shapes: Mapping[str, tuple[int, ...]]) -> Structured:
    """Return one element (1,) of zeros, float64, with a field of each shape."""
    return np.zeros(1, np.dtype([(name, np.float64, shape) for name, shape in shapes.items()]))
