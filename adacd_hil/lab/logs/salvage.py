"""The trusted records of a file, whatever happened to it.

Salvage trusts a message when a CRC vouches for it: that of its chunk, or that of the whole data section. So it takes
nothing from the beginning of a chunk that was cut or damaged: of 1000 decompressed so, two gave wrong messages.
Metadata and message indexes have no CRC of their own; recovery makes indexes anew and takes metadata where their shape
is right.

Many recorders write no CRC. A file in which neither a chunk nor the data section has one is read as a reader of streams
reads it: whole chunks that open, and messages outside of chunks up to the first damage. `Losses.unvouched` counts these
messages.
"""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Chunk, Metadata, Statistics
from numpy.typing import NDArray

from adacd_hil.file_access import open_input
from adacd_hil.lab.logs.record_scan import FileGap, chunk_crc, scan
from adacd_hil.log.log_files import LogError, failing_as
from adacd_hil.log.mcap.chunks import ChunkError, Contents, Opening, message_contents, read_contents
from adacd_hil.log.mcap.mcap_records import (
    DEFINITIONS,
    Definitions,
    RawRecord,
    attachment_crc_fits,
    crc_of,
    parse,
    read_end,
)

_NOTES = 20
"""Damages that are listed one by one."""


@dataclass
class Losses:
    """The records that could not be saved.

    `bytes`: in gaps and in lost records. `messages`: None if their number is unknown. `unvouched`: messages that were
    saved though no CRC vouches for them. `is_cut`: the file has no end. `is_doubtful`: the data section fails its CRC,
    though no damage was found. `holes_s`: gaps in time between saved messages. `notes`: a line for each damage, the
    first `_NOTES`.
    """

    chunks: int = 0
    bytes: int = 0
    messages: int | None = 0
    unvouched: int = 0  # messages that were saved though no CRC vouches for them
    attachments: int = 0
    metadata: int = 0
    is_cut: bool = False
    is_doubtful: bool = False  # the data section fails its CRC for no reason that was found: metadata may be wrong
    notes: list[str] = field(default_factory=list)
    holes_s: list[float] = field(default_factory=list)  # lengths of the gaps between the saved messages
    missing_parts: list[str] = field(default_factory=list)

    @property
    def is_any(self) -> bool:
        """Whether anything is lost, or metadata may be wrong.

        A gap in time alone is no loss, nor are messages that no CRC vouches for.
        """
        return bool(self.describe())

    def describe(self) -> str:
        """Return the losses in words; "" without a loss. Gaps in time are named only beside another loss."""
        messages = "an unknown number of messages" if self.messages is None else f"{self.messages} messages"
        head = [
            ("the end", self.is_cut),
            (messages, self.messages != 0),
            (f"{self.chunks} chunks", self.chunks),
        ]
        tail = [
            (f"{self.attachments} attachments", self.attachments),
            (f"{self.metadata} metadata records", self.metadata),
            (", ".join(self.missing_parts), self.missing_parts),
            ("metadata may be wrong", self.is_doubtful),
        ]
        holes = (
            f"{sum(self.holes_s):.3f} s between what was saved",
            self.holes_s and any(is_said for _, is_said in head + tail),
        )
        return ", ".join(word for word, is_said in (*head, holes, *tail) if is_said)

    def add_note(self, text: str) -> None:
        """Add a line on a damage to `notes`, unless it has `_NOTES` already."""
        if len(self.notes) < _NOTES:
            self.notes.append(text)

    def add_losses(self, other: "Losses") -> None:
        """Add the losses of another file to these, except `missing_parts`, and notes beyond `_NOTES`.

        The number of messages becomes None if it is unknown in one of them.
        """
        self.chunks += other.chunks
        self.bytes += other.bytes
        is_known = self.messages is not None and other.messages is not None
        self.messages = (self.messages or 0) + (other.messages or 0) if is_known else None
        self.unvouched += other.unvouched
        self.attachments += other.attachments
        self.metadata += other.metadata
        self.is_cut |= other.is_cut
        self.is_doubtful |= other.is_doubtful
        self.holes_s += other.holes_s
        for note in other.notes:
            self.add_note(note)


