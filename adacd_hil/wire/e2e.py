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
from functools import cached_property
from typing import Final

_POLYNOMIAL_8 = 0x2F


def _crc8_table() -> bytes:
    table = bytearray(range(256))
    for _ in range(8):
        for byte, crc in enumerate(table):
            table[byte] = (crc << 1 ^ _POLYNOMIAL_8) & 0xFF if crc & 0x80 else crc << 1
    return bytes(table)


_TABLE_8 = _crc8_table()


def crc8(frame: bytes | bytearray, counter: int, data_ids: bytes) -> int:
    """Return the Profile 2 CRC of a frame over its bytes 1… and the data id of its counter, one of 16 in `data_ids`."""
    table = _TABLE_8
    crc = 0xFF
    for byte in frame[1:]:
        crc = table[crc ^ byte]
    return table[crc ^ data_ids[counter]] ^ 0xFF


def crc16(frame: bytes | bytearray, counter: int, data_id: bytes) -> int:  # noqa: ARG001 (as of all profiles)
    """Return the Profile 5 CRC of a frame over its bytes 2… and `data_id`, two bytes, the low one first."""
    return crc_hqx(data_id, crc_hqx(frame[2:], 0xFFFF))


class Protection(Enum):
    """How a message's frames are protected; the values are those of the DBC attribute `E2EProfile`.

    `PROFILES` has the layout, CRC and tolerance of each.
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
        """Whether the frame's values may be used: OK or OK_SOME_LOST."""
        return self <= _LAST_VALID


@dataclass(frozen=True)
class Tolerance:
    """Losses that a receiver tolerates. The names in brackets are the standard's."""

    max_delta: int
    """Largest step of the counter that counts as loss; a larger one is a wrong sequence [MaxDeltaCounter, of Profile 2
    MaxDeltaCounterInit]."""
    max_missing: int
    """Most cycles in a row without a frame or with a repeated one; after more, the sequence counts as lost
    [MaxNoNewOrRepeatedData]. A cycle with a wrong CRC neither counts nor ends the row."""
    sync_frames: int
    """Frames in sequence after the frame that shows a lost sequence, before values are used again [SyncCounterInit]."""


# A run ends when a value is older than `bus.max_age_cycles`, 3 unless set otherwise. So a frame after 3 lost ones must
# be usable at once, and after a single wrong sequence the third frame. Four missing cycles let Profile 2 take steps up
# to 7, less than half the counter's circle: none of the last 8 frames is taken for a new one. One frame of SYNC is the
# least that confirms a new sequence before it is used: a stray old frame has no successor.
# Profile 5's step is the equivalent of four missing cycles.
PROFILE_2_TOLERANCE = Tolerance(max_delta=2, max_missing=4, sync_frames=1)
PROFILE_5_TOLERANCE = Tolerance(max_delta=5, max_missing=4, sync_frames=1)


@dataclass(frozen=True)
class E2eProfile:
    """A profile: everything that its frames, devices and contracts need to know; a new one is a row of `PROFILES`.

    crc_bits, counter_bits, status_bits: the header's signals in this order, from bit 0 on. The CRC has whole bytes, the
    counter the low bits of the next byte, 8 at most. objects: number of a device's objects that carry the header.
    data_id_bytes: of one message; is_id_list: a list by counter, in the DBC attribute `E2EDataIdList`, else a number,
    in `E2EDataId`. crc: returns the CRC of a frame, its counter, and the data ids. is_growing: the largest tolerated
    step is max_delta, and one more for each cycle since the frame that the step is counted from, the present cycle
    included.
    """

    crc_bits: int
    counter_bits: int
    status_bits: int
    objects: int
    data_id_bytes: int
    is_id_list: bool
    crc: Callable[[bytes | bytearray, int, bytes], int]
    tolerance: Tolerance
    is_growing: bool

    @property
    def header_bytes(self) -> int:
        """Length of the header in bytes."""
        return (self.crc_bits + self.counter_bits + self.status_bits) // 8

    @property
    def signals(self) -> tuple[tuple[str, int], ...]:
        """Names of the header's signals with their numbers of bits, from the frame's bit 0 on."""
        return ("e2e_crc", self.crc_bits), ("e2e_counter", self.counter_bits), ("e2e_status", self.status_bits)

    @property
    def status_place(self) -> tuple[int, int]:
        """Byte and shift of the sender's status."""
        return divmod(self.crc_bits + self.counter_bits, 8)

    @cached_property
    def counter_place(self) -> tuple[int, int]:
        """Byte of the counter, and its mask there."""
        return self.crc_bits // 8, (1 << self.counter_bits) - 1

    def counter_of(self, frame: bytes | bytearray) -> int:
        """Return the counter of a frame."""
        place, mask = self.counter_place
        return frame[place] & mask

    def sign(self, frame: bytearray, counter: int, data_ids: bytes) -> None:
        """Write a counter into a frame, and the CRC that goes with it; the sender's status stays."""
        place, mask = self.counter_place
        frame[place] = frame[place] & ~mask | counter
        frame[:place] = self.crc(frame, counter, data_ids).to_bytes(place, "little")


