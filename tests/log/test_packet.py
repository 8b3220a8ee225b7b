"""Packets between control process and writer: what is packed comes out again."""

from hypothesis import given
from hypothesis import strategies as st

from adacd_hil.log.packet import CyclePacket, EventPacket, LoggedFrame, pack_cycle, pack_end, pack_event, unpack
from adacd_hil.records import Event
from adacd_hil.wire.bus import Frame

TIMES = st.integers(0, 2**62)
COUNTS = st.integers(0, 2**32 - 1)
FRAMES = st.tuples(
    st.booleans(), st.builds(Frame, st.integers(0, 2**29 - 1), st.binary(max_size=64), TIMES, st.booleans())
)
MESSAGES = st.tuples(st.integers(0, 2**16 - 1), st.binary(max_size=500))


@given(TIMES, COUNTS, st.lists(MESSAGES, max_size=6), st.lists(FRAMES, max_size=40))
def test_a_cycle_comes_out_as_it_went_in(t_ns, dropped, messages, frames):
    expected = [
        LoggedFrame(frame.can_id, len(frame.data), is_tx, frame.is_error, frame.data.ljust(8, b"\0"), frame.t_ns)
        for is_tx, frame in frames
    ]
    assert unpack(pack_cycle(t_ns, dropped, messages, frames)) == CyclePacket(t_ns, dropped, expected, messages)


@given(TIMES, COUNTS, st.builds(Event, *[st.text(st.characters(codec="utf-8"), max_size=200)] * 3))
def test_an_event_comes_out_as_it_went_in(t_ns, dropped, event):
    assert unpack(pack_event(t_ns, dropped, event)) == EventPacket(t_ns, dropped, event)


def test_a_long_event_is_cut():
    packet = unpack(pack_event(0, 0, Event("info", "name", "x" * 100_000)))
    assert isinstance(packet, EventPacket)
    assert packet.event == Event("info", "name", "x" * 4096)


def test_the_end_is_the_end():
    assert unpack(pack_end(3)) is None


def test_data_that_no_frame_can_hold_shows_by_its_length():
    packet = unpack(pack_cycle(0, 0, [], [(True, Frame(1, bytes(65), 0))]))
    assert isinstance(packet, CyclePacket)
    assert packet.frames[0].length == 65


def test_classic_frames_are_packed_without_room_for_more():
    frames = [(False, Frame(1, bytes(8), 0))] * 7
    longer = [*frames, (False, Frame(1, bytes(24), 0))]
    empty, classic, mixed = (len(pack_cycle(0, 0, [], each)) for each in ([], frames, longer))
    assert classic - empty == 7 * 24
    assert mixed - classic == 24 + 16
