"""The rules on a log's structure.

Chunks, their message indexes, messages outside of chunks; the summary's statements about attachments, metadata,
messages and itself.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Chunk,
    ChunkIndex,
    Footer,
    MetadataIndex,
    Statistics,
    SummaryOffset,
)
from numpy.typing import NDArray

from adacd_hil.lab.logs.check.content_checks import ContentCheck, DefinitionCheck
from adacd_hil.lab.logs.check.findings import Findings
from adacd_hil.log.mcap.chunks import ChunkError, Contents, Opening, read_contents
from adacd_hil.log.mcap.mcap_records import CHANNEL_NUMBERS, RawRecord, name_of, parse
from adacd_hil.log.mcap.record_layout import HEAD, INDEX_ENTRY


@dataclass
class ChunkFacts:
    """Facts on a chunk, with which its index in the summary is compared. The first ones have mcap's names.

    channels: numbers of its messages' channels, uint16 each. message_index_offsets: as of `pack_offsets`. is_indexed:
    the summary has an index of it.
    """

    chunk_length: int
    message_start_time: int
    message_end_time: int
    compression: str
    compressed_size: int
    uncompressed_size: int
    channels: bytes = b""  # numbers of those of its messages, uint16 each
    message_index_length: int = 0
    message_index_offsets: bytes = b""  # packed: as a table they would fill 60 MB in an hour
    is_indexed: bool = False


_OUTSIDE_BYTES = 1 << 20
"""Messages outside of chunks are checked together: one by one, 150,000 took 1 min."""
_INDEXED = (
    "chunk_length",
    "message_start_time",
    "message_end_time",
    "compression",
    "compressed_size",
    "uncompressed_size",
    "message_index_length",
)
"""Fields of a chunk index that are compared as they are."""


def pack_offsets(offsets: Mapping[int, int]) -> bytes:
    """Return the offsets of message indexes as bytes, uint16 channel and uint64 offset each, ascending by channel."""
    return b"".join(struct.pack("<HQ", channel, offsets[channel]) for channel in sorted(offsets))


class ChunkCheck:
    """Checks the chunks of a file with their messages and indexes, and the messages outside of chunks.

    Call its methods in the order of the records in the file.
    """

    def __init__(self, findings: Findings, definitions: DefinitionCheck) -> None:
        self.facts: dict[int, ChunkFacts] = {}
        """By where the chunk begins."""
        self.counts = np.zeros(CHANNEL_NUMBERS, np.int64)
        """Messages of each channel."""
        self.start_ns, self.end_ns = 2**64, 0
        self.first_later_than_zero_ns = 2**64
        self.has_outside = False
        """Whether there are messages outside of chunks."""
        self._findings = findings
        self._opening = Opening()
        self._definitions = definitions
        self._content = ContentCheck(findings)
        self._latest: ChunkFacts | None = None  # whose indexes may follow
        self._expected: dict[int, NDArray[Any]] | None = None  # entries of its indexes; None where it can't be opened
        self._offsets: dict[int, int] = {}
        self._outside = bytearray()  # messages outside of chunks that are not checked yet
        self._outside_at = 0  # place of the first of them in the file

    def chunk(self, record: RawRecord) -> None:
        """Check a chunk, its messages and definitions; add findings.

        Keep the facts with which its indexes are compared. A chunk without a CRC is counted. Raises LogError if the
        record can't be parsed.
        """
        chunk: Chunk = parse(record.opcode, record.body)
        facts = ChunkFacts(
            HEAD.size + len(record.body),
            chunk.message_start_time,
            chunk.message_end_time,
            chunk.compression,
            len(chunk.data),
            chunk.uncompressed_size,
        )
        self._latest = self.facts[record.offset] = facts
        self._expected, self._offsets = None, {}
        if not chunk.uncompressed_crc:
            self._findings.without_crc["chunk"] += 1
        try:
            data = self._opening.open_chunk(chunk)
        except ChunkError as error:
            self._findings.add_finding("chunk-crc", f"a chunk {error}", record.offset)
            return
        if len(data) != chunk.uncompressed_size:
            text = f"a chunk holds {len(data)} bytes, and says {chunk.uncompressed_size}"
            self._findings.add_finding("chunk-size", text, record.offset)
        contents = read_contents(data)
        for opcode in contents.strangers:
            self._findings.add_finding("chunk-record", f"a chunk holds a {name_of(opcode)}", record.offset)
        for place in contents.breaks:
            rest = len(data) - place
            self._findings.add_finding("chunk-record", f"a chunk ends with {rest} bytes of no record", record.offset)
        self._compare_times(chunk, contents, record.offset)
        self._messages(contents, record.offset)
        self._expect(contents, facts)

    def _compare_times(self, chunk: Chunk, contents: Contents, offset: int) -> None:
        if not len(contents.starts):
            return
        for verb, which, said, real in (
            ("begins", "earliest", chunk.message_start_time, int(contents.log_times.min())),
            ("ends", "latest", chunk.message_end_time, int(contents.log_times.max())),
        ):
            if said != real:
                text = f"a chunk {verb} at {said}, its {which} message at {real}"
                self._findings.add_finding("chunk-times", text, offset)

    def _expect(self, contents: Contents, facts: ChunkFacts) -> None:
        """Store the message indexes that the chunk must have, and its channels."""
        order = np.argsort(contents.channels, kind="stable")
        channels, firsts = np.unique(contents.channels[order], return_index=True)
        groups = np.split(contents.entries[order], firsts[1:])
        self._expected = dict(zip(channels.tolist(), groups, strict=False))
        facts.channels = channels.tobytes()

    def message_index(self, record: RawRecord) -> None:
        """Compare a message index with the messages of the chunk before it; add findings.

        Store its place and length with that chunk's facts. If the chunk couldn't be opened, do only this.
        """
        channel = int.from_bytes(record.body[:2], "little")
        latest = self._latest
        if latest is None:
            self._findings.add_finding("place", "a MessageIndex doesn't follow a chunk", record.offset)
            return
        self._offsets[channel] = record.offset
        latest.message_index_length += HEAD.size + len(record.body)
        latest.message_index_offsets = pack_offsets(self._offsets)
        if self._expected is None or len(record.body) % INDEX_ENTRY.itemsize != 6:
            if self._expected is not None:
                self._findings.add_finding("message-index", "an index has part of an entry", record.offset)
            return
        found = np.frombuffer(record.body[6:], INDEX_ENTRY)
        expected = self._expected.pop(channel, found[:0])
        if found.tobytes() != expected.tobytes() and np.sort(found, order="offset").tobytes() != expected.tobytes():
            text = f"the index of channel {channel} has {len(found)} entries that aren't its {len(expected)} messages"
            self._findings.add_finding("message-index", text, record.offset)

    def end_indexes(self) -> None:
        """Add a finding if the latest chunk lacks a message index; then no more of its indexes can follow.

        Call it at each record that is no message index, and at the end.
        """
        if self._latest is not None and self._expected:
            channels = [channel for channel, entries in self._expected.items() if len(entries)]
            offset = next(reversed(self.facts))
            if not self._offsets:
                self._findings.add_finding("no-message-index", "a chunk has no message index", offset)
            elif channels:
                text = f"a chunk has no index of the channels {', '.join(map(str, channels))}"
                self._findings.add_finding("message-index", text, offset)
        self._latest = None

    def message(self, record: RawRecord) -> None:
        """Keep a message outside of chunks for `end_messages`, which is called at `_OUTSIDE_BYTES`.

        Sets `has_outside`.
        """
        self.has_outside = True
        if not self._outside:
            self._outside_at = record.offset
        self._outside += HEAD.pack(record.opcode, len(record.body)) + record.body
        if len(self._outside) >= _OUTSIDE_BYTES:
            self.end_messages()

    def end_messages(self) -> None:
        """Check and count the messages outside of chunks since the last call: channel, time, payload; add findings.

        Call it at each record that is no message, and at the end.
        """
        if self._outside:
            self._messages(read_contents(bytes(self._outside)), self._outside_at)
            self._outside.clear()

    def _messages(self, contents: Contents, offset: int) -> None:
        """Check and count messages and the definitions between them; add findings.

        offset: of the chunk, or of the first message, in the file.
        """
        channels, firsts = np.unique(contents.channels, return_index=True)
        first_at = dict(zip(channels.tolist(), contents.starts[firsts].tolist(), strict=True))
        known = set(self._definitions.channels)
        for definition in contents.definitions:
            parsed = parse(definition.opcode, definition.body)
            if definition.opcode == Opcode.SCHEMA:
                self._definitions.schema(parsed, offset, is_summary=False)
            else:
                self._definitions.channel(parsed, offset, is_summary=False)
                if definition.offset < first_at.get(parsed.id, len(contents.data)):
                    known.add(parsed.id)
        for channel in channels.tolist():
            if channel not in known:
                text = f"messages of channel {channel} come before its definition"
                self._findings.add_finding("undefined-channel", text, offset)
        if len(contents.starts):
            self.counts += np.bincount(contents.channels, minlength=CHANNEL_NUMBERS)
            self.start_ns = min(self.start_ns, int(contents.log_times.min()))
            later = contents.log_times[contents.log_times > 0]
            if len(later):
                self.first_later_than_zero_ns = min(self.first_later_than_zero_ns, int(later.min()))
            self.end_ns = max(self.end_ns, int(contents.log_times.max()))
            self._content.messages(contents, self._definitions, offset)

    def compare(self, index: ChunkIndex, offset: int) -> None:
        """Compare a chunk index of the summary with its chunk, and mark the chunk as indexed; add findings.

        offset: of the index in the file.
        """
        facts = self.facts.get(index.chunk_start_offset)
        if facts is None:
            text = f"a chunk index points to byte {index.chunk_start_offset}, where no chunk begins"
            self._findings.add_finding("chunk-index", text, offset)
            return
        if facts.is_indexed:
            text = f"the chunk at byte {index.chunk_start_offset} is indexed more than once"
            self._findings.add_finding("chunk-index", text, offset)
        facts.is_indexed = True
        for name in _INDEXED:
            said, real = getattr(index, name), getattr(facts, name)
            if said != real:
                what = name.replace("_", " ")
                text = f"the {what} of the chunk at byte {index.chunk_start_offset} is {real}, its index says {said}"
                self._findings.add_finding("chunk-index", text, offset)
        if pack_offsets(index.message_index_offsets) != facts.message_index_offsets:
            text = f"the message indexes of the chunk at byte {index.chunk_start_offset} are not where its index says"
            self._findings.add_finding("chunk-index", text, offset)


_INDEXES: dict[int, str] = {Opcode.ATTACHMENT_INDEX: "attachment-index", Opcode.METADATA_INDEX: "metadata-index"}
"""Indexes of single records, and their rules."""


class SummaryCheck:
    """Compares the summary of a file with the data section.

    Call `attachment` and `metadata` for those of the data section, `record` for each record of the summary, then
    `footer`, then `finish`.
    """

    def __init__(self, findings: Findings, definitions: DefinitionCheck, chunks: ChunkCheck) -> None:
        self.statistics: Statistics | None = None
        self._findings = findings
        self._definitions = definitions
        self._chunks = chunks
        self._expected: dict[int, dict[int, Any]] = {opcode: {} for opcode in _INDEXES}
        """The indexes that the summary must have, by the offset of their record."""
        self._indexed: set[int] = set()
        self._start = 0  # of the summary; 0: not reached so far
        self._groups: list[list[int]] = []  # opcode, start, end of each
        self._offsets: list[tuple[int, SummaryOffset]] = []
        self._offset_start = 0

    def attachment(self, record: RawRecord, attachment: Attachment) -> None:
        """Store the index that the summary must have for an attachment."""
        self._expected[Opcode.ATTACHMENT_INDEX][record.offset] = AttachmentIndex(
            offset=record.offset,
            length=HEAD.size + len(record.body),
            log_time=attachment.log_time,
            create_time=attachment.create_time,
            data_size=len(attachment.data),
            name=attachment.name,
            media_type=attachment.media_type,
        )

    def metadata(self, record: RawRecord, name: str) -> None:
        """Store the index that the summary must have for a metadata record."""
        length = HEAD.size + len(record.body)
        self._expected[Opcode.METADATA_INDEX][record.offset] = MetadataIndex(record.offset, length, name)

    def record(self, record: RawRecord) -> None:
        """Store the place of a record of the summary.

        Compare an index or the statistics' channels, and add findings.
        """
        self._start = self._start or record.offset
        if record.opcode == Opcode.SUMMARY_OFFSET:
            self._offset_start = self._offset_start or record.offset
            self._offsets.append((record.offset, parse(record.opcode, record.body)))
            return
        if self._groups and self._groups[-1][0] == record.opcode:
            self._groups[-1][2] = record.end
        else:
            self._groups.append([record.opcode, record.offset, record.end])
        if record.opcode == Opcode.CHUNK_INDEX:
            self._chunks.compare(parse(record.opcode, record.body), record.offset)
        elif record.opcode in _INDEXES:
            self._compare(record.opcode, parse(record.opcode, record.body), record.offset)
        elif record.opcode == Opcode.STATISTICS:
            if self.statistics is not None:
                self._findings.add_finding("statistics", "there is more than one Statistics", record.offset)
            self.statistics = parse(record.opcode, record.body)
            self._check_counted_channels(self.statistics, record.offset)

    def _compare(self, opcode: int, index: Any, offset: int) -> None:
        """Compare an index of an attachment or metadata with the expected ones; add a finding on a wrong or second one.

        opcode: of the index; offset: where it is in the file.
        """
        rule, expected = _INDEXES[opcode], self._expected[opcode]
        kind = rule.removesuffix("-index")
        if index.offset in self._indexed:
            self._findings.add_finding(rule, f"the {kind} at byte {index.offset} is indexed more than once", offset)
        elif index.offset not in expected:
            self._findings.add_finding(rule, f"an index points to byte {index.offset}, where no {kind} begins", offset)
        elif index != expected[index.offset]:
            text = f"an index says {index}, it is {expected[index.offset]}"
            self._findings.add_finding(rule, text, offset)
        self._indexed.add(index.offset)

    def _check_counted_channels(self, statistics: Statistics, offset: int) -> None:
        if not statistics.channel_message_counts:
            return
        needed = {*self._definitions.channels, *statistics.channel_message_counts}
        for channel in sorted(needed - self._definitions.summary_channels):
            text = f"channel {channel} is counted, but isn't defined in the summary before the Statistics"
            self._findings.add_finding("summary-channels", text, offset)

    def footer(self, record: RawRecord, crc: int) -> None:
        """Compare the footer with the summary; add findings. crc: that of the summary up to the footer's own CRC.

        A summary without a CRC is counted. Raises LogError if the record can't be parsed.
        """
        footer: Footer = parse(record.opcode, record.body)
        if footer.summary_start != self._start:
            text = f"the Footer says that the summary begins at byte {footer.summary_start}, it is {self._start}"
            self._findings.add_finding("summary-offset", text, record.offset)
        if footer.summary_offset_start != self._offset_start:
            text = f"the Footer says {footer.summary_offset_start} for the summary offsets, it is {self._offset_start}"
            self._findings.add_finding("summary-offset", text, record.offset)
        if not footer.summary_crc:
            self._findings.without_crc["summary"] += 1
        elif footer.summary_crc != crc:
            self._findings.add_finding("summary-crc", "the summary fails its CRC", record.offset)

    def finish(self) -> None:
        """Add the findings on groups, missing indexes and statistics; call it after the footer."""
        self._check_groups()
        self._check_indexes()
        if self.statistics is not None:
            self._check_statistics(self.statistics)

    def _check_groups(self) -> None:
        groups = {(opcode, start, end - start) for opcode, start, end in self._groups}
        for offset, said in self._offsets:
            if (said.group_opcode, said.group_start, said.group_length) not in groups and said.group_length:
                text = f"a group is said to be at byte {said.group_start}, {said.group_length} bytes, and isn't"
                self._findings.add_finding("summary-offset", text, offset)

    def _check_indexes(self) -> None:
        if not self._groups:
            return
        kinds = {group[0] for group in self._groups}
        chunks = self._chunks.facts
        if chunks and Opcode.CHUNK_INDEX not in kinds:
            self._findings.add_finding("no-chunk-index", "the summary has no chunk indexes")
        elif chunks:
            for offset in (offset for offset, facts in chunks.items() if not facts.is_indexed):
                self._findings.add_finding("chunk-index", "a chunk isn't in the index", offset)
            self._check_needed_channels()
        if self._chunks.has_outside and Opcode.CHUNK_INDEX in kinds:
            self._findings.add_finding("unindexed-messages", "there are messages outside chunks, which no index has")
        for opcode, rule in _INDEXES.items():
            if opcode in kinds:
                for offset in sorted(set(self._expected[opcode]) - self._indexed):
                    self._findings.add_finding(rule, f"a record has no {rule.replace('-', ' ')}", offset)

    def _check_needed_channels(self) -> None:
        used = {
            int(channel)
            for facts in self._chunks.facts.values()
            if facts.is_indexed
            for channel in np.frombuffer(facts.channels, np.uint16)
        }
        for channel in sorted(used - self._definitions.summary_channels):
            self._findings.add_finding(
                "summary-channels", f"channel {channel} of an indexed chunk isn't in the summary"
            )
        schemas = {self._definitions.channels[channel].schema_id for channel in used & set(self._definitions.channels)}
        for schema in sorted(schemas - self._definitions.summary_schemas - {0}):
            self._findings.add_finding("summary-channels", f"schema {schema} of an indexed chunk isn't in the summary")

    def _check_statistics(self, statistics: Statistics) -> None:
        chunks = self._chunks
        total = int(chunks.counts.sum())
        pairs = {
            "messages": (statistics.message_count, total),
            "attachments": (statistics.attachment_count, len(self._expected[Opcode.ATTACHMENT_INDEX])),
            "metadata records": (statistics.metadata_count, len(self._expected[Opcode.METADATA_INDEX])),
            "chunks": (statistics.chunk_count, len(chunks.facts)),
        }
        for what, (said, real) in pairs.items():
            if said != real:
                self._findings.add_finding("statistics", f"there are {real} {what}, the Statistics say {said}")
        # Some writers count the schemas and channels that only the summary defines, some don't.
        for what, said, data, summary in (
            ("schemas", statistics.schema_count, self._definitions.schemas, self._definitions.summary_schemas),
            ("channels", statistics.channel_count, self._definitions.channels, self._definitions.summary_channels),
        ):
            if said not in (len(data), len({*data, *summary})):
                text = f"there are {len({*data, *summary})} {what}, the Statistics say {said}"
                self._findings.add_finding("statistics", text)
        if total:
            for what, said, allowed in (  # mcap's writer in C++ takes 0 for no time yet
                ("first", statistics.message_start_time, (chunks.start_ns, chunks.first_later_than_zero_ns)),
                ("last", statistics.message_end_time, (chunks.end_ns,)),
            ):
                if said not in allowed:
                    text = f"the {what} message is of {allowed[0]}, the Statistics say {said}"
                    self._findings.add_finding("statistics", text)
        counts = statistics.channel_message_counts
        if counts:
            for channel in sorted({*counts, *np.flatnonzero(chunks.counts).tolist()}):
                said, real = counts.get(channel, 0), int(chunks.counts[channel])
                if said != real:
                    text = f"channel {channel} has {real} messages, the Statistics say {said}"
                    self._findings.add_finding("statistics", text)
