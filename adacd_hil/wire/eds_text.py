"""Repairs the text of an EDS, where the files of makers differ from what canopen reads.

Vendors announce comments and omit them, leave numbers of `[DeviceInfo]` empty, list dummies that don't exist, write
sub-indices before their object or in short form (CompactSubObj), and mind no case. Source: CiA 306.
"""

import configparser
import io

_DEVICE_NAMES = ("VendorName", "ProductName", "OrderCode")
_DUMMIES = tuple(f"Dummy{number:04d}" for number in range(1, 8))
_KEYS = ("ParameterName", "ObjectType", "DataType", "AccessType", "DefaultValue", "ParameterValue", "PDOMapping")
_SPELLINGS = {key.lower(): key for key in _KEYS}
_COUNT = {"ParameterName": "Number of entries", "DataType": "5", "AccessType": "ro"}


def readable_eds(text: str) -> str:
    """Return the text as canopen reads it, without `[Comments]` and unreadable numbers of `[DeviceInfo]`.

    Objects come before their sub-indices; CompactSubObj becomes sub-indices. `[DummyUsage]`, if present, has exactly
    the dummies 1 to 7, each used or not as in the text. Raises configparser.Error for a text that is no INI file.
    """
    given, eds = _parser(), _parser()
    given.read_string(text, "object dictionary.eds")
    given.remove_section("Comments")
    for name in sorted(given.sections(), key=len):  # an object before its sub-indices
        if name not in given:  # removed below
            continue
        rows = dict(given[name])
        if name == "DeviceInfo":
            rows = {key: value for key, value in rows.items() if key in _DEVICE_NAMES or _number(value) is not None}
        elif name.lower() == "dummyusage":
            rows = {key: str(int(_number(rows.get(key, "")) == 1)) for key in _DUMMIES}
        subs = _number(rows.pop("CompactSubObj", "")) or 0
        eds[name.replace("SUB", "sub")] = rows
        if subs:
            default, at = rows.get("DefaultValue", ""), f"{name}Value"
            eds[f"{name}sub0"] = _COUNT | {"DefaultValue": str(subs)}
            for sub in range(1, min(subs, 254) + 1):
                eds[f"{name}sub{sub:X}"] = rows | {"DefaultValue": given.get(at, str(sub), fallback=default)}
            given.remove_section(f"{name}Name")
    stream = io.StringIO()
    eds.write(stream)
    return stream.getvalue()


def _parser() -> configparser.RawConfigParser:
    parser = configparser.RawConfigParser(inline_comment_prefixes=(";",))
    parser.optionxform = lambda name: _SPELLINGS.get(name.lower(), name)  # type: ignore[assignment,method-assign]
    return parser


def _number(text: str) -> int | None:
    try:
        return int(text, 0)
    except ValueError:
        return None
