"""Recordings of every format, read to the same frames; times to the nanosecond where the format has them."""

import struct

import can
import numpy as np
import pytest
from made_log import BLF_ERROR, BLF_MARKER, blf_frame, blf_object, write_blf
from recorded_run import make_run, record

from adacd_hil.log.frames.frame_log import read_frames
from adacd_hil.log.log_files import LogError
from adacd_hil.log.reader import read_log
from adacd_hil.log.types.record_arrays import receivable_frames

NOON_NS = 1_790_000_000_123_000_000
"""Whole milliseconds, as BLF's start."""

# ruff: noqa: E501 (a table)
CANDUMP = [
    # line, t_ns, channel, can_id, is_tx, is_error, length, data, is_extended, is_remote, is_fd, BRS, ESI
    ("(1436509052.249713) vcan0 044#2A366C2BBA", 1436509052249713000, "vcan0", 0x44, 0, 0, 5, "2a366c2bba", 0, 0, 0, 0, 0),
    ("(0.000000001) can1 7FF#", 1, "can1", 0x7FF, 0, 0, 0, "", 0, 0, 0, 0, 0),
    ("(1.5) can1 18DAF110#1122 T", 1_500_000_000, "can1", 0x18DAF110, 1, 0, 2, "1122", 1, 0, 0, 0, 0),
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


def test_lines_of_candump_are_read_as_they_stand(candump_log):
    assert [fields(candump_log, number) for number in range(len(candump_log.frames))] == [row[1:] for row in CANDUMP]
    assert candump_log.channels == ("vcan0", "can1", "can0")
    assert candump_log.problem == ""


def test_our_bus_end_has_neither_remote_frames_nor_29_bits_that_read_as_11(candump_log):
    logged = receivable_frames(candump_log.frames)
    assert [f"{can_id:X}" for can_id in logged["can_id"]] == [
        "44", "7FF", "18DAF110", "123", "123", "123", "204", "123",
    ]  # fmt: skip


@pytest.mark.parametrize("line", ["(1.000001) can0 12", "(1.000001) can0 123#112"])
def test_a_candump_log_that_is_cut_says_where(line, tmp_path):
    path = tmp_path / "cut.log"
    path.write_text(f"(1.000000) can0 123#11\n{line}")
    log = read_frames(path)
    assert (len(log.frames), log.problem) == (1, f"cut.log: line 2 is no frame: {line}")


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        (
            "x.log",
            b"hello\n",
            "is not a candump log, as `candump -l` records it and SavvyCAN saves it: line 1 is no frame: hello",
        ),
        ("x.log", b"(1.0) can0 123#112233445566778899\n", "9 bytes of data"),
        ("x.log", b"  can0  181   [8]  00 01 02 03 04 05 06 07\n", "`candump -l`"),
        ("x.csv", b"Time Stamp,ID,Extended,Dir,Bus,LEN,D1\n1000,181,false,Rx,0,1,00,\n", "saves a candump log"),
        ("x.log.gz", b"", "unpack it with gunzip; known: .mcap .log"),
        ("x.blf", b"hello", "is not a whole .blf: unpack requires"),
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
    assert np.array_equal(receivable_frames(log.frames), own.frames)
    assert (log.frames["is_fd"] == (log.frames["length"] > 8)).all()
    assert log.epoch_ns == NOON_NS


def error_frame(dlc):
    return blf_object(BLF_ERROR, struct.pack("<HHLBBBxLLH2x8s", 1, 0, 0, 0, 0, dlc, 0, 0x4, 0, b"12345678"))


def test_an_error_frame_whose_length_code_no_frame_has_ends_nothing(tmp_path):
    frames = [blf_frame(number) for number in range(5)]
    log = read_frames(write_blf(tmp_path / "x.blf", b"".join([*frames[:2], error_frame(15), *frames[2:]])))
    assert log.frames["data"][~log.frames["is_error"], 0].tolist() == [0, 1, 2, 3, 4]
    assert log.frames["length"].tolist() == [8] * 6
    assert log.problem == ""


def test_an_object_of_a_version_to_come_is_counted_only_where_it_is_a_frame(tmp_path):
    frames, marker = [blf_frame(number) for number in range(4)], blf_object(BLF_MARKER, bytes(40), version=3)
    log = read_frames(write_blf(tmp_path / "x.blf", b"".join([*frames[:2], marker, *frames[2:]])))
    assert (len(log.frames), log.problem) == (4, "")
    frames[1] = frames[1].replace(b"\x20\0\x01\0", b"\x20\0\x03\0", 1)
    log = read_frames(write_blf(tmp_path / "x.blf", b"".join([*frames[:2], marker, *frames[2:]])))
    assert log.frames["data"][:, 0].tolist() == [0, 2, 3]
    assert log.problem == "x.blf: a frame of header version 3 is not read"


def test_a_blf_that_is_cut_says_so(tmp_path):
    log = read_frames(write_blf(tmp_path / "x.blf", b"".join(map(blf_frame, range(500))), cut=100))
    assert 0 < len(log.frames) < 500
    assert log.problem == f"x.blf: cut within an object, behind {len(log.frames)} frames"


HEADS = {
    "vector": "date Mon Mar 2 10:00:00.000 2026\nbase hex  timestamps {}\ninternal events logged\n",
    "without a line on events": "date Mon Mar 2 10:00:00.000 2026\nbase hex  timestamps {}\n// version 8.2\n",
    "with an empty line": "\nbase hex  timestamps {}\nno internal events logged\n",
}


@pytest.mark.parametrize("head", HEADS.values(), ids=HEADS)
@pytest.mark.parametrize("kind", ["absolute", "relative"])
def test_no_head_of_an_asc_costs_a_frame_and_stamps_count_from_the_beginning(head, kind, tmp_path):
    path = tmp_path / "x.asc"
    stamps = ["0.250000", "0.250100", "0.250150", "1.250150"]
    if kind == "relative":
        stamps = ["0.250000", "0.000100", "0.000050", "1.000000"]
    lines = [
        f"{stamps[0]} 1  181  Rx   d 2 00 01",
        f"{stamps[1]} CAN 1 Status:chip status error active",
        f"{stamps[2]} 1  18DAF110x  Tx   d 2 10 11",
        f"{stamps[3]} 1  7FF  Rx   d 1 FF",
    ]
    path.write_text(head.format(kind) + "".join(f"   {line}\n" for line in lines))
    log = read_frames(path)
    assert log.frames["can_id"].tolist() == [0x181, 0x18DAF110, 0x7FF]
    assert log.frames["t_ns"].tolist() == [250_000_000, 250_150_000, 1_250_150_000]
    assert log.problem == ""


def test_the_base_of_an_asc_counts_behind_an_empty_line(tmp_path):
    path = tmp_path / "x.asc"
    path.write_text("\nbase dec  timestamps absolute\n 0.1 1  385  Rx  d 2 16 255\n")
    log = read_frames(path)
    assert (hex(log.frames["can_id"][0]), log.frames["data"][0, :2].tolist()) == ("0x181", [16, 255])


def test_an_asc_whose_frames_python_can_passes_over_says_so(tmp_path):
    path = tmp_path / "x.asc"
    lines = ["-0.5 1 181 Rx d 1 00", "0,1 1 181 Rx d 1 01", "0.2 1 181 TxRq d 1 02", "0.2 1 181 Tx d 1 03"]
    path.write_text("base hex  timestamps absolute\n" + "\n".join(lines) + "\n")
    log = read_frames(path)
    assert log.frames["data"][:, 0].tolist() == [3]
    assert log.problem == "x.asc: line 2 is not read: -0.5 1 181 Rx d 1 00, and 1 more records"


def test_a_line_of_a_trc_that_tells_the_state_of_the_bus_is_no_frame(tmp_path):
    path = tmp_path / "x.trc"
    rows = [f"{n:6})   {n}.0  Rx     0181  2  00 {n:02X}" for n in range(1, 6)]
    rows.insert(2, "     9)   2.5  Rx     FFFFFFFF  4  00 00 00 08  BUSHEAVY")
    path.write_text(";$FILEVERSION=1.1\n;$STARTTIME=45000.0\n;\n" + "\n".join(rows) + "\n")
    log = read_frames(path)
    assert (log.frames["data"][:, 1].tolist(), log.problem) == ([1, 2, 3, 4, 5], "")


def test_an_error_frame_of_a_trc_and_data_shorter_than_their_dlc_are_counted(tmp_path):
    rows = "1 1.0 DT 181 Rx 1 07\n2 2.0 ER - Rx 5 04 00 02 00 00\n3 3.0 ST - Rx 4 00 00 00 04\n"
    (tmp_path / "x.trc").write_text(f";$FILEVERSION=2.1\n;$STARTTIME=45000.0\n;$COLUMNS=N,O,T,I,d,L,D\n{rows}")
    head = "timestamp,arbitration_id,extended,remote,error,dlc,data\n"
    (tmp_path / "x.csv").write_text(f"{head}1.0,0x181,0,0,0,1,Bw==\n2.0,0x181,0,0,0,2,!!!\n")
    fd = "CANFD 1 Rx 181 1 0 f 64 07"
    (tmp_path / "x.asc").write_text(f"base hex timestamps absolute\n1.0 {fd}{' 00' * 63}\n2.0 {fd}{' 00' * 19}\n")
    for name, cause in (("x.trc", "'ER'"), ("x.csv", " 0 bytes of data"), ("x.asc", " 20 bytes of data")):
        log = read_frames(tmp_path / name)
        assert log.frames["data"][:, 0].tolist() == [7]
        assert cause in log.problem
        assert "more records" not in log.problem


def test_a_cut_line_of_a_trc_is_counted(tmp_path, capfd):
    path = tmp_path / "x.trc"
    path.write_text(
        ";$FILEVERSION=1.1\n;$STARTTIME=45000.0\n     1)   1.0  Rx     0181  2  00 01\n     2)   2.0  Rx  01"
    )
    log = read_frames(path)
    assert len(log.frames) == 1
    assert "2.0 Rx 01" in log.problem
    assert capfd.readouterr() == ("", "")


def test_an_asc_without_a_frame_says_so(tmp_path):
    (tmp_path / "x.asc").touch()
    assert read_frames(tmp_path / "x.asc").problem == "x.asc: there is no frame in it"
