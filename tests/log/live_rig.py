"""A live view, fed with the packets of a run; what it sends is compared with what the file holds."""

import io
import json
import socket
import threading
from pathlib import Path

from hang import HANG_S
from made_log import MemorySink
from mcap.reader import make_reader
from recorded_run import CODEC, Run

from adacd_hil.clock import Clock
from adacd_hil.lab.live.client import LiveClient, LiveMessage
from adacd_hil.lab.live.feed import LiveFeed
from adacd_hil.lab.live.live_view import LiveView
from adacd_hil.lab.live.scene import Shape
from adacd_hil.log.recording import processes
from adacd_hil.log.recording.log_file import McapFile, Sink
from adacd_hil.log.recording.packet import pack_cycle, pack_event, unpack
from adacd_hil.log.recording.packet_writer import PacketWriter
from adacd_hil.log.recording.processes import WriterSetup
from adacd_hil.log.recording.ring import Ring, RingReader
from adacd_hil.log.recording.writer import WriterProcess
from adacd_hil.log.types.topics import run_channels
from adacd_hil.records import ContactKind, ContactLevel, ContactReport, Event, Location, Reaction
from adacd_hil.wire.message_table import plain_tables

EPOCH_NS = 1_700_000_000_000_000_000
URDF = '<robot name="a"/>'
LINK_LENGTH_M = (0.35, 0.30)
SETUP = LiveView("127.0.0.1", 0, robot_description=URDF, shape=Shape(LINK_LENGTH_M))
LAST = Event("info", "test", "last")
PUSH = ContactReport(
    cycle=7,
    link=2,
    direction=(1, -1),
    tau_ext_peak=(2.5, -1.5),
    impulse=(0.25, 0.125),
    is_final=True,
    level=ContactLevel.COLLISION,
    kind=ContactKind.PUSH,
    reaction=Reaction.FLOAT,
    location=Location.KNOWN,
    is_two_sided=True,
    tau_ext_peak_sigma=(0.1, 0.2),
    impulse_sigma=(0.3, 0.4),
    force_N=18.5,
    force_sigma=0.5,
    lever_m=0.2,
    lever_sigma=0.01,
    blind_rad=0.6,
)


def setup_of(live: LiveView | None, path: Path = Path("run.mcap"), parameter_count: int = 7) -> WriterSetup:
    """What a writer is told of a log in real time."""
    return WriterSetup(
        path=path,
        is_blocking=False,
        channels=run_channels(parameter_count, tuple(CODEC.messages.values())),
        messages=plain_tables(CODEC.messages.values()),
        epoch_ns=EPOCH_NS,
        part_bytes=0,
        part_ns=0,
        attachments={},
        metadata={},
        live=live,
    )


class ThreadedWriter:
    """The writer in a thread of this process, fed through its ring as by a control process in real time."""

    def __init__(self, setup: WriterSetup, sink: Sink, clock: Clock) -> None:
        self.ring = Ring(4 * 2**20)
        self._ours, self._theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.process = WriterProcess(self._theirs, RingReader(self.ring.descriptor), sink, setup, clock)
        self._thread = threading.Thread(target=self.process.run, daemon=True)  # a failure must not keep it waiting
        self._thread.start()

    def end(self) -> dict[str, str]:
        """Let it end; return what it says of the log."""
        self._ours.send(processes.END)
        self._thread.join()
        word: dict[str, str] = json.loads(self._ours.recv(processes.MOST_BYTES))
        for end in (self.ring, self._ours, self._theirs):
            end.close()
        return word


class Feed:
    """A file and its live view."""

    def __init__(self, setup: LiveView | None = SETUP, parameter_count: int = 7) -> None:
        messages = tuple(CODEC.messages.values())
        channels = run_channels(parameter_count, messages)
        self.sink = MemorySink()
        self._file = McapFile(self.sink, channels, {}, {})
        told = setup_of(setup, parameter_count=parameter_count)
        self.live = None if setup is None else LiveFeed(setup, told, self._file.ids, EPOCH_NS)
        self._writer = PacketWriter(self._file, messages, EPOCH_NS)
        self._packets: list[bytes] = []

    def cycles(self, run: Run, packets_at_once: int) -> None:
        """Write all of a run, then LAST."""
        for cycle in run.cycles:
            self._packets.append(pack_cycle(cycle.t_ns, 0, cycle.messages(), cycle.frames))
            if cycle.event is not None:
                self._packets.append(pack_event(cycle.t_ns, 0, cycle.event))
            if len(self._packets) >= packets_at_once:
                self.write()
        self.event(run.cycles[-1].t_ns, LAST)
        self.write()

    def event(self, t_ns: int, event: Event) -> None:
        self._packets.append(pack_event(t_ns, 0, event))

    def write(self) -> None:
        self._writer.shown = []
        assert all(self._writer.write_packet(unpack(packet)) for packet in self._packets)
        if self.live is not None:
            self.live.show(self._writer.shown)
        self._packets = []

    def file(self) -> bytes:
        self._file.finish({})
        return self.sink.getvalue()

    def close(self) -> None:
        if self.live is not None:
            self.live.end_view()
            self.live.process.wait(HANG_S)

    def __enter__(self) -> "Feed":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def receive_until_last(client: LiveClient) -> list[LiveMessage]:
    """Receive everything up to LAST, which no rate holds back."""
    messages: list[LiveMessage] = []
    while not (messages and messages[-1].topic == "/events" and b"last\0" in messages[-1].payload):
        message = client.receive(HANG_S)
        assert message is not None, "the last event did not come"
        messages.append(message)
    return messages


def by_topic(messages: list[LiveMessage]) -> dict[str, list[tuple[int, bytes]]]:
    topics: dict[str, list[tuple[int, bytes]]] = {}
    for topic, log_ns, payload in messages:
        topics.setdefault(topic, []).append((log_ns, payload))
    return topics


def first_cycles_of_slots(file: bytes, rates_Hz: dict[str, int]) -> dict[str, list[tuple[int, bytes]]]:
    """What the file has of each topic, read by mcap's own reader: of each slot of 1 / rate the first cycle."""
    topics: dict[str, list[tuple[int, bytes]]] = {}
    firsts: dict[tuple[str, int], int] = {}
    for _, channel, message in make_reader(io.BytesIO(file)).iter_messages(log_time_order=False):
        if rate_Hz := rates_Hz[channel.topic]:
            slot = message.publish_time * rate_Hz // 1_000_000_000
            if firsts.setdefault((channel.topic, slot), message.publish_time) != message.publish_time:
                continue
        topics.setdefault(channel.topic, []).append((message.log_time, message.data))
    return topics
