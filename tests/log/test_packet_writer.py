"""Packets become messages of the file: which, in which order, with which times, and in which chunks."""

import io
import struct

import cantools
import numpy as np
import pytest
from made_log import MemorySink
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from recorded_run import CODEC, fd_codec

from adacd_hil.log.mcap.chunked_file import CHUNK_BYTES
from adacd_hil.log.recording.log_file import McapFile
from adacd_hil.log.recording.packet import pack_cycle, pack_event, unpack
from adacd_hil.log.recording.packet_writer import PacketWriter
from adacd_hil.log.types.topics import ChannelId, run_channels
from adacd_hil.log.types.unpacking import unpack_log
from adacd_hil.records import Event
from adacd_hil.wire.bus import Frame

EPOCH_NS = 1_700_000_000_987_654_321
BITS_ID = 0x3A6
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


MESSAGES = tuple(CODEC.messages.values())


class CountingSink(MemorySink):
    """A file, and how many packets each write has completed."""

    def __init__(self):
        super().__init__()
        self.packets = []

    def write(self, data, packets=0):
        self.packets.append(packets)
        return super().write(data)


class Rig:
    """A file that is fed with packets."""

    def __init__(self, messages=MESSAGES, epoch_ns=0):
        self.sink = CountingSink()
        self.file = McapFile(self.sink, run_channels(7, messages), {}, {})
        self.writer = PacketWriter(self.file, messages, epoch_ns)

    def write(self, *packets):
        """Write packets; return for each whether the file holds it."""
        return [(packet := unpack(data)) is not None and self.writer.write_packet(packet) for data in packets]

    def messages(self):
        """End the file; return its messages as (topic, log time, publish time, payload), in their order."""
        self.file.finish({})
        reader = make_reader(io.BytesIO(self.sink.getvalue()), validate_crcs=True)
        return [
            (channel.topic, message.log_time, message.publish_time, message.data)
            for _, channel, message in reader.iter_messages(log_time_order=False)
        ]

    def chunks(self):
        reader = StreamReader(io.BytesIO(self.sink.getvalue()), emit_chunks=True)
        return [record for record in reader.records if isinstance(record, Chunk)]


CYCLE = [(ChannelId.CYCLE, bytes(48))]
SYNC = CODEC.message("Sync")


def stamp_ns(payload):
    sec, nanosec = struct.unpack_from("<II", payload, 4)
    return sec * 10**9 + nanosec


@pytest.mark.parametrize("epoch_ns", [0, EPOCH_NS])
def test_a_cycle_is_its_frames_each_with_its_decoded_message_then_its_bodies(epoch_ns):
    frames = [
        (True, Frame(SYNC.can_id, b"\x07", 1010)),
        (False, Frame(0x7A5, b"123", 1020)),
        (False, Frame(SYNC.can_id, b"\x08", 1030, is_error=True)),
        (False, Frame(SYNC.can_id, b"12", 1040)),
        (True, Frame(0x7A5, bytes(12), 1050)),
    ]
    joints = np.arange(8.0)
    scheme = bytes(56) + joints.tobytes() + bytes(1000)
    rig = Rig(epoch_ns=epoch_ns)
    packets = (
        pack_cycle(1000, 0, [(ChannelId.SCHEME, scheme), *CYCLE], frames),
        pack_event(1500, 0, Event("info", "n", "m")),
    )
    assert rig.write(*packets) == [True, True]
    messages = rig.messages()
    assert [(topic, log_ns - epoch_ns, publish_ns - epoch_ns) for topic, log_ns, publish_ns, _ in messages] == [
        ("/to_can_bus", 1010, 1000),
        ("/decoded/Sync", 1010, 1000),
        ("/from_can_bus", 1020, 1000),
        ("/from_can_bus", 1030, 1000),
        ("/from_can_bus", 1040, 1000),
        ("/to_can_bus_fd", 1050, 1000),
        ("/scheme", 1000, 1000),
        ("/joint_states", 1000, 1000),
        ("/cycle", 1000, 1000),
        ("/events", 1500, 1500),
    ]
    assert [stamp_ns(payload) for *_, payload in messages] == [log_ns for _, log_ns, *_ in messages]
    assert struct.unpack_from("<d", messages[1][-1], 12) == (7.0,)
    assert unpack_log(messages[-1][-1]) == Event("info", "n", "m")
    assert rig.writer.frames == 5


