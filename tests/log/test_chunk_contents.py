"""Messages found by the indexes behind chunks: the same as found record by record, whatever an index says."""

import functools
import itertools
import struct

import pytest
from made_log import kinds, make_log, message, payload, put_together, rechunk, take_apart
from mcap.opcode import Opcode
from recorded_run import payloads

from adacd_hil.log import log_walk
from adacd_hil.log.mcap.chunks import PADDING, read_chunks
from adacd_hil.log.reader import read_log

CHUNKS = ((0, 5), (5, 10), (10, 15))
ENTRY = 14
"""Where the offset of the first entry is in a message index."""


def without_indexes(parts):
    return [part for part in parts if part.opcode != Opcode.MESSAGE_INDEX]


def index_of_second_chunk(parts, offset):
    kinds(parts, Opcode.MESSAGE_INDEX)[2].put(ENTRY, "<Q", offset)
    return parts


def cut_entry(parts):
    index = kinds(parts, Opcode.MESSAGE_INDEX)[2]
    index.body = index.body[:2] + struct.pack("<I", len(index.body) - 22) + index.body[6:-16]
    return parts


INDEXES = {
    "none": without_indexes,
    "one that lacks a message": cut_entry,
    "an offset within a record": lambda parts: index_of_second_chunk(parts, 3),
    "an offset of another message": lambda parts: index_of_second_chunk(parts, 64),
    "an offset beyond the chunk": lambda parts: index_of_second_chunk(parts, 1 << 20),
    "an offset beyond 63 bits": lambda parts: index_of_second_chunk(parts, (1 << 63) + 5),
}


def read(path, parts):
    path.write_bytes(put_together(parts))
    log = read_log(path)
    return log.problem, {topic: payloads(series) for topic, series in log.topics.items()}


@pytest.fixture
def path(tmp_path, monkeypatch):
    """Where a log is put that is read chunk by chunk: only the first has definitions, which no index has."""
    read_blocks = functools.partial(log_walk.read_blocks, block_bytes=1)
    monkeypatch.setattr(log_walk, "read_blocks", read_blocks)
    return tmp_path / "run.mcap"


@pytest.mark.parametrize("spoil", INDEXES.values(), ids=INDEXES)
def test_a_wrong_index_changes_nothing(spoil, path):
    def parts_of():
        return take_apart(make_log(topics=("/decoded/A", "/decoded/B"), chunks=CHUNKS))

    whole = read(path, parts_of())
    assert whole[0] == ""
    assert len(whole[1]["/decoded/A"]) == 15 * len(payload(0))
    assert read(path, spoil(parts_of())) == whole


def test_a_message_that_no_index_has_is_read(path):
    parts = take_apart(make_log(topics=("/decoded/A",), chunks=CHUNKS))
    rechunk(kinds(parts, Opcode.CHUNK)[1], lambda data: data + message(1, 10, payload(77)))
    problem, payloads = read(path, parts)
    assert problem == ""
    assert payloads["/decoded/A"].count(payload(77)) == 1


def test_a_record_that_goes_on_in_the_next_chunk_is_none():
    """The indexes fill both chunks together, but not each of them."""
    records = [message(1, number, payload(number)) for number in range(3)]
    data, size = b"".join(records), len(records[0])
    chunks = [data[: size + 40], data[size + 40 :]]
    indexes = [struct.pack("<QQQQ", 0, 0, 1, size), struct.pack("<QQ", 2, size - 40)]
    contents = read_chunks(data + bytes(PADDING), list(itertools.accumulate(map(len, chunks))), indexes)
    assert contents.breaks[0] == size
    assert size not in contents.starts
