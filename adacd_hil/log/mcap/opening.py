"""What a chunk holds, decompressed within bounds: neither a chunk nor a whole file may open to more than makes sense.

Ours have 256 KiB before compression and shrink to 40 %; those of others have 1 to 16 MiB. A file of a few kilobytes
that opens to gigabytes is no log.
"""

import lz4.frame
import zstandard
from mcap.records import Chunk

from adacd_hil.log.mcap.mcap_records import crc32

MOST_BYTES = 32 << 20
"""Of a chunk, before compression."""
MOST_RATIO = 200
"""How many times its size in the file all that has been opened of it may have."""
FREE_BYTES = 64 << 20
"""What may be opened of a file whatever its size."""
_PIECE_BYTES = 1 << 20
_KINDS = ("", "zstd", "lz4")


class ChunkError(ValueError):
    """A chunk that can't be trusted; the message says why."""


class Opening:
    """Counts what has been opened of a file. One for each reading of it."""

    def __init__(self) -> None:
        self._packed = self._opened = 0

    def allow(self, packed: int, size: int) -> None:
        """Count a chunk of `packed` bytes in the file and `size` opened. Raises ChunkError when that's too much."""
        if size > MOST_BYTES:
            raise ChunkError(f"opens to {size} bytes, more than {MOST_BYTES}")
        self._packed += packed
        self._opened += size
        if self._opened > FREE_BYTES + MOST_RATIO * self._packed:
            raise ChunkError(f"opens to more than {MOST_RATIO} times the file before it")

    def open(self, chunk: Chunk) -> bytes:
        """Return what a chunk holds, as long as it is. Raises ChunkError when that can't be had."""
        data = decompress(chunk.compression, chunk.data)
        self.allow(len(chunk.data), len(data))
        return data

    def open_checked(self, chunk: Chunk) -> bytes:
        """Return what a chunk holds. Raises ChunkError when it isn't what was put in, as far as that can be told."""
        return _checked(chunk, self.open(chunk), is_size_certain=bool(chunk.uncompressed_crc))


def open_as_claimed(chunk: Chunk) -> bytes:
    """Return what a chunk holds, whose size has been allowed. Raises ChunkError when that isn't as it says."""
    data = decompress(chunk.compression, chunk.data, chunk.uncompressed_size)
    return _checked(chunk, data, is_size_certain=False)


def _checked(chunk: Chunk, data: bytes, is_size_certain: bool) -> bytes:
    if chunk.uncompressed_crc and crc32(data) != chunk.uncompressed_crc:
        raise ChunkError("fails its CRC")
    if not is_size_certain and len(data) != chunk.uncompressed_size:
        raise ChunkError(f"holds {len(data)} bytes, not {chunk.uncompressed_size}")
    return data


def decompress(compression: str, data: bytes, most_bytes: int = MOST_BYTES) -> bytes:
    """Decompress the records of a chunk. Raises ChunkError when that fails, and for more than `most_bytes`."""
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
    if compression == "":
        return data
    if compression == "zstd":
        return _unzstd(data, most_bytes)
    stream = lz4.frame.LZ4FrameDecompressor()
    opened: bytes = stream.decompress(data, most_bytes + 1)
    if not stream.eof and len(opened) <= most_bytes:
        raise ChunkError("can't be decompressed: it is cut")
    return opened


def _unzstd(data: bytes, most_bytes: int) -> bytes:
    size = zstandard.frame_content_size(data)
    decompressor = zstandard.ZstdDecompressor(max_window_size=MOST_BYTES)
    if size > most_bytes:
        raise ChunkError(f"claims {size} bytes, more than {most_bytes}")
    if size >= 0:
        return decompressor.decompress(data, max_output_size=max(size, 1))
    pieces, left = [], most_bytes + 1
    with decompressor.stream_reader(data) as reader:  # a writer that didn't know
        while left > 0 and (piece := reader.read(min(left, _PIECE_BYTES))):
            pieces.append(piece)
            left -= len(piece)
    return b"".join(pieces)
