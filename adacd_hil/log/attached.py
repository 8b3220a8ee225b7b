"""What is attached to a log, found without reading the log: our files have it before the first chunk."""

from pathlib import Path

from mcap.exceptions import McapError
from mcap.records import Attachment, Chunk
from mcap.stream_reader import StreamReader


def attachment(path: Path, name: str) -> bytes | None:
    """Return an attachment of an MCAP file by its name; None when it isn't among what precedes the first chunk."""
    try:
        with path.open("rb") as file:
            for record in StreamReader(file, emit_chunks=True).records:
                if isinstance(record, Attachment) and record.name == name:
                    return record.data
                if isinstance(record, Chunk):
                    break
    except (McapError, OSError, ValueError):
        pass  # who reads the log says what is wrong with it
    return None
