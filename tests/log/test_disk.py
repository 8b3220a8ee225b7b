"""A slow disk and a full one: the ring is emptied all the same, memory is bounded, and what is lost is counted."""

import dataclasses
import os
import re
import threading

import pytest
from live_rig import ThreadedWriter, setup_of
from made_log import disk_full_at
from recorded_run import make_run

from adacd_hil.log.log_files import find_parts
from adacd_hil.log.reader import read_log
from adacd_hil.log.recording.log_file import Sink
from adacd_hil.log.recording.packet import pack_cycle, pack_event
from adacd_hil.log.recording.writer import FLUSH_PERIOD_NS, RETRY_PERIOD_NS
from adacd_hil.log.types.topics import run_channels
from adacd_hil.wire.bus import Frame

pytestmark = pytest.mark.slow

MOST_WAITING = 300_000
STEP_NS = 8 * FLUSH_PERIOD_NS


class HastyClock:
    """Time enough to flush passes between any two looks at it."""

    def __init__(self):
        self.now = 0

    def now_ns(self):
        self.now += STEP_NS
        return self.now


class Writer(ThreadedWriter):
    """Its sink holds little, and its clock makes haste."""

    def __init__(self, path, descriptor, part_bytes=0):
        self.dropped = 0
        self.clock = HastyClock()
        self.sink = Sink(descriptor, path, waits=False, most_waiting=MOST_WAITING)
        self.told = []
        self.sink.say = self.told.append
        setup = dataclasses.replace(setup_of(None, path), channels=run_channels(7), messages=(), part_bytes=part_bytes)
        super().__init__(setup, self.sink, self.clock)

    def feed(self, cycles):
        for cycle in cycles:
            self.put(pack_cycle(cycle.t_ns, self.dropped, cycle.messages(), cycle.frames))
            if cycle.event is not None:
                self.put(pack_event(cycle.t_ns, self.dropped, cycle.event))

    def put(self, packet):
        while not self.ring.put_packet(packet):
            os.sched_yield()

    def wait(self, condition):
        while not condition():  # the test's time limit ends it
            os.sched_yield()

    def wait_until_taken(self):
        self.wait(lambda: not self.ring.waiting)
        seen = self.clock.now
        self.wait(lambda: self.clock.now > seen + STEP_NS)


def packets_of(cycles):
    return len(cycles) + sum(cycle.event is not None for cycle in cycles)


def missing_in(log):
    notices = [event.message for _, event in log.events if event.name == "log"]
    return [int(re.fullmatch(r"(\d+) packets are missing before this", notice)[1]) for notice in notices]


def assert_accounts_for(log, cycles, lost):
    """Every packet is in the log, or missed by it."""
    missing = missing_in(log)
    assert sum(missing) == lost > 0
    assert len(log.scheme) + len(log.events) - len(missing) == packets_of(cycles) - lost


