"""Joins the values of several devices that were sampled on the same SYNC.

The model compares torque with motion, so all values of a sample must be of one moment. Where a device answers late, the
sample is complete a cycle or more later than it was taken: it is used then, with its age.
"""

from typing import NamedTuple

KEPT = 16
"""SYNCs whose values are kept: more than any device may be late."""


class Sample(NamedTuple):
    """Values of all devices, sampled on one SYNC. `ordinal`: which; `values`: a tuple of each device."""

    ordinal: int
    values: tuple[tuple[float, ...], ...]


class SampleAlignment:
    """The last values of each device by the SYNC that they answer."""

    def __init__(self, devices: int) -> None:
        self._ordinals = [[-1] * KEPT for _ in range(devices)]
        self._values: list[list[tuple[float, ...]]] = [[()] * KEPT for _ in range(devices)]

    def put(self, device: int, ordinal: int, values: tuple[float, ...]) -> None:
        """Keep a device's values of one SYNC."""
        place = ordinal % KEPT
        self._ordinals[device][place] = ordinal
        self._values[device][place] = values

    def newest(self, last: int, after: int) -> Sample | None:
        """Return the newest complete sample of the SYNCs up to `last` that come behind `after`, or None."""
        for ordinal in range(last, max(after, last - KEPT), -1):
            place = ordinal % KEPT
            if all(ordinals[place] == ordinal for ordinals in self._ordinals):
                return Sample(ordinal, tuple(values[place] for values in self._values))
        return None
