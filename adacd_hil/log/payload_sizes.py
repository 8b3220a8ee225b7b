"""Whose schema a channel has, and how long its payloads are."""

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
    """Return how long the payloads of a channel are, where we wrote its schema and they have one size."""
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
    """Tell whether a channel has a schema of ours, to the letter."""
    is_named = channel.message_encoding == "cdr" and schema.encoding == "ros2msg" and schema.name == own.name
    return is_named and schema.data == own.text.encode()
