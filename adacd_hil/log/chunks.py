"""An MCAP file as blocks of message records: read, checked and decompressed by threads ahead of who asks.

All work on bytes (reading, CRCs, decompression, passing over index records) is done without the GIL. A block has the
records of many chunks; its memory is used again after the next one is asked for.
"""

import io
import itertools
import os
import struct
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple, TypeAlias, cast

import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from numpy.typing import NDArray

from adacd_hil.input_files import open_input
from adacd_hil.log.compiled_records import WORD, pass_over, words_of
from adacd_hil.log.errors import LogError
from adacd_hil.log.mcap.opening import MOST_BYTES, Opening, decompress
from adacd_hil.log.mcap.records import MAGIC, MOST_RECORD_BYTES, RECORD_HEAD_BYTES

try:
    from zlib_ng.zlib_ng import crc32  # six times as fast, which saves a sixth of the time to read a log
except ImportError:
    from zlib import crc32

READ_BYTES = 1 << 20
BLOCK_BYTES = 1 << 21
THREADS = 2
AHEAD = 6
"""Blocks that may wait or be in work."""
_RECORD_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
_IN_BLOCKS = (Opcode.MESSAGE, Opcode.CHANNEL, Opcode.SCHEMA)
_PASSED = (
    Opcode.MESSAGE_INDEX,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
    Opcode.STATISTICS,
    Opcode.SUMMARY_OFFSET,
)
DAMAGE = (McapError, zstandard.ZstdError, struct.error, ValueError, EOFError, MemoryError, OverflowError)
"""What reading damaged bytes raises."""

Bytes: TypeAlias = NDArray[np.uint8]


class Block(NamedTuple):
    """Records of chunks, one chunk after the other; at least WORD bytes follow the last."""

    data: Bytes
    ends: list[int]  # of each chunk
    position: int  # in the file, of the first of them
    problem: str  # why chunks are missing, "" if none is


class Record(NamedTuple):
    """A record outside chunks that isn't a message or a definition."""

    opcode: int
    body: bytes
    position: int


class Problem(NamedTuple):
    """Something that is missing."""

    text: str


class _PackedChunk(NamedTuple):
    """A chunk as it is in the file; a record outside chunks is one by itself."""

    body: bytes  # of the record of the chunk; the whole record outside chunks
    is_chunk: bool
    size: int  # decompressed
    position: int


_Packed: TypeAlias = list[_PackedChunk]
Item: TypeAlias = Block | Record | Problem


def read_items(path: Path) -> Iterator[Item]:
    """Read a file from front to end in threads ahead. Raises LogError when it can't be read or isn't MCAP."""
    packed = _read_packed(path)
    numbers = itertools.count()
    memory = [np.empty(0, np.uint8)] * (AHEAD + 2)  # one is held by who asks, one may wait for the one before it
    is_reading = threading.Lock()

    def read_next() -> tuple[int, Item | None]:
        with is_reading:
            number = next(numbers)
            item = next(packed, None)
        if not isinstance(item, list):
            return number, item
        place = number % len(memory)
        size = sum(chunk.size for chunk in item) + WORD
        if len(memory[place]) < size:
            memory[place] = np.zeros(max(size, BLOCK_BYTES), np.uint8)
        return number, _unpack(item, memory[place])

    with ThreadPoolExecutor(THREADS, "log-reader") as threads:
        try:
            yield from _in_order(deque(threads.submit(read_next) for _ in range(AHEAD)), threads, read_next)
        finally:
            threads.shutdown(cancel_futures=True)


def read_others(path: Path) -> Iterator[Record | Problem]:
    """Read all of a file but its messages, as fast as it can be passed over. Raises LogError as `read_items` does."""
    for item in _read_packed(path, has_chunks=False):
        if not isinstance(item, list):
            yield item


