"""A walk over all parts of a log, as if they were one file; a part that is missing or damaged costs only itself.

What is intact of a cut or damaged file is kept, what isn't raises nothing.
"""

import io
import zlib
from collections.abc import Collection, Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema

from adacd_hil.log import compiled_records as compiled
from adacd_hil.log.chunks import DAMAGE, Block, Record, read_items, read_others
from adacd_hil.log.errors import LogError
from adacd_hil.log.gathering import Gathered, Gathering
from adacd_hil.log.mcap.records import RECORD_HEAD_BYTES
from adacd_hil.log.mcap_file import CONTINUED, ENDING_KEY, PART_KEY, RUN_METADATA, SUMMARY_METADATA
from adacd_hil.log.parts import find_parts, part_path
from adacd_hil.log.topic_records import PayloadLayout, Topic

_COUNTS = {"frames", "messages", "dropped"}
_CHANNELS = 1 << 16


class Definition(NamedTuple):
    """A channel that a file defines."""

    channel: Channel
    schema: Schema


class _Extras:
    """What a file holds besides messages."""

    def __init__(self) -> None:
        self.attachments: dict[str, bytes] = {}
        self.metadata: dict[str, dict[str, str]] = {}

    def take(self, record: Record) -> None:
        """Take in a record, if it is an attachment or metadata. Raises one of DAMAGE."""
        stream = ReadDataStream(io.BytesIO(record.body))
        if record.opcode == Opcode.ATTACHMENT:
            attachment = Attachment.read(stream)
            if zlib.crc32(record.body[:-4]) != int.from_bytes(record.body[-4:], "little"):
                raise ValueError("attachment fails its CRC")
            self.attachments[attachment.name] = attachment.data
        elif record.opcode == Opcode.METADATA:
            metadata = Metadata.read(stream)
            self.metadata[metadata.name] = metadata.metadata


class _Part(NamedTuple):
    """A file that is part of the log."""

    path: Path
    number: int
    is_alone: bool


def _read_head(path: Path) -> _Extras:
    """Read what comes before the messages. Raises LogError when the file can't be read or isn't MCAP."""
    extras = _Extras()
    for item in read_others(path):
        if isinstance(item, Record):
            try:
                extras.take(item)
            except DAMAGE:
                continue
            if RUN_METADATA in extras.metadata:
                break
    return extras


class _Definitions:
    """The channels that a file defines."""

    def __init__(self) -> None:
        self._schemas: dict[int, Schema] = {}

    def take(self, data: bytes) -> Definition | None:
        """Take in a record; return the channel, if it defines one. Raises one of DAMAGE."""
        stream = ReadDataStream(io.BytesIO(data[RECORD_HEAD_BYTES:]))
        if data[0] == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._schemas[schema.id] = schema
        elif data[0] == Opcode.CHANNEL:
            channel = Channel.read(stream)
            return Definition(channel, self._schemas.get(channel.schema_id, Schema(0, b"", "", "")))
        return None


class JoinedWalk:
    """What a log holds. `problem` says in one line what is missing, "" for a whole log."""

    def __init__(
        self,
        path: Path,
        layout: PayloadLayout,
        topics: Collection[str] | None = None,
    ) -> None:
        """Find the parts of the log whose first is `path`; of the messages only those of `topics` are read if given.

        Raises LogError when nothing of it can be read.
        """
        self.attachments: dict[str, bytes] = {}
        self.metadata: dict[str, str] = {}
        self.summary: dict[str, str] = {}
        self.parts = 0
        self.topics: dict[str, Topic] = {}
        """Those that were asked for and are defined, as far as has been walked."""
        self._path = path
        self._layout = layout
        self._wanted = topics
        self._plan: list[_Part | str] = []  # parts, and problems where they would be
        self._problems: list[str] = []
        self._find_parts()

    @property
    def problem(self) -> str:
        """What is missing, as far as has been walked."""
        return "; ".join(self._problems)

    def _find_parts(self) -> None:
        parts = _parts_of(self._path)
        first_error: LogError | None = None
        for before, number in pairwise((-1, *parts)):
            self._plan += self._missing(before + 1, number)
            try:
                head = _read_head(parts[number])
            except LogError as error:
                first_error = first_error or error
                self._plan.append(str(error))
                continue
            self._plan_part(head, _Part(parts[number], number, is_alone=list(parts) == [0]))
        if first_error is not None and not any(isinstance(step, _Part) for step in self._plan):
            raise first_error
        self._last = max(parts)

    def _plan_part(self, head: _Extras, part: _Part) -> None:
        metadata = head.metadata.get(RUN_METADATA, {})
        number = metadata.pop(PART_KEY, str(part.number))
        is_foreign = bool(self.metadata and metadata) and metadata != self.metadata
        if is_foreign or (number != str(part.number) and not part.is_alone):
            self._plan.append(f"{part.path.name} is a part of another log")
            return
        if number != str(part.number):
            self._plan.append(f"{part.path.name} is part {number} of a log")
            part = part._replace(number=int(number) if number.isdecimal() else part.number)
        self._plan.append(part)
        self.metadata = self.metadata or metadata
        self.attachments = {**head.attachments, **self.attachments}

    def _missing(self, start: int, stop: int) -> list[str]:
        """Say that parts are missing, if any."""
        names = [part_path(self._path, number).name for number in sorted({start, stop - 1})] if start < stop else []
        return [f"{' to '.join(names)} {'is' if len(names) == 1 else 'are'} missing"] if names else []

    def pieces(self, cycles: int, epoch_ns: int, has_frame_records: bool = False) -> Iterator[Gathered]:
        """Read the messages of all parts, at most so many cycles at a time; what is known of the log grows meanwhile.

        epoch_ns: what the times of frames are less than those of the file; has_frame_records: of frames the records
        are gathered, too.
        """
        gathering = Gathering(cycles, epoch_ns, has_frame_records)
        self._problems, self.summary, self.parts = [], {}, 0
        joined = -1
        for step in self._plan:
            if isinstance(step, str):
                self._problems.append(step)
                continue
            walk = _PartWalk(step.path, gathering, self._layout, self._wanted)
            for piece in walk.pieces():
                self.topics = {topic.name: topic for topic in gathering.topics}
                yield piece
            self.topics = {topic.name: topic for topic in gathering.topics}
            if walk.problem:
                self._problems.append(walk.problem if step.is_alone else f"{step.path.name}: {walk.problem}")
            self._problems += [
                f"{step.path.name}: {name} has another type than before" for name in sorted(walk.other_types)
            ]
            self.parts += 1
            joined = step.number
            self.attachments = {**walk.extras.attachments, **self.attachments}
            self._sum_up(walk.extras.metadata.get(SUMMARY_METADATA, {}))
        if joined == self._last and self.summary.get(ENDING_KEY) == CONTINUED:
            self._problems += self._missing(self._last + 1, self._last + 2)
        if not gathering.is_empty:
            yield gathering.end()

    def _sum_up(self, summary: dict[str, str]) -> None:
        both = self.summary.keys() & summary.keys() & _COUNTS
        sums = {key: str(_count(self.summary, key) + _count(summary, key)) for key in both}
        self.summary = {**self.summary, **summary, **sums}
        if not summary:
            self.summary.pop(ENDING_KEY, None)


