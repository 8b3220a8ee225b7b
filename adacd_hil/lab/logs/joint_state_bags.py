"""Bags of sensor_msgs/JointState: MCAP files by `mcap`, the bags of ROS 1 and ROS 2 by `rosbags`; neither needs ROS."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Final

from adacd_hil.file_access import open_input
from adacd_hil.lab.logs.joint_states import TYPE, JointStateMessage, decode_joint_state
from adacd_hil.log.log_files import LOG_NAME, SUFFIX, LogError
from adacd_hil.log.mcap.record_layout import MAGIC
from adacd_hil.settings.schema import ConfigError

JOINT_STATES: Final = "/joint_states"
_BAG_MAGIC: Final = b"#ROSBAG V"
_SQLITE_MAGIC: Final = b"SQLite format 3\0"


Bag = tuple[Mapping[str, str], Callable[[str], Iterator[tuple[int, JointStateMessage]]]]
"""The type of each topic, and a function that reads the messages of one, with when they were recorded, ns."""


def is_bag(path: Path) -> bool:
    """Return whether a path is a folder, or a file that begins as MCAP, a bag of ROS 1 or a database of ROS 2.

    False if it can't be read.
    """
    if path.is_dir():
        return True
    try:
        with open_input(path) as file:
            return file.peek(16).startswith((MAGIC, _BAG_MAGIC, _SQLITE_MAGIC))
    except OSError:
        return False  # its reader raises the reason


@contextmanager
def opened_bag(path: Path) -> Iterator[Bag]:
    """Open a bag while the block lasts; yield its topics with types, and a function that reads one topic.

    Any error of its reader or of the block becomes a LogError; a LogError or ConfigError of the block passes.
    """
    try:
        begin = b""
        if not path.is_dir():
            with open_input(path) as file:
                begin = file.peek(16)
        elif not (path / "metadata.yaml").is_file():
            instead = f"; name {path / LOG_NAME}" if (path / LOG_NAME).is_file() else ""
            raise LogError(f"folder {path} is no rosbag: it has no metadata.yaml{instead}")
        is_ros1 = begin.startswith(_BAG_MAGIC)
        with _opened_mcap(path) if begin.startswith(MAGIC) else _opened_rosbag(path, is_ros1) as bag:
            yield bag
    except (LogError, ConfigError):
        raise
    except Exception as error:  # damaged bytes can raise any error, that of a seek too
        if isinstance(error, OSError) and error.filename is not None:
            raise LogError(f"recording {path}: {error.strerror or error}") from None
        remedy = "; `adacd-hil log recover` saves what is left of a cut MCAP file" if path.suffix == SUFFIX else ""
        reason = " ".join(str(error).split()) or type(error).__name__
        raise LogError(f"recording {path} can't be read: {reason}{remedy}") from None


@contextmanager
def _opened_mcap(path: Path) -> Iterator[Bag]:
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

        yield topics, messages


@contextmanager
def _opened_rosbag(path: Path, is_ros1: bool) -> Iterator[Bag]:
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    reader: Any = Reader1(path) if is_ros1 else Reader2(path)
    reader.open()
    with closing(reader):

        def messages(topic: str) -> Iterator[tuple[int, JointStateMessage]]:
            connections = [each for each in reader.connections if each.topic == topic]
            for _, received_ns, data in reader.messages(connections=connections):
                yield received_ns, decode_joint_state(data, is_ros1)

        yield {each.topic: each.msgtype for each in reader.connections}, messages


def joint_state_topics(topics: Mapping[str, str]) -> list[str]:
    """Return the topics with type sensor_msgs/JointState, spelt with or without "msg/"; topics: type by name."""
    return [topic for topic, kind in topics.items() if kind.replace("/msg/", "/") == TYPE.replace("/msg/", "/")]
