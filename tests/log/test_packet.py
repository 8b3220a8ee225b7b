"""Packets between control process and writer: what is packed comes out again."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from adacd_hil.log.recording.packet import pack_cycle, pack_event, unpack
from adacd_hil.records import Event
from adacd_hil.wire.bus import Frame

TIMES = st.integers(0, 2**62)
COUNTS = st.integers(0, 2**32 - 1)
FRAMES = st.tuples(
    st.booleans(), st.builds(Frame, st.integers(0, 2**29 - 1), st.binary(max_size=64), TIMES, st.booleans())
)
MESSAGES = st.tuples(st.integers(0, 2**16 - 1), st.binary(max_size=500))
EVENTS = st.builds(Event, *[st.text(st.characters(codec="utf-8"), max_size=200)] * 3)
CYCLES = st.tuples(TIMES, COUNTS, st.lists(MESSAGES, max_size=6), st.lists(FRAMES, max_size=40))


def content(packed: bytes) -> tuple | None:
    """Return what a packet holds, as `pack_cycle` and `pack_event` take it."""
    packet = unpack(packed)
    if packet is None:
        return None
    held = (packet.messages, packet.frames) if packet.event is None else (packet.event,)
    return (packet.t_ns, packet.dropped, *held)


@pytest.mark.slow
@given(st.one_of(CYCLES, st.tuples(TIMES, COUNTS, EVENTS)))
def test_a_packet_comes_out_as_it_went_in(packet):
    packed = pack_event(*packet) if isinstance(packet[2], Event) else pack_cycle(*packet)
    assert content(packed) == packet


def test_a_long_event_is_cut():
    packed = pack_event(0, 0, Event("info", "name", "x" * 100_000))
    assert content(packed) == (0, 0, Event("info", "name", "x" * 4096))


GOOD = pack_cycle(5, 0, [(3, b"body")], [(True, Frame(1, bytes(12), 7))])
WRONG = {
    "empty": b"",
    "cut in its head": GOOD[:15],
    "cut in its tables": GOOD[:30],
    "cut in its rest": GOOD[:-1],
    "too long": GOOD + b"\0",
    "of an unknown kind": b"\x09" + GOOD[1:],
    "an event cut in its head": pack_event(0, 0, Event("info", "name", ""))[:20],
    "an event cut in its text": pack_event(0, 0, Event("info", "name", "text"))[:-1],
    "a frame longer than any frame": pack_cycle(0, 0, [], [(True, Frame(1, bytes(65), 0))]),
}


@pytest.mark.parametrize("wrong", WRONG.values(), ids=WRONG.keys())
def test_a_packet_whose_parts_do_not_fit_has_no_content(wrong):
    assert unpack(GOOD) is not None
    assert unpack(wrong) is None
