"""`identify --init`: the map of a recording, drafted from its heads and values and the URDF."""

import csv
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from called import called
from click.testing import Result
from foreign_arms import AXES, Motion, record, urdf_text
from joint_state_bags import State, write_mcap

from adacd_hil.lab.offline.map_draft import DraftedKey, draft_map, map_text
from adacd_hil.lab.offline.recording_map import read_map
from adacd_hil.log.log_files import LogError
from adacd_hil.settings.schema import ConfigError

URDF = urdf_text(2, ("0 1 0",) * 2, effort=20.0)


@pytest.fixture(scope="module")
def motion() -> Motion:
    return record(URDF, seconds=3.0)


def table(heads: str, *columns, delimiter: str = ",", form: Callable[[float], str] = "{:.6g}".format) -> str:
    values = np.column_stack(columns)
    rows = [delimiter.join(form(value) for value in row) for row in values.tolist()]
    return "\n".join([*([heads] if heads else []), *rows]) + "\n"


def draft(folder: Path, text: str, urdf: str = URDF) -> tuple[list[DraftedKey], dict]:
    """Draft a map, write and read it, and return it with its tables."""
    (folder / "arm.urdf").write_text(urdf)
    (folder / "r.csv").write_text(text)
    found = draft_map(folder / "r.csv", folder / "arm.urdf", folder / "map.toml")
    text = map_text(folder / "r.csv", found)
    (folder / "map.toml").write_text(text)
    read_map(folder / "map.toml")
    return found, tomllib.loads(text)


HEADS = {
    "plain": ("t,q1,q2,dq1,dq2,tau1,tau2", {}),
    "counted from zero": ("time,pos_0,pos_1,vel_0,vel_1,effort_0,effort_1", {}),
    "units behind": (
        "time_ms,j1_deg,j2_deg,v1_rpm,v2_rpm,j1_mNm,j2_mNm",
        {"time": "ms", "q": "deg", "dq": "rpm", "tau_J": "mNm"},
    ),
    "units in brackets": ("Time [s],q1 [rad],q2 [rad],qd1 [rad/s],qd2 [rad/s],tau1 (N m),tau2 (N m)", {}),
    "of a controller": (
        "timestamp,actual_q_0,actual_q_1,actual_qd_0,actual_qd_1,actual_current_0,actual_current_1",
        {"tau_J": "A"},
    ),
    "quoted, with commas": (
        't,"position, 1","position, 2","velocity, 1","velocity, 2","torque, 1","torque, 2"',
        {},
    ),
    "quoted, with a line break": ('"time\n(s)",q1,q2,dq1,dq2,tau1,tau2', {}),
    "by the joints' names": (
        "stamp,joint1/position,joint2/position,joint1/velocity,joint2/velocity,joint1/effort,joint2/effort",
        {},
    ),
}


@pytest.mark.parametrize("kind", HEADS)
def test_columns_and_units_are_found_by_their_heads(tmp_path, motion, kind):
    heads, units = HEADS[kind]
    _, keys = draft(tmp_path, table(heads, motion.t, motion.q, motion.dq, motion.tau))
    (names,) = csv.reader(heads.splitlines(keepends=True))
    assert keys["columns"] == {"time": names[0], "q": names[1:3], "dq": names[3:5], "tau_J": names[5:7]}
    assert keys.get("units", {}) == units


def test_joints_in_another_order_are_put_in_the_urdfs(tmp_path, motion):
    heads = "t,joint2_pos,joint1_pos,joint2_effort,joint1_effort"
    _, keys = draft(tmp_path, table(heads, motion.t, motion.q[:, ::-1], motion.tau[:, ::-1]))
    assert keys["columns"]["q"] == ["joint1_pos", "joint2_pos"]
    assert keys["columns"]["tau_J"] == ["joint1_effort", "joint2_effort"]


def test_measured_columns_go_before_desired_and_filtered_ones(tmp_path, motion):
    heads = "t,q_des1,q_des2,q_filt1,q_filt2,q_meas1,q_meas2,tau_cmd1,tau_cmd2,tau_meas1,tau_meas2,qdd1,qdd2"
    text = table(heads, motion.t, motion.q, motion.q, motion.q, motion.tau, motion.tau, motion.q)
    found, keys = draft(tmp_path, text)
    assert keys["columns"] == {"time": "t", "q": ["q_meas1", "q_meas2"], "tau_J": ["tau_meas1", "tau_meas2"]}
    reasons = {key.key: key.reason for key in found if key.reason}
    assert reasons["q"] == "one of q_des1, q_filt1, q_meas1"


