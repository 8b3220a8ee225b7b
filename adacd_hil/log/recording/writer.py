"""The writer process: takes packets from a ring and writes the files of one log. Started by `Recorder` only.

It shares only the ring and a message socket with the control process: not its CAN sockets, its scheduling or its
session, so that Ctrl-C reaches only the control process. It ends the log on the control process's message or death,
after it has taken all packets left in the ring.

In lockstep the files depend on the packets only, bit for bit; so chunks end by log time, and packets are lost only to a
full disk. In real time chunks end by the clock, so that data reach the disk during silence, too; if the disk is too
slow or full, packets are dropped and counted, and the ring is still emptied. After a full disk, another part is tried.
"""

import contextlib
import json
import os
import socket
import struct
import sys

from adacd_hil.clock import Clock, MonotonicClock
from adacd_hil.error_texts import error_text
from adacd_hil.log.log_files import CLOSED, CONTINUED, ENDING_KEY, PART_KEY, PRODUCT, LogError, part_path
from adacd_hil.log.mcap.chunked_file import FLUSH_PERIOD_NS
from adacd_hil.log.recording import processes
from adacd_hil.log.recording.log_file import McapFile, Sink
from adacd_hil.log.recording.packet import unpack
from adacd_hil.log.recording.packet_writer import PacketWriter
from adacd_hil.log.recording.processes import LiveFeed, LiveService, WriterSetup, read_setup
from adacd_hil.log.recording.ring import RingReader, split
from adacd_hil.log.recording.run_folder import is_there
from adacd_hil.printable import in_line

POLL_PERIOD_US = 25_000
"""Polling interval of the ring in real time. A wake-up would cost the control process more than the packet."""
RETRY_PERIOD_NS = 5_000_000_000
"""Time before a disk that failed is tried again."""
TAKEN_BYTES = 64 * 1024
"""Most bytes of packets that are taken at once, about 100 cycles."""


