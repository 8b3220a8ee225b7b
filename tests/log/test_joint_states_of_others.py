"""Joint states that others recorded: of any number of joints, under the text that our own two-joint ones have."""

import csv
from pathlib import Path

import pytest
from called import called
from joint_state_bags import State, write_mcap
from mcap.writer import Writer

NAMES = ("lift", "pan", "elbow")


def states(effort=(5.0, 6.0, 7.0)) -> list[State]:
    return [State(0.01 * k, NAMES, (k, k + 1.0, k + 2.0), (), effort) for k in range(60)]


def tables(path: Path, out: Path) -> dict[str, list[dict[str, str]]]:
    exported = called("log", "export", path, "--format", "csv", "--out", out)
    assert exported.exit_code == 0, exported.stderr
    return {each.stem: list(csv.DictReader(each.read_text().splitlines())) for each in sorted(out.glob("*.csv"))}


def test_the_check_takes_them_for_what_they_are(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "r.mcap", states())
    checked = called("log", "check", path)
    assert (checked.exit_code, "60 messages" in checked.stdout) == (0, True)


def test_the_check_finds_one_that_is_none(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "r.mcap", states(), has_index=False)
    data = path.read_bytes()
    place = data.index(b"lift\0") - 4
    path.write_bytes(data[:place] + b"\xff\xff\xff\x00" + data[place + 4 :])
    checked = called("log", "check", path)
    assert checked.exit_code == 1
    assert "1 messages" in checked.stdout
    assert "/joint_states (cdr)" in checked.stdout


def test_a_table_of_them_has_the_joints_names(tmp_path: Path) -> None:
    without_names = State(0.6, (), (1.0,), (), ())
    (table,) = tables(write_mcap(tmp_path / "r.mcap", [*states(), without_names]), tmp_path / "out").values()
    assert len(table) == 60
    assert (table[2]["position_lift"], table[2]["position_elbow"], table[2]["effort_pan"]) == ("2.0", "4.0", "6.0")
    assert table[2]["velocity_pan"] == "nan"
    assert int(table[1]["t_ns"]) - int(table[0]["t_ns"]) == 10_000_000


def test_messages_of_another_encoding_on_their_topic_make_no_empty_table(tmp_path: Path) -> None:
    with (tmp_path / "r.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("sensor_msgs/JointState", "jsonschema", b"{}")
        writer.add_message(writer.register_channel("/joint_states", "json", schema), 1, b"{}", 1)
        writer.finish()
    exported = called("log", "export", tmp_path / "r.mcap", "--format", "csv", "--out", tmp_path / "out")
    assert (exported.exit_code, list((tmp_path / "out").glob("*.csv"))) == (1, [])


@pytest.mark.parametrize("is_gripper_first", [False, True])
def test_each_choice_of_joints_has_a_table(tmp_path: Path, is_gripper_first: bool) -> None:
    gripper = [State(state.t_s + 1e-3, ("finger",), (0.5,), (), (9.0,)) for state in states()]
    pairs = zip(states(), gripper, strict=True)
    messages = [message for pair in pairs for message in (reversed(pair) if is_gripper_first else pair)]
    found = tables(write_mcap(tmp_path / "r.mcap", messages), tmp_path / "out")
    assert sorted(len(table[0]) for table in found.values()) == [4, 10]
    assert all(len(table) == 60 for table in found.values())
    first, second = ("finger", "lift") if is_gripper_first else ("lift", "finger")
    assert f"effort_{first}" in found["joint_states"][0]
    assert f"effort_{second}" in found[f"joint_states_{second}_1"][0]