class Salvage:
    """One file: iterate once for its trusted attachments, metadata records and messages; then `losses` is filled.

    `definitions`, of schemas and channels, fill up on the way.
    """

    def __init__(self, path: Path) -> None:
        """Read the summary of a file, and find which CRCs it has; this may read all of the file.

        Raises LogError if it can't be read.
        """
        self.losses = Losses()
        self.definitions = Definitions()
        self.is_vouched = False
        """Whether the CRC of the data section fits: then everything is as it was written."""
        self._is_unchecked = False
        """Whether neither a chunk nor the data section has a CRC."""
        self._path = path
        self._opening = Opening()
        self._statistics: Statistics | None = None
        self._saved_messages = self._saved_attachments = self._saved_metadata = 0
        self._latest_ns = 0
        self._is_hole = False
        self._is_explained = False  # why the CRC of the data section doesn't fit
        self._has_data_end = self._has_footer = False
        self._chunk: tuple[Contents, NDArray[np.void]] | None = None  # the latest one, and the index that it must have
        self._data_end = RawRecord(0, Opcode.DATA_END, b"")
        self._left_out = 0  # messages that no CRC vouches for, or without their channel
        with failing_as(f"log {path} can't be read"), open_input(path) as file:
            self._look_at_end(file)

    def _look_at_end(self, file: IO[bytes]) -> None:
        """Keep definitions and statistics of a sound summary; set `is_vouched` by the CRC of the data section.

        Store, too, whether the file has no CRC at all in its data section and chunks.
        """
        end = read_end(file)
        has_data_crc = end is not None and end.data_crc != 0
        chunks = (item for item in scan(file) if isinstance(item, RawRecord) and item.opcode == Opcode.CHUNK)
        self._is_unchecked = not has_data_crc and not any(chunk_crc(chunk) for chunk in chunks)
        if end is None:
            return
        self.is_vouched = end.data_crc != 0 and end.data_crc == crc_of(file, 0, end.data_end)
        with contextlib.suppress(LogError):  # written wrong: of no use
            self.definitions.add_records(end.summary)
            for record in end.summary:
                if record.opcode == Opcode.STATISTICS:
                    self._statistics = parse(record.opcode, record.body)

    def __iter__(self) -> Iterator[Attachment | Metadata | Contents]:
        with open_input(self._path) as file:
            for item in scan(file):
                if isinstance(item, FileGap):
                    if item.is_behind or not self._has_data_end:
                        self._lose(item.offset, item.size, "behind the end" if item.is_behind else "no record")
                elif not self._has_data_end:
                    yield from self._take(item)
            if self._has_data_end and not self.is_vouched and not self._is_explained:
                self._doubt(file)
        self._sum_up()

    def _take(self, record: RawRecord) -> Iterator[Attachment | Metadata | Contents]:
        """Yield the content of a record if it can be trusted; else add it to the losses.

        Definitions are kept, not yielded; untrusted ones are passed over. Metadata are trusted without a CRC. A message
        outside of chunks that can't be trusted is counted as left out.
        """
        opcode = record.opcode
        is_trusted = self.is_vouched or (self._is_unchecked and not self.losses.bytes)
        try:
            if opcode == Opcode.CHUNK:
                yield from self._take_chunk(record)
            elif opcode == Opcode.MESSAGE and is_trusted:
                yield from self._give(message_contents(record), self.is_vouched)
            elif opcode == Opcode.MESSAGE:
                self._left_out += 1
            elif opcode in DEFINITIONS and is_trusted:
                self.definitions.add_record(record)
            elif opcode == Opcode.ATTACHMENT:
                if not attachment_crc_fits(record, self.is_vouched or self._is_unchecked):
                    self._lose(record.offset, len(record.body), "attachment fails its CRC")
                    return
                self._saved_attachments += 1
                yield parse(opcode, record.body)
            elif opcode == Opcode.METADATA:
                metadata = parse(opcode, record.body)
                self._saved_metadata += 1
                yield metadata
            elif opcode == Opcode.MESSAGE_INDEX:
                self._compare_index(record.body)
            elif opcode == Opcode.FOOTER:
                self._has_footer = True
            elif opcode == Opcode.DATA_END:
                self._has_data_end = True
                self._data_end = record
        except (ChunkError, LogError) as error:
            self.losses.chunks += opcode == Opcode.CHUNK
            self._lose(record.offset, len(record.body), str(error))

    def _take_chunk(self, record: RawRecord) -> Iterator[Contents]:
        """Yield the content of a chunk, and keep its definitions.

        Raises ChunkError if it can't be opened or fails its CRC. Raises ChunkError, too, if no CRC vouches for it. In a
        file without CRCs it does so only if the chunk holds other bytes than whole messages and definitions.
        """
        self._chunk = None
        chunk: Chunk = parse(record.opcode, record.body)
        is_vouched = self.is_vouched or chunk.uncompressed_crc != 0
        if not is_vouched and not self._is_unchecked:
            raise ChunkError("has no CRC, and that of the whole doesn't fit")
        contents = read_contents(self._opening.open_chunk(chunk))
        if not is_vouched and (contents.breaks or contents.strangers):
            raise ChunkError("has no CRC, and holds what is no message")
        self.definitions.add_records(contents.definitions)
        if not self.is_vouched:
            self._chunk = contents, contents.entries
        if len(contents.log_times):
            times = int(contents.log_times.min()), int(contents.log_times.max())
            self._is_explained |= times != (chunk.message_start_time, chunk.message_end_time)
        self._is_explained |= len(contents.data) != chunk.uncompressed_size
        yield from self._give(contents, is_vouched)

    def _give(self, contents: Contents, is_vouched: bool) -> Iterator[Contents]:
        """Yield messages, and count them for the losses.

        is_vouched: a CRC vouches for them. Counts those saved, unvouched or without a channel, and adds the gap in time
        before them if something was lost in it.
        """
        known = np.isin(contents.channels, list(self.definitions.channels))
        self._left_out += int(np.count_nonzero(~known))
        saved = int(np.count_nonzero(known))
        self._saved_messages += saved
        self.losses.unvouched += 0 if is_vouched else saved
        if len(contents.log_times):
            if self._is_hole:
                self.losses.holes_s.append(max(0, int(contents.log_times.min()) - self._latest_ns) * 1e-9)
            self._is_hole = not known.all()
            self._latest_ns = max(self._latest_ns, int(contents.log_times.max()))
        yield contents

    def _compare_index(self, body: bytes) -> None:
        """Compare a message index with its chunk. A difference explains why the CRC of the data section fails."""
        if self._chunk is not None:
            contents, entries = self._chunk
            is_own = contents.channels == int.from_bytes(body[:2], "little")
            self._is_explained |= body[6:] != entries[is_own].tobytes()

    def _doubt(self, file: IO[bytes]) -> None:
        """Mark the losses as doubtful, and add a note, if the data section has a CRC and fails it.

        Then metadata may be wrong. Call it only if no damage was found that explains the failure.
        """
        stored = int.from_bytes(self._data_end.body, "little")
        if stored and stored != crc_of(file, 0, self._data_end.offset):
            self.losses.is_doubtful = True
            self.losses.add_note(
                f"{self._path.name}: fails the CRC of the whole, nothing shows where: perhaps in metadata"
            )

    def _lose(self, offset: int, size: int, reason: str) -> None:
        self.losses.add_note(f"{self._path.name}: byte {offset}, {size} bytes: {reason}")
        self.losses.bytes += size
        self._is_hole = True
        self._is_explained = True

    def _sum_up(self) -> None:
        """Fill in `losses` at the end of the file: whether it is cut, and how many messages and other records are lost.

        The numbers follow from the statistics of a sound summary. Without one, that of messages is None if bytes are
        lost or the file is cut, else that of the messages left out; the others stay.
        """
        losses, statistics = self.losses, self._statistics
        losses.is_cut = not self._has_data_end and not self._has_footer and statistics is None
        if losses.is_cut:
            losses.add_note(f"{self._path.name}: cut, it has no end")
        if statistics is not None:
            losses.messages = max(0, statistics.message_count - self._saved_messages)
            losses.attachments = max(0, statistics.attachment_count - self._saved_attachments)
            losses.metadata = max(0, statistics.metadata_count - self._saved_metadata)
            return
        losses.messages = None if losses.bytes or losses.is_cut else self._left_out
