"""How long frames take on the emulated bus."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adacd_hil.wire.frame_bits import worst_case_frame
from adacd_hil.wire.frame_lengths import FRAME_LENGTHS
from adacd_hil.wire.frame_time import exact_frame, exact_time, worst_time

RATE, DATA_RATE = 1_000_000, 5_000_000
CLASSIC = exact_time(RATE)
FD = exact_time(RATE, DATA_RATE)
CLASSIC(0, b""), FD(0, bytes(12))  # compiled before hypothesis looks at the time
# Bytes that make long runs of equal bits, so that stuffing is at its densest.
BYTES = st.lists(st.sampled_from([0x00, 0xFF, 0x0F, 0xF0, 0x1F, 0xC1, 0x83, 0x55]) | st.integers(0, 255))


@settings(max_examples=70)
@given(st.integers(0, 0x7FF) | st.integers(0x800, 0x1FFFFFFF), BYTES.filter(lambda content: len(content) <= 8))
def test_a_classic_frame_takes_its_exact_bits(can_id: int, content: list[int]) -> None:
    """An identifier beyond 11 bits makes it longer."""
    data = bytes(content)
    assert CLASSIC(can_id, data) == exact_frame(can_id, data).duration_ns(RATE)


@pytest.mark.parametrize("length", [length for length in FRAME_LENGTHS if length > 8])
@settings(max_examples=20)
@given(can_id=st.integers(0, 0x7FF), content=st.data())
def test_an_fd_frame_takes_its_exact_bits_at_both_rates(length: int, can_id: int, content: st.DataObject) -> None:
    data = content.draw(
        st.binary(min_size=length, max_size=length) | st.sampled_from([bytes(length), b"\xff" * length])
    )
    assert FD(can_id, data) == exact_frame(can_id, data).duration_ns(RATE, DATA_RATE)


@pytest.mark.parametrize("rate", [125_000, 800_000, 83_333])
def test_a_rate_without_whole_nanoseconds_is_rounded_up_per_frame(rate: int) -> None:
    assert exact_time(rate)(0x181, b"\x12\x34") == exact_frame(0x181, b"\x12\x34").duration_ns(rate)


@pytest.mark.parametrize("length", [0, 1, 6, 8, 12, 24, 64])
def test_the_worst_case_depends_on_the_length_only(length: int) -> None:
    expected_ns = worst_case_frame(length).duration_ns(RATE, DATA_RATE)
    assert worst_time(RATE, DATA_RATE)(0x181, b"\x55" * length) == expected_ns
