"""A log in memory: one structured array per topic, frames in the order of the bus, events, contacts, attachments.

Cut and damaged files are read as far as they are intact; `is_complete` and `problem` say so.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from adacd_hil.log.cdr import MessageType
from adacd_hil.log.channels import DECODED, run_channels, truth_channels
from adacd_hil.log.errors import LogError
from adacd_hil.log.joined import JoinedWalk
from adacd_hil.log.mcap_file import FIELDS_KEY
from adacd_hil.log.mcap_walk import MESSAGE_HEAD, RECORD_HEAD_BYTES, Payload, Topic
from adacd_hil.log.ros_types import (
    CAN_FRAME,
    CAN_FRAME_DTYPE,
    FD_FRAME,
    FD_FRAME_DTYPE,
    JOINT_STATE,
    JOINT_STATE_DTYPE,
    LOG,
    unpack_log,
)
from adacd_hil.records import (
    PARAMETER_NAMES,
    ContactKind,
    ContactLevel,
    ContactReport,
    Event,
    Location,
    Reaction,
    Vector,
)

EPOCH_KEY = "epoch_ns"
_KNOWN = {
    CAN_FRAME.name: Payload(CAN_FRAME_DTYPE),
    FD_FRAME.name: Payload(FD_FRAME_DTYPE, has_tail=True),
    JOINT_STATE.name: Payload(JOINT_STATE_DTYPE),
}
_FRAME_TOPICS = {
    "/to_can_bus": (True, "dlc"),
    "/from_can_bus": (False, "dlc"),
    "/to_can_bus_fd": (True, "len"),
    "/from_can_bus_fd": (False, "len"),
}
"""Topics of frames: whether they were sent, and the field that counts their data bytes."""
_NOT_FIELDS = ("record_length", "log_time", "publish_time", "sec", "nanosec")


def _frame_dtype(data_bytes: int) -> "np.dtype[Any]":
    return np.dtype(
        [
            ("t_ns", np.int64),  # when it passed
            ("cycle_t_ns", np.int64),  # t_ns of the cycle that it was logged with
            ("can_id", np.uint32),
            ("is_tx", np.bool_),
            ("is_error", np.bool_),
            ("length", np.uint8),  # so many bytes of the data count, the rest is zero
            ("data", np.uint8, (data_bytes,)),
        ]
    )


FRAME_DTYPE = _frame_dtype(8)
"""A frame of a log without FD frames."""
LONG_FRAME_DTYPE = _frame_dtype(64)
"""A frame of a log with FD frames, classic ones too: `data` (64,). All else is as in the other."""


class LoggedEvent(NamedTuple):
    """An event and when it happened."""

    t_ns: int
    event: Event


class LoggedContact(NamedTuple):
    """A contact report and when it was made."""

    t_ns: int
    report: ContactReport


class Series:
    """The messages of one topic: `series["tau_J"]` is float64 (n, 2), a copy of its own; a scalar field is (n,)."""

    def __init__(self, records: NDArray[Any], epoch_ns: int) -> None:
        self.records = records
        """The records as they are in the file (n,), structured."""
        self._epoch_ns = epoch_ns

    def __len__(self) -> int:
        return len(self.records)

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the fields, without the times."""
        return tuple(name for name in self.records.dtype.names or () if name not in _NOT_FIELDS)

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self.fields:
            raise KeyError(f"no field {name!r}; there are {', '.join(self.fields)}")
        return self.records[name].copy()

    @property
    def t_ns(self) -> NDArray[np.int64]:
        """Time of each message (n,), ns, of the clock of the run."""
        stamp_ns = self.records["sec"].astype(np.int64) * 1_000_000_000 + self.records["nanosec"]
        return np.asarray(stamp_ns - self._epoch_ns, np.int64)

    @property
    def block(self) -> Vector:
        """All float64 values of each message (n, k), in order: for our own topics the block as it was logged."""
        fields: Mapping[str, Any] = self.records.dtype.fields or {}
        offsets = [int(fields[name][1]) for name in self.fields if fields[name][0].base == np.dtype("<f8")]
        if not offsets:
            return np.empty((len(self), 0))
        return self._rows()[:, min(offsets) :].copy().view(np.float64)

    def payloads(self) -> bytes:
        """Return the payloads of all messages, one after the other."""
        rows = self._rows()
        ends = self.records["record_length"] + RECORD_HEAD_BYTES
        if (ends == self.records.dtype.itemsize).all():
            return rows[:, MESSAGE_HEAD:].tobytes()
        return b"".join(row[MESSAGE_HEAD:end].tobytes() for row, end in zip(rows, ends.tolist(), strict=True))

    def _rows(self) -> NDArray[np.uint8]:
        return np.ascontiguousarray(self.records).view(np.uint8).reshape(len(self), self.records.dtype.itemsize)


