"""Durations of frames on the bus, exact and at worst.

Compiled: a cycle has seven frames. Source: ISO 11898-1, frame formats and frame coding; for the counted bits, and
CAN FD, see `adacd_hil.wire.frame_bits`.
"""

from collections.abc import Callable
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import compiled
from adacd_hil.wire.frame_bits import TAIL_BITS, FrameBits, fd_head_bits, unstuffed_fd_bits, worst_case_frame
from adacd_hil.wire.frame_lengths import CLASSIC_BYTES, FRAME_LENGTHS, MAX_STANDARD_ID

_CRC_POLYNOMIAL: Final = 0x4599
_HEAD_BITS: Final = 19  # start of frame, identifier, RTR, IDE, r0, DLC
_EXTENDED_HEAD_BITS: Final = 39  # and SRR, 18 bits more of the identifier, r1
_FD_CONTROL_BITS: Final = 5  # ESI, DLC

FrameTime = Callable[[int, bytes], int]
"""Returns the duration of a frame on the bus, ns, from identifier and data."""


_CRC_BITS: Final = 15
_STUFF_RUN: Final = 5


@compiled
def _stuffed(head: int, head_bits: int, data: int, length: int) -> int:
    """Return the number of bits of a classic frame to the end of its CRC, stuff bits included.

    head: its first `head_bits` bits, up to the data. data: its `length` bytes as one integer, the first one highest.
    """
    crc = run = added = 0
    last = -1
    plain = head_bits + 8 * length
    for place in range(plain + _CRC_BITS):
        if place < head_bits:
            bit = (head >> (head_bits - 1 - place)) & 1
        elif place < plain:
            bit = (data >> (plain - 1 - place)) & 1
        else:
            bit = (crc >> (plain + _CRC_BITS - 1 - place)) & 1
        if place < plain:
            crc = ((crc << 1) ^ (_CRC_POLYNOMIAL if ((crc >> 14) ^ bit) & 1 else 0)) & 0x7FFF
        run = run + 1 if bit == last else 1
        last = bit
        if run == _STUFF_RUN:  # a stuff bit begins a run
            run, last, added = 1, 1 - last, added + 1
    return plain + _CRC_BITS + added


@compiled
def _classic_bits(can_id: int, data: int, length: int) -> int:
    """Return the number of bits of a classic frame, stuff bits and intermission included.

    data: its `length` bytes as one integer, the first one highest.
    """
    if can_id <= MAX_STANDARD_ID:
        return _stuffed(can_id << 7 | length, _HEAD_BITS, data, length) + TAIL_BITS
    head = ((can_id >> 18) << 2 | 3) << 25 | (can_id & 0x3FFFF) << 7 | length
    return _stuffed(head, _EXTENDED_HEAD_BITS, data, length) + TAIL_BITS


@compiled
def _fd_stuff_bits(head: int, head_bits: int, body: NDArray[np.uint8], code: int) -> tuple[int, int]:
    """Return the numbers of dynamic stuff bits of an FD frame: up to BRS, and from there to the end of the data.

    head: its first `head_bits` bits, up to BRS. body: its data. code: data length code.
    """
    run = 0
    last = -1
    before = 0
    after = 0
    total = head_bits + _FD_CONTROL_BITS + 8 * body.size
    for place in range(total):
        if place < head_bits:
            bit = (head >> (head_bits - 1 - place)) & 1
        elif place < head_bits + _FD_CONTROL_BITS:
            bit = (code >> (head_bits + _FD_CONTROL_BITS - 1 - place)) & 1
        else:
            index = place - head_bits - _FD_CONTROL_BITS
            bit = (body[index >> 3] >> (7 - (index & 7))) & 1
        if bit == last:
            run += 1
        else:
            run = 1
            last = bit
        # The fixed stuff bit that begins the CRC field replaces a dynamic one after the last bit of the data.
        if run == _STUFF_RUN and place < total - 1:
            if place < head_bits:
                before += 1
            else:
                after += 1
            last = 1 - last
            run = 1
    return before, after


def exact_frame(can_id: int, data: bytes) -> FrameBits:
    """Return the exact number of bits of a frame by its content, classic up to 8 bytes; sent by an error active node.

    Identifiers beyond 0x7FF have 29 bits. If the data of CAN FD end with five equal bits, the fixed stuff bit that
    begins the CRC field replaces the dynamic one. Raises ValueError for a length that no frame has.
    """
    length, is_extended = len(data), can_id > MAX_STANDARD_ID
    if length <= CLASSIC_BYTES:
        return FrameBits(_classic_bits(can_id, int.from_bytes(data, "big", signed=True), length))
    plain = unstuffed_fd_bits(length, is_extended)
    # SOF, base, SRR, IDE, extension, RRS, FDF, res, BRS; or SOF, identifier, RRS, IDE, FDF, res, BRS
    extended = (((can_id >> 18) << 2 | 3) << 18 | can_id & 0x3FFFF) << 4 | 0b0101
    head = extended if is_extended else can_id << 5 | 0b00101
    body = np.frombuffer(data, np.uint8)
    before, after = _fd_stuff_bits(head, fd_head_bits(is_extended), body, FRAME_LENGTHS.index(length))
    return FrameBits(plain.nominal + before, plain.data + after)


def exact_time(bitrate: int, data_bitrate: int = 0) -> FrameTime:
    """Return a function for the exact duration of frames at rates in bit/s, in ns, rounded up per rate.

    That function raises ValueError for a length that no frame has. Frames of more than 8 bytes are CAN FD with rate
    switch, and need `data_bitrate`.
    """

    def time_ns(can_id: int, data: bytes) -> int:
        length = len(data)
        if length > CLASSIC_BYTES:
            return exact_frame(can_id, data).duration_ns(bitrate, data_bitrate)
        return -(-_classic_bits(can_id, int.from_bytes(data, "big", signed=True), length) * 1_000_000_000 // bitrate)

    return time_ns


def worst_time(bitrate: int, data_bitrate: int = 0) -> FrameTime:
    """Return a function for the longest duration of frames of a length, in ns, whatever their content; rates in bit/s.

    That function raises ValueError for a length that no frame has. Frames of more than 8 bytes need `data_bitrate`.
    """

    @cache
    def longest_ns(length: int, is_extended: bool) -> int:
        return worst_case_frame(length, is_extended).duration_ns(bitrate, data_bitrate)

    return lambda can_id, data: longest_ns(len(data), can_id > MAX_STANDARD_ID)
