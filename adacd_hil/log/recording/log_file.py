"""The MCAP file of a run, and the thread that writes it, so that a slow disk doesn't block the writer process.

The file: header, attachments and metadata first, then chunks, then the summary. Attachments and metadata come before
the first chunk, so that they survive when the file is cut.

The thread: the amount of data waiting for the disk is bounded. Above the bound `is_behind` is true until half of it is
written; a caller that must not lose packets makes `write` wait. The first error (disk full) ends a file at the last
whole write; the thread drops later data and counts its packets, until another file is begun.
"""

import contextlib
import os
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path, PurePath

from mcap.records import Attachment

from adacd_hil.file_access import create_file
from adacd_hil.log.log_files import FIELDS_KEY, QOS_KEY, ROS_PROFILE, RUN_METADATA, SUMMARY_METADATA
from adacd_hil.log.mcap.chunked_file import ChunkedFile
from adacd_hil.log.types.topics import LogChannel

WAITING_BYTES = 32 * 1024 * 1024
"""Most bytes waiting for the disk: about 36 s of `certified` at 1 kHz, compressed."""


class Sink:
    """Writes the bytes of `McapFile` to a file descriptor, on a thread of its own, and closes the descriptor."""

    def __init__(
        self,
        descriptor: int,
        path: Path | None = None,
        waits: bool = True,
        most_waiting: int = WAITING_BYTES,
        on_written: Callable[[int], None] = lambda _: None,
    ) -> None:
        """Write to `descriptor`, which belongs to the file `path`.

        waits: `write` blocks while `most_waiting` bytes or more wait. on_written: called by the thread with the number
        of packets that each write has brought to the disk.
        """
        self.error = ""
        """Error that ended the present file early."""
        self.first_error = ""
        """Error that ended any file early; the first one."""
        self.written = 0
        """Bytes of the present file that are on the disk."""
        self.path = path
        """The present file; None if it could not be created."""
        self.say: Callable[[str], None] = lambda _: None
        """Called by the thread with one line when a file fails and when one is written again."""
        self._has_told = False
        self._descriptor = descriptor
        self._name = ""  # of a later file
        self._waits = waits
        self._most_waiting = most_waiting
        self._on_written = on_written
        self._position = 0
        self._tasks: deque[tuple[bytes, int] | Path | None] = deque()  # data and their packets; a file to begin
        self._waiting = 0  # bytes
        self._is_idle = True
        self._is_behind = False
        self._lost = 0
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="log sink", daemon=True)
        self._thread.start()

    def write(self, data: bytes, packets: int = 0) -> int:
        """Queue `data` for the disk; return their length. packets: number of packets that end with them.

        Block while too many bytes wait, if the sink `waits`.
        """
        self._position += len(data)
        if data:
            with self._changed:
                self._changed.wait_for(lambda: not self._waits or self._waiting < self._most_waiting)
                self._waiting += len(data)
                self._tasks.append((data, packets))
                self._changed.notify_all()
        return len(data)

    def begin_file(self, path: Path) -> None:
        """Ask for a new file, or for the present one to be emptied and begun anew; return at once.

        The switch follows once earlier data are written or have failed.
        """
        self._position = 0
        with self._changed:
            self._tasks.append(path)
            self._changed.notify_all()

    def tell(self) -> int:
        """Return the number of bytes of the present file that have been queued."""
        return self._position

    @property
    def waiting(self) -> int:
        """Bytes waiting for the disk."""
        return self._waiting

    @property
    def is_behind(self) -> bool:
        """Whether too many bytes wait for the disk: more than `most_waiting`, then until half of it or less waits."""
        self._is_behind = self._waiting > (self._most_waiting // 2 if self._is_behind else self._most_waiting)
        return self._is_behind

    def take_lost(self) -> int:
        """Return the number of packets dropped since the last call, because their file had failed."""
        with self._changed:
            lost, self._lost = self._lost, 0
        return lost

    def settle(self) -> None:
        """Wait until all data handed over are written or have failed."""
        with self._changed:
            self._changed.wait_for(lambda: self._is_idle and not self._tasks)

    def close_file(self) -> None:
        """Write the waiting data, close the file and end the thread."""
        with self._changed:
            self._tasks.append(None)
            self._changed.notify_all()
        self._thread.join()

    def _work(self) -> None:
        """Run the sink's thread: write data and begin files, task by task, until `close_file`; then close the file."""
        while (task := self._next()) is not None:
            if isinstance(task, Path):
                self._open(task)
            else:
                self._write(*task)
        self._close()

    def _next(self) -> tuple[bytes, int] | Path | None:
        """Wait in the sink's thread for a task, and return it: data with their packets, or a file to begin.

        None: the file is to be closed.
        """
        with self._changed:
            self._is_idle = True
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._tasks)
            self._is_idle = False
            return self._tasks.popleft()

    def _write(self, data: bytes, packets: int) -> None:
        """Write data to the present file; after an error drop them and count their packets as lost.

        The write that fails is cut from the file, which then ends with the last whole one. `on_written` gets the number
        of packets of each other write; the first packets after a failure are reported by `say`.
        """
        if not self.error:
            try:
                _write_all(self._descriptor, data)
                self.written += len(data)
                self._on_written(packets)
                if self._has_told and packets:
                    self._has_told = False
                    self.say(f"log {self.path} is written again; packets are missing before it")
            except OSError as error:
                self._fail(error)
                with contextlib.suppress(OSError):  # a pipe or device can't be truncated
                    os.ftruncate(self._descriptor, self.written)
        with self._changed:
            self._waiting -= len(data)
            self._lost += packets if self.error else 0

    def _open(self, path: Path) -> None:
        """Create a file and switch to it; if it is the present one, empty it. A failure is kept as the file's error."""
        is_new = path != self.path or self._descriptor < 0
        if is_new:
            self._close()
            self.path = None
        self.error, self.written, self._name = "", 0, f"{path.name}: "
        try:
            if is_new:
                self._descriptor = create_file(path)
                self.path = path
            else:
                os.lseek(self._descriptor, 0, os.SEEK_SET)
                os.ftruncate(self._descriptor, 0)
        except OSError as error:
            self._fail(error)

    def _close(self) -> None:
        """Close the present file, if it is open; keep an error."""
        if self._descriptor < 0:
            return
        try:
            os.close(self._descriptor)
        except OSError as error:  # network file systems report their failures here
            self._fail(error)
        self._descriptor = -1

    def _fail(self, error: OSError) -> None:
        """Keep the file's first error; report it unless a failure was reported since packets were last written."""
        if not self._has_told:
            self._has_told = True
            what = "the log ends here" if self._waits else "packets are dropped until there is room"
            self.say(f"log {self.path} can't be written: {error.strerror}; {what}")
        self.error = self.error or f"{self._name}{error.strerror} after {self.written} bytes"
        self.first_error = self.first_error or self.error


