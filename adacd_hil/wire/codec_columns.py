"""The table of a message's signals, from which both codecs are made, and the column codec: many frames at a time.

A signal is a whole container of 1, 2, 4 or 8 bytes, or bits of one byte; containers cover the frame without gaps.
`value = raw * scale + offset`, each step rounded to float64. So both codecs give the same values, bit for bit:
`MessageCodec` (adacd_hil.wire.codec) for one frame, `ColumnCodec` for an array of frames.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


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


def plain_tables(messages: Iterable[MessageTable]) -> tuple[MessageTable, ...]:
    """Return the tables of messages without their codecs, so that another process can receive them."""
    return tuple(MessageTable(one.name, one.can_id, one.length, one.signals) for one in messages)


class ColumnCodec:
    """Decodes the frames of one message."""

    def __init__(self, message: MessageTable) -> None:
        self.length = message.length
        self.count = len(message.signals)
        sizes = {signal.container: signal.size for signal in message.signals}
        self._begins = {container: sum(sizes[before] for before in range(container)) for container in sizes}
        self._signals = message.signals

    def decode(self, data: NDArray[np.uint8], values: NDArray[np.float64]) -> None:
        """Decode `data` (n, length), each row in one piece, into `values` (n, signals)."""
        for column, signal in enumerate(self._signals):
            begin, size, mask = self._begins[signal.container], signal.size, signal.mask
            form = f"<{'i' if signal.is_signed and not mask else 'u'}{size}"
            raw: NDArray[Any] = data[:, begin : begin + size].view(form)[:, 0]
            if mask:
                raw = (raw.astype(np.int64) >> signal.shift) & mask
                if signal.is_signed:
                    raw -= (raw > mask >> 1) * np.int64(mask + 1)
            values[:, column] = raw.astype(np.float64) * signal.scale + signal.offset
