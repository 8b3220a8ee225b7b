"""A device of the arm in a file that outlives the run, such as a tare or a history."""

from dataclasses import dataclass

from adacd_hil.device.network import Identity
from adacd_hil.settings.schema import setting


@dataclass(frozen=True)
class DeviceRecord:
    """A device of the arm in a tare or history: name, node id and object 0x1018."""

    name: str = setting(meaning="name in the DBC")
    node_id: int = setting(low=1, high=127, meaning="CANopen node id")
    vendor: int = setting(low=0, high=0xFFFF_FFFF, meaning="0x1018:1")
    product: int = setting(low=0, high=0xFFFF_FFFF, meaning="0x1018:2")
    revision: int = setting(low=0, high=0xFFFF_FFFF, meaning="0x1018:3")
    serial: int = setting(low=0, high=0xFFFF_FFFF, meaning="0x1018:4")

    def difference(self, found: Identity) -> str:
        """Return the first difference to the device found, as text: vendor, product or serial number; "" without one.

        Revision (firmware), name and node id may differ.
        """
        for what, known, present in (
            ("vendor", self.vendor, found.vendor),
            ("product code", self.product, found.product),
            ("serial number", self.serial, found.serial),
        ):
            if known != present:
                return f"{found.name} (node {found.node_id}): {what} {present} is not the {known}"
        return ""
