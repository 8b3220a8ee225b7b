"""Files that outlive the run, such as a tare or a history: how they are read, and a device of the arm in them."""

from dataclasses import dataclass
from pathlib import Path

from adacd_hil.device.network import Identity
from adacd_hil.file_access import read_input
from adacd_hil.settings.parsing import Section, parse
from adacd_hil.settings.schema import ConfigError, setting
from adacd_hil.settings.toml_files import parse_toml


def read_record(path: Path, record: type[Section], kind: str, maker: str) -> tuple[bytes, Section]:
    """Return the text of a file, and the record in it. kind: of the file, maker: its command, in errors.

    Raises ConfigError if it is missing, can't be read, is no TOML, or has an invalid key or value.
    """
    if not path.exists():
        raise ConfigError(f"{kind} {path} does not exist; `adacd-hil {maker}` makes one")
    try:
        text = read_input(path)
        return text, parse(record, parse_toml(text))
    except (OSError, ConfigError) as error:
        raise ConfigError(f"{kind} {path}: {getattr(error, 'strerror', error)}") from None


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
