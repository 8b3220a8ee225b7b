"""Recording through the real writer process: what went in is in the file, for us and for others."""

import json
import os
import socket
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Attachment, Chunk, DataEnd, Header, MessageIndex, Metadata
from mcap.stream_reader import StreamReader
from recorded_run import (
    LONG_ID,
    UNKNOWN_ID,
    by_others,
    fd_codec,
    make_run,
    plain_frames,
    record,
    start,
)
from topic_bytes import topic_bytes

from adacd_hil import __version__
from adacd_hil.lab.logs.log_info import read_info
from adacd_hil.log.reader import read_log
from adacd_hil.log.types.topics import run_channels
from adacd_hil.log.viewer_layout import viewer_layout
from adacd_hil.records import scheme_layout
from adacd_hil.wire.frame_lengths import FD_LENGTHS

pytestmark = pytest.mark.slow  # each log starts a process

COUNT = 700
EPOCH_NS = 1_700_000_000_987_654_321
CODEC_FD = fd_codec()


def make_fd_run():
    return make_run(COUNT, has_fd=True)


@pytest.fixture(scope="module")
def run():
    return make_fd_run()


@pytest.fixture(scope="module")
def recorded(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    return path, record(path, run, messages=CODEC_FD.messages.values())


@pytest.fixture(scope="module")
def log(recorded):
    return read_log(recorded[0])


@pytest.fixture(scope="module")
def others(recorded):
    return by_others(recorded[0])


def decodable(run):
    """List (message, frame) of the frames that the DBC knows."""
    known = [(CODEC_FD.by_id.get(frame.can_id), frame) for *_, frame in run.frames]
    return [(m, frame) for m, frame in known if m and not frame.is_error and len(frame.data) == m.length]


def test_the_summary_counts_what_was_written(run, recorded, log, others):
    contacts = sum(cycle.contact is not None for cycle in run.cycles)
    events = sum(cycle.event is not None for cycle in run.cycles)
    messages = len(run.frames) + len(decodable(run)) + 5 * COUNT + contacts + events
    assert recorded[1][1:-1] == (len(run.frames), messages, 0, "", 1)
    assert 0 < recorded[1].queue_peak_bytes < 4 * 2**20
    assert sum(map(len, others.values())) == messages
    assert (log.problem, log.is_complete) == ("", True)
    assert (log.summary["ending"], log.summary["dropped"]) == ("closed", "0")


def test_bytes_are_told_of_what_was_read(recorded):
    brief, whole = (read_info(recorded[0], is_brief=is_brief) for is_brief in (True, False))
    sizes = [next(each.bytes for each in info.topics if each.topic == "/events") for info in (brief, whole)]
    assert sizes[0] is None
    assert sizes[1] > 0


def test_what_the_scheme_decided_is_read_back_bit_for_bit(run, log):
    assert log.scheme.block.tobytes() == run.blocks.tobytes()
    for name, place in scheme_layout(7).slices.items():
        values = log.scheme[name]
        assert values.shape == ((COUNT,) if place.stop - place.start == 1 else (COUNT, place.stop - place.start))
        assert values.tobytes() == run.blocks[:, place].tobytes()
    outputs = [cycle.output for cycle in run.cycles]
    assert log.scheme.t_ns.tolist() == [cycle.t_ns for cycle in run.cycles]
    for name in ("cycle", "state", "previous_state", "fault", "contact_joints", "is_model_valid"):
        assert log.scheme[name].tolist() == [getattr(output, name) for output in outputs]
    assert log.scheme["request"].tolist() == [cycle.request for cycle in run.cycles]
    for name in ("q", "dq", "tau_J"):
        assert log.topics["/joint_states"][name].tobytes() == log.scheme[name].tobytes()
    with pytest.raises(KeyError, match=r"tau_X.*tau_ext_hat"):
        log.scheme["tau_X"]


def test_commands_cycles_events_and_contacts_are_read_back(run, log):
    assert log.control.block.tobytes() == np.array([cycle.control for cycle in run.cycles]).tobytes()
    assert log.control["gate_flags"].tolist() == [cycle.gate_flags for cycle in run.cycles]
    assert log.control["enable"].all()
    assert not log.control["quick_stop"].any()
    for name in run.cycles[0].record._fields:
        assert log.cycle[name].tolist() == [getattr(cycle.record, name) for cycle in run.cycles]
    assert log.events == [(cycle.t_ns, cycle.event) for cycle in run.cycles if cycle.event]
    assert log.contacts == [(cycle.t_ns, cycle.contact) for cycle in run.cycles if cycle.contact]
    assert min(len(log.events), len(log.contacts)) > 10


def test_frames_of_every_length_are_read_back_in_the_order_of_the_bus_with_their_cycle(run, log):
    assert plain_frames(log.frames) == run.frames
    assert {len(frame.data) for *_, frame in run.frames} >= {*FD_LENGTHS, 8}
    beyond = np.arange(64) >= log.frames["length"][:, np.newaxis]
    assert not log.frames["data"][beyond].any()


def test_whole_frames_of_the_dbc_are_decoded_and_no_others(run, log):
    for name in ("Sync", "Drive1Command", "Drive2Feedback", "Sensor1Torque", "Long"):
        message = CODEC_FD.messages[name]
        frames = [frame for m, frame in decodable(run) if m is message]
        series = log.topics[f"/decoded/{name}"]
        assert len(frames) >= COUNT // len(FD_LENGTHS)
        assert series.t_ns.tolist() == [frame.t_ns for frame in frames]
        assert series.fields == tuple(signal.name for signal in message.signals)
        assert [tuple(row) for row in series.block.tolist()] == [message.decode(frame.data) for frame in frames]
    assert (
        sum(len(series) for topic, series in log.topics.items() if "/decoded/" in topic)
        == len(decodable(run))
        < len(run.frames)
    )
    assert {UNKNOWN_ID, LONG_ID} <= set(log.frames["can_id"].tolist())
    assert any(log.frames["is_error"])


def test_attachments_and_metadata_are_read_back(run, log):
    assert {name: log.attachments[name] for name in run.attachments} == run.attachments
    assert {key: log.metadata[key] for key in run.metadata} == run.metadata
    assert log.metadata["mode"] == "lockstep"


def test_others_decode_numbers_and_events_to_the_same_values(run, log, others):
    topics = {"/scheme": log.scheme, "/control": log.control, "/cycle": log.cycle, "/contact": log.topics["/contact"]}
    topics |= {topic: series for topic, series in log.topics.items() if "/decoded/" in topic and len(series)}
    for topic, series in topics.items():
        for name in series.fields:
            theirs = np.array([getattr(decoded, name.lower()) for _, decoded in others[topic]])
            np.testing.assert_array_equal(theirs, series[name], strict=False)
    decoded = [decoded for _, decoded in others["/joint_states"]]
    assert {tuple(d.name) for d in decoded} == {("joint1", "joint2")}
    for theirs, ours in (("position", "q"), ("velocity", "dq"), ("effort", "tau_J")):
        assert [getattr(d, theirs) for d in decoded] == log.scheme[ours].tolist()
    levels = {"info": 2, "warning": 3, "error": 4}
    theirs = [(d.level, d.name, d.message, d.file, d.line) for _, d in others["/events"]]
    assert theirs == [(levels[c.event.level], c.event.name, c.event.message, "", 0) for c in run.cycles if c.event]


@pytest.mark.parametrize("is_fd", [False, True])
@pytest.mark.parametrize(("way", "is_sent"), [("to", True), ("from", False)])
def test_others_decode_frames_to_the_same_values(run, others, way, is_sent, is_fd):
    frames = [frame for _, is_tx, frame in run.frames if is_tx == is_sent and (len(frame.data) > 8) == is_fd]
    decoded = [decoded for _, decoded in others[f"/{way}_can_bus{'_fd' * is_fd}"]]
    assert [d.id for d in decoded] == [f.can_id for f in frames]
    assert [bytes(d.data)[: d.len if is_fd else d.dlc] for d in decoded] == [f.data for f in frames]
    assert [d.is_error for d in decoded] == [f.is_error for f in frames]
    assert [d.is_extended for d in decoded] == [f.can_id > 0x7FF for f in frames]
    assert is_fd or not any(d.is_rtr for d in decoded)
    assert [d.header.stamp.sec * 10**9 + d.header.stamp.nanosec for d in decoded] == [f.t_ns for f in frames]


def test_publish_time_is_the_cycle_and_log_time_never_runs_backwards(run, others):
    cycle_times = {cycle.t_ns for cycle in run.cycles}
    frame_times = [frame.t_ns for _, is_tx, frame in run.frames if not is_tx]
    assert frame_times != sorted(frame_times)
    for topic, messages in others.items():
        times = [message.log_time for message, _ in messages]
        assert times == sorted(times), topic
        assert {message.publish_time for message, _ in messages} <= cycle_times, topic


def test_the_file_lets_a_viewer_know_seek_and_check_what_it_holds(run, recorded):
    with recorded[0].open("rb") as file:
        header, *records = StreamReader(file, emit_chunks=True, validate_crcs=True).records
    assert isinstance(header, Header)
    assert header.profile == "ros2"
    assert header.library.startswith(f"adacd-hil {__version__}")
    before = records[: next(index for index, record in enumerate(records) if isinstance(record, Chunk))]
    assert [r.name for r in before if isinstance(r, Attachment)] == [*run.attachments]
    assert [r.name for r in before if isinstance(r, Metadata)] == ["run"]
    chunks = [record for record in records if isinstance(record, Chunk)]
    assert len(chunks) > 3
    assert max(chunk.uncompressed_size for chunk in chunks) <= 280 * 1024  # the first one has the definitions, too
    assert {chunk.compression for chunk in chunks} == {"zstd"}
    assert all(chunk.uncompressed_crc for chunk in chunks)
    assert any(isinstance(record, MessageIndex) for record in records)
    assert all(record.data_section_crc for record in records if isinstance(record, DataEnd))
    with recorded[0].open("rb") as file:
        summary = make_reader(file).get_summary()
    assert (summary.statistics.message_count, summary.statistics.attachment_count) == (recorded[1].messages, 2)
    assert len(summary.chunk_indexes) == summary.statistics.chunk_count
    assert {c.message_encoding for c in summary.channels.values()} == {"cdr"}
    assert {c.metadata.get("offered_qos_profiles") for c in summary.channels.values()} == {""}
    assert {s.encoding for s in summary.schemas.values()} == {"ros2msg"}
    topics = {c.topic for c in run_channels(7, tuple(CODEC_FD.messages.values()))}
    assert {c.topic for c in summary.channels.values()} == topics


def test_the_viewer_layout_names_topics_and_fields_that_exist():
    layout = json.loads(viewer_layout())
    types = {channel.topic: channel.type.text for channel in run_channels(7)}
    paths = [path["value"] for panel in layout["configById"].values() for path in panel.get("paths", ())]
    assert len(paths) > 10
    for path in paths:
        topic, field = path.split(".")
        assert f" {field.split('[')[0]} " in types[topic], path


def test_two_runs_in_lockstep_give_the_same_file_and_one_bit_shows_in_its_topic(run, recorded, tmp_path):
    path, messages = recorded[0], CODEC_FD.messages.values()
    record(tmp_path / "again.mcap", run, messages=messages)
    assert (tmp_path / "again.mcap").read_bytes() == path.read_bytes()
    other = make_fd_run()
    other.cycles[350].output.block[3] = np.nextafter(other.cycles[350].output.block[3], np.inf)
    record(tmp_path / "other.mcap", other, messages=messages)
    ours, theirs = (topic_bytes(each, "/scheme") for each in (path, tmp_path / "other.mcap"))
    assert sum(a != b for a, b in zip(ours, theirs, strict=True)) in range(1, 9)
    for topic in ("/control", "/cycle", "/events", "/from_can_bus", "/to_can_bus_fd"):
        assert topic_bytes(path, topic) == topic_bytes(tmp_path / "other.mcap", topic)


def test_in_real_time_the_log_has_wall_time_and_the_reader_gives_back_ours(tmp_path):
    run = make_run(30)
    summary = record(tmp_path / "run.mcap", run, blocking=False, epoch_ns=EPOCH_NS)
    log = read_log(tmp_path / "run.mcap")
    assert summary.is_complete
    assert log.epoch_ns == EPOCH_NS
    assert log.metadata["mode"] == "realtime"
    assert log.scheme.t_ns.tolist() == [cycle.t_ns for cycle in run.cycles]
    assert plain_frames(log.frames) == run.frames
    assert [t_ns for t_ns, _ in log.events] == [cycle.t_ns for cycle in run.cycles if cycle.event]
    times = [message.log_time for message, _ in by_others(tmp_path / "run.mcap")["/scheme"]]
    assert times == [cycle.t_ns + EPOCH_NS for cycle in run.cycles]


def test_a_run_without_a_cycle_is_a_complete_log_and_is_closed_once(tmp_path):
    recorder = start(tmp_path / "run.mcap", make_run(0))
    summary = recorder.close()
    log = read_log(tmp_path / "run.mcap")
    assert recorder.close() is summary
    assert summary[1:] == (0, 0, 0, "", 1, 0)
    assert log.is_complete
    assert log.scheme.block.shape[0] == 0
    assert log.frames.shape == (0,)
    assert log.attachments["run.toml"] == b'name = "x"\n'


@pytest.mark.usefixtures("writer_process")
def test_the_writer_inherits_no_socket_of_ours_and_no_terminal(tmp_path):
    left, right = socket.socketpair()
    with left, right:
        left.set_inheritable(True)
        recorder = start(tmp_path / "run.mcap", make_run(0))
        links = [str(link.readlink()) for link in Path(f"/proc/{recorder.pid}/fd").iterdir()]
        session = os.getsid(recorder.pid)
        recorder.close()
    assert sum(link.startswith("socket:") for link in links) == 1
    assert session == recorder.pid


@pytest.mark.usefixtures("writer_process")
def test_the_writer_of_a_real_time_process_is_scheduled_plainly(tmp_path):
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except PermissionError:
        pytest.skip("real-time scheduling is not permitted")
    try:
        recorder = start(tmp_path / "run.mcap", make_run(0))
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    policy = os.sched_getscheduler(recorder.pid)
    recorder.close()
    assert policy == os.SCHED_OTHER
