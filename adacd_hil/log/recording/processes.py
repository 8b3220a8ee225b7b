"""The processes of a log: how the control process starts the others, the setup of each, and the words between them.

At its start a process reads its setup as JSON from its standard input. It has the messages of the DBC, as far as frames
are decoded by them: to read a DBC takes longer than all else that the writer does before it is ready.
"""

import base64
import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from adacd_hil.log.log_files import MOST_VIEWERS
from adacd_hil.log.types.message_types import MessageType
from adacd_hil.log.types.topics import LogChannel
from adacd_hil.wire.codec_columns import MessageTable, SignalCodec


@dataclass(frozen=True)
class LiveSetup:
    """Where the live view is served (port 0: any that is free), and the arm that it draws.

    robot_description: a URDF. is_upright: gravity acts on the joints. origins, names: of web pages that may watch, and
    of this machine, beside those of log/viewer/admission.py. most_viewers: at a time.
    """

    host: str
    port: int
    robot_description: str
    link_length_m: tuple[float, float]
    is_upright: bool = False
    origins: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    most_viewers: int = MOST_VIEWERS


@dataclass(frozen=True)
class WriterSetup:
    """`channels`: of the file; `messages`: of the DBC, whose frames are decoded.

    `path`: absolute, of the first part. A part ends after `part_bytes` before compression or `part_ns` of log time,
    never where these are 0. `live`: served, unless None.
    """

    path: Path
    is_blocking: bool
    channels: tuple[LogChannel, ...]
    messages: tuple[MessageTable, ...]
    epoch_ns: int
    part_bytes: int
    part_ns: int
    attachments: dict[str, bytes]
    metadata: dict[str, str]
    live: LiveSetup | None = None

    def to_json(self) -> bytes:
        """Write it."""
        table: dict[str, Any] = asdict(self)
        table["path"] = str(self.path)
        table["attachments"] = {name: base64.b64encode(data).decode() for name, data in self.attachments.items()}
        return json.dumps(table).encode()

    @staticmethod
    def from_json(text: bytes) -> "WriterSetup":
        """Read it."""
        table = json.loads(text)
        table["path"] = Path(table["path"])
        table["channels"] = tuple(
            LogChannel(channel["id"], channel["topic"], MessageType(**{**kind, "fields": tuple(kind["fields"])}))
            for channel in table["channels"]
            for kind in (channel["type"],)
        )
        table["messages"] = tuple(
            MessageTable(**{**message, "signals": tuple(SignalCodec(**signal) for signal in message["signals"])})
            for message in table["messages"]
        )
        table["attachments"] = {name: base64.b64decode(data) for name, data in table["attachments"].items()}
        if live := table["live"]:
            tuples = {name: tuple(live[name]) for name in ("link_length_m", "origins", "names")}
            table["live"] = LiveSetup(**{**live, **tuples})
        return WriterSetup(**table)


def start_module(
    module: str, descriptors: Sequence[int], told: bytes, stderr: int | None = None
) -> "subprocess.Popen[bytes]":
    """Run a module of ours with descriptors as its arguments and `told` on its standard input. Raises OSError.

    It is in a session of its own: Ctrl-C is for the control process. No folder but ours is searched for modules.
    stderr: as of subprocess; None: the one of this process.
    """
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", module, *map(str, descriptors)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=stderr,
        pass_fds=descriptors,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": _module_path()},
    )
    assert process.stdin is not None
    with contextlib.suppress(BrokenPipeError), process.stdin:  # one that died says so to who waits for its word
        process.stdin.write(told)
    return process


def _module_path() -> str:
    """Name the folder that this package was imported from, before what the environment names."""
    own = str(Path(__file__).resolve().parents[3])
    return os.pathsep.join(filter(None, (own, os.environ.get("PYTHONPATH", ""))))


WAKE = b"wake"
"""Take what waits in the ring."""
ROOM = b"room"
"""Take some of it and answer the same: there is more room."""
END = b"end"
"""Take it and end the log."""
NOTHING = b""
"""What is received once the other side is dead."""
WATCHED = b"watched"
ALONE = b"alone"
"""Whether somebody watches: from the process of the live view to the writer."""
MOST_BYTES = 65536
