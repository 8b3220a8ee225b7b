"""A recording in an MCAP file or a rosbag: sensor_msgs/JointState of any number of joints, found by their names.

Messages of other joints, as of a gripper that publishes on the same topic, are skipped.
"""

import math
from collections.abc import Mapping
from pathlib import Path

from adacd_hil.lab.logs.joint_state_bags import JOINT_STATES, joint_state_topics, opened_bag
from adacd_hil.lab.logs.joint_states import TYPE, JointStateMessage
from adacd_hil.lab.offline.recorded_columns import RecordedColumns, RecordedRows
from adacd_hil.lab.offline.recording_map import RecordingMap
from adacd_hil.log.log_files import LogError
from adacd_hil.log.time_window import TimeWindow
from adacd_hil.remedies import nearest_name
from adacd_hil.settings.schema import ConfigError


def read_bag(path: Path, described: RecordingMap, span: TimeWindow | None) -> RecordedColumns:
    """Read positions, efforts and, if all messages have them, velocities of the map's joints from a bag.

    span: as of `RecordedRows`. Raises LogError if the bag can't be read or has no efforts, ConfigError if it lacks a
    topic or a joint, or the wanted stamps are all 0.
    """
    wanted = described.columns.q or described.urdf.joint_names
    with opened_bag(path) as (topics, read_messages):
        topic = _topic(path, topics, described.bag.topic)
        states = _States(path, topic, wanted)
        read = RecordedRows(path, 1 + 3 * len(wanted), 1.0, span)
        is_stamped = described.bag.time == "header"
        first_ns: int | None = None
        for number, (received_ns, message) in enumerate(read_messages(topic), start=1):
            if row := states.read(number, message, read):
                time_ns = message.stamp_ns if is_stamped else received_ns
                first_ns = time_ns if first_ns is None else first_ns
                read.append(number, [(time_ns - first_ns) * 1e-9, *row])
            if read.is_past_span:
                break
    states.check(is_stamped)
    names = [*wanted] * (3 if states.has_velocities else 2)
    return read.columns(described, names)


def _topic(path: Path, topics: Mapping[str, str], wanted: str) -> str:
    """Return the topic to read: `wanted`, else /joint_states, else the only one of JointState.

    Raises ConfigError if the bag lacks `wanted`, has no topic of JointState, or has several and none is /joint_states.
    """
    found = joint_state_topics(topics)
    if wanted:
        if wanted in found:
            return wanted
        near = nearest_name(wanted, found)
        known = f"did you mean {near}?" if near else f"there are {', '.join(found) or 'none'}"
        raise ConfigError(f"recording {path} has no topic {wanted} of {TYPE}; {known}")
    if not found:
        there = ", ".join(f"{topic} ({kind})" for topic, kind in list(topics.items())[:6]) or "no topic at all"
        raise ConfigError(f"recording {path} has no topic of {TYPE}; it has {there}")
    if len(found) > 1 and JOINT_STATES not in found:
        raise ConfigError(f"recording {path} has joint states on {', '.join(found)}: choose one by `bag.topic`")
    return JOINT_STATES if JOINT_STATES in found else found[0]


class _States:
    """Finds the wanted joints in each message, whatever their order, and notes anything that the messages lack."""

    def __init__(self, path: Path, topic: str, wanted: tuple[str, ...]) -> None:
        self.has_velocities = True
        self._where = f"recording {path}, {topic}"
        self._wanted = wanted
        self._places: dict[tuple[str, ...], list[int] | None] = {}
        self._messages = self._taken = 0
        self._has_stamps = False
        self._lacks_effort: set[str] = set(wanted)

    def read(self, number: int, message: JointStateMessage, into: RecordedRows) -> list[float] | None:
        """Return positions, efforts and velocities of the wanted joints; None if the message lacks one of the joints.

        Missing efforts or velocities are nan. A message with arrays of wrong lengths gives None, too, and is counted in
        `into`. number: of the message, from 1.
        """
        self._messages += 1
        places = self._places.setdefault(message.names, self._find(message.names))
        if places is None:
            return None
        count = len(message.names)
        arrays = (message.position, message.effort, message.velocity)
        sizes = [len(values) for values in arrays]
        if sizes[0] != count or any(size not in (0, count) for size in sizes[1:]):
            named = f"{count} names, {sizes[0]} positions, {sizes[2]} velocities, {sizes[1]} efforts"
            into.drop("that can't be read", f"row {number}: the message has {named}")
            return None
        self._taken += 1
        self._has_stamps |= message.stamp_ns != 0
        self.has_velocities &= sizes[2] == count
        row = [float(values[p]) if len(values) else math.nan for values in arrays for p in places]
        if self._lacks_effort:
            efforts = row[len(places) : 2 * len(places)]
            self._lacks_effort -= {
                name for name, effort in zip(self._wanted, efforts, strict=True) if not math.isnan(effort)
            }
        return row

    def check(self, is_stamped: bool) -> None:
        """Raise LogError or ConfigError if the messages read so far can't be used. Call it after all `read`s.

        LogError if there are no messages, none has all joints together, or a joint never has an effort; ConfigError if
        no message names a joint, or if is_stamped and all stamps are 0.
        """
        if not self._messages:
            raise LogError(f"{self._where} has no messages")
        if all(places is None for places in self._places.values()):
            there = dict.fromkeys(name for names in self._places for name in names)
            lacking = next((name for name in self._wanted if name not in there), None)
            if lacking is None:
                raise LogError(
                    f"{self._where}: no message has all of {', '.join(self._wanted)}; record a topic that joins them, "
                    "as of joint_state_publisher with `source_list`"
                )
            near = nearest_name(lacking, there)
            known = f"did you mean {near!r}?" if near else f"it has {', '.join(there) or 'no names'}"
            raise ConfigError(f"{self._where} has no joint {lacking!r}; {known} (`columns.q` names them)")
        if self._taken and self._lacks_effort:
            names = ", ".join(name for name in self._wanted if name in self._lacks_effort)
            raise LogError(f"{self._where} has no effort of {names}: torques are needed")
        if is_stamped and self._taken and not self._has_stamps:
            raise ConfigError(f'{self._where}: all stamps are 0; `bag.time` = "received" takes when it was recorded')

    def _find(self, names: tuple[str, ...]) -> list[int] | None:
        """Return the index of each wanted joint among a message's names; None if one is missing."""
        return [names.index(name) for name in self._wanted] if set(self._wanted) <= set(names) else None
