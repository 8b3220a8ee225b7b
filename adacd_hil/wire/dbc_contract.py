"""Contracts read from a DBC: the codec accepts only layouts that the hot path decodes fast.

These are little-endian integers of 8, 16, 32 or 64 bits on byte borders, and bit fields within one byte. Any other
layout is refused with the signal's name. A message of more than 8 bytes is a CAN FD frame, marked in the DBC by
VFrameFormat; its length must have a data length code in ISO 11898-1.
"""

import functools
import logging
import re
from pathlib import Path

import cantools
from cantools.database.can import Database, Message, Signal

from adacd_hil.file_access import read_input
from adacd_hil.wire.codec import Codec, CodecError, MessageCodec
from adacd_hil.wire.e2e import PROFILES, E2eProfile, Protection
from adacd_hil.wire.frame_lengths import CLASSIC_BYTES, FD_LENGTHS
from adacd_hil.wire.message_table import SignalCodec

logging.getLogger("cantools").addHandler(logging.NullHandler())  # our errors replace its output on the terminal

_MOST_MESSAGES = 1000
"""Most messages of a contract: its budget takes 3 s to compute, and four times that for twice as many."""
WIRE_VERSION = "WireVersion"
"""The DBC attribute that marks a contract."""


def _message_codec(message: Message) -> MessageCodec:
    """Return the codec of a message. Raises CodecError for a length, layout or protection that no contract has."""
    _check_length(message)
    protection, data_ids = _protection(message)
    signals, senders = _lay_out(message), tuple(message.senders)
    return MessageCodec(message.name, message.frame_id, message.length, signals, protection, data_ids, senders)


def _check_length(message: Message) -> None:
    """Raise CodecError for a length that no frame has, or a frame format that doesn't fit the length.

    A frame of up to 8 bytes must be classic, a longer one CAN FD.
    """
    if message.length > CLASSIC_BYTES and message.length not in FD_LENGTHS:
        lengths = ", ".join(map(str, FD_LENGTHS))
        raise CodecError(f"{message.name}: no CAN frame has {message.length} bytes; beyond 8 there are {lengths}")
    if message.length > CLASSIC_BYTES and not message.is_fd:
        raise CodecError(f"{message.name}: {message.length} bytes need VFrameFormat StandardCAN_FD")
    if message.length <= CLASSIC_BYTES and message.is_fd:
        raise CodecError(f"{message.name}: {message.length} bytes go in a classic frame; VFrameFormat says CAN FD")


def _protection(message: Message) -> tuple[Protection, bytes]:
    """Return the protection by E2EProfile, and the data ids by E2EDataIdList or E2EDataId; b"" without protection.

    A list alone means Profile 2. Raises CodecError for an unknown profile, missing or wrong data ids, E2EDataId without
    a profile, or a message that doesn't begin with the profile's header.
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
    """Return the data ids of a hexadecimal list, a byte each. Raises CodecError for other text, or another count."""
    try:
        ids = bytes.fromhex(text)
    except ValueError:
        raise CodecError(f"{name}: E2EDataIdList = {text!r} is not hexadecimal") from None
    if len(ids) != count:
        raise CodecError(f"{name}: E2EDataIdList has {len(ids)} bytes, {count} expected")
    return ids


def _data_id(name: str, code: str, value: float | str | None, size: int) -> bytes:
    """Return a data id, `value`, as `size` bytes, the low one first. Raises CodecError if it is None or doesn't fit.

    name, code: of message and profile, for the error.
    """
    if value is None:
        raise CodecError(f"{name}: E2EProfile {code} without E2EDataId")
    most = (1 << 8 * size) - 1
    if not isinstance(value, int) or not 0 <= value <= most:
        raise CodecError(f"{name}: E2EDataId = {value!r} is no integer of 0..{most}")
    return value.to_bytes(size, "little")


def _check_header(message: Message, code: str, profile: E2eProfile) -> None:
    """Raise CodecError unless the message begins with the signals of its profile's header."""
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
    """Return the signals, placed in containers on byte borders that cover the frame without gaps.

    Raises CodecError, with the signal's name, for any other than little-endian integers of 8, 16, 32 or 64 bits on byte
    borders and bit fields within one byte, and for overlaps and gaps; for a gap at the end with the message's name.
    """
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
    """Raise CodecError for two messages of the same name or identifier, and for more than _MOST_MESSAGES."""
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


def contract_folder() -> Path:
    """Return the folder of the DBC and EDS files: in the package when installed, else beside it in the source tree."""
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
    """Return the codec of a DBC (default: the package's).

    Raises CodecError if it can't be read, or can't serve as a contract, see `parse_codec`.
    """
    return parse_codec(*read_dbc(path))


def parse_codec(text: bytes, path: Path) -> Codec:
    """Return the codec of the text of a DBC; `path`: its file, existing or not.

    Raises CodecError, with `path` first, for a text that isn't a DBC, a WireVersion that is missing or no number, more
    than _MOST_MESSAGES messages, two messages with the same name or identifier, and a message of a length, layout or
    protection that no contract has.
    """
    database = parse_database(text, path)
    try:
        _check_messages(database)
        messages = [_message_codec(message) for message in database.messages]
        attributes = database.dbc.attributes if database.dbc else {}
        if WIRE_VERSION not in attributes:
            raise CodecError("the DBC has no WireVersion attribute")
        version = attributes[WIRE_VERSION].value
        if not isinstance(version, int | float):
            raise CodecError(f"attribute {WIRE_VERSION} is {version!r}, not a number")
        return Codec(messages, int(version), database, path, text)
    except CodecError as error:
        raise CodecError(f"DBC {path}: {error}") from None


def parse_database(text: bytes, path: Path) -> Database:
    """Return cantools' database of any DBC that cantools accepts, in UTF-8 or a Windows code page.

    Equal texts share one object: don't change it. Raises CodecError, with `path`, if cantools can't read the text, and
    for a signal of more bits than the longest frame has.
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
    """Return a DBC as parsed by cantools; cached, since that takes 40 ms and each log has one: don't change it."""
    return cantools.database.load_string(text, "dbc")


def decode_dbc(text: bytes) -> str:
    """Return the text of a DBC, decoded as UTF-8, else by the code page of vendors' tools, as cantools assumes."""
    try:
        return text.decode("utf-8-sig")
    except UnicodeDecodeError:
        return text.decode("cp1252", "replace")
