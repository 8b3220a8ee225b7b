"""The rules on what messages hold: the order of their times, and cdr payloads as their schemas describe them."""

import contextlib

import numpy as np
from mcap.records import Channel, Schema

from adacd_hil.log.cdr import ENCAPSULATION, MessageType, payload_dtype
from adacd_hil.log.check.definition_checks import DefinitionCheck
from adacd_hil.log.check.findings import Findings
from adacd_hil.log.check.ros_text import text_problem
from adacd_hil.log.errors import LogError
from adacd_hil.log.mcap.chunk_contents import Contents
from adacd_hil.log.mcap.mcap_records import MESSAGE_HEAD
from adacd_hil.log.ros_types import (
    CAN_FRAME,
    CAN_FRAME_DTYPE,
    FD_FRAME,
    FD_FRAME_DTYPE,
    JOINT_STATE,
    JOINT_STATE_DTYPE,
    LOG,
    is_log,
)

_CHANNEL_NUMBERS = 2**16
_ANY = -1
_OWN_TEXT = b"# Written by adacd-hil."
_LAST_ENCAPSULATION = 0x0D
"""DDS-XTypes 7.6.3.1.2."""
_SIZES = ((CAN_FRAME, CAN_FRAME_DTYPE.itemsize), (JOINT_STATE, JOINT_STATE_DTYPE.itemsize))


class ContentCheck:
    """Watches the messages of a file."""

    def __init__(self, findings: Findings) -> None:
        self._findings = findings
        self._described: set[int] = set()
        self._read: set[int] = set()  # schemas
        self._latest = np.zeros(_CHANNEL_NUMBERS, np.uint64)  # log time of each channel
        self._sizes = np.full(_CHANNEL_NUMBERS, _ANY, np.int64)
        self._is_cdr = np.zeros(_CHANNEL_NUMBERS, np.bool_)
        self._fd_frames: set[int] = set()
        self._logs: set[int] = set()

    def schema(self, schema: Schema, offset: int) -> None:
        """Read the text of a schema."""
        if schema.encoding == "ros2msg" and schema.id not in self._read:
            self._read.add(schema.id)
            if problem := text_problem(schema.data):
                self._findings.add("schema-text", f"schema {schema.id} ({schema.name}): {problem}", offset)

    def messages(self, contents: Contents, definitions: DefinitionCheck, offset: int) -> None:
        """Take in the messages of a chunk."""
        for number in np.unique(contents.channels).tolist():
            if number not in self._described and number in definitions.channels:
                channel = definitions.channels[number]
                self._describe(channel, definitions.schemas.get(channel.schema_id))
        self._check_order(contents, definitions, offset)
        self._check_payloads(contents, definitions, offset)

    def _describe(self, channel: Channel, schema: Schema | None) -> None:
        """Note what the payloads of a channel must be."""
        self._described.add(channel.id)
        self._is_cdr[channel.id] = channel.message_encoding == "cdr"
        self._sizes[channel.id] = _ANY if (size := payload_size(channel, schema)) is None else size
        if schema is not None and _is_own(channel, schema, FD_FRAME):
            self._fd_frames.add(channel.id)
        elif schema is not None and _is_own(channel, schema, LOG):
            self._logs.add(channel.id)

    def _check_order(self, contents: Contents, definitions: DefinitionCheck, offset: int) -> None:
        order = np.argsort(contents.channels, kind="stable")
        channels, times = contents.channels[order], contents.log_times[order]
        is_first = np.concatenate(([True], channels[1:] != channels[:-1]))
        before = np.concatenate((times[:1], times[:-1]))
        before[is_first] = self._latest[channels[is_first]]
        backwards = np.flatnonzero(times < before)
        if len(backwards):
            number = int(channels[backwards[0]])
            channel = definitions.channels.get(number)
            back_ns = int(before[backwards[0]]) - int(times[backwards[0]])
            text = (
                f"{len(backwards)} messages of a chunk are earlier than the one before in their channel, the first on "
                f"{channel.topic if channel else number} by {back_ns} ns"
            )
            self._findings.add("order", text, offset)
        np.maximum.at(self._latest, channels, times)

    def _check_payloads(self, contents: Contents, definitions: DefinitionCheck, offset: int) -> None:
        data = np.frombuffer(contents.data, np.uint8)
        sizes = contents.ends - contents.starts - MESSAGE_HEAD
        is_cdr = self._is_cdr[contents.channels]
        expected = self._sizes[contents.channels]
        is_wrong = is_cdr & ((sizes < len(ENCAPSULATION)) | ((expected != _ANY) & (sizes != expected)))
        looked_at = np.flatnonzero(is_cdr & ~is_wrong)
        heads = data[contents.starts[looked_at, np.newaxis] + np.arange(MESSAGE_HEAD, MESSAGE_HEAD + 4)]
        is_wrong[looked_at] = (heads[:, 0] != 0) | (heads[:, 1] > _LAST_ENCAPSULATION)
        for place in np.flatnonzero(np.isin(contents.channels, [*self._fd_frames, *self._logs]) & ~is_wrong).tolist():
            payload = contents.payload(place)
            is_fd = int(contents.channels[place]) in self._fd_frames
            is_wrong[place] = not (_is_fd_frame(payload) if is_fd else is_log(payload))
        for place in np.flatnonzero(is_wrong)[:1].tolist():
            channel = definitions.channels[int(contents.channels[place])]
            count = np.count_nonzero(is_wrong)
            text = f"{count} messages of a chunk aren't as their schemas say, the first on {channel.topic}"
            self._findings.add("cdr", text, offset)


def payload_size(channel: Channel, schema: Schema | None) -> int | None:
    """Return how long the payloads of a channel are, where we wrote its schema and they have one size."""
    if schema is None or channel.message_encoding != "cdr":
        return None
    for own, size in _SIZES:
        if _is_own(channel, schema, own):
            return size
    if schema.encoding == "ros2msg" and schema.data.startswith(_OWN_TEXT):
        with contextlib.suppress(LogError):  # its size varies
            return payload_dtype(schema.data.decode("utf-8", "replace")).itemsize
    return None


def _is_own(channel: Channel, schema: Schema, own: MessageType) -> bool:
    is_named = channel.message_encoding == "cdr" and schema.encoding == "ros2msg" and schema.name == own.name
    return is_named and schema.data == own.text.encode()


def _is_fd_frame(payload: bytes) -> bool:
    assert FD_FRAME_DTYPE.fields is not None
    head, place = int(FD_FRAME_DTYPE.fields["data"][1]), int(FD_FRAME_DTYPE.fields["count"][1])
    return len(payload) >= head and len(payload) == head + int.from_bytes(payload[place : place + 4], "little")
