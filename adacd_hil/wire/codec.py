"""The cyclic codec: bytes to physical values and back, generated at start from the DBC.

Only what the hot path can do quickly is accepted: little-endian integers of 8, 16, 32 or 64 bits on byte borders, and
bit fields within one byte. A DBC that asks for more is refused with the signal's name. A frame is decoded all or
nothing: length first, then (for protected messages) counter and CRC, by `adacd_hil.wire.e2e`.
"""

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import cantools
from cantools.database.can import Database, Message, Signal
from cantools.database.errors import Error as DatabaseError

from adacd_hil.wire.e2e import HEADER_BYTES, E2eReceiver, E2eSender

_FORMATS = {(8, False): "B", (8, True): "b", (16, False): "H", (16, True): "h"} | {
    (32, False): "I",
    (32, True): "i",
    (64, False): "Q",
    (64, True): "q",
}
E2E_SIGNALS = ("e2e_crc", "e2e_counter", "e2e_status")


class CodecError(ValueError):
    """A DBC that can't serve as the contract, or a value that doesn't fit its signal; one line."""


@dataclass(frozen=True)
class SignalCodec:
    """One signal: where its raw integer is, and `value = raw * scale + offset` in `unit`."""

    name: str
    unit: str
    scale: float
    offset: float
    container: int
    shift: int
    mask: int  # 0: the whole container
    raw_low: int
    raw_high: int

    def to_raw(self, value: float) -> int:
        """Quantise a physical value. Raises CodecError when it doesn't fit."""
        raw = round((value - self.offset) / self.scale)
        if not self.raw_low <= raw <= self.raw_high:
            bound = self.raw_high if raw > self.raw_high else self.raw_low
            raise CodecError(f"{self.name} = {value:g} {self.unit} exceeds {bound * self.scale + self.offset:g}")
        return raw


class MessageCodec:
    """Encodes and decodes the frames of one message."""

    def __init__(self, message: Message) -> None:
        self.name: str = message.name
        self.can_id: int = message.frame_id
        self.length: int = message.length
        self.senders: tuple[str, ...] = tuple(message.senders)
        self.data_ids = _data_ids(message)
        ordered = sorted(message.signals, key=lambda signal: signal.start)
        self._struct, self.signals = _lay_out(message, ordered)
        self._signed = [signal.is_signed for signal in ordered]
        first = len(E2E_SIGNALS) if self.is_protected else 0
        self.values = self.signals[first:]
        """The signals without the end-to-end header."""
        # The hot path: values that each fill a container of their own need no shifting.
        is_plain = all(signal.mask == 0 for signal in self.values)
        self._scales = tuple((signal.scale, signal.offset) for signal in self.values)
        self._body = struct.Struct("<" + _body_format(ordered[first:])) if is_plain else None
        self._body_offset = HEADER_BYTES if self.is_protected else 0

    @property
    def is_protected(self) -> bool:
        """Whether the frames carry an end-to-end header."""
        return bool(self.data_ids)

    @property
    def header_bytes(self) -> int:
        """Count the bytes of the end-to-end header."""
        return HEADER_BYTES if self.is_protected else 0

    def sender(self) -> E2eSender:
        """Make the end-to-end sender of this message."""
        return E2eSender(self.data_ids)

    def receiver(self) -> E2eReceiver:
        """Make the end-to-end receiver of this message."""
        return E2eReceiver(self.data_ids)

    def encode(self, *values: float) -> bytearray:
        """Encode physical values in the order of `values`; the end-to-end header is left zero.

        Raises CodecError when a value doesn't fit or the number of values is wrong.
        """
        if len(values) != len(self.values):
            raise CodecError(f"{self.name} takes {len(self.values)} values, {len(values)} given")
        containers = [0] * len(self._struct.format.strip("<"))
        for signal, value in zip(self.values, values, strict=True):
            raw = signal.to_raw(value)
            containers[signal.container] |= (raw & signal.mask) << signal.shift if signal.mask else raw
        return bytearray(self._struct.pack(*containers))

    def decode(self, data: bytes) -> tuple[float, ...]:
        """Decode all signals to physical values, in the order of `signals`.

        Raises CodecError when the length is wrong.
        """
        if len(data) != self.length:
            raise CodecError(f"{self.name} has {len(data)} bytes, {self.length} expected")
        containers = self._struct.unpack(data)
        values = []
        for signal, is_signed in zip(self.signals, self._signed, strict=True):
            raw = containers[signal.container]
            if signal.mask:
                raw = (raw >> signal.shift) & signal.mask
                if is_signed and raw > signal.mask >> 1:
                    raw -= signal.mask + 1
            values.append(raw * signal.scale + signal.offset)
        return tuple(values)

    def decode_values(self, data: bytes) -> tuple[float, ...]:
        """Decode what follows the end-to-end header, in the order of `values`; `data` must have the right length."""
        if self._body is None:
            return self.decode(data)[len(self.signals) - len(self.values) :]
        raw = self._body.unpack_from(data, self._body_offset)
        return tuple([r * scale + offset for r, (scale, offset) in zip(raw, self._scales, strict=True)])

    def encode_raw(self, *raw: int) -> bytearray:
        """Encode raw integers in the order of `values`, each of which must fill its container; for the hot path."""
        if self._body is None:
            raise CodecError(f"{self.name} has bit fields: encode physical values instead")
        frame = bytearray(self.length)
        self._body.pack_into(frame, self._body_offset, *raw)
        return frame


