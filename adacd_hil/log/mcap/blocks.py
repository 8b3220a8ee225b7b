"""An MCAP file as blocks of records, many chunks each, which a thread checks and opens ahead of who asks.

Files are read from front to back, so that one that is being written, or cut, is read as far as it goes. The message
indexes behind a chunk say where its messages begin; they are believed where they fill the chunks exactly.
"""

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import IO, NamedTuple, TypeAlias

from mcap.opcode import Opcode
from mcap.records import Chunk

from adacd_hil.log.errors import LogError
from adacd_hil.log.mcap.chunk_contents import Contents, read_chunks
from adacd_hil.log.mcap.mcap_records import HEAD, MAGIC, IndexRun, Problem, RawRecord, crc32, parse, walk
from adacd_hil.log.mcap.opening import ChunkError, Opening, open_as_claimed

BLOCK_BYTES = 1 << 21
AHEAD = 6
"""Blocks that may wait or be in work."""
_OUTSIDE = (Opcode.MESSAGE, Opcode.CHANNEL, Opcode.SCHEMA)
_OTHERS = (Opcode.ATTACHMENT, Opcode.METADATA)


class Block(NamedTuple):
    """Records of chunks, one chunk after the other; a message or a definition outside chunks is one by itself."""

    contents: Contents
    memory: bytearray  # of the contents, used again after the next item is asked for
    position: int  # in the file, of the first of them
    problem: str  # why chunks are missing, "" if none is


Item: TypeAlias = Block | RawRecord | Problem


class _Packed(NamedTuple):
    """A chunk as it is in the file, or a record outside chunks."""

    chunk: Chunk | bytes
    size: int  # when opened
    position: int
    entries: list[bytes]  # of the message indexes behind it


def read_blocks(file: IO[bytes], name: str, block_bytes: int = BLOCK_BYTES) -> Iterator[Item]:
    """Read a file from front to end: blocks, attachments and metadata, and what is missing.

    block_bytes: of the chunks that make a block; 1: each chunk is one. Raises LogError when it isn't MCAP.
    """
    waiting: deque[Future[Block] | RawRecord | Problem] = deque()
    free: list[bytearray] = []
    # A second thread would wait for Python's lock more than it opens: 1.3 times the processor time, no sooner done.
    with ThreadPoolExecutor(1, "log-reader") as thread:
        try:
            for item in _pack(file, name, block_bytes):
                if isinstance(item, list):
                    waiting.append(thread.submit(_open, item, free.pop() if free else bytearray()))
                else:
                    waiting.append(item)
                if len(waiting) > AHEAD:
                    yield from _finished(waiting.popleft(), free)
            while waiting:
                yield from _finished(waiting.popleft(), free)
        finally:
            thread.shutdown(cancel_futures=True)


def _finished(item: Future[Block] | RawRecord | Problem, free: list[bytearray]) -> Iterator[Item]:
    """Give an item; take back its memory afterwards: pages that are new cost more than what is done with them."""
    if not isinstance(item, Future):
        yield item
        return
    block = item.result()
    yield block
    free.append(block.memory)


def _pack(file: IO[bytes], name: str, block_bytes: int) -> Iterator[list[_Packed] | RawRecord | Problem]:
    """Read a file, chunks as they are."""
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
    """Take a record as it is passed on; None for one that isn't. crc: of all before it."""
    if isinstance(record, Problem) or record.opcode in _OTHERS:
        return record
    if record.opcode == Opcode.CHUNK or record.opcode in _OUTSIDE:
        return _packed(record, opening)
    if record.opcode == Opcode.DATA_END and int.from_bytes(record.body[:4], "little") not in (0, crc):
        return Problem("the data section fails its CRC")
    return None


def _packed(record: RawRecord, opening: Opening) -> _Packed | Problem:
    """Look at a chunk, or take a record outside chunks."""
    position = record.offset + HEAD.size
    if record.opcode != Opcode.CHUNK:
        whole = HEAD.pack(record.opcode, len(record.body)) + record.body
        return _Packed(whole, len(whole), position, [])
    try:
        chunk: Chunk = parse(record.opcode, record.body)
        opening.allow(len(chunk.data), chunk.uncompressed_size)
    except (LogError, ChunkError):
        return Problem(f"damaged at byte {position}", is_damage=True)
    return _Packed(chunk, chunk.uncompressed_size, position, [])


def _open(packed: list[_Packed], memory: bytearray) -> Block:
    chunks, indexes, problem = [], [], ""
    for one in packed:
        try:
            chunks.append(one.chunk if isinstance(one.chunk, bytes) else open_as_claimed(one.chunk))
        except ChunkError:
            problem = problem or f"damaged at byte {one.position}"
        else:
            indexes.append(b"".join(one.entries))
    contents = read_chunks(chunks, indexes, memory)
    memory = contents.data if isinstance(contents.data, bytearray) else memory
    return Block(contents, memory, packed[0].position, problem)
