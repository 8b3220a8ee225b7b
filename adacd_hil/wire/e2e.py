"""AUTOSAR end-to-end protection, Profile 2: a CRC and an alive counter in the first two bytes of a frame.

Byte 0 is the CRC-8 (polynomial 0x2F, initial and final XOR 0xFF) over bytes 1… and one byte of the message's data id
list, picked by the counter. The low nibble of byte 1 is the alive counter 0…15; the high nibble is the sender's.
Source: AUTOSAR FO PRS E2E Protocol, chapter 6.3 (Profile 2).
"""

from enum import IntEnum

POLYNOMIAL = 0x2F
HEADER_BYTES = 2
COUNTER_MODULUS = 16


def _crc_table() -> bytes:
    table = bytearray(256)
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = ((crc << 1) ^ POLYNOMIAL) & 0xFF if crc & 0x80 else (crc << 1) & 0xFF
        table[byte] = crc
    return bytes(table)


_TABLE = _crc_table()


def crc8(data: bytes | bytearray, data_id: int) -> int:
    """Compute the Profile 2 CRC of a frame whose bytes 1… are `data[1:]`."""
    table = _TABLE
    crc = 0xFF
    for byte in data[1:]:
        crc = table[crc ^ byte]
    return table[crc ^ data_id] ^ 0xFF


class E2eStatus(IntEnum):
    """What the receiver's check says of one frame."""

    OK = 0
    OK_SOME_LOST = 1  # the counter jumped, within the tolerance
    REPEATED = 2  # the counter stands still
    WRONG_SEQUENCE = 3  # the counter jumped too far; this frame becomes the new reference
    WRONG_CRC = 4
    NO_NEW_DATA = 5  # no frame in this cycle
    SYNC = 6  # good again, but not yet often enough after a long silence

    @property
    def is_valid(self) -> bool:
        """Whether the frame's values may be used."""
        return self <= E2eStatus.OK_SOME_LOST


class E2eSender:
    """Counts and signs the frames of one message."""

    def __init__(self, data_ids: bytes) -> None:
        self._data_ids = data_ids
        self._counter = COUNTER_MODULUS - 1

    def protect(self, frame: bytearray) -> bytes:
        """Fill in the header of `frame` (bytes 0 and low nibble of 1) and return it as bytes."""
        if not self._data_ids:
            return bytes(frame)
        counter = (self._counter + 1) % COUNTER_MODULUS
        self._counter = counter
        frame[1] = (frame[1] & 0xF0) | counter
        frame[0] = crc8(frame, self._data_ids[counter])
        return bytes(frame)


class E2eReceiver:
    """Checks the frames of one message and counts what it found."""

    def __init__(self, data_ids: bytes, max_delta: int = 3) -> None:
        """`max_delta` is the largest step of the counter that still counts as loss, not as a wrong sequence."""
        self._data_ids = data_ids
        self._max_delta = max_delta
        self._last: int | None = None
        self.counts = [0] * len(E2eStatus)

    def check(self, frame: bytes) -> E2eStatus:
        """Check one frame; the first one with a right CRC sets the sequence."""
        status = self._judge(frame)
        self.counts[status] += 1
        return status

    def miss(self) -> E2eStatus:
        """Note a cycle in which no frame came."""
        self.counts[E2eStatus.NO_NEW_DATA] += 1
        return E2eStatus.NO_NEW_DATA

    def tally(self) -> list[tuple[E2eStatus, int]]:
        """Return how often each status was found so far."""
        return list(zip(E2eStatus, self.counts, strict=True))

    def _judge(self, frame: bytes) -> E2eStatus:
        if not self._data_ids:
            return E2eStatus.OK
        counter = frame[1] & 0x0F
        if frame[0] != crc8(frame, self._data_ids[counter]):
            return E2eStatus.WRONG_CRC
        last, self._last = self._last, counter
        delta = 1 if last is None else (counter - last) % COUNTER_MODULUS
        if delta == 1:
            return E2eStatus.OK
        if delta == 0:
            return E2eStatus.REPEATED
        return E2eStatus.OK_SOME_LOST if delta <= self._max_delta else E2eStatus.WRONG_SEQUENCE

    def restart(self) -> None:
        """Forget the sequence; the counts stay."""
        self._last = None
