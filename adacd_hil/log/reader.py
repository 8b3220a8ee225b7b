"""A log as a stream of pieces (`LogStream`), or as one piece (`read_log`).

A piece has one structured array per topic, frames in the order of the bus, and events. Cut and damaged files are read
as far as they are intact; `is_complete` and `problem` report the damage.

On two processors one reads, checks and decompresses ahead while the other gathers the messages; topics outside the
request cost only their decompression.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from adacd_hil.log.log_files import EPOCH_KEY, FIELDS_KEY, LogError
from adacd_hil.log.log_parts import DROPPED_KEY, LOST_KEY, log_in
from adacd_hil.log.log_walk import LogWalk
from adacd_hil.log.mcap.record_layout import record_dtype
from adacd_hil.log.types.message_types import (
    CAN_FRAME,
    CAN_FRAME_DTYPE,
    FD_FRAME,
    FD_FRAME_DTYPE,
    JOINT_STATE,
    JOINT_STATE_DTYPE,
    LOG,
    MessageType,
)
from adacd_hil.log.types.record_arrays import FRAME_DTYPE, FRAME_TOPICS, LONG_FRAME_DTYPE, Topic
from adacd_hil.log.types.topics import CONTACT, CONTROL, CYCLE, DECODED, EVENTS, SCHEME, run_channels
from adacd_hil.log.types.truth_topic import TRUTH, truth_channels
from adacd_hil.log.types.unpacking import contact_report, log_time_ns, unpack_log
from adacd_hil.records import (
    PARAMETER_NAMES,
    ContactReport,
    Event,
    FaultReason,
    SchemeState,
    Vector,
)

__all__ = [
    "FRAME_DTYPE",
    "LONG_FRAME_DTYPE",
    "LoggedEvent",
    "RunLog",
    "Series",
    "read_log",
    "topic_bytes",
]

_KNOWN = {
    CAN_FRAME.name: CAN_FRAME_DTYPE,
    FD_FRAME.name: FD_FRAME_DTYPE,
    JOINT_STATE.name: JOINT_STATE_DTYPE,
}
_EVERY_CYCLE = 1 << 62
_NOT_FIELDS = ("record_length", "log_time", "publish_time", "sec", "nanosec")


class LoggedEvent(NamedTuple):
    """An event and when it was logged, ns on the clock of the run."""

    t_ns: int
    event: Event


class Series:
    """The messages of one topic: `series["tau_J"]` is float64 (n, 2), a copy; a field of one number is (n,).

    `series[name]` raises KeyError for an unknown field.
    """

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
        """Time of each message (n,), ns, on the clock of the run."""
        stamp_ns = self.records["sec"].astype(np.int64) * 1_000_000_000 + self.records["nanosec"]
        return np.asarray(stamp_ns - self._epoch_ns, np.int64)

    def part(self, rows: slice | NDArray[np.bool_]) -> "Series":
        """Return the messages in a slice, or those where a mask (n,) is True."""
        return Series(self.records[rows], self._epoch_ns)

    def between(self, first_ns: int, end_ns: int) -> "Series":
        """Return the messages with times from `first_ns` on and before `end_ns`."""
        t_ns = self.t_ns
        return self.part((t_ns >= first_ns) & (t_ns < end_ns))

    @property
    def block(self) -> Vector:
        """Float64 values of each message (n, k), from the first float64 field on: in our own topics the logged block.

        (n, 0) for a topic without float64 fields.
        """
        fields: Mapping[str, Any] = self.records.dtype.fields or {}
        offsets = [int(fields[name][1]) for name in self.fields if fields[name][0].base == np.dtype("<f8")]
        if not offsets:
            return np.empty((len(self), 0))
        rows = np.ascontiguousarray(self.records).view(np.uint8).reshape(len(self), self.records.dtype.itemsize)
        return rows[:, min(offsets) :].copy().view(np.float64)


@dataclass(frozen=True)
class RunLog:
    """A log, all its parts as one. `topics`: those of fixed size, each of ours, empty if the log lacks it.

    Bus frames, events and contacts have fields of their own.
    """

    path: Path
    problem: str  # what the log lacks, one line; "" for a whole log
    metadata: dict[str, str]  # of the run
    summary: dict[str, str]  # frames, messages, dropped, ending, as far as the parts have their ends
    attachments: dict[str, bytes]
    topics: Mapping[str, Series]
    decoded: Mapping[str, Series]  # by DBC message
    frames: NDArray[Any]  # (n,) of FRAME_DTYPE or LONG_FRAME_DTYPE, both ways, in the order of the bus
    events: list[LoggedEvent]
    contacts: list[tuple[int, ContactReport]]  # when each report was made, ns, and the report
    parts: int  # files that it was read from

    @property
    def is_complete(self) -> bool:
        """Whether the file is whole, no packet was dropped on the way to it, and a recovered log had lost nothing."""
        return not self.problem

    @property
    def epoch_ns(self) -> int:
        """Offset of the times in the file from t_ns, ns; 0 if the metadata don't name it."""
        return _number(self.metadata, EPOCH_KEY, 0)

    @property
    def scheme(self) -> Series:
        """Decisions of the scheme in each cycle, records.scheme_layout or certified_layout."""
        return self.topics[SCHEME.name]

    @property
    def control(self) -> Series:
        """Desired motion and commanded torque, records.CONTROL_LAYOUT."""
        return self.topics[CONTROL.name]

    @property
    def cycle(self) -> Series:
        """Times and counts of each cycle, records.CycleRecord."""
        return self.topics[CYCLE.name]

    @property
    def truth(self) -> Series:
        """The emulator's truth, truth_topic.TRUTH_LAYOUT."""
        return self.topics[TRUTH.name]


