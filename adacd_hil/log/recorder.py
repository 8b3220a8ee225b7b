"""The control side of the log: hands each cycle to the writer process in one packet, and never waits in real time.

A full socket (the writer is behind) or a dead writer costs packets, never time and never an exception: `dropped`
counts. In lockstep (`blocking`) it waits instead, and nothing is lost; the packets of some cycles go together.
"""

import contextlib
import json
import os
import socket
import stat
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from adacd_hil.log import packet
from adacd_hil.log.errors import LogError
from adacd_hil.log.layout import LAYOUT_NAME, viewer_layout
from adacd_hil.log.outbox import Outbox
from adacd_hil.log.setup import Setup
from adacd_hil.records import PARAMETER_NAMES, Event
from adacd_hil.wire.bus import Frame

START_TIMEOUT_S = 60.0
END_TIMEOUT_S = 60.0
BUFFER_BYTES = 4 * 1024 * 1024
"""Room for packets while the writer is busy: about 1 s at 1 kHz, where the kernel grants it (net.core.wmem_max)."""
_SO_SNDBUFFORCE = 32
_FORMAT_VERSION = "1"


class LogSummary(NamedTuple):
    """How a log ended. `frames` and `messages` are 0 when the writer died; `error` says what went wrong."""

    path: Path
    frames: int
    messages: int
    dropped: int  # packets (cycles and events) that are not in the file
    is_complete: bool
    error: str = ""


class Recorder:
    """Writes one log. Start it before the process pins itself to a processor: the writer inherits that."""

    def __init__(
        self,
        path: Path,
        *,
        codec_path: Path | None = None,
        parameter_count: int = len(PARAMETER_NAMES),
        attachments: Mapping[str, bytes] | None = None,
        metadata: Mapping[str, str] | None = None,
        epoch_ns: int = 0,
        blocking: bool = False,
        is_truth: bool = False,
    ) -> None:
        """Create the file, replacing what is there, and start the writer.

        codec_path: the DBC, default the one that comes with the package. epoch_ns: added to t_ns for the log's times;
        0 in lockstep. is_truth: the emulator's own log, /truth and /events only. Raises LogError.
        """
        own = {
            "format_version": _FORMAT_VERSION,
            "epoch_ns": str(epoch_ns),
            "parameter_count": str(parameter_count),
            "mode": "lockstep" if blocking else "realtime",
        }
        layout = {} if is_truth else {LAYOUT_NAME: viewer_layout()}
        setup = Setup(
            is_truth=is_truth,
            is_blocking=blocking,
            codec_path=codec_path,
            parameter_count=parameter_count,
            epoch_ns=epoch_ns,
            attachments={**(attachments or {}), **layout},
            metadata={**(metadata or {}), **own},
        )
        self.path = path
        self.dropped = 0
        self._summary: LogSummary | None = None
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        _enlarge_buffer(self._socket)
        self._outbox = Outbox() if blocking else None
        with theirs:
            self._process = self._start(theirs, setup)
        self._wait_until_ready()
        self._socket.setblocking(blocking)

    def _start(self, theirs: socket.socket, setup: Setup) -> "subprocess.Popen[bytes]":
        try:
            file = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        except OSError as error:
            self._release()
            raise LogError(f"log {self.path} can't be created: {error.strerror}") from None
        descriptors = (theirs.fileno(), file, *([self._outbox.descriptor] if self._outbox else []))
        try:
            # A session of its own: Ctrl-C is for the control process. No folder but ours is searched for modules.
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", "adacd_hil.log.writer", *map(str, descriptors)],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                pass_fds=descriptors,
                start_new_session=True,
                env={**os.environ, "PYTHONPATH": _module_path()},
            )
        finally:
            os.close(file)
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError), process.stdin:  # a writer that died says so below
            process.stdin.write(setup.to_json())
        return process

    def _wait_until_ready(self) -> None:
        word = self._hear(START_TIMEOUT_S)
        error = "the writer did not start" if word is None else word["error"]
        if error:
            self._process.kill()
            self._process.wait()
            self._release()
            with contextlib.suppress(OSError):
                if stat.S_ISREG(self.path.stat().st_mode):
                    self.path.unlink()
            raise LogError(f"log {self.path} can't be written: {error}")

    @property
    def pid(self) -> int:
        """Process id of the writer."""
        return self._process.pid

    @property
    def waiting_bytes(self) -> int:
        """Bytes that wait for the writer."""
        return 0

    def cycle(
        self, t_ns: int, messages: Sequence[tuple[int, bytes]], frames: Sequence[tuple[bool, Frame]] = ()
    ) -> None:
        """Log a cycle: messages as (ChannelId, body), and its frames, oldest first, True for sent."""
        self._send(packet.pack_cycle(t_ns, self.dropped, messages, frames))

    def event(self, t_ns: int, event: Event) -> None:
        """Log an event."""
        self._send(packet.pack_event(t_ns, self.dropped, event))

    def flush(self) -> None:
        """Hand over what waits to be handed over together."""
        if self._outbox is not None and self._outbox.count:
            self._hand_over(self._outbox.batch(), self._outbox.count)
            self._outbox.clear()

    def _send(self, data: bytes) -> None:
        if self._outbox is None:
            self._hand_over(data, 1)
        elif not self._outbox.put(data):
            self.flush()
            if not self._outbox.put(data):
                self._hand_over(data, 1)

    def _hand_over(self, data: bytes, count: int) -> None:
        try:
            self._socket.send(data)
        except OSError:  # no room, or nobody there
            self.dropped += count

    def close(self) -> LogSummary:
        """End the file and say how it went; never raises, twice is once."""
        if self._summary is None:
            self.flush()
            self._socket.settimeout(END_TIMEOUT_S)
            with contextlib.suppress(OSError):
                self._socket.send(packet.pack_end(self.dropped))
            word = self._hear(END_TIMEOUT_S)
            self._release()
            if word is None:
                self._process.kill()
            self._process.wait()
            self._summary = self._summarise(word)
        return self._summary

    def _release(self) -> None:
        self._socket.close()
        if self._outbox is not None:
            self._outbox.close()

    def _summarise(self, word: dict[str, str] | None) -> LogSummary:
        if word is None:
            error = f"the writer died (exit status {self._process.returncode})"
            return LogSummary(self.path, 0, 0, self.dropped, False, error)
        dropped = self.dropped + int(word["lost"])
        is_complete = not word["error"] and dropped == 0
        return LogSummary(self.path, int(word["frames"]), int(word["messages"]), dropped, is_complete, word["error"])

    def _hear(self, timeout_s: float) -> dict[str, str] | None:
        """Receive the writer's word; None when it died or stays silent."""
        self._socket.settimeout(timeout_s)
        try:
            received = self._socket.recv(65536)
        except OSError:
            return None
        word: dict[str, str] = json.loads(received) if received else {}
        return word or None

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _enlarge_buffer(connection: socket.socket) -> None:
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
    with contextlib.suppress(OSError):  # beyond the limit with CAP_NET_ADMIN only
        connection.setsockopt(socket.SOL_SOCKET, _SO_SNDBUFFORCE, BUFFER_BYTES)


def _module_path() -> str:
    """Name the folder that this package was imported from, before what the environment names."""
    own = str(Path(__file__).resolve().parents[2])
    return os.pathsep.join(filter(None, (own, os.environ.get("PYTHONPATH", ""))))
