"""EDS files for tests: the stock drive's, changed as the makers' files differ from it."""

import configparser
from pathlib import Path
from typing import Self

from adacd_hil.wire.dbc_contract import contract_folder

UNSIGNED32 = "0x0007"
_LISTS = ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects")


class EdsVariant:
    """An EDS in the making. Sections are named as in the file: `6076`, `1801sub5`."""

    def __init__(self, name: str = "stock_drive.eds") -> None:
        self.table = configparser.RawConfigParser()
        self.table.optionxform = str  # type: ignore[assignment, method-assign]
        self.table.read(contract_folder() / name)

    def without(self, *sections: str) -> Self:
        """Leave objects out, with their sub-indices."""
        for section in sections:
            for found in self.table.sections():
                if found == section or found.startswith(f"{section}sub"):
                    self.table.remove_section(found)
        return self

    def with_value(self, value: int | str, *sections: str, key: str = "DefaultValue") -> Self:
        """Give objects another default, or another value of `key`."""
        for section in sections:
            self.table[section][key] = str(value)
        return self

    def with_object(self, section: str, value: int, **keys: str) -> Self:
        """Add an object, or a sub-index of one that is there; keys: instead of those of one that is written by SDO."""
        self.table[section] = {
            "ParameterName": f"Object {section}",
            "ObjectType": "0x7",
            "DataType": UNSIGNED32,
            "AccessType": "rw",
            "DefaultValue": str(value),
            "PDOMapping": "0",
        } | keys
        return self

    def write(self, path: Path) -> Path:
        """Write the file, with lists of the objects that it has."""
        objects = [section for section in self.table.sections() if len(section) == 4]
        ranges = ((0x1000, 0x1002), (0x1002, 0x2000), (0x2000, 0x6000))
        for name, (low, high) in zip(_LISTS, ranges, strict=True):
            rows = [one for one in objects if low <= int(one, 16) < high or (low == 0x1002 and int(one, 16) >= 0x6000)]
            numbered = {str(number): f"0x{one}" for number, one in enumerate(rows, start=1)}
            self.table[name] = {"SupportedObjects": str(len(rows))} | numbered
        with path.open("w", encoding="utf-8") as file:
            self.table.write(file, space_around_delimiters=False)
        return path
