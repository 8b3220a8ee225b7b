"""Bit budget of a contract: whether its frames meet their deadlines, from the DBC alone.

| trigger | counted as | deadline |
|---|---|---|
| sync | once per SYNC, SYNC itself included | before the next SYNC |
| command | once per SYNC, after the feedback | before the next SYNC |
| event | once per inhibit time; without one, per cycle time; without both, per 100 ms | within its cycle time |
| request | not while operating, or one SDO frame per SYNC | none |

All cyclic frames are taken as queued together with SYNC. That is never better than the truth for the last of them, and
needs no knowledge of the devices' and the host's delays. Response times are computed for three kinds of traffic:
operation (without requests and EMCY), which decides whether the contract fits; the same with one SDO frame per SYNC;
and with the EMCY of every device besides. Deadlines missed under the last two are reported but don't fail the contract:
a late command acts one SYNC later. NMT commands begin and end operation and do not disturb it.

On a bus that several arms share, messages without a node id count once and all others once per arm.

Worst-case response times of messages that share a bus by fixed priority, without preemption: Davis, Burns, Bril,
Lukkien, "Controller Area Network (CAN) schedulability analysis: refuted, revisited and revised", Real-Time Systems 35
(2007), section 3.2: level-m busy period, and every instance in it. (The analysis of 1994 looks at the first instance
only and promises too much.) A response time goes from the queueing of a message to the end of its frame, intermission
included; errors on the bus are left out.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from adacd_hil.wire.codec import Codec, CodecError
from adacd_hil.wire.contract_frames import (
    ASSUMED_INTERVAL_MS,
    NMT_ID,
    ContractFrame,
    ContractTiming,
    Trigger,
    read_contract,
    share_bus,
)
from adacd_hil.wire.frame_lengths import CLASSIC_BYTES, FrameBits, unstuffed_frame, worst_case_frame

HORIZON_NS = 1_000_000_000
"""Longest busy period that is followed; response times after it count as unbounded."""


class Stream(NamedTuple):
    """Frames of one message: time on the bus, smallest interval between two, release jitter."""

    duration_ns: int
    interval_ns: int
    jitter_ns: int = 0

    def arrivals(self, window_ns: int) -> int:
        """Most frames that can be queued within a window: ceil((window + J) / T)."""
        return -(-(window_ns + self.jitter_ns) // self.interval_ns)


class ResponseTime(NamedTuple):
    """A response time; if unbounded, a time that it reaches at least."""

    time_ns: int
    is_bounded: bool = True


def response_time(
    stream: Stream, higher: Sequence[Stream], blocking_ns: int, bit_ns: int, deadline_ns: int | None = None
) -> ResponseTime:
    """Return the worst-case response time of a message.

    higher: messages of higher priority; blocking_ns: the longest frame of lower priority; bit_ns: one bit at the
    nominal rate. If the bus is overloaded, a time beyond `deadline_ns` (or the horizon) is returned.
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
    return ResponseTime(worst_ns)


