"""Recordings in other programs' formats: the same frames and values, and what is lost is counted."""

import csv
import json
import re
import shutil
import subprocess
import sys

import numpy as np
import pyarrow.parquet
import pytest
from click.testing import CliRunner
from recorded_run import CODEC, make_run, record
from test_can_io import all_kinds, content, write

from adacd_hil.lab.cli.log_command import export
from adacd_hil.lab.logs.frame_export import FrameChoice, export_frames, sides
from adacd_hil.lab.logs.signal_tables import choose_topics, export_tables
from adacd_hil.log.frames.can_io import TimedMessage, to_messages
from adacd_hil.log.frames.frame_log import open_frames, read_frames
from adacd_hil.log.log_files import LogError
from adacd_hil.log.mcap.chunked_file import MAGIC
from adacd_hil.log.reader import read_log
from adacd_hil.wire.dbc_decoder import load_decoder

MILLISECOND_NS = 1_000_000


@pytest.fixture(scope="module")
def messages():
    return all_kinds(channels=(0,))


@pytest.fixture(scope="module")
def bus(messages, tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "bus.mcap"
    write(path, messages)
    return path


@pytest.fixture(scope="module")
def run():
    run = make_run(60, start_ns=5_000_000_000)
    run.metadata["channel"] = "can3"
    return run


@pytest.fixture(scope="module")
def log(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "run.mcap"
    record(path, run, epoch_ns=1_790_000_000_123_456_789)
    return path


def rewrite(source, target, kind, **options):
    frames = open_frames(source)
    return export_frames(frames, FrameChoice().pieces(frames), target, kind, **options)


def read_messages(path):
    log = read_frames(path)
    return list(to_messages(log.frames, list(log.channels), log.epoch_ns))


def test_blf_holds_every_frame_to_the_nanosecond(messages, bus, tmp_path):
    summary = rewrite(bus, tmp_path / "x.blf", "blf")
    read = read_messages(tmp_path / "x.blf")
    assert [content(message) for message in read] == [content(message) for message in messages]
    assert [message.t_ns for message in read] == [message.t_ns for message in messages]
    assert summary == (len(messages), ())


def test_candump_holds_every_frame_to_the_microsecond(messages, bus, tmp_path):
    summary = rewrite(bus, tmp_path / "x.log", "candump", has_direction=True)
    read = read_messages(tmp_path / "x.log")
    lost = [message for message in read if message.is_error_frame]
    assert [content(message)[2:] for message in read] == [
        (*content(message)[2:4], "can0", *content(message)[5:]) for message in messages
    ]
    assert [message.t_ns for message in read] == [message.t_ns // 1000 * 1000 for message in messages]
    assert summary.losses == (f"{len(messages)} frames lose what their times have below 1 µs",)
    assert len(lost) == 3


# What can-utils' canplayer and Wireshark's wiretap/candump_scanner.l take for a line; nothing may follow.
CANDUMP_LINE = re.compile(
    r"\(\d+\.\d{6}\) \S+ ([0-9A-F]{3}|[0-9A-F]{8})#(R[0-8]?|([0-9A-F]{2}){0,8}|#[0-9A-F]([0-9A-F]{2}){0,64})"
)


def test_candump_says_nothing_of_direction_unless_it_is_asked_to(bus, tmp_path):
    summary = rewrite(bus, tmp_path / "x.log", "candump")
    lines = (tmp_path / "x.log").read_text().splitlines()
    assert [line for line in lines if not CANDUMP_LINE.fullmatch(line)] == []
    rewrite(bus, tmp_path / "y.log", "candump", has_direction=True)
    marked = (tmp_path / "y.log").read_text().splitlines()
    assert [line[:-2] for line in marked] == lines
    sent = sum(line.endswith(" T") for line in marked)
    assert 0 < sent < len(lines)
    assert f"{sent} frames lose that they were sent" in summary.losses
    bare, full = (read_frames(tmp_path / name).frames for name in ("x.log", "y.log"))
    assert not bare["is_tx"].any()
    full["is_tx"] = False
    assert bare.tobytes() == full.tobytes()


# No Python package brings tshark. Where it is missing, the tests above check the lines by a pattern of their own.
@pytest.mark.skipif(shutil.which("tshark") is None, reason="Wireshark's tshark is not installed")
def test_wireshark_opens_a_candump_log_with_all_its_frames(bus, tmp_path):
    rewrite(bus, tmp_path / "x.log", "candump")
    fields = ["-T", "fields", "-e", "can.id", "-e", "frame.protocols"]
    done = subprocess.run(
        ["tshark", "-r", str(tmp_path / "x.log"), *fields], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    rows = [line.split("\t") for line in done.stdout.splitlines()]
    frames = read_frames(tmp_path / "x.log").frames
    assert len(rows) == len(frames)
    for (can_id, protocols), frame in zip(rows, frames, strict=True):
        if not frame["is_error"]:
            assert (int(can_id, 0), "canfd" in protocols) == (frame["can_id"], frame["is_fd"])


def test_asc_says_what_it_loses(messages, bus, tmp_path):
    summary = rewrite(bus, tmp_path / "x.asc", "asc")
    read = read_messages(tmp_path / "x.asc")
    pairs = [
        (one, other)
        for one, other in zip(read, messages, strict=True)
        if not (other.is_error_frame or (other.is_fd and not other.data))
    ]
    assert [content(one)[:4] for one, _ in pairs] == [content(other)[:4] for _, other in pairs]
    assert [content(one)[5:] for one, _ in pairs] == [content(other)[5:] for _, other in pairs]
    start_ns = messages[0].t_ns // MILLISECOND_NS * MILLISECOND_NS
    assert max(abs(one.t_ns + start_ns - other.t_ns) for one, other in pairs) <= 500
    assert summary.losses == (
        f"{len(messages)} frames lose what their times have below 1 µs",
        "3 error frames lose class, data and direction",
        "32 FD frames without data will read as remote frames",
    )


def test_frames_out_of_order_and_names_are_counted(tmp_path):
    kinds = [
        {"channel": "vcan7", "is_rx": True},
        {"channel": "", "is_rx": False, "is_error_frame": True},
        {"channel": "7", "is_rx": False, "is_error_frame": True, "is_fd": True},
    ]
    times_ns = (1_790_000_000_005_000_000, 1_790_000_000_004_999_999, 1_790_000_000_006_000_000)
    write(tmp_path / "x.mcap", [TimedMessage(t_ns, **kind) for t_ns, kind in zip(times_ns, kinds, strict=True)])
    both = (
        "1 frames keep of their channel's name no more than its number",
        "1 frames that precede the first one move up to the beginning",
    )
    assert rewrite(tmp_path / "x.mcap", tmp_path / "x.blf", "blf").losses == (
        *both,
        "2 error frames lose that they were sent",
        "1 error frames lose that they were FD",
    )
    assert rewrite(tmp_path / "x.mcap", tmp_path / "x.asc", "asc").losses == (
        *both,
        "1 frames lose what their times have below 1 µs",
        "2 error frames lose class, data and direction",
    )
    assert rewrite(tmp_path / "x.mcap", tmp_path / "x.log", "candump").losses == (
        "1 frames lose what their times have below 1 µs",
        "1 error frames lose that they were FD",
        "2 frames lose that they were sent",
    )
    assert read_frames(tmp_path / "x.blf").frames["t_ns"].tolist() == [times_ns[0], times_ns[0], times_ns[2]]
    assert read_frames(tmp_path / "x.asc").frames["t_ns"].tolist() == [0, 0, 1_000_000]


def test_a_run_in_lockstep_keeps_its_times_in_blf(tmp_path):
    record(tmp_path / "run.mcap", make_run(3, start_ns=7_000_123))
    rewrite(tmp_path / "run.mcap", tmp_path / "x.blf", "blf")
    expected = read_frames(tmp_path / "run.mcap").frames["t_ns"]
    assert read_frames(tmp_path / "x.blf").frames["t_ns"].tolist() == expected.tolist()


def test_frames_are_chosen_by_side_identifier_and_time(log):
    host_ids, device_ids = sides(CODEC)
    frames = read_frames(log).frames

    def chosen(**choice):
        return np.concatenate(
            list(FrameChoice(host_ids=host_ids, device_ids=device_ids, **choice).pieces(open_frames(log)))
        )

    hosts = chosen(only="host")
    assert set(hosts["can_id"].tolist()) == {0x080, 0x201, 0x202}  # one of which the run says that it was received
    assert len(chosen(only="devices")) + len(hosts) == len(frames)
    assert set(chosen(can_ids=frozenset({0x181, 0x182}))["can_id"].tolist()) == {0x181, 0x182}
    part = chosen(start_ns=10_000_000, end_ns=20_000_000)
    assert (part["t_ns"].min() - frames["t_ns"][0], len(np.unique(part["cycle_t_ns"]))) == (10_000_000, 10)


def test_whose_a_frame_is_says_the_contract_and_else_its_direction(tmp_path):
    kinds = [(0x080, True), (0x181, False), (0x7A5, True), (0x7A6, False)]  # identifier, received
    messages = [TimedMessage(1, arbitration_id=can_id, is_extended_id=False, is_rx=is_rx) for can_id, is_rx in kinds]
    messages.append(TimedMessage(2, arbitration_id=0x080, is_error_frame=True))
    write(tmp_path / "x.mcap", messages)
    host_ids, device_ids = sides(CODEC)
    choice = FrameChoice("host", host_ids, device_ids)
    (frames,) = choice.pieces(open_frames(tmp_path / "x.mcap"))
    assert frames["can_id"].tolist() == [0x080, 0x7A6]


def columns_of(path):
    return pyarrow.parquet.read_table(path).to_pydict()


def test_parquet_holds_every_topic_bit_for_bit(log, tmp_path):
    summary = export_tables(log, tmp_path, "parquet", (), load_decoder())
    expected = read_log(log)
    table = columns_of(tmp_path / "scheme.parquet")
    assert summary.problem == ""
    assert table["t_ns"] == expected.scheme.t_ns.tolist()
    assert np.array_equal(table["tau_J_2"], expected.scheme["tau_J"][:, 1])
    assert table["state"] == expected.scheme["state"].tolist()
    assert table["cycle_t_ns"] == table["t_ns"]
    feedback = columns_of(tmp_path / "decoded_Drive1Feedback.parquet")
    assert feedback["velocity"] == expected.decoded["Drive1Feedback"]["velocity"].tolist()
    assert columns_of(tmp_path / "events.parquet")["message"] == [event.event.message for event in expected.events]
    assert summary.rows[tmp_path / "contact.parquet"] == len(expected.contacts) == 1
    assert not (tmp_path / "from_can_bus.parquet").exists()


def test_parquet_says_where_it_comes_from(log, tmp_path):
    export_tables(log, tmp_path, "parquet", ("cycle",), load_decoder())
    metadata = pyarrow.parquet.read_schema(tmp_path / "cycle.parquet").metadata
    assert metadata[b"epoch_ns"] == b"1790000000123456789"


def test_csv_holds_numbers_that_read_back_to_the_same(log, tmp_path):
    export_tables(log, tmp_path, "csv", ("control", "decoded/Sensor*"), load_decoder())
    assert sorted(path.name for path in tmp_path.iterdir())[:2] == ["control.csv", "decoded_Sensor1Emcy.csv"]
    with (tmp_path / "control.csv").open() as file:
        rows = list(csv.DictReader(file))
    expected = read_log(log).control
    assert [float(row["q_d_1"]) for row in rows] == expected["q_d"][:, 0].tolist()
    assert {row["enable"] for row in rows} == {"True"}


def test_frames_of_others_become_tables_by_the_contract(log, tmp_path):
    rewrite(log, tmp_path / "x.blf", "blf")
    export_tables(tmp_path / "x.blf", tmp_path / "tables", "parquet", ("Drive1*",), load_decoder())
    expected = read_log(log).decoded
    for name in ("Drive1Feedback", "Drive1Command"):
        table = columns_of(tmp_path / "tables" / f"decoded_{name}.parquet")
        assert table[expected[name].fields[0]] == expected[name][expected[name].fields[0]].tolist()


def test_a_topic_that_is_not_there_names_the_nearest():
    topics = ["/scheme", "/control", "/decoded/Sync", "/decoded/Sensor1Torque"]
    assert choose_topics(topics, ()) == topics
    assert choose_topics(topics, ("decoded/S*", "Sync", "/control")) == [*topics[2:], "/control"]
    assert choose_topics(topics, ("S*",)) == topics[2:]
    with pytest.raises(LogError, match="the log has no topic sceme, did you mean /scheme"):
        choose_topics(topics, ("sceme",))


def test_without_pyarrow_one_line_says_what_to_install(log, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(LogError, match=r"pip install -e '.*\[tables\]', or choose csv"):
        export_tables(log, tmp_path / "x", "parquet", (), load_decoder())
    assert not (tmp_path / "x").exists()


def command(*arguments):
    return CliRunner().invoke(export, [str(argument) for argument in arguments])


def test_the_command_counts_losses_on_stderr(log, tmp_path):
    done = command(log, "--format", "asc", "--out", tmp_path / "x.asc", "--only", "devices", "--id", "181", "--json")
    assert done.exit_code == 0
    assert json.loads(done.stdout)["frames"] == 60 + 6 + 6  # feedback, an error frame, a short one
    assert "asc: 6 error frames lose class, data and direction" in done.stderr


def test_a_damaged_recording_is_a_partial_result(log, tmp_path):
    (tmp_path / "cut.mcap").write_bytes(log.read_bytes()[:-100])
    for kind in ("candump", "csv"):
        done = command(tmp_path / "cut.mcap", "--format", kind)
        assert (done.exit_code, "warning: " in done.stderr) == (3, True)
    assert (tmp_path / "cut.log").exists()
    assert (tmp_path / "cut-tables" / "scheme.csv").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--format", "blf", "--topic", "scheme"), "--topic chooses tables"),
        (("--format", "csv", "--id", "181"), "--only and --id choose frames"),
        (("--format", "blf", "--direction"), "--direction is candump's"),
        (("--format", "csv", "--id", "1XX"), "not a hexadecimal"),
        (("--format", "csv", "--id", "20000000"), "more than 29 bits"),
    ],
)
def test_options_that_make_no_sense_together_are_wrong_usage(log, arguments, said):
    done = command(log, *arguments)
    assert (done.exit_code, said in done.stderr) == (2, True)


def test_a_recording_is_not_overwritten(tmp_path):
    (tmp_path / "x.log").write_text("(1.000000) can0 123#11 R\n")
    done = command(tmp_path / "x.log", "--format", "candump", "--out", tmp_path / "x.log")
    assert (done.exit_code, "is the recording itself" in done.stderr) == (2, True)
    assert (tmp_path / "x.log").read_text() == "(1.000000) can0 123#11 R\n"


def test_a_candump_log_without_out_is_written_beside_itself(tmp_path):
    (tmp_path / "x.log").write_text("(1.000000) can0 123#11\n(2.000000) can0 124#22\n")
    assert command(tmp_path / "x.log", "--format", "candump", "--id", "124").exit_code == 0
    assert (tmp_path / "x.exported.log").read_text() == "(2.000000) can0 124#22\n"


def test_candumps_form_on_a_screen_is_named_without_out_too(tmp_path):
    (tmp_path / "x.log").write_text(" (000.001)  can0  181   [2]  00 01\n")
    done = command(tmp_path / "x.log", "--format", "candump")
    assert (done.exit_code, "`candump -l`" in done.stderr) == (1, True)
    assert [path.name for path in tmp_path.iterdir()] == ["x.log"]


def test_a_page_that_the_dbc_does_not_know_is_named(tmp_path):
    (tmp_path / "x.dbc").write_text(
        'VERSION ""\n\nBU_: A\n\nBO_ 291 Paged: 2 A\n SG_ page M : 0|8@1+ (1,0) [0|0] "" A\n'
        ' SG_ value m3 : 8|8@1+ (1,0) [0|0] "" A\n'
    )
    (tmp_path / "x.log").write_text("".join(f"({second}.000000) can0 123#0{second}11\n" for second in (2, 3, 5, 5)))
    done = command(tmp_path / "x.log", "--format", "csv", "--dbc", tmp_path / "x.dbc")
    notes = [line.split(": ", 1)[1] for line in done.stderr.splitlines()]
    decoded_in_part = "only the signals that are in every frame are decoded: expected multiplexer id 3, but got"
    assert notes == [f"Paged: of 1 frames {decoded_in_part} 2", f"Paged: of 2 frames {decoded_in_part} 5"]
    assert done.exit_code == 0
    rows = (tmp_path / "x-tables" / "decoded_Paged.csv").read_text().splitlines()
    assert [row.rsplit(",")[-2:] for row in rows[1:]] == [
        ["2.0", "nan"],
        ["3.0", "17.0"],
        ["5.0", "nan"],
        ["5.0", "nan"],
    ]


@pytest.mark.parametrize("kind", ["candump", "asc", "blf"])
def test_frames_replace_nothing_but_the_same_frames(log, tmp_path, kind):
    path = tmp_path / "bus.rec"
    for _ in range(2):
        assert command(log, "--format", kind, "--out", path).exit_code == 0
    whole = path.read_bytes()
    done = command(log, "--format", kind, "--out", path, "--only", "devices")
    assert (done.exit_code, path.read_bytes()) == (1, whole)
    assert done.stderr.splitlines()[-1].endswith(
        "bus.rec can't be written: another one is there already, which is left as it is"
    )
    path.write_bytes(b"")
    assert command(log, "--format", kind, "--out", path).exit_code == 0
    assert [file.name for file in tmp_path.iterdir()] == ["bus.rec"]


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_tables_replace_tables_and_nothing_else(log, tmp_path, kind):
    path = tmp_path / f"cycle.{kind}"
    path.touch()  # an empty file is nobody's
    for _ in range(2):
        assert command(log, "--format", kind, "--topic", "cycle", "--out", tmp_path).exit_code == 0
    path.write_text("timestamp,arbitration_id\n")
    done = command(log, "--format", kind, "--topic", "cycle", "--out", tmp_path)
    assert (done.exit_code, path.read_text()) == (1, "timestamp,arbitration_id\n")
    (complaint,) = done.stderr.splitlines()
    assert complaint.endswith(f"{path} can't be written: what is there is no table of this command")


@pytest.mark.parametrize(
    ("name", "data", "line"),
    [
        ("none.mcap", None, "none.mcap can't be read: No such file or directory"),
        ("text.mcap", b"hello", "text.mcap is not an MCAP file"),
        ("cut.mcap", MAGIC, "cut.mcap has no topic that can be read"),
        ("none.log", None, "none.log can't be read: No such file or directory"),
        (
            "bus.log",
            b"(1.000000) can0 123#11\n",
            "bus.log has frames only, and their contract arm.dbc has no topic Drive1Feedbak, did you mean",
        ),
    ],
)
def test_topics_are_told_of_those_that_a_recording_can_have(tmp_path, name, data, line):
    if data is not None:
        (tmp_path / name).write_bytes(data)
    done = command(tmp_path / name, "--format", "csv", "--topic", "Drive1Feedbak")
    assert done.exit_code == 1
    (complaint,) = done.stderr.splitlines()
    assert line in complaint


def test_topics_of_frames_are_no_tables(log):
    done = command(log, "--format", "csv", "--topic", "to_can_bus")
    assert done.exit_code == 1
    assert "topic /to_can_bus holds frames, which become no table: --format candump, blf or asc" in done.stderr


def test_the_help_has_the_exit_statuses():
    assert "Exit status: 0 done; 1 " in " ".join(command("--help").stdout.split())


def test_a_dbc_that_knows_no_frame_is_named(tmp_path):
    (tmp_path / "x.log").write_text("(1.000000) can0 7A5#11\n")
    done = command(tmp_path / "x.log", "--format", "csv")
    assert (done.exit_code, done.stdout) == (0, "nothing to export: arm.dbc knows no frame of x.log\n")
