"""The emulated devices' SDO server against CiA 301: each abort code over the wire, frame by frame and by canopen."""

import struct

import pytest
from bench_host import BenchHost

TOGGLE, UNKNOWN_COMMAND = 0x05030000, 0x05040001
WRITE_ONLY, READ_ONLY, NO_OBJECT, NO_SUBINDEX = 0x06010001, 0x06010002, 0x06020000, 0x06090011
WRONG_LENGTH, LONG, SHORT = 0x06070010, 0x06070012, 0x06070013
VALUE, HIGH, LOW, STATE = 0x06090030, 0x06090031, 0x06090032, 0x08000022
CANNOT_STORE = 0x08000020


def ask(host: BenchHost, request: bytes, node: int = 1) -> bytes:
    """Send one request frame; return the one answer."""
    host.take()
    host.put(0x600 + node, request.ljust(8, b"\0"))
    (answer,) = host.taken(0x580 + node)
    return answer


def frame(command: int, index: int, sub: int = 0, data: bytes = b"") -> bytes:
    return struct.pack("<BHB4s", command, index, sub, data)


def aborted(index: int, sub: int, code: int) -> bytes:
    return struct.pack("<BHBI", 0x80, index, sub, code)


@pytest.mark.parametrize(
    ("node", "index", "sub", "data", "code"),
    [
        (1, 0x5FFF, 0, None, NO_OBJECT),
        (1, 0x0005, 0, None, NO_OBJECT),  # a dummy is no object
        (1, 0x1018, 5, None, NO_SUBINDEX),
        (1, 0x6040, 1, b"\0\0", NO_SUBINDEX),
        (1, 0x6041, 0, b"\0\0", READ_ONLY),
        (3, 0x6125, 1, None, WRITE_ONLY),
        (1, 0x6040, 0, b"\0", WRONG_LENGTH),
        (1, 0x1003, 0, b"\x01", VALUE),
        (1, 0x1006, 0, struct.pack("<I", 1050), VALUE),
        (1, 0x1014, 0, struct.pack("<I", 0x85), VALUE),
        (1, 0x1016, 1, struct.pack("<I", 0x0080_0064), VALUE),  # node 128
        (1, 0x1019, 0, b"\1", VALUE),
        (1, 0x6060, 0, b"\x08", VALUE),
        (3, 0x6132, 1, b"\x03", VALUE),
        (1, 0x1019, 0, b"\xf1", HIGH),
        (1, 0x2201, 0, struct.pack("<H", 10_001), HIGH),
        (1, 0x2200, 0, b"\0", LOW),
        (1, 0x1400, 1, struct.pack("<I", 0x301), STATE),
        (1, 0x1019, 0, b"\0", STATE),
        (3, 0x6125, 1, b"nero", CANNOT_STORE),
    ],
)
def test_a_request_that_can_not_be_served_is_aborted_with_its_reason_and_changes_nothing(
    host, node, index, sub, data, code
):
    sdo = host.nodes[node].sdo
    if data is None:
        assert host.abort_code(lambda: sdo.upload(index, sub)) == code
        return
    is_readable = code not in (NO_OBJECT, NO_SUBINDEX) and index != 0x6125
    before = sdo.upload(index, sub) if is_readable else None
    assert host.abort_code(lambda: sdo.download(index, sub, data)) == code
    assert before is None or sdo.upload(index, sub) == before


def in_segments(*segments: bytes, size: int | None = None) -> list[bytes]:
    """Requests that write the controlword in segments, its size announced or not."""
    head = frame(0x20, 0x6040) if size is None else frame(0x21, 0x6040, 0, struct.pack("<I", size))
    return [head, *segments]


UPLOAD = frame(0x40, 0x1008)
BROKEN = [
    *[([frame(command, 0x1008)], 0x1008, UNKNOWN_COMMAND) for command in (0xE0, 0xFF, 0xA0, 0xC0, 0xC6)],
    *[([frame(0x40, 0x1000), bytes([command])], 0x1000, UNKNOWN_COMMAND) for command in (0x60, 0x70, 0x00, 0x01)],
    ([UPLOAD, b"\x60", b"\x60"], 0x1008, TOGGLE),
    ([UPLOAD, b"\x60", b"\x60", b"\x70"], 0x1008, UNKNOWN_COMMAND),
    ([frame(0x20, 0x1006), bytes([0x0A, 0xE8, 0x03]), bytes([0x0B, 0x00, 0x00])], 0x1006, TOGGLE),
    (in_segments(size=3), 0x6040, LONG),
    (in_segments(size=1), 0x6040, SHORT),
    (in_segments(bytes([0x09, 1, 2, 3]), size=2), 0x6040, LONG),
    (in_segments(bytes([0x0D, 1]), size=2), 0x6040, SHORT),
    (in_segments(bytes([0x0D, 1])), 0x6040, WRONG_LENGTH),
    (in_segments(bytes([0x00, 1, 2, 3, 4, 5, 6, 7])), 0x6040, LONG),  # and more would follow
]
"""Requests of which the last is aborted, the object, and why: unknown commands, segments of no transfer, lengths."""


@pytest.mark.parametrize(("requests", "index", "code"), BROKEN)
def test_a_transfer_that_goes_wrong_is_aborted_with_its_reason_and_writes_nothing(host, requests, index, code):
    before = {each: host.read(1, each) for each in (0x1006, 0x6040)}
    *_, answer = [ask(host, request) for request in requests]
    assert answer == aborted(index, 0, code)
    assert {each: host.read(1, each) for each in before} == before


def test_a_number_may_be_written_in_segments(host):
    assert [ask(host, request)[0] for request in in_segments(bytes([0x0B, 0x06, 0x00]), size=2)] == [0x60, 0x20]
    assert host.read(1, 0x6040) == 6


def test_an_expedited_write_without_a_size_takes_the_objects_length(host):
    assert ask(host, frame(0x22, 0x6040, 0, b"\x06\0\xaa\xaa"))[0] == 0x60
    assert host.read(1, 0x6040) == 6


def test_a_client_that_aborts_ends_the_transfer_and_gets_no_answer(host):
    ask(host, frame(0x40, 0x1008))
    host.take()
    host.put(0x601, aborted(0x1008, 0, 0x05040000))
    assert host.take() == []
    assert ask(host, b"\x60") == aborted(0x1008, 0, UNKNOWN_COMMAND)
