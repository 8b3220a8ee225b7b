"""The check of one file: every record is read once, in order, and handed to the rules it concerns."""

from pathlib import Path
from typing import IO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Header, Metadata

from adacd_hil.input_files import open_input
from adacd_hil.log.check.chunk_checks import ChunkCheck
from adacd_hil.log.check.definition_checks import DefinitionCheck
from adacd_hil.log.check.findings import Findings
from adacd_hil.log.check.summary_checks import SummaryCheck
from adacd_hil.log.errors import LogError
from adacd_hil.log.mcap.mcap_records import (
    HEAD,
    MAGIC,
    Gap,
    RawRecord,
    Trailer,
    attachment_crc_fits,
    crc32,
    name_of,
    parse,
    scan,
)
from adacd_hil.log.summary import count_frames

_DATA = {Opcode.CHUNK, Opcode.MESSAGE, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA}
_SUMMARY = {
    Opcode.STATISTICS,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET,
}
_PROFILES = ("", "ros1", "ros2")
_FOOTER_CRC = 4
_BLOCK = 1 << 20


class FileFacts(NamedTuple):
    """What a checked file says of itself."""

    findings: Findings
    metadata: dict[str, dict[str, str]]
    messages: int
    frames: int
    is_ended: bool


def check_file(path: Path) -> FileFacts:
    """Check a file by itself. Raises LogError when it can't be read."""
    try:
        with open_input(path) as file:
            return _FileCheck(path.name, file).run()
    except OSError as error:
        raise LogError(f"log {path} can't be read: {error.strerror}") from None