def _in_order(
    waiting: "deque[Future[tuple[int, Item | None]]]",
    threads: ThreadPoolExecutor,
    read_next: Callable[[], tuple[int, Item | None]],
) -> Iterator[Item]:
    """Yield what the threads make by its number; they may take turns in another order than they were asked."""
    early: dict[int, Item | None] = {}
    for number in itertools.count():
        while number not in early:
            other, item = waiting.popleft().result()
            early[other] = item
        item = early.pop(number)
        if item is None:
            return
        yield item
        waiting.append(threads.submit(read_next))


def _unpack(chunks: _Packed, memory: Bytes) -> Block:
    """Put the records of chunks one after the other."""
    decompressor = zstandard.ZstdDecompressor(max_window_size=MOST_BYTES)
    ends, problem, filled = [], "", 0
    for chunk in chunks:
        try:
            _unpack_chunk(chunk, decompressor, memory[filled : filled + chunk.size])
        except DAMAGE:
            problem = problem or f"damaged at byte {chunk.position}"
        else:
            filled += chunk.size
            ends.append(filled)
    return Block(memory, ends, chunks[0].position, problem)


def _unpack_chunk(chunk: _PackedChunk, decompressor: zstandard.ZstdDecompressor, records: Bytes) -> None:
    """Put the records of a chunk where they belong. Raises one of DAMAGE."""
    if not chunk.is_chunk:
        records[:] = np.frombuffer(chunk.body, np.uint8)
        return
    name, data = _compressed(chunk.body)
    if name == b"zstd":
        with decompressor.stream_reader(data) as reader:
            count = 0
            while count < chunk.size and (read := reader.readinto(records[count:].data)):
                count += read
        if count != chunk.size:
            raise ValueError("a chunk isn't as long as it says")
    else:
        records[:] = np.frombuffer(decompress(name.decode("ascii", "replace"), bytes(data)), np.uint8)
    _, _, _, crc, _ = _CHUNK_HEAD.unpack_from(chunk.body)
    if crc and crc32(records.data) != crc:
        raise ValueError("a chunk fails its CRC")


def _compressed(body: bytes) -> tuple[bytes, memoryview]:
    """Return how the records of a chunk are compressed, and to what. Raises one of DAMAGE."""
    *_, name_size = _CHUNK_HEAD.unpack_from(body)
    place = _CHUNK_HEAD.size + name_size
    (size,) = struct.unpack_from("<Q", body, place)
    data = memoryview(body)[place + 8 : place + 8 + size]
    if len(data) != size:
        raise ValueError("a chunk is longer than its record")
    return body[_CHUNK_HEAD.size : place], data


def _packed_chunk(body: bytes, position: int, opening: Opening) -> _PackedChunk:
    """Look at a chunk. Raises one of DAMAGE."""
    _, _, size, _, _ = _CHUNK_HEAD.unpack_from(body)
    name, data = _compressed(body)
    if name == b"zstd" and zstandard.frame_content_size(data) not in (-1, size):
        raise ValueError("a chunk isn't as long as it says")
    opening.allow(len(data), size)
    return _PackedChunk(body, is_chunk=True, size=size, position=position)


def _read_packed(path: Path, has_chunks: bool = True) -> Iterator[_Packed | Record | Problem]:
    """Read a file from front to end, chunks as they are."""
    try:
        with open_input(path) as file:
            yield from _Reading(cast("io.FileIO", file.raw), path, has_chunks).items()
    except OSError as error:
        raise LogError(f"log {path} can't be read: {error.strerror}") from None