def read_log(path: str | Path, topics: Collection[str] | None = None) -> RunLog:
    """Read the log whose first part is `path`, with all its parts, into memory.

    topics: those whose messages are read; None: all. A folder stands for the run's log in it, `run.mcap`. Damage is
    named in `problem`. Raises LogError if no part can be read, or a contact's report has an unknown value.
    """
    stream = LogStream(path, topics, _EVERY_CYCLE)
    empty = stream.empty()
    piece = [empty, *stream][-1]
    read = {name: each for name, each in piece.series.items() if name.startswith(DECODED) or name in empty.series}
    series = {**empty.series, **read}
    return RunLog(
        path=stream.path,
        problem=stream.problem,
        metadata=stream.metadata,
        summary=stream.summary,
        attachments=stream.attachments,
        topics=series,
        decoded={name.removeprefix(DECODED): values for name, values in series.items() if name.startswith(DECODED)},
        frames=piece.frames,
        events=stream.events(piece),
        contacts=contacts_of(series[CONTACT.name]),
        parts=stream.parts,
    )


def topic_bytes(path: str | Path, topic: str) -> bytes:
    """Return the payloads of a topic, one after the other: equal for two logs that hold the same, bit for bit.

    path: the first part of a log, or the folder of a run. Raises LogError if no part can be read, or if the log lacks
    the topic.
    """
    walk = LogWalk(log_in(path), (topic,))
    found = [payload for piece in walk.pieces(_EVERY_CYCLE, 0) for payload in piece.payloads.get(topic, ())]
    if topic not in walk.topics:
        raise LogError(f"log {path} has no topic {topic}")
    return b"".join(found)


def _own_layout(message_type: MessageType) -> "np.dtype[Any] | None":
    """Return the numpy type of the payloads of a message type of ours or of bus frames; None if their size varies."""
    if message_type.name in _KNOWN:
        return _KNOWN[message_type.name]
    try:
        return message_type.dtype
    except LogError:
        return None


def _number(metadata: Mapping[str, str], key: str, default: int) -> int:
    """Return the integer under a key of a log's metadata, `default` without the key.

    Raises LogError for a text that is no integer.
    """
    try:
        return int(metadata.get(key, default))
    except ValueError:
        raise LogError(f"the log's metadata {key} = {metadata[key]!r} is not a number") from None


