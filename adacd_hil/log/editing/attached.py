"""What precedes the first chunk of a log, read without the log itself: attachments and metadata of the run."""

from collections.abc import Iterator
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Attachment, Metadata

from adacd_hil.input_files import open_input
from adacd_hil.log.errors import LogError
from adacd_hil.log.mcap.mcap_records import MAGIC, RawRecord, parse, scan
from adacd_hil.log.mcap_file import RUN_METADATA


def attachment(path: Path, name: str) -> bytes | None:
    """Return an attachment of an MCAP file by its name; None when it isn't among what precedes the first chunk."""
    for record in _records_before_chunks(path):
        if isinstance(record, Attachment) and record.name == name:
            return record.data
    return None


def run_metadata(path: Path) -> dict[str, str]:
    """Return the metadata of the run in an MCAP file; empty when they aren't among what precedes the first chunk."""
    for record in _records_before_chunks(path):
        if isinstance(record, Metadata) and record.name == RUN_METADATA:
            return record.metadata
    return {}


def _records_before_chunks(path: Path) -> Iterator[Attachment | Metadata]:
    """Give the records before the first chunk, as far as they are sound: who reads the log says what is wrong."""
    try:
        with open_input(path) as file:
            if file.read(len(MAGIC)) != MAGIC:
                return
            for record in scan(file):
                if not isinstance(record, RawRecord) or record.opcode == Opcode.CHUNK:
                    return
                if record.opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
                    yield parse(record.opcode, record.body)
    except (OSError, LogError):
        return
