"""Recordings of strangers whose numbers lie: each is read to an end, and what is wrong is one line."""

import can
import numpy as np
import pytest
from made_log import BLF_FRAME, blf_object, make_log, write_blf

from adacd_hil.lab.logs.check.log_check import check_log
from adacd_hil.lab.logs.log_info import read_info
from adacd_hil.lab.logs.python_can_files import to_messages
from adacd_hil.lab.logs.signal_tables import Tables, export_tables
from adacd_hil.log.frames.frame_log import read_frames
from adacd_hil.log.log_files import LogError, find_parts
from adacd_hil.log.log_parts import summary_count
from adacd_hil.log.mcap.chunks import MOST_BYTES
from adacd_hil.log.reader import read_log
from adacd_hil.log.types.message_types import TIME_TEXT, payload_dtype
from adacd_hil.wire.dbc_decoder import load_decoder


def item(version, size):
    return blf_object(BLF_FRAME, bytes(16), version, size=size)


LIES = {
    "an object of no size and unknown version": (item(512, 0), {}, "an object of 0 bytes"),
    "an object of no size": (item(1, 0), {}, "an object of 0 bytes"),
    "an object shorter than its head": (item(1, 15), {}, "an object of 15 bytes"),
    "an object of 4 GB": (item(1, 2**32 - 1), {}, "cut within an object"),
    "a container of no size": (item(1, 48), {"size": 0}, "read length must be non-negative"),
    "a bomb": (bytes(MOST_BYTES + 1), {}, f"opens to {MOST_BYTES + 1} bytes"),
    "a compression that nobody knows": (b"", {"method": 9}, r"compression method \(9\)"),
}


@pytest.mark.parametrize(("inner", "options", "line"), LIES.values(), ids=LIES)
def test_a_blf_whose_sizes_lie_is_refused_at_once(inner, options, line, tmp_path):
    with pytest.raises(LogError, match=line) as error:
        read_frames(write_blf(tmp_path / "x.blf", inner, **options))
    assert "\n" not in str(error.value)


def candump_line(time="1700000000.000000", channel="can0"):
    return f"({time}) {channel} 181#1122334455667788\n"


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (candump_line(time="9" * 20 + ".0"), "is beyond the year 2116"),
        (candump_line(time="9" * 5000 + ".0"), "is beyond the year 2116"),
        (candump_line(time="nan"), "time nan s"),
        ("x" * 200_000 + "\n", "no frame"),
    ],
)
def test_a_line_that_no_recorder_writes_is_counted_and_the_rest_read(line, reason, tmp_path):
    path = tmp_path / "x.log"
    path.write_text(candump_line() + line + candump_line())
    log = read_frames(path)
    assert len(log.frames) == 2
    assert reason in log.problem
    assert len(log.problem) < 200


def test_a_recording_has_256_channels_at_most(tmp_path):
    path = tmp_path / "x.log"
    path.write_text("".join(candump_line(channel=f"can{number}") for number in range(300)))
    log = read_frames(path)
    assert len(log.channels) == len(log.frames) == 256
    assert log.problem == "x.log: there are more than 256 channels, and 43 more records"


def test_a_time_beyond_64_bits_is_left_out_and_named(tmp_path):
    path = tmp_path / "x.csv"
    message = can.Message(timestamp=1.0, arbitration_id=0x181, data=b"1", is_extended_id=False)
    with can.CSVWriter(path) as writer:
        writer(message)
        message.timestamp = 1e12
        writer(message)
        message.timestamp = 2.0
        writer(message)
    log = read_frames(path)
    assert log.frames["t_ns"].tolist() == [1_000_000_000, 2_000_000_000]
    assert log.problem == "x.csv: time 1e+12 s is beyond the year 2116"


def test_a_channel_that_is_a_number_of_5000_digits_is_a_name(tmp_path):
    frames = np.zeros(1, read_frames(write_blf(tmp_path / "x.blf", b"")).frames.dtype)
    (message,) = to_messages(frames, ["9" * 5000])
    assert message.channel == "9" * 5000


FIELDS = {
    "twice": ("uint8 a\nuint8 a\n", "a schema makes no layout"),
    "huge": ("float64[999999999] a\n", "a schema describes 8000000000 bytes"),
    "long": ("float64[99999999999999] a\n", "a schema has a field that isn't a number"),
    "many": ("".join(f"float64[99999] a{number}\n" for number in range(10)), "a schema describes"),
}


@pytest.mark.parametrize(("fields", "reason"), FIELDS.values(), ids=FIELDS)
def test_a_schema_that_makes_no_payload_is_one_line_and_its_messages_are_kept_apart(fields, reason, tmp_path):
    text = "builtin_interfaces/Time stamp\n" + fields + TIME_TEXT
    with pytest.raises(LogError, match=reason):
        payload_dtype(text)
    path = tmp_path / "run.mcap"
    path.write_bytes(make_log(text="# Written by adacd-hil.\n" + text, run=None))
    assert read_info(path).messages == 20
    assert check_log(path).messages == 20
    problem = read_log(path).problem
    assert problem in ("", "a message is not as long as its schema says")  # by the names of fields in the channel
    if problem:
        assert export_tables(path, tmp_path / "tables", "csv", (), load_decoder()).problem == problem
    else:
        with pytest.raises(LogError, match="messages of varying size are not exported: /a, /b"):
            export_tables(path, tmp_path / "tables", "csv", (), load_decoder())


def test_topics_of_strangers_become_files_of_their_own_in_the_folder(tmp_path):
    columns = {"t_ns": np.arange(2)}
    topics = ("/a/b", "/a_b", "/a\0b", "/../../x", "/", "/" + "é" * 300, "/\x1b]0;owned\x07")
    with Tables(tmp_path / "tables", "csv", {}) as tables:
        for topic in (*topics, *topics):
            tables.add_rows(topic, columns)
    written = sorted(path.name for path in (tmp_path / "tables").iterdir())
    assert len(written) == len(topics)
    assert set(tables.rows.values()) == {4}
    assert {"a_b.csv", "a_b_2.csv", "a_b_3.csv", ".._.._x.csv", "_.csv"} <= set(written)
    assert all(name.isprintable() for name in written)


def test_a_part_with_a_number_that_no_run_reaches_is_none(tmp_path):
    for name in ("run.mcap", "run_001.mcap", "run_9999999999.mcap"):
        (tmp_path / name).write_bytes(make_log())
    assert list(find_parts(tmp_path / "run.mcap")) == [0, 1]


@pytest.mark.parametrize(
    ("text", "count"), [(str(2**63 - 1), 2**63 - 1), (str(2**63), 0), ("9" * 5000, 0), ("-1", 0), ("", 0)]
)
def test_a_count_of_a_damaged_summary_is_0(text: str, count: int) -> None:
    assert summary_count({"frames": text}, "frames") == count
