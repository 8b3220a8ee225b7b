"""EMCY codes by name."""

import pytest

from adacd_hil.device.canopen_bus import describe_emergency, name_error


@pytest.mark.parametrize(
    ("code", "name"),
    [
        (0x8130, "life guard or heartbeat error"),
        (0x8250, "RPDO timeout"),
        (0x8100, "communication"),
        (0x8199, "communication"),  # unlisted: its class
        (0x2310, "continuous over-current, output"),
        (0x2399, "current, device output side"),
        (0x5D00, "device hardware"),  # unlisted class: the wider one
        (0x8611, "following error"),
        (0x8700, "sync controller"),
        (0xFF07, "device specific"),
        (0xB000, "unknown"),
    ],
)
def test_a_code_has_its_name_or_its_classs(code: int, name: str) -> None:
    assert name_error(code) == name


@pytest.mark.parametrize(
    ("number", "name"), [(1, "SYNC"), (2, "command"), (3, "host heartbeat"), (4, "left Operational"), (5, "PDO length")]
)
def test_our_devices_say_which_watchdog_tripped_and_when(number: int, name: str) -> None:
    data = bytes((number,)) + (123_456).to_bytes(4, "little")
    expected = f"EMCY 0x8250: RPDO timeout, watchdog {number} ({name}) at device time 123456 ms"
    assert describe_emergency(0x8250, data, has_watchdog=True) == expected


@pytest.mark.parametrize(("number", "has_watchdog"), [(2, False), (9, True)], ids=["a stranger's", "unknown"])
def test_bytes_that_name_no_watchdog_are_shown_as_they_are(number: int, has_watchdog: bool) -> None:
    text = describe_emergency(0x8250, bytes((number, 0, 0, 0, 9)), has_watchdog)
    assert text == f"EMCY 0x8250: RPDO timeout, manufacturer bytes 0{number} 00 00 00 09"


def test_an_error_reset_says_so() -> None:
    assert describe_emergency(0, bytes(5), has_watchdog=True) == "EMCY 0x0000: error reset"
