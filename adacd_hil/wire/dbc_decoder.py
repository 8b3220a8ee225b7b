"""Decoder for any DBC that cantools reads, with big-endian, multiplexed and float signals, gaps and overlaps.

A contract, which is stricter, is decoded by `adacd_hil.wire.codec`.
"""

from collections import Counter
from pathlib import Path

from cantools.database.can import Message
from cantools.database.errors import DecodeError
from cantools.database.utils import create_encode_decode_formats, decode_data

from adacd_hil.wire.dbc_contract import WIRE_VERSION, parse_database, read_dbc


class MessageDecoder:
    """Decodes the frames of one message as cantools does."""

    is_protected = False

    def __init__(self, message: Message, is_exact: bool) -> None:
        """Take cantools' message. is_exact: `takes` refuses frames of another length, as in a contract."""
        self.name = message.name
        self.can_id = message.frame_id
        self.is_extended = message.is_extended_frame
        self.senders = tuple(message.senders)
        self.units = {signal.name: signal.unit or "" for signal in message.signals}
        """Unit of each signal, by name, in the order of their places."""
        self.partly_decoded: Counter[str] = Counter()
        """Number of frames whose multiplexer has a value that the DBC doesn't list, by cantools' error text."""
        self._message = message
        self._is_exact = is_exact
        plain = [signal for signal in message.signals if not signal.multiplexer_ids]
        self._plain = plain, create_encode_decode_formats(plain, message.length)

    def takes(self, length: int) -> bool:
        """Return whether a frame of so many bytes is decoded; of another length only if the DBC isn't a contract."""
        return length == self._message.length or not self._is_exact

    def decode(self, data: bytes) -> dict[str, float]:
        """Return the values of the signals that a frame holds, by name; a short or multiplexed frame doesn't hold all.

        If the DBC doesn't list the multiplexer's value, only the signals outside the multiplexer are decoded, and the
        frame is counted in `partly_decoded`.
        """
        try:
            values = self._message.decode_simple(data, decode_choices=False, allow_truncated=True)
        except DecodeError as error:
            self.partly_decoded[str(error)] += 1
            values = decode_data(data, self._message.length, *self._plain, False, True, True, True)
        return {name: float(value) for name, value in values.items()}  # type: ignore[arg-type]

    def decode_named(self, data: bytes) -> tuple[tuple[str, float, str], ...]:
        """Return (name, value, unit) of each signal that a frame holds, as `decode`."""
        return tuple((name, value, self.units[name]) for name, value in self.decode(data).items())


class DbcDecoder:
    """All messages of one DBC. Of several messages with one name the last counts, as for cantools."""

    def __init__(self, text: bytes, path: Path) -> None:
        """Parse the text; `path`: its file, existing or not. Raises CodecError if cantools can't read it."""
        self.path = path
        self.database = parse_database(text, path)
        self.messages = {message.name: MessageDecoder(message, self.is_contract) for message in self.database.messages}
        self.by_id = {message.can_id: message for message in self.messages.values()}
        self.is_fd = any(message.is_fd for message in self.database.messages)

    @property
    def is_contract(self) -> bool:
        """Whether the DBC is marked as a contract; then `MessageDecoder.takes` refuses frames of a wrong length."""
        return self.database.dbc is not None and WIRE_VERSION in self.database.dbc.attributes


def load_decoder(path: Path | None = None) -> DbcDecoder:
    """Return the decoder of a DBC file (default: the package's). Raises CodecError if it can't be read or parsed."""
    return DbcDecoder(*read_dbc(path))
