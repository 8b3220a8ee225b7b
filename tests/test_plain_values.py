"""Records, arrays, paths and numbers as JSON has them."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from adacd_hil.plain_values import json_text, plain_values


class Pair(NamedTuple):
    first: float
    second: tuple[float, ...]


@dataclass(frozen=True)
class Record:
    path: Path
    pairs: list[Pair]


@pytest.mark.parametrize(
    ("value", "digits", "plain"),
    [
        (Record(Path("a/b"), [Pair(0.5, (1.0,))]), None, {"path": "a/b", "pairs": [{"first": 0.5, "second": [1.0]}]}),
        (np.array([[1.5, np.nan], [np.inf, 2.0]]), None, [[1.5, None], [None, 2.0]]),
        ({"x": -float("inf"), 3: np.float32(0.5)}, None, {"x": None, "3": 0.5}),
        ([1234.5678, 7, True, None, "x"], 6, [1234.57, 7, True, None, "x"]),
    ],
)
def test_values_are_those_of_json(value: Any, digits: int | None, plain: Any) -> None:
    assert plain_values(value, digits) == plain
    assert json.loads(json_text(plain)) == plain
