"""A log file of which one bit was flipped after it had been written, with checksums that fit."""

import struct
import zlib
from pathlib import Path

import zstandard
from mcap.opcode import Opcode

MAGIC_BYTES = 8
_HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQI")  # times, uncompressed size, CRC


def flip_in_file(source: Path, target: Path, wanted: bytes, place: int, bit: int = 0) -> None:
    """Flip a bit of the first message record that contains `wanted`, `place` bytes after where that begins."""
    data = source.read_bytes()
    result = bytearray(data[:MAGIC_BYTES])
    position = MAGIC_BYTES
    is_done = False
    while position < len(data) - MAGIC_BYTES:
        opcode, length = _HEAD.unpack_from(data, position)
        body = data[position + _HEAD.size : position + _HEAD.size + length]
        if opcode == Opcode.CHUNK and not is_done:
            start, end, _, _ = _CHUNK.unpack_from(body)
            name_end = _CHUNK.size + 4 + int.from_bytes(body[_CHUNK.size : _CHUNK.size + 4], "little")
            records = bytearray(zstandard.ZstdDecompressor().decompress(body[name_end + 8 :]))
            found = records.find(wanted)
            if found >= 0:
                records[found + place] ^= 1 << bit
                packed = zstandard.ZstdCompressor().compress(bytes(records))
                head = _CHUNK.pack(start, end, len(records), zlib.crc32(records))
                body = head + body[_CHUNK.size : name_end] + len(packed).to_bytes(8, "little") + packed
                is_done = True
        if opcode == Opcode.DATA_END:
            body = bytes(4)
        result += _HEAD.pack(opcode, len(body)) + body
        position += _HEAD.size + length
    assert is_done
    target.write_bytes(bytes(result) + data[-MAGIC_BYTES:])
