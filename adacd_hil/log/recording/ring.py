"""Ring of packets in memory that control process and writer share: one side puts, the other takes.

Neither side needs a system call, and neither waits for the other. The memory begins with a page of counts, each an
aligned uint64 that only one side writes: HEAD, bytes ever put; TAIL, bytes ever taken; DROPPED, packets that were not
put; PEAK, most bytes that were found waiting; WRITTEN, packets that are on the disk. Then the ring: a packet is its
size in 4 bytes, its bytes, and padding to a multiple of 8; a packet that reaches the end continues at the beginning.

HEAD moves last: if a process is killed in between, only whole packets remain. Whether the other side sees the bytes
before HEAD depends on the processor: x86-64 keeps the order of its writes. Elsewhere some 10 ns pass in which the order
may be wrong; a packet taken too early is invalid, and is counted as such.
"""

import mmap
import os
import struct
from collections.abc import Iterator

_HEAD, _TAIL, _DROPPED, _PEAK, _WRITTEN = range(5)
_COUNTS_BYTES = mmap.PAGESIZE
_SIZE = struct.Struct("<I")
_GRAIN = 8
"""Packets begin at multiples of this, so that the end of the ring never splits a size."""
LEAST_BYTES = mmap.PAGESIZE


def padded_bytes(size: int) -> int:
    """Return the bytes that a packet of `size` bytes takes in the ring."""
    return (_SIZE.size + size + _GRAIN - 1) & -_GRAIN


class _SharedRing:
    """Common part of the ring's writing and reading side: the shared memory and its counts."""

    def __init__(self, descriptor: int) -> None:
        self._memory = mmap.mmap(descriptor, os.fstat(descriptor).st_size)
        self._counts = memoryview(self._memory)[:_COUNTS_BYTES].cast("Q")
        self.capacity = len(self._memory) - _COUNTS_BYTES

    @property
    def waiting(self) -> int:
        """Bytes that have been put and not taken."""
        return self._counts[_HEAD] - self._counts[_TAIL]

    @property
    def peak(self) -> int:
        """Most bytes that the reader found waiting."""
        return self._counts[_PEAK]

    def _copy(self, start: int, size: int) -> bytes:
        """Return `size` bytes of the ring from a count such as TAIL on, across its end if need be."""
        place = start % self.capacity
        data = self._memory[_COUNTS_BYTES + place : _COUNTS_BYTES + min(place + size, self.capacity)]
        return data if len(data) == size else data + self._memory[_COUNTS_BYTES : _COUNTS_BYTES + size - len(data)]


class Ring(_SharedRing):
    """The ring's writing side: puts packets."""

    def __init__(self, capacity: int) -> None:
        """Make a ring of `capacity` bytes, at least LEAST_BYTES. Raises OSError, as when that much can't be locked."""
        self.descriptor = os.memfd_create("adacd-hil log")
        capacity = max(capacity, LEAST_BYTES) & -_GRAIN
        try:
            os.ftruncate(self.descriptor, _COUNTS_BYTES + capacity)
            super().__init__(self.descriptor)
        except OSError:
            os.close(self.descriptor)
            raise
        # Touch each page once, so that the cycle has no page fault.
        for place in range(0, len(self._memory), mmap.PAGESIZE):
            self._memory[place] = 0
        self.packets = 0
        """Number of packets that were put."""
        self._head = 0
        self._room_until = self.capacity  # limit of HEAD by the last TAIL that was read

    def put_packet(self, packet: bytes) -> bool:
        """Add a packet and return True; return False, without waiting, if there is no room for it."""
        size = len(packet)
        head = self._head
        end = head + padded_bytes(size)
        if end > self._room_until:
            self._room_until = self._counts[_TAIL] + self.capacity
            if end > self._room_until:
                return False
        place = head % self.capacity
        start = _COUNTS_BYTES + place + _SIZE.size
        _SIZE.pack_into(self._memory, start - _SIZE.size, size)
        room = self.capacity - place - _SIZE.size
        if size <= room:
            self._memory[start : start + size] = packet
        else:
            self._memory[start:] = packet[:room]
            self._memory[_COUNTS_BYTES : _COUNTS_BYTES + size - room] = packet[room:]
        self._head = self._counts[_HEAD] = end
        self.packets += 1
        return True

    def count_dropped(self, dropped: int) -> None:
        """Share with the reader the number of packets that were not put since the beginning."""
        self._counts[_DROPPED] = dropped

    @property
    def written(self) -> int:
        """Number of packets on the disk."""
        return self._counts[_WRITTEN]

    def close(self) -> None:
        """Release the shared memory; later calls of `put_packet` return False."""
        self._counts.release()
        self._memory.close()
        os.close(self.descriptor)
        self._counts = memoryview(bytearray(_COUNTS_BYTES)).cast("Q")
        self.capacity = self._room_until = 0


class RingReader(_SharedRing):
    """The ring's reading side: takes packets."""

    @property
    def dropped(self) -> int:
        """Number of packets that the writing side could not put since the beginning."""
        return self._counts[_DROPPED]

    def count_written(self, packets: int) -> None:
        """Add `packets` to the shared count of packets on the disk."""
        self._counts[_WRITTEN] += packets

    def take_packets(self, most: int) -> bytes:
        """Remove and return whole packets, at most `most` bytes, or a longer one alone; b"" if the ring is empty.

        Pass the result to `split`. Also raises `peak`.
        """
        tail = self._counts[_TAIL]
        waiting = self._counts[_HEAD] - tail
        self._counts[_PEAK] = max(self._counts[_PEAK], waiting)
        data = self._copy(tail, min(waiting, most))
        if waiting > most:
            data = data[: _whole_bytes(data)] or self._copy(tail, self._first_bytes(tail))
        self._counts[_TAIL] = tail + len(data)
        return data

    def _first_bytes(self, start: int) -> int:
        """Return the bytes that the packet at `start`, a count such as TAIL, takes in the ring."""
        return padded_bytes(_SIZE.unpack(self._copy(start, _SIZE.size))[0])


def split(data: bytes) -> Iterator[bytes]:
    """Yield the bytes of each packet in data that `RingReader.take_packets` returned."""
    place = 0
    while place < len(data):
        (size,) = _SIZE.unpack_from(data, place)
        yield data[place + _SIZE.size : place + _SIZE.size + size]
        place += padded_bytes(size)


def _whole_bytes(data: bytes) -> int:
    """Return the length of the whole packets at the beginning of the data."""
    place = 0
    while place + _SIZE.size <= len(data):
        end = place + padded_bytes(_SIZE.unpack_from(data, place)[0])
        if end > len(data):
            break
        place = end
    return place
