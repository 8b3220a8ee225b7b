"""Records that compiled code works on, declared as typed classes.

A class of record names its fields, their types and their shapes once::

    class Ring:
        tau: Annotated[Vector, "waiting n"]  # an array, by the names of its sizes
        used: float  # a number, as int, bool, and others by Annotated[int, np.uint8]

`zeros_of` makes the memory, `packed` puts an instance of a dataclass into it. Compiled code and Python read and write
the same fields as attributes, `m.ring.tau`, and mypy checks them.

At each call of compiled code numba looks up the types of the arguments: in 0.2 us if the description of the record is
the object that it knows, in 5 to 10 us if it is another one that is equal, field by field. So equal descriptions are
one and the same object.
"""

import dataclasses
from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

Structured = np.ndarray[Any, np.dtype[np.void]]
Record = np.dtype[np.void]
"""The description of a record."""
Shape = tuple[int, ...]
_Field = tuple[str, Any, Shape]

_Array = NDArray[np.float64]
PerJoint = Annotated[_Array, "n"]
PerParameter = Annotated[_Array, "p"]
Columns = Annotated[_Array, "n p"]
Square = Annotated[_Array, "p p"]

_NUMBERS: dict[Any, type[np.generic]] = {float: np.float64, int: np.int64, bool: np.bool_}


def described(kind: type[Any], sizes: Mapping[str, int]) -> Record:
    """Return numpy's description of a record of a class; of equal fields the same object.

    sizes: by the names of dimensions in the class and the classes in it. Raises ValueError for a field whose name is
    numpy's own, KeyError for a dimension without a size.
    """
    return _described(
        tuple(_field_of(name, hint, sizes) for name, hint in get_type_hints(kind, include_extras=True).items())
    )


def zeros_of(kind: type[Any], sizes: Mapping[str, int]) -> Structured:
    """Return one record (1,) of a class, all zeros. sizes: by the names of dimensions in the class.

    Raises ValueError for a field whose name is numpy's own, KeyError for a dimension without a size.
    """
    return np.zeros(1, described(kind, sizes))


def packed(values: Any) -> Structured:
    """Return one record (1,) with copies of the fields of an instance of a dataclass, all float64.

    Its fields are numbers, arrays and such instances, which become records in it. Raises ValueError for a field whose
    name is numpy's own.
    """
    record = np.zeros(1, _described_as(values))
    _fill(record[0], values)
    return record


def float_fields(shapes: Mapping[str, Shape]) -> Record:
    """Return the description of a record of float64 fields of these shapes; read a field as `record["name"]`."""
    return _flat(tuple(shapes.items()))


@cache
def _flat(shapes: tuple[tuple[str, Shape], ...]) -> Record:
    return np.dtype([(name, np.float64, shape) for name, shape in shapes])


def _field_of(name: str, hint: Any, sizes: Mapping[str, int]) -> _Field:
    """Return name, type and shape of a field from its annotation: an array, a number, or a record in it."""
    if hasattr(hint, "__metadata__"):
        kind, dimensions = hint.__origin__, hint.__metadata__[0]
        if isinstance(dimensions, type):
            return name, dimensions, ()
        number = _NUMBERS[kind] if kind in _NUMBERS else get_args(get_args(kind)[1])[0]
        return name, number, tuple(int(d) if d.isdigit() else sizes[d] for d in dimensions.split())
    if hint in _NUMBERS:
        return name, _NUMBERS[hint], ()
    return name, described(hint, sizes), ()


def _described_as(values: Any) -> Record:
    """Return the description of a record that holds an instance of a dataclass, all float64."""
    found = ((field.name, getattr(values, field.name)) for field in dataclasses.fields(values))
    return _described(
        tuple(
            (name, _described_as(value), ()) if dataclasses.is_dataclass(value) else (name, np.float64, np.shape(value))
            for name, value in found
        )
    )


def _fill(record: Any, values: Any) -> None:
    """Copy the fields of an instance of a dataclass, and of instances in it, into a record."""
    for field in dataclasses.fields(values):
        value = getattr(values, field.name)
        if dataclasses.is_dataclass(value):
            _fill(record[field.name], value)
        else:
            record[field.name] = value


@cache
def _described(fields: tuple[_Field, ...]) -> Record:
    """Return the description of a record of fields (name, type, shape), the same object for equal fields.

    Raises ValueError for a field whose name is numpy's own attribute of a record.
    """
    if taken := [name for name, _, _ in fields if hasattr(np.record, name)]:
        raise ValueError(f"field {', '.join(taken)}: numpy's own attribute of a record")
    return np.dtype((np.record, list(fields)))
