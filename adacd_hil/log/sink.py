"""A file that is written by a thread of its own, so that a slow disk doesn't stop the writer from taking packets.

The first failure (disk full) ends the file at the last whole write; what comes after is swallowed, and `error` says so.
"""

import contextlib
import os
import queue
import threading

_MAX_WAITING = 512
"""Writes that may wait for the disk; four per chunk of 256 KiB, so at most 32 MiB."""


class Sink:
    """What `mcap.writer.Writer` needs of a stream, over a file descriptor that it closes."""

    def __init__(self, descriptor: int) -> None:
        self.error = ""
        self._descriptor = descriptor
        self._position = 0
        self._queue: queue.Queue[bytes | None] = queue.Queue(_MAX_WAITING)
        self._thread = threading.Thread(target=self._write_all, name="log sink", daemon=True)
        self._thread.start()

    def write(self, data: bytes) -> int:
        """Queue `data`; waits when the disk is 32 MiB behind."""
        self._position += len(data)
        if data:
            self._queue.put(data)
        return len(data)

    def tell(self) -> int:
        """Return how many bytes have been handed over."""
        return self._position

    def flush(self) -> None:
        """Do nothing: the thread writes as soon as it can."""

    def settle(self) -> None:
        """Wait until everything handed over is written or has failed."""
        self._queue.join()

    def close(self) -> None:
        """Write what is waiting, then close the file."""
        self._queue.put(None)
        self._thread.join()

    def _write_all(self) -> None:
        written = 0
        while (data := self._queue.get()) is not None:
            if not self.error:
                try:
                    _write(self._descriptor, data)
                    written += len(data)
                except OSError as error:
                    self.error = f"{error.strerror} after {written} bytes"
                    with contextlib.suppress(OSError):  # not everything that can be written can be cut
                        os.ftruncate(self._descriptor, written)
            self._queue.task_done()
        try:
            os.close(self._descriptor)
        except OSError as error:  # network file systems report their failures here
            self.error = self.error or f"{error.strerror} after {written} bytes"


def _write(descriptor: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]
