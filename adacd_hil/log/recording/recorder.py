"""The control process's side of the log: passes each cycle to the writer process, without waiting in real time.

In real time a packet costs no system call: it goes into shared memory that the writer polls. If the ring is full (the
writer is behind, stopped or dead) packets are lost and counted in `dropped`; the cycle neither waits nor gets an
exception. In lockstep (`blocking`) the recorder wakes the writer now and then, and waits while the ring is full; it
loses a packet only if the writer is dead or the ring too small for it.
"""

import contextlib
import json
import os
import socket
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Self

from adacd_hil.error_texts import error_text
from adacd_hil.file_access import create_file
from adacd_hil.log.log_files import LogError, LogExistsError
from adacd_hil.log.log_parts import parts_of
from adacd_hil.log.recording import packet, processes
from adacd_hil.log.recording.processes import LiveService, WriterSetup, start_module
from adacd_hil.log.recording.ring import Ring, padded_bytes
from adacd_hil.log.recording.run_folder import make_room
from adacd_hil.log.types.topics import LogChannel, run_channels
from adacd_hil.records import PARAMETER_NAMES, Event
from adacd_hil.settings.run_settings import LogSettings
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.message_table import MessageTable, plain_tables

START_TIMEOUT_S = 60.0
END_TIMEOUT_S = 60.0
DEATH_TIMEOUT_S = 1.0
"""Longest time from the end of the writer's socket to the end of its process."""
WAKE_BYTES = 64 * 1024
"""Bytes, about 100 cycles, that go to the writer together in lockstep, so that system calls are cheap per cycle."""
_MIB = 1024 * 1024
_MINUTE_NS = 60_000_000_000
_FORMAT_VERSION = "1"


class LogSummary(NamedTuple):
    """Result of a log. `frames` and `messages` are 0 if the writer died; `error`: in one line, or "".

    parts: number of files.
    """

    path: Path  # of the first part
    frames: int
    messages: int
    dropped: int  # packets (cycles and events) that are not in the log
    error: str
    parts: int
    queue_peak_bytes: int  # most that the writer found waiting for it

    @property
    def is_complete(self) -> bool:
        """Whether there was no error, and no packet was dropped."""
        return not self.error and self.dropped == 0


