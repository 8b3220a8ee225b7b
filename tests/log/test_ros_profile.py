"""Our logs in the hands of a ROS 2 user: rosbags opens them and reads what mcap's own decoder reads."""

import collections
import dataclasses

import numpy as np
import pytest
from made_log import kinds, make_log, take_apart
from mcap.opcode import Opcode
from mcap.records import Header
from recorded_run import by_others, fd_codec, make_run, record
from rosbags.highlevel import AnyReader

from adacd_hil.lab.logs.cut import TimeWindow, cut
from adacd_hil.lab.logs.frame_writer import FrameWriter
from adacd_hil.lab.logs.recover import recover
from adacd_hil.log.frames.mcap_frames import RecordedFrame
from adacd_hil.log.mcap.chunked_file import LIBRARY

CYCLES = 120


def header_of(path):
    return kinds(take_apart(path.read_bytes()), Opcode.HEADER)[0].read(Header)


def plain(value):
    """Make a message of either library a comparable tree; of rosbags' names of types nothing stays."""
    if hasattr(value, "__slots__"):
        return {name: plain(getattr(value, name)) for name in value.__slots__}
    if dataclasses.is_dataclass(value):
        return {
            row.name: plain(getattr(value, row.name))
            for row in dataclasses.fields(value)
            if not (row.name.startswith("__") or row.name.isupper())  # the type, and its constants
        }
    if isinstance(value, (np.ndarray, bytes, list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (float, np.floating)):
        return repr(float(value))  # NaN is NaN
    return int(value) if isinstance(value, (int, np.integer)) else value


def by_rosbags(path):
    messages = collections.defaultdict(list)
    with AnyReader([path]) as reader:
        assert all(c.msgtype and c.msgdef.data for c in reader.connections)
        for connection, log_time, data in reader.messages():
            messages[connection.topic].append((log_time, plain(reader.deserialize(data, connection.msgtype))))
        counts = {connection.topic: connection.msgcount for connection in reader.connections if connection.msgcount}
    assert counts == {topic: len(rows) for topic, rows in messages.items()}
    return messages


def by_mcap(path):
    return {
        topic: [(message.log_time, plain(decoded)) for message, decoded in rows]
        for topic, rows in by_others(path).items()
    }


@pytest.mark.slow
def test_rosbags_reads_every_message_of_every_topic(tmp_path):
    log_path = tmp_path / "run.mcap"
    record(log_path, make_run(CYCLES, has_fd=True), messages=fd_codec().messages.values())
    theirs = by_rosbags(log_path)
    assert {"/scheme", "/joint_states", "/from_can_bus_fd", "/to_can_bus", "/events", "/contact"} <= set(theirs)
    assert len(theirs["/scheme"]) == CYCLES
    assert theirs == by_mcap(log_path)


def test_a_copy_keeps_the_profile_and_only_one_of_our_own_log_claims_it(tmp_path):
    """Also of one from before the profile."""
    for library, given, profile in (("somebody", "", ""), (LIBRARY, "", "ros2"), ("somebody", "ros2", "ros2")):
        (tmp_path / "run.mcap").write_bytes(make_log(library=library, profile=given))
        cut(tmp_path / "run.mcap", tmp_path / "cut.mcap", TimeWindow(0.0, 1.0))
        recover(tmp_path / "run.mcap", tmp_path / "recovered.mcap")
        assert [header_of(tmp_path / f"{name}.mcap").profile for name in ("cut", "recovered")] == [profile] * 2


def test_frames_that_python_can_records_open_in_rosbags(tmp_path):
    path = tmp_path / "frames.mcap"
    with path.open("wb") as file:
        writer = FrameWriter(file)
        writer.write_frame(RecordedFrame(1_000_000, 0x123, b"\x01\x02", 2, channel="can0"))
        writer.write_frame(RecordedFrame(2_000_000, 0x124, bytes(12), 12, channel="can0", is_fd=True))
        writer.finish()
    read = by_rosbags(path)
    assert read == by_mcap(path)
    assert [row["id"] for _, row in read["/from_can_bus"]] == [0x123]
