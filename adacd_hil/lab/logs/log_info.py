"""A log at a glance: from its summaries and the chunks with its events and contacts, without reading it all.

A file whose summary can't be trusted is read whole, as far as it is readable.
"""

import struct
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Metadata, Statistics

from adacd_hil.file_access import open_input
from adacd_hil.lab.logs.payload_sizes import payload_size
from adacd_hil.lab.logs.salvage import Losses, Salvage
from adacd_hil.log.log_files import (
    ENDING_KEY,
    FIELDS_KEY,
    PART_KEY,
    RUN_METADATA,
    SUMMARY_METADATA,
    failing_as,
)
from adacd_hil.log.log_parts import DROPPED_KEY, missing_parts, parts_of, summary_count
from adacd_hil.log.log_walk import run_metadata
from adacd_hil.log.mcap.chunks import ChunkError, Contents, Opening, read_contents
from adacd_hil.log.mcap.mcap_records import Definitions, FileEnd, RawRecord, check_magic, parse, read_end, read_record
from adacd_hil.log.mcap.record_layout import MAGIC, MESSAGE_HEAD
from adacd_hil.log.reader import LoggedEvent
from adacd_hil.log.types.message_types import LOG, payload_dtype
from adacd_hil.log.types.record_arrays import FRAME_TOPICS
from adacd_hil.log.types.topics import CONTACT, CYCLE, EVENTS
from adacd_hil.log.types.unpacking import log_time_ns, unpack_log
from adacd_hil.records import ContactLevel, Event

_READ = (EVENTS.name, CONTACT.name)
_MILESTONES = ("supervisor", "certificate", "revoked")
"""Names of the events that are kept."""


class TopicInfo(NamedTuple):
    """A topic of a log. `messages`: their number; `rate_hz`: that over the log's duration.

    `bytes`: of its payloads; None if only reading the whole file would tell.
    """

    topic: str
    type: str
    messages: int
    rate_hz: float
    bytes: int | None


