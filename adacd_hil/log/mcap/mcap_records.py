"""The records of an MCAP file in order: up to where they go, or, in a damaged file, what follows the damage too.

Constant memory: one record at a time; one of more than MOST_RECORD_BYTES is none. Chunks stay closed.
"""

import io
import os
import re
import struct
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from adacd_hil.input_files import open_input
from adacd_hil.log.errors import LogError
from adacd_hil.log.mcap.record_shapes import fits, has_shape

try:
    from zlib_ng import zlib_ng as fast_zlib  # six times as fast, which saves a sixth of the time to read a log
except ImportError:
    import zlib as fast_zlib  # type: ignore[no-redef]

crc32: Callable[..., int] = fast_zlib.crc32
MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")
RECORD_HEAD_BYTES = HEAD.size
"""Bytes of a record that its length doesn't count: opcode, length."""
MESSAGE_HEAD = 31
"""Bytes of a message record before its payload: opcode, length, channel, sequence, log time, publish time."""
MOST_RECORD_BYTES = 64 << 20
"""Of a record that is read. A chunk of ours has 0.1 MB, one of others up to 16 MB; an attachment of a run 0.2 MB."""
_WINDOW = 1 << 20
_RUN_BYTES = 1 << 15
_INDEX_HEAD = 6
"""Bytes of a message index before its entries: its channel, how many bytes they have."""
_READERS: dict[int, Any] = {
    Opcode.HEADER: Header.read,
    Opcode.FOOTER: Footer.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.CHUNK: Chunk.read,
    Opcode.MESSAGE_INDEX: MessageIndex.read,
    Opcode.CHUNK_INDEX: ChunkIndex.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex.read,
    Opcode.STATISTICS: Statistics.read,
    Opcode.METADATA: Metadata.read,
    Opcode.METADATA_INDEX: MetadataIndex.read,
    Opcode.SUMMARY_OFFSET: SummaryOffset.read,
    Opcode.DATA_END: DataEnd.read,
}
_BEGINNING = re.compile(rb"(?=[\x01-\x04\x06-\x0f].{5}\0\0\0)", re.DOTALL)
"""Where a record of less than a TiB may begin."""


class RawRecord(NamedTuple):
    """A record as it is in the file."""

    offset: int
    opcode: int
    body: bytes

    @property
    def end(self) -> int:
        """Where the next one begins."""
        return self.offset + HEAD.size + len(self.body)


class IndexRun(NamedTuple):
    """Message indexes that follow each other."""

    data: bytes  # their records
    entries: list[bytes]  # of each


class Gap(NamedTuple):
    """Bytes that are no record."""

    offset: int
    size: int


class Problem(NamedTuple):
    """Something that is missing of a file, in words. `is_damage`: these follow "the file is"."""

    text: str
    is_damage: bool = False


class Trailer(NamedTuple):
    """The magic behind the footer."""

    offset: int


def name_of(opcode: int) -> str:
    """Name a kind of record as the specification does."""
    if opcode not in set(Opcode):
        return f"record 0x{opcode:02x}"
    return "".join(word.capitalize() for word in Opcode(opcode).name.split("_"))


def parse(opcode: int, body: bytes) -> Any:
    """Read a record with mcap's class for it. Raises LogError when it makes no sense."""
    try:
        return _READERS[opcode](ReadDataStream(io.BytesIO(body)))
    except (McapError, struct.error, ValueError, OverflowError, MemoryError) as error:
        raise LogError(f"{name_of(opcode)} can't be read: {error or type(error).__name__}") from None


def walk(file: IO[bytes], name: str, passed: Collection[int] = ()) -> Iterator[RawRecord | IndexRun | Problem]:
    """List the records of a file up to its end, or to what can't be one; message indexes, which are many, in runs.

    passed: kinds whose bodies aren't read. Raises LogError, which begins with `name`, when it isn't MCAP.
    """
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    magic = file.read(len(MAGIC))
    if not MAGIC.startswith(magic):
        raise LogError(f"{name} is not an MCAP file")
    position, is_whole = len(magic), False
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
            break
    if not is_whole:
        yield Problem(f"cut after {size} bytes", is_damage=True)


