"""Live load of a bus: how much of the time its frames take, with the stuff bits that they really have.

The bits of classic frames are those of can-utils' `canbusload -e`: from start of frame to the end of the intermission.
CAN FD, which `canbusload -e` can't count, is measured likewise, each part of a frame at its own rate.
"""

from dataclasses import dataclass

from adacd_hil.wire.bus import Frame
from adacd_hil.wire.frame_bits import FrameBits, exact_frame

_LARGEST_BASE_ID = 0x7FF


@dataclass(frozen=True)
class Load:
    """What passed in an interval."""

    interval_ns: int
    frames: int
    bits: FrameBits
    payload_bits: int
    bitrate: int
    data_bitrate: int

    @property
    def percent(self) -> float:
        """Share of the interval in which the bus was taken, in percent; 0 for an empty interval."""
        if self.interval_ns <= 0:
            return 0.0
        return 100.0 * self.bits.duration_s(self.bitrate, self.data_bitrate) / (self.interval_ns * 1e-9)

    @property
    def frames_s(self) -> float:
        """Frames per second."""
        return self.frames / (self.interval_ns * 1e-9) if self.interval_ns > 0 else 0.0

    @property
    def bits_s(self) -> float:
        """Bits per second, of both rates."""
        return self.bits.total / (self.interval_ns * 1e-9) if self.interval_ns > 0 else 0.0


class LoadMeter:
    """Counts frames; `take` returns the load since the last call. About 10 µs per frame: for `monitor`, not the cycle.

    Error frames don't count: what they took of the bus isn't known. Identifiers above 0x7FF are taken as extended.
    """

    def __init__(self, bitrate: int, data_bitrate: int = 0, start_ns: int | None = None) -> None:
        """Count at rates in bit/s, from `start_ns` (default: the first frame) on. Raises ValueError for a rate of 0."""
        if bitrate <= 0:
            raise ValueError(f"bitrate = {bitrate} bit/s is not above 0 bit/s")
        self._bitrate = bitrate
        self._data_bitrate = data_bitrate
        self._start_ns = start_ns
        self._frames = self._nominal = self._data = self._payload = 0

    def add(self, frame: Frame) -> None:
        """Count a frame. Raises ValueError for one that can't be: no such length, or CAN FD without a data bit rate."""
        if frame.is_error:
            return
        bits = exact_frame(frame.can_id, frame.data, frame.can_id > _LARGEST_BASE_ID)
        if bits.data and self._data_bitrate <= 0:
            raise ValueError(
                f"frame 0x{frame.can_id:X} has {len(frame.data)} bytes: CAN FD, but no data bit rate is given"
            )
        if self._start_ns is None:
            self._start_ns = frame.t_ns
        self._frames += 1
        self._nominal += bits.nominal
        self._data += bits.data
        self._payload += 8 * len(frame.data)

    def take(self, t_ns: int) -> Load:
        """Return the load from the last call until now, and begin anew."""
        interval_ns = 0 if self._start_ns is None else t_ns - self._start_ns
        bits = FrameBits(self._nominal, self._data)
        load = Load(interval_ns, self._frames, bits, self._payload, self._bitrate, self._data_bitrate)
        self._start_ns = t_ns
        self._frames = self._nominal = self._data = self._payload = 0
        return load
