"""A log that is read as it is, record for record, all parts as one; at the first damage it says so and stops."""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import IO

from mcap.opcode import Opcode
from mcap.records import Attachment, Metadata

from adacd_hil.input_files import open_input
from adacd_hil.log.errors import LogError
from adacd_hil.log.mcap.chunk_contents import Contents, message_contents, read_contents
from adacd_hil.log.mcap.definitions import Definitions
from adacd_hil.log.mcap.file_end import crc_of, read_end
from adacd_hil.log.mcap.mcap_records import MAGIC, Gap, RawRecord, attachment_crc_fits, parse, scan
from adacd_hil.log.mcap.opening import ChunkError, Opening
from adacd_hil.log.mcap_file import PART_KEY, RUN_METADATA, SUMMARY_METADATA
from adacd_hil.log.parts import find_parts, part_path
from adacd_hil.log.summary import DROPPED_KEY, number


class IntactLog:
    """Iterate for attachments and chunks; metadata and definitions fill up on the way.

    Iterating raises LogError at damage, at a missing part, and when a file can't be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.definitions = Definitions()
        self.metadata: dict[str, dict[str, str]] = {}
        """By name, the first of each name; `run` without the number of its part; without `summary`."""
        self._opening = Opening()
        self.dropped = 0
        """Packets that the parts say are not in them."""

    def __iter__(self) -> Iterator[Attachment | Contents]:
        try:
            parts = find_parts(self.path) or {0: self.path}
        except OSError:
            parts = {0: self.path}
        for before, after in pairwise((-1, *parts)):
            if after != before + 1:
                raise LogError(f"{part_path(self.path, before + 1)} is missing: recover the log first")
        attached = set()
        for part in parts.values():
            for item in self._read(part):
                if isinstance(item, Attachment):
                    if item.name in attached:
                        continue
                    attached.add(item.name)
                yield item

    def _read(self, path: Path) -> Iterator[Attachment | Contents]:
        try:
            with open_input(path) as file:
                _check_ends(path, file)
                for item in scan(file):
                    if isinstance(item, Gap):
                        raise _damaged(path, item.offset)
                    if isinstance(item, RawRecord):
                        yield from self._take(path, item)
        except OSError as error:
            raise LogError(f"log {path} can't be read: {error.strerror}") from None

    def _take(self, path: Path, record: RawRecord) -> Iterator[Attachment | Contents]:
        """Give what is in a record of the data section; the summary only repeats it."""
        opcode, body = record.opcode, record.body
        if opcode == Opcode.CHUNK:
            yield self._open(path, record.offset, body)
        elif opcode == Opcode.MESSAGE:
            yield message_contents(record)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self.definitions.take((record,))
        elif opcode == Opcode.ATTACHMENT:
            if not attachment_crc_fits(body):
                raise _damaged(path, record.offset)
            yield parse(opcode, body)
        elif opcode == Opcode.METADATA:
            self._take_metadata(parse(opcode, body))

    def _open(self, path: Path, offset: int, body: bytes) -> Contents:
        try:
            contents = read_contents(self._opening.open_checked(parse(Opcode.CHUNK, body)))
        except ChunkError:
            raise _damaged(path, offset) from None
        self.definitions.take(contents.definitions)
        return contents

    def _take_metadata(self, item: Metadata) -> None:
        if item.name == SUMMARY_METADATA:
            self.dropped += number(item.metadata, DROPPED_KEY)
            return
        table = dict(item.metadata)
        if item.name == RUN_METADATA:
            table.pop(PART_KEY, None)
            if self.metadata.get(RUN_METADATA, table) != table:
                raise LogError(f"{self.path}: its parts are of different runs")
        self.metadata.setdefault(item.name, table)


def _check_ends(path: Path, file: IO[bytes]) -> None:
    """Raise LogError when a file has no beginning or no end, or when the data section fails its CRC."""
    if file.read(len(MAGIC)) != MAGIC:
        raise LogError(f"{path} is not an MCAP file")
    end = read_end(file)
    if end is None:
        raise LogError(f"{path} is cut, it has no end: recover it first")
    if end.data_crc and end.data_crc != crc_of(file, 0, end.data_end):
        raise LogError(f"{path} is damaged, it fails its CRC: recover it first")


def _damaged(path: Path, offset: int) -> LogError:
    return LogError(f"{path} is damaged at byte {offset}: recover it first")
