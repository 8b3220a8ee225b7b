"""Chunks, opened and read: decompressed within bounds, their messages as columns, many chunks ahead of the reader.

Neither a chunk nor a whole file may open to more than makes sense. Our chunks have some 240 KiB before compression and
shrink to 40 %; those of others have 1 to 16 MiB. A file of a few kilobytes that opens to gigabytes is refused.

Files are read from front to back, so that one that is being written, or cut, is read as far as it goes. The message
indexes behind a chunk give the beginnings of its messages; they are used where they fill the chunks exactly. Otherwise
each record takes a step.
"""

import struct
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import IO, Any, NamedTuple, TypeAlias

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import Chunk
from numpy.typing import NDArray

from adacd_hil.log.log_files import LogError
from adacd_hil.log.mcap.mcap_records import DEFINITIONS, IndexRun, Problem, RawRecord, parse, walk
from adacd_hil.log.mcap.record_layout import HEAD, INDEX_ENTRY, MAGIC, MESSAGE_HEAD, crc32

MOST_BYTES = 32 << 20
"""Of a chunk, before compression."""
MOST_RATIO = 200
"""Largest ratio of all decompressed bytes of a file to their size in the file."""
FREE_BYTES = 64 << 20
"""Bytes that may be decompressed from a file of any size."""
_KINDS = ("", "zstd", "lz4")


class ChunkError(ValueError):
    """A chunk that can't be trusted; the message says why."""


class Opening:
    """Counts the bytes of a file's chunks, packed and decompressed. Use one for each reading of a file."""

    def __init__(self) -> None:
        self._packed = self._opened = 0

    def add_chunk(self, packed: int, size: int) -> None:
        """Add a chunk to the file's counts: `packed`, its bytes in the file, and `size`, its bytes when decompressed.

        Raises ChunkError if the chunk has more than MOST_BYTES, or all chunks more than FREE_BYTES plus MOST_RATIO
        times their bytes in the file.
        """
        if size > MOST_BYTES:
            raise ChunkError(f"opens to {size} bytes, more than {MOST_BYTES}")
        self._packed += packed
        self._opened += size
        if self._opened > FREE_BYTES + MOST_RATIO * self._packed:
            raise ChunkError(f"opens to more than {MOST_RATIO} times the file before it")

    def open_chunk(self, chunk: Chunk) -> bytes:
        """Decompress a chunk, add it to the counts, and return its records.

        Raises ChunkError for an unknown compression, damaged data, too many bytes (`add_chunk`), and another CRC than
        stored, or without a CRC another size than stated.
        """
        data = decompress(chunk.compression, chunk.data)
        self.add_chunk(len(chunk.data), len(data))
        return _checked(chunk, data, is_size_certain=bool(chunk.uncompressed_crc))


def _checked(chunk: Chunk, data: bytes, is_size_certain: bool) -> bytes:
    """Return the decompressed data of a chunk. Raises ChunkError if they fail its CRC; a CRC of 0 isn't checked.

    Raises it for another size than the chunk states, too, unless `is_size_certain`.
    """
    if chunk.uncompressed_crc and crc32(data) != chunk.uncompressed_crc:
        raise ChunkError("fails its CRC")
    if not is_size_certain and len(data) != chunk.uncompressed_size:
        raise ChunkError(f"holds {len(data)} bytes, not {chunk.uncompressed_size}")
    return data


def decompress(compression: str, data: bytes, most_bytes: int = MOST_BYTES) -> bytes:
    """Return the decompressed records of a chunk. compression: "", "zstd" or "lz4".

    Raises ChunkError for another compression, data that can't be decompressed, and more than `most_bytes`.
    """
    if compression not in _KINDS:
        raise ChunkError(f"unknown compression {compression[:20]!r}")
    try:
        opened = _decompress(compression, data, most_bytes)
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
        raise ChunkError(f"can't be decompressed: {error or type(error).__name__}") from None
    if len(opened) > most_bytes:
        raise ChunkError(f"opens to more than {most_bytes} bytes")
    return opened