@dataclass
class LogInfo:
    """The content of a log, over all its parts. start_ns, end_ns: log times of the first and last message.

    frames: on the bus. dropped: packets that never reached the log. ending: why the log ended, "" if unknown.
    collisions: those of the contacts that were one. faults: texts of the events of level "error". events: number by
    level. attachments: sizes, bytes. problems: a line each.
    """

    path: Path
    files: int = 0
    size_bytes: int = 0
    start_ns: int = 0
    end_ns: int = 0
    messages: int = 0
    cycles: int = 0
    frames: int = 0
    dropped: int = 0
    ending: str = ""
    contacts: int = 0
    collisions: int = 0
    faults: list[str] = field(default_factory=list)  # events of level error
    events: Counter[str] = field(default_factory=Counter)  # by level
    topics: list[TopicInfo] = field(default_factory=list)
    attachments: dict[str, int] = field(default_factory=dict)  # sizes
    metadata: dict[str, str] = field(default_factory=dict)
    summary: dict[str, str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    milestones: list[LoggedEvent] = field(default_factory=list)  # changes of state, certificates; t_ns: of the log

    @property
    def duration_s(self) -> float:
        """Time from the first message to the last, s."""
        return (self.end_ns - self.start_ns) * 1e-9


def read_info(path: Path, *, is_brief: bool = False) -> LogInfo:
    """Return an overview of the log whose first part is `path`, over all its parts.

    is_brief: without events and contacts, and of a damaged file no more than the metadata of the run: some 2 ms. Raises
    LogError if a file can't be read, or has neither MCAP's magic nor anything of a log.
    """
    parts = parts_of(path)
    info = LogInfo(path, files=len(parts))
    view = _InfoView(info, is_brief)
    begin = b""
    for part in parts.values():
        with failing_as(f"log {part} can't be read"), open_input(part) as file:
            info.size_bytes += part.stat().st_size
            magic = file.read(len(MAGIC))
            begin = begin if begin == MAGIC else magic
            view.add_file(part, file)
    info.problems += [f"{part.name} is missing" for part in missing_parts(path, parts, info.ending)]
    view.sum_up()
    if not (info.topics or info.attachments or info.metadata or info.summary):
        check_magic(begin, str(path))
    return info


class _InfoView:
    """Adds the files of a log to a `LogInfo`: `add_file` for each, then `sum_up`."""

    def __init__(self, info: LogInfo, is_brief: bool) -> None:
        self._info = info
        self._is_brief = is_brief
        self._opening = Opening()
        self._channels: dict[str, tuple[str, int | None]] = {}  # by topic: type and size of payloads
        self._counts: Counter[str] = Counter()
        self._bytes: Counter[str] = Counter()  # where they were seen
        self._is_read: set[str] = set(() if is_brief else _READ)  # topics of which every message was seen
        self._start_ns, self._end_ns = 2**64, 0
        self._contact_cycles: dict[int, int] = {}  # level, by the cycle of the contact

    def add_file(self, path: Path, file: IO[bytes]) -> None:
        """Read one file of the log, by its summary or, if that can't be trusted, whole; add its counts and problems.

        With `is_brief` no file is read whole: if the summary can't be trusted, only run metadata and problems are
        added.
        """
        self._info.ending = ""
        end = read_end(file)
        statistics = None
        if end is not None:
            records = [record for record in end.summary if record.opcode == Opcode.STATISTICS]
            statistics = parse(Opcode.STATISTICS, records[0].body) if records else None
            channels = {parse(Opcode.CHANNEL, r.body).id for r in end.summary if r.opcode == Opcode.CHANNEL}
            if statistics is not None:
                indexes = sum(record.opcode == Opcode.CHUNK_INDEX for record in end.summary)
                is_indexed = self._is_brief or 0 < statistics.chunk_count <= indexes or not statistics.message_count
                if not (is_indexed and statistics.channel_message_counts.keys() <= channels):
                    statistics = None  # the summary doesn't say whose messages it counts, or where they are
        is_damaged = end is None
        if end is not None and statistics is not None:
            self._take_whole(file, end, statistics)
        elif self._is_brief:
            self._info.metadata = self._info.metadata or run_metadata(path)
        else:
            is_damaged |= self._take_each(path).is_any
        if is_damaged:
            self._info.problems.append(f"{path.name} is cut or damaged: `adacd-hil log check` says how")

    def _take_each(self, path: Path) -> Losses:
        """Read every record of a file and add it to the info; return what damage has destroyed."""
        salvage = Salvage(path)
        for item in salvage:
            if isinstance(item, Attachment):
                self._info.attachments[item.name] = len(item.data)
            elif isinstance(item, Metadata):
                self._take_metadata(item)
            else:
                self._know(salvage.definitions)
                topics = {number: channel.topic for number, channel in salvage.definitions.channels.items()}
                sizes = item.ends - item.starts - MESSAGE_HEAD
                for channel in np.unique(item.channels).tolist():
                    is_own = item.channels == channel
                    topic = topics.get(channel, "")
                    self._counts[topic] += int(np.count_nonzero(is_own))
                    self._bytes[topic] += 0 if topic in _READ else int(sizes[is_own].sum())
                    self._is_read.add(topic)
                if len(item.log_times):
                    self._span(int(item.log_times.min()), int(item.log_times.max()))
                self._read(item, salvage.definitions)
        return salvage.losses

    def _take_whole(self, file: IO[bytes], end: FileEnd, statistics: Statistics) -> None:
        """Add the facts of a file's summary to the info, and the events and contacts in the chunks that have some.

        With `is_brief` no chunk is read.
        """
        definitions = Definitions()
        definitions.add_records(end.summary)
        self._know(definitions)
        for channel, count in statistics.channel_message_counts.items():
            topic = definitions.channels[channel].topic if channel in definitions.channels else ""
            self._counts[topic] += count
        if statistics.message_count:
            self._span(statistics.message_start_time, statistics.message_end_time)
        topics = () if self._is_brief else _READ
        wanted = {number for number, channel in definitions.channels.items() if channel.topic in topics}
        chunks = set()
        for record in end.summary:
            if record.opcode == Opcode.ATTACHMENT_INDEX:
                index = parse(record.opcode, record.body)
                self._info.attachments[index.name] = index.data_size
            elif record.opcode == Opcode.METADATA_INDEX:
                found = read_record(file, parse(record.opcode, record.body).offset)
                self._take_metadata(parse(Opcode.METADATA, found.body))
            elif record.opcode == Opcode.CHUNK_INDEX and wanted:
                chunk = parse(record.opcode, record.body)
                if wanted & chunk.message_index_offsets.keys() and chunk.chunk_start_offset not in chunks:
                    chunks.add(chunk.chunk_start_offset)
                    self._read_chunk(read_record(file, chunk.chunk_start_offset), definitions)

    def _read_chunk(self, record: RawRecord, definitions: Definitions) -> None:
        try:
            self._read(read_contents(self._opening.open_chunk(parse(Opcode.CHUNK, record.body))), definitions)
        except ChunkError as error:
            self._info.problems.append(f"the chunk at byte {record.offset} {error}")

    def _know(self, definitions: Definitions) -> None:
        """Store type and payload size of each topic; the first definition of a topic stays."""
        for channel in definitions.channels.values():
            if channel.topic not in self._channels:
                schema = definitions.schemas.get(channel.schema_id)
                name = schema.name if schema is not None else channel.message_encoding
                self._channels[channel.topic] = name, payload_size(channel, schema)

    def _span(self, start_ns: int, end_ns: int) -> None:
        self._start_ns = min(self._start_ns, start_ns)
        self._end_ns = max(self._end_ns, end_ns)

    def _take_metadata(self, item: Metadata) -> None:
        info = self._info
        if item.name == RUN_METADATA and not info.metadata:
            info.metadata = {key: text for key, text in item.metadata.items() if key != PART_KEY}
        elif item.name == SUMMARY_METADATA:
            info.summary = item.metadata
            info.dropped += summary_count(item.metadata, DROPPED_KEY)
            info.ending = item.metadata.get(ENDING_KEY, "")

    def _read(self, contents: Contents, definitions: Definitions) -> None:
        """Add the events and contacts of a chunk, and the bytes of both topics, to the info.

        Messages that can't be decoded count with their bytes only.
        """
        for channel in definitions.channels.values():
            if channel.topic not in _READ:
                continue
            payloads = [contents.payload(place) for place in np.flatnonzero(contents.channels == channel.id).tolist()]
            self._bytes[channel.topic] += sum(map(len, payloads))
            schema = definitions.schemas.get(channel.schema_id)
            if schema is None:
                continue
            if channel.topic == EVENTS.name and schema.name == LOG.name:
                self._take_events(payloads)
            elif channel.topic == CONTACT.name and payload_size(channel, schema) is not None:
                fields = tuple(channel.metadata.get(FIELDS_KEY, "").split())
                self._take_contacts(payloads, payload_dtype(schema.data.decode(), fields))

    def _take_events(self, payloads: list[bytes]) -> None:
        for payload in payloads:
            try:
                event: Event = unpack_log(payload)
            except (struct.error, IndexError):
                continue
            self._info.events[event.level] += 1
            if event.name in _MILESTONES:
                self._info.milestones.append(LoggedEvent(log_time_ns(payload), event))
            if event.level == "error":
                self._info.faults.append(f"{event.name}: {event.message}")

    def _take_contacts(self, payloads: list[bytes], dtype: "np.dtype[Any]") -> None:
        for payload in payloads:
            if len(payload) == dtype.itemsize:
                report = np.frombuffer(payload, dtype)[0]
                level = int(report["level"]) if "level" in (dtype.names or ()) else 0
                cycle = int(report["cycle"])
                self._contact_cycles[cycle] = max(level, self._contact_cycles.get(cycle, 0))

    def sum_up(self) -> None:
        """Fill in the totals of the info: times, counts, contacts, topics. Call it after the last file."""
        info = self._info
        if self._end_ns:
            info.start_ns, info.end_ns = self._start_ns, self._end_ns
        info.messages = self._counts.total()
        info.cycles = self._counts[CYCLE.name]
        info.frames = sum(self._counts[topic] for topic in FRAME_TOPICS)
        info.contacts = len(self._contact_cycles)
        info.collisions = sum(level == ContactLevel.COLLISION for level in self._contact_cycles.values())
        for topic, (name, size) in self._channels.items():
            count = self._counts[topic]
            seen = self._bytes[topic] if topic in self._is_read else None
            total = count * size if size is not None else seen
            rate_hz = count / info.duration_s if info.duration_s > 0 else 0.0
            info.topics.append(TopicInfo(topic, name, count, rate_hz, total))
