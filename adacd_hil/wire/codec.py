"""The cyclic codec: bytes to physical values, and raw integers to bytes, by the tables of a contract.

A frame is decoded all or nothing: `adacd_hil.wire.e2e` first checks its length, then (for protected messages) CRC and
counter. `adacd_hil.wire.dbc_contract` makes a codec from a DBC.
"""

import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from adacd_hil.wire.e2e import PROFILES, E2eReceiver, E2eSender, ProtectedReceiver, Protection
from adacd_hil.wire.frame_lengths import CLASSIC_BYTES
from adacd_hil.wire.message_table import MessageTable, SignalCodec, container_struct

if TYPE_CHECKING:
    from cantools.database.can import Database


class CodecError(ValueError):
    """A DBC that can't serve as the contract, or a frame that doesn't fit its message; one line."""


class MessageCodec(MessageTable):
    """Encodes and decodes the frames of one message."""

    def __init__(
        self,
        name: str,
        can_id: int,
        length: int,
        signals: tuple[SignalCodec, ...],
        protection: Protection,
        data_ids: bytes,
        senders: tuple[str, ...],
    ) -> None:
        """Take a message's signals, and the end-to-end protection of its frames.

        data_ids: of the CRC, a byte for each counter, or a number, its low byte first; by the protection. senders:
        names of the nodes that send the message.
        """
        super().__init__(name, can_id, length, signals)
        self.protection, self.data_ids, self.senders = protection, data_ids, senders
        self.profile = PROFILES.get(protection)
        """Layout and rules of the end-to-end header; None without protection."""
        self.values = signals[0 if self.profile is None else len(self.profile.signals) :]
        """The signals behind the end-to-end header."""
        # `encode_raw` packs values that each fill a container of their own.
        is_plain = all(signal.mask == 0 for signal in self.values)
        self._body = container_struct(self.values) if is_plain else None
        self._body_offset = self.header_bytes

    @property
    def is_protected(self) -> bool:
        """Whether the frames carry an end-to-end header."""
        return self.protection is not Protection.NONE

    @property
    def header_bytes(self) -> int:
        """Length of the end-to-end header in bytes; 0 without protection."""
        return 0 if self.profile is None else self.profile.header_bytes

    @property
    def is_fd(self) -> bool:
        """Whether the frames are CAN FD; frames of up to 8 bytes are classic on every bus."""
        return self.length > CLASSIC_BYTES

    def place(self, name: str) -> int:
        """Return the index of a signal in `values`. Raises CodecError if there is no such signal."""
        for place, signal in enumerate(self.values):
            if signal.name == name:
                return place
        raise CodecError(f"{self.name} has no signal {name}")

    def sender(self) -> E2eSender:
        """Return a new end-to-end sender of this message, its counter at 0; without protection it changes no frame."""
        return E2eSender(self.profile, self.data_ids)

    def receiver(self) -> E2eReceiver:
        """Return a new end-to-end receiver of this message; without protection it accepts every frame as OK."""
        profile = self.profile
        return E2eReceiver() if profile is None else ProtectedReceiver(profile, self.data_ids, self.length)

    def decode(self, data: bytes) -> tuple[float, ...]:
        """Return the physical values of all signals, in the order of `signals`.

        Raises CodecError when the length is wrong.
        """
        if len(data) != self.length:
            raise CodecError(f"{self.name} has {len(data)} bytes, {self.length} expected")
        return super().decode(data)

    def decode_values(self, data: bytes) -> tuple[float, ...]:
        """Return physical values of the signals in `values`, in this order. Raises CodecError for a wrong length."""
        return self.decode(data)[len(self.signals) - len(self.values) :]

    def takes(self, length: int) -> bool:
        """Return whether a frame of so many bytes can be decoded."""
        return length == self.length

    def decode_named(self, data: bytes) -> tuple[tuple[str, float, str], ...]:
        """Return (name, value, unit) of each signal behind the end-to-end header.

        Raises CodecError for a wrong length.
        """
        return tuple(
            (signal.name, value, signal.unit)
            for signal, value in zip(self.values, self.decode_values(data), strict=True)
        )

    def encode_raw(self, *raw: int) -> bytearray:
        """Return a frame of raw integers in the order of `values`, the end-to-end header left zero; for the hot path.

        Raises CodecError if `values` has bit fields, struct.error for a wrong number of integers, and for one that
        doesn't fit its container.
        """
        if self._body is None:
            raise CodecError(f"{self.name} has bit fields, which no raw integers are packed into")
        frame = bytearray(self.length)
        self._body.pack_into(frame, self._body_offset, *raw)
        return frame


class Codec:
    """All messages of one contract. path, text, database: of its DBC, as a file, as bytes, and as cantools reads it."""

    def __init__(
        self, messages: Iterable[MessageCodec], wire_version: int, database: "Database", path: Path, text: bytes
    ) -> None:
        self.path = path
        self.text = text
        self.database = database
        self.messages = {message.name: message for message in messages}
        self.by_id = {message.can_id: message for message in self.messages.values()}
        self.is_fd = any(message.is_fd for message in self.messages.values())
        """Whether any message needs CAN FD."""
        self.wire_version = wire_version
        self.layout_digest = zlib.crc32(_describe(self.messages).encode())
        """CRC-32 of every message's name, identifier, length, protection and data ids, and every signal's name, place,
        sign, scale and offset; of no other property. Of a signal that fills its container, the place is the container's
        index: of unsigned ones the digest doesn't tell the sizes."""

    def message(self, name: str) -> MessageCodec:
        """Return a message by name. Raises CodecError when the DBC lacks it."""
        try:
            return self.messages[name]
        except KeyError:
            raise CodecError(f"message {name} is missing in the DBC") from None

    def node_id(self, message_name: str) -> int:
        """Return the node id of a CANopen message by name: the low seven bits of its identifier.

        Raises CodecError when the DBC lacks the message.
        """
        return self.message(message_name).can_id & 0x7F


def _describe(messages: dict[str, MessageCodec]) -> str:
    """Return the text whose CRC-32 is `Codec.layout_digest`: a line per message and per signal, by identifier."""
    lines = []
    for message in sorted(messages.values(), key=lambda message: message.can_id):
        # A list of ids alone says Profile 2, as in a DBC.
        code = "" if message.protection in (Protection.NONE, Protection.PROFILE_2) else f"{message.protection.value} "
        lines.append(f"{message.can_id:x} {message.name} {message.length} {code}{message.data_ids.hex()}")
        lines.extend(
            f" {s.name} {s.container} {s.shift} {s.mask} {s.raw_low} {s.scale!r} {s.offset!r}" for s in message.signals
        )
    return "\n".join(lines)
