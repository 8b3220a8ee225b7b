"""Playback of recorded frames: sent at absolute deadlines, with statistics of their lateness.

A frame is due at begin + (t_ns - first t_ns) / speed. A late frame doesn't delay later ones; overdue frames are sent at
once, in the order of the recording.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from typing import Final

from adacd_hil.clock import Clock
from adacd_hil.wire.bus import Bus, Frame

LEAD_NS: Final = 5_000_000
"""Time from the reading of the first frame until it is due."""
LOOP_PAUSE_NS: Final = 1_000_000
"""Time from the last frame of a recording to the first of its repetition, by the recording's clock."""
LATE_MS: Final = 1.0
"""A frame later than this is counted as late."""
_BUCKET_NS = 1_000
_STOP_NS = 50_000_000
"""Longest pause between two looks at `is_stopped`."""
_MOST_AT_ONCE = 64


class Lateness:
    """Histogram, in whole µs, of how late frames were handed to the bus. Its memory is bounded."""

    def __init__(self) -> None:
        self.frames = 0
        self.late_frames = 0
        """Frames later than LATE_MS."""
        self.worst_ns = 0
        self._counts: Counter[int] = Counter()

    def add_lateness(self, lateness_ns: int) -> None:
        """Count a frame that was sent `lateness_ns` after it was due."""
        self.frames += 1
        self.late_frames += lateness_ns > LATE_MS * 1e6
        self.worst_ns = max(self.worst_ns, lateness_ns)
        self._counts[lateness_ns // _BUCKET_NS] += 1

    def quantile_us(self, share: float) -> int:
        """Return a lateness, whole µs, that at least a share (0…1) of the frames did not reach; 0 without frames.

        It is the upper end of the 1 µs bin in which the share is reached.
        """
        needed = share * self.frames
        for bucket, count in sorted(self._counts.items()):
            needed -= count
            if needed <= 0:
                return bucket + 1
        return 0


def play(
    bus: Bus,
    clock: Clock,
    frames: Iterable[Frame],
    *,
    speed: float = 1.0,
    longest_pause_ns: int | None = None,
    is_stopped: Callable[[], bool] = lambda: False,
) -> Lateness:
    """Send frames at their times until they end or `is_stopped` returns True; return how late they were sent.

    The first frame is due `LEAD_NS` after `frames` has yielded it, on `clock`. Only identifier and data of a frame are
    sent. Frames due at the same time are sent together, up to `_MOST_AT_ONCE`, and count as late as the first of them.
    frames: their times are by any clock, only differences matter. speed: 2 plays twice as fast. longest_pause_ns:
    longer pauses of the recording are shortened to this; None: none is. A frame with an earlier time than the one
    before is sent with it. is_stopped: called at least every `_STOP_NS`. Raises BusError if the bus fails.
    """
    lateness = Lateness()
    for due_ns, group in _grouped(_scheduled(frames, clock, speed, longest_pause_ns)):
        while (now_ns := clock.now_ns()) < due_ns and not is_stopped():
            clock.sleep_until_ns(min(due_ns, now_ns + _STOP_NS))
        if is_stopped():
            break
        late_ns = max(0, clock.now_ns() - due_ns)
        bus.send_all([(frame.can_id, frame.data) for frame in group])
        for _ in group:
            lateness.add_lateness(late_ns)
    return lateness


def repeat(frames: Callable[[], Iterable[Frame]], times: int) -> Iterator[Frame]:
    """Yield the frames of a recording `times` times in a row, with times that continue; 0: forever.

    Each repetition begins `LOOP_PAUSE_NS` after the last frame before. Ends at once if the recording is empty. `frames`
    is called for each repetition.
    """
    shift_ns, end_ns, done = 0, None, 0
    while not times or done < times:
        is_first = True
        for frame in frames():
            if is_first and end_ns is not None:
                shift_ns = end_ns + LOOP_PAUSE_NS - frame.t_ns
            is_first = False
            end_ns = frame.t_ns + shift_ns
            yield frame._replace(t_ns=end_ns)
        if is_first:
            return
        done += 1


def _scheduled(
    frames: Iterable[Frame], clock: Clock, speed: float, longest_pause_ns: int | None
) -> Iterator[tuple[int, Frame]]:
    """Yield each frame with the time at which it is due, ns of `clock`; the times never decrease.

    The first is due `LEAD_NS` after `frames` has yielded it. A pause above `longest_pause_ns` is shortened to it before
    `speed` divides the time.
    """
    begin_ns, first_ns, cut_ns, latest_ns = 0, None, 0, 0
    for frame in frames:
        if first_ns is None:
            begin_ns = clock.now_ns() + LEAD_NS
            first_ns = latest_ns = frame.t_ns
        pause_ns = frame.t_ns - latest_ns
        if longest_pause_ns is not None and pause_ns > longest_pause_ns:
            cut_ns += pause_ns - longest_pause_ns
        latest_ns = max(latest_ns, frame.t_ns)
        yield begin_ns + round((latest_ns - first_ns - cut_ns) / speed), frame


def _grouped(scheduled: Iterable[tuple[int, Frame]]) -> Iterator[tuple[int, list[Frame]]]:
    """Yield due time and frames of each group with the same due time, `_MOST_AT_ONCE` frames at most."""
    group: list[Frame] = []
    group_ns = 0
    for due_ns, frame in scheduled:
        if group and (due_ns != group_ns or len(group) == _MOST_AT_ONCE):
            yield group_ns, group
            group = []
        group_ns = due_ns
        group.append(frame)
    if group:
        yield group_ns, group
