"""An MCAP file as blocks of message records: read, checked and decompressed by a thread ahead of who asks.

All work on bytes (reading, CRCs, decompression, passing over index records) is done without the GIL. A block has the
records of many chunks; its memory is used again after the next one is asked for.
"""

import io
import os
import struct
import zlib
from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeAlias

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.stream_reader import get_chunk_data_stream
from numpy.typing import NDArray

from adacd_hil.log.compiled_records import WORD, pass_over, words_of
from adacd_hil.log.errors import LogError
from adacd_hil.log.mcap_walk import MAGIC, RECORD_HEAD_BYTES

READ_BYTES = 1 << 20
BLOCK_BYTES = 1 << 22
AHEAD = 4
"""Blocks that may wait."""
_MAX_CHUNK = 1 << 30
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
    position: int  # in the file, of the last of them


class Record(NamedTuple):
    """A record outside chunks that isn't a message or a definition."""

    opcode: int
    body: bytes
    position: int


class Problem(NamedTuple):
    """Something that is missing."""

    text: str


Item: TypeAlias = Block | Record | Problem


def items_ahead(path: Path) -> Iterator[Item]:
    """Read a file in a thread ahead. Raises LogError when it can't be read or isn't MCAP."""
    items = read_items(path)
    with ThreadPoolExecutor(1, "log-reader") as thread:
        try:
            waiting = deque(thread.submit(next, items, None) for _ in range(AHEAD))
            while (item := waiting.popleft().result()) is not None:
                yield item
                waiting.append(thread.submit(next, items, None))
        finally:
            thread.shutdown(cancel_futures=True)


def read_items(path: Path, has_chunks: bool = True) -> Iterator[Item]:
    """Read a file from front to end, without `has_chunks` all but its messages.

    Raises LogError when it can't be read or isn't MCAP.
    """
    try:
        with path.open("rb", buffering=0) as file:
            yield from _Reading(file, path, has_chunks).items()
    except OSError as error:
        raise LogError(f"log {path} can't be read: {error.strerror}") from None


class _Blocks:
    """The block in progress, and the memory of those that wait."""

    def __init__(self) -> None:
        # One is being filled, AHEAD wait and one is being walked over.
        self._memory = [np.empty(0, np.uint8)] * (AHEAD + 2)
        self._turn = 0
        self._filled = 0
        self._ends: list[int] = []
        self._position = 0

    def room(self, size: int) -> bool:
        """Say whether so many bytes more fit; into an empty block they do."""
        if self._ends:
            return self._filled + size <= len(self._memory[self._turn]) - WORD
        if len(self._memory[self._turn]) < size + WORD:
            self._memory[self._turn] = np.zeros(max(size + WORD, BLOCK_BYTES), np.uint8)
        return True

    def place(self, size: int) -> Bytes:
        """Return where the next so many bytes go, for which there is room."""
        return self._memory[self._turn][self._filled : self._filled + size]

    def add(self, size: int, position: int) -> None:
        """Take what has been put there as a chunk."""
        self._filled += size
        self._ends.append(self._filled)
        self._position = position

    def end(self) -> Iterator[Block]:
        """End the block in progress if it has anything."""
        if self._ends:
            yield Block(self._memory[self._turn], self._ends, self._position)
            self._turn = (self._turn + 1) % len(self._memory)
            self._filled = 0
            self._ends = []