@dataclass(frozen=True)
class RunLog:
    """A log, all its parts as one. Topics that it lacks are empty."""

    path: Path
    problem: str  # what is missing, one line; "" for a whole file
    metadata: dict[str, str]  # of the run
    summary: dict[str, str]  # frames, messages, dropped, ending, as far as the parts have their ends
    attachments: dict[str, bytes]
    topics: Mapping[str, Series]
    decoded: Mapping[str, Series]  # by DBC message
    frames: NDArray[Any]  # (n,) of FRAME_DTYPE or LONG_FRAME_DTYPE, both ways, in the order of the bus
    events: list[LoggedEvent]
    contacts: list[LoggedContact]
    parts: int  # files that it was read from

    @property
    def is_complete(self) -> bool:
        """Whether the file is whole and no packet was dropped on the way to it."""
        return not self.problem and self.summary.get("dropped", "0") == "0"

    @property
    def epoch_ns(self) -> int:
        """What was added to t_ns for the times of the file."""
        return _number(self.metadata, EPOCH_KEY, 0)

    @property
    def scheme(self) -> Series:
        """What the scheme decided, records.scheme_layout."""
        return self.topics["/scheme"]

    @property
    def control(self) -> Series:
        """What was desired and commanded, records.CONTROL_LAYOUT."""
        return self.topics["/control"]

    @property
    def cycle(self) -> Series:
        """How the cycles went, records.CycleRecord."""
        return self.topics["/cycle"]

    @property
    def truth(self) -> Series:
        """What the emulator knows, records.TRUTH_LAYOUT."""
        return self.topics["/truth"]


def read_log(path: Path, topics: Collection[str] | None = None) -> RunLog:
    """Read the log whose first part is `path`, with all its parts, of the messages only those of `topics` when given.

    Raises LogError when the file doesn't exist or isn't MCAP.
    """
    walk = JoinedWalk(path, _payload_layout, topics)
    metadata = walk.metadata
    epoch_ns = _number(metadata, EPOCH_KEY, 0)
    series = _all_series(walk.topics, metadata, epoch_ns)
    return RunLog(
        path=path,
        problem=walk.problem,
        metadata=metadata,
        summary=walk.summary,
        attachments=walk.attachments,
        topics=series,
        decoded={name.removeprefix(DECODED): values for name, values in series.items() if name.startswith(DECODED)},
        frames=_frames(walk.topics, series, epoch_ns),
        events=_events(walk.topics.get("/events"), epoch_ns),
        contacts=_contacts(series["/contact"]),
        parts=walk.parts,
    )


def topic_bytes(path: Path, topic: str) -> bytes:
    """Return the payloads of a topic, one after the other: equal for two logs that hold the same, bit for bit.

    Raises LogError when the file can't be read or lacks the topic.
    """
    found = JoinedWalk(path, _payload_layout, (topic,)).topics.get(topic)
    if found is None:
        raise LogError(f"log {path} has no topic {topic}")
    return b"".join(found.payloads) if found.dtype is None else Series(found.records(), 0).payloads()


def _payload_layout(channel: Channel, schema: Schema) -> Payload | None:
    try:
        text = schema.data.decode("utf-8")
    except UnicodeDecodeError:
        return None
    return _own_layout(MessageType(schema.name, text, tuple(channel.metadata.get(FIELDS_KEY, "").split())))


