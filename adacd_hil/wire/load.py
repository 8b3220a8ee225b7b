"""Live bus load: the bit times of the frames that passed, per interval."""

from adacd_hil.wire.bus import Frame

_OVERHEAD_BITS = 47
"""Classic frame with an 11-bit identifier: everything but data and stuff bits, with intermission (ISO 11898-1)."""


class LoadMeter:
    """Adds up bit times; `data_bitrate` in bit/s is for the data phase of frames with more than 8 bytes, 0: none."""

    def __init__(self, bitrate: int, data_bitrate: int = 0) -> None:
        self._bit_s = 1.0 / bitrate
        self._data_bit_s = 1.0 / data_bitrate if data_bitrate else self._bit_s
        self._busy_s = 0.0

    def add(self, frame: Frame) -> None:
        """Count one frame."""
        if not frame.is_error:
            data_bit_s = self._bit_s if len(frame.data) <= 8 else self._data_bit_s
            self._busy_s += _OVERHEAD_BITS * self._bit_s + 8 * len(frame.data) * data_bit_s

    def take_percent(self, interval_s: float) -> float:
        """Return the load of the frames since the last call, in percent of `interval_s`."""
        busy_s, self._busy_s = self._busy_s, 0.0
        return 100.0 * busy_s / interval_s if interval_s > 0.0 else 0.0
