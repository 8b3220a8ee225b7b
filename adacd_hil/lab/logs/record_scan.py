"""Finds the records of a damaged file: those that still have the shape of their kind, and the gaps between them."""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import (
    Header,
)

from adacd_hil.file_access import open_input
from adacd_hil.log.log_files import LogError
from adacd_hil.log.mcap.mcap_records import MOST_RECORD_BYTES, RawRecord, fits, has_shape, parse, read_bytes
from adacd_hil.log.mcap.record_layout import HEAD, MAGIC

_BEGINNING = re.compile(rb"(?=[\x01-\x04\x06-\x0f].{5}\0\0\0)", re.DOTALL)
"""Possible beginning of a record of less than a TiB."""


_WINDOW = 1 << 20
"""Bytes that are searched at once for the next record."""


class FileGap(NamedTuple):
    """Bytes of a file that belong to no record. is_behind: they follow the end, as of a second file."""

    offset: int
    size: int
    is_behind: bool = False


def scan(file: IO[bytes]) -> Iterator[RawRecord | FileGap]:
    """Yield the records of a file, and the gaps between them, where no record could be found.

    All that follows a Footer with MCAP's magic is one gap.
    """
    size = os.fstat(file.fileno()).st_size
    position = len(MAGIC) if read_bytes(file, 0, len(MAGIC)) == MAGIC else 0
    while position < size:
        head = _head(file, position, size)
        if head is None:
            found = _find_next(file, position + 1, size)
            yield FileGap(position, found - position)
            position = found
            continue
        record = RawRecord(position, head[0], read_bytes(file, position + HEAD.size, head[1]))
        yield record
        position = record.end
        if record.opcode == Opcode.FOOTER and read_bytes(file, position, len(MAGIC)) == MAGIC:
            position += len(MAGIC)
            if position < size:
                yield FileGap(position, size - position, is_behind=True)
            return


def _head(file: IO[bytes], position: int, size: int) -> tuple[int, int] | None:
    """Return opcode of the record at `position` of a file of `size` bytes, and length of its contents, bytes.

    None if its contents don't fit its kind and length, or end behind the file. A record of an unknown kind counts if a
    known one follows.
    """
    head = read_bytes(file, position, HEAD.size)
    if len(head) < HEAD.size:
        return None
    opcode, length = HEAD.unpack(head)
    start = position + HEAD.size
    if not opcode or length > min(size - start, MOST_RECORD_BYTES):
        return None
    if opcode in set(Opcode):
        is_there = fits(opcode, length, lambda place, count: read_bytes(file, start + place, count))
    else:  # a kind that is not known, if a known one follows
        is_there = _is_shaped(file, start + length, size)
    return (opcode, length) if is_there else None


def _is_shaped(file: IO[bytes], position: int, size: int) -> bool:
    """Return whether at `position` a record begins whose kind and contents confirm its length."""
    opcode = read_bytes(file, position, 1)
    return bool(opcode) and has_shape(opcode[0]) and _head(file, position, size) is not None


def _find_next(file: IO[bytes], position: int, size: int) -> int:
    """Return the offset of the next record, from `position` on, whose contents confirm its length.

    `size` if there is none.
    """
    while position < size:
        window = read_bytes(file, position, _WINDOW + HEAD.size)
        for match in _BEGINNING.finditer(window):
            if _is_shaped(file, position + match.start(), size):
                return position + match.start()
        position += _WINDOW
    return size


def read_header(path: Path) -> Header | None:
    """Return the Header of an MCAP file; None if the file can't be read or doesn't begin with one."""
    try:
        with open_input(path) as file:
            first = next(scan(file), None)
        if not isinstance(first, RawRecord) or first.opcode != Opcode.HEADER:
            return None
        header: Header = parse(first.opcode, first.body)
    except (OSError, LogError):
        return None
    return header


def chunk_crc(record: RawRecord) -> int:
    """Return the CRC that a chunk stores, that of its decompressed records; 0 if it stores none.

    A record that is too short gives another number or 0.
    """
    return int.from_bytes(record.body[24:28], "little")
