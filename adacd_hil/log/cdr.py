"""Message types: `.msg` text (`ros2msg`), the `cdr` layout that follows from it, and the numpy view of that layout.

A `cdr` payload is the four bytes 00 01 00 00 followed by the fields, little endian, each aligned to its own size
counted after those four bytes (OMG DDS-XTypes 7.4.1, PLAIN_CDR). Our own types hold numbers of fixed count only, so
a payload is one `struct.pack` and a whole topic is one `numpy.frombuffer`.

ROS field names are lower case, ours are not (`tau_J`): the type keeps ours, and the log stores them beside the
channel.
"""

import re
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from adacd_hil.log.errors import LogError

ENCAPSULATION = b"\x00\x01\x00\x00"
SEPARATOR = "=" * 80
TIME_TEXT = f"""{SEPARATOR}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""

_PRIMITIVES = {
    "bool": "?",
    "uint8": "B",
    "int8": "b",
    "uint16": "H",
    "int16": "h",
    "uint32": "I",
    "int32": "i",
    "uint64": "Q",
    "int64": "q",
    "float32": "f",
    "float64": "d",
}
_STAMP_END = 8
_MOST_PAYLOAD_BYTES = 1 << 20
_FIELD_LINE = re.compile(r"(?P<type>[a-z0-9]+)(\[(?P<size>[0-9]{1,9})\])?\s+(?P<name>[a-z][a-z0-9_]*)\s*(#.*)?")


class Member(NamedTuple):
    """One field of a message: `size` numbers of the ROS type `kind`. `constants` name the values that it can take."""

    name: str
    kind: str
    size: int = 1
    unit: str = ""
    meaning: str = ""
    constants: tuple[tuple[str, int], ...] = ()


def ros_field_name(name: str) -> str:
    """Spell `name` as ROS 2 demands: lower case, words separated by single underscores."""
    words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()
    spelled = re.sub(r"[^a-z0-9]+", "_", words).strip("_")
    return spelled if spelled[:1].isalpha() else f"n{spelled}"


def ros_message_name(name: str) -> str:
    """Spell `name` as ROS 2 demands: words run together, each with a capital."""
    return "".join(word[:1].upper() + word[1:] for word in re.split(r"[^A-Za-z0-9]+", name))


@dataclass(frozen=True)
class MessageType:
    """A message type: its name, the `.msg` text with everything it depends on, and our names of its fields."""

    name: str
    text: str
    fields: tuple[str, ...] = ()

    @cached_property
    def dtype(self) -> "np.dtype[Any]":
        """Describe one payload to numpy; raises LogError where its size isn't fixed."""
        return payload_dtype(self.text, self.fields)


def number_type(name: str, members: Iterable[Member]) -> MessageType:
    """Make the type of a message of numbers, preceded by the stamp. Raises LogError when two fields share a name."""
    lines = ["# Written by adacd-hil.", "builtin_interfaces/Time stamp"]
    names = []
    for member in members:
        names.append(member.name)
        lines += [f"{member.kind} {constant}={value}" for constant, value in member.constants]
        count = "" if member.size == 1 else f"[{member.size}]"
        unit = f" [{member.unit}]" if member.unit else ""
        comment = f"  # {member.name}{unit}: {member.meaning}" if member.meaning else f"  # {member.name}{unit}"
        lines.append(f"{member.kind}{count} {ros_field_name(member.name)}{comment}")
    spelled = [ros_field_name(field) for field in names]
    for field in spelled:
        if spelled.count(field) > 1 or field == "stamp":
            raise LogError(f"{name}: two fields are named {field} in ROS")
    return MessageType(name, "\n".join(lines) + "\n" + TIME_TEXT, tuple(names))


def body_struct(members: Iterable[Member], has_block: bool = False) -> struct.Struct:
    """Make the packer of what follows the stamp; with `has_block` it ends where a float64 block may begin."""
    pattern = "<"
    position = _STAMP_END
    for member in members:
        code = _PRIMITIVES[member.kind]
        padding = -position % struct.calcsize(code)
        pattern += f"{padding}x{member.size}{code}"
        position += padding + member.size * struct.calcsize(code)
    if has_block:
        pattern += f"{-position % 8}x"
    return struct.Struct(pattern)


def payload_dtype(text: str, fields: tuple[str, ...] = ()) -> "np.dtype[Any]":
    """Read the layout of a payload from its `.msg` text; `fields` are our names of the fields, if they differ.

    The stamp becomes `sec` and `nanosec`. Raises LogError for anything but a stamp and numbers of fixed count.
    """
    names = ["sec", "nanosec"]
    formats: list[Any] = ["<u4", "<u4"]
    offsets = [4, 8]
    position = _STAMP_END
    for kind, size, name in _field_lines(text):
        code = _PRIMITIVES[kind]
        position += -position % struct.calcsize(code)
        names.append(name)
        formats.append(("<" + code, (size,)) if size > 1 else "<" + code)
        offsets.append(len(ENCAPSULATION) + position)
        position += size * struct.calcsize(code)
    if fields:
        if len(fields) != len(names) - 2:
            raise LogError(f"a schema has {len(names) - 2} fields, {len(fields)} are named")
        names[2:] = fields
    if position > _MOST_PAYLOAD_BYTES:
        raise LogError(f"a schema describes {position} bytes, more than {_MOST_PAYLOAD_BYTES}")
    layout = {"names": names, "formats": formats, "offsets": offsets, "itemsize": len(ENCAPSULATION) + position}
    try:
        return np.dtype(layout)  # type: ignore[call-overload,no-any-return]
    except ValueError as error:
        raise LogError(f"a schema makes no layout: {error}") from None


def _field_lines(text: str) -> Iterator[tuple[str, int, str]]:
    """List (type, count, name) of the fields after the stamp."""
    own_lines = text.split(SEPARATOR, maxsplit=1)[0].splitlines()
    lines = [line.strip() for line in own_lines if line.strip() and not line.strip().startswith("#")]
    if not lines or lines[0] != "builtin_interfaces/Time stamp":
        raise LogError("a schema doesn't begin with its stamp")
    for line in lines[1:]:
        if "=" in line.split("#", maxsplit=1)[0]:
            continue  # a constant
        match = _FIELD_LINE.fullmatch(line)
        if match is None or match["type"] not in _PRIMITIVES:
            raise LogError(f"a schema has a field that isn't a number: {line}")
        yield match["type"], int(match["size"] or 1), match["name"]