def _decompress(compression: str, data: bytes, most_bytes: int) -> bytes:
    """Return decompressed data, of zstd and lz4 at most one byte more than `most_bytes`.

    Raises ChunkError for lz4 data that are cut, or zstd data that state more bytes, and the errors of the two
    libraries, among them ZstdError for zstd data that state no size and have more.
    """
    if compression == "":
        return data
    if compression == "zstd":
        if zstandard.frame_content_size(data) > most_bytes:
            raise ChunkError(f"opens to more than {most_bytes} bytes")
        decompressor = zstandard.ZstdDecompressor(max_window_size=MOST_BYTES)
        return decompressor.decompress(data, max_output_size=most_bytes + 1)
    stream = lz4.frame.LZ4FrameDecompressor()
    opened: bytes = stream.decompress(data, most_bytes + 1)
    if not stream.eof and len(opened) <= most_bytes:
        raise ChunkError("can't be decompressed: it is cut")
    return opened


_START = struct.Struct("<BQ")
_LEAST_LENGTH = MESSAGE_HEAD - HEAD.size
_MESSAGE = np.dtype(
    {
        "names": ["opcode", "length", "channel", "log_time", "publish_time"],
        "formats": ["u1", "<i8", "<u2", "<u8", "<u8"],
        "offsets": [0, 1, 9, 15, 23],
        "itemsize": MESSAGE_HEAD,
    }
)
PADDING = 128
"""Behind chunks: a record whose size varies is taken as if it were the longest, which has 64 bytes of data."""


@dataclass
class Contents:
    """The records of chunks. Messages as columns (n,), which are computed at their first use.

    data: the chunks' bytes, one after the other; starts: offset of each message in them.
    """

    data: bytes
    starts: NDArray[np.int64]
    definitions: list[RawRecord] = field(default_factory=list)  # schemas and channels; `offset`: where in the data
    strangers: list[int] = field(default_factory=list)
    """Opcodes of records that may not be in a chunk; Message: one that is too short."""
    breaks: list[int] = field(default_factory=list)  # where invalid bytes begin, to the end of their chunk

    @cached_property
    def heads(self) -> NDArray[Any]:
        """Head of each message (n,): opcode, length, channel, times."""
        return _windows(self.data, MESSAGE_HEAD)[self.starts].view(_MESSAGE)

    @cached_property
    def ends(self) -> NDArray[np.int64]:
        """Offsets in `data` at which the messages end (n,)."""
        return np.asarray(self.starts + self.heads["length"] + HEAD.size)

    @cached_property
    def channels(self) -> NDArray[np.uint16]:
        """Channel ids of the messages (n,)."""
        return self.heads["channel"].copy()

    @cached_property
    def log_times(self) -> NDArray[np.uint64]:
        """Log times of the messages, ns (n,)."""
        return self.heads["log_time"].copy()

    @cached_property
    def publish_times(self) -> NDArray[np.uint64]:
        """Publish times of the messages, ns (n,)."""
        return self.heads["publish_time"].copy()

    @property
    def entries(self) -> NDArray[Any]:
        """Entries of a message index that these messages must have (n,): log times, and offsets in `data`."""
        entries = np.empty(len(self.starts), INDEX_ENTRY)
        entries["log_time"] = self.log_times
        entries["offset"] = self.starts
        return entries

    def payload(self, message: int) -> bytes:
        """Return a copy of the payload of a message; message: its index, from 0."""
        return bytes(self.data[self.starts[message] + MESSAGE_HEAD : self.ends[message]])

    def rows(self, starts: NDArray[np.int64], size: int) -> NDArray[np.uint8]:
        """Return copies of the `size` bytes from each offset of `starts` on, (n, size)."""
        return _windows(self.data, size)[starts].view(np.uint8).reshape(len(starts), size)


def read_contents(data: bytes) -> Contents:
    """Find the records in the bytes of a decompressed chunk, and return them."""
    return _walk_through(data, (len(data),))


def read_chunks(data: bytes, ends: Sequence[int], indexes: Sequence[bytes]) -> Contents:
    """Find the records of decompressed chunks that follow each other in `data`, and return them.

    ends: offset at which each chunk ends; PADDING bytes of no meaning follow the last. indexes: by chunk, the entries
    of all its message indexes. Without them, or where they don't fit the chunks exactly, each record is found by the
    length of the one before.
    """
    indexed = _indexed(data, ends, indexes)
    return _walk_through(data, ends) if indexed is None else indexed


