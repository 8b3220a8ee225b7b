"""`adacd-hil replay` and `compare`: what they print, and the status that they end with."""

import json
from pathlib import Path

import pytest
from analysis.flipped_log import flip_in_file
from analysis.replay_rig import write_candump
from click.testing import CliRunner, Result

from adacd_hil.cli.main import cli
from adacd_hil.log.reader import begin_of_log, read_log

pytestmark = pytest.mark.slow
OK, FAILURE, USAGE, PARTIAL = 0, 1, 2, 3


def run(*arguments: object) -> Result:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


def test_an_identical_log_ends_with_status_0_and_says_so(log: Path) -> None:
    done = run("replay", log.parent)
    assert done.exit_code == OK
    assert "identical, bit for bit" in done.stdout
    assert "in 2 attempts" in done.stdout


def test_a_flipped_bit_in_the_file_ends_with_status_1_and_the_field_is_named(log: Path, tmp_path: Path) -> None:
    scheme = read_log(log, ("/scheme",)).scheme
    record = scheme.records[1700:1701]
    offset = record.dtype.fields["theta_hat"][1] - record.dtype.fields["sec"][1]
    begin = record.tobytes()[record.dtype.fields["sec"][1] :][: offset + 8]
    assert len(begin) > 40
    flip_in_file(log, tmp_path / "run.mcap", begin, offset)
    done = run("replay", tmp_path / "run.mcap", "--json")
    (result,) = json.loads(done.stdout)
    assert done.exit_code == FAILURE
    assert result["mismatch_count"] == 1
    (mismatch,) = result["mismatches"]
    assert (mismatch["topic"], mismatch["field"], mismatch["place"]) == ("/scheme", "theta_hat", "a1")
    assert mismatch["cycle"] == int(record["cycle"][0])
    assert mismatch["logged"] != mismatch["replayed"]
    assert "theta_hat[a1]" in run("replay", tmp_path / "run.mcap").stdout


