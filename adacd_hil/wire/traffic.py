"""Who sends what on a bus, and how much of the bus it takes.

Every identifier seen, with count, rate, lengths and its last frame; and the live load: how much of the time frames take
with the stuff bits that they really have. The bits of classic frames are those of can-utils' `canbusload -e`: from
start of frame to the end of the intermission. CAN FD, which `canbusload -e` can't count, is measured likewise, each
part of a frame at its own rate.
"""

from dataclasses import dataclass

from adacd_hil.clock import Clock
from adacd_hil.wire.bus import MAX_STANDARD_ID, Bus, Frame
from adacd_hil.wire.frame_bits import FrameBits, exact_frame

_SLICE_S = 0.02
"""How long one wait on the bus may take while listening: how soon the end is noticed on a silent bus."""


@dataclass
class Talk:
    """One identifier's frames so far."""

    can_id: int
    count: int
    first_ns: int
    last_ns: int
    shortest: int
    longest: int
    data: bytes

    @property
    def rate_Hz(self) -> float | None:
        """Mean rate between the first and the last frame; None for a single frame."""
        span_ns = self.last_ns - self.first_ns
        return (self.count - 1) * 1e9 / span_ns if span_ns > 0 else None

    @property
    def length(self) -> str:
        """Count of data bytes, as a range when it changes."""
        return str(self.longest) if self.shortest == self.longest else f"{self.shortest}-{self.longest}"


class Traffic:
    """All identifiers seen so far. Error frames are counted apart."""

    def __init__(self) -> None:
        self.talks: dict[int, Talk] = {}
        self.error_frames = 0

    def accept(self, frame: Frame) -> None:
        """Count one frame."""
        if frame.is_error:
            self.error_frames += 1
            return
        can_id, data, t_ns, _ = frame
        length = len(data)
        talk = self.talks.get(can_id)
        if talk is None:
            self.talks[can_id] = Talk(can_id, 1, t_ns, t_ns, length, length, data)
            return
        talk.count += 1
        talk.last_ns = t_ns
        talk.data = data
        if length < talk.shortest:
            talk.shortest = length
        elif length > talk.longest:
            talk.longest = length

    def sorted(self) -> list[Talk]:
        """List what was seen, identifiers ascending."""
        return [self.talks[can_id] for can_id in sorted(self.talks)]


def receive_until(bus: Bus, clock: Clock, end_ns: int) -> Frame | None:
    """Wait for one frame until `end_ns`; None when the time is over. Raises BusError."""
    while (now_ns := clock.now_ns()) < end_ns:
        slice_ns = min(end_ns, now_ns + round(_SLICE_S * 1e9))
        frame = bus.receive((slice_ns - now_ns) * 1e-9)
        if frame is not None:
            return frame
        clock.sleep_until_ns(slice_ns)  # a virtual clock moves here; a real one is already there
    return None


def listen(bus: Bus, clock: Clock, duration_s: float, traffic: Traffic) -> None:
    """Take in what passes for a while, sending nothing. Raises BusError."""
    end_ns = clock.now_ns() + round(duration_s * 1e9)
    while (frame := receive_until(bus, clock, end_ns)) is not None:
        traffic.accept(frame)


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
        bits = exact_frame(frame.can_id, frame.data, frame.can_id > MAX_STANDARD_ID)
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
