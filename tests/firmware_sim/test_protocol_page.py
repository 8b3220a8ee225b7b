"""What docs/protocol.md says of the devices, where a reader could take it one way or the other."""

import re
import struct
from pathlib import Path

import pytest
from bench_host import CODEC, BenchHost, State, Word, moving_host

from firmware_sim.canopen.error_control import ERROR_CODES, WARNINGS, Watchdog

PAGE = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text()
REMOTE, REACHED, LIMITED, FOLLOWS = 1 << 9, 1 << 10, 1 << 11, 1 << 12


def crc8(data: bytes) -> int:
    """Compute the CRC that the page describes, bit by bit."""
    crc = 0xFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ (0x2F if crc & 0x80 else 0)) & 0xFF
    return crc ^ 0xFF


def test_the_pages_command_frame_is_right_and_taken_by_a_drive():
    found = re.search(
        r"counter (\d+), controlword (0x[0-9A-F]+), target torque (\d+)\..*The frame is `([0-9a-f ]+)`", PAGE
    )
    assert found is not None
    counter, word, torque, text = int(found[1]), int(found[2], 16), int(found[3]), found[4]
    frame = bytes.fromhex(text)
    ids = CODEC.message("Drive1Command").data_ids
    body = bytes([counter]) + struct.pack("<Hh", word, torque)
    assert frame == bytes([crc8(body + ids[counter : counter + 1])]) + body
    host = BenchHost()
    host.start()
    for earlier in (Word.SHUTDOWN, Word.SWITCH_ON):
        host.step(earlier)
    host.put(0x201, frame)
    host.command(Word.ENABLE, joints=(2,))
    host.sync()
    assert host.state_bits() == State.ENABLED
    assert host.bench.drives[0].torque_Nm == pytest.approx(1.2)


def test_a_drive_ignores_the_status_nibble_of_a_command():
    host = BenchHost()
    host.start()
    for nibble in range(16):
        word, bits = ((Word.SHUTDOWN, State.READY), (Word.SWITCH_ON, State.SWITCHED_ON))[nibble % 2]
        frame = bytearray(2) + struct.pack("<Hh", word, 0)
        frame[1] = nibble << 4
        host.put(0x201, host.senders[1].protect(frame))
        host.sync()
        assert host.state_bits() == bits


def test_the_status_of_a_drive_follows_statusword_mode_and_error_and_not_the_torque():
    host = moving_host(0, 20, noise=True)
    for _ in range(50):
        host.step(Word.ENABLE, 50)  # torque actual changes in each
    assert [can_id for can_id, _ in host.take() if can_id == 0x281] == []
    host.write(1, 0x1003, 0, 0)
    host.step(Word.ENABLE, 2000)  # more than rated: bit 11
    (status,) = host.taken(0x281)
    assert struct.unpack_from("<H", status)[0] & LIMITED == LIMITED
    host.bench.drives[0].fail(0x2310, host.bench.now_ns)
    host.sync()
    assert [data[5:] for data in host.taken(0x281)] == [b"\x10\x23"]


def test_what_sdo_writes_to_the_header_objects_is_dropped():
    host = moving_host(0, 20, noise=True)
    host.step(Word.DISABLE_VOLTAGE)
    for sub in (1, 2):
        before = host.read(1, 0x2100, sub)
        host.write(1, 0x2100, sub, before ^ 0xFF)
        assert host.read(1, 0x2100, sub) == before
    frame = host.command_frame(1, Word.DISABLE_VOLTAGE)
    host.put(0x201, frame)
    assert [host.read(1, 0x2100, 1), host.read(1, 0x2100, 2)] == [frame[0], frame[1]]


def test_bits_9_10_and_12_of_the_statusword():
    host = BenchHost()
    host.start()
    seen = []
    for word in (Word.SHUTDOWN, Word.SWITCH_ON, Word.ENABLE, Word.QUICK_STOP):
        host.step(word)
        seen.append(host.statusword() & (REMOTE | REACHED | FOLLOWS))
    assert seen == [REMOTE, REMOTE, REMOTE | FOLLOWS, REMOTE]


@pytest.mark.long
@pytest.mark.parametrize("clock_mode", ["sync", "wall"])
def test_after_nmt_start_the_first_sync_may_take_its_time_and_have_any_counter(clock_mode):
    host = BenchHost(clock_mode=clock_mode)
    host.start()
    host.take()
    host.t_ns += 60_000_000_000
    host.bench.advance_to(host.t_ns)
    assert [can_id for can_id, _ in host.take() if can_id < 0x100] == []
    host.cycle = 123
    for word in (Word.SHUTDOWN, Word.SWITCH_ON, Word.ENABLE, Word.ENABLE):
        host.step(word)
    assert (host.state_bits(), [host.read(1, 0x2211, sub) for sub in range(1, 6)]) == (State.ENABLED, [0] * 5)


def test_the_page_names_every_watchdog_with_its_code():
    for watchdog in Watchdog:
        assert f"0x{ERROR_CODES[watchdog]:04X}" in PAGE
    numbers = re.search(r"Byte 3 of each EMCY is the watchdog: (.*?);", PAGE)
    assert numbers is not None
    assert [int(entry.split()[0]) for entry in numbers[1].split(", ")] == sorted(Watchdog)
    assert {watchdog for watchdog in Watchdog if watchdog >= 5} == WARNINGS
