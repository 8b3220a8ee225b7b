"""The load meter, by hand."""

import pytest

from adacd_hil.lab.commission.load_meter import LoadMeter
from adacd_hil.wire.bus import Frame

SECOND_NS = 1_000_000_000
BITRATE = 1_000_000


def test_load_is_the_time_of_the_frames_over_the_interval() -> None:
    meter = LoadMeter(500_000, 0, 0)
    for _ in range(10):
        meter.count_frame(Frame(0, b"", 0))  # 34 zeros with 6 stuff bits, and 13: 53
    assert meter.bits.total == 530
    assert meter.take_percent(2_000_000) == pytest.approx(100 * 530 * 2e-6 / 2e-3)


def test_an_interval_begins_where_the_last_one_ended() -> None:
    meter = LoadMeter(BITRATE, 0, 0)
    meter.count_frame(Frame(1, b"12345678", 0))
    meter.take_percent(SECOND_NS)
    meter.count_frame(Frame(0, b"", 0))
    assert meter.take_percent(3 * SECOND_NS) == pytest.approx(100 * 53e-6 / 2.0)
    assert [meter.take_percent(end_s * SECOND_NS) for end_s in (4, 4)] == [0.0, 0.0]


def test_can_fd_counts_at_both_rates() -> None:
    meter = LoadMeter(BITRATE, 5_000_000, 0)
    meter.count_frame(Frame(0x555, b"\x55" * 12, 0))  # SOF, id 101 0101 0101, 00 1 0 1: no run of five; 29 and 129 bits
    assert meter.bits == (29, 129)
    assert meter.take_percent(SECOND_NS) == pytest.approx(100 * (29e-6 + 129 * 0.2e-6))


def test_can_fd_on_a_classic_bus_and_a_rate_of_zero_are_refused() -> None:
    meter = LoadMeter(BITRATE, 0, 0)
    with pytest.raises(ValueError, match="frame 0x181 has 12 bytes: CAN FD, but no data bit rate is given"):
        meter.count_frame(Frame(0x181, bytes(12), 0))
    with pytest.raises(ValueError, match="bitrate = 0 bit/s is not above 0 bit/s"):
        LoadMeter(0, 0, 0)


def test_error_frames_and_extended_identifiers() -> None:
    meter = LoadMeter(BITRATE, 0, 0)
    meter.count_frame(Frame(0x004, bytes(8), 0, is_error=True))
    meter.count_frame(Frame(0x1AAAAAAA, b"", 0))
    assert 67 <= meter.bits.total < 67 + 34
