"""Repairs the text of an EDS: removes or completes sections that make canopen refuse the file.

Vendors announce comments and omit them, leave numbers of `[DeviceInfo]` empty, and list dummies that don't exist.
canopen reads these sections first, and fails on each of them.
"""

import re
from collections.abc import Iterator

_SECTION = re.compile(r"\s*\[([^\]]*)\]")
_DEVICE_NAMES = ("vendorname", "productname", "ordercode")
_DUMMIES = range(1, 8)
_USED_DUMMY = re.compile(r"\s*Dummy(\d{4})\s*=\s*(0x0*)?1\s*(;.*)?", re.IGNORECASE)


def readable_eds(text: str) -> str:
    """Return the text without `[Comments]` and unreadable numbers of `[DeviceInfo]`.

    `[DummyUsage]`, if present, is written anew with exactly the dummies 1 to 7, each used or not as in the text.
    """
    return "\n".join(_readable(text.splitlines()))


def _readable(lines: list[str]) -> Iterator[str]:
    """Yield the lines that `readable_eds` keeps, and those of `[DummyUsage]` that it writes."""
    section = ""
    for line in lines:
        if head := _SECTION.match(line):
            section = head[1].strip().lower()
            if section != "comments":
                yield line
            if section == "dummyusage":
                used = {int(dummy[1]) for line in lines if (dummy := _USED_DUMMY.fullmatch(line))}
                yield from (f"Dummy{number:04d}={int(number in used)}" for number in _DUMMIES)
        elif section not in ("comments", "dummyusage") and (section != "deviceinfo" or _is_device_datum(line)):
            yield line


def _is_device_datum(line: str) -> bool:
    """Return whether canopen can read a line of `[DeviceInfo]`: no entry, a name, or an entry with an integer."""
    key, is_pair, value = line.partition("=")
    if not is_pair or key.strip().lower() in _DEVICE_NAMES:
        return True
    try:
        int(value.partition(";")[0].strip(), 0)
    except ValueError:
        return False
    return True
