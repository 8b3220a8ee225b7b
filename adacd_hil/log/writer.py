"""The writer process: packets from a socket in, one MCAP file out. Run by `Recorder`, never by hand.

It shares nothing with the control process but the socket: neither its CAN sockets nor its scheduling, nor its session,
so that Ctrl-C reaches only the control process. It ends the file when it is told to or when the control process dies.
A disk that fails doesn't stop it from taking packets; they are counted as dropped.

Packets are gathered and written many at a time, at the latest when a chunk has to end: see packet_writer.py.

In lockstep the file depends on the packets only, bit for bit; so its chunks end by log time. Otherwise they end by the
clock, so that silence doesn't keep data from the disk.
"""

import contextlib
import json
import os
import socket
import struct
import sys

import numpy as np

from adacd_hil.clock import MonotonicClock
from adacd_hil.log import packet
from adacd_hil.log.channels import MessageLike, run_channels, truth_channels
from adacd_hil.log.errors import LogError
from adacd_hil.log.mcap_file import McapFile
from adacd_hil.log.outbox import read_outbox, split
from adacd_hil.log.packet_writer import PacketWriter
from adacd_hil.log.setup import Setup
from adacd_hil.log.sink import Sink

FLUSH_PERIOD_NS = 250_000_000
POLL_PERIOD_NS = 10_000_000
"""A writer asleep in the socket would have to be woken by the control process, which costs more than the packet."""
PACKETS_PER_CLOCK = 32
"""How many packets are taken between two looks at the clock while the writer is behind."""
RECEIVE_BYTES = 4 * 1024 * 1024
"""No packet is longer: the kernel's limit of a socket's buffer."""
BATCH_BYTES = 256 * 1024
"""Packets that are gathered at most, about 400 cycles: more would be no cheaper, each."""


class WriterProcess:
    """The loop around a PacketWriter."""

    def __init__(self, connection: socket.socket, sink: Sink, setup: Setup, outbox: int | None) -> None:
        messages = () if setup.is_truth else _dbc_messages(setup)
        channels = truth_channels() if setup.is_truth else run_channels(setup.parameter_count, messages)
        self._connection = connection
        self._sink = sink
        self._outbox = outbox
        self._file = McapFile(sink, channels, setup.attachments, setup.metadata)
        self._packets = PacketWriter(self._file, messages, setup.epoch_ns, setup.parameter_count)
        self._is_blocking = setup.is_blocking
        connection.setblocking(False)
        self._buffer = bytearray(RECEIVE_BYTES)
        self._gathered: list[bytes] = []
        self._gathered_bytes = 0
        self._batch = 0  # number of the latest one
        self._packets_unclocked = 0
        self._clock = MonotonicClock()
        self._flushed_ns = 0 if setup.is_blocking else self._clock.now_ns()
        self._lost = 0  # packets that reached the writer but not the file

    def run(self) -> None:
        """Write until the end, then answer with the last word."""
        ending = "control process died"
        while received := self._receive():
            if received[0] == packet.END:
                ending = "closed"
                break
            self._take(received)
        else:
            self._take_what_is_left()
        self._write()
        summary = {
            "frames": str(self._packets.frames),
            "messages": str(self._file.messages),
            "dropped": str(self._packets.dropped + self._lost),
            "ending": ending,
        }
        self._file.finish(summary)
        self._sink.close()
        _send_word(self._connection, {**summary, "lost": str(self._lost), "error": self._sink.error})

    def _receive(self) -> bytes:
        """Return the next packet, b"" when there will be none; in real time, flushes by the clock as time passes."""
        self._packets_unclocked += 1
        if self._packets_unclocked >= PACKETS_PER_CLOCK:
            self._look_at_clock()
        while True:
            try:
                count = self._connection.recv_into(self._buffer)
                return bytes(memoryview(self._buffer)[:count])
            except ConnectionResetError:
                return b""
            except BlockingIOError:
                self._clock.sleep_until_ns(self._look_at_clock() + POLL_PERIOD_NS)

    def _look_at_clock(self) -> int:
        """Flush if it is time, and return the time."""
        self._packets_unclocked = 0
        now_ns = self._clock.now_ns()
        if not self._is_blocking and now_ns - self._flushed_ns >= FLUSH_PERIOD_NS:
            self._flush()
            self._flushed_ns = now_ns
        return now_ns

    def _take(self, received: bytes) -> None:
        """Keep the packet that was just received, or the packets of a batch."""
        if received[0] != packet.BATCH:
            self._keep(received)
            return
        try:
            self._batch, packets = split(received)
        except struct.error:
            self._lost += 1
            return
        for each in packets:
            self._keep(each)

    def _take_what_is_left(self) -> None:
        """Keep the batch that the control process had not sent when it died."""
        if self._outbox is not None:
            batch = read_outbox(self._outbox)
            if split(batch)[0] != self._batch:
                self._take(batch)

    def _keep(self, received: bytes) -> None:
        """Keep a packet until it is written with others; in lockstep, flushes by its time."""
        if len(received) < packet.HEAD.size or received[0] not in (packet.CYCLE, packet.EVENT):
            self._lost += 1
            return
        if self._is_blocking:
            _, _, _, _, t_ns = packet.HEAD.unpack_from(received)
            if t_ns - self._flushed_ns >= FLUSH_PERIOD_NS:
                self._flush()
                self._flushed_ns = t_ns
        self._gathered.append(received)
        self._gathered_bytes += len(received)
        if self._gathered_bytes >= BATCH_BYTES:
            self._write()

    def _flush(self) -> None:
        """Write what has been gathered and end the chunk in progress."""
        self._write()
        self._file.flush()

    def _write(self) -> None:
        """Write what has been gathered."""
        if self._sink.error:
            self._lost += len(self._gathered)
        elif self._gathered:
            edges = np.cumsum([0, *map(len, self._gathered)])
            data = np.frombuffer(b"".join((*self._gathered, bytes(packet.ROOM))), np.uint8)
            self._lost += self._packets.write(data, edges[:-1], np.diff(edges))
        self._gathered = []
        self._gathered_bytes = 0


def _dbc_messages(setup: Setup) -> tuple[MessageLike, ...]:
    # Takes 0.2 s, and the emulator's log does without.
    from adacd_hil.wire.codec import load_codec

    return tuple(load_codec(setup.codec_path).messages.values())


def _send_word(connection: socket.socket, word: dict[str, str]) -> None:
    with contextlib.suppress(OSError):  # nobody is left to hear it
        connection.send(json.dumps(word).encode())


def _schedule_plainly() -> None:
    """Leave the real-time class that the control process may have passed on."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def main(socket_descriptor: int, file_descriptor: int, outbox_descriptor: int | None = None) -> None:
    """Write a log: say when ready, take packets until the end, say how it went."""
    _schedule_plainly()
    connection = socket.socket(fileno=socket_descriptor)
    sink = Sink(file_descriptor)
    try:
        setup = Setup.from_json(sys.stdin.buffer.read())
        process = WriterProcess(connection, sink, setup, outbox_descriptor)
        sink.settle()
        if sink.error:
            raise LogError(sink.error)
    except (LogError, OSError, ValueError) as error:
        _send_word(connection, {"error": " ".join(str(error).split())})
        return
    _send_word(connection, {"error": ""})
    process.run()


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
