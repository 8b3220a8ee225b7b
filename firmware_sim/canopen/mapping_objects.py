"""Mapping parameters of a PDO: which objects may be mapped, and where they lie in the frame.

A mapping that begins with the end-to-end header's objects makes protected frames. Dummy entries (data types instead of
objects) leave gaps in frames that are received. Source: CiA 301 (4.2), 7.5.2.36 (0x1600) and 7.5.2.38 (0x1A00).
"""

import struct
from collections.abc import Sequence
from typing import NamedTuple

from firmware_sim.canopen.object_dictionary import Abort, ObjectDictionary, refuse

CLASSIC_BYTES, FD_BYTES = 8, 64
_FD_LENGTHS = (8, 12, 16, 20, 24, 32, 48, 64)

_HEADERS = {
    2: ((0x2100, 1), (0x2100, 2)),  # AUTOSAR Profile 2: CRC; counter and status
    4: ((0x2101, 1), (0x2101, 2), (0x2101, 3)),  # Profile 5: CRC, counter, status
}
_HEADER_OBJECTS = {key for keys in _HEADERS.values() for key in keys}


class Entry(NamedTuple):
    """One mapping entry: index << 16 | sub-index << 8 | bits."""

    key: tuple[int, int]
    bits: int


class Layout(NamedTuple):
    """What a frame holds: header_bytes, then `packing` with the values of `keys`, then padding up to `length`."""

    keys: tuple[tuple[int, int], ...]
    packing: struct.Struct
    header_bytes: int
    length: int


NOTHING = Layout((), struct.Struct("<"), 0, 0)


def check_entry(dictionary: ObjectDictionary, value: int, is_received: bool) -> str:
    """Refuse what can't be mapped in this direction; return the entry's `struct` format."""
    (index, subindex), bits = decode_entry(value)
    dummy_bits = dictionary.dummy_bits(index)
    if dummy_bits:
        if not is_received or subindex != 0 or bits != dummy_bits:
            refuse(Abort.NOT_MAPPABLE)
        return f"{bits // 8}x"
    variable = dictionary.find(index, subindex)
    is_reachable = variable.is_writable if is_received else variable.is_readable
    is_number = variable.format != "" and variable.bits % 8 == 0
    if not (variable.is_mappable and is_reachable and is_number) or bits != variable.bits:
        refuse(Abort.NOT_MAPPABLE)
    return variable.format


def decode_entry(value: int) -> Entry:
    """Take an entry apart."""
    return Entry((value >> 16, value >> 8 & 0xFF), value & 0xFF)


def lay_out(dictionary: ObjectDictionary, values: Sequence[int], is_received: bool, longest: int) -> Layout:
    """Place the mapped objects in a frame of at most `longest` bytes; refuse a mapping that can't be.

    A header must lead and be whole. Frames of more than 8 bytes have one of CAN FD's lengths.
    """
    formats = [check_entry(dictionary, value, is_received) for value in values]
    entries = [decode_entry(value) for value in values]
    size = sum(entry.bits for entry in entries) // 8
    if size > longest:
        refuse(Abort.PDO_TOO_LONG)
    keys = [entry.key for entry in entries]
    header_bytes = next((n for n, header in _HEADERS.items() if tuple(keys[: len(header)]) == header), 0)
    skipped = len(_HEADERS[header_bytes]) if header_bytes else 0
    if any(key in _HEADER_OBJECTS for key in keys[skipped:]):
        refuse(Abort.INCOMPATIBLE)
    length = size if size <= CLASSIC_BYTES else next(n for n in _FD_LENGTHS if n >= size)
    packing = struct.Struct("<" + "".join(formats[skipped:]) + f"{length - size}x")
    mapped = tuple(key for key in keys[skipped:] if not dictionary.dummy_bits(key[0]))
    return Layout(mapped, packing, header_bytes, length)