def test_what_heads_leave_open_is_guessed_from_spans_against_the_urdf(tmp_path, motion):
    heads = "t,q1,q2,dq1,dq2,tau1,tau2"
    columns = (5.0 * np.arange(len(motion.t)), np.degrees(motion.q), np.degrees(motion.dq), 1e3 * motion.tau)
    found, keys = draft(tmp_path, table(heads, *columns))
    assert keys["units"] == {"time": "ms", "q": "deg", "dq": "deg/s", "tau_J": "mNm"}
    reasons = {key.key: key.reason for key in found if key.reason}
    assert reasons["time"] == "rows are 5 ms apart"
    assert "the URDF to 2 rad" in reasons["q"]
    assert "the effort of the URDF is 20 Nm" in reasons["tau_J"]
    _, keys = draft(tmp_path, table(heads, motion.t, motion.q, motion.dq, motion.tau))
    assert "units" not in keys


def test_columns_without_heads_are_found_by_their_slopes(tmp_path, motion):
    _, keys = draft(tmp_path, table("", motion.t, motion.q, motion.dq, motion.tau, motion.tau))
    assert keys["csv"] == {"has_header": False}
    assert keys["columns"] == {"time": "1", "q": ["2", "3"], "dq": ["4", "5"], "tau_J": ["6", "7"]}


def test_semicolons_decimal_commas_and_lines_above_the_head_are_found(tmp_path, motion):
    rows = table("", motion.t, motion.q, motion.tau, delimiter=";", form="{:.5f}".format).replace(".", ",")
    _, keys = draft(tmp_path, f'Recorder 3.1\n"Arm\nleft"\nt;q1;q2;tau1;tau2\ns;deg;deg;Nm;Nm\n{rows}')
    assert keys["csv"] == {"delimiter": ";", "decimal": ",", "skip_rows": 3}
    assert keys["units"] == {"q": "deg"}


def test_heads_that_numpy_savetxt_writes_as_a_comment_are_found(tmp_path, motion):
    text = table("# t q1 q2 tau1 tau2\n# s deg deg Nm Nm", motion.t, motion.q, motion.tau, delimiter=" ")
    _, keys = draft(tmp_path, text)
    assert keys["csv"] == {"delimiter": " "}
    assert keys["columns"] == {"time": "t", "q": ["q1", "q2"], "tau_J": ["tau1", "tau2"]}
    assert keys["units"] == {"q": "deg"}


def test_dates_are_found_and_tell_the_interval_of_the_rows(tmp_path, motion):
    rows = table("", motion.q, np.degrees(motion.dq), motion.tau).splitlines()
    dated = [f"2024-05-01T10:00:{0.005 * k:09.6f}Z,{row}" for k, row in enumerate(rows)]
    _, keys = draft(tmp_path, "\n".join(["stamp,q1,q2,dq1,dq2,tau1,tau2", *dated]))
    assert keys["units"] == {"time": "iso", "dq": "deg/s"}
    _, keys = draft(tmp_path, "\n".join(dated))
    assert keys["columns"] == {"time": "1", "q": ["2", "3"], "dq": ["4", "5"], "tau_J": ["6", "7"]}


def test_a_period_that_nobody_says_is_left_to_be_written(tmp_path, motion):
    heads = "T1 [Nm],T2 [Nm],i1 [A],i2 [A],q1 [rad],q2 [rad]"
    _, keys = draft(tmp_path, table(heads, motion.tau, motion.tau, motion.q))
    assert keys["columns"] == {"q": ["q1 [rad]", "q2 [rad]"], "tau_J": ["T1 [Nm]", "T2 [Nm]"]}
    assert keys["sampling"] == {"period_s": 0.0}
    played = called("identify", tmp_path / "r.csv", "--map", tmp_path / "map.toml")
    assert played.exit_code == 2
    assert "`sampling.period_s`" in played.stderr


