"""The end of an MCAP file: its footer, and the summary where its CRC fits."""

import os
from typing import IO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Footer

from adacd_hil.log.errors import LogError
from adacd_hil.log.mcap.mcap_records import HEAD, MAGIC, MOST_RECORD_BYTES, RawRecord, crc32, parse

_BLOCK = 1 << 20
_FOOTER = HEAD.size + 20
_DATA_END = HEAD.size + 4


class FileEnd(NamedTuple):
    """What the end of a file says."""

    data_end: int  # where the DataEnd begins
    data_crc: int  # stored there; 0: none
    summary: list[RawRecord]  # empty where its CRC doesn't fit


def read_end(file: IO[bytes]) -> FileEnd | None:
    """Read the end of a file; None where there is none."""
    found = _find(file)
    if found is None:
        return None
    place, end, footer = found
    data_end = _read(file, end - _DATA_END, _DATA_END)
    if data_end[0] != Opcode.DATA_END:
        return None
    data_crc = int.from_bytes(data_end[HEAD.size :], "little")
    summary: list[RawRecord] = []
    if (
        footer.summary_crc
        and place - end <= MOST_RECORD_BYTES
        and footer.summary_crc == crc_of(file, end, place + _FOOTER - 4)
    ):
        summary = _split(_read(file, end, place - end), end)
    return FileEnd(end - _DATA_END, data_crc, summary)


def summary_of(file: IO[bytes]) -> list[RawRecord]:
    """Read the summary of a file, whether or not it has a CRC that fits; empty where there is none."""
    found = _find(file)
    if found is None or found[0] - found[1] > MOST_RECORD_BYTES:
        return []
    place, end, _ = found
    return _split(_read(file, end, place - end), end)


def _find(file: IO[bytes]) -> tuple[int, int, Footer] | None:
    """Find where the footer is, and where the summary begins; None where there is no end."""
    size = file.seek(0, os.SEEK_END)
    place = size - len(MAGIC) - _FOOTER
    tail = _read(file, max(0, place), _FOOTER + len(MAGIC))
    if place < len(MAGIC) + _DATA_END or not tail.endswith(MAGIC) or tail[0] != Opcode.FOOTER:
        return None
    footer: Footer = parse(Opcode.FOOTER, tail[HEAD.size : _FOOTER])
    end = footer.summary_start or place
    return (place, end, footer) if len(MAGIC) + _DATA_END <= end <= place else None


def _split(data: bytes, offset: int) -> list[RawRecord]:
    records = []
    position = 0
    while position + HEAD.size <= len(data):
        opcode, length = HEAD.unpack_from(data, position)
        start = position + HEAD.size
        records.append(RawRecord(offset + position, opcode, data[start : start + length]))
        position = start + length
    return records


def read_record(file: IO[bytes], offset: int) -> RawRecord:
    """Read the record that begins at `offset`. Raises LogError when there is none."""
    head = _read(file, offset, HEAD.size)
    if len(head) < HEAD.size:
        raise LogError(f"no record at byte {offset}")
    opcode, length = HEAD.unpack(head)
    size = os.fstat(file.fileno()).st_size
    if length > min(size - offset - HEAD.size, MOST_RECORD_BYTES):
        raise LogError(f"no record at byte {offset}")
    return RawRecord(offset, opcode, file.read(length))


def crc_of(file: IO[bytes], start: int, end: int) -> int:
    """Compute the CRC of a stretch of a file."""
    crc = 0
    file.seek(start)
    while start < end and (block := file.read(min(_BLOCK, end - start))):
        crc = crc32(block, crc)
        start += len(block)
    return crc


def _read(file: IO[bytes], place: int, count: int) -> bytes:
    file.seek(place)
    return file.read(count)
