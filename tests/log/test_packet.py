"""Packets between control process and writer: what is packed comes out again."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adacd_hil.log.recording.packet import (
    EVENT,
    IS_ERROR,
    IS_TX,
    ROOM,
    Columns,
    is_whole,
    long_data,
    pack_cycle,
    pack_event,
    times_ns,
    unpack,
    unpack_event,
)
from adacd_hil.records import Event
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.frame_lengths import CLASSIC_BYTES

TIMES = st.integers(0, 2**62)
COUNTS = st.integers(0, 2**32 - 1)
FRAMES = st.tuples(
    st.booleans(), st.builds(Frame, st.integers(0, 2**29 - 1), st.binary(max_size=64), TIMES, st.booleans())
)
MESSAGES = st.tuples(st.integers(0, 2**16 - 1), st.binary(max_size=500))
EVENTS = st.builds(Event, *[st.text(st.characters(codec="utf-8"), max_size=200)] * 3)
CYCLES = st.tuples(TIMES, COUNTS, st.lists(MESSAGES, max_size=6), st.lists(FRAMES, max_size=40))


def unpacked(*packets: bytes) -> Columns:
    edges = np.cumsum([0, *map(len, packets)])
    return unpack(np.frombuffer(b"".join(packets) + bytes(ROOM), np.uint8), edges[:-1], np.diff(edges))


def contents(columns: Columns) -> list:
    """List what each packet holds: an Event, or (t_ns, dropped, messages, frames) as `pack_cycle` takes them."""
    frames, messages = iter(range(len(columns.frames))), iter(range(len(columns.messages)))
    listed = []
    for index, head in enumerate(columns.heads):
        if head["kind"] == EVENT:
            listed.append((int(head["t_ns"]), int(head["dropped"]), unpack_event(columns, index)))
            continue
        own_frames = [frame_of(columns, next(frames)) for _ in range(head["frames"])]
        own_messages = [message_of(columns, next(messages)) for _ in range(head["messages"])]
        listed.append((int(head["t_ns"]), int(head["dropped"]), own_messages, own_frames))
    return listed


def frame_of(columns: Columns, number: int) -> tuple[bool, Frame]:
    row = columns.frames[number]
    is_long = row["length"] > CLASSIC_BYTES
    data = (long_data(columns, np.array([number]))[0] if is_long else row["data"]).tobytes()[: row["length"]]
    frame = Frame(int(row["can_id"]), data, int(row["t_ns"]), bool(row["flags"] & IS_ERROR))
    return bool(row["flags"] & IS_TX), frame


def message_of(columns: Columns, number: int) -> tuple[int, bytes]:
    channel, size = columns.messages[number].tolist()
    start = columns.body_starts[number]
    return channel, columns.data[start : start + size].tobytes()


@pytest.mark.slow
@given(st.lists(st.one_of(CYCLES, st.tuples(TIMES, COUNTS, EVENTS)), max_size=8))
def test_packets_come_out_as_they_went_in(packets):
    packed = [pack_event(*packet) if isinstance(packet[2], Event) else pack_cycle(*packet) for packet in packets]
    assert contents(unpacked(*packed)) == packets


def test_a_long_event_is_cut():
    assert contents(unpacked(pack_event(0, 0, Event("info", "name", "x" * 100_000)))) == [
        (0, 0, Event("info", "name", "x" * 4096))
    ]


GOOD = pack_cycle(5, 0, [(3, b"body")], [(True, Frame(1, bytes(12), 7))])
WRONG = {
    "cut in its tables": GOOD[:30],
    "cut in its rest": GOOD[:-1],
    "too long": GOOD + b"\0",
    "an event cut in its head": pack_event(0, 0, Event("info", "name", ""))[:20],
}


@pytest.mark.parametrize("wrong", WRONG.values(), ids=WRONG.keys())
def test_a_packet_whose_parts_do_not_fit_is_left_out_alone(wrong):
    good = contents(unpacked(GOOD))
    assert contents(unpacked(GOOD, wrong, GOOD)) == good + good


def test_data_that_no_frame_can_hold_shows_by_its_length():
    columns = unpacked(pack_cycle(0, 0, [], [(True, Frame(1, bytes(65), 0))]))
    assert columns.frames["length"].tolist() == [65]


def test_a_packet_without_a_whole_head_of_a_known_kind_is_told_apart():
    packets = (GOOD, b"", b"\x01", GOOD[:15], pack_event(-3, 0, Event("", "", "")), b"\x09" + GOOD[1:], GOOD)
    sizes = np.array([len(packet) for packet in packets])
    starts = np.cumsum(sizes) - sizes
    data = np.frombuffer(b"".join(packets) + bytes(ROOM), np.uint8)
    is_right = is_whole(data, starts, sizes)
    assert is_right.tolist() == [True, False, False, False, True, False, True]
    assert times_ns(data, starts[is_right]).tolist() == [5, -3, 5]
