"""The rules on chunks, their message indexes, and messages outside of chunks."""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Chunk, ChunkIndex
from numpy.typing import NDArray

from adacd_hil.log.check.content_checks import ContentCheck, DefinitionCheck
from adacd_hil.log.check.findings import Findings
from adacd_hil.log.mcap.chunks import ChunkError, Contents, Opening, message_contents, read_contents
from adacd_hil.log.mcap.mcap_records import CHANNEL_NUMBERS, HEAD, INDEX_ENTRY, RawRecord, name_of, parse


@dataclass
class ChunkFacts:
    """What a chunk index must say of a chunk."""

    length: int
    message_start_time: int
    message_end_time: int
    compression: str
    compressed_size: int
    uncompressed_size: int
    channels: bytes = b""  # numbers of those of its messages, uint16 each
    message_index_length: int = 0
    message_index_offsets: bytes = b""  # packed: as a table they would fill 60 MB in an hour
    is_indexed: bool = False


def pack_offsets(offsets: Mapping[int, int]) -> bytes:
    """Pack the places of message indexes, by channel."""
    return b"".join(struct.pack("<HQ", channel, offsets[channel]) for channel in sorted(offsets))


class ChunkCheck:
    """Watches the chunks of a file."""

    def __init__(self, findings: Findings, definitions: DefinitionCheck) -> None:
        self.facts: dict[int, ChunkFacts] = {}
        """By where the chunk begins."""
        self.counts = np.zeros(CHANNEL_NUMBERS, np.int64)
        """Messages of each channel."""
        self.start_ns, self.end_ns = 2**64, 0
        self.has_outside = False
        """Whether there are messages outside of chunks."""
        self._findings = findings
        self._opening = Opening()
        self._definitions = definitions
        self.content = ContentCheck(findings)
        self._latest: ChunkFacts | None = None  # whose indexes may follow
        self._expected: dict[int, NDArray[Any]] | None = None  # entries of its indexes; None where it can't be opened
        self._offsets: dict[int, int] = {}

    def chunk(self, record: RawRecord) -> None:
        """Take in a chunk."""
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
            self._findings.add("no-crc", "a chunk has no CRC", record.offset)
        try:
            data = self._opening.open_checked(chunk)
        except ChunkError as error:
            self._findings.add("chunk-crc", f"a chunk {error}", record.offset)
            return
        if len(data) != chunk.uncompressed_size:
            text = f"a chunk holds {len(data)} bytes, and says {chunk.uncompressed_size}"
            self._findings.add("chunk-size", text, record.offset)
        contents = read_contents(data)
        for opcode in contents.strangers:
            self._findings.add("chunk-record", f"a chunk holds a {name_of(opcode)}", record.offset)
        for place in contents.breaks:
            rest = len(data) - place
            self._findings.add("chunk-record", f"a chunk ends with {rest} bytes of no record", record.offset)
        self._compare_times(chunk, contents, record.offset)
        self._messages(contents, record.offset)
        self._expect(contents, facts)

    def _compare_times(self, chunk: Chunk, contents: Contents, offset: int) -> None:
        if not len(contents.starts):
            return
        first, last = int(contents.log_times.min()), int(contents.log_times.max())
        if chunk.message_start_time != first:
            text = f"a chunk begins at {chunk.message_start_time}, its earliest message at {first}"
            self._findings.add("chunk-times", text, offset)
        if chunk.message_end_time != last:
            text = f"a chunk ends at {chunk.message_end_time}, its latest message at {last}"
            self._findings.add("chunk-times", text, offset)

    def _expect(self, contents: Contents, facts: ChunkFacts) -> None:
        """Note what the indexes of the chunk must be."""
        order = np.argsort(contents.channels, kind="stable")
        channels, firsts = np.unique(contents.channels[order], return_index=True)
        groups = np.split(contents.entries[order], firsts[1:])
        self._expected = dict(zip(channels.tolist(), groups, strict=False))
        facts.channels = channels.tobytes()

    def message_index(self, record: RawRecord) -> None:
        """Take in a message index: of the chunk before it, one for each channel."""
        channel = int.from_bytes(record.body[:2], "little")
        latest = self._latest
        if latest is None:
            self._findings.add("place", "a MessageIndex doesn't follow a chunk", record.offset)
            return
        self._offsets[channel] = record.offset
        latest.message_index_length += HEAD.size + len(record.body)
        latest.message_index_offsets = pack_offsets(self._offsets)
        if self._expected is None or len(record.body) % INDEX_ENTRY.itemsize != 6:
            if self._expected is not None:
                self._findings.add("message-index", "an index has part of an entry", record.offset)
            return
        found = np.frombuffer(record.body[6:], INDEX_ENTRY)
        expected = self._expected.pop(channel, found[:0])
        if found.tobytes() != expected.tobytes() and np.sort(found, order="offset").tobytes() != expected.tobytes():
            text = f"the index of channel {channel} has {len(found)} entries that aren't its {len(expected)} messages"
            self._findings.add("message-index", text, record.offset)

    def end_indexes(self) -> None:
        """Take notice that the indexes of the latest chunk are over."""
        if self._latest is not None and self._expected:
            channels = [channel for channel, entries in self._expected.items() if len(entries)]
            offset = next(reversed(self.facts))
            if not self._offsets:
                self._findings.add("no-message-index", "a chunk has no message index", offset)
            elif channels:
                text = f"a chunk has no index of the channels {', '.join(map(str, channels))}"
                self._findings.add("message-index", text, offset)
        self._latest = None

    def message(self, record: RawRecord) -> None:
        """Take in a message outside of chunks."""
        self.has_outside = True
        self._messages(message_contents(record), record.offset)

    def _messages(self, contents: Contents, offset: int) -> None:
        """Take in messages, after the definitions that stand between them."""
        channels, firsts = np.unique(contents.channels, return_index=True)
        first_at = dict(zip(channels.tolist(), contents.starts[firsts].tolist(), strict=True))
        known = set(self._definitions.channels)
        for definition in contents.definitions:
            parsed = parse(definition.opcode, definition.body)
            if definition.opcode == Opcode.SCHEMA:
                self._definitions.schema(parsed, offset, is_summary=False)
                self.content.schema(parsed, offset)
            else:
                self._definitions.channel(parsed, offset, is_summary=False)
                if definition.offset < first_at.get(parsed.id, len(contents.data)):
                    known.add(parsed.id)
        for channel in channels.tolist():
            if channel not in known:
                text = f"messages of channel {channel} come before its definition"
                self._findings.add("undefined-channel", text, offset)
        if len(contents.starts):
            self.counts += np.bincount(contents.channels, minlength=CHANNEL_NUMBERS)
            self.start_ns = min(self.start_ns, int(contents.log_times.min()))
            self.end_ns = max(self.end_ns, int(contents.log_times.max()))
            self.content.messages(contents, self._definitions, offset)

    def compare(self, index: ChunkIndex, offset: int) -> None:
        """Compare a chunk index with its chunk."""
        facts = self.facts.get(index.chunk_start_offset)
        if facts is None:
            text = f"a chunk index points to byte {index.chunk_start_offset}, where no chunk begins"
            self._findings.add("chunk-index", text, offset)
            return
        if facts.is_indexed:
            text = f"the chunk at byte {index.chunk_start_offset} is indexed more than once"
            self._findings.add("chunk-index", text, offset)
        facts.is_indexed = True
        pairs = {
            "length": (index.chunk_length, facts.length),
            "start time": (index.message_start_time, facts.message_start_time),
            "end time": (index.message_end_time, facts.message_end_time),
            "compression": (index.compression, facts.compression),
            "compressed size": (index.compressed_size, facts.compressed_size),
            "uncompressed size": (index.uncompressed_size, facts.uncompressed_size),
            "length of message indexes": (index.message_index_length, facts.message_index_length),
        }
        for what, (said, real) in pairs.items():
            if said != real:
                text = f"the {what} of the chunk at byte {index.chunk_start_offset} is {real}, its index says {said}"
                self._findings.add("chunk-index", text, offset)
        if pack_offsets(index.message_index_offsets) != facts.message_index_offsets:
            text = f"the message indexes of the chunk at byte {index.chunk_start_offset} are not where its index says"
            self._findings.add("chunk-index", text, offset)