def test_a_gripper_that_makes_the_arm_branch_is_locked(tmp_path, motion):
    fingers = "".join(
        f'<link name="{side}"/><joint name="{side}_finger" type="prismatic"><parent link="link2"/>'
        f'<child link="{side}"/><axis xyz="0 1 0"/><limit lower="0" upper="0.04" velocity="1" effort="10"/></joint>'
        for side in ("left", "right")
    )
    urdf = URDF.replace("</robot>", fingers + "</robot>")
    _, keys = draft(tmp_path, table("t,q1,q2,tau1,tau2", motion.t, motion.q, motion.tau), urdf)
    assert keys["arm"]["locked"] == ["left_finger", "right_finger"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("t,a1,b1\n" + "0,1,2\n" * 9, "no 2 columns look like positions of joint1, joint2; there are t, a1, b1"),
        ("t,q1,q2,x1\n" + "0,1,2,3\n" * 9, "no 2 columns look like torques or currents"),
        ("nothing\n" * 9, "no rows of numbers in its first 60 lines"),
        ("", "no rows of numbers"),
    ],
)
def test_a_table_that_nothing_can_be_made_of_is_one_line(tmp_path, text, said):
    with pytest.raises((LogError, ConfigError)) as refusal:
        draft(tmp_path, text)
    assert said in str(refusal.value)
    assert "\n" not in str(refusal.value)


def bag(folder: Path, names: tuple[str, ...], motion: Motion, **more) -> dict:
    (folder / "arm.urdf").write_text(URDF)
    states = [
        State(t, names, q, (), tau, **more)
        for t, q, tau in zip(motion.t.tolist(), motion.q.tolist(), motion.tau.tolist(), strict=True)
    ]
    path = write_mcap(folder / "r.mcap", states)
    return tomllib.loads(map_text(path, draft_map(path, folder / "arm.urdf", folder / "map.toml")))


def test_a_bag_needs_its_urdf_alone_where_it_has_the_urdfs_names(tmp_path, motion):
    assert bag(tmp_path, ("joint1", "joint2"), motion) == {"arm": {"urdf": "arm.urdf"}}
    assert bag(tmp_path, ("left_joint1", "left_joint2"), motion, is_stamped=False) == {
        "arm": {"urdf": "arm.urdf"},
        "bag": {"time": "received"},
        "columns": {"q": ["left_joint1", "left_joint2"]},
    }
    wide = Motion(motion.t, motion.q[:, [0, 1, 1]], motion.dq, motion.tau[:, [0, 1, 1]])
    with pytest.raises(ConfigError, match="has the joints a, b, c, the URDF joint1, joint2"):
        bag(tmp_path, ("a", "b", "c"), wide)


@pytest.mark.slow
def test_the_command_writes_a_map_that_identifies_the_arm_and_replaces_none(tmp_path):
    urdf, recording, described = (tmp_path / name for name in ("arm.urdf", "r.csv", "map.toml"))
    urdf.write_text(urdf_text(3, AXES))
    motion = record(urdf.read_text())
    heads = "t_ms,angle1,angle2,angle3,torque1,torque2,torque3"
    recording.write_text(table(heads, 1e3 * motion.t, np.degrees(motion.q), motion.tau))

    def identify(*words: object) -> Result:
        return called("identify", *words)

    drafted = identify("--init", recording, urdf)
    assert drafted.exit_code == 0, drafted.stderr
    assert "units.q" in drafted.stdout
    assert "identify" in drafted.stderr
    identified = identify(recording, "--map", described)
    assert identified.exit_code == 0, identified.stdout
    assert identify("--init", recording, urdf).exit_code == 0  # the same map
    described.write_text("# my own\n")
    refused = identify("--init", recording, urdf)
    assert (refused.exit_code, described.read_text()) == (2, "# my own\n")
    assert "--map names a file for this one" in refused.stderr


def test_a_map_that_could_not_be_used_is_not_written(tmp_path, monkeypatch):
    (tmp_path / "arm.urdf").write_text(URDF)
    keys = [DraftedKey("arm", "urdf", "another.urdf", "")]
    (tmp_path / "r.csv").write_text("t,q\n")
    monkeypatch.setattr("adacd_hil.lab.offline.map_draft.draft_map", lambda *_: keys)
    refused = called("identify", "--init", tmp_path / "r.csv", tmp_path / "arm.urdf")
    assert (refused.exit_code, sorted(file.name for file in tmp_path.iterdir())) == (2, ["arm.urdf", "r.csv"])
