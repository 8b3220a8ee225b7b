"""The processes of a log: how the control process starts the others, the setup of each, and the words between them.

At its start a process reads its setup, pickled, from its standard input, which its parent alone writes. It has the
messages of the DBC, as far as frames are decoded by them: to read a DBC takes longer than all else that the writer does
before it is ready.
"""

import contextlib
import os
import pickle
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from adacd_hil.log.types.topics import LogChannel
from adacd_hil.wire.codec_columns import MessageTable


class LiveFeed(Protocol):
    """A live view of what is logged, open. `url`: where it is served; is_watched: whether somebody looks."""

    url: str

    @property
    def is_watched(self) -> bool: ...  # noqa: D102

    def show(
        self,
        records: NDArray[np.uint8],
        channels: NDArray[np.uint16],
        log_ns: NDArray[np.int64],
        ends: NDArray[np.int64],
    ) -> None:
        """Take message records (b,) that follow each other; channels, log_ns, ends (n,), a record each."""

    def close(self) -> None:
        """End it, and wait for nobody."""


class LiveService(Protocol):
    """A live view to be opened by the writer, in whose process it arrives pickled."""

    def open(self, setup: "WriterSetup", ids: dict[int, int], start_ns: int) -> LiveFeed:
        """Serve. ids: the file's number of each channel; start_ns: before the first record. Raises LogError."""


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
    live: LiveService | None = None


def start_module(
    module: str, descriptors: Sequence[int], told: object, stderr: int | None = None
) -> "subprocess.Popen[bytes]":
    """Run a module of ours with descriptors as its arguments and `told` pickled on its standard input. Raises OSError.

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
        pickle.dump(told, process.stdin)
    return process


def read_setup() -> Any:
    """Return what `start_module` was told, in the process that it started."""
    return pickle.load(sys.stdin.buffer)


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
