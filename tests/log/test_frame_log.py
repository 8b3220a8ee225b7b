"""Recordings of every format, read to the same frames; times to the nanosecond where the format has them."""

import can
import numpy as np
import pytest
from recorded_run import make_run, record

from adacd_hil.log.formats.frame_log import read_frames
from adacd_hil.log.log_files import LogError
from adacd_hil.log.reader import read_log
from adacd_hil.log.types.record_arrays import as_logged

NOON_NS = 1_790_000_000_123_000_000
"""Whole milliseconds, as BLF's start."""

# ruff: noqa: E501 (a table)
CANDUMP = [
    # line, t_ns, channel, can_id, is_tx, is_error, length, data, is_extended, is_remote, is_fd, BRS, ESI
    ("(1436509052.249713) vcan0 044#2A366C2BBA", 1436509052249713000, "vcan0", 0x44, 0, 0, 5, "2a366c2bba", 0, 0, 0, 0, 0),
    ("(0.000000001) can1 7FF#", 1, "can1", 0x7FF, 0, 0, 0, "", 0, 0, 0, 0, 0),
    ("(1.5) can1 18DAF110#11.22 T", 1_500_000_000, "can1", 0x18DAF110, 1, 0, 2, "1122", 1, 0, 0, 0, 0),
    ("(2.000000) can0 00000123#01 R", 2_000_000_000, "can0", 0x123, 0, 0, 1, "01", 1, 0, 0, 0, 0),
    ("(2.000001) can0 123#R", 2_000_001_000, "can0", 0x123, 0, 0, 0, "", 0, 1, 0, 0, 0),
    ("(2.000002) can0 123#R7 T", 2_000_002_000, "can0", 0x123, 1, 0, 7, "", 0, 1, 0, 0, 0),
    ("(2.000003) can0 123##0AA", 2_000_003_000, "can0", 0x123, 0, 0, 1, "aa", 0, 0, 1, 0, 0),
    ("(2.000004) can0 123##1" + "5A" * 64, 2_000_004_000, "can0", 0x123, 0, 0, 64, "5a" * 64, 0, 0, 1, 1, 0),
    ("(2.000005) can0 123##2", 2_000_005_000, "can0", 0x123, 0, 0, 0, "", 0, 0, 1, 0, 1),
    ("(2.000006) can0 20000204#0001000000000A0B", 2_000_006_000, "can0", 0x204, 0, 1, 8, "0001000000000a0b", 0, 0, 0, 0, 0),
    ("(2.000007) can0 123#1122334455667788_E", 2_000_007_000, "can0", 0x123, 0, 0, 8, "1122334455667788", 0, 0, 0, 0, 0),
]  # fmt: skip


def fields(log, number):
    frame = log.frames[number]
    names = ("can_id", "is_tx", "is_error", "length")
    flags = ("is_extended", "is_remote", "is_fd", "has_rate_switch", "has_error_state")
    data = frame["data"][: 0 if frame["is_remote"] else frame["length"]].tobytes().hex()
    assert not frame["data"][len(data) // 2 :].any()
    channel = log.channels[frame["channel"]]
    return int(frame["t_ns"]), channel, *(int(frame[n]) for n in names), data, *(int(frame[n]) for n in flags)


@pytest.fixture(scope="module")
def candump_log(tmp_path_factory):
    path = tmp_path_factory.mktemp("candump") / "bus.log"
    path.write_text("\n".join(row[0] for row in CANDUMP) + "\n\n")
    return read_frames(path)


@pytest.mark.parametrize("number", range(len(CANDUMP)))
def test_a_line_of_candump_is_read_as_it_stands(candump_log, number):
    assert fields(candump_log, number) == CANDUMP[number][1:]


def test_all_lines_of_candump_are_read(candump_log):
    assert len(candump_log.frames) == len(CANDUMP)
    assert candump_log.channels == ("vcan0", "can1", "can0")
    assert candump_log.problem == ""


def test_our_bus_end_has_neither_remote_frames_nor_29_bits_that_read_as_11(candump_log):
    logged = as_logged(candump_log.frames)
    assert [f"{can_id:X}" for can_id in logged["can_id"]] == [
        "44", "7FF", "18DAF110", "123", "123", "123", "204", "123",
    ]  # fmt: skip


def test_a_candump_log_that_is_cut_says_where(tmp_path):
    path = tmp_path / "cut.log"
    path.write_text("(1.000000) can0 123#11\n(1.000001) can0 12")
    log = read_frames(path)
    assert len(log.frames) == 1
    assert log.problem == "cut.log: 1 lines are no frames, the first is line 2: no frame: (1.000001) can0 12"


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("x.log", b"hello\n", "is not a candump log: line 1: no frame: hello"),
        ("x.log", b"(1.0) can0 123#112233445566778899\n", "9 bytes of data"),
        ("x.blf", b"hello", "can't be read as .blf: unpack requires"),
        ("x.mcap", b"hello", "is not an MCAP file"),
        ("x.pcap", b"", "did you mean .mcap; known: .mcap .log"),
        ("x", b"", "a file without suffix"),
        ("missing.asc", None, "can't be read: No such file"),
        ("missing.log", None, "can't be read: No such file"),
        ("missing.mcap", None, "can't be read: No such file"),
    ],
)
def test_what_is_no_recording_is_refused_in_one_line(tmp_path, name, content, said):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(LogError) as error:
        read_frames(path)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def write(path, times_ns):
    """Write a frame each with python-can."""
    with can.Logger(path) as writer:
        for number, t_ns in enumerate(times_ns):
            writer(
                can.Message((t_ns - times_ns[0]) * 1e-9, 0x100 + number, is_extended_id=False, data=[number], channel=1)
            )


def test_blf_keeps_nanoseconds_at_todays_date(tmp_path):
    path = tmp_path / "x.blf"
    rests_ns = [1, 999_999_999, 86_400_000_000_007]
    writer = can.BLFWriter(path)
    writer.start_timestamp = 0.0
    for rest_ns in rests_ns:
        writer.on_message_received(can.Message(rest_ns * 1e-9 + 0.25e-9, 0x123, channel=1))
    writer.start_timestamp = writer.stop_timestamp = NOON_NS / 1e9
    writer.stop()
    assert read_frames(path).frames["t_ns"].tolist() == [NOON_NS + rest_ns for rest_ns in rests_ns]


@pytest.mark.parametrize("suffix", [".asc", ".csv", ".trc", ".blf"])
def test_python_cans_formats_are_read(tmp_path, suffix):
    path = tmp_path / f"x{suffix}"
    times_ns = [0, 1_500_000, 60_000_001_000]
    write(path, times_ns)
    frames = read_frames(path).frames
    errors_ns = frames["t_ns"] - frames["t_ns"][0] - times_ns
    assert np.abs(errors_ns).max() < 500
    assert frames["can_id"].tolist() == [0x100, 0x101, 0x102]
    assert frames["data"][:, 0].tolist() == [0, 1, 2]


@pytest.mark.slow
def test_a_log_of_ours_gives_the_frames_that_its_reader_gives(tmp_path):
    path = tmp_path / "run.mcap"
    run = make_run(60, has_fd=True)
    run.metadata["channel"] = "vcan7"
    record(path, run, epoch_ns=NOON_NS)
    log, own = read_frames(path), read_log(path)
    assert log.channels == ("vcan7",)
    assert np.array_equal(as_logged(log.frames), own.frames)
    assert (log.frames["is_fd"] == (log.frames["length"] > 8)).all()
    assert log.epoch_ns == NOON_NS