@pytest.mark.parametrize("contract", [CODEC, fd_codec(BITS)], ids=["classic", "every kind of place"])
def test_each_message_of_the_dbc_is_decoded_as_cantools_does(contract):
    generator = np.random.default_rng(5)
    peer = cantools.database.load_string(contract.text.decode())
    frames = [
        Frame(message.can_id, generator.bytes(message.length), number)
        for number, message in enumerate([*contract.messages.values()] * 5)
    ]
    rig = Rig(tuple(contract.messages.values()))
    assert rig.write(pack_cycle(0, 0, [], [(False, frame) for frame in frames])) == [True]
    decoded = [message for message in rig.messages() if message[0].startswith("/decoded/")]
    assert len(decoded) == len(frames) >= 5 * 20
    for frame, (topic, *_, payload) in zip(frames, decoded, strict=True):
        theirs = peer.decode_message(frame.can_id, frame.data, decode_choices=False)
        names = [signal.name for signal in contract.message(topic.removeprefix("/decoded/")).signals]
        values = struct.unpack_from(f"<{len(names)}d", payload, 12)
        assert values == pytest.approx([theirs[name] for name in names], rel=1e-15), topic


def test_an_event_reports_the_packets_that_are_missing_before_it():
    rig = Rig()
    rig.write(pack_cycle(1, 0, CYCLE, []), pack_cycle(2, 3, CYCLE, []), pack_cycle(3, 3, CYCLE, []))
    rig.writer.lose(2)
    rig.write(pack_event(4, 4, Event("info", "n", "m")), pack_cycle(5, 4, CYCLE, []))
    messages = rig.messages()
    assert [topic[1:] for topic, *_ in messages] == ["cycle", "events", "cycle", "cycle", "events", "events", "cycle"]
    assert [unpack_log(payload).message for topic, *_, payload in messages if topic == "/events"] == [
        "3 packets are missing before this",
        "3 packets are missing before this",
        "m",
    ]


def test_a_chunk_ends_behind_the_packet_that_fills_it_and_is_written_with_the_count_of_its_packets():
    rig = Rig()
    body = [(ChannelId.CYCLE, bytes(CHUNK_BYTES // 100 - 43))]  # 100 of their records fill a chunk
    assert all(rig.write(*[pack_cycle(number, 0, body, []) for number in range(250)]))
    rig.file.flush()
    assert [packets for packets in rig.sink.packets if packets] == [101, 101, 48]
    assert len(rig.messages()) == 250
    assert [chunk.message_end_time for chunk in rig.chunks()] == [100, 201, 249]


def test_a_packet_without_content_counts_with_the_next_chunk():
    rig = Rig()
    assert rig.write(pack_cycle(1, 0, [], [])) == [True]
    rig.file.flush()
    assert rig.write(pack_cycle(2, 0, CYCLE, [])) == [True]
    rig.file.flush()
    assert [packets for packets in rig.sink.packets if packets] == [2]


def test_a_cycle_may_be_larger_than_a_chunk():
    rig = Rig()
    frames = [(False, Frame(0x181, number.to_bytes(8, "little"), number)) for number in range(9000)]
    assert rig.write(pack_cycle(0, 0, [], frames), pack_cycle(1, 0, CYCLE, [])) == [True, True]
    messages = rig.messages()
    assert len(messages) == 2 * 9000 + 1
    assert [payload[-8:] for topic, *_, payload in messages if topic == "/from_can_bus"] == [f.data for _, f in frames]


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
    rig = Rig()
    good = pack_cycle(3, 0, CYCLE, [(False, Frame(1, b"12", 3))])
    assert rig.write(good, wrong, good) == [True, False, True]
    assert [topic for topic, *_ in rig.messages()] == ["/from_can_bus", "/cycle"] * 2
    assert rig.writer.frames == 2
