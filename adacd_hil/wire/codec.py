"""The cyclic codec: bytes to physical values and back, generated at start from the DBC.

The codec accepts only layouts that the hot path decodes fast: little-endian integers of 8, 16, 32 or 64 bits on byte
borders, and bit fields within one byte. Any other layout is refused with the signal's name. A frame is decoded all or
nothing: `adacd_hil.wire.e2e` first checks its length, then (for protected messages) CRC and counter.

A message of more than 8 bytes is a CAN FD frame, marked in the DBC by VFrameFormat; its length must have a data length
code in ISO 11898-1.
"""

import functools
import logging
import re
import zlib
from pathlib import Path

import cantools
from cantools.database.can import Database, Message, Signal

from adacd_hil.file_access import read_input
from adacd_hil.wire.e2e import (
    PROFILES,
    E2eProfile,
    E2eReceiver,
    E2eSender,
    Protection,
)
from adacd_hil.wire.frame_lengths import CLASSIC_BYTES, FD_LENGTHS
from adacd_hil.wire.message_table import MessageTable, SignalCodec, container_struct

logging.getLogger("cantools").addHandler(logging.NullHandler())  # our errors replace its output on the terminal

_MOST_MESSAGES = 1000
"""Most messages of a contract: its budget takes 3 s to compute, and four times that for twice as many."""
WIRE_VERSION = "WireVersion"
"""The DBC attribute that marks a contract."""


class CodecError(ValueError):
    """A DBC that can't serve as the contract, or a value that doesn't fit its signal; one line."""


class MessageCodec(MessageTable):
    """Encodes and decodes the frames of one message."""

    def __init__(self, message: Message) -> None:
        _check_length(message)
        self.protection, self.data_ids = _protection(message)
        """Protection of the frames; data ids: a byte for each counter, or a number, its low byte first."""
        self.profile = PROFILES.get(self.protection)
        """Layout, sender and receiver of the end-to-end header; None without protection."""
        super().__init__(message.name, message.frame_id, message.length, _lay_out(message))
        self.senders: tuple[str, ...] = tuple(message.senders)
        self.values = self.signals[0 if self.profile is None else len(self.profile.signals) :]
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
        """Return a new end-to-end sender of this message; without protection it leaves frames unchanged."""
        return E2eSender() if self.profile is None else self.profile.sender(self.data_ids)

    def receiver(self) -> E2eReceiver:
        """Return a new end-to-end receiver of this message; without protection it accepts every frame as OK."""
        return E2eReceiver() if self.profile is None else self.profile.receiver(self.data_ids, self.length)

    def encode(self, *values: float) -> bytearray:
        """Return a frame of finite physical values in the order of `values`; the end-to-end header is left zero.

        Raises CodecError when a value doesn't fit or the number of values is wrong.
        """
        if len(values) != len(self.values):
            raise CodecError(f"{self.name} takes {len(self.values)} values, {len(values)} given")
        containers = [0] * (1 + max((signal.container for signal in self.signals), default=-1))
        for signal, value in zip(self.values, values, strict=True):
            raw = _quantise(signal, value)
            containers[signal.container] |= (raw & signal.mask) << signal.shift if signal.mask else raw
        return bytearray(self.containers.pack(*containers))

    def decode(self, data: bytes) -> tuple[float, ...]:
        """Return the physical values of all signals, in the order of `signals`.

        Raises CodecError when the length is wrong.
        """
        if len(data) != self.length:
            raise CodecError(f"{self.name} has {len(data)} bytes, {self.length} expected")
        return super().decode(data)

    def decode_values(self, data: bytes) -> tuple[float, ...]:
        """Return physical values of the signals in `values`, in this order; the length must be right."""
        return self.decode(data)[len(self.signals) - len(self.values) :]

    def takes(self, length: int) -> bool:
        """Return whether a frame of so many bytes can be decoded."""
        return length == self.length

    def decode_named(self, data: bytes) -> tuple[tuple[str, float, str], ...]:
        """Return (name, value, unit) of each signal behind the end-to-end header; the length must be right."""
        return tuple(
            (signal.name, value, signal.unit)
            for signal, value in zip(self.values, self.decode_values(data), strict=True)
        )

    def encode_raw(self, *raw: int) -> bytearray:
        """Return a frame of raw integers in the order of `values`, the end-to-end header left zero; for the hot path.

        Raises CodecError if the message has bit fields. The integers must fit.
        """
        if self._body is None:
            raise CodecError(f"{self.name} has bit fields: encode physical values instead")
        frame = bytearray(self.length)
        self._body.pack_into(frame, self._body_offset, *raw)
        return frame