class _Reading:
    """The bytes of a file that are in memory, and how far its records have been taken from them."""

    def __init__(self, file: "IO[bytes]", path: Path, has_chunks: bool) -> None:
        self._file = file
        self._path = path
        self._size = os.fstat(file.fileno()).st_size
        self._data = np.zeros(READ_BYTES + WORD, np.uint8)
        self._words = words_of(self._data)
        self._before = 0  # bytes of the file before those in memory
        self._start = self._stop = 0  # of what is in memory and not yet taken
        self._crc = 0  # of all before `_summed`
        self._summed = 0
        self._blocks = _Blocks()
        self._decompressor = zstandard.ZstdDecompressor()
        self._is_passed = np.zeros(256, np.bool_)
        self._is_passed[list(_PASSED if has_chunks else (*_PASSED, *_IN_BLOCKS, Opcode.CHUNK))] = True

    @property
    def _position(self) -> int:
        return self._before + self._start

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
            read = self._file.readinto(self._data[self._stop : -WORD].data)  # type: ignore[attr-defined]
            if not read:
                return False
            self._stop += read
        return True

    def _sum_up(self) -> None:
        """Take into the CRC what has been taken from memory."""
        self._crc = zlib.crc32(self._data[self._summed : self._start].data, self._crc)
        self._summed = self._start

    def items(self) -> Iterator[Item]:
        """Read the records."""
        is_whole = self._fill(len(MAGIC))
        magic = self._data[: min(self._stop, len(MAGIC))].tobytes()
        if not MAGIC.startswith(magic):
            raise LogError(f"{self._path} is not an MCAP file")
        self._start = len(magic)
        while is_whole:
            self._start = pass_over(self._data, self._words, self._start, self._stop, self._is_passed)
            if not self._fill(RECORD_HEAD_BYTES):
                break
            opcode, length = _RECORD_HEAD.unpack_from(self._data.data, self._start)
            if opcode == 0 or length > self._size - self._position - RECORD_HEAD_BYTES:
                break
            if not self._fill(RECORD_HEAD_BYTES + length):
                break
            yield from self._take(opcode, length)
            self._start += RECORD_HEAD_BYTES + length
            if opcode == Opcode.FOOTER:
                is_whole = self._fill(len(MAGIC)) and self._bytes(len(MAGIC)) == MAGIC
                yield from self._blocks.end()
                if not is_whole:
                    break
                return
        yield from self._blocks.end()
        yield Problem(f"cut after {self._size} bytes")

    def _bytes(self, count: int) -> bytes:
        return self._data[self._start : self._start + count].tobytes()

    def _take(self, opcode: int, length: int) -> Iterator[Item]:
        """Take the record at `_start`, which is in memory."""
        position = self._position + RECORD_HEAD_BYTES
        body = self._data[self._start + RECORD_HEAD_BYTES : self._start + RECORD_HEAD_BYTES + length]
        try:
            if opcode == Opcode.CHUNK:
                yield from self._take_chunk(body, position)
            elif opcode in _IN_BLOCKS:
                size = RECORD_HEAD_BYTES + length
                if not self._blocks.room(size):
                    yield from self._blocks.end()
                    self._blocks.room(size)
                self._blocks.place(size)[:] = self._data[self._start : self._start + size]
                self._blocks.add(size, position)
            elif not self._is_passed[opcode]:
                yield from self._blocks.end()
                if opcode == Opcode.DATA_END:
                    self._sum_up()
                    if int.from_bytes(body[:4].tobytes(), "little") not in (0, self._crc):
                        yield Problem("the data section fails its CRC")
                else:
                    yield Record(opcode, body.tobytes(), position)
        except DAMAGE:
            yield Problem(f"damaged at byte {position}")

    def _take_chunk(self, body: Bytes, position: int) -> Iterator[Item]:
        """Decompress a chunk into the block in progress."""
        _, _, size, crc, name_size = _CHUNK_HEAD.unpack_from(body.data)
        place = _CHUNK_HEAD.size + name_size
        name = body[_CHUNK_HEAD.size : place].tobytes()
        (data_size,) = struct.unpack_from("<Q", body.data, place)
        data = body[place + 8 : place + 8 + data_size]
        if size > _MAX_CHUNK or len(data) != data_size:
            raise ValueError("sizes of a chunk make no sense")
        if name == b"zstd" and zstandard.frame_content_size(data.data) not in (-1, size):
            raise ValueError("a chunk isn't as long as it says")
        if not self._blocks.room(size):
            yield from self._blocks.end()
            self._blocks.room(size)
        records = self._blocks.place(size)
        if name == b"zstd":
            count = 0
            with self._decompressor.stream_reader(data.data) as reader:
                while count < size and (read := reader.readinto(records[count:].data)):
                    count += read
            if count != size:
                raise ValueError("a chunk isn't as long as it says")
        else:
            records[:] = np.frombuffer(_others_decompressed(body.tobytes()), np.uint8)
        if crc and zlib.crc32(records.data) != crc:
            raise ValueError("a chunk fails its CRC")
        self._blocks.add(size, position)


def _others_decompressed(body: bytes) -> bytes:
    """Decompress a chunk in another way than our writer's."""
    chunk = Chunk.read(ReadDataStream(io.BytesIO(body)))
    stream, size = get_chunk_data_stream(chunk, validate_crc=False)
    decompressed: Any = stream.read(size)
    return bytes(decompressed)
