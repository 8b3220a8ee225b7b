"""Message types: `.msg` text (`ros2msg`), the `cdr` layout that follows from it, and the numpy view of that layout.

A `cdr` payload is the four bytes 00 01 00 00 followed by the fields, little endian, each aligned to its own size
counted after those four bytes (OMG DDS-XTypes 7.4.1, PLAIN_CDR). Our own types hold numbers of fixed count only, so
a payload is one `struct.pack` and a whole topic is one `numpy.frombuffer`.

ROS field names are lower case, ours are not (`tau_J`): the type keeps ours, and the log stores them beside the
channel.

Types of others have their text in `messages`: can_msgs/Frame, ros2_socketcan_msgs/FdFrame, sensor_msgs/JointState,
foxglove_msgs/Log. Each is packed here to its whole payload. Strings and counts that could vary are constant (no
frame_id, two joints), so that the sizes of classic frames and joint states are constant too. An FD frame is as long as
its data, as ros2_socketcan publishes it.
"""

import re
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from adacd_hil.log.log_files import LogError
from adacd_hil.records import JOINT_NAMES, JOINTS, Event
from adacd_hil.wire.frame_lengths import MAX_STANDARD_ID

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
_STAMP = struct.Struct("<II")
_STAMP_END = _STAMP.size
_MOST_PAYLOAD_BYTES = 1 << 20
_FIELD_LINE = re.compile(r"(?P<type>[a-z0-9]+)(\[(?P<size>[0-9]{1,9})\])?\s+(?P<name>[a-z][a-z0-9_]*)\s*(#.*)?")


class Member(NamedTuple):
    """One field of a message: `size` numbers of the ROS type `kind`.

    values: the numbers that the field can take; the schema names them by constants that begin with `prefix`, without
    one with the field's name in capitals.
    """

    name: str
    kind: str
    size: int = 1
    unit: str = ""
    meaning: str = ""
    values: type[IntEnum] | None = None
    prefix: str = ""

    @property
    def constants(self) -> tuple[tuple[str, int], ...]:
        """Names and values of the schema's constants for the values that the field can take."""
        return tuple((f"{self.prefix or self.name.upper()}_{value.name}", int(value)) for value in self.values or ())

    def value_of(self, number: Any) -> Any:
        """Convert a record's number to the field's value: a member of `values` if there are any.

        Several numbers become a tuple, unchecked. Raises ValueError for a number that `values` lack, or for NaN as an
        integer; OverflowError for inf as an integer.
        """
        if self.size > 1:
            return tuple(number)
        if self.values is not None:
            return self.values(number)
        return {"bool": bool, "float64": float}.get(self.kind, int)(number)


def ros_field_name(name: str) -> str:
    """Return `name` as ROS 2 demands of fields: lower case, words separated by single underscores.

    A capital after a small letter or digit begins a word. An `n` is put before a name that would not begin with a
    letter.
    """
    words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()
    spelled = re.sub(r"[^a-z0-9]+", "_", words).strip("_")
    return spelled if spelled[:1].isalpha() else f"n{spelled}"


def ros_message_name(name: str) -> str:
    """Return `name` as ROS 2 demands of types: words run together, each with a capital."""
    return "".join(word[:1].upper() + word[1:] for word in re.split(r"[^A-Za-z0-9]+", name))


@dataclass(frozen=True)
class MessageType:
    """A message type. name: "package/msg/Type"; text: its `.msg` text with all types that it contains.

    fields: our names of its fields, in order; () if they are those of the text.
    """

    name: str
    text: str
    fields: tuple[str, ...] = ()

    @cached_property
    def dtype(self) -> "np.dtype[Any]":
        """Numpy type of one payload. Raises LogError for fields other than a stamp and numbers of fixed count."""
        return payload_dtype(self.text, self.fields)


def foreign_type(name: str) -> MessageType:
    """Return a type of another package, as "package/msg/Type", by the file `messages/Type.msg`, whatever the package.

    Raises FileNotFoundError without that file.
    """
    file = resources.files("adacd_hil.log.types").joinpath("messages", f"{name.rpartition('/')[2]}.msg")
    return MessageType(name, file.read_text(encoding="utf-8"))


