"""Messages of a log unpacked: contacts and events."""

import struct
from typing import Any

import numpy as np

from adacd_hil.log.types.message_types import LEVELS
from adacd_hil.log.types.topics import CONTACT
from adacd_hil.records import ContactReport, Event

_CONTACT_DTYPE = CONTACT.channel().type.dtype
_LEVEL_NAMES = {number: name for name, number in LEVELS.items()} | {0: "info", 1: "info", 5: "error"}


def contact_report(record: Any) -> ContactReport:
    """Convert a record of /contact to a report; a field that an older log lacks gets its default.

    Raises ValueError or OverflowError for a value that its field can't have, such as an unknown level.
    """
    members = [member for member in CONTACT.head if member.name in (record.dtype.names or ())]
    return ContactReport(**{member.name: member.value_of(record[member.name].tolist()) for member in members})


def unpack_contact(body: bytes) -> ContactReport:
    """Return the report in the bytes of `pack_contact`.

    Raises ValueError if they are cut, ValueError or OverflowError for a value that its field can't have.
    """
    head = bytes(_CONTACT_DTYPE.itemsize - CONTACT.body.size)
    return contact_report(np.frombuffer(head + body, _CONTACT_DTYPE)[0])


def is_log(payload: bytes) -> bool:
    """Return whether `unpack_log` can unpack a payload."""
    try:
        unpack_log(payload)
    except (struct.error, IndexError):
        return False
    return True


def log_time_ns(payload: bytes) -> int:
    """Return the stamp of an event's payload, ns, in the file's time.

    Raises struct.error if the payload is cut before it.
    """
    sec, nanosec = struct.unpack_from("<II", payload, 4)
    return int(sec) * 1_000_000_000 + int(nanosec)


def unpack_log(payload: bytes) -> Event:
    """Return the event in a payload of foxglove_msgs/Log; an unknown level becomes "error".

    Raises struct.error or IndexError if the payload is cut before the end of the event's name.
    """
    level = _LEVEL_NAMES.get(payload[12], "error")
    position = 13
    texts = []
    for _ in range(2):
        position += -position % 4
        (size,) = struct.unpack_from("<I", payload, position)
        position += 4
        (text,) = struct.unpack_from(f"{size}s", payload, position)
        texts.append(text.rstrip(b"\0").decode("utf-8", "replace"))
        position += size
    return Event(level, texts[1], texts[0])
