"""Bits of CAN frames without stuffing, and at worst.

`adacd_hil.wire.frame_time` computes the exact length with the stuff bits of a frame's content.
All counts go from start of frame to the end of the intermission (3 bits), after which the next frame can begin, and
are those of data frames (no remote frames). Source: ISO 11898-1, frame formats and frame coding; the worst case of
classic frames: Davis, Burns, Bril, Lukkien, "Controller Area Network (CAN) schedulability analysis: refuted, revisited
and revised", Real-Time Systems 35 (2007), eq. (1) and (2).

A frame with more than 8 bytes is CAN FD (ISO, not the first Bosch format) with bit rate switch; all others are classic.
In CAN FD the bits from BRS to the CRC delimiter run at the data bit rate. Each of these two bits changes the rate at
its sample point; together they last as long as one bit of either rate, so BRS is counted as nominal and the CRC
delimiter as data. The CRC field of CAN FD has stuff bits at fixed places, so its length doesn't depend on its value.
"""

from typing import NamedTuple

from adacd_hil.wire.frame_lengths import CLASSIC_BYTES, FRAME_LENGTHS

TAIL_BITS = 3 + 7 + 3  # CRC delimiter, acknowledgement, its delimiter; end of frame; intermission
_FD_TAIL_BITS = 2 + 7 + 3  # the CRC delimiter is a data bit
_LONG_CRC_BYTES = 16  # CRC-17 up to here, CRC-21 above


class FrameBits(NamedTuple):
    """Bits of a frame at the nominal and at the data bit rate."""

    nominal: int
    data: int = 0

    @property
    def total(self) -> int:
        """Sum of the bits at both rates."""
        return self.nominal + self.data

    def duration_ns(self, bitrate: int, data_bitrate: int = 0) -> int:
        """Return the time on the bus at rates in bit/s, rounded up to whole ns per rate.

        data_bitrate: only for frames with bits at the data bit rate.
        """
        data_ns = -(-self.data * 1_000_000_000 // data_bitrate) if self.data else 0
        return -(-self.nominal * 1_000_000_000 // bitrate) + data_ns

    def duration_s(self, bitrate: int, data_bitrate: int = 0) -> float:
        """Return the time on the bus in s, at rates in bit/s; data_bitrate: only for bits at that rate."""
        return self.nominal / bitrate + (self.data / data_bitrate if self.data else 0.0)


def unstuffed_fd_bits(length: int, is_extended: bool = False) -> FrameBits:
    """Return the number of bits of a CAN FD frame of `length` data bytes, without dynamic stuff bits.

    is_extended: its identifier has 29 bits. Raises ValueError for a length that no frame has.
    """
    if length not in FRAME_LENGTHS:
        above = next((known for known in FRAME_LENGTHS if known > length), FRAME_LENGTHS[-1])
        raise ValueError(f"a CAN FD frame can't have {length} bytes; next possible: {above}")
    crc, fixed_stuff = (17, 6) if length <= _LONG_CRC_BYTES else (21, 7)
    # ESI, DLC, data; stuff count; CRC with its fixed stuff bits; CRC delimiter
    return FrameBits(fd_head_bits(is_extended) + _FD_TAIL_BITS, 5 + 8 * length + 4 + crc + fixed_stuff + 1)


def unstuffed_frame(length: int, is_extended: bool = False) -> FrameBits:
    """Return the number of bits of a frame, classic up to 8 data bytes, without content-dependent stuff bits.

    is_extended: its identifier has 29 bits. Raises ValueError for a length that no frame has.
    """
    if length > CLASSIC_BYTES:
        return unstuffed_fd_bits(length, is_extended)
    return FrameBits(_stuffable_bits(length, is_extended) + TAIL_BITS)


def worst_case_frame(length: int, is_extended: bool = False) -> FrameBits:
    """Return the number of bits of a frame with the most stuff bits; classic up to 8 data bytes.

    is_extended: its identifier has 29 bits. Classic frames have stuff bits up to the CRC's end, CAN FD up to the data's
    end. There, as many of them as possible are counted before the rate switch, where they take longest. Raises
    ValueError for a length that no frame has.
    """
    plain = unstuffed_frame(length, is_extended)
    if length <= CLASSIC_BYTES:
        return FrameBits(plain.nominal + (_stuffable_bits(length, is_extended) - 1) // 4)
    head = fd_head_bits(is_extended)
    stuff = (head + 5 + 8 * length - 1) // 4
    nominal_stuff = (head - 1) // 4
    return FrameBits(plain.nominal + nominal_stuff, plain.data + stuff - nominal_stuff)


def _stuffable_bits(length: int, is_extended: bool) -> int:
    """Return the number of bits of a classic frame up to the CRC's end; is_extended: its identifier has 29 bits."""
    return (54 if is_extended else 34) + 8 * length


def fd_head_bits(is_extended: bool) -> int:
    """Return the number of bits of a CAN FD frame up to BRS, BRS included; is_extended: its identifier has 29 bits."""
    return 36 if is_extended else 17