class WriterProcess:
    """The writer process's loop: takes packets, writes them, ends chunks and parts, reports the end."""

    def __init__(
        self, connection: socket.socket, ring: RingReader, sink: Sink, setup: WriterSetup, clock: Clock | None = None
    ) -> None:
        self._connection = connection
        self._ring = ring
        self._sink = sink
        self._setup = setup
        self._part = 0
        self._parts = 1
        self._file = self._begin_file()
        self._clock = clock or MonotonicClock()
        self.live = self._open(setup.live) if setup.live else None
        self._packets = PacketWriter(self._file, setup.messages, setup.epoch_ns)
        self._flushed_ns = 0 if setup.is_blocking else self._clock.now_ns()
        self._failed_ns: int | None = None  # time at which the disk failed, or was last tried
        self._part_ns: tuple[int, int] | None = None  # t_ns of the first and the last packet of the part
        self._lost = 0  # packets that were taken but are in no file
        self._frames = self._messages = self._dropped = 0  # of earlier parts
        if not setup.is_blocking:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", 0, POLL_PERIOD_US))

    def _open(self, live: LiveService) -> LiveFeed:
        """Open the live view of the log, and return it. Raises LogError if it can't be opened."""
        start_ns = self._setup.epoch_ns + (0 if self._setup.is_blocking else self._clock.now_ns())
        return live(self._setup, self._file.ids, start_ns)

    def run(self) -> None:
        """Write packets until the control process ends the log or dies; then close the file and send the summary."""
        while True:
            word = self._hear()
            if word == processes.ROOM:
                taken = self._ring.take_packets(TAKEN_BYTES)
                _send(self._connection, processes.ROOM)  # before writing, so that both sides work at once
                self._write(taken)
            self._take()
            if word in (processes.END, processes.NOTHING):
                break
        self._end(self._finish(CLOSED if word == processes.END else "control process died"))

    def _end(self, summary: dict[str, str]) -> None:
        """Close the last file and send the summary; end the live view.

        Remove the file if it is a further part that has no chunk because of an error.
        """
        self._sink.close_file()
        path = part_path(self._setup.path, self._part)
        if self._part and self._sink.error and self._sink.path == path and not self._has_chunks:
            with contextlib.suppress(OSError):
                path.unlink()
        lost = self._lost + self._sink.take_lost()
        last = {"parts": str(self._parts), "lost": str(lost), "error": self._sink.first_error}
        _send(self._connection, json.dumps({**summary, **last}).encode())
        if self.live is not None:
            self.live.end_view()

    def _hear(self) -> bytes | None:
        """Receive a message; NOTHING if the control process is dead; None after a timeout."""
        try:
            return self._connection.recv(processes.MOST_BYTES)
        except BlockingIOError:
            return None
        except ConnectionResetError:
            return processes.NOTHING

    def _take(self) -> None:
        """Take and write all packets waiting in the ring; in real time also call `_look_at_clock`, at least once."""
        while True:
            self._write(self._ring.take_packets(TAKEN_BYTES))
            if not self._setup.is_blocking:
                self._look_at_clock()
            if not self._ring.waiting:
                return

    def _look_at_clock(self) -> None:
        """Each FLUSH_PERIOD_NS write the chunk in progress, and try a disk again that failed long enough ago.

        If the part is full, begin the next one, see `_flush`.
        """
        now_ns = self._clock.now_ns()
        if now_ns - self._flushed_ns >= FLUSH_PERIOD_NS:
            self._flush(now_ns)
            self._look_at_disk(now_ns)

    @property
    def _is_watched(self) -> bool:
        return self.live is not None and self.live.is_watched

    def _look_at_disk(self, now_ns: int) -> None:
        """Begin another part each RETRY_PERIOD_NS after the disk failed; the present part again if it has no chunk."""
        if not self._sink.error:
            self._failed_ns = None
        elif self._failed_ns is None:
            self._failed_ns = now_ns
        elif now_ns - self._failed_ns >= RETRY_PERIOD_NS:
            self._failed_ns = now_ns
            self._begin_part(is_next=self._has_chunks)

    @property
    def _has_chunks(self) -> bool:
        """Whether a chunk of the part is on the disk."""
        return self._sink.written > self._file.head_bytes

    def _flush(self, now_ns: int) -> None:
        """Write the chunk in progress; if the part is full, end it and begin the next.

        Keep a full part while the disk has failed or is behind. now_ns: stored as the time of the latest flush.
        """
        self._file.flush()
        self._flushed_ns = now_ns
        if self._is_part_full() and not self._sink.error and not self._sink.is_behind:
            self._finish(CONTINUED)
            self._begin_part(is_next=True)

    def _is_part_full(self) -> bool:
        if self._part_ns is None:
            return False
        first_ns, last_ns = self._part_ns
        part_bytes, part_ns = self._setup.part_bytes, self._setup.part_ns
        return 0 < part_bytes <= self._file.record_bytes or 0 < part_ns <= last_ns - first_ns

    def _begin_part(self, is_next: bool) -> None:
        """Begin the next part, or, with is_next False, the present one again from empty.

        Skip names that other files have taken meanwhile.
        """
        self._part += is_next
        self._parts += is_next
        while self._sink.path != (path := part_path(self._setup.path, self._part)) and is_there(path):
            self._part += 1
        self._frames += self._packets.frames
        self._messages += self._file.messages
        self._packets.frames = 0
        self._part_ns = None
        self._sink.begin_file(path)
        self._file = self._begin_file()
        self._packets.begin_file(self._file)

    def _begin_file(self) -> McapFile:
        """Return a new file over the sink, with attachments and with the present part's number in its metadata."""
        setup = self._setup
        metadata = {**setup.metadata, PART_KEY: str(self._part)}
        return McapFile(self._sink, setup.channels, setup.attachments, metadata)

    def _finish(self, ending: str) -> dict[str, str]:
        """End the part in progress with a summary in the file; return the counts of all parts so far.

        ending: the reason, for the summary.
        """
        self._note_lost()
        dropped = self._ring.dropped if ending != CONTINUED else self._packets.dropped
        dropped += self._lost
        summary = {
            "frames": str(self._packets.frames),
            "messages": str(self._file.messages),
            "dropped": str(dropped - self._dropped),
            ENDING_KEY: ending,
        }
        self._dropped = dropped
        self._file.finish(summary)
        return {
            "frames": str(self._frames + self._packets.frames),
            "messages": str(self._messages + self._file.messages),
        }

    def _write(self, taken: bytes) -> None:
        """Write packets from the ring; count them as lost if the disk has failed, or in real time is too slow.

        A packet that can't be unpacked or written counts as lost, too. In lockstep end chunks by log time. While a
        viewer is connected, send it the messages.
        """
        if self._sink.error or (not self._setup.is_blocking and self._sink.is_behind):
            self._lose(sum(1 for _ in split(taken)))
            return
        self._note_lost()
        self._packets.shown = [] if self._is_watched else None
        for data in split(taken):
            packet = unpack(data)
            if packet is None:
                self._lost += 1
                continue
            if self._setup.is_blocking and packet.t_ns - self._flushed_ns >= FLUSH_PERIOD_NS:
                self._flush(packet.t_ns)
            self._part_ns = packet.t_ns if self._part_ns is None else self._part_ns[0], packet.t_ns
            self._lost += not self._packets.write_packet(packet)
        if self.live is not None and self._packets.shown:
            self.live.show(self._packets.shown)

    def _note_lost(self) -> None:
        """Count the packets that the sink has dropped since the last call as lost."""
        self._lose(self._sink.take_lost())

    def _lose(self, count: int) -> None:
        self._lost += count
        self._packets.lose(count)


def _send(connection: socket.socket, word: bytes) -> None:
    with contextlib.suppress(OSError):  # the receiver is dead
        connection.send(word)


def _say(line: str) -> None:
    """Print a line for the user at once: the control process reports a full disk only at the end."""
    with contextlib.suppress(OSError, ValueError):  # standard error is closed
        sys.stderr.write(f"{PRODUCT}: {in_line(line)}\n")
        sys.stderr.flush()


def _schedule_plainly() -> None:
    """Leave the real-time scheduling class inherited from the control process."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def write_log(connection: socket.socket, file_descriptor: int, ring_descriptor: int, setup: WriterSetup) -> None:
    """Report to the control process that the writer is ready, or an error; write packets until the log's end.

    After an error write none.
    """
    error = url = ""
    try:
        ring = RingReader(ring_descriptor)
        sink = Sink(file_descriptor, setup.path, waits=setup.is_blocking, on_written=ring.count_written)
        process = WriterProcess(connection, ring, sink, setup)
        sink.settle()
        error = sink.error  # the control process prints the first one
        sink.say = _say
        url = process.live.url if process.live else ""
    except (LogError, OSError, ValueError) as reason:
        error = " ".join(error_text(reason).split())
    _send(connection, json.dumps({"error": error, "live_url": url}).encode())
    if not error:
        process.run()


def main(socket_descriptor: int, file_descriptor: int, ring_descriptor: int) -> None:
    """Run the writer process to the log's end, without real-time scheduling. Its setup comes by standard input."""
    _schedule_plainly()
    os.dup(file_descriptor)  # never closed: the lock of the first part lasts as long as this process
    write_log(socket.socket(fileno=socket_descriptor), file_descriptor, ring_descriptor, read_setup())


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
