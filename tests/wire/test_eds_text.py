"""An EDS of a maker is read whatever its sections without objects are like, by the host and by the emulator."""

import re

import pytest

from adacd_hil.device.canopen_bus import find_variable
from adacd_hil.device.eds_file import read_eds
from adacd_hil.wire.dbc_contract import contract_folder
from adacd_hil.wire.eds_text import readable_eds
from firmware_sim.canopen.object_dictionary import read_eds as read_emulated

EDS = (contract_folder() / "torque_sensor.eds").read_text()


def section(name: str, *lines: str) -> str:
    """Replace the lines of a section."""
    head, _, rest = EDS.partition(f"[{name}]\n")
    behind = re.search(r"^\[", rest, re.MULTILINE)
    return "\n".join([f"{head}[{name}]", *lines, rest[behind.start() :]])


ODD = {
    "fewer comments than announced": section("Comments", "Lines=5", "Line1=one"),
    "no number of comments": section("Comments", "Line1=one"),
    "a device without numbers": section("DeviceInfo", "ProductNumber=", "BaudRate_1000=", "LSS_Supported=x"),
    "numbers with zeros before them": section("DeviceInfo", "VendorName=x", "RevisionNumber=0003", "BaudRate_10=0x0"),
    "some dummies, in hexadecimal": section("DummyUsage", "Dummy0002=0x0", "Dummy0005=0x1"),
    "an object of the maker's that is no number": EDS.replace("[1018]", "[2FFF]\nParameterName=x\nObjectType=7\n"
        "DataType=0x001B\nAccessType=rw\nDefaultValue=0x1234567890ABCDEFLL\n\n[1018]"),
    "sub-indices before their object": "[" + "[".join(sorted(EDS.split("[")[1:], reverse=True)),
    "keys and sub-indices in another case": re.sub("sub(?=.])", "SUB", EDS.replace("DefaultValue", "defaultvalue")),
    "an array in short form": EDS.partition("[9130]")[0] + "\n".join(("[9130]", "ParameterName=x", "ObjectType=8",
        "DataType=4", "AccessType=ro", "PDOMapping=1", "CompactSubObj=1", "[9130Value]", "NrOfEntries=1", "1=0",
        "[9130Name]", "NrOfEntries=1", "1=a")),
}  # fmt: skip


@pytest.mark.parametrize("kind", ODD)
@pytest.mark.parametrize("read", [read_eds, read_emulated], ids=["host", "emulator"])
def test_what_describes_no_object_ends_no_reading(kind, read, tmp_path):
    assert ODD[kind] != EDS
    (tmp_path / "x.eds").write_text(ODD[kind])
    objects = read(tmp_path / "x.eds", 3)
    expected = read_eds(contract_folder() / "torque_sensor.eds", 3)
    for index in (0x1000, 0x1018, 0x1A00, 0x9130):
        found, wanted = (find_variable(each, index, 1) for each in (objects, expected))
        assert (found and found[1:]) == (wanted and wanted[1:])  # a short form has no names


def test_dummies_are_those_that_the_file_has(tmp_path):
    (tmp_path / "x.eds").write_text(ODD["some dummies, in hexadecimal"])
    objects = read_eds(tmp_path / "x.eds", 3)
    assert [index for index in range(1, 8) if index in objects] == [5]


def test_objects_and_names_stay_as_they_are():
    text = "[DeviceInfo]\nVendorName = a = b\nVendorNumber = 0x12\n\n"
    assert readable_eds(text.replace("x12", "x12 ; ours")) == text