class Recorder:
    """Writes one log by a process of its own; close it at the end.

    Start it before the control process pins itself to a processor, since the writer inherits that.
    """

    def __init__(
        self,
        path: Path,
        *,
        messages: Iterable[MessageTable] = (),
        parameter_count: int = len(PARAMETER_NAMES),
        further_count: int = 0,
        channel_count: int = 0,
        attachments: Mapping[str, bytes] | None = None,
        metadata: Mapping[str, str] | None = None,
        epoch_ns: int = 0,
        blocking: bool = False,
        channels: tuple[LogChannel, ...] | None = None,
        settings: LogSettings | None = None,
        live: LiveService | None = None,
    ) -> None:
        """Create the file, which must not exist (see run_folder.py), and start the writer.

        The log of a start that failed is moved aside first. messages: of the DBC, whose frames are decoded. The
        counts: see `run_channels`; by default those of the paper's scheme. attachments, metadata: at the file's
        beginning. epoch_ns: added to t_ns for the log's times; 0 in lockstep. blocking: lockstep. channels: of a log
        that is no run's. settings: sizes of parts and buffer. live: live view to open. Raises LogExistsError if a log
        is there already, LogError if the file or the writer can't be made.
        """
        settings = settings or LogSettings()
        own = {
            "format_version": _FORMAT_VERSION,
            "epoch_ns": str(epoch_ns),
            "parameter_count": str(parameter_count),
            "mode": "lockstep" if blocking else "realtime",
        }
        self.path = path
        self.dropped = 0
        self.live_url = ""
        """Address of the live view; "" without one."""
        self._summary: LogSummary | None = None
        self._is_blocking = blocking
        self._unannounced = 0  # bytes in the ring since the writer was last woken
        told = plain_tables(messages)
        try:
            channels = channels or run_channels(parameter_count, told, further_count, channel_count)
        except LogError as error:
            raise LogError(f"log {path} can't be written: {error}") from None
        file = _create(path)
        setup = WriterSetup(
            path=path.absolute(),
            is_blocking=blocking,
            channels=channels,
            messages=told,
            epoch_ns=epoch_ns,
            part_bytes=settings.part_MiB * _MIB,
            part_ns=round(settings.part_min * _MINUTE_NS),
            attachments=dict(attachments or {}),
            metadata={**(metadata or {}), **own},
            live=live,
        )
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._ring = Ring(settings.buffer_MiB * _MIB)
            self._process = start_module(
                "adacd_hil.log.recording.writer", (theirs.fileno(), file, self._ring.descriptor), setup
            )
        except OSError as error:
            self._socket.close()
            lack = f"no writer with a buffer of {settings.buffer_MiB} MiB: {error_text(error)}"
            raise LogError(f"log {path}: {lack}") from None
        finally:
            theirs.close()
            os.close(file)
        self._wait_until_ready()
        self._socket.setblocking(True)

    def _wait_until_ready(self) -> None:
        """Wait until the writer is ready, and store the address of its live view.

        If it reports an error, or sends nothing within START_TIMEOUT_S, end it, remove the file and raise LogError.
        """
        word = self._hear(START_TIMEOUT_S)
        error = "the writer did not start" if word is None else word["error"]
        if error:
            self._process.kill()
            self._process.wait()
            self._release()
            with contextlib.suppress(OSError):
                self.path.unlink()
            raise LogError(f"log {self.path} can't be written: {error}")
        assert word is not None
        self.live_url = word["live_url"]

    @property
    def pid(self) -> int:
        """Process id of the writer."""
        return self._process.pid

    @property
    def waiting_bytes(self) -> int:
        """Bytes in the ring that the writer hasn't taken; 0 in lockstep, where they depend on chance.

        Costs no system call.
        """
        return 0 if self._is_blocking else self._ring.waiting

    def cycle(
        self, t_ns: int, messages: Sequence[tuple[int, bytes]], frames: Sequence[tuple[bool, Frame]] = ()
    ) -> None:
        """Hand a cycle to the writer. messages: (ChannelId, body); frames: oldest first, each with True if it was sent.

        If the ring is full, wait in lockstep; in real time, or if the writer is dead or the ring too small for the
        cycle, drop the cycle and count it in `dropped`.
        """
        self._put(packet.pack_cycle(t_ns, self.dropped, messages, frames))

    def event(self, t_ns: int, event: Event) -> None:
        """Hand an event to the writer; with a full ring wait or drop it as `cycle` does."""
        self._put(packet.pack_event(t_ns, self.dropped, event))

    def flush(self) -> None:
        """Wake the writer to take the packets in the ring."""
        self._unannounced = 0
        with contextlib.suppress(OSError):  # its socket is full, so it will wake anyway, or it is dead
            self._socket.send(processes.WAKE, socket.MSG_DONTWAIT)

    def _put(self, data: bytes) -> None:
        """Put a packet into the ring; if that is full, wait in lockstep, in real time count the packet in `dropped`.

        In lockstep wake the writer after each WAKE_BYTES, and count a packet if the writer is dead or the ring too
        small for it.
        """
        if not self._ring.put_packet(data) and not (self._is_blocking and self._put_patiently(data)):
            self.dropped += 1
            self._ring.count_dropped(self.dropped)
        elif self._is_blocking:
            self._unannounced += len(data)
            if self._unannounced >= WAKE_BYTES:
                self.flush()

    def _put_patiently(self, data: bytes) -> bool:
        """Add a packet as soon as there is room, and return True.

        False if the writer is dead or the ring is too small for it.
        """
        is_put = False
        with contextlib.suppress(OSError):  # the writer is dead
            while not is_put and padded_bytes(len(data)) <= self._ring.capacity:
                self._socket.send(processes.ROOM)
                if self._socket.recv(processes.MOST_BYTES) == processes.NOTHING:
                    break
                is_put = self._ring.put_packet(data)
        return is_put

    def close(self) -> LogSummary:
        """End the log and return its summary; a second call returns the same summary. Raises no error."""
        if self._summary is None:
            self._socket.settimeout(END_TIMEOUT_S)
            with contextlib.suppress(OSError):
                self._socket.send(processes.END)
            self._summary = self._summarise(self._hear(END_TIMEOUT_S))
            self._release()
        return self._summary

    def _release(self) -> None:
        self._socket.close()
        self._ring.close()

    def _summarise(self, word: dict[str, str] | None) -> LogSummary:
        """Wait for the end of the writer's process, and return the summary.

        word: the writer's last message, None if it died or is silent. Without it the writer is ended, the log is
        incomplete, `frames` and `messages` are 0, and the packets that it had not written count as dropped.
        """
        error = self._end_writer() if word is None else word["error"]
        self._process.wait()
        peak = self._ring.peak
        if word is not None:
            counts = int(word["frames"]), int(word["messages"]), self.dropped + int(word["lost"])
            return LogSummary(self.path, *counts, error, int(word["parts"]), peak)
        self.dropped += self._ring.packets - self._ring.written
        return LogSummary(self.path, 0, 0, self.dropped, error, len(parts_of(self.path)), peak)

    def _end_writer(self) -> str:
        """Return the error of a silent writer in words: its exit status if it ends within DEATH_TIMEOUT_S.

        Else it is killed, without waiting for its end.
        """
        try:
            return f"the writer died (exit status {self._process.wait(DEATH_TIMEOUT_S)})"
        except subprocess.TimeoutExpired:
            self._process.kill()
            return f"the writer did not end within {END_TIMEOUT_S:g} s"

    def _hear(self, timeout_s: float) -> dict[str, str] | None:
        """Return the next message of the writer; None if it died, or sends none within timeout_s."""
        self._socket.settimeout(timeout_s)
        try:
            received = self._socket.recv(processes.MOST_BYTES)
        except OSError:
            return None
        word: dict[str, str] = json.loads(received) if received else {}
        return word or None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _create(path: Path) -> int:
    """Create the first part of a log, the log of a failed start moved aside; return its file descriptor.

    Raises LogExistsError if a log is there already, LogError if the file can't be created.
    """
    make_room(path)
    try:
        return create_file(path)
    except FileExistsError:  # created since `make_room`
        raise LogExistsError(f"{path} is being written by another run; choose another folder with --out") from None
    except OSError as error:
        raise LogError(f"log {path} can't be created: {error.strerror}") from None
