"""The records of an MCAP file: in order, at the end of the file, and parsed by mcap's classes.

A record repeats its length: its strings, maps and arrays must fill exactly the lengths that they state. In random bytes
that happens once in 2^72 and more, so that it shows where records resume after damage. A message record has no such
shape.

Constant memory: one record at a time; one of more than MOST_RECORD_BYTES is none. Chunks stay closed.
"""

import io
import os
import struct
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import IO, Any, NamedTuple

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Footer, Schema

from adacd_hil.log.log_files import LogError
from adacd_hil.log.mcap.record_layout import HEAD, MAGIC, crc32

_TEXT = _TABLE = -4  # a length of 4 bytes, then so many bytes
_DATA = -8  # a length of 8 bytes, then so many bytes

_SHAPES: dict[int, tuple[int, ...]] = {
    Opcode.HEADER: (_TEXT, _TEXT),
    Opcode.FOOTER: (20,),
    Opcode.SCHEMA: (2, _TEXT, _TEXT, _TABLE),
    Opcode.CHANNEL: (4, _TEXT, _TEXT, _TABLE),
    Opcode.CHUNK: (28, _TEXT, _DATA),
    Opcode.MESSAGE_INDEX: (2, _TABLE),
    Opcode.CHUNK_INDEX: (32, _TABLE, 8, _TEXT, 16),
    Opcode.ATTACHMENT: (16, _TEXT, _TEXT, _DATA, 4),
    Opcode.ATTACHMENT_INDEX: (40, _TEXT, _TEXT),
    Opcode.STATISTICS: (42, _TABLE),
    Opcode.METADATA: (_TEXT, _TABLE),
    Opcode.METADATA_INDEX: (16, _TEXT),
    Opcode.SUMMARY_OFFSET: (17,),
    Opcode.DATA_END: (4,),
}
LEAST_MESSAGE = 22
"""Bytes of a message record without payload, without opcode and length."""


def has_shape(opcode: int) -> bool:
    """Return whether the fields of this kind of record must fill it exactly; False for messages, unknown kinds."""
    return opcode in _SHAPES


def fits(opcode: int, length: int, read: Callable[[int, int], bytes]) -> bool:
    """Return whether the lengths in a record add up to `length`, the size of its body.

    read: a function that returns bytes of the body, by offset and count. A message fits from LEAST_MESSAGE bytes on; a
    record of an unknown kind never fits.
    """
    if opcode not in _SHAPES:
        return opcode == Opcode.MESSAGE and length >= LEAST_MESSAGE
    position = 0
    for part in _SHAPES[opcode]:
        if part > 0:
            position += part
            continue
        prefix = read(position, -part)
        position += -part + int.from_bytes(prefix, "little")
        if position > length or len(prefix) < -part:
            return False
    return position == length


MOST_RECORD_BYTES = 64 << 20
"""Of a record that is read. A chunk of ours has 0.1 MB, one of others up to 16 MB; an attachment of a run 0.2 MB."""
CHANNEL_NUMBERS = 1 << 16
DEFINITIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
_PIECE_BYTES = 1 << 20
"""Read at once for a CRC."""
_RUN_BYTES = 40 << 10
"""Read at once of message indexes. A chunk of ours has 33 KB of them, in 30 records."""
_INDEX_HEAD = 6
"""Bytes of a message index before its entries: its channel, how many bytes they have."""


class RawRecord(NamedTuple):
    """A record as it is in the file. offset: where it begins; body: its bytes after opcode and length."""

    offset: int
    opcode: int
    body: bytes

    @property
    def end(self) -> int:
        """Offset of the next record; too low for a record that came without its whole body, see `walk`."""
        return self.offset + HEAD.size + len(self.body)


class IndexRun(NamedTuple):
    """Message indexes that follow each other in a file."""

    data: bytes  # their records
    entries: list[bytes]  # of each


class Problem(NamedTuple):
    """A defect of a file, in words. `is_damage`: the words complete "the file is", such as "cut after 5 bytes"."""

    text: str
    is_damage: bool = False


def name_of(opcode: int) -> str:
    """Return the name of a kind of record as in the specification, such as ChunkIndex.

    Of an unknown kind return its number, such as "record 0x2a".
    """
    if opcode not in set(Opcode):
        return f"record 0x{opcode:02x}"
    return "".join(word.capitalize() for word in Opcode(opcode).name.split("_"))


_READERS: dict[int, Any] = {opcode: getattr(records, name_of(opcode)).read for opcode in _SHAPES}
"""mcap's classes have the names of the specification."""


