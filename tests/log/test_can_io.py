"""The plugin of python-can: its tools read and write our logs, and nothing of a frame is lost."""

import gzip
import importlib.metadata
import itertools
import struct
import sys
import tomllib
from decimal import Decimal
from pathlib import Path

import can
import can.logconvert
import pytest
from made_log import flipped
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory

from adacd_hil.lab.logs.python_can_files import McapReader, McapWriter, TimedMessage
from adacd_hil.log.frames.frame_log import read_frames
from adacd_hil.log.reader import read_log
from adacd_hil.log.types.message_types import CAN_FRAME, ENCAPSULATION, FD_FRAME

NOON_NS = 1_790_000_000_123_456_789


def all_kinds(channels=(0, 1)):
    """Make a message of every kind there is, with times that a float can't hold."""
    kinds = []
    for is_rx, channel, (can_id, is_extended) in itertools.product(
        (True, False), channels, ((0, False), (0x7FF, False), (0x7FF, True), (0x1FFFFFFF, True))
    ):
        common = {"is_rx": is_rx, "channel": channel, "arbitration_id": can_id, "is_extended_id": is_extended}
        kinds += [dict(common, data=bytes(range(1, size + 1))) for size in (0, 3, 8)]
        kinds += [dict(common, is_remote_frame=True, dlc=dlc) for dlc in (0, 5, 8)]
        kinds += [
            dict(common, is_fd=True, bitrate_switch=brs, error_state_indicator=esi, data=bytes(range(size)))
            for brs, esi, size in itertools.product((True, False), (True, False), (0, 8, 12, 64))
        ]
    for channel, can_id in itertools.product(channels, (0x004, 0x204)):
        kinds.append(
            {"channel": channel, "is_error_frame": True, "arbitration_id": can_id, "data": bytes(range(8, 16))}
        )
        kinds[-1]["is_extended_id"] = False
    kinds.append({"channel": channels[0], "is_error_frame": True, "arbitration_id": 0x80, "dlc": 0})
    return [TimedMessage(NOON_NS + 1_000_003 * number, **kind) for number, kind in enumerate(kinds)]


def content(message):
    """List everything that a message is, but for its time."""
    return (
        message.arbitration_id,
        message.is_extended_id,
        message.is_remote_frame,
        message.is_error_frame,
        message.channel,
        message.dlc,
        bytes(message.data),
        message.is_fd,
        message.is_rx,
        message.bitrate_switch,
        message.error_state_indicator,
    )


def write(path, messages):
    with McapWriter(path) as writer:
        for message in messages:
            writer(message)


@pytest.fixture(scope="module")
def messages():
    return all_kinds()


@pytest.fixture(scope="module")
def path(messages, tmp_path_factory):
    path = tmp_path_factory.mktemp("can_io") / "bus.mcap"
    write(path, messages)
    return path


@pytest.fixture
def tools(monkeypatch, tmp_path):
    """Let python-can find the plugin as it would after an installation."""
    points = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]["entry-points"]
    lines = [f"[{group}]\n{name} = {value}\n" for group, table in points.items() for name, value in table.items()]
    folder = tmp_path / "installed" / "plugin-1.dist-info"
    folder.mkdir(parents=True)
    (folder / "entry_points.txt").write_text("\n".join(lines))
    (folder / "METADATA").write_text("Name: plugin\nVersion: 1\n")
    monkeypatch.syspath_prepend(str(folder.parent))
    for table in (can.io.player.MESSAGE_READERS, can.io.logger.MESSAGE_WRITERS):
        monkeypatch.delitem(table, ".mcap", raising=False)

    def convert(source, target):
        monkeypatch.setattr(sys, "argv", ["can_logconvert", str(source), str(target)])
        can.logconvert.main()
        return target

    yield convert
    for table in (can.io.player.MESSAGE_READERS, can.io.logger.MESSAGE_WRITERS):
        table.pop(".mcap", None)
    assert importlib.metadata.entry_points(group="can.io.message_reader")


def test_pythons_float_is_the_one_nearest_to_the_time(path):
    errors_s = [Decimal(message.timestamp) - Decimal(message.t_ns) / 10**9 for message in McapReader(path)]
    assert max(map(abs, errors_s)) < Decimal("120e-9")


def test_a_time_that_somebody_changed_counts(tmp_path):
    message = TimedMessage(NOON_NS, arbitration_id=1, data=b"")
    message.timestamp = 12.5
    write(tmp_path / "x.mcap", [message, can.Message(timestamp=1790000000.1234567)])
    assert read_frames(tmp_path / "x.mcap").frames["t_ns"].tolist() == [12_500_000_000, 1_790_000_000_123_456_700]


def test_logconvert_to_blf_and_back_keeps_all_but_the_direction_of_error_frames(messages, path, tools, tmp_path):
    copy = list(McapReader(tools(path, tmp_path / "copy.mcap")))
    assert [message.t_ns for message in copy] == [message.t_ns for message in messages]
    back = tools(tools(path, tmp_path / "bus.blf"), tmp_path / "back.mcap")
    read = list(McapReader(back))
    assert [content(message) for message in read] == [content(message) for message in messages]
    errors_ns = [one.t_ns - other.t_ns for one, other in zip(read, messages, strict=True)]
    assert max(map(abs, errors_ns)) <= 240


def test_logconvert_of_a_cut_log_says_what_is_missing(path, tools, tmp_path, caplog):
    (tmp_path / "cut.mcap").write_bytes(path.read_bytes()[:-100])
    tools(tmp_path / "cut.mcap", tmp_path / "cut.blf")
    (said,) = [record for record in caplog.records if record.name.startswith("adacd_hil.")]
    assert (said.levelname, "cut" in said.getMessage()) == ("WARNING", True)


