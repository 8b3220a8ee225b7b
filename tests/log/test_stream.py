"""A log read piece by piece: the pieces together are the log, as mcap's own reader and what was recorded have it."""

import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from made_log import flipped
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from recorded_run import by_others, make_run, payloads, plain_frames, record

from adacd_hil.lab.logs.signal_tables import export_tables
from adacd_hil.log.log_files import FIELDS_KEY, find_parts, part_path
from adacd_hil.log.reader import LogStream, read_log
from adacd_hil.log.types.message_types import LOG, pack_log
from adacd_hil.log.types.topics import run_channels
from adacd_hil.records import Event
from adacd_hil.settings.run_settings import LogSettings
from adacd_hil.wire.dbc_decoder import load_decoder

COUNT = 900
EPOCH_NS = 1_700_000_000_000_000_000
FRAMES = ("/to_can_bus", "/from_can_bus", "/to_can_bus_fd", "/from_can_bus_fd")


@pytest.fixture(scope="module")
def run():
    return make_run(COUNT, has_fd=True)


@pytest.fixture(scope="module")
def path(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("stream") / "run.mcap"
    record(path, run, settings=LogSettings(part_MiB=1, part_min=0.0), epoch_ns=EPOCH_NS)
    assert len(find_parts(path)) == 2
    return path


@pytest.fixture
def spoiled(path, tmp_path):
    """A copy to spoil."""
    shutil.copytree(path.parent, tmp_path / "copy")
    return tmp_path / "copy" / "run.mcap"


@pytest.fixture(scope="module")
def others(path):
    """The payloads of each topic, read with mcap."""
    parts = [by_others(part) for part in find_parts(path).values()]
    return {topic: [m.data for part in parts for m, _ in part.get(topic, ())] for topic in set().union(*parts)}


def frames_of(pieces):
    return [frame for piece in pieces for frame in plain_frames(piece.frames)]


def times_of(piece):
    """The cycles that a piece has something of, by topic; frames last."""
    times = [set((s.records["publish_time"].astype(np.int64) - EPOCH_NS).tolist()) for s in piece.series.values()]
    return [*times, set(piece.frames["cycle_t_ns"].tolist())]


@pytest.mark.slow
@pytest.mark.parametrize("cycles", [5, 64, 10_000])
def test_the_pieces_together_are_the_log(cycles, path, run, others):
    stream = LogStream(path, cycles_per_piece=cycles)
    pieces = list(stream)
    assert stream.problem == ""
    for topic in others.keys() - {*FRAMES, "/events"}:
        assert b"".join(payloads(piece.series[topic]) for piece in pieces) == b"".join(others[topic]), topic
    assert [payload for piece in pieces for payload in piece.payloads["/events"]] == others["/events"]
    assert frames_of(pieces) == run.frames
    assert not any(topic in piece.series for topic in FRAMES for piece in pieces)


def test_a_piece_never_splits_a_cycle_and_has_as_many_as_asked_for(path, run):
    pieces = [set.union(*times_of(piece)) for piece in LogStream(path, cycles_per_piece=64)]
    every = [cycle.t_ns for cycle in run.cycles]
    assert [sorted(piece) for piece in pieces] == [every[start : start + 64] for start in range(0, COUNT, 64)]


def test_what_a_log_was_made_with_is_known_at_once(path, run):
    stream = LogStream(path)
    assert stream.epoch_ns == EPOCH_NS
    assert stream.metadata["name"] == "Prüfung"
    assert stream.attachments["arm.dbc"] == run.attachments["arm.dbc"]
    assert stream.summary == {}
    assert sum(len(piece.frames) for piece in stream) == int(stream.summary["frames"])
    assert stream.summary["ending"] == "closed"


def test_only_what_is_asked_for_is_gathered(path):
    (piece,) = LogStream(path, ("/cycle", "/truth", "/decoded/Sync"))
    assert {topic: len(series) for topic, series in piece.series.items()} == {
        "/cycle": COUNT,
        "/truth": 0,
        "/decoded/Sync": COUNT,
    }
    assert (len(piece.frames), piece.payloads) == (0, {})
    (piece,) = LogStream(path, ("/from_can_bus", "/events"))
    assert (piece.series, set(piece.payloads), set(piece.frames["is_tx"])) == ({}, {"/events"}, {False})


def test_what_lies_beyond_the_data_is_zero_whatever_the_memory_held(path, monkeypatch):
    def used(shape, dtype):
        count = int(np.prod(shape))
        return np.frombuffer(bytes([0xAA]) * np.dtype(dtype).itemsize * count, dtype).copy().reshape(shape)

    monkeypatch.setattr(np, "empty", used)
    log = read_log(part_path(path, 1), FRAMES)
    beyond = np.arange(64) >= log.frames["length"][:, np.newaxis]
    assert beyond.any()
    assert not log.frames["data"][beyond].any()


def test_a_stream_that_is_left_leaves_no_thread(path):
    before = threading.active_count()
    pieces = iter(LogStream(path, cycles_per_piece=10))
    assert len(next(pieces).frames)
    pieces.close()
    assert threading.active_count() == before


def test_a_cut_part_costs_what_comes_behind(spoiled, run):
    part = part_path(spoiled, 1)
    data = part.read_bytes()
    for size in (0, 7, 40, len(data) // 2, len(data) - 3):
        part.write_bytes(data[:size])
        stream = LogStream(spoiled, FRAMES, 100)
        read = frames_of(stream)
        said = {0: " is empty", 7: " is cut after 7 bytes"}.get(size, f": cut after {size} bytes")
        assert stream.problem.endswith(f"run_001.mcap{said}")
        assert read == run.frames[: len(read)]
    assert len(read) == len(run.frames)
    assert part_path(spoiled, 0).stat().st_size > 500_000


def test_a_flipped_chunk_costs_only_itself(spoiled, run):
    """Also when it is the first, which defines the topics."""
    whole = spoiled.read_bytes()
    with spoiled.open("rb") as file:
        found = [item for item in StreamReader(file, emit_chunks=True).records if isinstance(item, Chunk)]
    times = [cycle.t_ns for cycle in run.cycles]
    for chunk in (found[0], found[2]):
        place = whole.index(chunk.data)
        spoiled.write_bytes(flipped(whole, place + len(chunk.data) // 2))
        stream = LogStream(spoiled, ("/scheme",), 50)
        read = [t_ns for piece in stream for t_ns in piece.series["/scheme"].t_ns.tolist()]
        first, last = chunk.message_start_time - EPOCH_NS, chunk.message_end_time - EPOCH_NS
        lost = [t_ns for t_ns in times if t_ns not in read]
        assert stream.problem == f"run.mcap: damaged at byte {place - 48 + 4}"
        inside = {t_ns for t_ns in times if first <= t_ns <= last}
        assert len(inside) >= 5
        assert set(lost) <= inside
        assert len(inside) - len(lost) <= 2  # cycles at the ends, of which another chunk has this message


def write_foreign(path, messages, schema="builtin_interfaces/Time stamp\nuint8 value\n", **options):
    """Write (topic, publish time, payload) with mcap's writer."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start()
        schemas = {
            "/value": writer.register_schema("their_msgs/msg/Value", "ros2msg", schema.encode()),
            "/events": writer.register_schema(LOG.name, "ros2msg", LOG.text.encode()),
        }
        channels = {topic: writer.register_channel(topic, "cdr", schema) for topic, schema in schemas.items()}
        for topic, time_ns, payload in messages:
            writer.add_message(channels[topic], time_ns, payload, time_ns)
        writer.finish()


def value(number):
    return bytes((0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, number))


EVENT = pack_log(bytes(8), Event("info", "name", "b"))  # the name is its bytes 28 to 32


@pytest.mark.parametrize("payload", [b"", b"text", EVENT[:22], EVENT[:30], b"\xff" * 40])
def test_an_event_that_is_none_is_left_out_and_said(payload, tmp_path):
    path = tmp_path / "theirs.mcap"
    event = pack_log(bytes(8), Event("info", "node", "text"))
    write_foreign(path, [("/events", 0, event), ("/events", 1, payload), ("/events", 2, event)])
    stream = LogStream(path)
    found = [logged.event.message for piece in stream for logged in stream.events(piece)]
    assert found == ["text", "text"]
    assert stream.problem == "a message is not as long as its schema says"
    tables = export_tables(path, tmp_path / "tables", "csv", (), load_decoder())
    assert tables.rows[tmp_path / "tables" / "events.csv"] == 2
    assert tables.problem == stream.problem


@pytest.mark.parametrize(
    "options",
    [{"use_chunking": False}, {"compression": CompressionType.NONE}, {"chunk_size": 100}, {"enable_crcs": False}],
)
def test_logs_that_others_wrote_are_read(options, tmp_path):
    path = tmp_path / "theirs.mcap"
    messages = [("/value", 10 * number, value(number)) for number in range(200)]
    event = pack_log(bytes(8), Event("info", "their node", "text"))
    write_foreign(path, [*messages, ("/events", 2000, event)], **options)
    stream = LogStream(path, cycles_per_piece=70)
    pieces = list(stream)
    assert stream.problem == ""
    assert [piece.series["/value"]["value"].tolist() for piece in pieces] == [
        list(range(70)),
        list(range(70, 140)),
        list(range(140, 200)),
    ]
    assert [piece.payloads["/events"] for piece in pieces] == [[], [], [event]]


def test_a_message_that_is_too_short_or_too_long_is_left_out(tmp_path):
    path = tmp_path / "theirs.mcap"
    payloads = [value(1), value(2)[:-1], value(3) + b"!", b"", value(4)]
    write_foreign(path, [("/value", 5, payload) for payload in payloads])
    stream = LogStream(path)
    (piece,) = stream
    assert piece.series["/value"]["value"].tolist() == [1, 4]
    assert stream.problem == "a message is not as long as its schema says"


def test_a_part_whose_topic_has_another_type_keeps_its_other_topics(tmp_path):
    path = tmp_path / "run.mcap"
    one, two = (pack_log(bytes(8), Event("info", "their node", text)) for text in ("one", "two"))
    write_foreign(path, [("/value", 1, value(1)), ("/events", 1, one)])
    other = "builtin_interfaces/Time stamp\nuint16 value\n"
    write_foreign(part_path(path, 1), [("/value", 2, value(2)), ("/events", 2, two)], other)
    stream = LogStream(path)
    (piece,) = stream
    assert piece.series["/value"]["value"].tolist() == [1]
    assert piece.payloads["/events"] == [one, two]
    # Without metadata, the second file passes for a part.
    assert stream.problem == "run_001.mcap: /value has another type than before"


def test_a_topic_that_begins_in_a_later_part_keeps_what_was_before(path, tmp_path):
    first = tmp_path / "run.mcap"
    write_foreign(first, [("/value", 1, value(1))])
    kind = next(channel for channel in run_channels(7) if channel.topic == "/cycle").type
    with part_path(first, 1).open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(kind.name, "ros2msg", kind.text.encode())
        channel = writer.register_channel("/cycle", "cdr", schema, {FIELDS_KEY: " ".join(kind.fields)})
        writer.add_message(channel, 2, bytes(kind.dtype.itemsize), 2)
        writer.finish()
    (piece,) = LogStream(first)
    assert piece.series["/value"]["value"].tolist() == [1]
    assert len(piece.series["/cycle"]) == 1


@pytest.mark.slow
def test_neither_the_writer_process_nor_reading_a_log_loads_the_compiler(path):
    code = (
        "import sys, adacd_hil.log.recording.writer, adacd_hil.log.reader, adacd_hil.log.reader\n"
        "assert adacd_hil.log.reader.read_log(sys.argv[1]).metadata\n"
        "assert list(adacd_hil.log.reader.LogStream(sys.argv[1]))\n"
        "print('numba' in sys.modules)"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    command = [sys.executable, "-c", code, str(path)]
    loaded = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert loaded.stdout.strip() == "False"