class _FileCheck:
    def __init__(self, name: str, file: IO[bytes]) -> None:
        self._file = file
        self._findings = Findings(name)
        self._definitions = DefinitionCheck(self._findings)
        self._chunks = ChunkCheck(self._findings, self._definitions)
        self._summary = SummaryCheck(self._findings, self._definitions, self._chunks)
        self._metadata: dict[str, dict[str, str]] = {}
        self._is_summary = False  # DataEnd is behind
        self._crc = 0  # of the section so far
        self._counts = {Opcode.HEADER: 0, Opcode.DATA_END: 0, Opcode.FOOTER: 0}
        self._has_trailer = False

    def run(self) -> FileFacts:
        magic = self._file.read(len(MAGIC))
        is_right = magic == MAGIC
        if not is_right:
            self._findings.add("magic", "the file doesn't begin with MCAP's magic", 0)
        self._crc = crc32(magic) if is_right else 0
        end = len(magic) if is_right else 0
        for item in scan(self._file):
            if isinstance(item, Trailer):
                self._has_trailer = True
                end = item.offset + len(MAGIC)
            elif isinstance(item, Gap):
                self._gap(item)
                end = item.offset + item.size
            else:
                self._record(item)
                end = item.end
        self._chunks.end_indexes()
        self._finish(end)
        topics = {number: channel.topic for number, channel in self._definitions.channels.items()}
        counts = {number: int(self._chunks.counts[number]) for number in topics}
        total = int(self._chunks.counts.sum())
        is_ended = self._counts[Opcode.DATA_END] > 0
        return FileFacts(self._findings, self._metadata, total, count_frames(topics, counts), is_ended)

    def _gap(self, gap: Gap) -> None:
        """Tell of bytes that are no record; they count for the CRC."""
        self._findings.add("record", f"{gap.size} bytes are no record", gap.offset)
        position = self._file.tell()
        self._file.seek(gap.offset)
        left = gap.size
        while left > 0 and (block := self._file.read(min(_BLOCK, left))):
            self._crc = crc32(block, self._crc)
            left -= len(block)
        self._file.seek(position)

    def _record(self, record: RawRecord) -> None:
        head = HEAD.pack(record.opcode, len(record.body))
        if record.opcode != Opcode.MESSAGE_INDEX:
            self._chunks.end_indexes()
        if record.opcode == Opcode.DATA_END:
            self._data_end(record)
            return
        if record.opcode == Opcode.FOOTER:
            self._count(record)
            crc = crc32(record.body[:-_FOOTER_CRC], crc32(head, self._crc))
            self._summary.footer(record, crc)
            return
        self._crc = crc32(record.body, crc32(head, self._crc))
        try:
            self._judge(record)
        except LogError as error:
            self._findings.add("record", str(error), record.offset)

    def _count(self, record: RawRecord) -> None:
        """Count records of which there is one."""
        opcode = Opcode(record.opcode)
        self._counts[opcode] += 1
        if self._counts[opcode] > 1:
            rule = {Opcode.HEADER: "header", Opcode.DATA_END: "data-end", Opcode.FOOTER: "footer"}[opcode]
            self._findings.add(rule, f"there is more than one {name_of(opcode)}", record.offset)

    def _data_end(self, record: RawRecord) -> None:
        self._count(record)
        stored = int.from_bytes(record.body, "little")
        if not stored:
            self._findings.add("no-crc", "the data section has no CRC", record.offset)
        elif stored != self._crc:
            self._findings.add("data-crc", "the data section fails its CRC", record.offset)
        self._is_summary = True
        self._crc = 0

    def _judge(self, record: RawRecord) -> None:
        opcode = record.opcode
        if opcode not in set(Opcode):
            self._findings.add("unknown-record", f"{name_of(opcode)} of {len(record.body)} bytes", record.offset)
            return
        if opcode in (_DATA if self._is_summary else _SUMMARY):
            where = "summary" if self._is_summary else "data section"
            self._findings.add("place", f"{name_of(opcode)} in the {where}", record.offset)
            return
        if self._is_summary:
            self._summary.record(record)
        match opcode:
            case Opcode.HEADER:
                self._header(record)
            case Opcode.SCHEMA:
                schema = parse(opcode, record.body)
                self._definitions.schema(schema, record.offset, self._is_summary)
                self._chunks.content.schema(schema, record.offset)
            case Opcode.CHANNEL:
                self._definitions.channel(parse(opcode, record.body), record.offset, self._is_summary)
            case Opcode.CHUNK:
                self._chunks.chunk(record)
            case Opcode.MESSAGE_INDEX:
                self._chunks.message_index(record)
            case Opcode.MESSAGE:
                self._chunks.message(record)
            case Opcode.ATTACHMENT:
                self._attachment(record)
            case Opcode.METADATA:
                metadata: Metadata = parse(opcode, record.body)
                self._metadata[metadata.name] = metadata.metadata
                self._summary.metadata(record, metadata.name)

    def _header(self, record: RawRecord) -> None:
        self._count(record)
        if record.offset != len(MAGIC):
            self._findings.add("header", "the Header doesn't come first", record.offset)
        header: Header = parse(record.opcode, record.body)
        if not header.library:
            self._findings.add("library", "the Header doesn't say what wrote the file", record.offset)
        if header.profile not in _PROFILES:
            self._findings.add("profile", f"the profile {header.profile!r} is not a known one", record.offset)

    def _attachment(self, record: RawRecord) -> None:
        attachment = parse(record.opcode, record.body)
        self._summary.attachment(record, attachment)
        if record.body[-4:] == bytes(4):
            self._findings.add("no-crc", f"the attachment {attachment.name} has no CRC", record.offset)
        elif not attachment_crc_fits(record.body):
            self._findings.add("attachment-crc", f"the attachment {attachment.name} fails its CRC", record.offset)

    def _finish(self, end: int) -> None:
        """Judge the file as a whole; it was read up to `end`."""
        for opcode, rule in ((Opcode.HEADER, "header"), (Opcode.DATA_END, "data-end"), (Opcode.FOOTER, "footer")):
            if not self._counts[opcode]:
                self._findings.add(rule, f"there is no {name_of(opcode)}")
        self._file.seek(0, 2)
        size = self._file.tell()
        if not self._has_trailer:
            self._findings.add("magic", "the file doesn't end with a Footer and MCAP's magic", size)
        elif end < size:
            self._findings.add("magic", f"{size - end} bytes follow the end", end)
        self._definitions.finish(has_messages=bool(self._chunks.counts.any()))
        self._summary.finish()
