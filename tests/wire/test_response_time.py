"""Response times: the published counter-example, hand-made cases, and a bus played frame by frame."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from adacd_hil.wire.budget import HORIZON_NS, ResponseTime, Stream, is_overloaded, response_time

MS = 1_000_000
BIT_NS = 8_000  # 125 kbit/s

# Davis, Burns, Bril, Lukkien 2007, table 3: three messages of 125 bits at 125 kbit/s.
A, B, C = Stream(1 * MS, 2_500_000), Stream(1 * MS, 3_500_000), Stream(1 * MS, 3_500_000)
DEADLINE_OF_C = 3_250_000


def play(streams: list[Stream], blocking_ns: int, until_ns: int) -> list[int]:
    """Play the bus from the critical instant on: all queued at once, just after a frame that blocks them.

    Returns each stream's longest response time. Source: arbitration as in ISO 11898-1, one frame after the other.
    """
    now_ns = blocking_ns
    sent = [0] * len(streams)
    worst = [0] * len(streams)
    while now_ns < until_ns:
        waiting = [k for k, s in enumerate(streams) if sent[k] * s.interval_ns <= now_ns]
        if not waiting:
            now_ns = min(sent[k] * s.interval_ns for k, s in enumerate(streams))
            continue
        k = waiting[0]
        now_ns += streams[k].duration_ns
        worst[k] = max(worst[k], now_ns - sent[k] * streams[k].interval_ns)
        sent[k] += 1
    return worst


def test_the_published_counter_example_the_second_instance_of_c_is_late() -> None:
    assert response_time(A, [], 1 * MS, BIT_NS) == ResponseTime(2 * MS)
    assert response_time(B, [A], 1 * MS, BIT_NS) == ResponseTime(3 * MS)
    worst = response_time(C, [A, B], 0, BIT_NS)
    # The analysis of 1994 stops at the first instance: 3.0 ms, in time. The second takes 3.5 ms.
    assert worst == ResponseTime(3_500_000)
    assert worst.time_ns > DEADLINE_OF_C


def test_a_frame_queued_within_the_bit_in_which_arbitration_begins_still_wins() -> None:
    # At 100 µs the bus becomes free; the next frame of the higher message is queued half a bit later.
    higher = [Stream(50_000, 100_500)]
    assert response_time(Stream(50_000, 10 * MS), higher, 50_000, 1000) == ResponseTime(50_000 + 2 * 50_000 + 50_000)
    assert response_time(Stream(50_000, 10 * MS), higher, 50_000, 100) == ResponseTime(50_000 + 50_000 + 50_000)


def test_a_message_on_a_bus_that_is_full_has_no_bound() -> None:
    full = [Stream(135_000, MS)] * 7  # 945 µs of 1 ms
    response = response_time(Stream(135_000, MS), full, 135_000, 1000, MS)
    assert not response.is_bounded
    assert response.time_ns > MS
    assert response_time(Stream(50_000, MS), full, 0, 1000, MS) == ResponseTime(995_000)


def test_a_bus_that_is_exactly_full_is_given_up_at_the_horizon() -> None:
    # Blocked once, it never catches up; no frame is later than 1.1 ms though.
    response = response_time(Stream(500_000, MS), [Stream(500_000, MS)], 100_000, 1000, HORIZON_NS)
    assert response == ResponseTime(1_100_000, is_bounded=False)


def test_overload_is_decided_in_whole_numbers() -> None:
    thirds = [Stream(1, 3), Stream(1, 3), Stream(1, 3)]
    assert not is_overloaded(thirds)
    assert is_overloaded([*thirds, Stream(1, 1_000_000_000)])


STREAMS = st.lists(
    st.builds(
        Stream,
        st.integers(40, 160).map(lambda us: us * 1000),
        st.integers(3, 40).map(lambda k: k * 250_000),
    ),
    min_size=1,
    max_size=6,
).filter(lambda streams: sum(s.duration_ns / s.interval_ns for s in streams) < 0.8)


@pytest.mark.slow
@given(streams=STREAMS, blocking_us=st.integers(0, 160))
def test_no_played_bus_is_later_than_the_analysis_and_the_lowest_is_as_late(
    streams: list[Stream], blocking_us: int
) -> None:
    played = play(streams, blocking_us * 1000, 20 * MS)
    for place, stream in enumerate(streams):
        found = response_time(stream, streams[:place], blocking_us * 1000, 1)
        assert found.is_bounded
        lower = max((s.duration_ns for s in streams[place + 1 :]), default=0)
        assert played[place] <= response_time(stream, streams[:place], max(lower, blocking_us * 1000), 1).time_ns
    assert played[-1] == response_time(streams[-1], streams[:-1], blocking_us * 1000, 1).time_ns
