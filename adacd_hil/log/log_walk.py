"""A walk over one part of a log: attachments, metadata, and messages as far as the file is intact."""

import contextlib
import operator
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema

from adacd_hil.file_access import open_input
from adacd_hil.log.log_files import (
    RUN_METADATA,
    LogError,
    failing_as,
)
from adacd_hil.log.mcap.chunks import Block, read_blocks
from adacd_hil.log.mcap.mcap_records import (
    CHANNEL_NUMBERS,
    DEFINITIONS,
    Definitions,
    RawRecord,
    attachment_crc_fits,
    parse,
    summary_of,
    walk,
)
from adacd_hil.log.mcap.record_layout import HEAD, record_dtype
from adacd_hil.log.types.record_arrays import UNKNOWN, UNWANTED, Piece, PieceBuilder, Topic

PayloadLayout = Callable[[Channel, Schema], "np.dtype[Any] | None"]
_NOT_OF_HEAD = set(Opcode) - {Opcode.ATTACHMENT, Opcode.METADATA}


class Extras:
    """Attachments and metadata of a file, by name; a later one replaces an earlier one of the same name."""

    def __init__(self) -> None:
        self.attachments: dict[str, bytes] = {}
        self.metadata: dict[str, dict[str, str]] = {}

    def add_record(self, record: RawRecord) -> None:
        """Keep the attachment or metadata in a record; ignore other records.

        Raises LogError for a record that can't be parsed, or an attachment that fails its CRC.
        """
        if record.opcode == Opcode.ATTACHMENT:
            attachment: Attachment = parse(record.opcode, record.body)
            if not attachment_crc_fits(record):
                raise LogError("attachment fails its CRC")
            self.attachments[attachment.name] = attachment.data
        elif record.opcode == Opcode.METADATA:
            metadata: Metadata = parse(record.opcode, record.body)
            self.metadata[metadata.name] = metadata.metadata


def read_head(path: Path) -> Extras:
    """Return the attachments and metadata at the beginning of a file, up to the metadata of the run.

    Without that metadata it reads the whole file. Damaged ones are left out. Raises LogError if the file can't be read
    or isn't MCAP.
    """
    extras = Extras()
    with failing_as(f"log {path} can't be read"), open_input(path) as file:
        for record in walk(file, str(path), _NOT_OF_HEAD):
            if isinstance(record, RawRecord):
                with contextlib.suppress(LogError):
                    extras.add_record(record)
            if RUN_METADATA in extras.metadata:
                break
    return extras


def attachment(path: Path, name: str) -> bytes | None:
    """Return an attachment of an MCAP file by its name; None if the head of the file lacks it or can't be read.

    Raises no error.
    """
    with contextlib.suppress(LogError):  # the reader of the log reports damage
        return read_head(path).attachments.get(name)
    return None


def run_metadata(path: Path) -> dict[str, str]:
    """Return the metadata of the run in an MCAP file; {} if the head of the file lacks them or can't be read."""
    with contextlib.suppress(LogError):
        return read_head(path).metadata.get(RUN_METADATA, {})
    return {}


