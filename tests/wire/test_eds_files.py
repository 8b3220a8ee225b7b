"""The EDS files as tools that are not ours see them, and what CiA 306 and CiA 301 ask of them."""

import configparser
import re
from pathlib import Path

import pytest
from eds_utils.core.file_io.read_eds import read_eds

from adacd_hil.wire.dbc_contract import contract_folder

FILES = sorted(contract_folder().glob("*.eds"))
EVERY_FILE = pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
BITS = {0x1: 1, 0x2: 8, 0x3: 16, 0x4: 32, 0x5: 8, 0x6: 16, 0x7: 32, 0x15: 64, 0x1B: 64}  # by DataType
SIGNED = {0x2, 0x3, 0x4, 0x15}
ACCESS = {"ro", "wo", "rw", "rwr", "rww", "const"}
SERIES = {"maxon_epos4", "zeroerr_erob"}
"""Files of all models of a maker's series."""
OPEN_IN_A_SERIES = {
    "ProductNumber was missing from [DeviceInfo]",
    "RevisionNumber was missing from [DeviceInfo]",
    "Section [ManufacturerObjects] was missing",  # said of an empty one, too
}
DRIVES = [path for path in FILES if "drive" in path.stem]


def sections_of(path: Path) -> configparser.ConfigParser:
    parser = configparser.ConfigParser(strict=True, interpolation=None)  # strict: nothing twice
    parser.optionxform = str  # type: ignore[method-assign, assignment]
    parser.read_string(path.read_text(encoding="ascii"))
    return parser


def number(text: str, node_id: int = 1) -> int:
    """Read a value; `$NODEID+x` stands for the node's."""
    return node_id + int(text.removeprefix("$NODEID+"), 0) if text.startswith("$NODEID+") else int(text, 0)


def variables(path: Path) -> dict[tuple[int, int], configparser.SectionProxy]:
    """List what has a DataType, by index and sub-index."""
    found = {}
    parser = sections_of(path)
    for name in parser.sections():
        match = re.fullmatch(r"([0-9A-F]{4})(?:sub([0-9A-F]{1,2}))?", name)
        if match and "DataType" in parser[name]:
            found[int(match[1], 16), int(match[2] or "0", 16)] = parser[name]
    return found


@EVERY_FILE
def test_eds_validate_has_no_complaint(path: Path) -> None:
    _, complaints = read_eds(str(path))
    missing = {line.partition(": ")[2] for line in complaints}
    assert missing == (OPEN_IN_A_SERIES if path.stem in SERIES else set())


@EVERY_FILE
def test_an_array_or_record_has_as_many_sub_indices_as_it_says(path: Path) -> None:
    parser = sections_of(path)
    for name in parser.sections():
        if "SubNumber" not in parser[name]:
            continue
        subs = [int(other[len(name) + 3 :], 16) for other in parser.sections() if other.startswith(f"{name}sub")]
        assert (name, len(subs)) == (name, int(parser[name]["SubNumber"], 0))
        highest = parser[f"{name}sub0"]
        assert number(highest["DataType"]) == 5
        is_live = name == "1003" or name[:2] in ("16", "1A")  # how many there are now
        if not is_live:
            assert (name, number(highest["DefaultValue"])) == (name, max(subs))


@EVERY_FILE
def test_every_default_and_limit_fits_its_type(path: Path) -> None:
    for (index, sub), row in variables(path).items():
        kind = number(row["DataType"])
        assert row["AccessType"] in ACCESS
        assert row["PDOMapping"] in ("0", "1")
        if kind not in BITS:
            continue
        low, high = (
            (-(1 << (BITS[kind] - 1)), (1 << (BITS[kind] - 1)) - 1) if kind in SIGNED else (0, (1 << BITS[kind]) - 1)
        )
        values = [number(row[key]) for key in ("LowLimit", "DefaultValue", "HighLimit") if key in row]
        assert all(low <= value <= high for value in values), (hex(index), sub)
        assert values == sorted(values), (hex(index), sub)


@pytest.mark.parametrize("path", DRIVES, ids=lambda path: path.stem)
def test_rated_torque_is_constant_and_has_no_value_that_two_motors_could_share(path: Path) -> None:
    row = variables(path)[0x6076, 0]
    assert (row["AccessType"], "DefaultValue" in row) == ("const", False)


@EVERY_FILE
def test_the_file_names_itself(path: Path) -> None:
    assert sections_of(path)["FileInfo"]["FileName"] == path.name