def parse(opcode: int, body: bytes) -> Any:
    """Parse a record's body to mcap's class for its kind; ignore bytes after its last field.

    Raises LogError for a body that can't be read as that kind; KeyError for a message or an unknown kind.
    """
    try:
        return _READERS[opcode](ReadDataStream(io.BytesIO(body)))
    except (McapError, struct.error, ValueError, OverflowError, MemoryError) as error:
        raise LogError(f"{name_of(opcode)} can't be read: {error or type(error).__name__}") from None


def check_magic(begin: bytes, name: str) -> None:
    """Raise LogError unless `begin`, the first bytes of a file, are those of MCAP.

    name: with which the message begins.
    """
    if begin != MAGIC:
        cut = f"cut after {len(begin)} bytes" if begin else "empty"
        raise LogError(f"{name} is {cut if MAGIC.startswith(begin) else 'not an MCAP file'}")


def walk(file: IO[bytes], name: str, passed: Collection[int] = ()) -> Iterator[RawRecord | IndexRun | Problem]:
    """Yield the records of a file up to its footer, or to bytes that can't be a record.

    Message indexes that follow each other come as one IndexRun, or as several if they are long. Unless the footer and
    the file's last magic bytes are reached, and nothing follows, the last item is a Problem; so it is behind an
    overlong record. passed: kinds of records that come without their body. Raises LogError, which begins with `name`,
    if the file isn't MCAP.
    """
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    check_magic(file.read(len(MAGIC)), name)
    position, is_whole = len(MAGIC), False
    while len(head := file.read(HEAD.size)) == HEAD.size:
        opcode, length = HEAD.unpack(head)
        if length > MOST_RECORD_BYTES:
            yield Problem(f"the record at byte {position} has {length} bytes, more than {MOST_RECORD_BYTES}")
            return
        end = position + HEAD.size + length
        if not opcode or end > size:
            break
        if opcode in passed:
            file.seek(length, io.SEEK_CUR)
            yield RawRecord(position, opcode, b"")
        elif opcode == Opcode.MESSAGE_INDEX:
            run = _index_run(head + file.read(max(length, _RUN_BYTES)))
            if not run.data:  # the file has become shorter meanwhile
                break
            end = position + len(run.data)
            file.seek(end)
            yield run
        else:
            body = file.read(length)
            if len(body) < length:
                break
            yield RawRecord(position, opcode, body)
        position = end
        if opcode == Opcode.FOOTER:
            is_whole = file.read(len(MAGIC)) == MAGIC
            if is_whole and (rest := size - file.tell()) > 0:
                yield Problem(f"{rest} bytes follow the end")
            break
    if not is_whole:
        yield Problem(f"cut after {size} bytes", is_damage=True)


def _index_run(data: bytes) -> IndexRun:
    """Return the whole message indexes at the beginning of `data`; empty if the first is cut."""
    position, size, entries = 0, len(data), []
    unpack, index, head = HEAD.unpack_from, int(Opcode.MESSAGE_INDEX), HEAD.size
    while position + head <= size:
        opcode, length = unpack(data, position)
        begin = position + head
        end = begin + length
        if opcode != index or end > size:
            break
        entries.append(data[begin + _INDEX_HEAD : end])
        position = end
    return IndexRun(data[:position], entries)


def attachment_crc_fits(record: RawRecord, can_lack: bool = True) -> bool:
    """Return whether an attachment fits its CRC. can_lack: a stored CRC of 0, which stands for no CRC, fits, too."""
    stored = int.from_bytes(record.body[-4:], "little")
    return stored == crc32(record.body[:-4]) or (stored == 0 and can_lack)


_FOOTER = HEAD.size + 20
_DATA_END = HEAD.size + 4


class FileEnd(NamedTuple):
    """Position and CRC of the data section, and the summary, as the end of the file has them."""

    data_end: int  # where the DataEnd begins
    data_crc: int  # stored there; 0: no CRC
    summary: list[RawRecord]  # empty if its CRC doesn't fit, or if both its CRC and its records' shape are missing


