"""MCAP files and rosbags of joint states: joints by their names, and one line for what nothing can be learnt from."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from foreign_arms import urdf_text
from joint_state_bags import State, write_mcap, write_rosbag1, write_rosbag2
from rosbags.rosbag2 import StoragePlugin

from adacd_hil.lab.offline.recording_import import ForeignRecording, read_recording
from adacd_hil.lab.offline.recording_map import RecordingMap, read_map
from adacd_hil.log.log_files import LogError
from adacd_hil.log.time_window import TimeWindow
from adacd_hil.settings.schema import ConfigError

NAMES = ("pan", "lift", "elbow")
ARM = urdf_text(3, ("0 0 1",) * 3, has_masses=False, names=NAMES)
COUNT = 100


@pytest.fixture
def described(tmp_path: Path) -> RecordingMap:
    (tmp_path / "arm.urdf").write_text(ARM)
    (tmp_path / "map.toml").write_text('[arm]\nurdf = "arm.urdf"\n')
    return read_map(tmp_path / "map.toml")


def value(name: str, k: int, scale: float = 1.0) -> float:
    return scale * math.sin(0.1 * k + NAMES.index(name))


def states(order: Sequence[str] = NAMES, has_velocity: bool = True, **more) -> list[State]:
    return [
        State(
            0.004 * k,
            order,
            [value(name, k) for name in order],
            [value(name, k, 2.0) for name in order] if has_velocity else (),
            [value(name, k, 30.0) for name in order],
            **more,
        )
        for k in range(COUNT)
    ]


def check(recording: ForeignRecording, has_velocity: bool = True) -> None:
    (stretch,) = recording.stretches
    count = len(stretch.record.q)
    assert recording.period_s == pytest.approx(0.004)
    assert count >= COUNT - 1
    for values, scale in ((stretch.record.q, 1.0), (stretch.record.tau_J, 30.0), (stretch.record.dq, 2.0)):
        if scale != 2.0 or has_velocity:
            expected = [[value(name, k, scale) for name in NAMES] for k in range(count)]
            np.testing.assert_allclose(values, expected, atol=1e-6)


WRITERS: dict[str, Callable[[Path, list[State]], Path]] = {
    "mcap": lambda folder, messages: write_mcap(folder / "r.mcap", messages),
    "mcap without an index or a profile": lambda folder, messages: write_mcap(
        folder / "r.mcap", messages, profile="", has_index=False
    ),
    "a bag of ROS 2": lambda folder, messages: write_rosbag2(folder / "bag", messages),
    "its database alone": lambda folder, messages: next(write_rosbag2(folder / "bag", messages).glob("*.db3")),
    "a bag of ROS 2 in MCAP": lambda folder, messages: write_rosbag2(folder / "bag", messages, StoragePlugin.MCAP),
    "a bag of ROS 1": lambda folder, messages: write_rosbag1(folder / "r.bag", messages),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_joints_are_found_by_their_names_in_whatever_order_a_bag_has_them(tmp_path, described, kind):
    check(read_recording(WRITERS[kind](tmp_path, states(("elbow", "pan", "lift"))), described))


def test_velocities_are_derived_where_a_bag_has_none(tmp_path, described):
    recording = read_recording(write_mcap(tmp_path / "r.mcap", states(has_velocity=False)), described)
    check(recording, has_velocity=False)
    assert not recording.has_velocities
    assert np.abs(recording.stretches[0].record.dq).max() == pytest.approx(25.0, rel=0.05)


def test_messages_of_a_gripper_and_joints_beyond_the_arm_are_passed_over(tmp_path, described):
    arm = states(("pan", "lift", "elbow"))
    messages = [
        message
        for state in arm
        for message in (
            State(state.t_s + 1e-3, ["finger"], [0.0], (), [0.0]),
            State(state.t_s, ["base", *state.names], *([9.0, *values] for values in state[2:5])),
        )
    ]
    check(read_recording(write_mcap(tmp_path / "r.mcap", messages), described))


def test_a_map_names_topic_joints_and_time_of_a_bag(tmp_path, described):
    names = tuple(f"left_{name}" for name in NAMES)
    renamed = changed(states(topic="/left/joint_states", is_stamped=False), names=names)
    path = write_mcap(tmp_path / "r.mcap", [*renamed, *states(topic="/right/joint_states")])
    (tmp_path / "map.toml").write_text(
        '[arm]\nurdf = "arm.urdf"\n[columns]\nq = ["left_pan", "left_lift", "left_elbow"]\n'
        '[bag]\ntopic = "/left/joint_states"\ntime = "received"\n'
    )
    check(read_recording(path, read_map(tmp_path / "map.toml")))


def test_a_span_of_a_bag_is_what_is_kept_of_it(tmp_path, described):
    path = write_mcap(tmp_path / "r.mcap", states())
    part = read_recording(path, described, span=TimeWindow(0.1, 0.35)).between(0.1, 0.35)
    assert part.duration_s == pytest.approx(0.25, abs=0.008)


def changed(messages: list[State], **change) -> list[State]:
    return [message._replace(**change) for message in messages]


REFUSED = {
    "no efforts": (lambda: changed(states(), effort=()), "/joint_states has no effort of pan, lift, elbow"),
    "no effort of a joint": (
        lambda: [message._replace(effort=[1.0, math.nan, 2.0]) for message in states()],
        "/joint_states has no effort of lift",
    ),
    "joints in messages of their own": (
        lambda: [state for pair in zip(states(NAMES[:2]), states(NAMES[2:]), strict=True) for state in pair],
        "no message has all of pan, lift, elbow; record a topic that joins them",
    ),
    "another arm": (
        lambda: changed(states(), names=("pan", "lift", "wrist")),
        "/joint_states has no joint 'elbow'; known: pan, lift, wrist (`columns.q` names them)",
    ),
    "a name that is nearly right": (
        lambda: changed(states(), names=("pan", "lift", "Elbow_")),
        "no joint 'elbow'; did you mean 'Elbow_'?",
    ),
    "no stamps": (lambda: states(is_stamped=False), 'all stamps are 0; `bag.time` = "received"'),
    "two topics": (
        lambda: [*states(topic="/left"), *states(topic="/right")],
        "has joint states on /left, /right",
    ),
    "efforts of some joints": (
        lambda: changed(states(), effort=(1.0, 2.0)),
        "the message has 3 names, 3 positions, 3 velocities, 2 efforts",
    ),
    "nothing": (list, "has no topic of sensor_msgs/msg/JointState; it has no topic at all"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_a_bag_that_nothing_can_be_learnt_from_is_one_line(tmp_path, described, kind):
    make, said = REFUSED[kind]
    path = write_mcap(tmp_path / "r.mcap", make())
    with pytest.raises((LogError, ConfigError)) as refusal:
        read_recording(path, described)
    assert said in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_topic_of_the_map_that_a_bag_lacks_names_the_nearest(tmp_path):
    (tmp_path / "arm.urdf").write_text(ARM)
    (tmp_path / "map.toml").write_text('[arm]\nurdf = "arm.urdf"\n[bag]\ntopic = "/joint_state"\n')
    path = write_mcap(tmp_path / "r.mcap", states())
    with pytest.raises(ConfigError, match="did you mean '/joint_states'"):
        read_recording(path, read_map(tmp_path / "map.toml"))


def test_damaged_and_missing_bags_are_one_line(tmp_path, described):
    whole = write_mcap(tmp_path / "whole.mcap", states()).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "footer.mcap").write_bytes(whole[:-28] + (1 << 60).to_bytes(8, "little") + whole[-20:])
    (tmp_path / "head.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(40))
    (tmp_path / "folder").mkdir()
    (tmp_path / "other.db3").write_bytes(b"SQLite format 3\0" + bytes(100))
    for name, said in (
        ("cut.mcap", "`adacd-hil log recover` saves"),
        ("footer.mcap", "`adacd-hil log recover` saves"),
        ("head.bag", "can't be read"),
        ("folder", "has no metadata.yaml"),
        ("other.db3", "can't be read"),
    ):
        with pytest.raises(LogError) as refusal:
            read_recording(tmp_path / name, described)
        assert said in str(refusal.value)
        assert "\n" not in str(refusal.value)
