"""`adacd-hil replay` and `compare`: what they print, and the status that they end with."""

import json
import shlex
from pathlib import Path
from types import SimpleNamespace

import pytest
from analysis.replay_rig import write_candump
from called import called, complaints
from log.made_log import flipped as bit_flipped
from log.made_log import kinds, put_together, rechunk, take_apart
from mcap.opcode import Opcode
from mcap.records import Chunk
from zstandard import decompress

from adacd_hil.lab.runs.log_comparison import LogComparison
from adacd_hil.log.reader import begin_of_log, read_log

pytestmark = pytest.mark.slow
OK, FAILURE, USAGE, PARTIAL = 0, 1, 2, 3


ROW = 1700


@pytest.fixture(scope="module")
def flipped(log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log with one bit of theta_hat[a1] flipped in a row."""
    record = read_log(log, ("/scheme",)).scheme.records[ROW : ROW + 1]
    begin, place = (record.dtype.fields[name][1] for name in ("sec", "theta_hat"))
    wanted, parts = record.tobytes()[begin : place + 8], take_apart(log.read_bytes())
    chunk = next(part for part in kinds(parts, Opcode.CHUNK) if wanted in decompress(part.read(Chunk).data))
    rechunk(chunk, lambda data: bit_flipped(data, data.find(wanted) + place - begin))
    target = tmp_path_factory.mktemp("flipped") / "run.mcap"
    target.write_bytes(put_together(parts))
    return target


def test_a_flipped_bit_in_the_file_ends_with_status_1_and_the_field_is_named(log, flipped):
    done = called("replay", flipped, "--json")
    (result,) = json.loads(done.stdout)
    assert (done.exit_code, result["mismatch_count"]) == (FAILURE, 1)
    (mismatch,) = result["mismatches"]
    assert (mismatch["topic"], mismatch["field"], mismatch["place"]) == ("/scheme", "theta_hat", "a1")
    assert mismatch["cycle"] == read_log(log, ("/scheme",)).scheme["cycle"][ROW]
    assert mismatch["logged"] != mismatch["replayed"]
    assert "theta_hat[a1]" in called("replay", flipped).stdout


def test_a_log_that_cannot_be_read_keeps_no_other_back(log, tmp_path):
    done = called("replay", tmp_path / "gone.mcap", log, tmp_path / "gone.mcap", "--json")
    assert (done.exit_code, [each["log"] for each in json.loads(done.stdout)]) == (FAILURE, [str(log)])
    assert [str(tmp_path / "gone.mcap") in line for line in complaints(done)] == [True]
    done = called("compare", log, tmp_path / "gone.mcap", log, "--json")
    assert (done.exit_code, [each["cycles"] > 0 for each in json.loads(done.stdout)]) == (FAILURE, [True])
    assert [str(tmp_path / "gone.mcap") in line for line in complaints(done)] == [True]


@pytest.mark.parametrize(
    ("topics", "options", "lacks"),
    [(("/scheme", "/cycle"), (), "neither /arm nor frames"), (("/scheme", "/arm"), ("--frames",), "no frames")],
)
def test_a_log_without_frames_is_not_compared_with_what_none_decode_to(log, tmp_path, topics, options, lacks):
    called(
        "log", "cut", log, *(word for topic in topics for word in ("--topic", topic)), "--out", tmp_path / "run.mcap"
    )
    done = called("replay", tmp_path, *options)
    assert (done.exit_code, done.stdout) == (FAILURE, "")
    assert f"has {lacks}" in done.stderr


def test_a_cut_log_ends_with_status_3(log, tmp_path):
    content = log.read_bytes()
    (tmp_path / "run.mcap").write_bytes(content[: len(content) // 2])
    done = called("replay", tmp_path)
    assert done.exit_code == PARTIAL
    assert "identical, bit for bit" in done.stdout
    assert "the log is not whole" in done.stdout


def test_a_stretch_of_two_runs_is_compared(log, flipped):
    at_s = (int(read_log(log, ("/scheme",)).scheme.t_ns[ROW]) - begin_of_log(log)) * 1e-9
    for start_s, end_s, code, fields in (
        (at_s - 0.3004, at_s - 0.0004, OK, []),
        (at_s - 0.0004, at_s + 0.2996, FAILURE, ["theta_hat"]),
        (at_s + 0.0006, at_s + 0.3006, OK, []),
    ):
        done = called("compare", log, flipped, "--from", start_s, "--until", end_s, "--json")
        found = json.loads(done.stdout)
        assert (done.exit_code, [field["field"] for field in found["fields"]]) == (code, fields)
        assert (found["cycles"], found["only"], found["runs"][0]["cycles"]) == (300, [0, 0], 300)
        assert found["from_s"] == pytest.approx(start_s)
    assert f"the same in all {ROW} cycles" in called("compare", log, flipped, "--until", at_s - 0.0004).stdout


@pytest.mark.parametrize("command", ["replay", "compare", "thresholds", "tune"])
def test_a_stretch_that_holds_nothing_is_one_line(log, command):
    logs = [log, log] if command == "compare" else [log]
    for bounds, code, line in (
        (("--from", "2000"), FAILURE, "from 2000 s"),
        (("--until", "-5"), FAILURE, "until -5 s"),
        (("--from", "5", "--until", "5"), USAGE, "--from 5 s is not before --until 5 s"),
        (("--from", "nan"), USAGE, "--from nan is not a time"),
        (("--until", "inf"), USAGE, "--until inf is not a time"),
    ):
        done = called(command, *logs, *bounds)
        (said,) = complaints(done)
        assert (done.exit_code, done.stdout) == (code, "")
        assert line in said


def test_the_suggested_command_has_what_was_typed(log, tmp_path):
    recorded = tmp_path / "bus log.log"
    write_candump(log, recorded)
    given = ["replay", str(recorded), "--against", str(log), "--frames", "--shown", "3"]
    (suggested,) = [shlex.split(line, comments=True) for line in called(*given).stderr.splitlines() if "next:" in line]
    assert suggested == ["next:", "adacd-hil", *given, "--set", "filter.a_rad_s=20"]
    assert called(*suggested[2:]).exit_code in (OK, PARTIAL)


def test_other_settings_stand_beside_the_original(log):
    done = called("replay", log, "--vary", "detector.threshold_Nm=0.3,50", "--json")
    (result,) = json.loads(done.stdout)
    assert (done.exit_code, result["identical"], result["attempts"]) == (OK, True, 2)
    missed = {variant["name"]: variant["missed"] for variant in result["variants"]}
    assert missed == {"detector.threshold_Nm=0.3": 0, "detector.threshold_Nm=50": 1}
    text = called("replay", log, "--set", "detector.threshold_Nm=50").stdout
    assert "missed" in text
    assert "every figure is the original's" not in text
    text = called("replay", log, "--vary", "certified.noise_sigmas=1,2").stdout
    assert [line.split(" with ")[1].partition(":")[0] for line in text.splitlines() if "every figure" in line] == [
        "certified.noise_sigmas=1",
        "certified.noise_sigmas=2",
    ]
    assert "The arm in the log moved as it did" in text


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("--set", "detector.treshold=1"), "did you mean `detector.threshold_Nm`?"),
        (("--set", "bus.period_us=2000"), "`bus.period_us` made the numbers of the log; a replay can't change it"),
        (("--vary", "arm.torque_offset_Nm=0.1,0.2"), "`arm.torque_offset_Nm` made the numbers of the log"),
        (("--set", "filter.a_rad_s=8", "--vary", "filter.a_rad_s=9,10"), "filter.a_rad_s is both set and varied"),
        (("--set", "filter.a_rad_s=8", "--set", "filter.a_rad_s=9"), "filter.a_rad_s is given twice, as 8 and 9"),
        (("--set", "devices.drive_node=[5, 6]"), "`devices.drive_node` made the numbers of the log"),
    ],
)
def test_settings_that_cant_be_used_end_with_status_2(log, arguments, line):
    done = called("replay", log, *arguments)
    assert done.exit_code == USAGE
    assert line in done.stderr


def test_two_logs_compare_with_status_0_if_the_same_3_as_far_as_whole_else_1(log, flipped, tmp_path):
    assert called("compare", log, log.parent).exit_code == OK
    content = log.read_bytes()
    (tmp_path / "run.mcap").write_bytes(content[: len(content) * 3 // 4])
    many = called("compare", log, log.parent, tmp_path, "--json")
    same, cut = json.loads(many.stdout)
    assert (many.exit_code, same["is_same"], cut["is_same"], cut["fields"]) == (PARTIAL, True, False, [])
    assert cut["only"][0] > 0
    assert called("compare", tmp_path, log).exit_code == PARTIAL
    assert called("compare", log, tmp_path, flipped).exit_code == FAILURE
    one, two = {"problem": ""}, {"problem": "cut after 9 bytes"}
    for first, second, only, is_same in (
        (one, two, (4, 0), True),
        (one, two, (0, 4), False),
        (one, one, (4, 0), False),
    ):
        sides = SimpleNamespace(**first), SimpleNamespace(**second)
        assert LogComparison(*sides, {}, {}, (), (), 9, only, ()).is_same_where_whole == is_same
