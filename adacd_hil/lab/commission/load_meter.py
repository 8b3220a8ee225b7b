"""The load of a bus: the share of time that frames take with their actual stuff bits.

The bits of classic frames are those of can-utils' `canbusload -e`: from start of frame to the end of the intermission.
CAN FD, which `canbusload -e` can't count, is measured likewise, each part of a frame at its own rate.
"""

from dataclasses import dataclass

from adacd_hil.wire.bus import Frame
from adacd_hil.wire.frame_bits import FrameBits
from adacd_hil.wire.frame_lengths import FRAME_LENGTHS
from adacd_hil.wire.frame_time import exact_frame


@dataclass(frozen=True)
class Load:
    """Frames and bits of an interval, and the rates."""

    interval_ns: int
    frames: int
    bits: FrameBits
    bitrate: int
    data_bitrate: int

    @property
    def percent(self) -> float:
        """Share of the interval in which the bus was busy, in percent; 0 for an empty interval."""
        if self.interval_ns <= 0:
            return 0.0
        return 100.0 * self.bits.duration_s(self.bitrate, self.data_bitrate) / (self.interval_ns * 1e-9)


class LoadMeter:
    """Counts frames; `take_load` returns the load since the last call. For `monitor`, not the cycle.

    Error frames don't count: their duration is unknown. Identifiers above 0x7FF are extended ones.
    """

    def __init__(self, bitrate: int, data_bitrate: int = 0, start_ns: int | None = None) -> None:
        """Count at rates in bit/s, from `start_ns` (default: the first frame) on. Raises ValueError for a rate of 0."""
        if bitrate <= 0:
            raise ValueError(f"bitrate = {bitrate} bit/s is not above 0 bit/s")
        exact_frame(0, bytes(FRAME_LENGTHS[-1] if data_bitrate else 0))  # compiled before the first frame comes
        self._bitrate = bitrate
        self._data_bitrate = data_bitrate
        self._start_ns = start_ns
        self._frames = self._nominal = self._data = 0

    def count_frame(self, frame: Frame) -> None:
        """Add a frame's bits to the load; ignore an error frame.

        Raises ValueError for an impossible length, or CAN FD without a data bit rate.
        """
        if frame.is_error:
            return
        bits = exact_frame(frame.can_id, frame.data)
        if bits.data and self._data_bitrate <= 0:
            raise ValueError(
                f"frame 0x{frame.can_id:X} has {len(frame.data)} bytes: CAN FD, but no data bit rate is given"
            )
        if self._start_ns is None:
            self._start_ns = frame.t_ns
        self._frames += 1
        self._nominal += bits.nominal
        self._data += bits.data

    def take_load(self, t_ns: int) -> Load:
        """Return the load from the last call, or the beginning, until `t_ns`; start again from zero."""
        interval_ns = 0 if self._start_ns is None else t_ns - self._start_ns
        bits = FrameBits(self._nominal, self._data)
        load = Load(interval_ns, self._frames, bits, self._bitrate, self._data_bitrate)
        self._start_ns = t_ns
        self._frames = self._nominal = self._data = 0
        return load
