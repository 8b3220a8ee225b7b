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
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import NamedTuple

from cantools.database.can import Database, Message

from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.codec import Codec, CodecError
from adacd_hil.wire.contract_attributes import read_attribute
from adacd_hil.wire.contract_frames import EMERGENCY_ID, HEARTBEAT_ID, HOST_HEARTBEAT, NMT_ID, NODE_MASK, SYNC_ID
from adacd_hil.wire.frame_bits import FrameBits, unstuffed_frame, worst_case_frame
from adacd_hil.wire.moved_contract import move_id

ASSUMED_INTERVAL_MS = 100
"""Interval of an event frame without a declared one: the usual heartbeat period."""
HORIZON_NS = 1_000_000_000
"""Longest busy period that is followed; response times after it count as unbounded."""


class Stream(NamedTuple):
    """Frames of one message: duration of one on the bus, smallest interval between the queueing of two."""

    duration_ns: int
    interval_ns: int

    def arrivals(self, window_ns: int) -> int:
        """Return the most frames that can be queued within a window: ceil(window_ns / interval_ns)."""
        return -(-window_ns // self.interval_ns)


class ResponseTime(NamedTuple):
    """Time from a message's queueing to its frame's end, ns; `is_bounded` False: a time that it reaches at least."""

    time_ns: int
    is_bounded: bool = True


def response_time(
    stream: Stream, higher: Sequence[Stream], blocking_ns: int, bit_ns: int, deadline_ns: int | None = None
) -> ResponseTime:
    """Return the longest time from the queueing of a message to the end of its frame.

    higher: messages of higher priority; blocking_ns: the longest frame of lower priority; bit_ns: one bit at the
    nominal rate. If the bus is overloaded, or busy for longer than HORIZON_NS, the result is unbounded: a time that the
    response time reaches, over `deadline_ns` (default: HORIZON_NS) if there is one within the horizon, see `_exceeded`.
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
        worst_ns = max(worst_ns, waiting_ns - instance * stream.interval_ns + stream.duration_ns)
    return ResponseTime(worst_ns)


def is_overloaded(streams: Sequence[Stream]) -> bool:
    """Return whether the messages' durations over their intervals add up to more than 1, all of the bus's time."""
    common = math.lcm(*(stream.interval_ns for stream in streams))
    return sum(stream.duration_ns * (common // stream.interval_ns) for stream in streams) > common


def _waiting(
    stream: Stream, higher: Sequence[Stream], blocking_ns: int, bit_ns: int, instance: int, waiting_ns: int
) -> int:
    """Return a better estimate than `waiting_ns` of the time that a message's frame `instance`, from 0, waits: eq. (9).

    The longest frame of lower priority, the message's earlier frames, and the frames of higher priority that are queued
    within `waiting_ns`. Once the estimate no longer grows, it is the time.
    """
    before_ns = sum(s.arrivals(waiting_ns + bit_ns) * s.duration_ns for s in higher)
    return blocking_ns + instance * stream.duration_ns + before_ns


def _exceeded(stream: Stream, higher: Sequence[Stream], blocking_ns: int, bit_ns: int, limit_ns: int) -> ResponseTime:
    """Return, as unbounded, a response time that some frame of an endless busy period reaches at least.

    It is beyond `limit_ns`, unless all frames that are queued within the horizon take less.
    """
    worst_ns = 0
    waiting_ns = blocking_ns
    instance = 0
    while worst_ns <= limit_ns and instance * stream.interval_ns <= HORIZON_NS:
        longer_ns = _waiting(stream, higher, blocking_ns, bit_ns, instance, waiting_ns)
        worst_ns = max(worst_ns, longer_ns - instance * stream.interval_ns + stream.duration_ns)
        if longer_ns == waiting_ns:
            instance += 1
            longer_ns += stream.duration_ns
        waiting_ns = longer_ns
    return ResponseTime(worst_ns, is_bounded=False)


class LoadCase(Enum):
    """Frames on the bus besides the cyclic ones: event frames without EMCY; those and requests; EMCY as well."""

    OPERATION = "operation"
    REQUESTS = "requests"
    EMERGENCIES = "emergencies"


class Trigger(Enum):
    """When a frame is sent; the DBC's `Trigger`."""

    SYNC = "sync"
    COMMAND = "command"
    EVENT = "event"
    REQUEST = "request"


@dataclass(frozen=True)
class FrameBudget:
    """Identifier, bits, durations, deadline and response times of a message; deadline None: it has none.

    length: bytes of data. unstuffed, worst: bits without stuff bits, and with the most; duration_ns: of the latter.
    """

    name: str
    can_id: int
    is_extended: bool
    length: int
    trigger: Trigger
    unstuffed: FrameBits
    worst: FrameBits
    duration_ns: int
    interval_ns: int
    """Smallest interval between two of them that the budget assumes."""
    deadline_ns: int | None
    has_interval: bool
    """Whether its rate is bounded, by SYNC, a request or an inhibit time; a heartbeat's always is."""
    responses: dict[LoadCase, ResponseTime] = field(default_factory=dict)

    @property
    def priority(self) -> tuple[int, int]:
        """Arbitration order; lower wins. A base frame wins over an extended one with the same first 11 bits."""
        return (self.can_id >> 18, 1 + (self.can_id & 0x3FFFF)) if self.is_extended else (self.can_id, 0)

    @property
    def is_cyclic(self) -> bool:
        """Whether it is sent on every SYNC."""
        return self.trigger in (Trigger.SYNC, Trigger.COMMAND)

    @property
    def is_emergency(self) -> bool:
        """Whether it is an EMCY: an event frame whose identifier is 0x080 plus a node id."""
        is_emcy_id = _function(self.can_id, self.is_extended) == EMERGENCY_ID and self.can_id != SYNC_ID
        return is_emcy_id and self.trigger is Trigger.EVENT

    def late_ns(self, traffic: LoadCase = LoadCase.OPERATION) -> int:
        """Return the time by which the frame misses its deadline in a load case, ns; 0 if in time or without deadline.

        If the response time is unbounded, the frame misses it by at least the result, which is above 0.
        """
        response = self.responses[traffic]
        if self.deadline_ns is None:
            return 0
        return max(response.time_ns - self.deadline_ns, 0 if response.is_bounded else 1)


@dataclass(frozen=True)
class Budget:
    """Budget of a contract at a period and bit rates. Times in ns, at worst-case stuffing."""

    name: str
    arms: int
    """Number of arms on the bus, each with its host."""
    period_us: int
    bitrate: int
    data_bitrate: int
    frames: tuple[FrameBudget, ...]

    def _sum_ns(self, *triggers: Trigger) -> int:
        """Return the sum of the durations of one frame each of all messages with these triggers."""
        return sum(entry.duration_ns for entry in self.frames if entry.trigger in triggers)

    @property
    def cyclic(self) -> tuple[FrameBudget, ...]:
        """Frames that are sent in every cycle."""
        return tuple(entry for entry in self.frames if entry.is_cyclic)

    @property
    def unstuffed_bits(self) -> int:
        """Number of bits of a cycle's frames without stuff bits, those at both bit rates added up."""
        return sum(entry.unstuffed.total for entry in self.cyclic)

    @property
    def worst_bits(self) -> int:
        """Number of bits of a cycle's frames with the most stuff bits, those at both bit rates added up."""
        return sum(entry.worst.total for entry in self.cyclic)

    @property
    def feedback_ns(self) -> int:
        """Duration of SYNC and all feedback frames, one after the other."""
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
        """Duration of the longest event frame other than EMCY, ns; 0 without one.

        It can delay SYNC, feedback and commands.
        """
        events = [e.duration_ns for e in self.frames if e.trigger is Trigger.EVENT and not e.is_emergency]
        return max(events, default=0)

    @property
    def cyclic_load(self) -> float:
        """Share of the period, 0 to 1 if they fit, that cyclic frames take at most."""
        return self.cyclic_ns / (self.period_us * 1000)

    @property
    def load(self) -> float:
        """Share of the bus's time that cyclic frames and events take at worst, over 1 if they don't fit.

        Requests and EMCY don't count.
        """
        return sum(
            entry.duration_ns / entry.interval_ns for entry in self.frames if _is_sent(entry, LoadCase.OPERATION)
        )

    @property
    def late(self) -> tuple[FrameBudget, ...]:
        """Frames that may miss their deadline in operation, which is without requests and EMCY."""
        return tuple(entry for entry in self.frames if entry.late_ns() > 0)

    @property
    def is_fit(self) -> bool:
        """Whether every frame meets its deadline in operation, which is without requests and EMCY."""
        return not self.late

    @property
    def line(self) -> str:
        """The verdict in one line: the time left for the host, or a frame that misses its deadline and by how much.

        Of several such frames it names a cyclic one before others, the one that is late by the most, and the number of
        the rest. The line also has the duration of the cyclic frames if the contract fits or they exceed the period.
        """
        where = f"{self.name} at {self.period_us} µs"
        if self.is_fit:
            left = f"{format_us(self.host_ns)} µs left for the host"
            return f"{where} fits: {format_us(self.cyclic_ns)} µs of cyclic frames, {left}"
        reasons = []
        if self.host_ns < 0:
            reasons.append(
                f"the cyclic frames need {format_us(self.cyclic_ns)} µs, {format_us(-self.host_ns)} µs too many"
            )
        first, *more = sorted(self.late, key=lambda entry: (not entry.is_cyclic, -entry.late_ns()))
        reasons.append(_describe_late(first, LoadCase.OPERATION) + (f", {len(more)} more miss theirs" if more else ""))
        return f"{where} doesn't fit: {'; '.join(reasons)}"

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on event frames, requests and EMCY, one line each; () if the contract has none of them."""
        notes = []
        if self.longest_event_ns:
            notes.append(
                f"each event frame in the way takes up to {format_us(self.longest_event_ns)} µs of the host's time"
            )
        if any(entry.trigger is Trigger.REQUEST for entry in self.frames):
            whose = "one SDO" if self.arms == 1 else "one SDO of each host"
            notes.append(f"{whose} in every cycle: {self._describe_traffic(LoadCase.REQUESTS)}")
        if any(entry.is_emergency for entry in self.frames):
            notes.append(f"and every EMCY at once: {self._describe_traffic(LoadCase.EMERGENCIES)}")
        open_ended = [entry for entry in self.frames if not entry.has_interval]
        if open_ended:
            notes.append(
                f"event frames without inhibit time (GenMsgDelayTime): {len(open_ended)}. Nothing bounds how often "
                f"they come; counted once per cycle time, or per {ASSUMED_INTERVAL_MS} ms"
            )
        return tuple(notes)

    def _describe_traffic(self, traffic: LoadCase) -> str:
        """Return as text the cyclic frame with the longest response time in a load case, and whether it is in time."""
        if not self.cyclic:
            return "no cyclic frames"
        last = max(self.cyclic, key=lambda entry: entry.responses[traffic].time_ns)
        if last.late_ns(traffic):
            return _describe_late(last, traffic)
        return f"in time, {last.name} within {format_us(last.responses[traffic].time_ns)} µs"


def format_us(time_ns: int) -> str:
    """Return a time as a text in µs, with one decimal unless it is whole."""
    return f"{time_ns / 1000:.0f}" if time_ns % 1000 == 0 else f"{time_ns / 1000:.1f}"


def _describe_late(entry: FrameBudget, traffic: LoadCase) -> str:
    response = entry.responses[traffic]
    about = "" if response.is_bounded else "at least "
    deadline_ns = entry.deadline_ns or 0
    late = f"{about}{format_us(entry.late_ns(traffic))} µs"
    return f"{entry.name} misses its deadline of {format_us(deadline_ns)} µs by {late}"


def describe_excess(codec: Codec, settings: Settings) -> str:
    """Return in a line how frames of a contract miss their deadlines in the configured period; "" if all meet them.

    "" also for a DBC without attribute Trigger, which can't be judged. Raises CodecError if the DBC has no bit rates or
    an unknown Trigger, or if so many arms can't share its node ids.
    """
    if b'"Trigger"' not in codec.text:
        return ""
    budget = compute_budget(codec, settings.bus.period_us, arms=settings.bus.arms)
    return "" if budget.is_fit else f"contract {codec.path.stem}: {budget.line}"


def compute_budget(
    codec: Codec,
    period_us: int | None = None,
    bitrate: int | None = None,
    data_bitrate: int | None = None,
    arms: int = 1,
) -> Budget:
    """Return the loads and response times of a contract's frames; arms: number of such arms on the bus.

    Period in µs and rates in bit/s default to the DBC's own. A missed deadline raises no error. Raises CodecError if
    the DBC lacks these or the attribute Trigger, has an unknown Trigger, or if so many arms can't share its node ids.
    """
    name, dbc = codec.path.name, codec.database.dbc
    if dbc is None or "Trigger" not in dbc.attribute_definitions:
        raise CodecError(f"DBC {name} has no attribute Trigger, which tells when messages are sent")
    period_us = _given(codec, "BusPeriod_us", period_us)
    bitrate = _given(codec, "Baudrate", bitrate)
    data_bitrate = _given(codec, "BaudrateCANFD", data_bitrate) if codec.is_fd else 0
    one = [_read_frame(message, name, period_us * 1000, bitrate, data_bitrate) for message in codec.database.messages]
    entries = sorted(_share_bus(one, name, arms), key=lambda entry: entry.priority)
    bit_ns = FrameBits(1).duration_ns(bitrate)
    for place, entry in enumerate(entries):
        for traffic in LoadCase:
            entry.responses[traffic] = _respond(entries, place, traffic, bit_ns, period_us * 1000, arms)
    return Budget(name if arms == 1 else f"{arms} × {name}", arms, period_us, bitrate, data_bitrate, tuple(entries))


def _given(codec: Codec, attribute: str, chosen: int | None) -> int:
    """Return `chosen`, or if it is None the value of a DBC's attribute. Raises CodecError unless that is above 0."""
    value = _number(codec.database, attribute, codec.path.name) if chosen is None else chosen
    if value <= 0:
        raise CodecError(f"DBC {codec.path.name} has no {attribute}, and none is given")
    return value


def _number(owner: Database | Message, attribute: str, contract: str) -> int:
    """Return an attribute's value, as by `read_attribute`. Raises CodecError for a text that is no whole number."""
    value = read_attribute(owner, attribute)
    try:
        return int(value)
    except ValueError:
        raise CodecError(f"DBC {contract}: {attribute} = {value!r} is no whole number") from None


def _read_frame(message: Message, contract: str, period_ns: int, bitrate: int, data_bitrate: int) -> FrameBudget:
    """Return the budget of a message, still without response times.

    Interval: the period; of an event frame the first of inhibit time, cycle time and ASSUMED_INTERVAL_MS that isn't 0.
    Deadline: the period for cyclic frames, the cycle time, if any, for event frames, none for requests. contract: name
    of the DBC, for the error. Raises CodecError for an unknown Trigger.
    """
    choices = list(message.dbc.attribute_definitions["Trigger"].choices or ()) if message.dbc else []
    value = read_attribute(message, "Trigger")
    chosen = choices[value] if isinstance(value, int) and 0 <= value < len(choices) else value
    try:
        trigger = Trigger(chosen)
    except ValueError:
        known = ", ".join(trigger.value for trigger in Trigger)
        raise CodecError(f"DBC {contract}: {message.name}: Trigger = {chosen!r}; known: {known}") from None
    cycle_ms, inhibit_ms = (_number(message, f"GenMsg{name}Time", contract) for name in ("Cycle", "Delay"))
    length, is_extended = message.length, message.is_extended_frame
    worst = worst_case_frame(length, is_extended)
    interval_ns, deadline_ns = period_ns, period_ns if trigger is not Trigger.REQUEST else None
    if trigger is Trigger.EVENT:
        interval_ns = (inhibit_ms or cycle_ms or ASSUMED_INTERVAL_MS) * 1_000_000
        deadline_ns = cycle_ms * 1_000_000 or None
    return FrameBudget(
        message.name,
        message.frame_id,
        is_extended,
        length,
        trigger,
        unstuffed_frame(length, is_extended),
        worst,
        worst.duration_ns(bitrate, data_bitrate),
        interval_ns,
        deadline_ns,
        trigger is not Trigger.EVENT or inhibit_ms > 0 or _function(message.frame_id, is_extended) == HEARTBEAT_ID,
    )


def _function(can_id: int, is_extended: bool) -> int:
    """Return an identifier with node id 0, such as 0x700 for a heartbeat; -1 for an extended frame."""
    return -1 if is_extended else can_id & ~NODE_MASK


def _share_bus(frames: list[FrameBudget], contract: str, arms: int) -> list[FrameBudget]:
    """Return the frames of `arms` arms of one contract on a bus, frames without a node id only once.

    One arm's frames are returned as they are. Of several, the devices' node ids follow each other from 1, arm by arm;
    the hosts' go down from the contract's; names begin with `Arm1.` and so on. contract: name of the DBC, for errors.
    Raises CodecError, if there are several arms, for a 29-bit identifier, a node id beyond 126, and one of a host.
    """
    if arms == 1:
        return frames
    nodes = {f.can_id & NODE_MASK for f in frames if f.name != HOST_HEARTBEAT and f.can_id & NODE_MASK}
    first, step = min(nodes, default=1), max(nodes, default=1) - min(nodes, default=1) + 1
    common = [frame for frame in frames if not (frame.is_extended or frame.can_id & NODE_MASK)]
    shared = list(common)
    for arm in range(arms):
        for frame in frames:
            if frame in common:
                continue
            if frame.name == HOST_HEARTBEAT:
                can_id = frame.can_id - arm
            else:
                can_id = move_id(frame.can_id, 1 - first + arm * step, 0, f"DBC {contract}: {frame.name}")
            shared.append(replace(frame, name=f"Arm{arm + 1}.{frame.name}", can_id=can_id, responses={}))
    if len({frame.can_id for frame in shared}) < len(shared):
        raise CodecError(f"DBC {contract}: a device of {arms} arms has the node id of a host")
    return shared


def _is_sent(entry: FrameBudget, traffic: LoadCase) -> bool:
    """Return whether a load case has the frame on the bus; no case has NMT commands of Trigger request."""
    if entry.trigger is Trigger.REQUEST:
        return traffic is not LoadCase.OPERATION and entry.can_id != NMT_ID
    return not entry.is_emergency or traffic is LoadCase.EMERGENCIES


def _respond(
    entries: list[FrameBudget], place: int, traffic: LoadCase, bit_ns: int, period_ns: int, hosts: int
) -> ResponseTime:
    """Return the response time in a load case of the frame at index `place` of all, in arbitration order.

    Each of `hosts` sends one request a period; a request itself is judged without other requests. A frame that the load
    case lacks is judged as a single one.
    """
    entry = entries[place]
    above = [other for other in entries[:place] if _is_sent(other, traffic)]
    below = [other for other in entries[place + 1 :] if _is_sent(other, traffic)]
    if entry.trigger is Trigger.REQUEST:
        above, below = ([o for o in part if o.trigger is not Trigger.REQUEST] for part in (above, below))
    higher = [Stream(o.duration_ns, o.interval_ns) for o in above if o.trigger is not Trigger.REQUEST]
    request_ns = max((o.duration_ns for o in above if o.trigger is Trigger.REQUEST), default=0)
    if request_ns:
        higher.extend([Stream(request_ns, period_ns)] * hosts)
    blocking_ns = max((o.duration_ns for o in below), default=0)
    # A frame that doesn't occur in this load case is judged as a single one.
    interval_ns = entry.interval_ns if _is_sent(entry, traffic) else ASSUMED_INTERVAL_MS * 1_000_000
    stream = Stream(entry.duration_ns, interval_ns)
    return response_time(stream, higher, blocking_ns, bit_ns, entry.deadline_ns)
