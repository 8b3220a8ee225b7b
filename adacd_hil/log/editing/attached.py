"""What precedes the first chunk of a log, read without the log itself: attachments and metadata of the run."""

from collections.abc import Iterator
from pathlib import Path

from mcap.exceptions import McapError
from mcap.records import Attachment, Chunk, McapRecord, Metadata
from mcap.stream_reader import StreamReader

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


def _records_before_chunks(path: Path) -> Iterator[McapRecord]:
    """Give the records before the first chunk, as far as they are sound: who reads the log says what is wrong."""
    try:
        with path.open("rb") as file:
            for record in StreamReader(file, emit_chunks=True).records:
                if isinstance(record, Chunk):
                    return
                yield record
    except (McapError, OSError, ValueError):
        return
