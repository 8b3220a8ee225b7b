"""Statistics of bus traffic: every identifier seen, with count, rate, lengths and its last frame."""

from dataclasses import dataclass

from adacd_hil.clock import Clock
from adacd_hil.wire.bus import Bus, Frame

_SLICE_S = 0.02
"""Longest single wait on the bus while listening, so that the end is noticed on a silent bus."""


@dataclass
class Talk:
    """Frames of one identifier so far. shortest, longest: number of data bytes. data: of the last frame."""

    can_id: int
    count: int
    first_ns: int
    last_ns: int
    shortest: int
    longest: int
    data: bytes

    @property
    def rate_Hz(self) -> float | None:
        """Mean rate between the first and the last frame; None for a single frame, or if all came at the same time."""
        span_ns = self.last_ns - self.first_ns
        return (self.count - 1) * 1e9 / span_ns if span_ns > 0 else None

    @property
    def length(self) -> str:
        """Number of data bytes as text; a range such as "4-8" if it has changed."""
        return str(self.longest) if self.shortest == self.longest else f"{self.shortest}-{self.longest}"


class Traffic:
    """The identifiers seen so far, each with its `Talk`, and the number of error frames, which have none."""

    def __init__(self) -> None:
        self.talks: dict[int, Talk] = {}
        self.error_frames = 0

    def count_frame(self, frame: Frame) -> None:
        """Add a frame to the statistics of its identifier; count an error frame in `error_frames` only."""
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
        """Return the statistics of each identifier seen, ascending by identifier."""
        return [self.talks[can_id] for can_id in sorted(self.talks)]


def receive_until(bus: Bus, clock: Clock, end_ns: int) -> Frame | None:
    """Return the next frame; None if none came until `end_ns` of the clock, or that has passed.

    Raises BusError if the bus fails.
    """
    while (now_ns := clock.now_ns()) < end_ns:
        slice_ns = min(end_ns, now_ns + round(_SLICE_S * 1e9))
        frame = bus.receive((slice_ns - now_ns) * 1e-9)
        if frame is not None:
            return frame
        clock.sleep_until_ns(slice_ns)  # a virtual clock moves here; a real one is already there
    return None


def listen(bus: Bus, clock: Clock, duration_s: float, traffic: Traffic) -> None:
    """Receive frames for a duration, and add them to `traffic`; send nothing. Raises BusError if the bus fails."""
    end_ns = clock.now_ns() + round(duration_s * 1e9)
    while (frame := receive_until(bus, clock, end_ns)) is not None:
        traffic.count_frame(frame)
