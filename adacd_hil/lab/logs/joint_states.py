"""sensor_msgs/JointState as others write it: any number of joints, whose names each message has.

Ours have two joints and one layout (`message_types.JOINT_STATE_DTYPE`). `rosbags` decodes all others.
"""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from adacd_hil.log.log_files import LogError
from adacd_hil.records import Vector

TYPE = "sensor_msgs/msg/JointState"
_FIELDS = ("position", "velocity", "effort")


class JointStateMessage(NamedTuple):
    """A message: its stamp, the joints' names, and their position, velocity, effort.

    Arrays are empty where it has none.
    """

    stamp_ns: int
    names: tuple[str, ...]
    position: Vector
    velocity: Vector
    effort: Vector


def decode_joint_state(payload: bytes, is_ros1: bool = False) -> JointStateMessage:
    """Return a decoded message of ROS 2 (CDR), or with is_ros1 of ROS 1. Raises LogError if it is invalid."""
    from rosbags.serde import SerdeError

    store = _store(is_ros1)
    decode = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
    try:
        message = decode(payload, TYPE)
    except SerdeError as error:
        raise LogError(str(error)) from None
    stamp = message.header.stamp
    values = (getattr(message, field) for field in _FIELDS)
    return JointStateMessage(stamp.sec * 1_000_000_000 + stamp.nanosec, tuple(message.name), *values)


def is_joint_state(payload: bytes) -> bool:
    """Return whether `decode_joint_state` decodes a payload of ROS 2."""
    try:
        decode_joint_state(payload)
    except LogError:
        return False
    return True


def joint_state_columns(payloads: Iterable[bytes]) -> Iterator[tuple[tuple[str, ...], dict[str, Any]]]:
    """Yield the joints' names and a table of columns for each list of joints in messages of ROS 2.

    Columns: `t_ns` of the stamp, and `position_NAME`, `velocity_NAME`, `effort_NAME`; nan in a row whose message hasn't
    one for each joint. Invalid payloads and messages without names are left out.
    """
    groups: dict[tuple[str, ...], list[JointStateMessage]] = {}
    for payload in payloads:
        with suppress(LogError):
            message = decode_joint_state(payload)
            if message.names:
                groups.setdefault(message.names, []).append(message)
    for names, messages in groups.items():
        columns: dict[str, Any] = {"t_ns": np.array([message.stamp_ns for message in messages], np.int64)}
        for field in _FIELDS:
            table = np.array([_filled(getattr(message, field), len(names)) for message in messages])
            columns |= {f"{field}_{name}": table[:, joint] for joint, name in enumerate(names)}
        yield names, columns


def _filled(values: Vector, count: int) -> Vector:
    return values if len(values) == count else np.full(count, np.nan)


@cache
def _store(is_ros1: bool) -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)
