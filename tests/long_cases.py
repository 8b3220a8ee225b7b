"""Cases of a test that takes long: some are played by `make test`, all by `make test-all`."""

from collections.abc import Iterable
from typing import Any

import pytest


def long_but(kept: int, cases: Iterable[Any]) -> list[Any]:
    """Mark the cases of `pytest.mark.parametrize` as long, but for so many at the beginning."""
    return [
        case if number < kept else pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.long)
        for number, case in enumerate(cases)
    ]
