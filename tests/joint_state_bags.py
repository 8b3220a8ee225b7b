"""Bags of sensor_msgs/JointState as recorders write them: MCAP by `mcap`, bags of ROS 1 and 2 by `rosbags`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

TYPE = "sensor_msgs/msg/JointState"
START_NS = 1_712_000_000_123_456_789
ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.LATEST)


class State(NamedTuple):
    """A message: its time since the first, its joints, and what it says of each; empty: nothing."""

    t_s: float
    names: Sequence[str]
    position: Sequence[float]
    velocity: Sequence[float] = ()
    effort: Sequence[float] = ()
    topic: str = "/joint_states"
    is_stamped: bool = True


def _message(store: Any, state: State, number: int) -> Any:
    stamp_ns = START_NS + round(state.t_s * 1e9) if state.is_stamped else 0
    time = store.types["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9)
    count = {"seq": number} if store is ROS1 else {}
    header = store.types["std_msgs/msg/Header"](stamp=time, frame_id="base", **count)
    values = (np.array(each, np.float64) for each in (state.position, state.velocity, state.effort))
    return store.types[TYPE](header, list(state.names), *values)


def _received_ns(state: State) -> int:
    return START_NS + round(state.t_s * 1e9) + 300_000


def write_mcap(path: Path, states: Sequence[State], profile: str = "ros2", has_index: bool = True) -> Path:
    """Write an MCAP file; without an index as a recorder that streams."""
    with path.open("wb") as file:
        writer = McapWriter(file, use_chunking=has_index, use_statistics=has_index, use_summary_offsets=has_index)
        writer.start(profile=profile, library="a test")
        schema = writer.register_schema(TYPE, "ros2msg", ROS2.generate_msgdef(TYPE, ros_version=2)[0].encode())
        topics = dict.fromkeys(state.topic for state in states)
        channels = {topic: writer.register_channel(topic, "cdr", schema) for topic in topics}
        for number, state in enumerate(states):
            data = ROS2.serialize_cdr(_message(ROS2, state, number), TYPE)
            writer.add_message(channels[state.topic], _received_ns(state), data, _received_ns(state), number)
        writer.finish()
    return path


def write_rosbag2(path: Path, states: Sequence[State], storage: StoragePlugin = StoragePlugin.SQLITE3) -> Path:
    """Write the folder of a bag of ROS 2."""
    with Writer2(path, version=9, storage_plugin=storage) as writer:
        topics = dict.fromkeys(state.topic for state in states)
        connections = {topic: writer.add_connection(topic, TYPE, typestore=ROS2) for topic in topics}
        for number, state in enumerate(states):
            data = ROS2.serialize_cdr(_message(ROS2, state, number), TYPE)
            writer.write(connections[state.topic], _received_ns(state), data)
    return path


def write_rosbag1(path: Path, states: Sequence[State]) -> Path:
    """Write a bag of ROS 1."""
    with Writer1(path) as writer:
        topics = dict.fromkeys(state.topic for state in states)
        connections = {topic: writer.add_connection(topic, TYPE, typestore=ROS1) for topic in topics}
        for number, state in enumerate(states):
            data = ROS1.serialize_ros1(_message(ROS1, state, number), TYPE)
            writer.write(connections[state.topic], _received_ns(state), data)
    return path
