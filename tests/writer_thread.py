"""The log's writer as a thread: a process of its own takes a third of a second of a processor to begin.

Only in lockstep, where the log is the same whoever writes it, and without a live view. Tests of the process itself use
the fixture `writer_process`.
"""

import os
import pickle
import socket
import subprocess
import threading
from collections.abc import Sequence

from adacd_hil.log.recording.processes import WriterSetup, start_module
from adacd_hil.log.recording.writer import write_log


class WriterThread(threading.Thread):
    """A writer with as much of a process as a `Recorder` asks for."""

    def __init__(self, descriptors: Sequence[int], setup: WriterSetup) -> None:
        super().__init__(daemon=True)
        self._connection, self._file, self._ring = map(os.dup, descriptors)
        self._setup = pickle.loads(pickle.dumps(setup))

    def run(self) -> None:
        with socket.socket(fileno=self._connection) as connection:
            write_log(connection, self._file, self._ring, self._setup)
        os.close(self._ring)

    def kill(self) -> None:
        """Do nothing: it ends by itself, as its socket does."""

    def wait(self, timeout_s: float | None = None) -> int:
        self.join(timeout_s)
        if self.is_alive():
            raise subprocess.TimeoutExpired("writer", timeout_s or 0.0)
        return 0


def started(module: str, descriptors: Sequence[int], setup: WriterSetup) -> "WriterThread | subprocess.Popen[bytes]":
    """Start a writer: what a `Recorder` calls."""
    if not setup.is_blocking or setup.live is not None:
        return start_module(module, descriptors, setup)
    writer = WriterThread(descriptors, setup)
    writer.start()
    return writer
