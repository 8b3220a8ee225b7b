"""Records of compiled code: declared once, and each field of memory written by one module."""

import ast
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, get_type_hints

import numpy as np
import pytest
from numpy.typing import NDArray

from adacd_hil.scheme import memory
from adacd_hil.structured import PerJoint, described, packed, zeros_of

SCHEME = Path(memory.__file__).parent


class Inner:
    used: float
    counts: Annotated[NDArray[np.int64], "n 3"]


class Outer:
    ways: PerJoint
    inner: Inner
    is_open: bool
    state: Annotated[int, np.uint8]


def test_a_record_has_the_fields_types_and_shapes_of_its_class():
    record = zeros_of(Outer, {"n": 2})[0]
    assert record.ways.shape == (2,)
    assert record.inner.counts.shape == (2, 3)
    kinds = [record.dtype[name].base for name in ("ways", "is_open", "state")]
    assert kinds == [np.float64, np.bool_, np.uint8]
    assert record.inner.counts.dtype == np.int64
    record.inner.used = 3.0
    assert record["inner"]["used"] == 3.0


def test_equal_descriptions_are_one_object():
    assert described(Outer, {"n": 2}) is described(Outer, {"n": 2})


@dataclass
class Numbers:
    gain: float
    rows: np.ndarray


@dataclass
class Both:
    numbers: Numbers
    count: int


def test_values_are_packed_by_their_names():
    record = packed(Both(Numbers(2.5, np.eye(2)), 7))[0]
    assert (record.numbers.gain, record.count) == (2.5, 7.0)
    np.testing.assert_array_equal(record.numbers.rows, np.eye(2))


def test_a_field_that_numpy_s_records_have_themselves_is_refused():
    class Wrong:
        base: float

    with pytest.raises(ValueError, match="base"):
        zeros_of(Wrong, {})


def owners() -> dict[str, set[str]]:
    """Return by record of `Memory` the modules that its docstring names."""
    return {
        name: set(re.findall(r"`(?:\w+\.)*(\w+)`", re.split("written by", kind.__doc__, flags=re.IGNORECASE)[-1]))
        for name, kind in get_type_hints(memory.Memory).items()
    }


def written(path: Path) -> set[str]:
    """Name the records of `Memory` of which a module writes a field: `m.record.field = ...`, or a part of it."""
    found, tree = set(), ast.parse(path.read_text())
    own = {ast.unparse(node.value)[2:] for node in ast.walk(tree) if isinstance(node, ast.Assign)
           and ast.unparse(node.targets[0]) == "own" and ast.unparse(node.value).startswith("m.")}  # fmt: skip
    assert len(own) <= 1, path
    for node in ast.walk(tree):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        for target in targets:
            for place in target.elts if isinstance(target, ast.Tuple) else [target]:
                text = "" if place is None else ast.unparse(place)
                text = re.sub(r"^own\.", f"m.{next(iter(own), '')}.", text)
                match = re.fullmatch(r"(?:self\._)?m\.(\w+)\.\w+(?:\[.*\])?", text)
                if match is not None:
                    found.add(match[1])
    return found


def test_each_record_of_memory_is_written_by_the_modules_that_it_names():
    allowed = owners()
    assert all(allowed.values())
    wrong = [
        f"{path.name} writes m.{record}"
        for path in sorted(SCHEME.rglob("*.py"))
        for record in written(path) & set(allowed)
        if path.stem not in allowed[record]
    ]
    assert wrong == []
