"""AUTOSAR end-to-end protection of single frames, Profiles 2 and 5: a CRC and a counter in the first bytes of a frame.

Profile 2, two bytes. Byte 0 is the CRC-8 (polynomial 0x2F, initial and final XOR 0xFF) over bytes 1… and one byte of
the message's data id list, picked by the counter. The low nibble of byte 1 is the counter 0…15.

Profile 5, four bytes. Bytes 0 and 1 are the CRC-16 (polynomial 0x1021, initial 0xFFFF, no final XOR; little-endian)
over bytes 2… and the data id, low byte first. Byte 2 is the counter 0…255.

The rest of the header, the high nibble of byte 1 and byte 3, is the sender's status. The CRC covers it.
Source: AUTOSAR FO PRS E2E Protocol, specifications of E2E Profile 2 and Profile 5.
"""

from binascii import crc_hqx
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Final

_POLYNOMIAL_8 = 0x2F
_COUNTER_MASK_2 = 0x0F
_COUNTER_MASK_5 = 0xFF


def _crc8_table() -> bytes:
    table = bytearray(256)
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = ((crc << 1) ^ _POLYNOMIAL_8) & 0xFF if crc & 0x80 else (crc << 1) & 0xFF
        table[byte] = crc
    return bytes(table)


_TABLE_8 = _crc8_table()


def crc8(data: bytes | bytearray, data_id: int) -> int:
    """Return the Profile 2 CRC of a frame whose bytes 1… are `data[1:]`; `data_id`: the one of its counter."""
    table = _TABLE_8
    crc = 0xFF
    for byte in data[1:]:
        crc = table[crc ^ byte]
    return table[crc ^ data_id] ^ 0xFF


def crc16(data: bytes | bytearray, data_id: bytes) -> int:
    """Return the Profile 5 CRC of a frame whose bytes 2… are `data[2:]`; `data_id`: two bytes, the low one first."""
    return crc_hqx(data_id, crc_hqx(data[2:], 0xFFFF))


def sign_profile_2(frame: bytearray, counter: int, data_ids: bytes) -> None:
    """Write Profile 2's counter 0…15 into a frame, and the CRC that goes with it; the sender's status stays."""
    frame[1] = (frame[1] & 0xF0) | counter
    frame[0] = crc8(frame, data_ids[counter])


def sign_profile_5(frame: bytearray, counter: int, data_id: bytes) -> None:
    """Write Profile 5's counter 0…255 into a frame, and the CRC that goes with it; the sender's status stays."""
    frame[2] = counter
    frame[:2] = crc16(frame, data_id).to_bytes(2, "little")


class Protection(Enum):
    """How a message's frames are protected; the values are those of the DBC attribute `E2EProfile`.

    `PROFILES` has the layout, sender and receiver of each.
    """

    NONE = ""
    PROFILE_2 = "P02"
    PROFILE_5 = "P05"


_LAST_VALID = 1  # OK_SOME_LOST: a plain number, since looking it up costs more than the comparison


class E2eStatus(IntEnum):
    """Result of the check of one message in one cycle. The numbers are logged."""

    OK = 0  # also the first frame of all: it sets the sequence
    OK_SOME_LOST = 1  # the counter jumped, within the tolerance
    REPEATED = 2  # the counter stands still; left when it moves
    WRONG_SEQUENCE = 3  # the counter jumped too far; left through SYNC from this frame on
    WRONG_CRC = 4  # CRC or length; left with the next right frame
    NO_NEW_DATA = 5  # no frame in this cycle; left with the next frame
    SYNC = 6  # in sequence, but too soon after a silence or a wrong sequence; left after a few frames in sequence

    @property
    def is_valid(self) -> bool:
        """Whether the frame's values may be used."""
        return self <= _LAST_VALID


@dataclass(frozen=True)
class Tolerance:
    """Losses that a receiver tolerates. The names in brackets are the standard's."""

    max_delta: int
    """Largest step of the counter that counts as loss; a larger one is a wrong sequence. Profile 2
    (MaxDeltaCounterInit): plus one, and plus one for each cycle since the last frame in sequence. Profile 5
    (MaxDeltaCounter): as it stands."""
    max_missing: int
    """Most cycles in a row without a new frame; after more, the sequence counts as lost [MaxNoNewOrRepeatedData]."""
    sync_frames: int
    """Frames in sequence after the frame that shows a lost sequence, before values are used again [SyncCounterInit]."""


