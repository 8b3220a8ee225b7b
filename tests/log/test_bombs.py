"""Logs that open to more than there is, or say that they do: what is read is bounded, the rest is a named problem."""

import struct
import tracemalloc
import zlib

import lz4.frame
import pytest
import zstandard
from made_log import kinds, make_log, new, put_together, take_apart
from mcap.opcode import Opcode
from mcap.records import Chunk
from recorded_run import make_run, start

from adacd_hil.lab.logs.check.log_check import check_log
from adacd_hil.lab.logs.cut import TimeWindow, cut
from adacd_hil.lab.logs.log_info import read_info
from adacd_hil.lab.logs.recover import recover
from adacd_hil.lab.logs.signal_tables import export_tables
from adacd_hil.log.frames.frame_log import read_frames
from adacd_hil.log.log_files import LogError
from adacd_hil.log.log_walk import attachment
from adacd_hil.log.mcap.chunks import FREE_BYTES, MOST_BYTES, MOST_RATIO, ChunkError, Opening, decompress
from adacd_hil.log.mcap.mcap_records import MOST_RECORD_BYTES
from adacd_hil.log.reader import read_log
from adacd_hil.records import Event
from adacd_hil.wire.dbc_decoder import load_decoder

MOST_PEAK_BYTES = 400 << 20


def pack_unsized(data):
    """Compress as a writer that didn't know how much would come."""
    packer = zstandard.ZstdCompressor().compressobj()
    return packer.compress(data) + packer.flush()


PACKED = {
    "zstd": ("zstd", zstandard.compress),
    "zstd without a size": ("zstd", pack_unsized),
    "lz4": ("lz4", lz4.frame.compress),
    "nothing": ("", bytes),
}


def chunk_of(compression, data, size, crc=0):
    return Chunk(
        compression=compression,
        data=data,
        message_start_time=0,
        message_end_time=0,
        uncompressed_crc=crc,
        uncompressed_size=size,
    )


@pytest.mark.parametrize(("compression", "pack"), PACKED.values(), ids=PACKED)
def test_what_a_chunk_holds_is_had_again(compression, pack):
    data = bytes(range(256)) * 4000
    chunk = chunk_of(compression, pack(data), len(data), zlib.crc32(data))
    assert Opening().open_chunk(chunk) == data
    chunk.uncompressed_crc ^= 1
    with pytest.raises(ChunkError, match="fails its CRC"):
        Opening().open_chunk(chunk)
    with pytest.raises(ChunkError, match=r"holds 1024000 bytes, not 3"):
        Opening().open_chunk(chunk_of(compression, pack(data), 3))


@pytest.mark.slow
@pytest.mark.parametrize(("compression", "pack"), PACKED.values(), ids=PACKED)
def test_a_chunk_opens_to_so_many_bytes_and_no_more(compression, pack):
    assert len(decompress(compression, pack(bytes(MOST_BYTES)))) == MOST_BYTES
    with pytest.raises(ChunkError, match=f"opens to more than {MOST_BYTES} bytes"):
        decompress(compression, pack(bytes(MOST_BYTES + 1)))


@pytest.mark.parametrize(("compression", "pack"), [PACKED["zstd"], PACKED["zstd without a size"], PACKED["lz4"]])
def test_a_chunk_that_is_cut_or_rubbish_cannot_be_opened(compression, pack):
    packed = pack(bytes(range(256)) * 4000)
    for data in (packed[:-20], packed[:3], b"", b"rubbish" * 9):
        with pytest.raises(ChunkError):
            Opening().open_chunk(chunk_of(compression, data, 1_024_000))


def test_an_unknown_compression_is_named():
    with pytest.raises(ChunkError, match="unknown compression 'bzip2'"):
        Opening().open_chunk(chunk_of("bzip2", b"", 0))


