"""Frame lengths: by hand, against an encoder of its own, and the worst case against exact frames."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from adacd_hil.wire.frame_bits import FrameBits, unstuffed_frame, worst_case_frame
from adacd_hil.wire.frame_lengths import FRAME_LENGTHS
from adacd_hil.wire.frame_time import exact_frame

BASE_ID = st.integers(0, 0x7FF)
EXTENDED_ID = st.integers(0x800, 0x1FFFFFFF)
FD_DATA = st.sampled_from(FRAME_LENGTHS[9:]).flatmap(lambda length: st.binary(min_size=length, max_size=length))
# Bytes that make long runs of equal bits, so that stuffing is at its densest, and any.
DENSE = st.sampled_from([0x00, 0xFF, 0x0F, 0xF0, 0x1F, 0xC1, 0x83, 0x55]) | st.integers(0, 255)
DATA = st.lists(DENSE, max_size=8).map(bytes)
exact_frame(0, b""), exact_frame(0, bytes(12))  # compiled before hypothesis looks at the time


def to_bits(value: int, count: int) -> list[int]:
    return [value >> place & 1 for place in reversed(range(count))]


def count_stuff_bits(bits: list[int]) -> int:
    """Insert as a transmitter does, bit by bit: ISO 11898-1, frame coding."""
    sent: list[int] = []
    count = 0
    for bit in bits:
        sent.append(bit)
        if len(sent) >= 5 and len(set(sent[-5:])) == 1:
            sent.append(1 - bit)
            count += 1
    return count


def crc15(bits: list[int]) -> list[int]:
    """The shift register of the CAN specification 2.0, section 3.1.1."""
    register = 0
    for bit in bits:
        is_next = bit ^ (register >> 14 & 1)
        register = register << 1 & 0x7FFF
        if is_next:
            register ^= 0x4599
    return to_bits(register, 15)


def encode_classic(can_id: int, data: bytes, is_extended: bool) -> list[int]:
    """Start of frame to CRC."""
    if is_extended:
        head = [0, *to_bits(can_id >> 18, 11), 1, 1, *to_bits(can_id, 18), 0, 0, 0]
    else:
        head = [0, *to_bits(can_id, 11), 0, 0, 0]
    content = [*head, *to_bits(len(data), 4), *(bit for byte in data for bit in to_bits(byte, 8))]
    return content + crc15(content)


@pytest.mark.parametrize(
    ("length", "base", "extended"),
    [(0, 55, 80), (1, 65, 90), (4, 95, 120), (6, 115, 140), (7, 125, 150), (8, 135, 160)],
)
def test_the_worst_case_is_that_of_davis_2007(length: int, base: int, extended: int) -> None:
    assert worst_case_frame(length).total == base
    assert worst_case_frame(length, is_extended=True).total == extended


def test_lengths_without_stuffing_are_47_and_67_bits_and_the_data() -> None:
    assert [unstuffed_frame(length).total for length in (0, 1, 8)] == [47, 55, 111]
    assert [unstuffed_frame(length, is_extended=True).total for length in (0, 1, 8)] == [67, 75, 131]


def test_the_lengths_of_a_can_fd_frame_by_hand() -> None:
    # SOF 1, id 11, RRS, IDE, FDF, res, BRS 5; ACK 2, EOF 7, intermission 3 | ESI 1, DLC 4, 96 data, stuff count 4,
    # CRC 17 with 6 fixed stuff bits, CRC delimiter 1
    assert unstuffed_frame(12) == FrameBits(29, 129)
    assert unstuffed_frame(24) == FrameBits(29, 5 + 192 + 4 + 21 + 7 + 1)
    # 17 bits take 4 stuff bits at most, 118 take 29
    assert worst_case_frame(12) == FrameBits(33, 129 + 25)


@pytest.mark.parametrize("length", [9, 13, 65])
def test_a_length_that_no_can_fd_frame_has_is_refused(length: int) -> None:
    with pytest.raises(ValueError, match=f"a CAN FD frame can't have {length} bytes"):
        worst_case_frame(length)
    with pytest.raises(ValueError, match=f"a CAN FD frame can't have {length} bytes"):
        exact_frame(1, bytes(length))


def test_times_are_rounded_up_to_whole_nanoseconds() -> None:
    assert FrameBits(1, 1).duration_ns(300_000, 3_000_000) == 3334 + 334
    assert FrameBits(100, 40).duration_s(1_000_000, 8_000_000) == pytest.approx(105e-6)


@pytest.mark.slow
@given(can_id=BASE_ID | EXTENDED_ID, data=DATA)
def test_a_classic_frame_is_as_long_as_its_bits_put_one_after_the_other(can_id: int, data: bytes) -> None:
    bits = encode_classic(can_id, data, is_extended=can_id > 0x7FF)
    assert exact_frame(can_id, data) == FrameBits(len(bits) + count_stuff_bits(bits) + 13)


@pytest.mark.slow
@given(can_id=BASE_ID | EXTENDED_ID, data=FD_DATA)
def test_a_can_fd_frame_is_as_long_as_its_bits_put_one_after_the_other(can_id: int, data: bytes) -> None:
    if can_id > 0x7FF:
        head = [0, *to_bits(can_id >> 18, 11), 1, 1, *to_bits(can_id, 18), 0, 1, 0, 1]
    else:
        head = [0, *to_bits(can_id, 11), 0, 0, 1, 0, 1]
    dlc = {12: 9, 16: 10, 20: 11, 24: 12, 32: 13, 48: 14, 64: 15}.get(len(data), len(data))
    dynamic = [*head, 0, *to_bits(dlc, 4), *(bit for byte in data for bit in to_bits(byte, 8))]
    # A stuff bit that would follow the last data bit is the fixed one that begins the CRC field: feed one bit less.
    nominal = len(head) + count_stuff_bits(head)
    stuffed = len(dynamic) + count_stuff_bits(dynamic[:-1])
    crc_field = 4 + 17 + 6 if len(data) <= 16 else 4 + 21 + 7
    assert exact_frame(can_id, data) == FrameBits(nominal + 2 + 7 + 3, stuffed - nominal + crc_field + 1)


@pytest.mark.slow
@given(can_id=BASE_ID | EXTENDED_ID, data=DATA | FD_DATA, rate=st.sampled_from([1, 2, 5, 8]))
def test_no_frame_is_longer_than_the_worst_case_or_shorter_than_without_stuffing(
    can_id: int, data: bytes, rate: int
) -> None:
    exact, worst = exact_frame(can_id, data), worst_case_frame(len(data), can_id > 0x7FF)
    assert exact.nominal <= worst.nominal
    assert unstuffed_frame(len(data), can_id > 0x7FF).total <= exact.total <= worst.total
    assert exact.duration_ns(1_000_000, rate * 1_000_000) <= worst.duration_ns(1_000_000, rate * 1_000_000)