# A run ends when a value is older than `bus.max_age_cycles`, 3 unless set otherwise. So a frame after 3 lost ones must
# be usable at once, and after a single wrong sequence the third frame. Four missing cycles let Profile 2 take steps up
# to 7, less than half the counter's circle: none of the last 8 frames is taken for a new one. One frame of SYNC is the
# least that confirms a new sequence before it is used: a stray old frame has no successor.
# Profile 5's step is the equivalent of four missing cycles.
PROFILE_2_TOLERANCE = Tolerance(max_delta=2, max_missing=4, sync_frames=1)
PROFILE_5_TOLERANCE = Tolerance(max_delta=5, max_missing=4, sync_frames=1)


class E2eSender:
    """Leaves the frames of one message unchanged; the sender of a profile adds counter and CRC."""

    def protect(self, frame: bytearray) -> bytes:
        """Return `frame` as bytes; with a profile, fill in its counter and CRC. The sender's status stays."""
        return bytes(frame)


class Profile2Sender(E2eSender):
    """Adds counter and CRC of Profile 2 to the frames of one message."""

    def __init__(self, data_ids: bytes) -> None:
        """`data_ids`: 16 bytes, one for each counter."""
        self._data_ids = data_ids
        self._counter = 0

    def protect(self, frame: bytearray) -> bytes:
        """Fill in the header of `frame` (bytes 0 and low nibble of 1) and return it as bytes."""
        counter = self._counter
        self._counter = (counter + 1) & _COUNTER_MASK_2
        sign_profile_2(frame, counter, self._data_ids)
        return bytes(frame)


class Profile5Sender(E2eSender):
    """Adds counter and CRC of Profile 5 to the frames of one message."""

    def __init__(self, data_id: bytes) -> None:
        """`data_id`: two bytes, the low one first."""
        self._data_id = data_id
        self._counter = 0

    def protect(self, frame: bytearray) -> bytes:
        """Fill in the header of `frame` (bytes 0 to 2) and return it as bytes."""
        counter = self._counter
        self._counter = (counter + 1) & _COUNTER_MASK_5
        sign_profile_5(frame, counter, self._data_id)
        return bytes(frame)


class E2eReceiver:
    """Accepts the frames of one message unchecked, and counts them; the receiver of a profile checks them."""

    def __init__(self) -> None:
        self.counts = [0] * len(E2eStatus)
        """Number of frames by status, in NO_NEW_DATA of cycles without a frame; the index is the status."""
        self.status = E2eStatus.NO_NEW_DATA
        """Status of the last frame."""

    @property
    def counter_range(self) -> int:
        """Number of values of the counter; 0 without counter."""
        return 0

    def check(self, frame: bytes) -> E2eStatus:
        """Check one frame and return its status; use its values only if the status is valid."""
        status = self.status = self._judge(frame)
        self.counts[status] += 1
        return status

    def step_of(self, frame: bytes) -> int | None:  # noqa: ARG002
        """Return the step of a frame's counter from the last one's, unchecked.

        None before the first frame, for a frame of another length, and without a counter.
        """
        return None

    def is_signed(self, frame: bytes) -> bool:  # noqa: ARG002
        """Return whether length and CRC of a frame are right; doesn't count it."""
        return True

    def miss(self) -> E2eStatus:
        """Count a cycle without a frame and return NO_NEW_DATA; the status of the last frame stays."""
        self._note_silence()
        self.counts[E2eStatus.NO_NEW_DATA] += 1
        return E2eStatus.NO_NEW_DATA

    def tally(self) -> list[tuple[E2eStatus, int]]:
        """Return the number of frames by status, in NO_NEW_DATA of cycles without a frame."""
        return list(zip(E2eStatus, self.counts, strict=True))

    def restart_sequence(self) -> None:
        """Forget the sequence: the next frame with a right CRC starts a new one. The counts stay."""

    def _judge(self, frame: bytes) -> E2eStatus:  # noqa: ARG002
        return E2eStatus.OK

    def _note_silence(self) -> None:
        pass


