"""The table of a message's signals, by which its frames are decoded.

A signal is a whole container of 1, 2, 4 or 8 bytes, or bits of one byte; containers cover the frame without gaps.
`value = raw * scale + offset`, each step rounded to float64.
"""

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

_FORMATS = {(1, False): "B", (1, True): "b", (2, False): "H", (2, True): "h"} | {
    (4, False): "I",
    (4, True): "i",
    (8, False): "Q",
    (8, True): "q",
}
"""Letter of the module struct for a container, by bytes and whether it is signed."""


@dataclass(frozen=True)
class SignalCodec:
    """One signal: where its raw integer is, and `value = raw * scale + offset` in `unit`.

    container: which of the integers that make up the frame holds it. shift, mask: its lowest bit there, and its bits
    after the shift; a mask of 0 means the whole container.
    """

    name: str
    unit: str
    scale: float
    offset: float
    container: int
    shift: int
    mask: int
    raw_low: int
    raw_high: int

    @property
    def bits(self) -> int:
        """How many bits it has."""
        return (self.raw_high - self.raw_low).bit_length()

    @property
    def size(self) -> int:
        """How many bytes its container has."""
        return 1 if self.mask else self.bits // 8

    @property
    def is_signed(self) -> bool:
        """Whether its raw integer may be negative."""
        return self.raw_low < 0


@dataclass
class MessageTable:
    """Everything needed to read a message's frames: signals in the order of their containers."""

    name: str
    can_id: int
    length: int
    signals: tuple[SignalCodec, ...]

    @cached_property
    def containers(self) -> struct.Struct:
        """The struct that packs and unpacks a frame as the integers that make it up, its signals' containers."""
        return container_struct(self.signals)

    def decode(self, data: bytes) -> tuple[float, ...]:
        """Decode all signals to physical values, in the order of `signals`. Raises struct.error for a wrong length."""
        containers = self.containers.unpack(data)
        values = []
        for signal in self.signals:
            raw = containers[signal.container]
            if mask := signal.mask:
                raw = (raw >> signal.shift) & mask
                if raw > mask >> 1 and signal.is_signed:
                    raw -= mask + 1
            values.append(raw * signal.scale + signal.offset)
        return tuple(values)


def plain_tables(messages: Iterable[MessageTable]) -> tuple[MessageTable, ...]:
    """Return plain tables, with copies of name, identifier, length and signals, that can be sent to another process."""
    return tuple(MessageTable(one.name, one.can_id, one.length, one.signals) for one in messages)


def container_struct(signals: Iterable[SignalCodec]) -> struct.Struct:
    """Return the little-endian struct of the integers that hold these signals; signals: in the order of containers."""
    formats = {signal.container: _FORMATS[signal.size, signal.is_signed and not signal.mask] for signal in signals}
    return struct.Struct("<" + "".join(formats.values()))
