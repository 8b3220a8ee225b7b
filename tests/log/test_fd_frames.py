"""CAN FD in the log: frames of every length, both ways, among classic ones; for us and for others."""

import collections

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from recorded_run import LONG_ID, fd_contract, make_run, record

from adacd_hil.log.reader import FRAME_DTYPE, LONG_FRAME_DTYPE, read_log, topic_bytes
from adacd_hil.log.types.message_types import pack_fd_frame
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.codec import load_codec

pytestmark = pytest.mark.slow  # each log starts a process


@pytest.fixture(scope="module")
def run():
    return make_run(140, has_fd=True)


@pytest.fixture(scope="module")
def recorded(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("fd")
    path = folder / "run.mcap"
    codec = load_codec(fd_contract(folder))
    return path, record(path, run, messages=codec.messages.values()), codec


@pytest.fixture(scope="module")
def log(recorded):
    return read_log(recorded[0])


@pytest.fixture(scope="module")
def by_others(recorded):
    messages = collections.defaultdict(list)
    with recorded[0].open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        for _, channel, message, decoded in reader.iter_decoded_messages():
            messages[channel.topic].append((message, decoded))
    return messages


def test_classic_and_fd_frames_are_read_back_in_the_order_of_the_bus(run, log, recorded):
    read = [
        (
            bool(f["is_tx"]),
            Frame(int(f["can_id"]), f["data"].tobytes()[: f["length"]], int(f["t_ns"]), bool(f["is_error"])),
        )
        for f in log.frames
    ]
    assert read == [(is_tx, frame._replace(data=bytes(frame.data))) for is_tx, frame in run.frames]
    assert recorded[1].frames == len(read)
    assert log.is_complete


def test_what_lies_beyond_the_data_is_zero(log):
    beyond = np.arange(64) >= log.frames["length"][:, np.newaxis]
    assert log.frames.dtype == LONG_FRAME_DTYPE
    assert not log.frames["data"][beyond].any()


def test_each_fd_frame_knows_its_cycle(run, log):
    assert log.frames["cycle_t_ns"].tolist() == [cycle.t_ns for cycle in run.cycles for _ in cycle.frames]


def test_a_log_of_classic_frames_has_no_room_for_more(tmp_path):
    record(tmp_path / "run.mcap", make_run(3))
    frames = read_log(tmp_path / "run.mcap").frames
    assert frames.dtype == FRAME_DTYPE
    assert frames.dtype.itemsize == 31


def test_others_decode_fd_frames_to_the_same_values(run, by_others):
    for topic, is_sent in (("/to_can_bus_fd", True), ("/from_can_bus_fd", False)):
        frames = [frame for is_tx, frame in run.frames if is_tx == is_sent and len(frame.data) > 8]
        decoded = [decoded for _, decoded in by_others[topic]]
        assert {d.len for d in decoded} == {12, 16, 20, 24, 32, 48, 64}
        assert [bytes(d.data) for d in decoded] == [f.data for f in frames]
        assert [d.len for d in decoded] == [len(f.data) for f in frames]
        assert [d.id for d in decoded] == [f.can_id for f in frames]
        assert [d.is_extended for d in decoded] == [f.can_id > 0x7FF for f in frames]
        assert not any(d.is_error for d in decoded)
        assert [d.header.stamp.sec * 10**9 + d.header.stamp.nanosec for d in decoded] == [f.t_ns for f in frames]


def test_classic_frames_stay_on_their_topics(run, by_others):
    for topic, is_sent in (("/to_can_bus", True), ("/from_can_bus", False)):
        frames = [frame for is_tx, frame in run.frames if is_tx == is_sent and len(frame.data) <= 8]
        assert [bytes(d.data)[: d.dlc] for _, d in by_others[topic]] == [bytes(f.data) for f in frames]


def test_an_fd_message_of_the_contract_has_a_topic_of_its_own(run, log, recorded):
    message = recorded[2].message("Long")
    frames = [frame for _, frame in run.frames if frame.can_id == LONG_ID and len(frame.data) == message.length]
    series = log.decoded["Long"]
    assert len(frames) == 20
    assert series.fields == tuple(signal.name for signal in message.signals)
    assert series.t_ns.tolist() == [frame.t_ns for frame in frames]
    assert [tuple(row) for row in series.block.tolist()] == [message.decode(frame.data) for frame in frames]


def test_topic_bytes_of_fd_frames_are_the_payloads(recorded, by_others):
    for topic in ("/to_can_bus_fd", "/from_can_bus_fd", "/from_can_bus"):
        assert topic_bytes(recorded[0], topic) == b"".join(message.data for message, _ in by_others[topic])


def test_a_cut_log_gives_the_fd_frames_that_came_before(run, recorded, tmp_path):
    whole = recorded[0].read_bytes()
    path = tmp_path / "cut.mcap"
    times = [frame.t_ns for _, frame in run.frames]
    for size in np.random.default_rng(5).integers(0, len(whole), 40).tolist():
        path.write_bytes(whole[:size])
        log = read_log(path)
        assert not log.is_complete
        assert log.frames["t_ns"].tolist() == times[: len(log.frames)]


def test_an_fd_payload_is_laid_out_as_written_by_hand():
    stamp = bytes.fromhex("0100000002000000")
    expected = (
        "00010000"  # little-endian CDR
        "01000000 02000000"  # stamp
        "01000000 00 000000"  # frame_id "", aligned
        "81010000 00 01 0c 00"  # id, is_extended, is_error, len, aligned
        "0c000000 000102030405060708090a0b"  # data
    )
    assert pack_fd_frame(stamp, 0x181, bytes(range(12)), True) == bytes.fromhex(expected)
