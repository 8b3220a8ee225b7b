"""Packets in shared memory: all of them arrive, once and in order, also when the control process dies."""

import os
import select

import numpy as np
import pytest
from mcap.records import Message
from mcap.stream_reader import StreamReader
from recorded_run import feed, make_run, start, wait_until_taken

from adacd_hil.log.reader import read_log
from adacd_hil.log.recording.ring import LEAST_BYTES, Ring, RingReader, room_of, split
from adacd_hil.records import Event
from adacd_hil.settings.run_settings import LogSettings

MOST = 2**20


@pytest.fixture
def ring():
    ring = Ring(LEAST_BYTES)
    yield ring
    ring.close()


@pytest.fixture
def reader(ring):
    return RingReader(ring.descriptor)


def packets_of(data):
    return [data[start : start + size] for start, size in zip(*split(data), strict=True)]


def test_what_is_put_comes_out_in_order(ring, reader):
    packets = [bytes([number]) * number for number in range(50)]
    assert all(ring.put_packet(packet) for packet in packets)
    assert ring.waiting == reader.waiting == sum(map(room_of, range(50)))
    assert packets_of(reader.take_packets(MOST)) == packets
    assert reader.take_packets(MOST) == b""
    assert ring.waiting == 0


def test_packets_of_any_size_go_round_the_ring_often(ring, reader):
    generator = np.random.default_rng(3)
    sent, received = [], []
    while len(sent) < 2000:
        packet = generator.bytes(int(generator.integers(0, 900)))
        if ring.put_packet(packet):
            sent.append(packet)
        else:
            received += packets_of(reader.take_packets(int(generator.integers(1, LEAST_BYTES))))
    while data := reader.take_packets(MOST):
        received += packets_of(data)
    assert received == sent


def test_a_packet_without_room_changes_nothing_and_there_is_room_again_once_others_are_taken(ring, reader):
    assert ring.put_packet(bytes(LEAST_BYTES // 2))
    assert not ring.put_packet(bytes(LEAST_BYTES // 2 - 8))
    assert ring.packets == 1
    assert reader.take_packets(MOST)
    assert ring.put_packet(b"second")
    assert packets_of(reader.take_packets(MOST)) == [b"second"]


@pytest.mark.parametrize(("size", "fits"), [(LEAST_BYTES - 4, True), (LEAST_BYTES - 3, False)])
def test_a_packet_may_fill_the_ring(size, fits, ring, reader):
    for _ in range(3):  # wherever it begins
        assert ring.put_packet(b"12345")
        assert reader.take_packets(MOST)
        assert ring.put_packet(bytes(size)) is fits
        assert len(packets_of(reader.take_packets(MOST))) == fits


def test_no_more_is_taken_than_asked_for_but_one_packet(ring, reader):
    packets = [b"a" * 100, b"b" * 100, b"c" * 500, b"d"]
    assert all(ring.put_packet(packet) for packet in packets)
    assert packets_of(reader.take_packets(2 * room_of(100))) == packets[:2]
    assert packets_of(reader.take_packets(30)) == packets[2:3]
    assert packets_of(reader.take_packets(30)) == packets[3:]


def test_the_reader_remembers_the_most_that_waited(ring, reader):
    for count in (3, 7, 2):
        assert all(ring.put_packet(bytes(12)) for _ in range(count))
        reader.take_packets(MOST)
    assert ring.peak == 7 * 16


def test_what_is_on_the_disk_is_counted(ring, reader):
    for count in (3, 4):
        reader.count_written(count)
    assert ring.written == 7


def test_a_packet_that_was_not_finished_is_not_there(ring, reader):
    """What a process leaves behind that is killed while it puts: HEAD has not moved."""
    ring.put_packet(b"whole")
    place = ring._counts.nbytes + room_of(5)
    ring._memory[place : place + 4] = (100).to_bytes(4, "little")
    assert packets_of(reader.take_packets(MOST)) == [b"whole"]


def test_all_pages_are_there_before_the_first_packet():
    ring = Ring(2**20)
    assert os.fstat(ring.descriptor).st_blocks * 512 >= 2**20
    ring.close()


def end_of(recorder):
    """End the connection as the death of the control process does, and wait for the writer's end."""
    descriptor = os.pidfd_open(recorder.pid)
    recorder._socket.close()
    ended, _, _ = select.select([descriptor], [], [], 30)
    os.close(descriptor)
    recorder._process.wait()
    recorder._ring.close()
    return bool(ended)


@pytest.mark.slow
@pytest.mark.parametrize("blocking", [True, False])
def test_what_waits_in_the_ring_is_written_once_though_the_control_process_dies(blocking, tmp_path):
    run = make_run(12)
    recorder = start(tmp_path / "run.mcap", run, blocking=blocking)
    feed(recorder, run.cycles[:7])
    wait_until_taken(recorder)
    feed(recorder, run.cycles[7:])
    assert end_of(recorder)
    log = read_log(tmp_path / "run.mcap")
    assert log.summary["ending"] == "control process died"
    assert log.scheme.block.tobytes() == run.blocks.tobytes()
    assert log.is_complete


@pytest.mark.slow
def test_packets_of_very_different_sizes_keep_their_order(tmp_path):
    recorder = start(tmp_path / "run.mcap", make_run(0), settings=LogSettings(buffer_MiB=1))
    large = [(6, bytes(65000)), (6, bytes(65000))] * 3
    for number in range(12):
        recorder.cycle(number, large if number % 2 else [(6, bytes(100))])
        recorder.event(number, Event("info", "n", str(number)))
    assert recorder.close().is_complete
    with (tmp_path / "run.mcap").open("rb") as file:
        times = [record.publish_time for record in StreamReader(file).records if isinstance(record, Message)]
    assert times == [number for number in range(12) for _ in range(7 if number % 2 else 2)]