class E2eSender:
    """Adds counter and CRC to the frames of one message; without a profile it leaves them unchanged."""

    def __init__(self, profile: E2eProfile | None = None, data_ids: bytes = b"") -> None:
        """Begin with counter 0. `data_ids`: of the message, as the profile's CRC takes them."""
        self._profile, self._data_ids = profile, data_ids
        self._counter = 0

    def protect(self, frame: bytearray) -> bytes:
        """Return `frame` as bytes; with a profile, first write counter and CRC into it, and advance the counter.

        The sender's status in the header stays.
        """
        profile = self._profile
        if profile is not None:
            profile.sign(frame, self._counter, self._data_ids)
            self._counter = self._counter + 1 & profile.counter_place[1]
        return bytes(frame)


class E2eReceiver:
    """Accepts the frames of one message unchecked, and counts them; with a profile, `ProtectedReceiver` checks them."""

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
        """Check one frame; return, store and count its status. Use its values only if the status is valid."""
        status = self.status = self._judge(frame)
        self.counts[status] += 1
        return status

    def step_of(self, frame: bytes) -> int | None:  # noqa: ARG002
        """Return the counter's step from the last frame; None here, as these frames have no counter."""
        return None

    def is_signed(self, frame: bytes) -> bool:  # noqa: ARG002
        """Return whether length and CRC of a frame are right, without counting it; True here, unchecked."""
        return True

    def miss(self) -> E2eStatus:
        """Count a cycle without a frame and return NO_NEW_DATA; `status`, that of the last frame, stays."""
        self._note_silence()
        self.counts[E2eStatus.NO_NEW_DATA] += 1
        return E2eStatus.NO_NEW_DATA

    def tally(self) -> list[tuple[E2eStatus, int]]:
        """Return (status, number of frames so far) of each status; of NO_NEW_DATA the cycles without a frame."""
        return list(zip(E2eStatus, self.counts, strict=True))

    def restart_sequence(self) -> None:
        """Do nothing: these frames have no counter; `ProtectedReceiver` forgets the sequence of its counter here."""

    def _judge(self, frame: bytes) -> E2eStatus:  # noqa: ARG002
        return E2eStatus.OK

    def _note_silence(self) -> None:
        pass