def _indexed(data: bytes, ends: Sequence[int], indexes: Sequence[bytes]) -> Contents | None:
    """Return the contents of chunks, with the beginnings of messages from the indexes; arguments as for `read_chunks`.

    None if the indexes are missing, or don't fill the chunks exactly with messages.
    """
    if not indexes or not all(index and len(index) % INDEX_ENTRY.itemsize == 0 for index in indexes):
        return None
    pairs = zip(indexes, (0, *ends[:-1]), strict=True)
    offsets = [np.frombuffer(index, INDEX_ENTRY)["offset"] + first for index, first in pairs]
    starts = np.sort(np.concatenate(offsets).view(np.int64))
    if starts[0] != 0 or starts[-1] > ends[-1] - MESSAGE_HEAD:
        return None
    contents = Contents(data, starts)
    heads = contents.heads
    is_message = (heads["opcode"] == Opcode.MESSAGE) & (heads["length"] >= _LEAST_LENGTH)
    is_filled = np.array_equal(contents.ends[:-1], starts[1:]) and contents.ends[-1] == ends[-1]
    if not is_filled or not is_message.all():
        return None
    lasts = contents.ends[np.searchsorted(contents.ends, ends)]
    return contents if np.array_equal(lasts, ends) else None


def _walk_through(data: bytes, ends: Sequence[int]) -> Contents:
    """Find the records of chunks one by one, each by the length of the one before, and return them.

    A message that is too short, and a record that may not be in a chunk, are strangers; bytes that can't be a record
    break off their chunk. ends: offset at which each chunk ends.
    """
    definitions: list[RawRecord] = []
    strangers: list[int] = []
    breaks: list[int] = []
    starts: list[int] = []
    unpack, add = _START.unpack_from, starts.append
    message, head, least = int(Opcode.MESSAGE), HEAD.size, _LEAST_LENGTH
    for first, size in pairwise((0, *ends)):
        position = first
        while position + head <= size:
            opcode, length = unpack(data, position)
            end = position + head + length
            if end > size:
                break
            if opcode == message and length >= least:
                add(position)
            elif opcode in DEFINITIONS:
                definitions.append(RawRecord(position, opcode, bytes(data[position + head : end])))
            else:
                strangers.append(opcode)
            position = end
        if position < size:
            breaks.append(position)
    return Contents(data, np.array(starts, np.int64), definitions, strangers, breaks)


def message_contents(record: RawRecord) -> Contents:
    """Return a message outside of chunks as the contents of a chunk of its own."""
    data = HEAD.pack(record.opcode, len(record.body)) + record.body
    return Contents(data, np.zeros(1, np.int64))


def _windows(data: bytes, size: int) -> NDArray[Any]:
    """View the `size` bytes that begin at each byte as one item; the items overlap."""
    windows: NDArray[Any] = np.ndarray((max(0, len(data) - size + 1),), f"V{size}", data, strides=(1,))
    return windows


BLOCK_BYTES = 1 << 20
AHEAD = 3
"""Blocks that may wait or be in work."""
_OUTSIDE = (Opcode.MESSAGE, Opcode.CHANNEL, Opcode.SCHEMA)
_OTHERS = (Opcode.ATTACHMENT, Opcode.METADATA)


class Block(NamedTuple):
    """Decompressed chunks, one after the other; a message or a definition outside chunks is a chunk by itself."""

    contents: Contents
    position: int  # in the file, of the first of them
    problem: str  # why chunks are missing, "" if none is


Item: TypeAlias = Block | RawRecord | Problem


class _Packed(NamedTuple):
    """A chunk as it is in the file, still compressed; or the bytes of a message or definition outside chunks."""

    chunk: Chunk | bytes
    size: int  # when opened
    position: int
    entries: list[bytes]  # of the message indexes behind it


def read_blocks(file: IO[bytes], name: str, block_bytes: int = BLOCK_BYTES, is_ahead: bool = True) -> Iterator[Item]:
    """Yield the contents of an MCAP file from front to end: blocks of chunks, attachments, metadata, and problems.

    A message or definition outside chunks counts as a chunk. name: of the file, for errors. block_bytes: most
    decompressed bytes of the chunks in a block, unless it is one chunk; 1: each chunk is a block. is_ahead: a thread
    decompresses chunks in advance. Raises LogError if the file isn't MCAP.
    """
    if not is_ahead:
        for item in _pack(file, name, block_bytes):
            yield _open(item) if isinstance(item, list) else item
        return
    waiting: deque[Future[Block] | RawRecord | Problem] = deque()
    # A second thread would wait for Python's lock more than it opens: 1.3 times the processor time, no sooner done.
    with ThreadPoolExecutor(1, "log-reader") as thread:
        try:
            for item in _pack(file, name, block_bytes):
                waiting.append(thread.submit(_open, item) if isinstance(item, list) else item)
                if len(waiting) > AHEAD:
                    yield _finished(waiting.popleft())
            while waiting:
                yield _finished(waiting.popleft())
        finally:
            thread.shutdown(cancel_futures=True)


