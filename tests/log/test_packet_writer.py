"""The fast way from packets to the file against the straightforward one: the same bytes, whatever the bus does."""

import struct

import mcap.writer
import numpy as np
import pytest
from made_log import MemorySink
from recorded_run import CODEC, LONG_ID, PERIOD_NS, fd_codec, make_run

from adacd_hil import __version__
from adacd_hil.log.log_files import FIELDS_KEY, RUN_METADATA, SUMMARY_METADATA
from adacd_hil.log.recording.log_file import McapFile
from adacd_hil.log.recording.packet import ROOM, pack_cycle, pack_event
from adacd_hil.log.recording.packet_writer import PacketWriter
from adacd_hil.log.types.message_types import (
    ENCAPSULATION,
    body_struct,
    pack_can_frame,
    pack_fd_frame,
    pack_joint_state,
    pack_log,
)
from adacd_hil.log.types.topics import SCHEME, ChannelId, pack_truth, run_channels, truth_channels
from adacd_hil.records import TRUTH_LAYOUT, Event, scheme_layout
from adacd_hil.wire.bus import Frame

EPOCH_NS = 1_700_000_000_987_654_321
BITS_ID = 0x3A6
ATTACHMENTS = {"arm.dbc": b"text", "run.toml": b'name = "x"\n'}
METADATA = {"interface": "embedded"}
SUMMARY = {"ending": "closed"}
PLACES = (
    "0|3@1- (0.25,-1)",
    "3|1@1+ (1,0)",
    "4|4@1- (-2,0.5)",
    "8|8@1- (0.1,0.3)",
    "16|16@1+ (1e-3,-7)",
    "32|32@1+ (1e-9,1)",
)
BITS = (
    f"BO_ {BITS_ID} Bits: 8 Drive1\n"
    + "".join(f' SG_ bit{n} : {place} [0|0] "" HOST\n' for n, place in enumerate(PLACES))
    + f'\nBO_ {BITS_ID + 1} Wide: 8 Drive1\n SG_ w0 : 0|64@1- (1e-3,0.1) [0|0] "" HOST\n'
    + f'\nBO_ {BITS_ID + 2} Huge: 8 Drive1\n SG_ w0 : 0|64@1+ (3,0) [0|0] "" HOST\n\n'
)
"""Messages with every kind of place for a signal."""


SCHEME_BLOCK = body_struct(SCHEME.head, has_block=True).size


