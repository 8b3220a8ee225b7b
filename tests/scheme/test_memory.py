"""Records of compiled code: each declared once, by a class."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pytest
from numpy.typing import NDArray

from adacd_hil.structured import PerJoint, described, packed, zeros_of


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