def test_a_slow_disk_costs_packets_and_bounded_memory(tmp_path):
    run = make_run(2000)
    left, right = os.pipe()
    written = bytearray()

    def read_all():
        while data := os.read(left, 65536):
            written.extend(data)

    writer = Writer(tmp_path / "run.mcap", right)
    for start in range(0, 1900, 190):
        writer.feed(run.cycles[start : start + 190])
        writer.wait_until_taken()
        assert writer.sink.waiting < MOST_WAITING + 300_000
    assert writer.sink.is_behind
    disk = threading.Thread(target=read_all)
    disk.start()
    writer.wait(lambda: writer.sink.waiting < MOST_WAITING // 4)
    writer.feed(run.cycles[1900:])
    word = writer.end()
    disk.join()
    os.close(left)
    (tmp_path / "copy.mcap").write_bytes(written)
    log = read_log(tmp_path / "copy.mcap")
    assert log.problem == f"{word['lost']} packets never reached the log"
    assert word["error"] == ""
    assert_accounts_for(log, run.cycles, int(word["lost"]))
    assert int(word["lost"]) > 1000
    assert log.scheme.block[-100:].tobytes() == run.blocks[-100:].tobytes()


def create(path):
    return os.open(path, os.O_WRONLY | os.O_CREAT)


@pytest.fixture
def writer(tmp_path):
    """It ends though the test fails: sockets that it left open would fail the next one."""
    path = tmp_path / "run.mcap"
    writer = Writer(path, create(path))
    yield writer
    if writer.ring.capacity:
        writer.end()


def test_a_full_disk_is_tried_again_with_another_part(tmp_path, writer):
    run = make_run(1200)
    path = writer.sink.path
    writer.feed(run.cycles[:300])
    writer.wait_until_taken()
    with disk_full_at(0):
        writer.feed(run.cycles[300:900])
        writer.wait_until_taken()
        full = f"log {path} can't be written: File too large; packets are dropped until there is room"
        assert writer.told == [full]
    failed = writer.clock.now
    writer.wait(lambda: writer.clock.now > failed + 2 * RETRY_PERIOD_NS)
    writer.feed(run.cycles[900:])
    word = writer.end()
    assert re.fullmatch(r"File too large after \d+ bytes", word["error"])
    assert (word["lost"], word["parts"]) == (str(packets_of(run.cycles[300:900])), "2")
    again = f"log {tmp_path / 'run_001.mcap'} is written again; packets are missing before it"
    assert writer.told == [full, again]
    log = read_log(path)
    assert list(find_parts(path)) == [0, 1]
    assert re.fullmatch(rf"run.mcap: cut after \d+ bytes; {word['lost']} packets never reached the log", log.problem)
    assert not log.is_complete
    assert log.summary["dropped"] == word["lost"]
    assert log.scheme.block[:300].tobytes() == run.blocks[:300].tobytes()
    assert log.scheme.block[300:].tobytes() == run.blocks[900:].tobytes()
    assert_accounts_for(log, run.cycles, int(word["lost"]))


def test_a_part_without_data_is_begun_again_when_there_is_room(writer):
    run = make_run(400)
    path = writer.sink.path
    with disk_full_at(0):
        writer.feed(run.cycles[:200])
        writer.wait_until_taken()
    failed = writer.clock.now
    writer.wait(lambda: writer.clock.now > failed + 2 * RETRY_PERIOD_NS)
    writer.feed(run.cycles[200:])
    word = writer.end()
    assert (word["lost"], word["parts"]) == (str(packets_of(run.cycles[:200])), "1")
    log = read_log(path)
    assert log.problem == f"{word['lost']} packets never reached the log"
    assert log.scheme.block.tobytes() == run.blocks[200:].tobytes()


@pytest.mark.parametrize("has_chunk", [False, True])
def test_a_disk_that_stays_full_leaves_no_part_without_data(has_chunk, tmp_path, writer):
    run = make_run(400)
    path = writer.sink.path
    if has_chunk:
        writer.feed(run.cycles[:200])
        writer.wait_until_taken()
    with disk_full_at(0):
        writer.feed(run.cycles[200:])
        writer.wait_until_taken()
        failed = writer.clock.now
        writer.wait(lambda: writer.clock.now > failed + 4 * RETRY_PERIOD_NS)
        word = writer.end()
    assert word["lost"] == str(packets_of(run.cycles[200:]))
    assert [file.name for file in tmp_path.iterdir()] == ["run.mcap"]
    assert path.stat().st_size == 0 if not has_chunk else len(read_log(path).scheme) == 200
    assert word["error"].startswith("File too large")
    assert len(writer.told) == 1


def test_what_was_dropped_is_counted_in_one_part_only(tmp_path):
    run = make_run(30)
    path = tmp_path / "run.mcap"
    writer = Writer(path, create(path), part_bytes=1)
    for start in (0, 10, 20):
        writer.dropped = (start > 0) * 5
        writer.ring.count_dropped(writer.dropped)
        writer.feed(run.cycles[start : start + 10])
        writer.wait_until_taken()
    word = writer.end()
    log = read_log(path)
    assert len(find_parts(path)) == int(word["parts"]) >= 3
    assert log.problem == "5 packets never reached the log"
    assert missing_in(log) == [5]


def test_a_packet_that_makes_no_sense_is_dropped_alone(writer):
    run = make_run(10)
    path = writer.sink.path
    writer.feed(run.cycles[:5])
    for packet in (
        pack_cycle(1, 0, [], [(True, Frame(1, bytes(65), 0))]),
        pack_cycle(1, 0, [(9999, b"")], []),
        b"\x01",
    ):
        writer.put(packet)
    writer.feed(run.cycles[5:])
    word = writer.end()
    assert (word["lost"], word["error"]) == ("3", "")
    assert read_log(path).scheme.block.tobytes() == run.blocks.tobytes()
