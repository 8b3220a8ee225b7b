"""Frames at the times of their recording."""

import pytest

from adacd_hil.clock import VirtualClock
from adacd_hil.lab.logs.playback import LEAD_NS, LOOP_PAUSE_NS, Lateness, play, repeat
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.embedded_bus import EmbeddedBus

BEGIN_NS = 1_000_000_000


class StallingClock(VirtualClock):
    """Wakes up late at given times."""

    def __init__(self, stalls=None):
        super().__init__()
        super().sleep_until_ns(BEGIN_NS)
        self._stalls = dict(stalls or {})

    def sleep_until_ns(self, t_ns):
        super().sleep_until_ns(t_ns)
        super().sleep_until_ns(t_ns + self._stalls.pop(t_ns - BEGIN_NS - LEAD_NS, 0))


def played(times_ns, stalls=None, **options):
    """Play frames that are numbered; return (number, time since the first was due) of each, and the lateness."""
    clock = StallingClock(stalls)
    bus = EmbeddedBus(clock)
    sent = []
    bus.attach(lambda frame: sent.append((frame.can_id, frame.t_ns - BEGIN_NS - LEAD_NS)))
    frames = [Frame(number, b"x", t_ns) for number, t_ns in enumerate(times_ns)]
    return sent, play(bus, clock, frames, **options)


def test_frames_keep_the_times_of_their_recording():
    sent, lateness = played([5_000, 5_300, 5_300, 1_000_005_000])
    assert sent == [(0, 0), (1, 300), (2, 300), (3, 1_000_000_000)]
    assert (lateness.frames, lateness.worst_ns, lateness.late_frames) == (4, 0, 0)


@pytest.mark.parametrize(("speed", "expected_ns"), [(2.0, 500_000), (0.5, 2_000_000)])
def test_speed_divides_the_times(speed, expected_ns):
    assert played([7, 1_000_007], speed=speed)[0][1] == (1, expected_ns)


def test_a_late_frame_does_not_move_those_after_it():
    sent, lateness = played([0, 1_000_000, 2_000_000, 5_000_000], stalls={1_000_000: 2_500_000})
    assert sent == [(0, 0), (1, 3_500_000), (2, 3_500_000), (3, 5_000_000)]
    assert (lateness.frames, lateness.worst_ns, lateness.late_frames) == (4, 2_500_000, 2)


def test_a_millisecond_is_not_late_yet():
    assert played([0, 10_000_000], stalls={10_000_000: 1_000_000})[1].late_frames == 0


def test_a_frame_out_of_order_goes_with_those_before_it():
    sent, lateness = played([1_000, 3_000, 2_000, 4_000])
    assert sent == [(0, 0), (1, 2_000), (2, 2_000), (3, 3_000)]
    assert lateness.worst_ns == 0


def test_long_pauses_are_cut():
    sent, _ = played([0, 1_000, 90_001_000, 90_002_000, 99_000_000], longest_pause_ns=8_000_000)
    assert [t_ns for _, t_ns in sent] == [0, 1_000, 8_001_000, 8_002_000, 16_002_000]


def test_playback_stops_when_asked():
    asked = iter([False] * 5 + [True] * 100)
    sent, lateness = played(range(0, 10_000_000_000, 1_000_000_000), is_stopped=lambda: next(asked))
    assert len(sent) == lateness.frames < 10


def test_a_recording_is_repeated_by_one_clock():
    recording = [Frame(1, b"", 500), Frame(2, b"", 900)]
    twice = list(repeat(lambda: recording, 2))
    second_ns = 900 + LOOP_PAUSE_NS
    assert [(frame.t_ns, frame.can_id) for frame in twice] == [(500, 1), (900, 2), (second_ns, 1), (second_ns + 400, 2)]
    third = list(repeat(lambda: recording, 3))[4:]
    assert third[0].t_ns == second_ns + 400 + LOOP_PAUSE_NS


def test_a_recording_is_repeated_for_ever_unless_it_is_empty():
    endless = repeat(lambda: [Frame(1, b"", 0)], 0)
    assert [next(endless).t_ns for _ in range(4)][-1] == 3 * LOOP_PAUSE_NS
    assert list(repeat(list, 0)) == []


def test_quantiles_count_whole_microseconds():
    lateness = Lateness()
    for late_ns in [0] * 98 + [1_500, 7_000_999]:
        lateness.add_lateness(late_ns)
    assert [lateness.quantile_us(share) for share in (0.5, 0.98, 0.99, 1.0)] == [1, 1, 2, 7001]
    assert Lateness().quantile_us(0.5) == 0
