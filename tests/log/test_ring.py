"""Packets in shared memory: all of them arrive, once and in order."""

import os

import numpy as np
import pytest

from adacd_hil.log.recording.ring import LEAST_BYTES, Ring, RingReader, padded_bytes, split

MOST = 2**20


@pytest.fixture
def ring():
    ring = Ring(LEAST_BYTES)
    yield ring
    ring.close()


@pytest.fixture
def reader(ring):
    return RingReader(ring.descriptor)


def test_packets_of_any_size_go_round_the_ring_often(ring, reader):
    generator = np.random.default_rng(3)
    sent, received = [], []
    while len(sent) < 2000:
        packet = generator.bytes(int(generator.integers(0, 900)))
        if ring.put_packet(packet):
            sent.append(packet)
        else:
            received += list(split(reader.take_packets(int(generator.integers(1, LEAST_BYTES)))))
    while data := reader.take_packets(MOST):
        received += list(split(data))
    assert received == sent
    assert ring.waiting == 0


def test_a_packet_without_room_changes_nothing_and_there_is_room_again_once_others_are_taken(ring, reader):
    assert ring.put_packet(bytes(LEAST_BYTES // 2))
    assert not ring.put_packet(bytes(LEAST_BYTES // 2 - 8))
    assert ring.packets == 1
    assert reader.take_packets(MOST)
    assert ring.put_packet(b"second")
    assert list(split(reader.take_packets(MOST))) == [b"second"]


@pytest.mark.parametrize(("size", "fits"), [(LEAST_BYTES - 4, True), (LEAST_BYTES - 3, False)])
def test_a_packet_may_fill_the_ring(size, fits, ring, reader):
    for _ in range(3):  # wherever it begins
        assert ring.put_packet(b"12345")
        assert reader.take_packets(MOST)
        assert ring.put_packet(bytes(size)) is fits
        assert len(list(split(reader.take_packets(MOST)))) == fits


def test_no_more_is_taken_than_asked_for_but_one_packet(ring, reader):
    packets = [b"a" * 100, b"b" * 100, b"c" * 500, b"d"]
    assert all(ring.put_packet(packet) for packet in packets)
    assert list(split(reader.take_packets(2 * padded_bytes(100)))) == packets[:2]
    assert list(split(reader.take_packets(30))) == packets[2:3]
    assert list(split(reader.take_packets(30))) == packets[3:]


def test_what_is_on_the_disk_is_counted(ring, reader):
    for count in (3, 4):
        reader.count_written(count)
    assert ring.written == 7


def test_a_packet_that_was_not_finished_is_not_there(ring, reader):
    """What a process leaves behind that is killed while it puts: HEAD has not moved."""
    ring.put_packet(b"whole")
    place = os.fstat(ring.descriptor).st_size - ring.capacity + padded_bytes(5)
    os.pwrite(ring.descriptor, (100).to_bytes(4, "little"), place)
    assert list(split(reader.take_packets(MOST))) == [b"whole"]


def test_all_pages_are_there_before_the_first_packet():
    ring = Ring(2**20)
    assert os.fstat(ring.descriptor).st_blocks * 512 >= 2**20
    ring.close()