class _Reading:
    """The bytes of a file that are in memory, and how far its records have been taken from them."""

    def __init__(self, file: io.FileIO, path: Path, has_chunks: bool) -> None:
        self._file = file
        self._path = path
        self._size = os.fstat(file.fileno()).st_size
        self._data = np.zeros(READ_BYTES + WORD, np.uint8)
        self._words = words_of(self._data)
        self._before = 0  # bytes of the file before those in memory
        self._start = self._stop = 0  # of what is in memory and not yet taken
        self._crc = 0  # of all before `_summed`
        self._summed = 0
        self._opening = Opening()
        self._packed: _Packed = []
        self._packed_size = 0
        self._is_passed = np.zeros(256, np.bool_)
        self._is_passed[list(_PASSED if has_chunks else (*_PASSED, *_IN_BLOCKS, Opcode.CHUNK))] = True

    def _fill(self, count: int) -> bool:
        """Have `count` bytes in memory from `_start` on, and as many more as there is room; False at the file's end."""
        if self._stop - self._start >= count:
            return True
        self._sum_up()
        rest = self._data[self._start : self._stop]
        if count > len(self._data) - WORD:
            self._data = np.zeros(count + READ_BYTES, np.uint8)
            self._words = words_of(self._data)
        self._data[: len(rest)] = rest.copy()
        self._before += self._start
        self._start, self._stop, self._summed = 0, len(rest), 0
        while self._stop < count:
            read = self._file.readinto(self._data[self._stop : -WORD].data)
            if not read:
                return False
            self._stop += read
        return True

    def _sum_up(self) -> None:
        """Take into the CRC what has been taken from memory."""
        self._crc = crc32(self._data[self._summed : self._start].data, self._crc)
        self._summed = self._start

    def items(self) -> Iterator[_Packed | Record | Problem]:
        """Read the records."""
        self._fill(len(MAGIC))
        if not MAGIC.startswith(self._bytes(len(MAGIC))):
            raise LogError(f"{self._path} is not an MCAP file")
        is_whole = self._stop >= len(MAGIC)
        self._start = min(self._stop, len(MAGIC))
        while is_whole:
            self._start = pass_over(self._data, self._words, self._start, self._stop, self._is_passed)
            if not self._fill(RECORD_HEAD_BYTES):
                break
            opcode, length = _RECORD_HEAD.unpack_from(self._data.data, self._start)
            if length > MOST_RECORD_BYTES and not self._is_passed[opcode]:
                position = self._before + self._start
                yield from self._end_block()
                yield Problem(f"the record at byte {position} has {length} bytes, more than {MOST_RECORD_BYTES}")
                return
            is_in_file = opcode and length <= self._size - self._before - self._start - RECORD_HEAD_BYTES
            if not is_in_file or not self._fill(RECORD_HEAD_BYTES + length):
                break
            yield from self._take(opcode, length)
            self._start += RECORD_HEAD_BYTES + length
            if opcode == Opcode.FOOTER:
                if self._fill(len(MAGIC)) and self._bytes(len(MAGIC)) == MAGIC:
                    return
                break
        yield from self._end_block()
        yield Problem(f"cut after {self._size} bytes")

    def _bytes(self, count: int) -> bytes:
        """Return the next bytes, fewer at the file's end."""
        return self._data[self._start : min(self._start + count, self._stop)].tobytes()

    def _take(self, opcode: int, length: int) -> Iterator[_Packed | Record | Problem]:
        """Take the record at `_start`, which is in memory."""
        if self._is_passed[opcode]:
            return
        position = self._before + self._start + RECORD_HEAD_BYTES
        record = self._bytes(RECORD_HEAD_BYTES + length)
        if opcode == Opcode.CHUNK:
            try:
                yield from self._add(_packed_chunk(record[RECORD_HEAD_BYTES:], position, self._opening))
            except DAMAGE:
                yield Problem(f"damaged at byte {position}")
        elif opcode in _IN_BLOCKS:
            yield from self._add(_PackedChunk(record, is_chunk=False, size=len(record), position=position))
        else:
            yield from self._end_block()
            yield Record(opcode, record[RECORD_HEAD_BYTES:], position)
        if opcode == Opcode.DATA_END:
            self._sum_up()
            if int.from_bytes(record[9:13], "little") not in (0, self._crc):
                yield Problem("the data section fails its CRC")

    def _add(self, chunk: _PackedChunk) -> Iterator[_Packed]:
        """Put a chunk into the block in progress."""
        if self._packed_size + chunk.size > BLOCK_BYTES - WORD:
            yield from self._end_block()
        self._packed.append(chunk)
        self._packed_size += chunk.size

    def _end_block(self) -> Iterator[_Packed]:
        if self._packed:
            packed, self._packed, self._packed_size = self._packed, [], 0
            yield packed
