"""A recording in an MCAP file or a rosbag: sensor_msgs/JointState of any number of joints, found by their names.

Messages of other joints, as of a gripper that publishes on the same topic, are skipped.
"""

import math
from collections.abc import Mapping
from pathlib import Path

from adacd_hil.lab.logs.joint_state_bags import JOINT_STATES, joint_state_topics, opened_bag
from adacd_hil.lab.logs.joint_states import TYPE
from adacd_hil.lab.offline.recorded_columns import RecordedColumns, RecordedRows
from adacd_hil.lab.offline.recording_map import RecordingMap
from adacd_hil.log.log_files import LogError
from adacd_hil.log.time_window import TimeWindow
from adacd_hil.remedies import hint
from adacd_hil.settings.schema import ConfigError


def read_bag(path: Path, described: RecordingMap, span: TimeWindow | None) -> RecordedColumns:
    """Read the positions, efforts and velocities of the map's joints from the messages of a bag that name all of them.

    Velocities are left out unless all read messages have them. Messages whose arrays don't fit their names are dropped
    and counted. Times count from the first read message. span: as of `RecordedRows`; reading ends behind it. Raises
    LogError if the bag can't be read, the joints are never in one message, a joint has no effort in any message, or as
    `RecordedRows.columns`. Raises ConfigError if the bag lacks a topic or a joint, or all stamps are 0 although
    `bag.time` is "header".
    """
    wanted = described.columns.q or described.urdf.joint_names
    places: dict[tuple[str, ...], list[int] | None] = {}
    has_velocities, has_stamps, lacking = True, False, set(wanted)
    is_stamped = described.bag.time == "header"
    first_ns: int | None = None
    with opened_bag(path) as (topics, read_messages):
        topic = _topic(path, topics, described.bag.topic)
        read = RecordedRows(path, 1 + 3 * len(wanted), 1.0, span)
        for number, (received_ns, message) in enumerate(read_messages(topic), start=1):
            names, arrays = message.names, (message.position, message.effort, message.velocity)
            if names not in places:
                places[names] = [names.index(name) for name in wanted] if set(wanted) <= set(names) else None
            found = places[names]
            if found is None:
                continue
            sizes = [len(values) for values in arrays]
            if sizes[0] != len(names) or any(size not in (0, len(names)) for size in sizes[1:]):
                named = f"{len(names)} names, {sizes[0]} positions, {sizes[2]} velocities, {sizes[1]} efforts"
                read.drop("that can't be read", f"row {number}: the message has {named}")
                continue
            row = [float(values[place]) if len(values) else math.nan for values in arrays for place in found]
            has_velocities &= sizes[2] == len(names)
            has_stamps |= message.stamp_ns != 0
            if lacking:
                efforts = zip(wanted, row[len(wanted) : 2 * len(wanted)], strict=True)
                lacking -= {name for name, effort in efforts if not math.isnan(effort)}
            time_ns = message.stamp_ns if is_stamped else received_ns
            first_ns = time_ns if first_ns is None else first_ns
            read.append(number, [(time_ns - first_ns) * 1e-9, *row])
            if read.is_past_span:
                break
    where = f"recording {path}, {topic}"
    _check_names(where, wanted, places)
    if read.count and lacking:
        without = ", ".join(name for name in wanted if name in lacking)
        raise LogError(f"{where} has no effort of {without}: torques are needed")
    if is_stamped and read.count and not has_stamps:
        raise ConfigError(f'{where}: all stamps are 0; `bag.time` = "received" takes when it was recorded')
    return read.columns(described, [*wanted] * (3 if has_velocities else 2))


def _topic(path: Path, topics: Mapping[str, str], wanted: str) -> str:
    """Return the topic to read: `wanted`, else /joint_states, else the only one of JointState.

    Raises ConfigError if the bag lacks `wanted`, has no topic of JointState, or has several and none is /joint_states.
    """
    found = joint_state_topics(topics)
    if wanted:
        if wanted in found:
            return wanted
        raise ConfigError(f"recording {path} has no topic {wanted} of {TYPE}; {hint(wanted, found)}")
    if not found:
        there = ", ".join(f"{topic} ({kind})" for topic, kind in list(topics.items())[:6]) or "no topic at all"
        raise ConfigError(f"recording {path} has no topic of {TYPE}; it has {there}")
    if len(found) > 1 and JOINT_STATES not in found:
        raise ConfigError(f"recording {path} has joint states on {', '.join(found)}: choose one by `bag.topic`")
    return JOINT_STATES if JOINT_STATES in found else found[0]


def _check_names(where: str, wanted: tuple[str, ...], places: Mapping[tuple[str, ...], list[int] | None]) -> None:
    """Raise LogError or ConfigError if no message has all wanted joints.

    LogError if there are no messages, or all joints are named, but never in one message. ConfigError if one of the
    joints is named in no message. where: recording and topic. places: by the names of each kind of message, None if one
    of the joints is missing.
    """
    if not places:
        raise LogError(f"{where} has no messages")
    if any(found is not None for found in places.values()):
        return
    there = dict.fromkeys(name for names in places for name in names)
    lacking = next((name for name in wanted if name not in there), None)
    if lacking is None:
        raise LogError(
            f"{where}: no message has all of {', '.join(wanted)}; record a topic that joins them, as of "
            "joint_state_publisher with `source_list`"
        )
    raise ConfigError(f"{where} has no joint {lacking!r}; {hint(lacking, there)} (`columns.q` names them)")