def _own_topics(metadata: Mapping[str, str]) -> dict[str, Topic]:
    """Return our own topics except those of bus frames and of varying size, by name, for a log with such metadata.

    Raises LogError if the number of parameters in the metadata is no integer.
    """
    parameter_count = _number(metadata, "parameter_count", len(PARAMETER_NAMES))
    topics = {}
    for channel in (*run_channels(parameter_count), *truth_channels()):
        payload = None if channel.topic in FRAME_TOPICS else _own_layout(channel.type)
        if payload is not None:
            topics[channel.topic] = Topic(channel.topic, channel.type.name, record_dtype(payload))
    return topics


def _series_of(
    rows: Mapping[str, NDArray[np.uint8]], topics: Mapping[str, Topic], own: Mapping[str, Topic], epoch_ns: int
) -> dict[str, Series]:
    """Return a series for each topic of fixed size: each of ours, even if it is empty, and all others of the log.

    rows: the records of topics (n, size). topics: those of the log; own: ours. One of ours that has another type in the
    log is empty.
    """
    series = {}
    for name, topic in {**topics, **own}.items():
        found = topics.get(name, topic)
        if found.type_name != topic.type_name or found.dtype is None:
            found = topic
        if found.dtype is not None:
            is_there = found is topics.get(name) and name in rows
            records = rows[name].view(found.dtype)[:, 0] if is_there else np.empty(0, found.dtype)
            series[name] = Series(records, epoch_ns)
    return series


_STATES: Final = {"state": SchemeState, "previous_state": SchemeState, "fault": FaultReason}


def check_states(scheme: Series) -> None:
    """Raise LogError for a record of /scheme with an unknown state or fault."""
    for name, kind in _STATES.items():
        if name in scheme.fields:
            odd = np.flatnonzero(~np.isin(scheme.records[name], [int(member) for member in kind]))
            if odd.size:
                value, cycle = scheme.records[name][odd[0]], scheme.records["cycle"][odd[0]]
                raise LogError(f"{SCHEME.name} has {name} {value} in cycle {cycle}, which this version does not know")


def contacts_of(series: Series) -> list[tuple[int, ContactReport]]:
    """Return each report of /contact, in the order of the log, as a pair: the time at which it was made, the report.

    Times in ns on the clock of the run. Raises LogError for an unknown level, kind, reaction or location.
    """
    contacts = []
    for t_ns, record in zip(series.t_ns.tolist(), series.records, strict=True):
        try:
            report = contact_report(record)
        except (ValueError, OverflowError) as error:  # "77 is not a valid ContactLevel"
            raise LogError(f"{CONTACT.name} has a report that this version does not know: {error}") from None
        contacts.append((t_ns, report))
    return contacts


Time = TypeVar("Time", int, float)


def each_once(reports: Iterable[tuple[Time, ContactReport]]) -> list[tuple[Time, ContactReport]]:
    """Return each contact once, as the time of its first report and the content of its last report.

    Reports that name the same cycle of detection are of one contact.
    """
    found: dict[int, tuple[Time, ContactReport]] = {}
    for time, report in reports:
        first, _ = found.get(report.cycle, (time, report))
        found[report.cycle] = first, report
    return list(found.values())


class Piece(NamedTuple):
    """A stretch of a log that ends with whole cycles: consecutive pieces have all of it, in the order of the file.

    The records of a cycle are those with one publish time, one after the other in the file. An event that happens
    between two cycles counts as one.
    """

    series: Mapping[str, Series]
    """Requested topics of fixed size without those of bus frames; our own ones are there even when empty."""
    frames: NDArray[Any]
    """(n,) of reader.FRAME_DTYPE, or LONG_FRAME_DTYPE in a piece with FD frames; both ways, in the order of the bus."""
    payloads: Mapping[str, list[bytes]]
    """Requested topics of varying size, such as /events."""