def test_a_cut_log_ends_with_status_3(log: Path, tmp_path: Path) -> None:
    content = log.read_bytes()
    (tmp_path / "run.mcap").write_bytes(content[: len(content) // 2])
    done = run("replay", tmp_path)
    assert done.exit_code == PARTIAL
    assert "identical, bit for bit" in done.stdout
    assert "the log is not whole" in done.stdout


def test_a_stretch_is_replayed_from_the_beginning_and_told_so(log: Path) -> None:
    done = run("replay", log, "--from", "2.2", "--until", "2.7")
    assert done.exit_code == OK
    assert (
        "500 of 500 cycles in 2 attempts compared, from 2.2 s until 2.7 s; replayed from the beginning of the log"
        in (done.stdout)
    )
    (result,) = json.loads(run("replay", log, "--from", "0.7", "--json").stdout)
    assert (result["from_s"], result["until_s"], result["identical"]) == (0.7, None, True)
    whole = read_log(log, ("/scheme",)).scheme
    assert 0 < result["compared"] < len(whole)


def test_a_stretch_of_two_runs_is_compared(log: Path, tmp_path: Path) -> None:
    scheme = read_log(log, ("/scheme",)).scheme
    record = scheme.records[1700:1701]
    offset = record.dtype.fields["theta_hat"][1] - record.dtype.fields["sec"][1]
    begin = record.tobytes()[record.dtype.fields["sec"][1] :][: offset + 8]
    flip_in_file(log, tmp_path / "run.mcap", begin, offset)
    at_s = (int(scheme.t_ns[1700]) - begin_of_log(log)) * 1e-9
    for start_s, end_s, code, fields in (
        (at_s - 0.3004, at_s - 0.0004, OK, []),
        (at_s - 0.0004, at_s + 0.2996, FAILURE, ["theta_hat"]),
        (at_s + 0.0006, at_s + 0.3006, OK, []),
    ):
        done = run("compare", log, tmp_path, "--from", start_s, "--until", end_s, "--json")
        found = json.loads(done.stdout)
        assert (done.exit_code, [field["field"] for field in found["fields"]]) == (code, fields)
        assert (found["cycles"], found["only"], found["runs"][0]["cycles"]) == (300, [0, 0], 300)
        assert found["from_s"] == pytest.approx(start_s)
    text = run("compare", log, tmp_path, "--until", at_s - 0.0004).stdout
    assert f"of 1 until {at_s - 0.0004:g} s; of 2 as long after motion start" in text
    assert "the same in all 1700 cycles" in text


@pytest.mark.parametrize("command", ["replay", "compare", "thresholds", "tune"])
def test_a_stretch_that_holds_nothing_is_one_line(log: Path, command: str) -> None:
    logs = [log, log] if command == "compare" else [log]
    for bounds, code, line in (
        (("--from", "2000"), FAILURE, "from 2000 s"),
        (("--until", "-5"), FAILURE, "until -5 s"),
        (("--from", "5", "--until", "5"), USAGE, "--from 5 s is not before --until 5 s"),
        (("--from", "nan"), USAGE, "--from nan is not a time"),
        (("--until", "inf"), USAGE, "--until inf is not a time"),
    ):
        done = run(command, *logs, *bounds)
        said = [each for each in done.stderr.splitlines() if each.startswith("adacd-hil: ")]
        assert (done.exit_code, done.stdout, len(said)) == (code, "", 1), done.output
        assert line in said[0]


def test_other_settings_stand_beside_the_original(log: Path) -> None:
    done = run("replay", log, "--vary", "detector.threshold_Nm=0.3,50", "--json")
    (result,) = json.loads(done.stdout)
    assert done.exit_code == OK
    assert result["identical"]
    assert [variant["name"] for variant in result["variants"]] == [
        "detector.threshold_Nm=0.3",
        "detector.threshold_Nm=50",
    ]
    assert [variant["missed"] for variant in result["variants"]] == [0, 1]
    text = run("replay", log, "--set", "detector.threshold_Nm=50").stdout
    assert "missed" in text
    assert "The arm in the log moved as it did" in text


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("--set", "detector.treshold=1"), "did you mean `detector.threshold_Nm`?"),
        (("--set", "detector"), "must be key=value"),
        (("--config", "papper"), "did you mean 'paper'?"),
        (("--set", "bus.period_us=2000"), "`bus.period_us` made the numbers of the log; a replay can't change it"),
        (("--vary", "arm.torque_offset_Nm=0.1,0.2"), "`arm.torque_offset_Nm` made the numbers of the log"),
        (("--set", "devices.drive_node=[5, 6]"), "`devices.drive_node` made the numbers of the log"),
    ],
)
def test_settings_that_cant_be_used_end_with_status_2(log: Path, arguments: tuple[str, ...], line: str) -> None:
    done = run("replay", log, *arguments)
    assert done.exit_code == USAGE
    assert line in done.stderr


def test_a_recording_alone_needs_a_configuration(log: Path, tmp_path: Path) -> None:
    write_candump(log, tmp_path / "bus.log")
    done = run("replay", tmp_path / "bus.log")
    assert done.exit_code == USAGE
    assert "--against the log of its run, or --config" in done.stderr


def test_a_log_that_isnt_there_ends_with_status_1(tmp_path: Path) -> None:
    done = run("replay", tmp_path / "none.mcap")
    assert done.exit_code == FAILURE
    assert "none.mcap" in done.stderr


def test_two_logs_that_are_the_same_compare_with_status_0_and_others_with_1(log: Path, tmp_path: Path) -> None:
    assert run("compare", log, log.parent).exit_code == OK
    content = log.read_bytes()
    (tmp_path / "run.mcap").write_bytes(content[: len(content) * 3 // 4])
    many = run("compare", log, log.parent, tmp_path, "--json")
    assert (many.exit_code, [each["is_same"] for each in json.loads(many.stdout)]) == (FAILURE, [True, False])
    done = run("compare", log, tmp_path, "--json")
    found = json.loads(done.stdout)
    assert done.exit_code == FAILURE
    assert not found["is_same"]
    assert found["only"][0] > 0
    assert found["fields"] == []