class ReferenceWriter:
    """The straightforward log: one packet at a time, each message packed by itself, mcap's own writer."""

    def __init__(self, sink, channels, attachments, metadata, messages, epoch_ns, parameter_count):
        self._epoch_ns = epoch_ns
        self._by_id = {message.can_id: (index, message) for index, message in enumerate(messages)}
        slices = scheme_layout(parameter_count).slices
        self._joints = [slices[name] for name in ("q", "dq", "tau_J")]
        self._dropped = 0
        self._writer = mcap.writer.Writer(sink, chunk_size=240 * 1024, enable_crcs=True, enable_data_crcs=True)
        self._writer.start("ros2", f"adacd-hil {__version__}; {mcap.writer.LIBRARY_IDENTIFIER}")
        for name, data in attachments.items():
            kind = "application/toml" if name.endswith(".toml") else "text/plain"
            self._writer.add_attachment(0, 0, name, kind, data)
        self._writer.add_metadata(RUN_METADATA, metadata)
        self._ids, schema_ids = {}, {}
        for channel in channels:
            kind = channel.type
            if kind.name not in schema_ids:
                schema_ids[kind.name] = self._writer.register_schema(kind.name, "ros2msg", kind.text.encode())
            fields = {"offered_qos_profiles": ""}
            if kind.fields:
                fields[FIELDS_KEY] = " ".join(kind.fields)
            self._ids[channel.id] = self._writer.register_channel(channel.topic, "cdr", schema_ids[kind.name], fields)
        self._latest_ns = dict.fromkeys(self._ids, 0)

    def _add(self, channel, log_time_ns, publish_time_ns, payload):
        self._latest_ns[channel] = log_time_ns = max(log_time_ns, self._latest_ns[channel])
        self._writer.add_message(self._ids[channel], log_time_ns, payload, publish_time_ns)

    def _look_at(self, time_ns, dropped):
        if dropped != self._dropped:
            notice = Event("warning", "log", f"{dropped - self._dropped} packets are missing before this")
            self._add(ChannelId.EVENTS, time_ns, time_ns, pack_log(stamp(time_ns), notice))
            self._dropped = dropped

    def event(self, t_ns, dropped, event):
        time_ns = t_ns + self._epoch_ns
        self._look_at(time_ns, dropped)
        self._add(ChannelId.EVENTS, time_ns, time_ns, pack_log(stamp(time_ns), event))

    def cycle(self, t_ns, dropped, messages, frames):
        time_ns = t_ns + self._epoch_ns
        self._look_at(time_ns, dropped)
        for is_tx, frame in frames:
            self._frame(is_tx, frame, time_ns)
        for channel, body in messages:
            self._add(channel, time_ns, time_ns, ENCAPSULATION + stamp(time_ns) + body)
            if channel == ChannelId.SCHEME:
                parts = [body[SCHEME_BLOCK + 8 * s.start : SCHEME_BLOCK + 8 * s.stop] for s in self._joints]
                self._add(ChannelId.JOINT_STATES, time_ns, time_ns, pack_joint_state(stamp(time_ns), *parts))

    def _frame(self, is_tx, frame, publish_ns):
        time_ns = frame.t_ns + self._epoch_ns
        if len(frame.data) > 8:
            channel = ChannelId.TO_CAN_BUS_FD if is_tx else ChannelId.FROM_CAN_BUS_FD
            payload = pack_fd_frame(stamp(time_ns), frame.can_id, frame.data, frame.is_error)
        else:
            channel = ChannelId.TO_CAN_BUS if is_tx else ChannelId.FROM_CAN_BUS
            payload = pack_can_frame(stamp(time_ns), frame.can_id, frame.data, len(frame.data), frame.is_error)
        self._add(channel, time_ns, publish_ns, payload)
        index, message = self._by_id.get(frame.can_id, (0, None))
        if message is not None and not frame.is_error and len(frame.data) == message.length:
            values = message.decode(frame.data)
            body = struct.pack(f"<{len(values)}d", *values)
            self._add(ChannelId.DECODED_FIRST + index, time_ns, publish_ns, ENCAPSULATION + stamp(time_ns) + body)

    def flush(self):
        self._writer.flush()

    def finish(self, summary):
        self._writer.flush()
        self._writer.add_metadata(SUMMARY_METADATA, summary)
        self._writer.finish()


def stamp(time_ns):
    return struct.pack("<II", *divmod(time_ns, 1_000_000_000))


class Pair:
    """The same packets to both writers, to ours in batches of random size."""

    def __init__(self, channels, messages=(), epoch_ns=0, parameter_count=7, seed=1):
        self._generator = np.random.default_rng(seed)
        self.sinks = MemorySink(), MemorySink()
        self._file = McapFile(self.sinks[0], channels, ATTACHMENTS, METADATA)
        self.writer = PacketWriter(self._file, messages, epoch_ns)
        arguments = (channels, ATTACHMENTS, METADATA, messages, epoch_ns, parameter_count)
        self._reference = ReferenceWriter(self.sinks[1], *arguments)
        self._packets = []
        self.lost = 0

    def cycle(self, t_ns, dropped, messages, frames):
        self._reference.cycle(t_ns, dropped, messages, frames)
        self.ours_only(pack_cycle(t_ns, dropped, messages, frames))

    def event(self, t_ns, dropped, event):
        self._reference.event(t_ns, dropped, event)
        self.ours_only(pack_event(t_ns, dropped, event))

    def ours_only(self, packet):
        self._packets.append(packet)
        if self._generator.random() < 0.02:
            self._write()

    def _write(self):
        edges = np.cumsum([0, *map(len, self._packets)])
        data = np.frombuffer(b"".join(self._packets) + bytes(ROOM), np.uint8)
        self.lost += self.writer.write_packets(data, edges[:-1], np.diff(edges))
        self._packets = []

    def flush(self):
        self._write()
        self._file.flush()
        self._reference.flush()

    def files(self):
        self._write()
        self._file.finish(SUMMARY)
        self._reference.finish(SUMMARY)
        ours, theirs = (sink.getvalue() for sink in self.sinks)
        return ours, theirs


def odd_frames(generator, t_ns):
    """Make frames of any kind in any order, some of them stamped long before the others."""
    ids = (*(message.can_id for message in CODEC.messages.values()), LONG_ID, *range(BITS_ID, BITS_ID + 3), 0x18DAF110)
    frames = []
    for _ in range(generator.integers(0, 30)):
        length = int(generator.choice((*range(9), 8, 8, 8, 24, 64)))
        stamp_ns = t_ns - int(generator.integers(0, 3) * generator.integers(0, 5 * PERIOD_NS))
        is_error = bool(generator.random() < 0.1)
        frame = Frame(int(generator.choice(ids)), generator.bytes(length), stamp_ns, is_error)
        frames.append((bool(generator.integers(2)), frame))
    return frames