def read_end(file: IO[bytes]) -> FileEnd | None:
    """Return the end of a file: its data section's end and CRC, and its summary.

    None if the file has no footer or an impossible offset in it, or no DataEnd before its summary. The summary is [] if
    its CRC doesn't fit, or, without a CRC, if a record's lengths don't.
    """
    found = _find(file)
    if found is None:
        return None
    place, end, footer = found
    data_end = read_bytes(file, end - _DATA_END, _DATA_END)
    if data_end[0] != Opcode.DATA_END:
        return None
    data_crc = int.from_bytes(data_end[HEAD.size :], "little")
    summary = summary_of(file)
    if footer.summary_crc:
        is_sound = footer.summary_crc == crc_of(file, end, place + _FOOTER - 4)
    else:
        is_sound = all(_has_shape(record) for record in summary)
    return FileEnd(end - _DATA_END, data_crc, summary if is_sound else [])


def _has_shape(record: RawRecord) -> bool:
    """Return whether the lengths in a record add up to the size of its body.

    False for a message, and for a record of an unknown kind.
    """
    body = record.body
    return has_shape(record.opcode) and fits(record.opcode, len(body), lambda place, count: body[place : place + count])


def summary_of(file: IO[bytes]) -> list[RawRecord]:
    """Return the records of a file's summary, whether or not its CRC fits.

    [] if the file has no footer or an impossible offset in it, or the summary has more than MOST_RECORD_BYTES.
    """
    found = _find(file)
    if found is None or found[0] - found[1] > MOST_RECORD_BYTES:
        return []
    place, end, _ = found
    return _split(read_bytes(file, end, place - end), end)


def _find(file: IO[bytes]) -> tuple[int, int, Footer] | None:
    """Return the offset of the footer, that of the summary, and the footer.

    Without a summary both offsets are the footer's. None for a file that ends without a footer, or whose footer has an
    impossible offset.
    """
    size = file.seek(0, os.SEEK_END)
    place = size - len(MAGIC) - _FOOTER
    tail = read_bytes(file, max(0, place), _FOOTER + len(MAGIC))
    if place < len(MAGIC) + _DATA_END or not tail.endswith(MAGIC) or tail[0] != Opcode.FOOTER:
        return None
    footer: Footer = parse(Opcode.FOOTER, tail[HEAD.size : _FOOTER])
    end = footer.summary_start or place
    return (place, end, footer) if len(MAGIC) + _DATA_END <= end <= place else None


def _split(data: bytes, offset: int) -> list[RawRecord]:
    """Return the records that follow each other in `data`; the body of the last may be cut.

    offset: position of `data` in the file.
    """
    records = []
    position = 0
    while position + HEAD.size <= len(data):
        opcode, length = HEAD.unpack_from(data, position)
        start = position + HEAD.size
        records.append(RawRecord(offset + position, opcode, data[start : start + length]))
        position = start + length
    return records


def read_record(file: IO[bytes], offset: int) -> RawRecord:
    """Return the record that begins at `offset`. Raises LogError if the file ends within it, or it is overlong."""
    head = read_bytes(file, offset, HEAD.size)
    if len(head) < HEAD.size:
        raise LogError(f"no record at byte {offset}")
    opcode, length = HEAD.unpack(head)
    size = os.fstat(file.fileno()).st_size
    if length > min(size - offset - HEAD.size, MOST_RECORD_BYTES):
        raise LogError(f"no record at byte {offset}")
    return RawRecord(offset, opcode, file.read(length))


def crc_of(file: IO[bytes], start: int, end: int, crc: int = 0) -> int:
    """Return the CRC of the bytes of a file from start to end - 1; crc: that of the bytes before them."""
    file.seek(start)
    while start < end and (block := file.read(min(_PIECE_BYTES, end - start))):
        crc = crc32(block, crc)
        start += len(block)
    return crc


def read_bytes(file: IO[bytes], place: int, count: int) -> bytes:
    """Return up to `count` bytes of a file from an offset on, fewer at its end."""
    file.seek(place)
    return file.read(count)


class Definitions:
    """Schemas and channels by their numbers."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}

    def add_record(self, record: RawRecord) -> Schema | Channel:
        """Add the schema or channel in a record and return it; adding an equal one again changes nothing.

        Raises LogError for a record that can't be parsed, or that gives a known number another meaning.
        """
        definition: Schema | Channel = parse(record.opcode, record.body)
        known: dict[int, Any] = self.schemas if isinstance(definition, Schema) else self.channels
        if known.setdefault(definition.id, definition) != definition:
            raise LogError(f"{type(definition).__name__.lower()} {definition.id} is defined in two ways")
        return definition

    def add_records(self, records: Iterable[RawRecord]) -> None:
        """Add the schemas and channels among some records; ignore the others.

        Raises LogError for one that can't be parsed, or that gives a known number another meaning.
        """
        for record in records:
            if record.opcode in DEFINITIONS:
                self.add_record(record)
