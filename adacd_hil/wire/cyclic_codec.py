"""The cyclic codec in compiled code: whether a frame is the one that is expected next, and its values.

A frame is right when its length is, and then, where it carries an end-to-end header, its counter is the next one and
its CRC fits; where it carries none, its value is plausible: no further from the last than motion or the device's rate
can bring it. Everything else, a lost frame included, is left to the state machines of `adacd_hil.wire.e2e` and of the
devices. Values are those of `MessageCodec.decode_values`, bit for bit: both are made from the same table.
"""

from binascii import crc_hqx
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import Structured, compiled, released
from adacd_hil.wire.e2e import TABLE_8, Protection

MOST_DATA_IDS = 16
PROFILE_NUMBERS = {Protection.NONE: 0, Protection.PROFILE_2: 2, Protection.PROFILE_5: 5}
_PROFILE_2 = PROFILE_NUMBERS[Protection.PROFILE_2]
_CRC_8: NDArray[np.int64] = np.array(list(TABLE_8))
_CRC_16: NDArray[np.int64] = np.array([crc_hqx(bytes((byte,)), 0) for byte in range(256)])

NO_SPEED = -1
CYCLIC_MESSAGE = np.dtype(
    [
        ("length", np.int64),
        ("profile", np.int64),  # of the end-to-end header, 0 without
        ("data_ids", np.uint8, (MOST_DATA_IDS,)),
        ("first", np.int64),  # of its rows among those of all messages
        ("count", np.int64),
        # Without header: |value[main] - last - value[speed] * elapsed| <= jump + rate * elapsed
        ("main", np.int64),
        ("speed", np.int64),  # or NO_SPEED
        ("jump", np.float64),
        ("rate", np.float64),
    ]
)


@compiled
def read_frame(
    data: NDArray[np.uint8],
    row: int,
    length: int,
    message: Any,
    rows: Structured,
    counter: int,
    last: float,
    elapsed_s: float,
    values: NDArray[np.float64],
) -> bool:
    """Decode a frame of `length` bytes in a row of `data` into `values`; False unless it is the next right one.

    counter, last: of the frame before, and its main value.
    """
    if length != message["length"]:
        return False
    profile = message["profile"]
    if profile > 0 and not is_next(data, row, length, profile, message["data_ids"], counter):
        return False
    for place in range(message["count"]):
        values[place] = decode_signal(data, row, rows[message["first"] + place])
    if profile > 0:
        return True
    step = values[message["main"]] - last
    if message["speed"] >= 0:
        step -= values[message["speed"]] * elapsed_s
    return bool(abs(step) <= message["jump"] + message["rate"] * elapsed_s)


@compiled
def read_cycle(
    data: NDArray[np.uint8],
    messages: Structured,
    rows: Structured,
    counters: NDArray[np.int64],
    last: NDArray[np.float64],
    elapsed_s: float,
    values: NDArray[np.float64],
) -> bool:
    """Decode the frames of a cycle, one of each message in its row; False unless all are the next right ones.

    The frames have their messages' lengths. counters, last: of the cycle before; of this one when it is true.
    """
    for row in range(len(messages)):
        message = messages[row]
        if not read_frame(
            data, row, message["length"], message, rows, counters[row], last[row], elapsed_s, values[row]
        ):
            return False
    for row in range(len(messages)):
        if messages[row]["profile"] > 0:
            counters[row] = counter_of(data, row, messages[row]["profile"])
        last[row] = values[row, messages[row]["main"]]
    return True


@released
def read_frames(
    data: NDArray[np.uint8],
    lengths: NDArray[np.uint8],
    places: NDArray[np.int64],
    chosen: tuple[Structured, Structured, int],
    before: tuple[int, float],
    elapsed_s: float,
    values: NDArray[np.float64],
) -> int:
    """Decode a message's frames of one cycle after the other into `values`; return how many are right in a row.

    places: of the frames in `data`. chosen: messages, their rows, and which message. before: counter and main value of
    the frame before the first.
    """
    messages, rows, number = chosen
    counter, last = before
    message = messages[number]
    for n in range(len(places)):
        row = places[n]
        length = int(lengths[row])
        if not read_frame(data, row, length, message, rows, counter, last, elapsed_s, values[n]):
            return n
        if message["profile"] > 0:
            counter = counter_of(data, row, message["profile"])
        last = values[n, message["main"]]
    return len(places)


@compiled
def decode_signal(data: NDArray[np.uint8], row: int, signal: Any) -> float:
    """Decode one signal of a frame."""
    raw = np.uint64(0)
    for byte in range(signal["size"]):
        raw |= np.uint64(data[row, signal["byte"] + byte]) << np.uint64(8 * byte)
    mask = signal["mask"]
    if mask > 0:
        raw = (raw >> np.uint64(signal["shift"])) & np.uint64(mask)
        number = np.int64(raw)
        if signal["is_signed"] > 0 and number > mask >> 1:
            number -= mask + 1
        return float(number * signal["scale"] + signal["offset"])
    if signal["is_signed"] > 0:
        unused = np.uint64(64 - 8 * signal["size"])
        number = np.int64(raw << unused) >> np.int64(unused)
        return float(number * signal["scale"] + signal["offset"])
    return float(raw * signal["scale"] + signal["offset"])


@compiled
def is_next(data: NDArray[np.uint8], row: int, length: int, profile: int, data_ids: Any, last: int) -> bool:
    """Say whether the frame of `length` bytes in a row of `data` has a right CRC and the counter that follows `last`.

    profile: 2 or 5; data_ids: 16 bytes for Profile 2, for Profile 5 two, the low one first.
    """
    counter = counter_of(data, row, profile)
    if profile == _PROFILE_2:
        if counter != (last + 1) & 0x0F:
            return False
        crc = 0xFF
        for place in range(1, length):
            crc = _CRC_8[crc ^ int(data[row, place])]
        return bool(_CRC_8[crc ^ int(data_ids[counter])] ^ 0xFF == int(data[row, 0]))
    if counter != (last + 1) & 0xFF:
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