def test_a_file_may_open_to_so_many_times_its_size():
    opening = Opening()
    for _ in range(FREE_BYTES // MOST_BYTES):
        opening.add_chunk(0, MOST_BYTES)
    opening.add_chunk(1000, 1000 * MOST_RATIO)
    with pytest.raises(ChunkError, match=f"opens to more than {MOST_RATIO} times the file before it"):
        opening.add_chunk(0, 1)


def many_small_bombs():
    """Many chunks of empty messages that pack to little: 12 KB in the file are 1 GiB."""
    zeros = bytes(MOST_BYTES - 100)
    record = struct.pack("<BQ", 0x7F, len(zeros)) + zeros
    data = zstandard.compress(record)
    return [new(chunk_of("zstd", data, len(record))) for _ in range(32)]


def lying_size():
    return [new(chunk_of("lz4", lz4.frame.compress(bytes(1000)), 1 << 40))]


def lz4_bomb():
    zeros = bytes(1 << 28)
    return [new(chunk_of("lz4", lz4.frame.compress(zeros), 100))]


def zstd_bomb():
    zeros = pack_unsized(bytes(1 << 28))
    return [new(chunk_of("zstd", zeros, 100))]


def zstd_with_a_long_window():
    """A frame that asks for a window of 2 GiB, RFC 8878 3.1.1.1.2, and repeats one byte."""
    frame = b"\x28\xb5\x2f\xfd" + bytes([0x00, 21 << 3]) + (b"\x02\x00\x10" + b"\0") * 10 + b"\x03\x00\x00\0"
    return [new(chunk_of("zstd", frame, 100))]


BOMBS = {f.__name__: f for f in (many_small_bombs, lying_size, lz4_bomb, zstd_bomb, zstd_with_a_long_window)}


def bombed_log(path, bomb, chunks=((0, 5), (5, 10))):
    parts = take_apart(make_log(chunks=chunks))
    place = parts.index(kinds(parts, Opcode.DATA_END)[0])
    path.write_bytes(put_together(parts[:place] + bomb() + parts[place:]))
    return path


def readers(path, folder):
    """Read a log in every way."""
    yield lambda: read_log(path).problem
    yield lambda: read_frames(path).problem
    yield lambda: [finding for finding in check_log(path).findings if finding.rule == "chunk-crc"]
    yield lambda: recover(path, folder / "recovered.mcap").losses.chunks
    yield lambda: export_tables(path, folder / "tables", "csv", (), load_decoder()).problem


@pytest.mark.slow
@pytest.mark.parametrize("bomb", BOMBS.values(), ids=BOMBS)
def test_a_bomb_in_a_log_is_a_problem_in_every_way_of_reading_it(bomb, tmp_path):
    path = bombed_log(tmp_path / "run.mcap", bomb)
    for read in readers(path, tmp_path):
        tracemalloc.start()
        try:
            problem = read()
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert problem
        assert peak < MOST_PEAK_BYTES
    with pytest.raises(LogError):
        cut(path, tmp_path / "cut.mcap", TimeWindow(0.0, 1.0), ())
    assert len(read_log(tmp_path / "recovered.mcap").metadata)


@pytest.mark.slow
@pytest.mark.parametrize("times", [101, 0])
def test_a_chunk_is_read_once_however_often_the_summary_names_it(times, tmp_path):
    path = tmp_path / "run.mcap"
    with start(path, make_run(20)) as recorder:
        recorder.event(0, Event("info", "run", "begins"))
    parts = take_apart(path.read_bytes())
    place = parts.index(kinds(parts, Opcode.CHUNK_INDEX)[0])
    path.write_bytes(put_together(parts[:place] + [parts[place]] * times + parts[place + 1 :]))
    assert dict(read_info(path).events) == {"info": 1}


@pytest.mark.slow
def test_a_record_that_is_too_large_is_not_read(tmp_path):
    """A sparse file: what the record says is true."""
    whole = make_log()
    parts = take_apart(whole)
    start = parts[1].offset
    path = tmp_path / "run.mcap"
    size = MOST_RECORD_BYTES + (1 << 20)
    body_start = struct.pack("<QQI3sIQ", 0, 0, 3, b"big", 0, size - 16 - 7 - 4 - 8 - 4)
    with path.open("wb") as file:
        file.write(whole[:start] + struct.pack("<BQ", Opcode.ATTACHMENT, size) + body_start)
        file.truncate(start + 9 + size)
    tracemalloc.start()
    try:
        assert f"has {size} bytes, more than {MOST_RECORD_BYTES}" in read_log(path).problem
        assert f"has {size} bytes, more than {MOST_RECORD_BYTES}" in read_frames(path).problem
        assert read_info(path).problems
        assert attachment(path, "big") is None
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < MOST_PEAK_BYTES


@pytest.mark.parametrize("opcode", [Opcode.ATTACHMENT, Opcode.METADATA, Opcode.CHUNK, Opcode.MESSAGE, 0x80])
def test_a_record_longer_than_its_file_is_a_cut(opcode, tmp_path):
    path = tmp_path / "run.mcap"
    whole = make_log()
    for length in (len(whole), 2**32, 2**63, 2**64 - 1):
        path.write_bytes(whole[: take_apart(whole)[1].offset] + struct.pack("<BQ", opcode, length) + bytes(50))
        assert read_log(path).problem
        assert read_frames(path).problem
        assert check_log(path).findings
        assert attachment(path, "config.toml") is None


def test_a_log_that_is_compressed_well_is_no_bomb(tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(make_log(chunks=tuple((n, n + 1000) for n in range(0, 20_000, 1000)), summary=None))
    assert read_log(path).problem == ""
    assert [finding.rule for finding in check_log(path).findings] == ["ending"]
