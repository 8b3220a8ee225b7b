"""The rules on the summary: its statements about attachments, metadata, messages and itself."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Footer, MetadataIndex, Statistics, SummaryOffset

from adacd_hil.log.check.chunk_checks import ChunkCheck
from adacd_hil.log.check.content_checks import DefinitionCheck
from adacd_hil.log.check.findings import Findings
from adacd_hil.log.mcap.mcap_records import HEAD, RawRecord, parse


class SummaryCheck:
    """Watches the summary of a file, and the facts that it must state."""

    def __init__(self, findings: Findings, definitions: DefinitionCheck, chunks: ChunkCheck) -> None:
        self.statistics: Statistics | None = None
        self._findings = findings
        self._definitions = definitions
        self._chunks = chunks
        self._attachments: dict[int, AttachmentIndex] = {}  # what the indexes must be, by offset
        self._metadata: dict[int, MetadataIndex] = {}
        self._attachment_count = self._metadata_count = 0
        self._indexed: set[int] = set()
        self._start = 0  # of the summary; 0: none so far
        self._groups: list[list[int]] = []  # opcode, start, end of each
        self._offsets: list[tuple[int, SummaryOffset]] = []
        self._offset_start = 0

    def attachment(self, record: RawRecord, attachment: Attachment) -> None:
        """Take in an attachment."""
        self._attachment_count += 1
        self._attachments[record.offset] = AttachmentIndex(
            offset=record.offset,
            length=HEAD.size + len(record.body),
            log_time=attachment.log_time,
            create_time=attachment.create_time,
            data_size=len(attachment.data),
            name=attachment.name,
            media_type=attachment.media_type,
        )

    def metadata(self, record: RawRecord, name: str) -> None:
        """Take in a metadata record."""
        self._metadata_count += 1
        self._metadata[record.offset] = MetadataIndex(record.offset, HEAD.size + len(record.body), name)

    def record(self, record: RawRecord) -> None:
        """Take in a record of the summary, but for its definitions."""
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
        elif record.opcode == Opcode.ATTACHMENT_INDEX:
            self._compare("attachment-index", self._attachments, parse(record.opcode, record.body), record.offset)
        elif record.opcode == Opcode.METADATA_INDEX:
            self._compare("metadata-index", self._metadata, parse(record.opcode, record.body), record.offset)
        elif record.opcode == Opcode.STATISTICS:
            if self.statistics is not None:
                self._findings.add("statistics", "there is more than one Statistics", record.offset)
            self.statistics = parse(record.opcode, record.body)
            self._check_counted_channels(self.statistics, record.offset)

    def _compare(self, rule: str, expected: Mapping[int, Any], index: Any, offset: int) -> None:
        kind = rule.removesuffix("-index")
        if index.offset in self._indexed:
            self._findings.add(rule, f"the {kind} at byte {index.offset} is indexed more than once", offset)
        elif index.offset not in expected:
            self._findings.add(rule, f"an index points to byte {index.offset}, where no {kind} begins", offset)
        elif index != expected[index.offset]:
            text = f"an index says {index}, it is {expected[index.offset]}"
            self._findings.add(rule, text, offset)
        self._indexed.add(index.offset)

    def _check_counted_channels(self, statistics: Statistics | None, offset: int) -> None:
        if statistics is None or not statistics.channel_message_counts:
            return
        needed = {*self._definitions.channels, *statistics.channel_message_counts}
        for channel in sorted(needed - self._definitions.summary_channels):
            text = f"channel {channel} is counted, but isn't defined in the summary before the Statistics"
            self._findings.add("summary-channels", text, offset)

    def footer(self, record: RawRecord, crc: int) -> None:
        """Take in the footer; `crc`: of the summary up to its own."""
        footer: Footer = parse(record.opcode, record.body)
        if footer.summary_start != self._start:
            text = f"the Footer says that the summary begins at byte {footer.summary_start}, it is {self._start}"
            self._findings.add("summary-offset", text, record.offset)
        if footer.summary_offset_start != self._offset_start:
            text = f"the Footer says {footer.summary_offset_start} for the summary offsets, it is {self._offset_start}"
            self._findings.add("summary-offset", text, record.offset)
        if not footer.summary_crc:
            self._findings.add("no-crc", "the summary has no CRC", record.offset)
        elif footer.summary_crc != crc:
            self._findings.add("summary-crc", "the summary fails its CRC", record.offset)

    def finish(self) -> None:
        """Judge the summary as a whole."""
        self._check_groups()
        self._check_indexes()
        if self.statistics is not None:
            self._check_statistics(self.statistics)

    def _check_groups(self) -> None:
        groups = {(opcode, start, end - start) for opcode, start, end in self._groups}
        for offset, said in self._offsets:
            if (said.group_opcode, said.group_start, said.group_length) not in groups and said.group_length:
                text = f"a group is said to be at byte {said.group_start}, {said.group_length} bytes, and isn't"
                self._findings.add("summary-offset", text, offset)

    def _check_indexes(self) -> None:
        if not self._groups:
            return
        kinds = {group[0] for group in self._groups}
        chunks = self._chunks.facts
        if chunks and Opcode.CHUNK_INDEX not in kinds:
            self._findings.add("no-chunk-index", "the summary has no chunk indexes")
        elif chunks:
            for offset in (offset for offset, facts in chunks.items() if not facts.is_indexed):
                self._findings.add("chunk-index", "a chunk isn't in the index", offset)
            self._check_needed_channels()
        if self._chunks.has_outside and Opcode.CHUNK_INDEX in kinds:
            self._findings.add("unindexed-messages", "there are messages outside chunks, which no index has")
        for rule, opcode, expected in (
            ("attachment-index", Opcode.ATTACHMENT_INDEX, self._attachments),
            ("metadata-index", Opcode.METADATA_INDEX, self._metadata),
        ):
            if opcode in kinds:
                for offset in sorted(set(expected) - self._indexed):
                    self._findings.add(rule, f"a record has no {rule.replace('-', ' ')}", offset)

    def _check_needed_channels(self) -> None:
        used = {
            int(channel)
            for facts in self._chunks.facts.values()
            if facts.is_indexed
            for channel in np.frombuffer(facts.channels, np.uint16)
        }
        for channel in sorted(used - self._definitions.summary_channels):
            self._findings.add("summary-channels", f"channel {channel} of an indexed chunk isn't in the summary")
        schemas = {self._definitions.channels[channel].schema_id for channel in used & set(self._definitions.channels)}
        for schema in sorted(schemas - self._definitions.summary_schemas - {0}):
            self._findings.add("summary-channels", f"schema {schema} of an indexed chunk isn't in the summary")

    def _check_statistics(self, statistics: Statistics) -> None:
        chunks = self._chunks
        total = int(chunks.counts.sum())
        pairs = {
            "messages": (statistics.message_count, total),
            "schemas": (statistics.schema_count, len({*self._definitions.schemas, *self._definitions.summary_schemas})),
            "channels": (
                statistics.channel_count,
                len({*self._definitions.channels, *self._definitions.summary_channels}),
            ),
            "attachments": (statistics.attachment_count, self._attachment_count),
            "metadata records": (statistics.metadata_count, self._metadata_count),
            "chunks": (statistics.chunk_count, len(chunks.facts)),
        }
        for what, (said, real) in pairs.items():
            if said != real:
                self._findings.add("statistics", f"there are {real} {what}, the Statistics say {said}")
        if total:
            for what, said, real in (
                ("first", statistics.message_start_time, chunks.start_ns),
                ("last", statistics.message_end_time, chunks.end_ns),
            ):
                if said != real:
                    text = f"the {what} message is of {real}, the Statistics say {said}"
                    self._findings.add("statistics", text)
        counts = statistics.channel_message_counts
        if counts:
            for channel in sorted({*counts, *np.flatnonzero(chunks.counts).tolist()}):
                said, real = counts.get(channel, 0), int(chunks.counts[channel])
                if said != real:
                    text = f"channel {channel} has {real} messages, the Statistics say {said}"
                    self._findings.add("statistics", text)
