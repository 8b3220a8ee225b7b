"""The devices around a recorded arm: SYNC is answered by the recording, all else live."""

import struct

import pytest
from bench_host import CODEC, BenchHost, Nmt

from adacd_hil.lab.logs.frame_writer import FrameWriter
from adacd_hil.log.frames.mcap_frames import RecordedFrame
from adacd_hil.wire.time_marks import DEVICE_MARK, HOST_MARK, MarkKind, pack_mark, unpack_mark
from firmware_sim.bench.recorded_bench import RecordedBench, RecordedCycles
from firmware_sim.scenario.scenario import load_scenario

SYNC, NMT = 0x080, 0x000
FEEDBACKS, TORQUES = (0x181, 0x182), (0x183, 0x184)
RESET = (NMT, bytes([Nmt.RESET_COMMUNICATION, 0]))


def sync(counter):
    return SYNC, bytes([counter])


def answers(number):
    """Make the four frames of a cycle, with contents of its own."""
    feedbacks = [(can_id, struct.pack("<ii", 1000 * number + place, -number)) for place, can_id in enumerate(FEEDBACKS)]
    torques = [(can_id, struct.pack("<Hi", 0x1000, 2000 * number + place)) for place, can_id in enumerate(TORQUES)]
    return (*feedbacks, *torques)


def recorded(path, frames):
    """Write a recording; the host's frames aren't marked as such, as in one by a third party."""
    with path.open("wb") as file:
        writer = FrameWriter(file)
        for t_ms, (can_id, data) in enumerate(frames):
            writer.write_frame(RecordedFrame(1_000_000 * t_ms, can_id, data, len(data)))
        writer.finish()
    return RecordedCycles(path, CODEC)


def test_cycles_are_counted_from_the_first_sync_after_a_reset(tmp_path):
    frames = [
        sync(200),
        *answers(1),
        RESET,
        RESET,
        (NMT, bytes([Nmt.START, 0])),
        sync(7),
        *answers(2),
        sync(8),
        *answers(3),
    ]
    cycles = recorded(tmp_path / "x.mcap", frames)
    cycles.begin()
    assert cycles.take(0) == answers(1)
    cycles.begin()
    assert [cycles.take(0), cycles.take(1), cycles.take(2)] == [answers(2), answers(3), ()]
    assert (cycles.answered, cycles.is_over) == (3, True)


def test_a_lost_sync_leaves_a_gap_the_counter_wraps_and_a_host_may_skip_cycles(tmp_path):
    frames = [sync(239), *answers(1), sync(240), *answers(2), sync(3), *answers(3), (SYNC, b""), *answers(4)]
    for numbers, expected in (
        (range(6), [answers(1), answers(2), (), (), answers(3), answers(4)]),
        ((0, 4, 1, 5), [answers(1), answers(3), (), answers(4)]),
    ):
        cycles = recorded(tmp_path / "x.mcap", frames)
        cycles.begin()
        assert [cycles.take(number) for number in numbers] == expected


def test_an_attempt_that_the_host_ends_early_is_left_out_to_its_end(tmp_path):
    frames = [sync(1), *answers(1), sync(2), *answers(2), RESET, sync(1), *answers(3)]
    cycles = recorded(tmp_path / "x.mcap", frames)
    cycles.begin()
    assert cycles.take(0) == answers(1)
    cycles.begin()
    assert cycles.take(0) == answers(3)


class Host(BenchHost):
    """A host of a bench around a recorded arm."""

    def __init__(self, cycles):
        super().__init__()
        self.bench = RecordedBench(load_scenario("idle"), CODEC, lambda *frame: self.frames.append(frame), cycles)
        self.bench.boot()

    def answer(self, can_id, data):
        """Send a frame; return what came back at once."""
        self.take()
        self.put(can_id, data)
        return self.take()

    def cyclic(self, counter):
        """Send SYNC; return what came back of the frames that follow each."""
        return tuple(frame for frame in self.answer(*sync(counter)) if frame[0] in (*FEEDBACKS, *TORQUES))


@pytest.fixture
def host(tmp_path):
    frames = [RESET, *(frame for number in range(1, 4) for frame in (sync(number), *answers(number)))]
    frames[-1:] = [sync(4), answers(4)[0]]
    host = Host(recorded(tmp_path / "x.mcap", frames))
    host.put(*RESET)
    host.put(NMT, bytes([Nmt.START, 0]))
    return host


def test_sync_is_answered_from_the_recordings_first_cycle_on_whatever_the_hosts_counter(host):
    assert [host.cyclic(number) for number in (239, 240)] == [answers(1), answers(2)]


def test_nothing_is_answered_before_the_nodes_are_operational(tmp_path):
    host = Host(recorded(tmp_path / "x.mcap", [sync(1), *answers(1), sync(2), *answers(2)]))
    assert host.cyclic(1) == ()
    host.put(NMT, bytes([Nmt.START, 0]))
    assert host.cyclic(2) == answers(2)


def test_after_the_recording_sync_is_not_answered(host):
    assert len([host.cyclic(number) for number in (1, 2, 3, 4)][-1]) == 1
    assert host.cyclic(5) == ()


def test_objects_read_as_the_recording_shows_the_arm(host):
    host.put(*sync(1))
    host.put(*sync(2))
    assert [host.read(1, 0x6064), host.read(2, 0x6064), host.read(2, 0x606C)] == [2000, 2001, -2]


def test_a_host_in_lockstep_hears_that_a_cycle_lacks_frames(host):
    host.put(HOST_MARK, pack_mark(MarkKind.ADVANCE, 0))
    assert DEVICE_MARK not in [can_id for can_id, _ in host.answer(*sync(2))]
    assert DEVICE_MARK in [can_id for can_id, _ in host.answer(*sync(4))]
    (*_, (last_id, last)) = host.answer(*sync(5))
    assert (last_id, unpack_mark(last)[0]) == (DEVICE_MARK, MarkKind.END)


def test_without_cycles_all_but_sync_is_answered():
    host = Host(None)
    assert [data for _, data in host.answer(*RESET)] == [b"\0"] * 4
    host.put(NMT, bytes([Nmt.START, 0]))
    assert host.cyclic(1) == ()
    assert host.read(1, 0x6064) == 0