def _own_layout(message_type: MessageType) -> Payload | None:
    """Describe payloads as we write them; None where their size varies."""
    if message_type.name in _KNOWN:
        return _KNOWN[message_type.name]
    try:
        return Payload(message_type.dtype)
    except LogError:
        return None


def _number(metadata: Mapping[str, str], key: str, default: int) -> int:
    try:
        return int(metadata.get(key, default))
    except ValueError:
        raise LogError(f"the log's metadata {key} = {metadata[key]!r} is not a number") from None


def _all_series(topics: Mapping[str, Topic], metadata: Mapping[str, str], epoch_ns: int) -> dict[str, Series]:
    """Make a series of each topic of fixed size: our own ones, present or not, and the decoded ones."""
    parameter_count = _number(metadata, "parameter_count", len(PARAMETER_NAMES))
    series = {}
    for channel in (*run_channels(parameter_count), *truth_channels()):
        topic = topics.get(channel.topic)
        if topic is None or topic.type_name != channel.type.name:
            topic = Topic(channel.type.name, _own_layout(channel.type))
        if topic.dtype is not None:
            series[channel.topic] = Series(topic.records(), epoch_ns)
    for name, topic in topics.items():
        if name.startswith(DECODED) and topic.dtype is not None:
            series[name] = Series(topic.records(), epoch_ns)
    return series


def _frames(topics: Mapping[str, Topic], series: Mapping[str, Series], epoch_ns: int) -> NDArray[Any]:
    parts, places = [], []
    has_long = any(len(series[name]) for name, (_, length) in _FRAME_TOPICS.items() if length == "len")
    dtype = LONG_FRAME_DTYPE if has_long else FRAME_DTYPE
    for name, (is_tx, length) in _FRAME_TOPICS.items():
        source = series[name]
        if not len(source):
            continue
        part = np.zeros(len(source), dtype)
        part["t_ns"] = source.t_ns
        part["cycle_t_ns"] = source.records["publish_time"].astype(np.int64) - epoch_ns
        part["is_tx"] = is_tx
        part["length"] = source.records[length]
        part["can_id"] = source.records["can_id"]
        part["is_error"] = source.records["is_error"]
        data = source.records["data"]
        part["data"][:, : data.shape[1]] = data
        parts.append(part)
        places.append(topics[name].place())
    if not parts:
        return np.zeros(0, FRAME_DTYPE)
    return np.concatenate(parts)[np.argsort(np.concatenate(places), kind="stable")]


def _events(topic: Topic | None, epoch_ns: int) -> list[LoggedEvent]:
    if topic is None or topic.type_name != LOG.name:
        return []
    events = []
    for payload in topic.payloads:
        sec, nanosec = np.frombuffer(payload, "<u4", 2, 4).tolist()
        events.append(LoggedEvent(sec * 1_000_000_000 + nanosec - epoch_ns, unpack_log(payload)))
    return events


_CONTACT_TYPES: dict[str, Callable[[Any], Any]] = {
    **dict.fromkeys(ContactReport._fields, float),
    **dict.fromkeys(("cycle", "link"), int),
    **dict.fromkeys(("is_final", "is_two_sided"), bool),
    **dict.fromkeys(("direction", "tau_ext_peak", "impulse", "tau_ext_peak_sigma", "impulse_sigma"), tuple),
    "level": ContactLevel,
    "kind": ContactKind,
    "reaction": Reaction,
    "location": Location,
}
"""What each field of a report is made of the number or list that the log has."""


def _contacts(series: Series) -> list[LoggedContact]:
    contacts = []
    names = [name for name in ContactReport._fields if name in series.fields]  # an older log has fewer
    for t_ns, record in zip(series.t_ns.tolist(), series.records, strict=True):
        report = ContactReport(**{name: _CONTACT_TYPES[name](record[name].tolist()) for name in names})
        contacts.append(LoggedContact(t_ns, report))
    return contacts