def _quantise(signal: SignalCodec, value: float) -> int:
    """Return the raw integer of a physical value. Raises CodecError when it doesn't fit."""
    raw = round((value - signal.offset) / signal.scale)
    if not signal.raw_low <= raw <= signal.raw_high:
        bound = signal.raw_high if raw > signal.raw_high else signal.raw_low
        raise CodecError(f"{signal.name} = {value:g} {signal.unit} exceeds {bound * signal.scale + signal.offset:g}")
    return raw


def _check_length(message: Message) -> None:
    """Raise CodecError for a length that no frame has, or a frame format that doesn't fit the length."""
    if message.length > CLASSIC_BYTES and message.length not in FD_LENGTHS:
        lengths = ", ".join(map(str, FD_LENGTHS))
        raise CodecError(f"{message.name}: no CAN frame has {message.length} bytes; beyond 8 there are {lengths}")
    if message.length > CLASSIC_BYTES and not message.is_fd:
        raise CodecError(f"{message.name}: {message.length} bytes need VFrameFormat StandardCAN_FD")
    if message.length <= CLASSIC_BYTES and message.is_fd:
        raise CodecError(f"{message.name}: {message.length} bytes go in a classic frame; VFrameFormat says CAN FD")


def _protection(message: Message) -> tuple[Protection, bytes]:
    """Return the protection by E2EProfile, and the data ids by E2EDataIdList or E2EDataId. Raises CodecError.

    A list alone means Profile 2.
    """
    attributes = message.dbc.attributes if message.dbc else {}
    values = {name: attribute.value for name, attribute in attributes.items()}
    id_list = str(values.get("E2EDataIdList", ""))
    code = str(values.get("E2EProfile", "")) or (Protection.PROFILE_2.value if id_list else "")
    try:
        protection = Protection(code)
    except ValueError:
        known = ", ".join(repr(each.value) for each in Protection)
        raise CodecError(f"{message.name}: E2EProfile = {code!r} is none of {known}") from None
    if protection is Protection.NONE:
        if "E2EDataId" in values:
            raise CodecError(f"{message.name}: E2EDataId without E2EProfile")
        return protection, b""
    profile = PROFILES[protection]
    if profile.is_id_list:
        data_ids = _data_id_list(message.name, id_list, profile.data_id_bytes)
    else:
        data_ids = _data_id(message.name, code, values.get("E2EDataId"), profile.data_id_bytes)
    _check_header(message, code, profile)
    return protection, data_ids


def _data_id_list(name: str, text: str, count: int) -> bytes:
    try:
        ids = bytes.fromhex(text)
    except ValueError:
        raise CodecError(f"{name}: E2EDataIdList = {text!r} is not hexadecimal") from None
    if len(ids) != count:
        raise CodecError(f"{name}: E2EDataIdList has {len(ids)} bytes, {count} expected")
    return ids


def _data_id(name: str, code: str, value: float | str | None, size: int) -> bytes:
    if value is None:
        raise CodecError(f"{name}: E2EProfile {code} without E2EDataId")
    most = (1 << 8 * size) - 1
    if not isinstance(value, int) or not 0 <= value <= most:
        raise CodecError(f"{name}: E2EDataId = {value!r} is no integer of 0..{most}")
    return value.to_bytes(size, "little")


def _check_header(message: Message, code: str, profile: E2eProfile) -> None:
    start, wanted = 0, []
    for name, bits in profile.signals:
        wanted.append((name, start, bits, False))
        start += bits
    first = _in_order(message)[: len(wanted)]
    if [(signal.name, signal.start, signal.length, signal.is_signed) for signal in first] != wanted:
        header = ", ".join(f"{name} ({bits} bits)" for name, bits in profile.signals)
        raise CodecError(f"{message.name}: a message protected by {code} begins with unsigned {header}")


def _in_order(message: Message) -> list[Signal]:
    return sorted(message.signals, key=lambda signal: signal.start)


def _lay_out(message: Message) -> tuple[SignalCodec, ...]:
    """Return the signals, placed in containers on byte borders that cover the frame without gaps. Raises CodecError."""
    end_bit = 0
    containers = 0
    codecs = []
    for signal in _in_order(message):
        where = f"{message.name}.{signal.name}"
        if signal.byte_order != "little_endian" or signal.is_float or signal.is_multiplexer:
            raise CodecError(f"{where}: only plain little-endian integers can be cyclic")
        is_whole = signal.start % 8 == 0 and signal.length in (8, 16, 32, 64)
        if is_whole and signal.start == end_bit:
            container, shift, mask = containers, 0, 0
            containers += 1
            end_bit += signal.length
        elif signal.start % 8 + signal.length <= 8 and signal.start // 8 * 8 in (end_bit, end_bit - 8):
            if signal.start // 8 * 8 == end_bit:
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
    return tuple(codecs)


