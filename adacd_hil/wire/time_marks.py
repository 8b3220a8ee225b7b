"""The frames by which a host in lockstep and the emulated devices keep one time.

A bus without time of its own, such as vcan, carries them like any other frame, so their order shows which frames belong
together. Both have 29-bit identifiers that no CANopen service has; on an arm they never appear. Data: 1 byte kind,
7 bytes time in ns, little-endian.

| kind | from | means |
|---|---|---|
| ADVANCE | host | "I won't send before this time": let time pass until then, or until you have sent a frame |
| GRANT | devices | "it is this time": the answer to ADVANCE, after the frames sent on the way |
| RELEASE | devices | the frames after this are handed to the bus so long after SYNC; wait for END |
| END | devices | all frames that belong to this SYNC have been sent |
| DARK | devices | no device is powered, so frames are not acknowledged; time: 0 |
| LIT | devices | a device is powered |

Every SYNC lets one period pass. RELEASE and END are sent only when not all cyclic frames follow a SYNC at once, or when
other frames follow it too; an undisturbed arm doesn't send them. The first ADVANCE of a host has its clock's time and
lets no time pass.
"""

import struct
from enum import IntEnum
from typing import Final

from adacd_hil.wire.codec import Codec

HOST_MARK: Final = 0x1ADACD00
DEVICE_MARK: Final = 0x1ADACD01
ANSWERS: Final = ("Drive1Feedback", "Drive2Feedback", "Sensor1Torque", "Sensor2Torque")
"""The messages that the devices send on every SYNC."""
NEVER_NS: Final = 1 << 62
"""A time after all others: no frame is due."""
_PACKING: Final = struct.Struct("<Q")


class MarkKind(IntEnum):
    """Meaning of a mark; see the module's table."""

    ADVANCE = 1
    GRANT = 2
    RELEASE = 3
    END = 4
    DARK = 5
    LIT = 6


def pack_mark(kind: MarkKind, t_ns: int = 0) -> bytes:
    """Return the data of a mark's frame: its kind, and a time in ns, which wraps at 2.3 years."""
    return _PACKING.pack((t_ns << 8 | kind) & 0xFFFFFFFFFFFFFFFF)


def unpack_mark(data: bytes) -> tuple[MarkKind, int] | None:
    """Return the kind of a mark and its time in ns, from its frame's data; None for another length or kind."""
    if len(data) != _PACKING.size:
        return None
    (packed,) = _PACKING.unpack(data)
    try:
        return MarkKind(packed & 0xFF), packed >> 8
    except ValueError:
        return None


def answers_to_sync(codec: Codec) -> frozenset[int]:
    """Return the identifiers of ANSWERS, the frames sent on every SYNC. Raises CodecError if the DBC lacks one."""
    return frozenset(codec.message(name).can_id for name in ANSWERS)
