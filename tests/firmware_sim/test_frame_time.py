"""How long frames take on the emulated bus: the bits of tests/wire/test_frame_bits.py, at the bus's rates."""

import pytest

from adacd_hil.wire.frame_bits import worst_case_frame
from adacd_hil.wire.frame_time import exact_frame, exact_time, worst_time

DATA_RATE = 5_000_000


@pytest.mark.parametrize("rate", [1_000_000, 125_000, 83_333])
@pytest.mark.parametrize("can_id", [0x181, 0x18DAF110])
@pytest.mark.parametrize("length", [0, 1, 8, 12, 64])
def test_a_frame_takes_its_bits_at_the_rates_of_the_bus_rounded_up_to_nanoseconds(
    length: int, can_id: int, rate: int
) -> None:
    for data in (bytes(length), b"\x55" * length):
        assert exact_time(rate, DATA_RATE)(can_id, data) == exact_frame(can_id, data).duration_ns(rate, DATA_RATE)
        worst_ns = worst_case_frame(length, can_id > 0x7FF).duration_ns(rate, DATA_RATE)
        assert worst_time(rate, DATA_RATE)(can_id, data) == worst_ns
