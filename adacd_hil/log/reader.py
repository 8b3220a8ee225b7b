"""A log as a stream of pieces (`LogStream`), or as one piece (`read_log`).

A piece has one structured array per topic, frames in the order of the bus, and events. Cut and damaged files are read
as far as they are intact; `problem` reports the damage.

On two processors one reads, checks and decompresses ahead while the other gathers the messages; topics outside the
request cost only their decompression.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from adacd_hil.log.log_files import (
    CONTINUED,
    ENDING_KEY,
    EPOCH_KEY,
    FIELDS_KEY,
    PART_KEY,
    RUN_METADATA,
    SUMMARY_METADATA,
    LogError,
    part_path,
)
from adacd_hil.log.log_parts import DROPPED_KEY, LOST_KEY, log_in, parts_of, summary_count, whole_number
from adacd_hil.log.log_walk import Extras, PartWalk, read_head
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
from adacd_hil.log.types.record_arrays import (
    FRAME_DTYPE,
    FRAME_TOPICS,
    LONG_FRAME_DTYPE,
    Piece,
    PieceBuilder,
    Series,
    Topic,
)
from adacd_hil.log.types.topics import CONTACT, CONTROL, CYCLE, DECODED, EVENTS, SCHEME, run_channels
from adacd_hil.log.types.truth_topic import TRUTH, truth_channels
from adacd_hil.log.types.unpacking import contact_report, log_time_ns, unpack_log
from adacd_hil.records import (
    PARAMETER_NAMES,
    ContactReport,
    Event,
)

__all__ = [
    "FRAME_DTYPE",
    "LONG_FRAME_DTYPE",
    "LogStream",
    "LoggedEvent",
    "Piece",
    "RunLog",
    "Series",
    "read_log",
]

_KNOWN = {
    CAN_FRAME.name: CAN_FRAME_DTYPE,
    FD_FRAME.name: FD_FRAME_DTYPE,
    JOINT_STATE.name: JOINT_STATE_DTYPE,
}
_EVERY_CYCLE = 1 << 62
_COUNTS = {"frames", "messages", "dropped"}


class LoggedEvent(NamedTuple):
    """An event and when it was logged, ns on the clock of the run."""

    t_ns: int
    event: Event


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
    frames: NDArray[Any]  # (n,) of FRAME_DTYPE or LONG_FRAME_DTYPE, both ways, in the order of the bus
    events: list[LoggedEvent]
    contacts: list[tuple[int, ContactReport]]  # when each report was made, ns, and the report

    @property
    def is_complete(self) -> bool:
        """Whether all parts are there and whole, no packet was dropped, and a recovered log had lost nothing."""
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
        """The emulator's truth, truth_topic.TRUTH_LAYOUT; empty except in the emulator's own log."""
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
        frames=piece.frames,
        events=stream.events(piece),
        contacts=contacts_of(series[CONTACT.name]),
    )


def _own_layout(message_type: MessageType) -> "np.dtype[Any] | None":
    """Return the numpy type of the payloads of a message type of ours or of bus frames; None if their size varies.

    FD frames, whose size varies too, get the type of the longest one.
    """
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


def report_values(series: Series) -> Iterator[dict[str, Any]]:
    """Yield the fields of each report of /contact that the log has, values by name; those of enums are numbers."""
    names = [name for name in ContactReport._fields if name in series.fields]
    for record in series.records:
        yield {name: record[name].tolist() for name in names}


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


class LogStream:
    """A log read from front to back in constant memory, all parts as one: iterate for its pieces.

    The constructor reads the heads of the parts, the iteration the rest; each begins with the first part. The intact
    messages of a cut or damaged file are kept; a missing or damaged part costs only itself, and `problem` names it.
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
        self.path = log_in(path)
        self.attachments: dict[str, bytes] = {}
        self.metadata: dict[str, str] = {}
        self.summary: dict[str, str] = {}
        self.topics: dict[str, Topic] = {}
        """The requested topics that are defined in the parts read so far."""
        self._wanted = topics
        self._cycles_per_piece = cycles_per_piece
        self._is_ahead = is_ahead
        self._plan: list[tuple[Path, int] | str] = []  # files and numbers of parts, and problems where they would be
        self._problems: list[str] = []
        self._is_alone = False
        self._find_parts()
        self.epoch_ns = _number(self.metadata, EPOCH_KEY, 0)

    def _find_parts(self) -> None:
        """Plan the reading: readable parts by ascending number, and a problem for each unreadable or foreign one.

        Missing parts in a row are one problem. Foreign: of another log. Raises LogError if every part is unreadable or
        foreign.
        """
        parts = parts_of(self.path)
        self._is_alone = list(parts) == [0]
        first_error: LogError | None = None
        for before, number in pairwise((-1, *parts)):
            self._plan += self._missing(before + 1, number)
            try:
                head = read_head(parts[number])
            except LogError as error:
                first_error = first_error or error
                self._plan.append(str(error))
                continue
            self._plan_part(head, parts[number], number)
        if all(isinstance(step, str) for step in self._plan):
            raise first_error or LogError(f"log {self.path} can't be read: {'; '.join(map(str, self._plan))}")
        self._last = max(parts)

    def _plan_part(self, head: Extras, path: Path, number: int) -> None:
        """Add a part to the plan, and its metadata and attachments to the log's.

        A part of another log is a problem instead. A file alone that names itself a further part is planned, with a
        problem. number: by its name.
        """
        metadata = head.metadata.get(RUN_METADATA, {})
        said = metadata.pop(PART_KEY, str(number))
        is_foreign = bool(self.metadata and metadata) and metadata != self.metadata
        if is_foreign or (said != str(number) and not self._is_alone):
            self._plan.append(f"{path.name} is a part of another log")
            return
        if said != str(number):
            self._plan.append(f"{path.name} is part {said} of a log")
            told = whole_number(said)
            number = number if told is None else told
        self._plan.append((path, number))
        self.metadata = self.metadata or metadata
        self.attachments = {**head.attachments, **self.attachments}

    def _missing(self, start: int, stop: int) -> list[str]:
        """Return a line that says that the parts start to stop - 1 are missing; [] if stop isn't beyond start.

        It names the first and the last one, and doesn't look for the files.
        """
        names = [part_path(self.path, number).name for number in sorted({start, stop - 1})] if start < stop else []
        return [f"{' to '.join(names)} {'is' if len(names) == 1 else 'are'} missing"] if names else []

    def _layout(self, channel: Channel, schema: Schema) -> "np.dtype[Any] | None":
        """Return the numpy type of a channel's payloads; None if their size varies, or their schema can't be read."""
        if schema.name == JOINT_STATE.name and not self.metadata:
            return None  # others have any number of joints
        try:
            text = schema.data.decode("utf-8")
        except UnicodeDecodeError:
            return None
        return _own_layout(MessageType(schema.name, text, tuple(channel.metadata.get(FIELDS_KEY, "").split())))

    def empty(self) -> Piece:
        """Return a piece without messages, with an empty series for each of our own topics, see `_own_topics`."""
        own = {
            name: Series(np.empty(0, topic.dtype), self.epoch_ns) for name, topic in _own_topics(self.metadata).items()
        }
        return Piece(own, np.empty(0, FRAME_DTYPE), {})

    @property
    def problem(self) -> str:
        """Missing, foreign and damaged parts, dropped packets, and the losses of a recovered log, in one line.

        Also topics that have another type in a later part. As far as it was read; "" for a whole log, and before.
        """
        dropped, lost = self.summary.get(DROPPED_KEY, "0"), self.summary.get(LOST_KEY, "")
        said = (
            f"{dropped} packets never reached the log" if dropped != "0" else "",
            lost and f"recovered without {lost}",
        )
        return "; ".join(filter(None, (*self._problems, *said)))

    def events(self, piece: Piece) -> list[LoggedEvent]:
        """Return the events of a piece; [] for a log without events, or if /events is not among the read topics."""
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
        types = _own_topics(self.metadata)
        own = {
            name: series for name, series in self.empty().series.items() if self._wanted is None or name in self._wanted
        }
        for piece in self._pieces():
            absent = {
                name: series
                for name, series in own.items()
                if name not in piece.series or self.topics[name].type_name != types[name].type_name
            }
            yield piece._replace(series={**piece.series, **absent})

    def _pieces(self) -> Iterator[Piece]:
        """Yield the messages of all parts in pieces; empty summary and problem first.

        These, topics and attachments grow meanwhile.
        """
        builder = PieceBuilder(self._cycles_per_piece, self.epoch_ns)
        self._problems, self.summary = [], {}
        joined = -1
        for step in self._plan:
            if isinstance(step, str):
                self._problems.append(step)
                continue
            path, joined = step
            walk = PartWalk(path, builder, self._layout, self._wanted)
            for piece in walk.pieces(self._is_ahead):
                self.topics = {topic.name: topic for topic in builder.topics}
                yield piece
            self.topics = {topic.name: topic for topic in builder.topics}
            if walk.problem:
                self._problems.append(walk.problem if self._is_alone else f"{path.name}: {walk.problem}")
            self._problems += [f"{path.name}: {name} has another type than before" for name in sorted(walk.other_types)]
            self.attachments = {**walk.extras.attachments, **self.attachments}
            self._sum_up(walk.extras.metadata.get(SUMMARY_METADATA, {}))
        if joined == self._last and self.summary.get(ENDING_KEY) == CONTINUED:
            self._problems += self._missing(self._last + 1, self._last + 2)
        if not builder.is_empty:
            yield builder.take_piece()

    def _sum_up(self, summary: dict[str, str]) -> None:
        """Add a part's summary to the log's: add up counts, replace other entries.

        A part without a summary removes the log's ending.
        """
        both = self.summary.keys() & summary.keys() & _COUNTS
        sums = {key: str(summary_count(self.summary, key) + summary_count(summary, key)) for key in both}
        self.summary = {**self.summary, **summary, **sums}
        if not summary:
            self.summary.pop(ENDING_KEY, None)


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
