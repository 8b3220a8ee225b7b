"""Packets that wait to be handed to the writer together, where it finds them should this process be killed.

In lockstep a packet of its own for every cycle would cost both sides more in system calls than all else about it. So
packets are gathered in memory that the writer shares, already in the form in which they are sent: kind BATCH, number
of the batch, bytes in use; then each packet after its size. The writer looks into that memory only when the socket
has ended without a last word: nothing is being written there any more, and what it holds was not sent unless the
writer knows its number.
"""

import mmap
import os
import struct

from adacd_hil.log.packet import BATCH

OUTBOX_BYTES = 64 * 1024
"""About 100 cycles of a run: the system calls of each are then cheap, and the writer is not kept waiting."""
_HEAD = struct.Struct("<BxxxII")
_NUMBER_PLACE = 4
_USED_PLACE = 8
_COUNT = struct.Struct("<I")


class Outbox:
    """The control side of the shared memory."""

    def __init__(self) -> None:
        self.descriptor = os.memfd_create("adacd-hil log outbox")
        os.ftruncate(self.descriptor, OUTBOX_BYTES)
        self.count = 0
        """Packets that wait."""
        self._memory = mmap.mmap(self.descriptor, OUTBOX_BYTES)
        self._used = 0
        self._number = 1
        _HEAD.pack_into(self._memory, 0, BATCH, self._number, 0)

    def put(self, packet: bytes) -> bool:
        """Add a packet; False when there is no room for it."""
        start = _HEAD.size + self._used + _COUNT.size
        end = start + len(packet)
        if end > OUTBOX_BYTES:
            return False
        _COUNT.pack_into(self._memory, start - _COUNT.size, len(packet))
        self._memory[start:end] = packet
        self._used = end - _HEAD.size
        # Last, so that a process killed before this leaves whole packets only.
        _COUNT.pack_into(self._memory, _USED_PLACE, self._used)
        self.count += 1
        return True

    def batch(self) -> bytes:
        """Return what is to be sent."""
        return self._memory[: _HEAD.size + self._used]

    def clear(self) -> None:
        """Forget what was sent."""
        self._used = 0
        self.count = 0
        self._number += 1
        # In this order: an old batch is never seen under a new number.
        _COUNT.pack_into(self._memory, _USED_PLACE, 0)
        _COUNT.pack_into(self._memory, _NUMBER_PLACE, self._number & 0xFFFFFFFF)

    def close(self) -> None:
        """Release the memory."""
        self._memory.close()
        os.close(self.descriptor)


def split(batch: bytes) -> tuple[int, list[bytes]]:
    """Take a batch apart: its number, and its packets. Raises struct.error when it is cut."""
    _, number, used = _HEAD.unpack_from(batch)
    packets = []
    start = _HEAD.size
    while start < _HEAD.size + used:
        (size,) = _COUNT.unpack_from(batch, start)
        start += _COUNT.size
        packets.append(batch[start : start + size])
        start += size
    return number, packets


def read_outbox(descriptor: int) -> bytes:
    """Read the batch that a process left behind in the memory of `descriptor`."""
    return os.pread(descriptor, OUTBOX_BYTES, 0)
