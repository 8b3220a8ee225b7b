"""Whatever canopen raises becomes one line with device, node and object; what the bus raises passes."""

import struct
from types import SimpleNamespace

import canopen
import pytest
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from adacd_hil.device.canopen_bus import DeviceError, as_device_error, read_object
from adacd_hil.wire.bus import SilenceError


def fail_with(error: Exception) -> None:
    with as_device_error("Drive1", 1, "reading 0x6041:0 Statusword"):
        raise error


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (SdoAbortedError(0x06020000), "refused: Code 0x06020000, Object does not exist"),
        (SdoCommunicationError("No SDO response received"), "no SDO answer within 0.5 s"),
        (struct.error("unpack requires a buffer of 4 bytes"), "unpack requires a buffer of 4 bytes"),
        (canopen.ObjectDictionaryError("No value\ndescriptions"), "No value descriptions"),
        (KeyError(7), "7"),
        (IndexError("bytearray index out of range"), "index out of range"),
        (ValueError("no int"), "no int"),
        (TypeError("no int"), "no int"),
        (OverflowError("too large"), "too large"),
        (AssertionError(), "AssertionError()"),
        (RuntimeError("All expected data"), "All expected data"),
    ],
)
def test_an_error_of_canopen_names_device_node_and_object(error: Exception, reason: str) -> None:
    with pytest.raises(DeviceError) as caught:
        fail_with(error)
    line = str(caught.value)
    assert line.startswith("Drive1 (node 1): ")
    assert reason in line
    assert "reading 0x6041:0 Statusword" in line
    assert "\n" not in line


@pytest.mark.parametrize("error", [SilenceError("nobody answers"), DeviceError("of another device")])
def test_an_error_that_says_it_all_passes(error: Exception) -> None:
    with pytest.raises(type(error)) as caught:
        fail_with(error)
    assert caught.value is error


def test_an_object_that_comes_garbled_names_the_node() -> None:
    with pytest.raises(DeviceError, match=r"^node \(node 5\): object 0x1008:0: unpack requires"):
        read_object(SimpleNamespace(id=5, sdo=SimpleNamespace(upload=lambda *_: struct.unpack("<I", b""))), 0x1008)
