"""Live load of a bus: how much of the time its frames take, without stuff bits."""

from dataclasses import dataclass

from adacd_hil.wire.bus import Frame

_OVERHEAD_BITS = 47
"""Classic frame with an 11-bit identifier: everything but data and stuff bits, with intermission (ISO 11898-1)."""


@dataclass(frozen=True)
class Load:
    """What passed in an interval."""

    interval_ns: int
    busy_s: float

    @property
    def percent(self) -> float:
        """Share of the interval in which the bus was taken, in percent; 0 for an empty interval."""
        return 100.0 * self.busy_s / (self.interval_ns * 1e-9) if self.interval_ns > 0 else 0.0


class LoadMeter:
    """Counts frames; `take` returns the load since the last call. Error frames don't count."""

    def __init__(self, bitrate: int, data_bitrate: int = 0, start_ns: int | None = None) -> None:
        """Count at rates in bit/s, from `start_ns` (default: the first frame) on."""
        self._bit_s = 1.0 / bitrate
        self._data_bit_s = 1.0 / data_bitrate if data_bitrate else None
        self._start_ns = start_ns
        self._busy_s = 0.0

    def add(self, frame: Frame) -> None:
        """Count a frame. Raises ValueError for one that can't be: CAN FD without a data bit rate."""
        if frame.is_error:
            return
        data_bit_s = self._bit_s if len(frame.data) <= 8 else self._data_bit_s
        if data_bit_s is None:
            raise ValueError(
                f"frame 0x{frame.can_id:X} has {len(frame.data)} bytes: CAN FD, but no data bit rate is given"
            )
        if self._start_ns is None:
            self._start_ns = frame.t_ns
        self._busy_s += _OVERHEAD_BITS * self._bit_s + 8 * len(frame.data) * data_bit_s

    def take(self, t_ns: int) -> Load:
        """Return the load from the last call until now, and begin anew."""
        load = Load(0 if self._start_ns is None else t_ns - self._start_ns, self._busy_s)
        self._start_ns, self._busy_s = t_ns, 0.0
        return load
