"""A device of the arm as its master sees it: its objects by SDO, and failures that name device, object and value.

Source: CiA 301 (4.2), clause 7.2.4.
"""

from typing import Any, NoReturn

from adacd_hil.device.canopen_bus import DeviceError, explained, find_variable
from adacd_hil.device.profile import ObjectName, PlacedDevice


class Slave:
    """A device of the arm on the bus, as its master sees it."""

    def __init__(self, device: PlacedDevice, node: Any) -> None:
        self.device = device
        self.name = device.name
        self.node_id = device.node_id
        self.known: dict[tuple[int, int], int] = {}
        """What the set-up has written or compared, by index and sub-index."""
        self._node = node

    def has(self, index: int, sub: int = 0) -> bool:
        """Whether the EDS lists an object."""
        return find_variable(self._node.object_dictionary, index, sub) is not None

    def default(self, index: int, sub: int = 0) -> int:
        """Return the value that the EDS gives, 0 when it gives none."""
        variable = find_variable(self._node.object_dictionary, index, sub)
        return 0 if variable is None or variable.default is None else variable.default

    def read(self, index: int, sub: int = 0) -> int:
        """Read a number. Raises DeviceError."""
        with explained(self.name, self.node_id, f"reading {self.describe(index, sub)}"):
            return int(self._entry(index, sub).raw)

    def write(self, index: int, sub: int, value: int) -> None:
        """Write a number. Raises DeviceError."""
        with explained(self.name, self.node_id, f"writing {self.describe(index, sub)} = {_number(value)}"):
            self._entry(index, sub).raw = value
        self.known[index, sub] = value

    def write_checked(self, index: int, sub: int, value: int, unit: str = "") -> None:
        """Write a number and read it back. Raises DeviceError."""
        self.write(index, sub, value)
        found = self.read(index, sub)
        if found != value:
            self.fail(f"{self.describe(index, sub)} reads back {_with(found, unit)}, {_with(value, unit)} written")

    def expect(self, index: int, sub: int, expected: int, quantity: str, unit: str = "", is_hex: bool = False) -> None:
        """Compare an object with what it must be. Raises DeviceError."""
        found = self.read(index, sub)
        self.known[index, sub] = expected
        if found != expected:
            values = [f"0x{value:08X}" if is_hex else _with(value, unit) for value in (found, expected)]
            self.fail(f"{quantity} {ObjectName(index, sub)} = {values[0]}, {values[1]} expected")

    def describe(self, index: int, sub: int) -> str:
        """Name an object as the EDS does."""
        variable = find_variable(self._node.object_dictionary, index, sub)
        return str(ObjectName(index, sub)) + ("" if variable is None else f" {variable.name}")

    def fail(self, text: str) -> NoReturn:
        """Raise DeviceError with the device's name."""
        raise DeviceError(f"{self.name} (node {self.node_id}): {text}")

    def _entry(self, index: int, sub: int) -> Any:
        entry = self._node.sdo.get_variable(index, sub)
        if entry is None:
            self.fail(f"{ObjectName(index, sub)} is not in the EDS")
        return entry


def _with(value: int, unit: str) -> str:
    return f"{_number(value)} {unit}".rstrip()


def _number(value: int) -> str:
    return f"0x{value:08X}" if value > 0xFFFFFF else str(value)
