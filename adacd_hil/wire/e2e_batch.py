"""End-to-end checks of recorded frames in compiled code: whether the CRC is right, and which counter comes with it.

The CRCs of `adacd_hil.wire.e2e`, over rows of an array of data bytes.
"""

from binascii import crc_hqx
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import compiled
from adacd_hil.wire.e2e import TABLE_8, Protection

PROFILE_NUMBERS = {Protection.NONE: 0, Protection.PROFILE_2: 2, Protection.PROFILE_5: 5}
_PROFILE_2 = PROFILE_NUMBERS[Protection.PROFILE_2]
MOST_DATA_IDS = 16
_CRC_8: NDArray[np.int64] = np.array(list(TABLE_8))
_CRC_16: NDArray[np.int64] = np.array([crc_hqx(bytes((byte,)), 0) for byte in range(256)])


@compiled
def is_next(data: NDArray[np.uint8], row: int, length: int, profile: int, data_ids: Any, last: int) -> bool:
    """Say whether the frame of `length` bytes in a row of `data` has a right CRC and the counter that follows `last`.

    profile: 2 or 5; data_ids: 16 bytes for Profile 2, for Profile 5 two, the low one first.
    """
    if profile == _PROFILE_2:
        counter = int(data[row, 1]) & 0x0F
        if counter != (last + 1) & 0x0F:
            return False
        crc = 0xFF
        for place in range(1, length):
            crc = _CRC_8[crc ^ int(data[row, place])]
        return bool(_CRC_8[crc ^ int(data_ids[counter])] ^ 0xFF == int(data[row, 0]))
    if int(data[row, 2]) != (last + 1) & 0xFF:
        return False
    crc = 0xFFFF
    for place in range(2, length):
        crc = _add_16(crc, int(data[row, place]))
    crc = _add_16(_add_16(crc, int(data_ids[0])), int(data_ids[1]))
    return bool(crc == int(data[row, 0]) | int(data[row, 1]) << 8)


@compiled
def counter_of(data: NDArray[np.uint8], row: int, profile: int) -> int:
    """Return the counter of a frame."""
    return int(data[row, 1]) & 0x0F if profile == _PROFILE_2 else int(data[row, 2])


@compiled
def _add_16(crc: int, byte: int) -> int:
    """Take one byte into a CRC-16."""
    return int(((crc << 8) & 0xFFFF) ^ _CRC_16[(crc >> 8) ^ byte])