class _SequenceReceiver(E2eReceiver):
    """Common part of both profiles' receivers: sequence, silence, SYNC."""

    def __init__(self, length: int, tolerance: Tolerance) -> None:
        super().__init__()
        self._length = length
        self._tolerance = tolerance
        self.restart_sequence()

    def restart_sequence(self) -> None:
        """Forget the sequence: the next frame with a right CRC starts a new one. The counts stay."""
        self._last: int | None = None
        self._missing = 0
        self._to_sync = 0

    def _note_silence(self) -> None:
        self._missing += 1

    def _begin(self, counter: int) -> E2eStatus:
        """Accept the first frame, the standard's INITIAL. Its values are used; silence before it is ignored."""
        self._last = counter
        self._missing = 0
        return E2eStatus.OK

    def _lose_sequence(self) -> E2eStatus:
        self._missing = 0
        self._to_sync = self._tolerance.sync_frames
        return E2eStatus.WRONG_SEQUENCE

    def _accept(self, delta: int) -> E2eStatus:
        """Return the status of a frame in sequence: OK, OK_SOME_LOST, or SYNC after a silence or a wrong sequence."""
        missing, self._missing = self._missing, 0
        if missing > self._tolerance.max_missing:
            self._to_sync = self._tolerance.sync_frames
            return E2eStatus.SYNC
        if self._to_sync > 0:
            self._to_sync -= 1
            return E2eStatus.SYNC
        return E2eStatus.OK if delta == 1 else E2eStatus.OK_SOME_LOST


class Profile2Receiver(_SequenceReceiver):
    """Checks the frames of one message by Profile 2 (E2E_P02Check).

    As in the standard the tolerated step grows with each cycle without a usable frame, wrong CRCs included.
    """

    def __init__(self, data_ids: bytes, length: int, tolerance: Tolerance = PROFILE_2_TOLERANCE) -> None:
        """`data_ids`: 16 bytes, one for each counter; `length`: bytes of a frame, at least 2."""
        super().__init__(length, tolerance)
        self._data_ids = data_ids

    def restart_sequence(self) -> None:
        """Forget the sequence: the next frame with a right CRC starts a new one. The counts stay."""
        super().restart_sequence()
        self._max_delta = self._tolerance.max_delta

    @property
    def counter_range(self) -> int:
        """Number of values of the counter."""
        return _COUNTER_MASK_2 + 1

    def step_of(self, frame: bytes) -> int | None:
        """Return the step of a frame's counter from the last one's, unchecked; None as in the base class."""
        if self._last is None or len(frame) != self._length:
            return None
        return (frame[1] - self._last) & _COUNTER_MASK_2

    def is_signed(self, frame: bytes) -> bool:
        """Return whether length and CRC of a frame are right; doesn't count it."""
        return len(frame) == self._length and frame[0] == crc8(frame, self._data_ids[frame[1] & _COUNTER_MASK_2])

    def _note_silence(self) -> None:
        self._max_delta += 1
        self._missing += 1

    def _judge(self, frame: bytes) -> E2eStatus:
        self._max_delta += 1
        if not self.is_signed(frame):
            return E2eStatus.WRONG_CRC
        counter = frame[1] & _COUNTER_MASK_2
        if self._last is None:
            self._max_delta = self._tolerance.max_delta
            return self._begin(counter)
        delta = (counter - self._last) & _COUNTER_MASK_2
        if delta == 0:
            self._missing += 1
            return E2eStatus.REPEATED
        is_in_sequence = delta <= self._max_delta
        if is_in_sequence or self._tolerance.sync_frames:  # without SYNC only a wider tolerance recovers
            self._last = counter
            self._max_delta = self._tolerance.max_delta
        return self._accept(delta) if is_in_sequence else self._lose_sequence()


