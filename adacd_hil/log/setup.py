"""What the writer is told at its start, as JSON on its standard input."""

import base64
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Setup:
    """`codec_path` None is the DBC that comes with the package; `is_truth` makes the emulator's own log.

    `path`: absolute, of the first part. A part ends after `part_bytes` before compression or `part_ns` of log time,
    never where these are 0. `may_rotate`: the log is a file, which others can follow.
    """

    path: Path
    is_truth: bool
    is_blocking: bool
    codec_path: Path | None
    parameter_count: int
    epoch_ns: int
    part_bytes: int
    part_ns: int
    may_rotate: bool
    attachments: dict[str, bytes]
    metadata: dict[str, str]

    def to_json(self) -> bytes:
        """Write it."""
        table: dict[str, Any] = asdict(self)
        table["path"] = str(self.path)
        table["codec_path"] = None if self.codec_path is None else str(self.codec_path)
        table["attachments"] = {name: base64.b64encode(data).decode() for name, data in self.attachments.items()}
        return json.dumps(table).encode()

    @staticmethod
    def from_json(text: bytes) -> "Setup":
        """Read it."""
        table = json.loads(text)
        table["path"] = Path(table["path"])
        table["codec_path"] = None if table["codec_path"] is None else Path(table["codec_path"])
        table["attachments"] = {name: base64.b64decode(data) for name, data in table["attachments"].items()}
        return Setup(**table)