class LogStream(LogWalk):
    """A log read from front to back in constant memory, all parts as one: iterate for its pieces.

    Damaged and missing parts are left out; `problem` names them.
    """

    def __init__(
        self,
        path: str | Path,
        topics: Collection[str] | None = None,
        cycles_per_piece: int = 5_000,
        is_ahead: bool = True,
    ) -> None:
        """Open the log whose first part is `path`. topics: those whose messages are read; None: all.

        A folder stands for the run's log in it. cycles_per_piece: most cycles in a piece of the iteration. is_ahead: a
        thread opens chunks ahead, for a caller without a thread of its own for the reading. Raises LogError if no part
        of it can be read.
        """
        super().__init__(log_in(path), topics)
        self.epoch_ns = _number(self.metadata, EPOCH_KEY, 0)
        self._cycles_per_piece = cycles_per_piece
        self._is_ahead = is_ahead

    def layout(self, channel: Channel, schema: Schema) -> "np.dtype[Any] | None":
        """Return the numpy type of a channel's payloads; None if their size varies, or their schema can't be read."""
        if schema.name == JOINT_STATE.name and not self.metadata:
            return None  # others have any number of joints
        try:
            text = schema.data.decode("utf-8")
        except UnicodeDecodeError:
            return None
        return _own_layout(MessageType(schema.name, text, tuple(channel.metadata.get(FIELDS_KEY, "").split())))

    def empty(self) -> Piece:
        """Return a piece without messages, with all of our own topics."""
        return Piece(_series_of({}, {}, _own_topics(self.metadata), self.epoch_ns), np.empty(0, FRAME_DTYPE), {})

    @property
    def problem(self) -> str:
        """Missing and damaged parts, dropped packets, and the losses of a recovered log, in one line.

        As far as it was read; "" for a whole log, and before.
        """
        dropped, lost = self.summary.get(DROPPED_KEY, "0"), self.summary.get(LOST_KEY, "")
        said = (
            f"{dropped} packets never reached the log" if dropped != "0" else "",
            lost and f"recovered without {lost}",
        )
        return "; ".join(filter(None, (super().problem, *said)))

    @property
    def is_complete(self) -> bool:
        """Whether all that was read so far is whole, no packet was dropped, and a recovered log had lost nothing."""
        return not self.problem

    def events(self, piece: Piece) -> list[LoggedEvent]:
        """Return the events of a piece; [] for a log without events."""
        topic = self.topics.get(EVENTS.name)
        if topic is None or topic.type_name != LOG.name:
            return []
        payloads = piece.payloads.get(EVENTS.name, ())
        return [LoggedEvent(log_time_ns(payload) - self.epoch_ns, unpack_log(payload)) for payload in payloads]

    def joint_states(self, piece: Piece) -> dict[str, list[bytes]]:
        """Return the payloads of joint states that another program recorded, by topic; {} in a log of ours."""
        found = self.topics
        return {name: each for name, each in piece.payloads.items() if found[name].type_name == JOINT_STATE.name}

    def __iter__(self) -> Iterator[Piece]:
        own = {
            name: topic
            for name, topic in _own_topics(self.metadata).items()
            if self._wanted is None or name in self._wanted
        }
        for piece in self.pieces(self._cycles_per_piece, self.epoch_ns, self._is_ahead):
            there = {name: each for name, each in self.topics.items() if name in piece.records}
            yield Piece(_series_of(piece.records, there, own, self.epoch_ns), piece.frames, piece.payloads)


def start_of_log(path: Path) -> int | None:
    """Return the time of the first message of a log of ours, ns of the run's clock; None without a message.

    Raises LogError if the log can't be read. The host's first frames come before its first decisions.
    """
    stream = LogStream(path, cycles_per_piece=1)
    for piece in stream:
        times = [event.t_ns for event in stream.events(piece)[:1]]
        there = [series.records for series in piece.series.values() if len(series)]
        times += [int(records["publish_time"][0]) - stream.epoch_ns for records in there]
        times += piece.frames["cycle_t_ns"][:1].tolist()
        if times:
            return min(times)
    return None


def begin_of_log(path: Path) -> int:
    """Return the time of a log's first message, ns of the run's clock.

    Raises LogError if it can't be read or has none.
    """
    start_ns = start_of_log(path)
    if start_ns is None:
        raise LogError(f"log {path} has no message")
    return start_ns