def test_others_decode_the_frames(messages, path):
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        decoded = [(channel, frame) for _, channel, _, frame in reader.iter_decoded_messages(log_time_order=False)]
    assert len(decoded) == len(messages)
    for (channel, frame), message in zip(decoded, messages, strict=True):
        prefix = "/can1" if message.channel == 1 else ""
        way = "from" if message.is_rx else "to"
        assert channel.topic == f"{prefix}/{way}_can_bus{'_fd' if message.is_fd else ''}"
        assert (frame.id, frame.is_extended, frame.is_error) == (*content(message)[:2], message.is_error_frame)
        if message.is_fd:
            assert bytes(frame.data) == message.data
        else:
            assert (frame.is_rtr, frame.dlc) == (message.is_remote_frame, message.dlc)
        assert frame.header.stamp.sec * 10**9 + frame.header.stamp.nanosec == message.t_ns


def test_our_reader_has_the_first_channels_frames(messages, path):
    log = read_log(path)
    assert log.is_complete
    assert (log.summary["frames"], log.summary["messages"]) == (str(len(log.frames)), str(len(messages)))
    assert log.frames["t_ns"].tolist() == [message.t_ns for message in messages if message.channel == 0]


def test_names_of_channels_are_kept(tmp_path):
    names = ["vcan0", "/dev/ttyUSB0", 3, None]
    write(tmp_path / "x.mcap", [can.Message(timestamp=1.0, channel=name) for name in names])
    assert [message.channel for message in McapReader(tmp_path / "x.mcap")] == names
    assert read_frames(tmp_path / "x.mcap").channels == ("vcan0", "/dev/ttyUSB0", "3", "")


def test_a_flipped_bit_outside_the_chunks_is_said(path, tmp_path):
    with path.open("rb") as file:
        chunk = make_reader(file).get_summary().chunk_indexes[0]
    place = chunk.chunk_start_offset + chunk.chunk_length + 20  # in its message index
    (tmp_path / "x.mcap").write_bytes(flipped(path.read_bytes(), place))
    assert read_frames(tmp_path / "x.mcap").problem == "x.mcap: the data section fails its CRC"
    assert read_frames(path).problem == ""


@pytest.mark.parametrize(("content", "cause"), [(b"", "empty"), (b"notes", "not an MCAP file")])
def test_a_further_part_that_is_no_mcap_costs_only_itself(content, cause, messages, path, tmp_path):
    (tmp_path / "x.mcap").write_bytes(path.read_bytes())
    (tmp_path / "x_001.mcap").write_bytes(content)
    log = read_frames(tmp_path / "x.mcap")
    assert (len(log.frames), log.problem) == (len(messages), f"x_001.mcap is {cause}")


def test_log_times_never_run_backwards_within_a_topic(tmp_path):
    times_ns = [5_000, 3_000, 4_000, 9_000]
    write(tmp_path / "x.mcap", [TimedMessage(t_ns) for t_ns in times_ns])
    with (tmp_path / "x.mcap").open("rb") as file:
        messages = [message for _, _, message in make_reader(file).iter_messages(log_time_order=False)]
    assert [message.log_time for message in messages] == [5_000, 5_000, 5_000, 9_000]
    assert [message.t_ns for message in McapReader(tmp_path / "x.mcap")] == times_ns


@pytest.mark.parametrize("frame_id", ["", "a", "abc", "can_bus0"])
def test_frames_of_others_are_read_whatever_their_frame_id_is(tmp_path, frame_id):
    text = frame_id.encode() + b"\0"
    head = struct.pack("<4s2II", ENCAPSULATION, 7, 8, len(text)) + text
    head += bytes(-len(head) % 4)
    bodies = {
        CAN_FRAME: struct.pack("<I???B8s", 0x123, True, False, False, 5, b"notdata!"),
        FD_FRAME: struct.pack("<I??BxI12s", 0x124, True, False, 12, 12, bytes(range(12))),
    }
    with (tmp_path / "x.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        for kind, body in bodies.items():
            schema = writer.register_schema(kind.name, "ros2msg", kind.text.encode())
            channel = writer.register_channel("/arm/from_can_bus", "cdr", schema)
            writer.add_message(channel, 9, head + body, 10)
        writer.finish()
    remote, long = McapReader(tmp_path / "x.mcap")
    assert content(remote) == (0x123, False, True, False, None, 5, b"", False, True, False, False)
    assert content(long) == (0x124, True, False, False, None, 12, bytes(range(12)), True, True, True, False)
    assert (remote.t_ns, long.t_ns) == (7_000_000_008, 7_000_000_008)
    frames = read_frames(tmp_path / "x.mcap").frames
    assert (frames["cycle_t_ns"].tolist(), frames["data"][0].any()) == ([10, 10], False)


def test_a_gzipped_log_is_read(messages, path, tmp_path):
    zipped = tmp_path / "bus.mcap.gz"
    zipped.write_bytes(gzip.compress(path.read_bytes()))
    with gzip.open(zipped) as file:
        assert len(list(McapReader(file))) == len(messages)


def test_nothing_is_appended(tmp_path):
    with pytest.raises(ValueError, match="appended"):
        McapWriter(tmp_path / "x.mcap", append=True)
    assert not (tmp_path / "x.mcap").exists()


def test_a_time_before_1970_is_refused(tmp_path):
    writer = McapWriter(tmp_path / "x.mcap")
    with pytest.raises(ValueError, match="t_ns = -1000000000"):
        writer(can.Message(timestamp=-1.0))
    writer.stop()
    writer.stop()
