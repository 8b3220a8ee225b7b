"""Frames of one DBC message to physical values, many at a time; the values of `MessageCodec.decode`, bit for bit.

A signal is a whole container of 1, 2, 4 or 8 bytes, or bits of one byte; containers cover the frame without gaps
(adacd_hil.wire.codec). `value = raw * scale + offset`, each step rounded to float64.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from adacd_hil.log.channels import MessageLike, SignalLike


class Decoder:
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
