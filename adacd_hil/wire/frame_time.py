"""How long a frame takes on the bus, exactly, at the pace of an emulated one.

The same count as `adacd_hil.wire.traffic.exact_frame`, from start of frame to the end of the intermission, but
compiled, a byte at a time by table: a cycle has seven frames. Source: ISO 11898-1, frame formats and frame coding.
"""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import compiled
from adacd_hil.wire.bus import CLASSIC_BYTES, MAX_STANDARD_ID
from adacd_hil.wire.traffic import CRC15, FRAME_LENGTHS, TAIL_BITS, unstuffed_fd_bits, worst_case_frame

_HEAD_BITS: Final = 19  # start of frame, identifier, RTR, IDE, r0, DLC
_EXTENDED_HEAD_BITS: Final = 39  # and SRR, 18 bits more of the identifier, r1
_FD_HEAD_BITS: Final = 17  # start of frame, identifier, RRS, IDE, FDF, res, BRS
_FD_CONTROL_BITS: Final = 5  # ESI, DLC

FrameTime = Callable[[int, bytes], int]
"""Gives the time of a frame on the bus, ns, by identifier and data."""


_STUFF_RUN: Final = 5


def _stuffing(bits: int) -> NDArray[np.int64]:
    """Tabulate for so many bits at once, by state and bits: stuff bits added << 3 | next state.

    State: (length of the run of equal bits - 1) << 1 | the last bit. A stuff bit begins a run.
    """
    table = np.zeros((2 * (_STUFF_RUN - 1), 1 << bits), np.int64)
    for start in range(len(table)):
        for value in range(1 << bits):
            run, last, added = (start >> 1) + 1, start & 1, 0
            for place in reversed(range(bits)):
                bit = value >> place & 1
                run, last = (run + 1 if bit == last else 1), bit
                if run == _STUFF_RUN:
                    run, last, added = 1, 1 - last, added + 1
            table[start, value] = added << 3 | (run - 1) << 1 | last
    return table


def _crc_15() -> NDArray[np.int64]:
    """Tabulate the CRC of a classic frame by byte."""
    table = np.arange(256, dtype=np.int64) << 7
    for _ in range(8):
        table = np.where(table & 0x4000, (table << 1) ^ CRC15, table << 1) & 0x7FFF
    return table


_STUFF_1: Final = _stuffing(1)
_STUFF_8: Final = _stuffing(8)
_CRC_15: Final = _crc_15()


@compiled
def _stuffed(head: int, head_bits: int, data: int, length: int) -> int:
    """Count the bits of a classic frame up to its CRC's end, stuff bits included. data: bytes as one integer."""
    crc = state = added = 0  # as start of frame, one dominant bit, leaves them
    left = head_bits - 1
    while left & 7:
        left -= 1
        bit = (head >> left) & 1
        crc = ((crc << 1) ^ CRC15) & 0x7FFF if ((crc >> 14) ^ bit) & 1 else (crc << 1) & 0x7FFF
        step = _STUFF_1[state, bit]
        state, added = step & 7, added + (step >> 3)
    for place in range(left // 8 + length):
        shift = left - 8 * (place + 1)
        byte = (head >> shift) & 0xFF if shift >= 0 else (data >> (shift + 8 * length)) & 0xFF
        crc = ((crc << 8) & 0x7FFF) ^ _CRC_15[(crc >> 7) ^ byte]
        step = _STUFF_8[state, byte]
        state, added = step & 7, added + (step >> 3)
    for place in range(14, 7, -1):
        step = _STUFF_1[state, (crc >> place) & 1]
        state, added = step & 7, added + (step >> 3)
    return int(head_bits + 8 * length + 15 + added + (_STUFF_8[state, crc & 0xFF] >> 3))


@compiled
def _classic_bits(can_id: int, data: int, length: int) -> int:
    """Count the bits of a classic frame. data: bytes as one integer."""
    if can_id <= MAX_STANDARD_ID:
        return _stuffed(can_id << 7 | length, _HEAD_BITS, data, length) + TAIL_BITS
    head = ((can_id >> 18) << 2 | 3) << 25 | (can_id & 0x3FFFF) << 7 | length
    return _stuffed(head, _EXTENDED_HEAD_BITS, data, length) + TAIL_BITS


@compiled
def _fd_stuff_bits(head: int, body: NDArray[np.uint8], code: int) -> tuple[int, int]:
    """Count the dynamic stuff bits of an FD frame: up to BRS, and from there to the end of the data."""
    run = 0
    last = -1
    before = 0
    after = 0
    total = _FD_HEAD_BITS + _FD_CONTROL_BITS + 8 * body.size
    for place in range(total):
        if place < _FD_HEAD_BITS:
            bit = (head >> (_FD_HEAD_BITS - 1 - place)) & 1
        elif place < _FD_HEAD_BITS + _FD_CONTROL_BITS:
            bit = (code >> (_FD_HEAD_BITS + _FD_CONTROL_BITS - 1 - place)) & 1
        else:
            index = place - _FD_HEAD_BITS - _FD_CONTROL_BITS
            bit = (body[index >> 3] >> (7 - (index & 7))) & 1
        if bit == last:
            run += 1
        else:
            run = 1
            last = bit
        # The fixed stuff bit that begins the CRC field stands for a dynamic one after the last bit of the data.
        if run == 5 and place < total - 1:
            if place < _FD_HEAD_BITS:
                before += 1
            else:
                after += 1
            last = 1 - last
            run = 1
    return before, after


def exact_time(bitrate: int, data_bitrate: int = 0) -> FrameTime:
    """Make the exact time of frames at rates in bit/s, in ns, rounded up per rate.

    The result raises ValueError for a length that no frame has. Frames of more than 8 bytes are CAN FD with rate
    switch and 11-bit identifier.
    """
    classic_bits = _classic_bits
    bits_to_ns = _round_up(bitrate)
    whole_ns = 1_000_000_000 // bitrate if 1_000_000_000 % bitrate == 0 else 0

    def fd(can_id: int, data: bytes) -> int:
        plain = unstuffed_fd_bits(len(data))
        body = np.frombuffer(data, dtype=np.uint8)
        before, after = _fd_stuff_bits(can_id << 5 | 0b00101, body, FRAME_LENGTHS.index(len(data)))
        return bits_to_ns(plain.nominal + before) - (-(plain.data + after) * 1_000_000_000 // data_bitrate)

    def exact(can_id: int, data: bytes, from_bytes: Callable[..., int] = int.from_bytes) -> int:
        length = len(data)
        if length > CLASSIC_BYTES:
            return fd(can_id, data)
        bits = classic_bits(can_id, from_bytes(data, "big", signed=True), length)
        return bits * whole_ns if whole_ns else bits_to_ns(bits)

    return exact


def _round_up(bitrate: int) -> Callable[[int], int]:
    return lambda bits: -(-bits * 1_000_000_000 // bitrate)


def worst_time(bitrate: int, data_bitrate: int = 0) -> FrameTime:
    """Make the longest time of frames of a length at rates in bit/s, whatever is in them, in ns."""
    by_length: dict[tuple[int, bool], int] = {}

    def time_ns(can_id: int, data: bytes) -> int:
        key = (len(data), can_id > MAX_STANDARD_ID)
        found = by_length.get(key)
        if found is None:
            found = by_length[key] = worst_case_frame(*key).duration_ns(bitrate, data_bitrate)
        return found

    return time_ns
