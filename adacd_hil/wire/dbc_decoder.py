"""A DBC that only decodes: any that cantools reads, with big-endian, multiplexed and float signals, gaps and overlaps.

The rules of a contract hold in `adacd_hil.wire.codec`, for the frames of a cycle.
"""

from collections import Counter
from pathlib import Path

from cantools.database.can import Message
from cantools.database.errors import DecodeError
from cantools.database.utils import create_encode_decode_formats, decode_data

from adacd_hil.wire.codec import WIRE_VERSION, parse_database, read_dbc


class MessageDecoder:
    """Decodes the frames of one message as cantools does."""

    is_protected = False

    def __init__(self, message: Message, is_exact: bool) -> None:
        """Take cantools' message. is_exact: frames of another length are none, as in a contract."""
        self.name = message.name
        self.can_id = message.frame_id
        self.is_extended = message.is_extended_frame
        self.senders = tuple(message.senders)
        self.units = {signal.name: signal.unit or "" for signal in message.signals}
        """Of each signal, by name, in the order of their places."""
        self.partly_decoded: Counter[str] = Counter()
        """Frames whose multiplexer has a value that the DBC doesn't list, by cantools' words for it."""
        self._message = message
        self._is_exact = is_exact
        plain = [signal for signal in message.signals if not signal.multiplexer_ids]
        self._plain = plain, create_encode_decode_formats(plain, message.length)

    def takes(self, length: int) -> bool:
        """Say whether a frame of so many bytes is decoded: of a contract a whole one, of others what is there."""
        return length == self._message.length or not self._is_exact

    def decode(self, data: bytes) -> dict[str, float]:
        """Decode the signals that a frame holds: not all where it is short, or multiplexed.

        Of a multiplexer whose value the DBC doesn't know, those that are always there.
        """
        try:
            values = self._message.decode_simple(data, decode_choices=False, allow_truncated=True)
        except DecodeError as error:
            self.partly_decoded[str(error)] += 1
            values = decode_data(data, self._message.length, *self._plain, False, True, True, True)
        return {name: float(value) for name, value in values.items()}  # type: ignore[arg-type]

    def decode_named(self, data: bytes) -> tuple[tuple[str, float, str], ...]:
        """Decode a frame to (signal, value, unit)."""
        return tuple((name, value, self.units[name]) for name, value in self.decode(data).items())


class DbcDecoder:
    """All messages of one DBC. Of messages that share a name the last one counts, as for cantools."""

    def __init__(self, text: bytes, path: Path) -> None:
        """Read it; `path` is where it is, or would be. Raises CodecError."""
        self.path = path
        self.database = parse_database(text, path)
        self.messages = {message.name: MessageDecoder(message, self.is_contract) for message in self.database.messages}
        self.by_id = {message.can_id: message for message in self.messages.values()}
        self.is_fd = any(message.is_fd for message in self.database.messages)

    @property
    def is_contract(self) -> bool:
        """Whether it says that it is a contract; then its rules hold."""
        return self.database.dbc is not None and WIRE_VERSION in self.database.dbc.attributes


def load_decoder(path: Path | None = None) -> DbcDecoder:
    """Read a DBC (default: the one that comes with the package). Raises CodecError."""
    return DbcDecoder(*read_dbc(path))
