"""Worst-case response times of messages that share a bus by fixed priority, without preemption.

Source: Davis, Burns, Bril, Lukkien, "Controller Area Network (CAN) schedulability analysis: refuted, revisited and
revised", Real-Time Systems 35 (2007), section 3.2: level-m busy period, and every instance in it. (The analysis of 1994
looks at the first instance only and promises too much.) A response time goes from the queueing of a message to the end
of its frame, intermission included; errors on the bus are left out.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

HORIZON_NS = 1_000_000_000
"""Longest busy period that is followed; what isn't through after it counts as unbounded."""


class Stream(NamedTuple):
    """Frames of one message: time on the bus, smallest interval between two, release jitter."""

    duration_ns: int
    interval_ns: int
    jitter_ns: int = 0

    def arrivals(self, window_ns: int) -> int:
        """Most frames that can be queued within a window: ceil((window + J) / T)."""
        return -(-(window_ns + self.jitter_ns) // self.interval_ns)


class Response(NamedTuple):
    """A response time; where no bound was found, a time that it reaches at least."""

    time_ns: int
    is_bounded: bool = True


def response_time(
    stream: Stream, higher: Sequence[Stream], blocking_ns: int, bit_ns: int, deadline_ns: int | None = None
) -> Response:
    """Return the worst-case response time of a message.

    higher: the messages that win arbitration; blocking_ns: the longest frame of those that lose it; bit_ns: one bit at
    the nominal rate. Where messages use up the bus, a time beyond `deadline_ns` (or the horizon) is returned.
    """
    if is_overloaded((*higher, stream)):
        return _exceeded(stream, higher, blocking_ns, bit_ns, HORIZON_NS if deadline_ns is None else deadline_ns)
    busy_ns = stream.duration_ns
    while True:
        longer_ns = blocking_ns + sum(s.arrivals(busy_ns) * s.duration_ns for s in (*higher, stream))
        if longer_ns == busy_ns:
            break
        busy_ns = longer_ns
        if busy_ns > HORIZON_NS:
            return _exceeded(stream, higher, blocking_ns, bit_ns, HORIZON_NS if deadline_ns is None else deadline_ns)
    worst_ns = 0
    waiting_ns = blocking_ns
    for instance in range(stream.arrivals(busy_ns)):
        waiting_ns = max(waiting_ns, blocking_ns + instance * stream.duration_ns)
        while True:
            longer_ns = _waiting(stream, higher, blocking_ns, bit_ns, instance, waiting_ns)
            if longer_ns == waiting_ns:
                break
            waiting_ns = longer_ns
        worst_ns = max(worst_ns, stream.jitter_ns + waiting_ns - instance * stream.interval_ns + stream.duration_ns)
    return Response(worst_ns)


def is_overloaded(streams: Sequence[Stream]) -> bool:
    """Tell whether messages together need more than all of the bus."""
    common = math.lcm(*(stream.interval_ns for stream in streams))
    return sum(stream.duration_ns * (common // stream.interval_ns) for stream in streams) > common


def _waiting(
    stream: Stream, higher: Sequence[Stream], blocking_ns: int, bit_ns: int, instance: int, waiting_ns: int
) -> int:
    """One step of eq. (9): what is sent before instance q while it waits."""
    before_ns = sum(s.arrivals(waiting_ns + bit_ns) * s.duration_ns for s in higher)
    return blocking_ns + instance * stream.duration_ns + before_ns


def _exceeded(stream: Stream, higher: Sequence[Stream], blocking_ns: int, bit_ns: int, limit_ns: int) -> Response:
    """Return a time, beyond `limit_ns` where there is one, that some frame of an endless busy period takes at least."""
    worst_ns = 0
    waiting_ns = blocking_ns
    instance = 0
    while worst_ns <= limit_ns and instance * stream.interval_ns <= HORIZON_NS:
        longer_ns = _waiting(stream, higher, blocking_ns, bit_ns, instance, waiting_ns)
        worst_ns = max(worst_ns, stream.jitter_ns + longer_ns - instance * stream.interval_ns + stream.duration_ns)
        if longer_ns == waiting_ns:
            instance += 1
            longer_ns += stream.duration_ns
        waiting_ns = longer_ns
    return Response(worst_ns, is_bounded=False)