class PartWalk:
    """The walk over one file; keeps its attachments, metadata and first problem."""

    def __init__(
        self, path: Path, builder: PieceBuilder, layout: PayloadLayout, wanted: Collection[str] | None
    ) -> None:
        self.extras = Extras()
        self.problem = ""
        self.other_types: set[str] = set()
        """Topics that have another type than in the parts before."""
        self._path = path
        self._builder = builder
        self._layout = layout
        self._wanted = wanted
        self._definitions = Definitions()
        self._slots = np.full(CHANNEL_NUMBERS, UNKNOWN, np.int32)  # of each channel
        self._has_searched = False

    def _note(self, problem: str) -> None:
        """Keep the first problem of the file."""
        self.problem = self.problem or problem

    def pieces(self, is_ahead: bool) -> Iterator[Piece]:
        """Read the file; yield a piece whenever enough cycles are gathered; keep attachments, metadata, first problem.

        The cycles after the last full piece stay in the `PieceBuilder`. is_ahead: a thread decompresses chunks in
        advance. Raises LogError if the file can't be read or isn't MCAP.
        """
        with failing_as(f"log {self._path} can't be read"), open_input(self._path) as file:
            for item in read_blocks(file, str(self._path), is_ahead=is_ahead):
                if isinstance(item, Block):
                    yield from self._take_block(item)
                elif isinstance(item, RawRecord):
                    try:
                        self.extras.add_record(item)
                    except LogError:
                        self._note(f"damaged at byte {item.offset + HEAD.size}")
                else:
                    self._note(item.text)

    def _take_block(self, block: Block) -> Iterator[Piece]:
        """Gather the messages of some chunks, `block`, each by the definitions before it; yield full pieces.

        Note the chunks' problems: damage, and messages of another length than their schema says.
        """
        contents = block.contents
        marks: list[tuple[int, RawRecord | None]] = [(record.offset, record) for record in contents.definitions]
        marks += [(place, None) for place in contents.breaks]
        first = 0
        for place, definition in sorted(marks, key=operator.itemgetter(0)):
            last = int(np.searchsorted(contents.starts, place))
            yield from self._take_messages(block, slice(first, last))
            first = last
            try:
                self._define(definition)
            except LogError:
                self._note(f"damaged at byte {block.position}")
        yield from self._take_messages(block, slice(first, len(contents.starts)))
        if block.problem:
            self._note(block.problem)
        if self._builder.wrong or Opcode.MESSAGE in contents.strangers:
            self._builder.wrong = 0
            self._note("a message is not as long as its schema says")

    def _take_messages(self, block: Block, messages: slice) -> Iterator[Piece]:
        """Gather consecutive messages of some chunks, the slice `messages` of those in `block`; yield full pieces.

        Of a channel that isn't defined yet, search the definition in the file's summary first.
        """
        channels = block.contents.channels[messages]
        slots = self._slots[channels]
        if UNKNOWN in slots:
            for channel in dict.fromkeys(channels[slots == UNKNOWN].tolist()):
                self._search(channel)
            slots = self._slots[channels]
        yield from self._builder.add_messages(block.contents, messages, slots)

    def _define(self, record: RawRecord | None) -> None:
        """Keep a schema, or a channel with the slot of its topic in the builder.

        Raises LogError for an invalid record, and for None, which stands for one.
        """
        if record is None:
            raise LogError("no record")
        definition = self._definitions.add_record(record)
        if isinstance(definition, Channel):
            self._slots[definition.id] = self._slot_of(definition)

    def _slot_of(self, channel: Channel) -> int:
        """Return the slot that gathers a channel's messages, a new one for a new topic; UNWANTED: they are skipped.

        They are skipped if the topic isn't wanted, or if it has another type than before, which is kept in
        `other_types`.
        """
        if self._wanted is not None and channel.topic not in self._wanted:
            return UNWANTED
        schema = self._definitions.schemas.get(channel.schema_id, Schema(0, b"", "", ""))
        payload = self._layout(channel, schema)
        topic = Topic(channel.topic, schema.name, None if payload is None else record_dtype(payload))
        slot = next((slot for slot, known in enumerate(self._builder.topics) if known.name == topic.name), None)
        if slot is None:
            slot = self._builder.add_topic(topic)
        elif self._builder.topics[slot] != topic:
            self.other_types.add(topic.name)
            return UNWANTED
        return slot

    def _search(self, channel: int) -> None:
        """Look for the definition of a channel in the file's summary, since the one before its messages is damaged.

        If there is none, note the problem and skip the channel's messages.
        """
        if not self._has_searched:
            self._has_searched = True
            with contextlib.suppress(OSError, LogError), open_input(self._path) as file:
                for record in summary_of(file):
                    if record.opcode in DEFINITIONS:
                        self._define(record)
        if self._slots[channel] == UNKNOWN:
            self._slots[channel] = UNWANTED
            self._note(f"messages of channel {channel}, which is not defined")