class Profile5Receiver(_SequenceReceiver):
    """Checks the frames of one message by Profile 5 (E2E_P05Check).

    The standard's check has no SYNC: it leaves that to a state machine above it. Here Profile 2's SYNC is used, so that
    both profiles treat a silence alike.
    """

    def __init__(self, data_id: bytes, length: int, tolerance: Tolerance = PROFILE_5_TOLERANCE) -> None:
        """`data_id`: two bytes, the low one first; `length`: bytes of a frame, at least 4."""
        super().__init__(length, tolerance)
        self._data_id = data_id

    @property
    def counter_range(self) -> int:
        """Number of values of the counter."""
        return _COUNTER_MASK_5 + 1

    def step_of(self, frame: bytes) -> int | None:
        """Return the step of a frame's counter from the last one's, unchecked; None as in the base class."""
        if self._last is None or len(frame) != self._length:
            return None
        return (frame[2] - self._last) & _COUNTER_MASK_5

    def is_signed(self, frame: bytes) -> bool:
        """Return whether length and CRC of a frame are right; doesn't count it."""
        return len(frame) == self._length and frame[0] | frame[1] << 8 == crc16(frame, self._data_id)

    def _judge(self, frame: bytes) -> E2eStatus:
        if not self.is_signed(frame):
            return E2eStatus.WRONG_CRC
        last, self._last = self._last, frame[2]
        if last is None:
            return self._begin(frame[2])
        delta = (frame[2] - last) & _COUNTER_MASK_5
        if delta == 0:
            self._missing += 1
            return E2eStatus.REPEATED
        return self._accept(delta) if delta <= self._tolerance.max_delta else self._lose_sequence()


@dataclass(frozen=True)
class E2eProfile:
    """A profile: everything that its frames, devices and contracts need to know; a new one is a row of `PROFILES`.

    crc_bits, counter_bits, status_bits: the header's signals in this order, from bit 0 on. objects: of a device's
    dictionary that carry the header. data_id_bytes: of one message; is_id_list: a list by counter, in the DBC attribute
    `E2EDataIdList`, else a number, in `E2EDataId`. sender, receiver: made of the data ids, and the frame's length.
    sign: writes a counter and its CRC into a frame.
    """

    crc_bits: int
    counter_bits: int
    status_bits: int
    objects: int
    data_id_bytes: int
    is_id_list: bool
    sender: Callable[[bytes], E2eSender]
    receiver: Callable[[bytes, int], E2eReceiver]
    sign: Callable[[bytearray, int, bytes], None]

    @property
    def header_bytes(self) -> int:
        """Length of the header in bytes."""
        return (self.crc_bits + self.counter_bits + self.status_bits) // 8

    @property
    def signals(self) -> tuple[tuple[str, int], ...]:
        """Names of the header's signals with their numbers of bits, in order."""
        return ("e2e_crc", self.crc_bits), ("e2e_counter", self.counter_bits), ("e2e_status", self.status_bits)

    @property
    def status_place(self) -> tuple[int, int]:
        """Byte and shift of the sender's status."""
        return divmod(self.crc_bits + self.counter_bits, 8)

    def counter_of(self, frame: bytes) -> int:
        """Return the counter of a frame."""
        byte, shift = divmod(self.crc_bits, 8)
        return frame[byte] >> shift & (1 << self.counter_bits) - 1


PROFILES: Final = {
    Protection.PROFILE_2: E2eProfile(
        crc_bits=8,
        counter_bits=4,
        status_bits=4,
        objects=2,  # counter and status share one
        data_id_bytes=16,
        is_id_list=True,
        sender=Profile2Sender,
        receiver=Profile2Receiver,
        sign=sign_profile_2,
    ),
    Protection.PROFILE_5: E2eProfile(
        crc_bits=16,
        counter_bits=8,
        status_bits=8,
        objects=3,
        data_id_bytes=2,
        is_id_list=False,
        sender=Profile5Sender,
        receiver=Profile5Receiver,
        sign=sign_profile_5,
    ),
}
PROFILES_BY_CODE: Final = {protection.value: profile for protection, profile in PROFILES.items()}
"""By the values of the DBC attribute `E2EProfile`."""