def _write_all(descriptor: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]


_MEDIA_TYPES = {".toml": "application/toml", ".json": "application/json"}


class McapFile(ChunkedFile):
    """One file of a run, over a sink."""

    def __init__(
        self, sink: Sink, channels: tuple[LogChannel, ...], attachments: dict[str, bytes], metadata: dict[str, str]
    ) -> None:
        super().__init__(sink.write, ROS_PROFILE)
        self.ids: dict[int, int] = {}
        """The file's channel ids, by our channel ids."""
        self.types = {channel.id: channel.type for channel in channels}
        """Message types, by our channel ids."""
        for name, data in attachments.items():
            media_type = _MEDIA_TYPES.get(PurePath(name).suffix, "text/plain")
            self.add_attachment(Attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data))
        self.add_metadata(RUN_METADATA, metadata)
        self._define(channels)
        self.head_bytes = sink.tell()
        """Bytes before the first chunk."""

    def _define(self, channels: tuple[LogChannel, ...]) -> None:
        """Define schemas and channels, with which the first chunk begins; store the channels' numbers in `ids`."""
        for channel in channels:
            schema = self.define_schema(channel.type.name, "ros2msg", channel.type.text.encode())
            metadata = {QOS_KEY: "", **({FIELDS_KEY: " ".join(channel.type.fields)} if channel.type.fields else {})}
            self.ids[channel.id] = self.define_channel(channel.topic, "cdr", schema, metadata)

    def finish(self, summary: dict[str, str]) -> None:
        """Write the chunk in progress and `summary` as metadata, then end the file."""
        self.flush()
        self.add_metadata(SUMMARY_METADATA, summary)
        self.complete()
