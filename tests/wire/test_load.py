"""The load meter: by hand, and against can-utils' canbusload on the same frames."""

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from hang import HANG_S

from adacd_hil.clock import MonotonicClock
from adacd_hil.lab.commission.load_meter import LoadMeter
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.dbc_contract import load_codec
from adacd_hil.wire.open_bus import open_bus

SECOND_NS = 1_000_000_000
BITRATE = 1_000_000
BURST = 200
"""Frames between two lines of canbusload: fewer than a socket's default receive buffer holds (277)."""
CANGEN = ("cangen", "-g", "0", "-I", "r", "-L", "r", "-D", "r", "-n")


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


@contextmanager
def canbusload(channel: str) -> Iterator[Iterator[tuple[int, int, int]]]:
    """Run canbusload; yields its lines, once a second: frames, bits, payload bits."""
    command = ["canbusload", "-e", f"{channel}@{BITRATE}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            fields = (line.split() for line in process.stdout)
            yield ((int(f[1]), int(f[2]), int(f[3])) for f in fields if f)
        finally:
            process.terminate()


def arm_frames() -> list[tuple[int, bytes]]:
    """Every message of the arm, one burst of them after the other, with few, many and dense changes of bits."""
    messages = sorted((message.can_id, message.length) for message in load_codec().messages.values())
    frames = []
    for number in range(BURST):
        can_id, length = messages[number % len(messages)]
        pattern = (0, 0xFF, 0x0F, 0xF8, 0x1E, 0x55)[number // len(messages) % 6]
        frames.append((can_id, bytes((pattern + number * k // 7) & 0xFF for k in range(length))))
    return frames


@pytest.mark.vcan
@pytest.mark.slow
def test_the_meter_counts_the_bits_that_canbusload_counts() -> None:
    if not shutil.which("canbusload"):
        pytest.skip("canbusload (Debian package can-utils) is not installed")
    clock = MonotonicClock()
    sender, receiver = open_bus("socketcan", "vcan0", clock), open_bus("socketcan", "vcan0", clock)
    meter = LoadMeter(BITRATE, 0, 0)
    theirs = [0, 0, 0]
    with canbusload("vcan0") as lines:
        next(lines)  # it listens
        for is_ours in (True, False):
            if is_ours:
                for can_id, data in arm_frames():
                    sender.send(can_id, data)
            else:  # what another program makes up: random identifiers, lengths, contents
                subprocess.run([*CANGEN, str(BURST), "vcan0"], check=True)
            for _ in range(BURST):
                received = receiver.receive(HANG_S)
                assert received is not None
                meter.count_frame(received)
            counted = 0
            while counted < BURST:
                line = next(lines)
                counted += line[0]
                theirs = [total + new for total, new in zip(theirs, line, strict=True)]
    assert [2 * BURST, meter.bits.total] == theirs[:2]
    sender.close()
    receiver.close()