def _index_run(data: bytes) -> IndexRun:
    """Take the message indexes at the beginning of `data`, of which the first is whole."""
    position, entries = 0, []
    while len(data) - position >= HEAD.size:
        opcode, length = HEAD.unpack_from(data, position)
        end = position + HEAD.size + length
        if opcode != Opcode.MESSAGE_INDEX or end > len(data):
            break
        entries.append(data[position + HEAD.size + _INDEX_HEAD : end])
        position = end
    return IndexRun(data[:position], entries)


def scan(file: IO[bytes]) -> Iterator[RawRecord | Gap | Trailer]:
    """List the records of a file, and the gaps between them: what follows damage is found again."""
    return _Scan(file).items()


def read_header(path: Path) -> Header | None:
    """Read the header of a file; None where it has none that can be trusted."""
    try:
        with open_input(path) as file:
            first = next(scan(file), None)
        if not isinstance(first, RawRecord) or first.opcode != Opcode.HEADER:
            return None
        header: Header = parse(first.opcode, first.body)
    except (OSError, LogError):
        return None
    return header


class _Scan:
    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._size = os.fstat(file.fileno()).st_size

    def items(self) -> Iterator[RawRecord | Gap | Trailer]:
        position = len(MAGIC)
        if self._read(0, position) != MAGIC:
            position = 0
        while position < self._size:
            head = self._head(position)
            if head is None:
                found = self._find(position + 1)
                yield Gap(position, found - position)
                position = found
                continue
            record = RawRecord(position, head[0], self._read(position + HEAD.size, head[1]))
            yield record
            position = record.end
            if record.opcode == Opcode.FOOTER and self._read(position, len(MAGIC)) == MAGIC:
                yield Trailer(position)
                return

    def _read(self, position: int, count: int) -> bytes:
        self._file.seek(position)
        return self._file.read(count)

    def _head(self, position: int) -> tuple[int, int] | None:
        """Return opcode and length of the record at `position`, if one is there."""
        head = self._read(position, HEAD.size)
        if len(head) < HEAD.size:
            return None
        opcode, length = HEAD.unpack(head)
        start = position + HEAD.size
        if not opcode or length > min(self._size - start, MOST_RECORD_BYTES):
            return None
        if opcode in set(Opcode):
            is_there = fits(opcode, length, lambda place, count: self._read(start + place, count))
        else:  # a kind that is not known, if a known one follows
            is_there = self._is_shaped(start + length)
        return (opcode, length) if is_there else None

    def _is_shaped(self, position: int) -> bool:
        """Say whether a record that repeats its length is at `position`."""
        head = self._read(position, HEAD.size)
        if len(head) < HEAD.size or not has_shape(head[0]):
            return False
        opcode, length = HEAD.unpack(head)
        start = position + HEAD.size
        return length <= min(self._size - start, MOST_RECORD_BYTES) and fits(
            opcode, length, lambda place, count: self._read(start + place, count)
        )

    def _find(self, position: int) -> int:
        """Find the next record that repeats its length; the end of the file if there is none."""
        while position < self._size:
            window = self._read(position, _WINDOW + HEAD.size)
            for match in _BEGINNING.finditer(window):
                if self._is_shaped(position + match.start()):
                    return position + match.start()
            position += _WINDOW
        return self._size


def attachment_crc_fits(body: bytes, is_vouched: bool = True) -> bool:
    """Say whether the body of an attachment fits its CRC; 0, for none, does if something else vouches for it."""
    stored = int.from_bytes(body[-4:], "little")
    return stored == crc32(body[:-4]) or (stored == 0 and is_vouched)