class _PartWalk:
    """The walk over one file."""

    def __init__(self, path: Path, gathering: Gathering, layout: PayloadLayout, wanted: Collection[str] | None) -> None:
        self.extras = _Extras()
        self.problem = ""
        self.other_types: set[str] = set()
        """Topics that have another type than in the parts before."""
        self._path = path
        self._gathering = gathering
        self._layout = layout
        self._wanted = wanted
        self._definitions = _Definitions()
        self._channels = np.full(_CHANNELS, compiled.UNKNOWN, np.int64)
        self._has_searched = False

    def _note(self, problem: str) -> None:
        self.problem = self.problem or problem

    def pieces(self) -> Iterator[Gathered]:
        """Read the file; yield whenever enough is gathered."""
        for item in read_items(self._path):
            if isinstance(item, Block):
                yield from self._take_block(item)
            elif isinstance(item, Record):
                try:
                    self.extras.take(item)
                except DAMAGE:
                    self._note(f"damaged at byte {item.position}")
            else:
                self._note(item.text)

    def _take_block(self, block: Block) -> Iterator[Gathered]:
        for start, end in pairwise((0, *block.ends)):
            for stop in self._gathering.walk(block.data, start, end, self._channels):
                if stop.reason == compiled.CUT:
                    yield self._gathering.end()
                elif stop.reason == compiled.UNDEFINED:
                    self._search(stop.culprit)
                elif stop.reason == compiled.BROKEN:
                    self._note(f"damaged at byte {block.position}")
                else:
                    self._define(block.data[stop.position : stop.end].tobytes(), block.position)
        if block.problem:
            self._note(block.problem)
        if self._gathering.take_wrong():
            self._note("a message is not as long as its schema says")

    def _define(self, data: bytes, position: int) -> None:
        """Take in a definition, which `data` begin with."""
        try:
            definition = self._definitions.take(data)
        except DAMAGE:
            self._note(f"damaged at byte {position}")
            return
        if definition is not None:
            self._channels[definition.channel.id] = self._slot_of(definition)

    def _slot_of(self, definition: Definition) -> int:
        """Find the slot of a channel."""
        channel, schema = definition
        if self._wanted is not None and channel.topic not in self._wanted:
            return compiled.UNWANTED
        topic = Topic.of(channel.topic, schema.name, self._layout(channel, schema))
        for slot, known in enumerate(self._gathering.topics):
            if known.name == topic.name:
                if known == topic:
                    return slot
                self.other_types.add(topic.name)
                return compiled.UNWANTED
        return self._gathering.add(topic)

    def _search(self, channel: int) -> None:
        """Look for the definition of a channel in the whole file: the one that came before its messages is damaged."""
        if not self._has_searched:
            self._has_searched = True
            for definition in _defined_in(self._path):
                self._channels[definition.channel.id] = self._slot_of(definition)
        if self._channels[channel] == compiled.UNKNOWN:
            self._channels[channel] = compiled.UNWANTED
            self._note(f"messages of channel {channel}, which is not defined")


def _defined_in(path: Path) -> Iterator[Definition]:
    """Read all definitions of a file."""
    definitions = _Definitions()
    nothing = Gathering(cycles=np.iinfo(np.int64).max, epoch_ns=0, has_frame_records=False)
    unwanted = np.full(_CHANNELS, compiled.UNWANTED, np.int64)
    for item in read_items(path):
        if not isinstance(item, Block):
            continue
        for start, end in pairwise((0, *item.ends)):
            for stop in nothing.walk(item.data, start, end, unwanted):
                if stop.reason == compiled.DEFINITION:
                    try:
                        definition = definitions.take(item.data[stop.position : stop.end].tobytes())
                    except DAMAGE:
                        continue
                    if definition is not None:
                        yield definition


def _parts_of(path: Path) -> dict[int, Path]:
    try:
        return find_parts(path) or {0: path}
    except OSError:
        return {0: path}


def _count(summary: dict[str, str], key: str) -> int:
    text = summary.get(key, "0")
    return int(text) if text.isdecimal() else 0