def number_type(name: str, members: Iterable[Member]) -> MessageType:
    """Return a message type whose fields are a stamp, then the members, all numbers. name: "package/msg/Type".

    Raises LogError if two fields have the same name in ROS, or one is named stamp.
    """
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
    """Return the struct that packs the members behind the stamp.

    has_block: it pads up to a float64 block that follows.
    """
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
    """Return the numpy type of a payload, from its `.msg` text; fields: our names of its fields, if they differ.

    The stamp becomes `sec` and `nanosec`. Raises LogError for anything but a stamp and numbers of fixed count, another
    number of `fields`, two fields of one name, and more than 1 MiB.
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
    """Yield (type, count, name) of the fields after the stamp, without constants.

    Raises LogError for a text that doesn't begin with a stamp, or a field that isn't a number.
    """
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


CAN_FRAME = foreign_type("can_msgs/msg/Frame")
FD_FRAME = foreign_type("ros2_socketcan_msgs/msg/FdFrame")
JOINT_STATE = foreign_type("sensor_msgs/msg/JointState")
LOG = foreign_type("foxglove_msgs/msg/Log")

_EMPTY_STRING = struct.pack("<I", 1) + b"\0"
_FRAME_ID = _EMPTY_STRING + b"\0\0\0"  # padded to the uint32 that follows
_CAN_FRAME_BODY = struct.Struct("<I???B8s")
CAN_FRAME_DTYPE = np.dtype(
    {
        "names": ["sec", "nanosec", "can_id", "is_remote", "is_extended", "is_error", "length", "data"],
        "formats": ["<u4", "<u4", "<u4", "?", "?", "?", "u1", ("u1", (8,))],
        "offsets": [4, 8, 20, 24, 25, 26, 27, 28],
        "itemsize": 36,
    }
)
END_OF_TIME_NS = 2**32 * 1_000_000_000
"""A stamp counts its seconds in 32 bits."""
MAX_DATA = 64
"""Bytes of data of the longest FD frame."""
_FD_FRAME_BODY = struct.Struct("<I??BxI")
FD_FRAME_DTYPE = np.dtype(
    {
        "names": ["sec", "nanosec", "can_id", "is_extended", "is_error", "length", "count", "data"],
        "formats": ["<u4", "<u4", "<u4", "?", "?", "u1", "<u4", ("u1", (MAX_DATA,))],
        "offsets": [4, 8, 20, 24, 25, 26, 28, 32],
        "itemsize": 32 + MAX_DATA,
    }
)
"""The longest payload; others end after `count` bytes of data."""

LEVELS = {"info": 2, "warning": 3, "error": 4}


def pack_stamp(time_ns: int) -> bytes:
    """Return a time as the 8 bytes of a builtin_interfaces/Time.

    Raises struct.error if negative or from END_OF_TIME_NS on.
    """
    return _STAMP.pack(*divmod(time_ns, 1_000_000_000))


def pack_can_frame(
    stamp: bytes,
    can_id: int,
    data: bytes,
    dlc: int,
    is_error: bool,
    is_remote: bool = False,
    is_extended: bool | None = None,
) -> bytes:
    """Return a frame as a payload of can_msgs/Frame.

    stamp: a packed builtin_interfaces/Time. data: up to 8 bytes, of which `dlc` count. is_error, is_remote: its flags.
    is_extended: it has a 29-bit identifier; None: if it is above 0x7FF.
    """
    is_extended = can_id > MAX_STANDARD_ID if is_extended is None else is_extended
    body = _CAN_FRAME_BODY.pack(can_id, is_remote, is_extended, is_error, dlc, data)
    return ENCAPSULATION + stamp + _FRAME_ID + body


def pack_fd_frame(stamp: bytes, can_id: int, data: bytes, is_error: bool, is_extended: bool | None = None) -> bytes:
    """Return an FD frame as a payload of ros2_socketcan_msgs/FdFrame.

    stamp: a packed builtin_interfaces/Time. data: up to 64 bytes. is_error: its flag. is_extended: it has a 29-bit
    identifier; None: if it is above 0x7FF.
    """
    length = len(data)
    is_extended = can_id > MAX_STANDARD_ID if is_extended is None else is_extended
    return ENCAPSULATION + stamp + _FRAME_ID + _FD_FRAME_BODY.pack(can_id, is_extended, is_error, length, length) + data


def _joint_state_parts() -> tuple[bytes, bytes]:
    """Return the constant bytes between stamp and position, and those before velocity and before effort."""
    names = struct.pack("<I", JOINTS)
    for name in JOINT_NAMES:
        text = name.encode() + b"\0"
        names += bytes(-len(names) % 4) + struct.pack("<I", len(text)) + text
    head = _FRAME_ID + names
    stamp_size = 8
    head += bytes(-(stamp_size + len(head)) % 4) + struct.pack("<I", JOINTS)
    head += bytes(-(stamp_size + len(head)) % 8)
    return head, struct.pack("<II", JOINTS, 0)


_JOINT_STATE_HEAD, _COUNT = _joint_state_parts()
_POSITION = len(ENCAPSULATION) + 8 + len(_JOINT_STATE_HEAD)
_STEP = 8 * JOINTS + len(_COUNT)
JOINT_STATE_DTYPE = np.dtype(
    {
        "names": ["sec", "nanosec", "q", "dq", "tau_J"],
        "formats": ["<u4", "<u4", *[("<f8", (JOINTS,))] * 3],
        "offsets": [4, 8, _POSITION, _POSITION + _STEP, _POSITION + 2 * _STEP],
        "itemsize": _POSITION + 2 * _STEP + 8 * JOINTS,
    }
)


def pack_joint_state(stamp: bytes, q: bytes, dq: bytes, tau_J: bytes) -> bytes:
    """Return a payload of sensor_msgs/JointState. stamp: a packed builtin_interfaces/Time.

    `q`, `dq`, `tau_J`: the bytes of float64 (2,), little endian.
    """
    return b"".join((ENCAPSULATION, stamp, _JOINT_STATE_HEAD, q, _COUNT, dq, _COUNT, tau_J))


def pack_log(stamp: bytes, event: Event) -> bytes:
    """Return an event as a payload of foxglove_msgs/Log; an unknown level becomes "error"."""
    payload = ENCAPSULATION + stamp + bytes((LEVELS.get(event.level, LEVELS["error"]),))
    for text in (event.message, event.name, ""):
        encoded = text.encode("utf-8", "replace") + b"\0"
        payload += bytes(-len(payload) % 4) + struct.pack("<I", len(encoded)) + encoded
    return payload + bytes(-len(payload) % 4) + struct.pack("<I", 0)