def _check_messages(database: Database) -> None:
    """Raise CodecError for two messages of the same name or identifier, and for too many messages."""
    by_name: dict[str, Message] = {}
    by_id: dict[tuple[int, bool], Message] = {}
    for message in database.messages:
        first = by_id.setdefault((message.frame_id, message.is_extended_frame), message)
        if by_name.setdefault(message.name, message) is not message:
            raise CodecError(f"message {message.name} is defined more than once")
        if first is not message:
            raise CodecError(
                f"messages {first.name} and {message.name} have the same identifier 0x{message.frame_id:X}"
            )
    if len(by_name) > _MOST_MESSAGES:
        raise CodecError(f"{len(by_name)} messages are more than {_MOST_MESSAGES}")


class Codec:
    """All messages of one DBC."""

    def __init__(self, database: Database, path: Path, text: bytes) -> None:
        self.path = path
        self.text = text
        self.database = database
        self.messages = {message.name: MessageCodec(message) for message in database.messages}
        self.by_id = {message.can_id: message for message in self.messages.values()}
        attributes = database.dbc.attributes if database.dbc else {}
        if WIRE_VERSION not in attributes:
            raise CodecError("the DBC has no WireVersion attribute")
        self.is_fd = any(message.is_fd for message in self.messages.values())
        """Whether any message needs CAN FD."""
        self.wire_version = int(attributes[WIRE_VERSION].value)
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
        """Return the node id of a CANopen message: the low seven bits of its identifier. Raises CodecError."""
        return self.message(message_name).can_id & 0x7F


def _describe(messages: dict[str, MessageCodec]) -> str:
    lines = []
    for message in sorted(messages.values(), key=lambda message: message.can_id):
        # A list of ids alone says Profile 2, as in a DBC.
        code = "" if message.protection in (Protection.NONE, Protection.PROFILE_2) else f"{message.protection.value} "
        lines.append(f"{message.can_id:x} {message.name} {message.length} {code}{message.data_ids.hex()}")
        lines.extend(
            f" {s.name} {s.container} {s.shift} {s.mask} {s.raw_low} {s.scale!r} {s.offset!r}" for s in message.signals
        )
    return "\n".join(lines)


def contract_folder() -> Path:
    """Return the folder of the DBC and EDS files: beside the package when installed, else in the source tree."""
    package = Path(__file__).resolve().parent.parent
    installed = package / "dbc"
    return installed if installed.is_dir() else package.parent / "dbc"


_SIGNAL_PLACE = re.compile(rb"\|\s*0*(?P<bits>\d+)\s*@")
_MOST_BITS = "512"
"""Bits of the longest frame, 64 bytes."""


def read_dbc(path: Path | None = None) -> tuple[bytes, Path]:
    """Return the text and the path of a DBC (default: the package's). Raises CodecError when it can't be read."""
    path = path or contract_folder() / "arm.dbc"
    try:
        return read_input(path), path
    except OSError as error:
        raise CodecError(f"DBC {path}: {error.strerror}") from None


def load_codec(path: Path | None = None) -> Codec:
    """Return the codec of a DBC (default: the package's). Raises CodecError."""
    return parse_codec(*read_dbc(path))


def parse_codec(text: bytes, path: Path) -> Codec:
    """Return the codec of the text of a DBC; `path`: its file, existing or not. Raises CodecError."""
    database = parse_database(text, path)
    try:
        _check_messages(database)
        return Codec(database, path, text)
    except CodecError as error:
        raise CodecError(f"DBC {path}: {error}") from None


def parse_database(text: bytes, path: Path) -> Database:
    """Return the messages of any DBC that cantools accepts, in UTF-8 or a Windows code page. Raises CodecError.

    A signal of more bits than the longest frame has is an error, too. `path`: as in `parse_codec`.
    """
    for found in _SIGNAL_PLACE.finditer(text):  # cantools allocates a character for each bit
        if len(found["bits"]) > len(_MOST_BITS) or int(found["bits"]) > int(_MOST_BITS):
            raise CodecError(f"DBC {path}: a signal has {found['bits'].decode()[:20]} bits, more than {_MOST_BITS}")
    try:
        database = _load_database(decode_dbc(text))
    except Exception as error:  # cantools has no common class of its errors
        reason = " ".join(str(error).split()) or type(error).__name__
        raise CodecError(f"DBC {path} can't be read: {reason}") from None
    if not isinstance(database, Database):
        raise CodecError(f"DBC {path} holds no CAN messages")
    return database


@functools.lru_cache(maxsize=16)
def _load_database(text: str) -> object:
    """Let cantools parse a DBC. Cached, for it takes 40 ms and each log has one: don't change it."""
    return cantools.database.load_string(text, "dbc")


def decode_dbc(text: bytes) -> str:
    """Return the text of a DBC, decoded as UTF-8, else by the code page of vendors' tools, as cantools assumes."""
    try:
        return text.decode("utf-8-sig")
    except UnicodeDecodeError:
        return text.decode("cp1252", "replace")
