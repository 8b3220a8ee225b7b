"""Bounds that a profile sets to values of a device, such as a temperature or the second torque of a sensor.

A value may be bounded by itself or by its difference to another value of the same frame.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from adacd_hil.device.profile import PdoSettings
from adacd_hil.wire.codec import MessageCodec


class ValueBound(NamedTuple):
    """The bounds of one value: its place among a message's values, `low` and `high` in `unit`, its name as text."""

    text: str
    unit: str
    place: int
    place_of: int | None
    """Of the value that is subtracted; None: the value itself is bounded."""
    low: float
    high: float

    def value_in(self, values: Sequence[float]) -> float:
        """Return the bounded quantity of a decoded frame: one value, or its difference to the value at `place_of`."""
        return values[self.place] - (0.0 if self.place_of is None else values[self.place_of])

    def is_within(self, values: Sequence[float]) -> bool:
        """Return whether the bounded quantity of a decoded frame is within its bounds, inclusive; NaN isn't."""
        return self.low <= self.value_in(values) <= self.high

    def describe(self, values: Sequence[float]) -> str:
        """Return the bounded quantity of a decoded frame, as of `value_in`, and its bounds in words."""
        bounds = [f"at least {self.low:g}"] if self.low > -math.inf else []
        bounds += [f"at most {self.high:g}"] if self.high < math.inf else []
        return f"{self.text} {f'{self.value_in(values):g} {self.unit}'.rstrip()}, {' and '.join(bounds)} allowed"


def value_bounds(pdo: PdoSettings | None, message: MessageCodec | None) -> tuple[ValueBound, ...]:
    """Return the bounds that a profile sets to values of a frame; empty if `pdo` or `message` is None.

    Signals without bounds are left out; a bound that is not set is infinite. Raises CodecError when the message lacks a
    bounded signal.
    """
    if pdo is None or message is None:
        return ()
    return tuple(
        ValueBound(
            f"{signal.signal} - {signal.of}" if signal.of else signal.signal,
            message.values[message.place(signal.signal)].unit,
            message.place(signal.signal),
            message.place(signal.of) if signal.of else None,
            -math.inf if signal.low is None else signal.low,
            math.inf if signal.high is None else signal.high,
        )
        for signal in pdo.signals
        if signal.is_bounded
    )
