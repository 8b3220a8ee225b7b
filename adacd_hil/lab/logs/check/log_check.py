"""The check of logs: each file by itself, then the parts of a log against each other.

The rules are in `findings.RULES`: those of `mcap doctor` (foxglove/mcap), all CRCs, indexes against records, and our
own. The check reads a file once, from front to back, in constant memory but for 0.5 kB per chunk, and passes each
record to the rules that concern it.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Header, Metadata

from adacd_hil.file_access import open_input
from adacd_hil.lab.logs.check.content_checks import DefinitionCheck
from adacd_hil.lab.logs.check.findings import Findings, LogFinding, Severity
from adacd_hil.lab.logs.check.structure_checks import ChunkCheck, SummaryCheck
from adacd_hil.lab.logs.record_scan import FileGap, scan
from adacd_hil.log.log_files import (
    CONTINUED,
    ENDING_KEY,
    PART_KEY,
    RUN_METADATA,
    SUFFIX,
    SUMMARY_METADATA,
    LogError,
    failing_as,
    find_parts,
    part_path,
)
from adacd_hil.log.log_parts import DROPPED_KEY, LOST_KEY, PLANNED_ENDINGS, missing_parts, parts_of
from adacd_hil.log.mcap.mcap_records import RawRecord, attachment_crc_fits, crc_of, name_of, parse
from adacd_hil.log.mcap.record_layout import HEAD, MAGIC, crc32
from adacd_hil.log.types.record_arrays import FRAME_TOPICS

_DATA = {Opcode.CHUNK, Opcode.MESSAGE, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA}
_SUMMARY = {
    Opcode.STATISTICS,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET,
}
_ONCE = {Opcode.HEADER: "header", Opcode.DATA_END: "data-end", Opcode.FOOTER: "footer"}
"""Records of which a file has one, and their rules."""
_PROFILES = ("", "ros1", "ros2")
_FOOTER_CRC = 4
_DATA_SECTION = "data section"


class _FileCheck:
    """The check of one file by itself, done at construction; then `findings`, metadata and counts are filled."""

    def __init__(self, name: str, file: IO[bytes]) -> None:
        """Check a whole file. The results are in `findings`, `metadata`, `messages` and `frames`."""
        self.metadata: dict[str, dict[str, str]] = {}
        self.messages = self.frames = 0
        self._file = file
        self.findings = Findings(name)
        self._definitions = DefinitionCheck(self.findings)
        self._chunks = ChunkCheck(self.findings, self._definitions)
        self._summary = SummaryCheck(self.findings, self._definitions, self._chunks)
        self.is_ended = False  # DataEnd is behind: what follows is the summary
        self._crc = 0  # of the section so far
        self._counts = dict.fromkeys(_ONCE, 0)
        self._has_trailer = False
        self._run()

    def _run(self) -> None:
        magic = self._file.read(len(MAGIC))
        is_right = magic == MAGIC
        if not is_right:
            self.findings.add_finding("magic", "the file doesn't begin with MCAP's magic", 0)
        self._crc = crc32(magic) if is_right else 0
        end = len(magic) if is_right else 0
        for item in scan(self._file):
            if isinstance(item, RawRecord):
                self._record(item)
                end = item.end
            elif item.is_behind:
                self.findings.add_finding("magic", f"{item.size} bytes follow the end", item.offset)
            else:
                self._gap(item)
                end = item.offset + item.size
        self._file.seek(end)
        self._has_trailer = bool(self._counts[Opcode.FOOTER]) and self._file.read(len(MAGIC)) == MAGIC
        self._chunks.end_indexes()
        self._chunks.end_messages()
        self._finish()
        counts, channels = self._chunks.counts, self._definitions.channels
        self.messages = int(counts.sum())
        self.frames = sum(int(counts[number]) for number in channels if channels[number].topic in FRAME_TOPICS)

    def _gap(self, gap: FileGap) -> None:
        """Add a finding on bytes that form no record, and add them to the CRC."""
        self.findings.add_finding("record", f"{gap.size} bytes are no record", gap.offset)
        position = self._file.tell()
        self._crc = crc_of(self._file, gap.offset, gap.offset + gap.size, self._crc)
        self._file.seek(position)

    def _record(self, record: RawRecord) -> None:
        """Add a record to the CRC of its section and check it; a DataEnd ends the data section.

        A record that can't be parsed makes a finding. A record other than a MessageIndex ends the indexes of the latest
        chunk, one other than a Message the messages in a row outside of chunks.
        """
        head = HEAD.pack(record.opcode, len(record.body))
        if record.opcode != Opcode.MESSAGE_INDEX:
            self._chunks.end_indexes()
        if record.opcode != Opcode.MESSAGE:
            self._chunks.end_messages()
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
            self.findings.add_finding("record", str(error), record.offset)

    def _count(self, record: RawRecord) -> None:
        """Count a record that a file may have only once, and add a finding for the second and later ones."""
        opcode = Opcode(record.opcode)
        self._counts[opcode] += 1
        if self._counts[opcode] > 1:
            self.findings.add_finding(_ONCE[opcode], f"there is more than one {name_of(opcode)}", record.offset)

    def _data_end(self, record: RawRecord) -> None:
        self._count(record)
        stored = int.from_bytes(record.body, "little")
        if not stored:
            self.findings.without_crc[_DATA_SECTION] += 1
        elif stored != self._crc:
            self.findings.add_finding("data-crc", "the data section fails its CRC", record.offset)
        self.is_ended = True
        self._crc = 0

    def _judge(self, record: RawRecord) -> None:
        """Check a record by the rules for its kind; add a finding on an unknown kind or a wrong section.

        Raises LogError if the record can't be parsed.
        """
        opcode = record.opcode
        if opcode not in set(Opcode):
            self.findings.add_finding("unknown-record", f"{name_of(opcode)} of {len(record.body)} bytes", record.offset)
            return
        if opcode in (_DATA if self.is_ended else _SUMMARY):
            where = "summary" if self.is_ended else "data section"
            self.findings.add_finding("place", f"{name_of(opcode)} in the {where}", record.offset)
            return
        if self.is_ended:
            self._summary.record(record)
        match opcode:
            case Opcode.HEADER:
                self._header(record)
            case Opcode.SCHEMA:
                self._definitions.schema(parse(opcode, record.body), record.offset, self.is_ended)
            case Opcode.CHANNEL:
                self._definitions.channel(parse(opcode, record.body), record.offset, self.is_ended)
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
                self.metadata[metadata.name] = metadata.metadata
                self._summary.metadata(record, metadata.name)

    def _header(self, record: RawRecord) -> None:
        self._count(record)
        if record.offset != len(MAGIC):
            self.findings.add_finding("header", "the Header doesn't come first", record.offset)
        header: Header = parse(record.opcode, record.body)
        if not header.library:
            self.findings.add_finding("library", "the Header doesn't say what wrote the file", record.offset)
        if header.profile not in _PROFILES:
            self.findings.add_finding("profile", f"the profile {header.profile!r} is not a known one", record.offset)

    def _attachment(self, record: RawRecord) -> None:
        attachment = parse(record.opcode, record.body)
        self._summary.attachment(record, attachment)
        if record.body[-4:] == bytes(4):
            self.findings.without_crc["attachment"] += 1
        elif not attachment_crc_fits(record):
            self.findings.add_finding(
                "attachment-crc", f"the attachment {attachment.name} fails its CRC", record.offset
            )

    def _finish(self) -> None:
        """Add the findings on the file as a whole: missing records, its end, definitions, summary and missing CRCs."""
        for opcode, rule in _ONCE.items():
            if not self._counts[opcode]:
                self.findings.add_finding(rule, f"there is no {name_of(opcode)}")
        if not self._has_trailer:
            size = self._file.seek(0, 2)
            self.findings.add_finding("magic", "the file doesn't end with a Footer and MCAP's magic", size)
        self._definitions.finish(self._chunks.counts)
        self._summary.finish()
        self._judge_missing_crcs()

    def _judge_missing_crcs(self) -> None:
        """Add a note on the parts that no CRC covers, and a warning if only some chunks have one.

        The CRC of the data section covers all that is in it; it is in the DataEnd, which a cut file lacks.
        """
        missing, chunks = self.findings.without_crc, len(self._chunks.facts)
        missing[_DATA_SECTION] += not self.is_ended
        if not missing[_DATA_SECTION]:
            missing = Counter(summary=missing["summary"])
        elif 0 < missing["chunk"] < chunks:
            text = f"{missing['chunk']} of {chunks} chunks have no CRC, nor has the data section"
            self.findings.add_finding("some-crc", text)
        elif chunks and not missing["chunk"] and not self._chunks.has_outside:
            missing = missing - Counter([_DATA_SECTION])  # each chunk has its own
        parts = [f"{count} {part}s" if count > 1 else f"the {part}" for part, count in missing.items() if count]
        if parts:
            self.findings.add_finding(
                "no-crc", f"nothing vouches for these bytes, which have no CRC: {', '.join(parts)}"
            )


class LogCheck(NamedTuple):
    """The findings in a log, with all its parts.

    path: of the first part. files: number of parts. errors, warnings, notes: numbers of all findings; `findings` lists
    fewer where a rule was broken often.
    """

    path: Path
    files: int
    messages: int
    findings: list[LogFinding]
    errors: int  # more than are in `findings` where a rule was broken often
    warnings: int
    notes: int


def find_logs(given: Path) -> list[Path]:
    """Return the paths of the logs in a folder and below: each .mcap file except later parts of a log.

    Any other path is returned as it is.

    Raises LogError for a folder without a log.
    """
    if not given.is_dir():
        return [given]
    files = sorted(given.rglob(f"*{SUFFIX}"))
    if not files:
        raise LogError(f"folder {given} has no {SUFFIX} file")
    later = {part for file in files for number, part in find_parts(file).items() if number}
    return [file for file in files if file not in later]


def check_log(path: Path, progress: Callable[[str], None] = lambda _: None) -> LogCheck:
    """Check the log whose first part is `path`, with all its parts; return the findings.

    progress: called with a line per file. Raises LogError if a file can't be read.
    """
    parts = parts_of(path)
    checked: dict[int, _FileCheck] = {}
    for number, part in parts.items():
        progress(f"checking {part.name}")
        with failing_as(f"log {part} can't be read"), open_input(part) as file:
            checked[number] = _FileCheck(part.name, file)
    whole = Findings(path.name)
    _check_parts(path, checked, whole)
    for facts in checked.values():
        _check_words(facts)
    all_findings = [whole, *(facts.findings for facts in checked.values())]
    return LogCheck(
        path,
        len(parts),
        sum(facts.messages for facts in checked.values()),
        [finding for findings in all_findings for finding in findings.found],
        sum(findings.count(Severity.ERROR) for findings in all_findings),
        sum(findings.count(Severity.WARNING) for findings in all_findings),
        sum(findings.count(Severity.NOTE) for findings in all_findings),
    )


def _check_parts(path: Path, checked: dict[int, _FileCheck], findings: Findings) -> None:
    """Check that no part of a log is missing, and that all are of one run; add findings.

    A part whose metadata have another number than its name has a finding, too.
    """
    last = max(checked)
    for missing in missing_parts(path, checked):
        findings.add_finding("missing-part", f"{missing.name} is missing")
    if _summary(checked[last]).get(ENDING_KEY) == CONTINUED:
        findings.add_finding(
            "missing-part", f"{part_path(path, last + 1).name} is missing: the part before says it follows"
        )
    runs = {number: facts.metadata[RUN_METADATA] for number, facts in checked.items() if RUN_METADATA in facts.metadata}
    first = next(iter(runs.values()), {})
    for number, run in runs.items():
        name = part_path(path, number).name
        different = sorted(key for key, _ in {*_identity(run)} ^ {*_identity(first)})
        if different:
            text = f"{name} is of another run: {', '.join(dict.fromkeys(different))} differ"
            findings.add_finding("foreign-part", text)
        said = run.get(PART_KEY, str(number))
        if said != str(number):
            findings.add_finding("foreign-part", f"{name} is part {said} of a log")


def _identity(run: dict[str, str]) -> Iterator[tuple[str, str]]:
    return (pair for pair in run.items() if pair[0] != PART_KEY)


def _summary(facts: _FileCheck) -> dict[str, str]:
    return facts.metadata.get(SUMMARY_METADATA, {})


def _check_words(facts: _FileCheck) -> None:
    """Compare the counts in a file's metadata with its contents; check its ending, dropped packets and losses.

    Adds findings. A file without our metadata is skipped.
    """
    findings, summary = facts.findings, _summary(facts)
    if RUN_METADATA not in facts.metadata:
        return
    if not summary:
        if facts.is_ended:
            findings.add_finding("ending", "the log doesn't say why it ended")
        return
    for key, real in (("messages", facts.messages), ("frames", facts.frames)):
        if summary.get(key, str(real)) != str(real):
            findings.add_finding("counts", f"there are {real} {key}, the summary says {summary[key]}")
    dropped = summary.get(DROPPED_KEY, "0")
    if dropped != "0":
        findings.add_finding("dropped", f"{dropped} packets were dropped on the way to the log")
    ending = summary.get(ENDING_KEY, "")
    if ending not in PLANNED_ENDINGS:
        findings.add_finding(
            "ending", f"the log ended because: {ending}" if ending else "the log doesn't say why it ended"
        )
    if LOST_KEY in summary:
        findings.add_finding("lost", f"lost before it was recovered: {summary[LOST_KEY]}")