def assert_same(files):
    ours, theirs = files
    assert len(ours) == len(theirs)
    assert ours == theirs


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize(("epoch_ns", "parameter_count"), [(0, 7), (EPOCH_NS, 9)])
def test_a_run_is_written_as_the_straightforward_way_would(epoch_ns, parameter_count):
    messages = tuple(fd_codec(BITS).messages.values())
    pair = Pair(run_channels(parameter_count, messages), messages, epoch_ns, parameter_count)
    generator = np.random.default_rng(5)
    run = make_run(600, parameter_count=parameter_count, has_fd=True)
    dropped = 0
    for number, cycle in enumerate(run.cycles):
        if number % 190 == 189:
            pair.flush()
        dropped += number % 97 == 96
        frames = cycle.frames + odd_frames(generator, cycle.t_ns)
        pair.cycle(cycle.t_ns, dropped, cycle.messages(), frames)
        if cycle.event is not None:
            dropped += 1
            pair.event(cycle.t_ns, dropped, cycle.event)
    files = pair.files()
    assert_same(files)
    assert pair.lost == 0
    assert pair.writer.dropped == dropped > 0
    assert len(files[0]) > 600_000


@pytest.mark.slow
def test_the_truth_is_written_as_the_straightforward_way_would():
    pair = Pair(truth_channels())
    generator = np.random.default_rng(6)
    for number in range(1000):
        block = generator.normal(size=TRUTH_LAYOUT.size)
        pair.cycle(number * PERIOD_NS, 0, [(ChannelId.TRUTH, pack_truth(number, block))], [])
        if number % 250 == 249:
            pair.flush()
    assert_same(pair.files())


def test_a_chunk_ends_after_the_message_that_overruns_it_not_after_the_one_that_fills_it():
    pair = Pair(run_channels(7))
    pair.cycle(0, 0, [(ChannelId.CYCLE, b"")], [])
    pair.flush()
    record_bytes = 480  # 512 of them make 240 KiB
    for number in range(1100):
        pair.cycle(number, 0, [(ChannelId.CYCLE, bytes(record_bytes - 43))], [])
    assert_same(pair.files())


@pytest.mark.slow
def test_a_cycle_may_be_larger_than_a_chunk():
    messages = tuple(CODEC.messages.values())
    pair = Pair(run_channels(7, messages), messages)
    generator = np.random.default_rng(7)
    frames = [(False, Frame(0x181, generator.bytes(8), number)) for number in range(9000)]
    pair.cycle(0, 0, [], frames)
    pair.cycle(1, 0, [(ChannelId.CYCLE, bytes(48))], frames[:10])
    assert_same(pair.files())


def test_a_log_without_messages_is_written_as_the_straightforward_way_would():
    assert_same(Pair(run_channels(7)).files())


WRONG = {
    "unknown channel": pack_cycle(1, 0, [(9999, b"body")], [(True, Frame(1, b"", 1))]),
    "frame too long": pack_cycle(1, 0, [(ChannelId.CYCLE, bytes(48))], [(True, Frame(1, bytes(65), 0))]),
    "no joints in the scheme": pack_cycle(1, 0, [(ChannelId.SCHEME, bytes(63))], []),
    "cycle before the epoch": pack_cycle(-1, 0, [(ChannelId.CYCLE, bytes(48))], []),
    "frame before the epoch": pack_cycle(1, 0, [], [(True, Frame(1, b"", -1))]),
    "frame after the end of time": pack_cycle(1, 0, [], [(True, Frame(1, b"", 2**32 * 10**9))]),
    "event before the epoch": pack_event(-1, 0, Event("info", "n", "m")),
    "dropped packets in a wrong one": pack_cycle(1, 5, [(9999, b"body")], []),
}


@pytest.mark.parametrize("wrong", WRONG.values(), ids=WRONG.keys())
def test_nothing_of_a_packet_that_makes_no_sense_is_written(wrong):
    pair = Pair(run_channels(7))
    cycle = ([(ChannelId.CYCLE, bytes(48))], [(False, Frame(1, b"12", 3))])
    pair.cycle(3, 0, *cycle)
    pair.ours_only(wrong)
    pair.cycle(4, 0, *cycle)
    assert_same(pair.files())
    assert pair.lost == 1
    assert pair.writer.frames == 2
