"""The writer process: packets from a socket in, one MCAP file out. Run by `Recorder`, never by hand.

It shares nothing with the control process but the socket: neither its CAN sockets nor its scheduling, nor its session,
so that Ctrl-C reaches only the control process. It ends the file when it is told to or when the control process dies.
A disk that fails doesn't stop it from taking packets; they are counted as dropped.

In lockstep the file depends on the packets only, bit for bit; so its chunks end by log time. Otherwise they end by the
clock, so that silence doesn't keep data from the disk.
"""

import contextlib
import json
import os
import socket
import struct
import sys

from adacd_hil.clock import MonotonicClock
from adacd_hil.log.cdr import ENCAPSULATION
from adacd_hil.log.channels import SCHEME_BLOCK, ChannelId, MessageLike, run_channels, truth_channels
from adacd_hil.log.errors import LogError
from adacd_hil.log.mcap_file import McapFile
from adacd_hil.log.packet import CyclePacket, EventPacket, LoggedFrame, unpack
from adacd_hil.log.ros_types import MAX_DATA, pack_can_frame, pack_fd_frame, pack_joint_state, pack_log
from adacd_hil.log.setup import Setup
from adacd_hil.log.sink import Sink
from adacd_hil.records import Event, scheme_layout
from adacd_hil.wire.bus import MAX_CLASSIC_BYTES

FLUSH_PERIOD_NS = 250_000_000
POLL_PERIOD_NS = 10_000_000
"""A writer asleep in the socket would have to be woken by the control process, which costs more than the packet."""
PACKETS_PER_CLOCK = 32
"""How many packets are taken between two looks at the clock while the writer is behind."""
RECEIVE_BYTES = 4 * 1024 * 1024
"""No packet is longer: the kernel's limit of a socket's buffer."""

_TIME = struct.Struct("<II")


class PacketWriter:
    """Turns packets into messages of a file."""

    def __init__(self, file: McapFile, messages: tuple[MessageLike, ...], epoch_ns: int, parameter_count: int) -> None:
        self.frames = 0
        self.dropped = 0  # packets that didn't reach the writer
        self._file = file
        self._epoch_ns = epoch_ns
        self._decoders = {
            message.can_id: (ChannelId.DECODED_FIRST + index, message, struct.Struct(f"<{len(message.signals)}d"))
            for index, message in enumerate(messages)
        }
        slices = scheme_layout(parameter_count).slices
        self._joint_slices = [
            slice(SCHEME_BLOCK + 8 * slices[name].start, SCHEME_BLOCK + 8 * slices[name].stop)
            for name in ("q", "dq", "tau_J")
        ]

    def write(self, packet: CyclePacket | EventPacket) -> None:
        """Write all that a packet holds. Raises struct.error, ValueError or KeyError when it makes no sense."""
        time_ns = packet.t_ns + self._epoch_ns
        if packet.dropped != self.dropped:
            missing = packet.dropped - self.dropped
            self.dropped = packet.dropped
            self._write_event(time_ns, Event("warning", "log", f"{missing} packets are missing before this"))
        if isinstance(packet, EventPacket):
            self._write_event(time_ns, packet.event)
            return
        for frame in packet.frames:
            self._write_frame(frame, time_ns)
        stamp = _stamp(time_ns)
        for channel_id, body in packet.messages:
            self._file.add(channel_id, time_ns, time_ns, ENCAPSULATION + stamp + body)
            if channel_id == ChannelId.SCHEME:
                joint_state = pack_joint_state(stamp, *(body[place] for place in self._joint_slices))
                self._file.add(ChannelId.JOINT_STATES, time_ns, time_ns, joint_state)

    def _write_frame(self, frame: LoggedFrame, cycle_time_ns: int) -> None:
        if frame.length > MAX_DATA:
            raise ValueError(f"a frame of {frame.length} bytes; {MAX_DATA} are the most")
        time_ns = frame.t_ns + self._epoch_ns
        stamp = _stamp(time_ns)
        if frame.length > MAX_CLASSIC_BYTES:
            channel_id = ChannelId.TO_CAN_BUS_FD if frame.is_tx else ChannelId.FROM_CAN_BUS_FD
            payload = pack_fd_frame(stamp, frame.can_id, frame.data, frame.is_error)
        else:
            channel_id = ChannelId.TO_CAN_BUS if frame.is_tx else ChannelId.FROM_CAN_BUS
            payload = pack_can_frame(stamp, frame.can_id, frame.data, frame.length, frame.is_error)
        self._file.add(channel_id, time_ns, cycle_time_ns, payload)
        self.frames += 1
        decoder = self._decoders.get(frame.can_id)
        if decoder is None or frame.is_error:
            return
        decoded_id, message, numbers = decoder
        if frame.length == message.length:
            values = numbers.pack(*message.decode(frame.data[: frame.length]))
            self._file.add(decoded_id, time_ns, cycle_time_ns, ENCAPSULATION + stamp + values)

    def _write_event(self, time_ns: int, event: Event) -> None:
        self._file.add(ChannelId.EVENTS, time_ns, time_ns, pack_log(_stamp(time_ns), event))


def _stamp(time_ns: int) -> bytes:
    return _TIME.pack(*divmod(time_ns, 1_000_000_000))


class WriterProcess:
    """The loop around a PacketWriter."""

    def __init__(self, connection: socket.socket, sink: Sink, setup: Setup) -> None:
        messages = () if setup.is_truth else _dbc_messages(setup)
        channels = truth_channels() if setup.is_truth else run_channels(setup.parameter_count, messages)
        self._connection = connection
        self._sink = sink
        self._file = McapFile(sink, channels, setup.attachments, setup.metadata)
        self._packets = PacketWriter(self._file, messages, setup.epoch_ns, setup.parameter_count)
        self._is_blocking = setup.is_blocking
        connection.setblocking(False)
        self._buffer = bytearray(RECEIVE_BYTES)
        self._packets_unclocked = 0
        self._clock = MonotonicClock()
        self._flushed_ns = 0 if setup.is_blocking else self._clock.now_ns()
        self._lost = 0  # packets that reached the writer but not the file

    def run(self) -> None:
        """Write until the end, then answer with the last word."""
        ending = "control process died"
        while received := self._receive():
            if not self._write(received):
                ending = "closed"
                break
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
            self._file.flush()
            self._flushed_ns = now_ns
        return now_ns

    def _write(self, received: bytes) -> bool:
        """Write one packet; False when it is the end."""
        try:
            packet = unpack(received)
            if packet is None:
                return False
            if self._is_blocking and packet.t_ns - self._flushed_ns >= FLUSH_PERIOD_NS:
                self._file.flush()
                self._flushed_ns = packet.t_ns
            if self._sink.error:
                self._lost += 1
            else:
                self._packets.write(packet)
        except (struct.error, ValueError, KeyError):
            self._lost += 1
        return True


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


def main(socket_descriptor: int, file_descriptor: int) -> None:
    """Write a log: say when ready, take packets until the end, say how it went."""
    _schedule_plainly()
    connection = socket.socket(fileno=socket_descriptor)
    sink = Sink(file_descriptor)
    try:
        setup = Setup.from_json(sys.stdin.buffer.read())
        process = WriterProcess(connection, sink, setup)
        sink.settle()
        if sink.error:
            raise LogError(sink.error)
    except (LogError, OSError, ValueError) as error:
        _send_word(connection, {"error": " ".join(str(error).split())})
        return
    _send_word(connection, {"error": ""})
    process.run()


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
