"""The load of a bus: the share of time that frames take with their actual stuff bits.

The bits of classic frames are those of can-utils' `canbusload -e`: from start of frame to the end of the intermission.
CAN FD, which `canbusload -e` can't count, is measured likewise, each part of a frame at its own rate.
"""

from adacd_hil.wire.bus import Frame
from adacd_hil.wire.frame_bits import FrameBits
from adacd_hil.wire.frame_lengths import FRAME_LENGTHS
from adacd_hil.wire.frame_time import exact_frame


class LoadMeter:
    """Counts the bits of a bus's frames, and turns them into a load. For `monitor` and `commtest`, not for a run.

    Error frames don't count: their duration is unknown. Identifiers above 0x7FF are extended ones.
    """

    def __init__(self, bitrate: int, data_bitrate: int, start_ns: int) -> None:
        """Begin with no bits at `start_ns`; the rates are in bit/s, data_bitrate 0 without CAN FD.

        Raises ValueError if `bitrate` is 0 or less.
        """
        if bitrate <= 0:
            raise ValueError(f"bitrate = {bitrate} bit/s is not above 0 bit/s")
        exact_frame(0, bytes(FRAME_LENGTHS[-1] if data_bitrate else 0))  # compiled before the first frame comes
        self._bitrate = bitrate
        self._data_bitrate = data_bitrate
        self._start_ns = start_ns
        self.bits = FrameBits(0, 0)
        """Of the frames since the last call of `take_percent`."""

    def count_frame(self, frame: Frame) -> None:
        """Add a frame's bits to the load; ignore an error frame.

        Raises ValueError for a length that no frame has, or a frame of CAN FD if no data bit rate was given.
        """
        if frame.is_error:
            return
        bits = exact_frame(frame.can_id, frame.data)
        if bits.data and self._data_bitrate <= 0:
            raise ValueError(
                f"frame 0x{frame.can_id:X} has {len(frame.data)} bytes: CAN FD, but no data bit rate is given"
            )
        self.bits = FrameBits(self.bits.nominal + bits.nominal, self.bits.data + bits.data)

    def take_percent(self, t_ns: int) -> float:
        """Return the bus load, percent, since the last call, or since the begin, until `t_ns`; 0 for an empty interval.

        Then count from zero again, from `t_ns` on.
        """
        busy_s, interval_s = self.bits.duration_s(self._bitrate, self._data_bitrate), (t_ns - self._start_ns) * 1e-9
        self._start_ns, self.bits = t_ns, FrameBits(0, 0)
        return 100.0 * busy_s / interval_s if interval_s > 0.0 else 0.0