class ProtectedReceiver(E2eReceiver):
    """Checks the frames of one message by its profile: sequence, silence, SYNC (E2E_P02Check, E2E_P05Check).

    Profile 2: as in the standard the tolerated step grows with each cycle without a usable frame, wrong CRCs included.
    Profile 5: the standard's check has no SYNC, it leaves that to a state machine above it. Here Profile 2's SYNC is
    used, so that both profiles treat a silence alike.
    """

    def __init__(self, profile: E2eProfile, data_ids: bytes, length: int, tolerance: Tolerance | None = None) -> None:
        """`data_ids`: as the profile's CRC takes them; `length`: bytes of a frame; `tolerance`: None: the profile's."""
        super().__init__()
        self._profile, self._data_ids, self._length = profile, data_ids, length
        self._tolerance = tolerance or profile.tolerance
        self._place, self._mask = profile.counter_place
        self.restart_sequence()

    def restart_sequence(self) -> None:
        """Forget the sequence: the next frame with a right CRC starts a new one. The counts stay."""
        self._last: int | None = None
        self._missing = 0
        self._to_sync = 0
        self._max_delta = self._tolerance.max_delta

    @property
    def counter_range(self) -> int:
        """Number of values of the counter."""
        return self._mask + 1

    def step_of(self, frame: bytes) -> int | None:
        """Return the counter's step from the last frame that advanced the sequence, modulo its range; 0: no step.

        None before the first frame with a right CRC, also after `restart_sequence`, and for another length. This
        frame's CRC is not checked; nothing is stored.
        """
        if self._last is None or len(frame) != self._length:
            return None
        return frame[self._place] - self._last & self._mask

    def is_signed(self, frame: bytes) -> bool:
        """Return whether length and CRC of a frame are right; doesn't count it."""
        if len(frame) != self._length:
            return False
        crc = self._profile.crc(frame, frame[self._place] & self._mask, self._data_ids)
        return int.from_bytes(frame[: self._place], "little") == crc

    def _note_silence(self) -> None:
        """Count a cycle without a frame; in a profile with `is_growing`, tolerate a step of the counter larger by 1."""
        self._missing += 1
        self._max_delta += self._profile.is_growing

    def _judge(self, frame: bytes) -> E2eStatus:
        """Return the status of a frame by its length, CRC and counter, and advance the sequence.

        A wrong length is WRONG_CRC, too. A frame with a wrong CRC doesn't advance the sequence, nor does one beyond the
        tolerance if that grows (`is_growing`) and `sync_frames` is 0. A frame whose counter stands still is REPEATED,
        and counts as a cycle without a new frame. The first right frame begins the sequence.
        """
        is_growing = self._profile.is_growing
        self._max_delta += is_growing
        if not self.is_signed(frame):
            return E2eStatus.WRONG_CRC
        counter, last = frame[self._place] & self._mask, self._last
        if last is None:
            return self._begin(counter)
        delta = counter - last & self._mask
        if delta == 0:
            self._missing += 1
            return E2eStatus.REPEATED
        is_in_sequence = delta <= self._max_delta
        if is_in_sequence or self._tolerance.sync_frames or not is_growing:  # else only a wider tolerance recovers
            self._last, self._max_delta = counter, self._tolerance.max_delta
        return self._accept(delta) if is_in_sequence else self._lose_sequence()

    def _begin(self, counter: int) -> E2eStatus:
        """Begin the sequence with the counter of the first right frame, and return OK; the standard returns INITIAL.

        Cycles without a frame before it don't count as missing.
        """
        self._last, self._max_delta = counter, self._tolerance.max_delta
        self._missing = 0
        return E2eStatus.OK

    def _lose_sequence(self) -> E2eStatus:
        """Begin SYNC behind a counter that jumped too far; return WRONG_SEQUENCE."""
        self._missing = 0
        self._to_sync = self._tolerance.sync_frames
        return E2eStatus.WRONG_SEQUENCE

    def _accept(self, delta: int) -> E2eStatus:
        """Return the status of a frame whose counter advanced by `delta`, a tolerated step, and update the sequence.

        SYNC for the first frame after more than `max_missing` cycles without a frame or with a repeated one, and for
        the `sync_frames` frames after that frame or after a wrong sequence. Other frames: OK for a step of 1,
        OK_SOME_LOST for a larger one.
        """
        missing, self._missing = self._missing, 0
        if missing > self._tolerance.max_missing:
            self._to_sync = self._tolerance.sync_frames
            return E2eStatus.SYNC
        if self._to_sync > 0:
            self._to_sync -= 1
            return E2eStatus.SYNC
        return E2eStatus.OK if delta == 1 else E2eStatus.OK_SOME_LOST


PROFILES: Final = {
    Protection.PROFILE_2: E2eProfile(
        crc_bits=8,
        counter_bits=4,
        status_bits=4,
        objects=2,  # counter and status share one
        data_id_bytes=16,
        is_id_list=True,
        crc=crc8,
        tolerance=PROFILE_2_TOLERANCE,
        is_growing=True,
    ),
    Protection.PROFILE_5: E2eProfile(
        crc_bits=16,
        counter_bits=8,
        status_bits=8,
        objects=3,
        data_id_bytes=2,
        is_id_list=False,
        crc=crc16,
        tolerance=PROFILE_5_TOLERANCE,
        is_growing=False,
    ),
}
PROFILES_BY_CODE: Final = {protection.value: profile for protection, profile in PROFILES.items()}
"""By the values of the DBC attribute `E2EProfile`."""
