"""The writer's side of the live view: records go into a ring that a process of its own looks into.

Nothing here waits for that process. Records that find the ring full are not shown; one that is stopped, dead or busy
with five hundred viewers costs the log nothing. Only the writer's start waits until it listens, or says why it can't.
"""

import contextlib
import json
import os
import socket
import struct
import subprocess
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.log.log_files import LogError
from adacd_hil.log.recording import processes
from adacd_hil.log.recording.processes import WriterSetup, start_module
from adacd_hil.log.recording.ring import Ring

_HEAD = struct.Struct("<Q")


class Batch(NamedTuple):
    """Message records that follow each other, as the writer lays them down for the file.

    records: their bytes (b,) uint8; channels: the file's numbers (n,) uint16; log_ns: log times (n,) int64; ends: where
    each record ends (n,) int64.
    """

    records: NDArray[np.uint8]
    channels: NDArray[np.uint16]
    log_ns: NDArray[np.int64]
    ends: NDArray[np.int64]


class ServerSetup(NamedTuple):
    """ids: the file's number of each channel, by ours; start_ns: log time before the first record."""

    setup: WriterSetup
    ids: dict[int, int]
    start_ns: int


def pack_batch(batch: Batch) -> bytes:
    """Write a batch: the number of its records, their times, ends and channels, then their bytes."""
    columns = (batch.log_ns, batch.ends, batch.channels, batch.records)
    return _HEAD.pack(len(batch.ends)) + b"".join(column.tobytes() for column in columns)


def unpack_batch(data: bytes) -> Batch:
    """Read it; no bytes are copied."""
    (count,) = _HEAD.unpack_from(data)
    place = _HEAD.size
    log_ns = np.frombuffer(data, np.int64, count, place)
    ends = np.frombuffer(data, np.int64, count, place + 8 * count)
    channels = np.frombuffer(data, np.uint16, count, place + 16 * count)
    records = np.frombuffer(data, np.uint8, -1, place + 18 * count)
    return Batch(records, channels, log_ns, ends)


START_TIMEOUT_S = 30.0
RING_BYTES = 8 * 1024 * 1024
"""3.8 s of a certified run at 1 kHz: longer than any viewer's request keeps the other process busy."""


class LiveFeed:
    """Records for the live view. `url`: where it is; `process`: serves it; `hidden`: batches without room."""

    def __init__(self, setup: WriterSetup, ids: dict[int, int], start_ns: int) -> None:
        """Start the process, and wait until it listens where `setup.live` says. Raises LogError.

        ids: the file's number of each channel, by ours. start_ns: log time before the first record.
        """
        self.hidden = 0
        self._is_watched = False
        assert setup.live is not None
        place = f"{setup.live.host}:{setup.live.port}"
        told = ServerSetup(replace(setup, attachments={}, metadata={}), ids, start_ns)
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._ring = Ring(RING_BYTES)
            descriptors = (theirs.fileno(), self._ring.descriptor)
            # Whatever its libraries might say of what a viewer sent stays away from the run's terminal.
            notices = os.dup(2)
            try:
                self.process = start_module(
                    "adacd_hil.log.viewer.server", (*descriptors, notices), told, subprocess.DEVNULL
                )
            finally:
                os.close(notices)
        except OSError as error:
            self._socket.close()
            raise LogError(f"the live view can't start: {error}") from None
        finally:
            theirs.close()
        word = self._hear()
        if word["error"]:
            self.process.kill()
            self.process.wait()
            self._release()
            raise LogError(f"the live view can't listen on {place}: {word['error']}")
        self.url = word["url"]
        self._socket.setblocking(False)

    def _hear(self) -> dict[str, str]:
        self._socket.settimeout(START_TIMEOUT_S)
        try:
            received = self._socket.recv(processes.MOST_BYTES)
        except OSError:
            received = b""
        word: dict[str, str] = json.loads(received) if received else {"error": "it did not start"}
        return word

    @property
    def is_watched(self) -> bool:
        """Whether somebody is there to see what is shown."""
        with contextlib.suppress(BlockingIOError, ConnectionResetError):
            while word := self._socket.recv(processes.MOST_BYTES):
                self._is_watched = word == processes.WATCHED
            self._is_watched = False  # nobody is left
        return self._is_watched

    @property
    def waiting_bytes(self) -> int:
        """Bytes that the other side has not taken yet."""
        return self._ring.waiting

    def show(
        self,
        records: NDArray[np.uint8],
        channels: NDArray[np.uint16],
        log_ns: NDArray[np.int64],
        ends: NDArray[np.int64],
    ) -> None:
        """Hand over message records that follow each other, of which the other side shows some; see Batch."""
        if not len(ends) or not self.is_watched:
            return
        if not self._ring.put(pack_batch(Batch(records, channels, log_ns, ends))):
            self.hidden += 1
            return
        self._say(processes.WAKE)

    def _say(self, word: bytes) -> None:
        with contextlib.suppress(OSError):  # it has words that it hasn't heard yet, or is dead
            self._socket.send(word)

    def close(self) -> None:
        """Let it send what it has, and end, in its own time."""
        self._say(processes.END)
        self._release()

    def _release(self) -> None:
        self._socket.close()
        self._ring.close()
