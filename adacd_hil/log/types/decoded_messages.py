"""Messages of a DBC as far as the log needs them, and their decoding, many frames at a time.

A signal is a whole container of 1, 2, 4 or 8 bytes, or bits of one byte; containers cover the frame without gaps
(adacd_hil.wire.codec). `value = raw * scale + offset`, each step rounded to float64: the values of
`MessageCodec.decode`, bit for bit.
"""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


class SignalLike(Protocol):
    """What the log needs to know of a DBC signal."""

    @property
    def name(self) -> str:
        """Name in the DBC."""

    @property
    def unit(self) -> str:
        """Unit of the decoded value."""

    @property
    def scale(self) -> float:
        """Physical value of one raw step."""

    @property
    def offset(self) -> float:
        """Physical value of raw zero."""

    @property
    def container(self) -> int:
        """Which of the integers that make up the frame holds it."""

    @property
    def shift(self) -> int:
        """Its lowest bit within that integer, where it has a mask."""

    @property
    def mask(self) -> int:
        """Its bits after the shift; 0 when it is the whole integer, of one byte otherwise."""

    @property
    def raw_low(self) -> int:
        """Smallest raw value; below 0 it is signed."""

    @property
    def raw_high(self) -> int:
        """Largest raw value."""


class MessageLike(Protocol):
    """What the log needs to know of a DBC message."""

    @property
    def name(self) -> str:
        """Name in the DBC."""

    @property
    def can_id(self) -> int:
        """Identifier on the bus."""

    @property
    def length(self) -> int:
        """Count of data bytes."""

    @property
    def signals(self) -> "tuple[SignalLike, ...]":
        """Signals in the order of their containers, and of the fields of its topic."""


@dataclass(frozen=True)
class PlainSignal:
    """A signal of a DBC message; the fields are those of `SignalLike`."""

    name: str
    unit: str
    scale: float
    offset: float
    container: int
    shift: int
    mask: int
    raw_low: int
    raw_high: int


@dataclass(frozen=True)
class PlainMessage:
    """A message of a DBC."""

    name: str
    can_id: int
    length: int
    signals: tuple[PlainSignal, ...]


def plain_messages(messages: Iterable[MessageLike]) -> tuple[PlainMessage, ...]:
    """Put messages of a DBC into a form that can be told."""
    names = [field.name for field in fields(PlainSignal)]
    return tuple(
        PlainMessage(
            name=message.name,
            can_id=message.can_id,
            length=message.length,
            signals=tuple(PlainSignal(*(getattr(signal, name) for name in names)) for signal in message.signals),
        )
        for message in messages
    )


class ColumnDecoder:
    """Decodes the frames of one message."""

    def __init__(self, message: MessageLike) -> None:
        self.length = message.length
        self.count = len(message.signals)
        self._signals = message.signals
        formats = {signal.container: _container_format(signal) for signal in message.signals}
        self._dtype = np.dtype([(str(container), form) for container, form in sorted(formats.items())])

    def decode(self, data: NDArray[np.uint8], values: NDArray[np.float64]) -> None:
        """Decode `data` (n, length), each row in one piece, into `values` (n, signals)."""
        if not self._signals:
            return
        containers: NDArray[Any] = data.view(self._dtype)[:, 0]
        for column, signal in enumerate(self._signals):
            raw = containers[str(signal.container)]
            if signal.mask:
                raw = (raw.astype(np.int64) >> signal.shift) & signal.mask
                if signal.raw_low < 0:
                    raw -= (raw > signal.mask >> 1) * np.int64(signal.mask + 1)
            values[:, column] = raw.astype(np.float64) * signal.scale + signal.offset


def _container_format(signal: SignalLike) -> str:
    """Name numpy's type of the container of a signal: a byte when it holds bits of one."""
    if signal.mask:
        return "u1"
    size = (signal.raw_high - signal.raw_low).bit_length() // 8
    return f"<i{size}" if signal.raw_low < 0 else f"<u{size}"
