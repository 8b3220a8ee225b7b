"""Processes of a log: their start by the control process, their setup, and the messages between them.

A process reads its setup, pickled, from its standard input, to which only its parent writes. The setup contains the
messages of the DBC whose frames are decoded, since reading a DBC takes longer than the rest of the writer's start.
"""

import contextlib
import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from adacd_hil.log.types.topics import LogChannel
from adacd_hil.wire.message_table import MessageTable


class LoggedMessage(NamedTuple):
    """A message of the log. channel: its id in the file; log_ns, publish_ns: its times in the file."""

    channel: int
    log_ns: int
    publish_ns: int
    payload: bytes


class LiveFeed(Protocol):
    """An open live view of the log. `url`: its address; is_watched: whether a viewer is connected."""

    url: str

    @property
    def is_watched(self) -> bool: ...  # noqa: D102

    def show(self, messages: Sequence[LoggedMessage]) -> None:
        """Send messages, consecutive in the log, to the viewers."""

    def end_view(self) -> None:
        """End the view; don't wait for viewers."""


LiveService = Callable[["WriterSetup", dict[int, int], int], LiveFeed]
"""Opens a live view in the writer process, to which it is sent pickled. Raises LogError.

It takes the log's setup, the file's id of each channel, and a log time before the first record.
"""


@dataclass(frozen=True)
class WriterSetup:
    """Setup of the writer. `channels`: of the file; `messages`: of the DBC, whose frames are decoded.

    `path`: absolute, of the first part. is_blocking: lockstep. epoch_ns: added to the packets' times. A part ends after
    `part_bytes` before compression or `part_ns` of log time; 0: no limit. `live`: the view to open, or None.
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
    live: LiveService | None = None


def start_module(
    module: str, descriptors: Sequence[int], setup: object, stderr: int | None = None
) -> "subprocess.Popen[bytes]":
    """Start a process that runs a module of ours, and return it. Raises OSError if it can't be started.

    Its arguments are the descriptors; it reads `setup`, pickled, from its standard input, and its standard output is
    dropped. It runs in a session of its own, so that Ctrl-C reaches only the control process, and imports this package
    from its own folder, not from the current one. stderr: as in subprocess; None: this process's.
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
    with contextlib.suppress(BrokenPipeError), process.stdin:  # a dead process is noticed where its answer is awaited
        pickle.dump(setup, process.stdin)
    return process


def read_setup() -> Any:
    """Return the setup that `start_module` has sent to this process."""
    return pickle.load(sys.stdin.buffer)


def _module_path() -> str:
    """Return a PYTHONPATH: the folder that contains `adacd_hil`, then those of the environment's PYTHONPATH."""
    own = str(Path(__file__).resolve().parents[3])
    return os.pathsep.join(filter(None, (own, os.environ.get("PYTHONPATH", ""))))


WAKE = b"wake"
"""Take the packets waiting in the ring."""
ROOM = b"room"
"""Take some packets, then answer the same: there is more room."""
END = b"end"
"""Take all packets and end the log."""
NOTHING = b""
"""Received when the other side is dead."""
WATCHED = b"watched"
ALONE = b"alone"
"""Sent by the live view's process to the writer: whether a viewer is connected."""
MOST_BYTES = 65536