def _body_format(signals: list[Signal]) -> str:
    return "".join(_FORMATS[(signal.length, signal.is_signed)] for signal in signals)


def _data_ids(message: Message) -> bytes:
    attributes = message.dbc.attributes if message.dbc else {}
    text = str(attributes["E2EDataIdList"].value) if "E2EDataIdList" in attributes else ""
    if not text:
        return b""
    try:
        ids = bytes.fromhex(text)
    except ValueError:
        raise CodecError(f"{message.name}: E2EDataIdList = {text!r} is not hexadecimal") from None
    if len(ids) != 16:
        raise CodecError(f"{message.name}: E2EDataIdList has {len(ids)} bytes, 16 expected")
    names = tuple(signal.name for signal in sorted(message.signals, key=lambda signal: signal.start))
    if names[: len(E2E_SIGNALS)] != E2E_SIGNALS:
        raise CodecError(f"{message.name}: a protected message begins with {', '.join(E2E_SIGNALS)}")
    return ids


def _lay_out(message: Message, signals: list[Signal]) -> tuple[struct.Struct, tuple[SignalCodec, ...]]:
    """Place the signals in containers on byte borders that cover the frame without gaps."""
    format_text = "<"
    end_bit = 0
    containers = 0
    codecs = []
    for signal in signals:
        where = f"{message.name}.{signal.name}"
        if signal.byte_order != "little_endian" or signal.is_float or signal.is_multiplexer:
            raise CodecError(f"{where}: only plain little-endian integers can be cyclic")
        is_whole = signal.start % 8 == 0 and signal.length in (8, 16, 32, 64)
        if is_whole and signal.start == end_bit:
            format_text += _FORMATS[(signal.length, signal.is_signed)]
            container, shift, mask = containers, 0, 0
            containers += 1
            end_bit += signal.length
        elif signal.start % 8 + signal.length <= 8 and signal.start // 8 * 8 in (end_bit, end_bit - 8):
            if signal.start // 8 * 8 == end_bit:
                format_text += "B"
                containers += 1
                end_bit += 8
            container, shift, mask = containers - 1, signal.start % 8, (1 << signal.length) - 1
        else:
            raise CodecError(f"{where}: bits {signal.start}+{signal.length} overlap, leave a gap or cross a byte")
        half = 1 << (signal.length - 1)
        low, high = (-half, half - 1) if signal.is_signed else (0, 2 * half - 1)
        scale, offset, unit = float(signal.scale), float(signal.offset), signal.unit or ""
        codecs.append(SignalCodec(signal.name, unit, scale, offset, container, shift, mask, low, high))
    if end_bit != message.length * 8:
        raise CodecError(f"{message.name}: signals cover {end_bit} of {message.length * 8} bits")
    return struct.Struct(format_text), tuple(codecs)


class Codec:
    """All messages of one DBC."""

    def __init__(self, database: Database, path: Path, text: bytes) -> None:
        self.path = path
        self.text = text
        self.messages = {message.name: MessageCodec(message) for message in database.messages}
        self.by_id = {message.can_id: message for message in self.messages.values()}
        attributes = database.dbc.attributes if database.dbc else {}
        if "WireVersion" not in attributes:
            raise CodecError("the DBC has no WireVersion attribute")
        self.wire_version = int(attributes["WireVersion"].value)
        self.layout_digest = zlib.crc32(_describe(self.messages).encode())
        """CRC-32 of every identifier, length, signal place, scale and data id; comments don't count."""

    def message(self, name: str) -> MessageCodec:
        """Return a message by name. Raises CodecError when the DBC lacks it."""
        try:
            return self.messages[name]
        except KeyError:
            raise CodecError(f"message {name} is missing in the DBC") from None

    def node_id(self, message_name: str) -> int:
        """Return the node id of a CANopen message: the low seven bits of its identifier."""
        return self.message(message_name).can_id & 0x7F


def _describe(messages: dict[str, MessageCodec]) -> str:
    lines = []
    for message in sorted(messages.values(), key=lambda message: message.can_id):
        lines.append(f"{message.can_id:x} {message.name} {message.length} {message.data_ids.hex()}")
        lines.extend(
            f" {s.name} {s.container} {s.shift} {s.mask} {s.raw_low} {s.scale!r} {s.offset!r}" for s in message.signals
        )
    return "\n".join(lines)


def contract_folder() -> Path:
    """Return the folder of the DBC and EDS files: beside the package when installed, else in the source tree."""
    package = Path(__file__).resolve().parent.parent
    installed = package / "dbc"
    return installed if installed.is_dir() else package.parent / "dbc"


def load_codec(path: Path | None = None) -> Codec:
    """Generate the codec from a DBC (default: the one that comes with the package). Raises CodecError."""
    path = path or contract_folder() / "arm.dbc"
    try:
        text = path.read_bytes()
    except OSError as error:
        raise CodecError(f"DBC {path}: {error.strerror}") from None
    return parse_codec(text, path)


def parse_codec(text: bytes, path: Path) -> Codec:
    """Generate the codec from the text of a DBC; `path` is where it is, or would be. Raises CodecError."""
    try:
        database = cantools.database.load_string(text.decode("utf-8"), "dbc")
    except (UnicodeDecodeError, DatabaseError) as error:
        reason = " ".join(str(error).split())
        raise CodecError(f"DBC {path} can't be read: {reason}") from None
    if not isinstance(database, Database):
        raise CodecError(f"DBC {path} holds no CAN messages")
    try:
        return Codec(database, path, text)
    except CodecError as error:
        raise CodecError(f"DBC {path}: {error}") from None