def is_overloaded(streams: Sequence[Stream]) -> bool:
    """Return whether messages together need more than the whole bus."""
    common = math.lcm(*(stream.interval_ns for stream in streams))
    return sum(stream.duration_ns * (common // stream.interval_ns) for stream in streams) > common


def _waiting(
    stream: Stream, higher: Sequence[Stream], blocking_ns: int, bit_ns: int, instance: int, waiting_ns: int
) -> int:
    """Return the next iteration of eq. (9): the time of all frames sent before instance q, while it waits."""
    before_ns = sum(s.arrivals(waiting_ns + bit_ns) * s.duration_ns for s in higher)
    return blocking_ns + instance * stream.duration_ns + before_ns


def _exceeded(stream: Stream, higher: Sequence[Stream], blocking_ns: int, bit_ns: int, limit_ns: int) -> ResponseTime:
    """Return a time beyond `limit_ns`, if given, that some frame of an endless busy period takes at least."""
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
    return ResponseTime(worst_ns, is_bounded=False)


class LoadCase(Enum):
    """Frames on the bus besides the cyclic ones."""

    OPERATION = "operation"
    REQUESTS = "requests"
    EMERGENCIES = "emergencies"


@dataclass(frozen=True)
class FrameBudget:
    """Bits, durations, deadline and response times of a message."""

    frame: ContractFrame
    unstuffed: FrameBits
    worst: FrameBits
    duration_ns: int
    interval_ns: int
    deadline_ns: int | None
    responses: dict[LoadCase, ResponseTime]

    def late_ns(self, traffic: LoadCase = LoadCase.OPERATION) -> int:
        """Time by which its response misses the deadline (at least, if unbounded); 0: in time."""
        response = self.responses[traffic]
        if self.deadline_ns is None:
            return 0
        return max(response.time_ns - self.deadline_ns, 0 if response.is_bounded else 1)


@dataclass(frozen=True)
class Budget:
    """Budget of a contract at a period and bit rates. Times in ns, at worst-case stuffing."""

    contract: ContractTiming
    period_us: int
    bitrate: int
    data_bitrate: int
    frames: tuple[FrameBudget, ...]

    def _sum_ns(self, *triggers: Trigger) -> int:
        return sum(entry.duration_ns for entry in self.frames if entry.frame.trigger in triggers)

    @property
    def cyclic(self) -> tuple[FrameBudget, ...]:
        """Frames that are sent in every cycle."""
        return tuple(entry for entry in self.frames if entry.frame.is_cyclic)

    @property
    def unstuffed_bits(self) -> int:
        """Bits of a cycle's frames without stuff bits, at both rates."""
        return sum(entry.unstuffed.total for entry in self.cyclic)

    @property
    def worst_bits(self) -> int:
        """Bits of a cycle's frames with the most stuff bits, at both rates."""
        return sum(entry.worst.total for entry in self.cyclic)

    @property
    def feedback_ns(self) -> int:
        """Time from SYNC to the end of the last feedback frame."""
        return self._sum_ns(Trigger.SYNC)

    @property
    def command_ns(self) -> int:
        """Duration of the command frames."""
        return self._sum_ns(Trigger.COMMAND)

    @property
    def cyclic_ns(self) -> int:
        """Duration of all frames of a cycle."""
        return self.feedback_ns + self.command_ns

    @property
    def host_ns(self) -> int:
        """Time for the host between the last feedback and the last moment to send commands; negative: doesn't fit."""
        return self.period_us * 1000 - self.cyclic_ns

    @property
    def longest_event_ns(self) -> int:
        """Duration of the longest event frame, which can delay SYNC, feedback and commands."""
        events = [e.duration_ns for e in self.frames if e.frame.trigger is Trigger.EVENT and not e.frame.is_emergency]
        return max(events, default=0)

    @property
    def cyclic_load(self) -> float:
        """Share of the time that cyclic frames take at most."""
        return self.cyclic_ns / (self.period_us * 1000)

    @property
    def load(self) -> float:
        """Share of the time in operation: cyclic frames and events, at worst, without requests and EMCY."""
        return sum(
            entry.duration_ns / entry.interval_ns for entry in self.frames if _is_sent(entry, LoadCase.OPERATION)
        )

    @property
    def late(self) -> tuple[FrameBudget, ...]:
        """Frames that may miss their deadline in operation."""
        return tuple(entry for entry in self.frames if entry.late_ns() > 0)

    @property
    def is_fit(self) -> bool:
        """Whether every frame meets its deadline in operation."""
        return not self.late

    @property
    def line(self) -> str:
        """The verdict in one line."""
        where = f"{self.contract.name} at {self.period_us} µs"
        if self.is_fit:
            return f"{where} fits: {us(self.cyclic_ns)} µs of cyclic frames, {us(self.host_ns)} µs left for the host"
        reasons = []
        if self.host_ns < 0:
            reasons.append(f"the cyclic frames need {us(self.cyclic_ns)} µs, {us(-self.host_ns)} µs too many")
        first, *more = sorted(self.late, key=lambda entry: (not entry.frame.is_cyclic, -entry.late_ns()))
        reasons.append(_describe_late(first, LoadCase.OPERATION) + (f", {len(more)} more miss theirs" if more else ""))
        return f"{where} doesn't fit: {'; '.join(reasons)}"

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on event frames, requests and EMCY, one line each."""
        notes = []
        if self.longest_event_ns:
            notes.append(f"each event frame in the way takes up to {us(self.longest_event_ns)} µs of the host's time")
        if any(entry.frame.trigger is Trigger.REQUEST for entry in self.frames):
            whose = "one SDO" if self.contract.arms == 1 else "one SDO of each host"
            notes.append(f"{whose} in every cycle: {self._describe_traffic(LoadCase.REQUESTS)}")
        if any(entry.frame.is_emergency for entry in self.frames):
            notes.append(f"and every EMCY at once: {self._describe_traffic(LoadCase.EMERGENCIES)}")
        open_ended = [entry.frame for entry in self.frames if not entry.frame.has_interval]
        if open_ended:
            notes.append(
                f"event frames without inhibit time (GenMsgDelayTime): {len(open_ended)}. Nothing bounds how often "
                f"they come; counted once per cycle time, or per {ASSUMED_INTERVAL_MS} ms"
            )
        return tuple(notes)

    def _describe_traffic(self, traffic: LoadCase) -> str:
        if not self.cyclic:
            return "no cyclic frames"
        last = max(self.cyclic, key=lambda entry: entry.responses[traffic].time_ns)
        if last.late_ns(traffic):
            return _describe_late(last, traffic)
        return f"in time, {last.frame.name} within {us(last.responses[traffic].time_ns)} µs"


def us(time_ns: int) -> str:
    """Format a time in µs, with one decimal unless it is whole."""
    return f"{time_ns / 1000:.0f}" if time_ns % 1000 == 0 else f"{time_ns / 1000:.1f}"


def _describe_late(entry: FrameBudget, traffic: LoadCase) -> str:
    response = entry.responses[traffic]
    about = "" if response.is_bounded else "at least "
    deadline_ns = entry.deadline_ns or 0
    return f"{entry.frame.name} misses its deadline of {us(deadline_ns)} µs by {about}{us(entry.late_ns(traffic))} µs"


def check_budget(
    codec: Codec,
    period_us: int | None = None,
    bitrate: int | None = None,
    data_bitrate: int | None = None,
    arms: int = 1,
) -> Budget:
    """Compute the budget of a contract, or of several arms of it on one bus.

    Period in µs and rates in bit/s default to the DBC's own. Raises CodecError.
    """
    contract = share_bus(read_contract(codec.text, codec.path.name), arms)
    return find_budget(contract, period_us, bitrate, data_bitrate)


def find_budget(
    contract: ContractTiming, period_us: int | None = None, bitrate: int | None = None, data_bitrate: int | None = None
) -> Budget:
    """Compute the budget of a contract; see `check_budget`."""
    period_us = _given(contract, "BusPeriod_us", period_us, contract.period_us)
    bitrate = _given(contract, "Baudrate", bitrate, contract.bitrate)
    is_fd = any(frame.length > CLASSIC_BYTES for frame in contract.frames)
    data_bitrate = _given(contract, "BaudrateCANFD", data_bitrate, contract.data_bitrate) if is_fd else 0
    period_ns = period_us * 1000
    entries = []
    for frame in contract.frames:
        try:
            worst = worst_case_frame(frame.length, frame.is_extended)
        except ValueError as error:
            raise CodecError(f"DBC {contract.name}: {frame.name}: {error}") from None
        unstuffed = unstuffed_frame(frame.length, frame.is_extended)
        duration_ns = worst.duration_ns(bitrate, data_bitrate)
        interval_ns, deadline_ns = frame.interval_ns(period_ns), frame.deadline_ns(period_ns)
        entries.append(FrameBudget(frame, unstuffed, worst, duration_ns, interval_ns, deadline_ns, {}))
    bit_ns = FrameBits(1).duration_ns(bitrate)
    for place, entry in enumerate(entries):
        for traffic in LoadCase:
            entry.responses[traffic] = _respond(entries, place, traffic, bit_ns, period_ns, contract.arms)
    return Budget(contract, period_us, bitrate, data_bitrate, tuple(entries))


def _given(contract: ContractTiming, attribute: str, chosen: int | None, declared: int) -> int:
    value = declared if chosen is None else chosen
    if value <= 0:
        raise CodecError(f"DBC {contract.name} has no {attribute}, and none is given")
    return value


def _is_sent(entry: FrameBudget, traffic: LoadCase) -> bool:
    if entry.frame.trigger is Trigger.REQUEST:
        return traffic is not LoadCase.OPERATION and entry.frame.can_id != NMT_ID
    return not entry.frame.is_emergency or traffic is LoadCase.EMERGENCIES


def _respond(
    entries: list[FrameBudget], place: int, traffic: LoadCase, bit_ns: int, period_ns: int, hosts: int
) -> ResponseTime:
    """Return the response time of the frame at `place` in arbitration order; each host sends one request a period."""
    entry = entries[place]
    above = [other for other in entries[:place] if _is_sent(other, traffic)]
    below = [other for other in entries[place + 1 :] if _is_sent(other, traffic)]
    if entry.frame.trigger is Trigger.REQUEST:
        above, below = ([o for o in part if o.frame.trigger is not Trigger.REQUEST] for part in (above, below))
    higher = [Stream(o.duration_ns, o.interval_ns) for o in above if o.frame.trigger is not Trigger.REQUEST]
    request_ns = max((o.duration_ns for o in above if o.frame.trigger is Trigger.REQUEST), default=0)
    if request_ns:
        higher.extend([Stream(request_ns, period_ns)] * hosts)
    blocking_ns = max((o.duration_ns for o in below), default=0)
    # A frame that doesn't occur in this load case is judged as a single one.
    interval_ns = entry.interval_ns if _is_sent(entry, traffic) else ASSUMED_INTERVAL_MS * 1_000_000
    stream = Stream(entry.duration_ns, interval_ns)
    return response_time(stream, higher, blocking_ns, bit_ns, entry.deadline_ns)
