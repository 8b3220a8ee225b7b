"""The text of an EDS without what describes no object and would end its reading.

Vendors leave comments out that they announce, numbers of `[DeviceInfo]` empty, and dummies that they don't have.
canopen reads these sections first, and refuses the file for each of them.
"""

import re
from collections.abc import Iterator

_SECTION = re.compile(r"\s*\[([^\]]*)\]")
_DEVICE_NAMES = ("vendorname", "productname", "ordercode")
_DUMMIES = range(1, 8)


def readable_eds(text: str) -> str:
    """Leave out comments and device data that are no numbers, and complete the dummies."""
    return "\n".join(_readable(text.splitlines()))


def _readable(lines: list[str]) -> Iterator[str]:
    section = ""
    for line in lines:
        if head := _SECTION.match(line):
            section = head[1].strip().lower()
            if section != "comments":
                yield line
            if section == "dummyusage":
                yield from (f"Dummy{number:04d}={int(_has_dummy(lines, number))}" for number in _DUMMIES)
        elif section not in ("comments", "dummyusage") and (section != "deviceinfo" or _is_device_datum(line)):
            yield line


def _has_dummy(lines: list[str], number: int) -> bool:
    return any(re.fullmatch(rf"\s*Dummy{number:04d}\s*=\s*(0x0*)?1\s*(;.*)?", line, re.IGNORECASE) for line in lines)


def _is_device_datum(line: str) -> bool:
    key, is_pair, value = line.partition("=")
    if not is_pair or key.strip().lower() in _DEVICE_NAMES:
        return True
    try:
        int(value.partition(";")[0].strip(), 0)
    except ValueError:
        return False
    return True
