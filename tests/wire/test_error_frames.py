"""Error frames: written by hand after linux/can/error.h, each meaning what the header says."""

import pytest

from adacd_hil.wire.bus import Frame
from adacd_hil.wire.error_frames import TroubleKind, decode_error, is_bus_off

# error class, data, kind, text, counters
REPORTS = [
    (0x001, "0000000000000000", "TRANSMIT_TIMEOUT", "transmit timeout", None),
    (0x002, "0000000000000000", "ARBITRATION_LOST", "arbitration lost", None),
    (0x002, "0b00000000000000", "ARBITRATION_LOST", "arbitration lost in bit 11", None),
    (0x004, "0000000000000000", "OTHER", "unspecified controller error", None),
    (0x004, "0001000000000000", "RECEIVE_OVERFLOW", "receive buffer overflow", None),
    (0x004, "0002000000000000", "TRANSMIT_OVERFLOW", "transmit buffer overflow", None),
    (0x204, "0004000000000060", "ERROR_WARNING", "error warning (receiving)", (0, 96)),
    (0x204, "0008000000006105", "ERROR_WARNING", "error warning (sending)", (97, 5)),
    (0x204, "0010000000000880", "ERROR_PASSIVE", "error passive (receiving)", (8, 128)),
    (0x204, "0030000000008081", "ERROR_PASSIVE", "error passive (receiving), error passive (sending)", (128, 129)),
    (0x204, "0040000000000000", "ERROR_ACTIVE", "error active again", (0, 0)),
    (0x008, "0000000000000000", "PROTOCOL", "protocol error (unspecified)", None),
    (0x088, "0000040a00000000", "PROTOCOL", "protocol error (bit stuffing at data)", None),
    (0x008, "0000880600000000", "PROTOCOL", "protocol error (unable to send dominant bit, while sending at "
     "identifier bits 2-0)", None),
    (0x008, "0000001800000000", "PROTOCOL", "protocol error (CRC delimiter)", None),
    (0x010, "0000000007000000", "OTHER", "transceiver: CAN-H short to ground", None),
    (0x010, "0000000044000000", "OTHER", "transceiver: CAN-H no wire, CAN-L no wire", None),
    (0x010, "0000000080000000", "OTHER", "transceiver: CAN-L short to CAN-H", None),
    (0x020, "0000000000000000", "NO_ACKNOWLEDGE", "no acknowledgement", None),
    (0x088, "0000001900000000", "NO_ACKNOWLEDGE", "no acknowledgement, protocol error (acknowledge slot)", None),
    (0x0A8, "0000801900008800", "NO_ACKNOWLEDGE", "no acknowledgement, protocol error (while sending at "
     "acknowledge slot)", (136, 0)),
    (0x040, "0000000000000000", "BUS_OFF", "bus-off", None),
    (0x064, "0020000000000000", "BUS_OFF", "bus-off, error passive (sending), no acknowledgement", None),
    (0x080, "0000000000000000", "PROTOCOL", "bus error", None),
    (0x100, "0000000000000000", "RESTARTED", "controller restarted", None),
    (0x200, "0000000000000300", "OTHER", "unspecified error", (3, 0)),
    (0x000, "0000000000000000", "OTHER", "unspecified error", None),
    (0x040, "", "BUS_OFF", "bus-off", None),
    (0x204, "0020", "ERROR_PASSIVE", "error passive (sending)", (0, 0)),
    (0x100, "0b3f881944000000", "RESTARTED", "controller restarted", None),  # details of classes that it isn't
]  # fmt: skip


@pytest.mark.parametrize(("error_class", "data", "kind", "text", "counters"), REPORTS)
def test_a_report_is_read_as_the_header_says(
    error_class: int, data: str, kind: str, text: str, counters: tuple[int, int] | None
) -> None:
    if counters is not None:
        text += f"; error counters: sending {counters[0]}, receiving {counters[1]}"
    assert decode_error(Frame(error_class, bytes.fromhex(data), 0, is_error=True)) == (TroubleKind[kind], text)


def test_no_frame_of_any_class_is_without_a_line() -> None:
    for error_class in range(0x400):
        text = decode_error(Frame(error_class, b"\xff" * 8, 0, is_error=True))[1]
        assert text
        assert "\n" not in text


def test_only_the_bus_off_class_is_bus_off() -> None:
    assert [error_class for error_class in range(0x400) if is_bus_off(Frame(error_class, bytes(8), 0, True))] == [
        error_class for error_class in range(0x400) if error_class >> 6 & 1
    ]


def test_a_frame_that_is_no_error_frame_is_refused() -> None:
    with pytest.raises(ValueError, match="frame 0x40 is not an error frame"):
        decode_error(Frame(0x40, bytes(8), 0))
