"""Payload size of a channel, if this package defines its schema."""

import contextlib

from mcap.records import Channel, Schema

from adacd_hil.log.log_files import LogError
from adacd_hil.log.types.message_types import (
    CAN_FRAME,
    CAN_FRAME_DTYPE,
    JOINT_STATE,
    JOINT_STATE_DTYPE,
    MessageType,
    payload_dtype,
)

_OWN_TEXT = b"# Written by adacd-hil."
_SIZES = ((CAN_FRAME, CAN_FRAME_DTYPE.itemsize), (JOINT_STATE, JOINT_STATE_DTYPE.itemsize))


def payload_size(channel: Channel, schema: Schema | None) -> int | None:
    """Return the payload size of a channel, bytes.

    None if this package doesn't define its schema, or its payloads vary in size.
    """
    if schema is None or channel.message_encoding != "cdr":
        return None
    for own, size in _SIZES:
        if is_own(channel, schema, own):
            return size
    if schema.encoding == "ros2msg" and schema.data.startswith(_OWN_TEXT):
        with contextlib.suppress(LogError):  # its size varies
            return payload_dtype(schema.data.decode("utf-8", "replace")).itemsize
    return None


def is_own(channel: Channel, schema: Schema, own: MessageType) -> bool:
    """Return whether a channel is cdr and its schema has name and text of `own`, a message type that we write."""
    is_named = channel.message_encoding == "cdr" and schema.encoding == "ros2msg" and schema.name == own.name
    return is_named and schema.data == own.text.encode()
