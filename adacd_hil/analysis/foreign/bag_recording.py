"""A recording in an MCAP file or a rosbag: sensor_msgs/JointState of any number of joints, found by their names.

`mcap` reads MCAP files, `rosbags` the bags of ROS 1 and ROS 2; neither needs ROS. Messages of other joints, as of a
gripper that publishes on the same topic, are passed over.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

from adacd_hil.analysis.foreign.recorded_columns import RecordedColumns, RecordedRows
from adacd_hil.analysis.foreign.recording_map import RecordingMap
from adacd_hil.file_access import open_input
from adacd_hil.log.log_files import LogError, TimeWindow
from adacd_hil.log.types.joint_states import TYPE, JointStateMessage, decode_joint_state
from adacd_hil.remedies import nearest_name
from adacd_hil.settings.schema import ConfigError

JOINT_STATES: Final = "/joint_states"
_MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
_BAG_MAGIC: Final = b"#ROSBAG V"
_SQLITE_MAGIC: Final = b"SQLite format 3\0"


class _Bag(NamedTuple):
    """What is in a bag: the type of each topic, and how messages of one are read."""

    topics: Mapping[str, str]
    messages: Callable[[str], Iterator[tuple[int, JointStateMessage]]]  # with when they were recorded, ns


def is_bag(path: Path) -> bool:
    """Tell whether a path is a bag: a folder, an MCAP file, one of ROS 1, or the database of ROS 2."""
    if path.is_dir():
        return True
    try:
        with open_input(path) as file:
            return file.peek(16).startswith((_MCAP_MAGIC, _BAG_MAGIC, _SQLITE_MAGIC))
    except OSError:
        return False  # who reads it says why it can't be


def read_bag(path: Path, described: RecordingMap, span: TimeWindow | None) -> RecordedColumns:
    """Read positions, efforts and, where all messages have them, velocities.

    Raises LogError when the bag can't be read or has no efforts, ConfigError when it lacks a topic or a joint.
    """
    wanted = described.columns.q or described.urdf.joint_names
    with opened_bag(path) as bag:
        topic = _topic(path, bag.topics, described.bag.topic)
        states = _States(path, topic, wanted)
        read = RecordedRows(path, 1 + 3 * len(wanted), 1.0, span)
        is_stamped = described.bag.time == "header"
        first_ns: int | None = None
        for number, (received_ns, message) in enumerate(bag.messages(topic), start=1):
            if row := states.read(number, message, read):
                time_ns = message.stamp_ns if is_stamped else received_ns
                first_ns = time_ns if first_ns is None else first_ns
                read.append(number, [(time_ns - first_ns) * 1e-9, *row])
            if read.is_past_span:
                break
    states.check(is_stamped)
    names = [*wanted] * (3 if states.has_velocities else 2)
    return read.columns(described, names)


@contextmanager
def opened_bag(path: Path) -> Iterator[_Bag]:
    """Open a bag. Raises LogError for whatever its reader raises."""
    try:
        if not path.is_dir():
            with open_input(path) as file:
                is_mcap, is_ros1 = (file.peek(16).startswith(magic) for magic in (_MCAP_MAGIC, _BAG_MAGIC))
            with _opened_mcap(path) if is_mcap else _opened_rosbag(path, is_ros1) as bag:
                yield bag
        else:
            if not (path / "metadata.yaml").is_file():
                raise LogError(f"folder {path} is no rosbag: it has no metadata.yaml")
            with _opened_rosbag(path, is_ros1=False) as bag:
                yield bag
    except (LogError, ConfigError):
        raise
    except OSError as error:
        raise LogError(f"recording {path}: {error.strerror or error}") from None
    except Exception as error:  # whatever a reader makes of damaged bytes
        remedy = "; `adacd-hil log recover` saves what is left of a cut MCAP file" if path.suffix == ".mcap" else ""
        reason = " ".join(str(error).split()) or type(error).__name__
        raise LogError(f"recording {path} can't be read: {reason}{remedy}") from None


@contextmanager
def _opened_mcap(path: Path) -> Iterator[_Bag]:
    from mcap.reader import make_reader

    with open_input(path) as file:
        topics: dict[str, str] = {}
        summary = make_reader(file).get_summary()
        if summary is None or not summary.channels:
            for schema, channel, _ in make_reader(file).iter_messages(log_time_order=False):
                topics.setdefault(channel.topic, schema.name if schema else "")
        else:
            for channel in summary.channels.values():
                known = summary.schemas.get(channel.schema_id)
                is_cdr = channel.message_encoding == "cdr"
                topics[channel.topic] = known.name if known and is_cdr else channel.message_encoding

        def messages(topic: str) -> Iterator[tuple[int, JointStateMessage]]:
            for _, _, message in make_reader(file).iter_messages(topics=[topic], log_time_order=False):
                yield message.log_time, decode_joint_state(message.data)

        yield _Bag(topics, messages)


@contextmanager
def _opened_rosbag(path: Path, is_ros1: bool) -> Iterator[_Bag]:
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    reader: Any = Reader1(path) if is_ros1 else Reader2(path)
    reader.open()
    with closing(reader):

        def messages(topic: str) -> Iterator[tuple[int, JointStateMessage]]:
            connections = [each for each in reader.connections if each.topic == topic]
            for _, received_ns, data in reader.messages(connections=connections):
                yield received_ns, decode_joint_state(data, is_ros1)

        yield _Bag({each.topic: each.msgtype for each in reader.connections}, messages)


def joint_state_topics(topics: Mapping[str, str]) -> list[str]:
    """List the topics of joint states."""
    return [topic for topic, kind in topics.items() if kind.replace("/msg/", "/") == TYPE.replace("/msg/", "/")]


def _topic(path: Path, topics: Mapping[str, str], wanted: str) -> str:
    """Choose the topic. Raises ConfigError."""
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
        raise ConfigError(f"recording {path} has joint states on {', '.join(found)}: `bag.topic` says which")
    return JOINT_STATES if JOINT_STATES in found else found[0]


class _States:
    """Finds the joints in each message, in whatever order it names them."""

    def __init__(self, path: Path, topic: str, wanted: tuple[str, ...]) -> None:
        self.has_velocities = True
        self._where = f"recording {path}, {topic}"
        self._wanted = wanted
        self._places: dict[tuple[str, ...], list[int] | None] = {}
        self._messages = self._taken = 0
        self._has_stamps = False
        self._lacks_effort: set[str] = set(wanted)

    def read(self, number: int, message: JointStateMessage, into: RecordedRows) -> list[float] | None:
        """Return positions, efforts and velocities of the joints that are wanted; None where they aren't in it."""
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
        """Refuse a topic without the joints, without efforts, or without stamps. Raises LogError, ConfigError."""
        if not self._messages:
            raise LogError(f"{self._where} has no messages")
        if all(places is None for places in self._places.values()):
            there = dict.fromkeys(name for names in self._places for name in names)
            lacking = next((name for name in self._wanted if name not in there), self._wanted[0])
            near = nearest_name(lacking, there)
            known = f"did you mean {near!r}?" if near else f"it has {', '.join(there) or 'no names'}"
            raise ConfigError(f"{self._where} has no joint {lacking!r}; {known} (`columns.q` names them)")
        if self._taken and self._lacks_effort:
            names = ", ".join(name for name in self._wanted if name in self._lacks_effort)
            raise LogError(f"{self._where} has no effort of {names}: without a torque nothing can be explained")
        if is_stamped and self._taken and not self._has_stamps:
            raise ConfigError(f'{self._where}: all stamps are 0; `bag.time` = "received" takes when it was recorded')

    def _find(self, names: tuple[str, ...]) -> list[int] | None:
        return [names.index(name) for name in self._wanted] if set(self._wanted) <= set(names) else None
