"""Recordings as tables: the same values."""

import csv
import sys

import can
import numpy as np
import pyarrow.parquet
import pytest
from click.testing import CliRunner
from recorded_run import make_run, record

from adacd_hil.lab.cli.log_command import export
from adacd_hil.lab.logs.python_can_files import McapReader
from adacd_hil.lab.logs.signal_tables import choose_topics, export_tables
from adacd_hil.log.log_files import LogError
from adacd_hil.log.mcap.record_layout import MAGIC
from adacd_hil.log.reader import read_log
from adacd_hil.wire.dbc_decoder import load_decoder


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


def columns_of(path):
    return pyarrow.parquet.read_table(path).to_pydict()


def test_parquet_holds_every_topic_bit_for_bit(log, tmp_path):
    summary = export_tables(log, tmp_path, "parquet", (), load_decoder())
    expected = read_log(log)
    assert pyarrow.parquet.read_schema(tmp_path / "scheme.parquet").metadata[b"epoch_ns"] == b"1790000000123456789"
    table = columns_of(tmp_path / "scheme.parquet")
    assert summary.problem == ""
    assert table["t_ns"] == expected.scheme.t_ns.tolist()
    assert np.array_equal(table["tau_J_2"], expected.scheme["tau_J"][:, 1])
    assert table["state"] == expected.scheme["state"].tolist()
    assert table["cycle_t_ns"] == table["t_ns"]
    feedback = columns_of(tmp_path / "decoded_Drive1Feedback.parquet")
    assert feedback["velocity"] == expected.topics["/decoded/Drive1Feedback"]["velocity"].tolist()
    assert columns_of(tmp_path / "events.parquet")["message"] == [event.event.message for event in expected.events]
    assert summary.rows[tmp_path / "contact.parquet"] == len(expected.contacts) == 1
    assert not (tmp_path / "from_can_bus.parquet").exists()


def test_csv_holds_numbers_that_read_back_to_the_same(log, tmp_path):
    export_tables(log, tmp_path, "csv", ("control", "decoded/Sensor*"), load_decoder())
    assert sorted(path.name for path in tmp_path.iterdir())[:2] == ["control.csv", "decoded_Sensor1Emcy.csv"]
    with (tmp_path / "control.csv").open() as file:
        rows = list(csv.DictReader(file))
    expected = read_log(log).control
    assert [float(row["q_d_1"]) for row in rows] == expected["q_d"][:, 0].tolist()
    assert {row["enable"] for row in rows} == {"True"}


def test_frames_of_others_become_tables_by_the_contract(log, tmp_path):
    with can.Logger(tmp_path / "x.blf") as target:
        for message in McapReader(log):
            target(message)
    export_tables(tmp_path / "x.blf", tmp_path / "tables", "parquet", ("Drive1*",), load_decoder())
    for name in ("Drive1Feedback", "Drive1Command"):
        expected = read_log(log).topics[f"/decoded/{name}"]
        table = columns_of(tmp_path / "tables" / f"decoded_{name}.parquet")
        assert table[expected.fields[0]] == expected[expected.fields[0]].tolist()


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


def test_a_damaged_recording_is_a_partial_result(log, tmp_path):
    (tmp_path / "cut.mcap").write_bytes(log.read_bytes()[:-100])
    done = command(tmp_path / "cut.mcap", "--format", "csv")
    assert (done.exit_code, "warning: " in done.stderr) == (3, True)
    assert (tmp_path / "cut-tables" / "scheme.csv").exists()


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
    assert "topic /to_can_bus holds frames, which become no table: `can_logconvert` converts them" in done.stderr


def test_a_dbc_that_knows_no_frame_is_named(tmp_path):
    (tmp_path / "x.log").write_text("(1.000000) can0 7A5#11\n")
    done = command(tmp_path / "x.log", "--format", "csv")
    assert (done.exit_code, done.stdout) == (0, "nothing to export: arm.dbc knows no frame of x.log\n")


@pytest.mark.parametrize(
    "options",
    [("--format", "BLF"), ("--only", "devices"), ("--direction",), ("--id", "181")],
)
def test_formats_of_frames_name_their_successor_and_write_nothing(options, log):
    before = sorted(log.parent.iterdir())
    done = command(log, *options)
    assert (done.exit_code, done.stdout) == (2, "")
    assert "can_logconvert run.mcap run.blf" in done.stderr
    assert sorted(log.parent.iterdir()) == before