def _finished(item: Future[Block] | RawRecord | Problem) -> Item:
    """Wait for the block in a future and return it; return any other item as it is."""
    return item.result() if isinstance(item, Future) else item


def _pack(file: IO[bytes], name: str, block_bytes: int) -> Iterator[list[_Packed] | RawRecord | Problem]:
    """Yield lists of chunks, still compressed, and attachments, metadata and problems one by one.

    The chunks of a list have at most `block_bytes` when opened, unless it is one chunk. A message or definition outside
    chunks counts as a chunk. Other records are left out.
    """
    packed: list[_Packed] = []
    size, crc = 0, crc32(MAGIC)
    opening = Opening()
    for record in walk(file, name):
        if isinstance(record, IndexRun):
            crc = crc32(record.data, crc)
            if packed:
                packed[-1].entries.extend(record.entries)
            continue
        found = _look_at(record, opening, crc)
        if isinstance(record, RawRecord):
            crc = crc32(record.body, crc32(HEAD.pack(record.opcode, len(record.body)), crc))
        if found is None:
            continue
        if packed and (not isinstance(found, _Packed) or size + found.size > block_bytes):
            yield packed
            packed, size = [], 0
        if isinstance(found, _Packed):
            packed.append(found)
            size += found.size
        else:
            yield found
    if packed:
        yield packed


def _look_at(record: RawRecord | Problem, opening: Opening, crc: int) -> _Packed | RawRecord | Problem | None:
    """Return a chunk, message, schema or channel as `_packed` does; an attachment, metadata or Problem as it is.

    Return None for any other record, which is skipped, but a DataEnd becomes a Problem if its CRC is neither 0 nor
    `crc`, that of all bytes before it.
    """
    if isinstance(record, Problem) or record.opcode in _OTHERS:
        return record
    if record.opcode == Opcode.CHUNK or record.opcode in _OUTSIDE:
        return _packed(record, opening)
    if record.opcode == Opcode.DATA_END and int.from_bytes(record.body[:4], "little") not in (0, crc):
        return Problem("the data section fails its CRC")
    return None


def _packed(record: RawRecord, opening: Opening) -> _Packed | Problem:
    """Return a chunk, still compressed, or a message or definition outside chunks.

    Return a Problem for a chunk that can't be parsed, or is too large when decompressed.
    """
    position = record.offset + HEAD.size
    if record.opcode != Opcode.CHUNK:
        whole = HEAD.pack(record.opcode, len(record.body)) + record.body
        return _Packed(whole, len(whole), position, [])
    try:
        chunk: Chunk = parse(record.opcode, record.body)
        opening.add_chunk(len(chunk.data), chunk.uncompressed_size)
    except (LogError, ChunkError):
        return Problem(f"damaged at byte {position}", is_damage=True)
    return _Packed(chunk, chunk.uncompressed_size, position, [])


def _open(packed: list[_Packed]) -> Block:
    """Decompress chunks and return their records as a block; leave out damaged ones; the first is its problem."""
    opened: list[bytes] = []
    ends: list[int] = []
    indexes, problem, end = [], "", 0
    for one in packed:
        try:
            data = one.chunk if isinstance(one.chunk, bytes) else _open_sized(one.chunk)
        except ChunkError:
            problem = problem or f"damaged at byte {one.position}"
        else:
            opened.append(data)
            end += len(data)
            ends.append(end)
            indexes.append(b"".join(one.entries))
    contents = read_chunks(b"".join((*opened, bytes(PADDING))), ends, indexes)
    _ = contents.channels, contents.publish_times  # here, where two processors can share the work
    return Block(contents, packed[0].position, problem)


def _open_sized(chunk: Chunk) -> bytes:
    """Return the decompressed records of a chunk whose stated size has been allowed.

    Raises ChunkError if it can't be decompressed, or its size or CRC differs.
    """
    data = decompress(chunk.compression, chunk.data, chunk.uncompressed_size)
    return _checked(chunk, data, is_size_certain=False)
