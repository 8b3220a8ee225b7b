"""Bit budget of a contract: whether its frames get through in time, from the DBC alone.

DBC attributes: of the network `Baudrate`, `BaudrateCANFD` (bit/s; 0: classic), `BusPeriod_us`; of a message `Trigger`,
`GenMsgCycleTime` (ms, period of an event frame), `GenMsgDelayTime` (ms, its inhibit time).

| trigger | counted as | must be through |
|---|---|---|
| sync | once per SYNC, SYNC itself included | before the next SYNC |
| command | once per SYNC, after the feedback | before the next SYNC |
| event | once per inhibit time; without one, per cycle time; without both, per 100 ms | within its cycle time |
| request | not while operating, or one SDO frame per SYNC | at leisure |

All cyclic frames are taken as queued together with SYNC. That is never better than the truth for the last of them, and
needs nothing known about the devices' and the host's delays. Response times (`adacd_hil.wire.response_time`) are found
for three kinds of traffic: operation (without requests and EMCY), which decides whether the contract fits; the same
with one SDO frame per SYNC; and with the EMCY of every device besides. What the last two make late is said, not failed:
a command that is late acts one SYNC later. NMT commands begin and end operation and disturb none of them.

On a bus that arms share, what has no node id counts once and everything else once per arm.
"""

from dataclasses import dataclass, replace
from enum import Enum

import cantools
from cantools.database.can import Database, Message

from adacd_hil.wire.codec import Codec, CodecError
from adacd_hil.wire.frame_bits import CLASSIC_BYTES, FrameBits, unstuffed_frame, worst_case_frame
from adacd_hil.wire.node_offset import NODE_MASK, move_id
from adacd_hil.wire.response_time import Response, Stream, response_time

ASSUMED_INTERVAL_MS = 100
"""Interval of an event frame that declares none: the usual heartbeat period."""
_NMT_ID = 0  # CiA 301, pre-defined connection set
_HOST_HEARTBEAT = "HostHeartbeat"
_EMCY_FUNCTION = 1  # 0x080 + node; 0x080 itself is SYNC
_HEARTBEAT_FUNCTION = 14  # 0x700 + node


class Trigger(Enum):
    """When a frame is sent; the DBC's `Trigger`."""

    SYNC = "sync"
    COMMAND = "command"
    EVENT = "event"
    REQUEST = "request"


class Traffic(Enum):
    """Which frames are on the bus besides the cyclic ones."""

    OPERATION = "operation"
    REQUESTS = "requests"
    EMERGENCIES = "emergencies"


@dataclass(frozen=True)
class ContractFrame:
    """What a contract says of a message."""

    name: str
    can_id: int
    is_extended: bool
    length: int
    trigger: Trigger
    cycle_ms: int
    inhibit_ms: int

    @property
    def priority(self) -> tuple[int, int]:
        """Order of arbitration; the lower wins. A base frame wins over an extended one with the same first 11 bits."""
        return (self.can_id >> 18, 1 + (self.can_id & 0x3FFFF)) if self.is_extended else (self.can_id, 0)

    @property
    def is_cyclic(self) -> bool:
        """Whether it is sent on every SYNC."""
        return self.trigger in (Trigger.SYNC, Trigger.COMMAND)

    @property
    def is_emergency(self) -> bool:
        """Whether it is a CiA 301 EMCY."""
        is_emcy_id = not self.is_extended and self.can_id >> 7 == _EMCY_FUNCTION and self.can_id & 0x7F != 0
        return is_emcy_id and self.trigger is Trigger.EVENT

    @property
    def has_interval(self) -> bool:
        """Whether something bounds how often it is sent; a heartbeat keeps its time."""
        is_heartbeat = not self.is_extended and self.can_id >> 7 == _HEARTBEAT_FUNCTION
        return self.trigger is not Trigger.EVENT or self.inhibit_ms > 0 or is_heartbeat

    def interval_ns(self, period_ns: int) -> int:
        """Smallest time between two of them that is counted with."""
        if self.trigger is Trigger.EVENT:
            return (self.inhibit_ms or self.cycle_ms or ASSUMED_INTERVAL_MS) * 1_000_000
        return period_ns

    def deadline_ns(self, period_ns: int) -> int | None:
        """Time within which it must be through; None: at leisure."""
        if self.is_cyclic:
            return period_ns
        return self.cycle_ms * 1_000_000 if self.trigger is Trigger.EVENT and self.cycle_ms else None


@dataclass(frozen=True)
class Contract:
    """Frames of a DBC in the order of arbitration; rates in bit/s; a period of 0 is not given.

    `arms`: how many, each with a host.
    """

    name: str
    bitrate: int
    data_bitrate: int
    period_us: int
    frames: tuple[ContractFrame, ...]
    arms: int = 1


@dataclass(frozen=True)
class FrameBudget:
    """What a message needs and how long it may take."""

    frame: ContractFrame
    unstuffed: FrameBits
    worst: FrameBits
    duration_ns: int
    interval_ns: int
    deadline_ns: int | None
    responses: dict[Traffic, Response]

    def late_ns(self, traffic: Traffic = Traffic.OPERATION) -> int:
        """How far it may be beyond its deadline (at least, where the response is unbounded); 0: in time."""
        response = self.responses[traffic]
        if self.deadline_ns is None:
            return 0
        return max(response.time_ns - self.deadline_ns, 0 if response.is_bounded else 1)


@dataclass(frozen=True)
class Budget:
    """Budget of a contract at a period and bit rates. Times in ns, at worst-case stuffing."""

    contract: Contract
    period_us: int
    bitrate: int
    data_bitrate: int
    frames: tuple[FrameBudget, ...]

    def _sum_ns(self, *triggers: Trigger) -> int:
        return sum(entry.duration_ns for entry in self.frames if entry.frame.trigger in triggers)

    @property
    def cyclic(self) -> tuple[FrameBudget, ...]:
        """The frames of every cycle."""
        return tuple(entry for entry in self.frames if entry.frame.is_cyclic)

    @property
    def unstuffed_bits(self) -> int:
        """Bits of a cycle without stuffing, of both rates."""
        return sum(entry.unstuffed.total for entry in self.cyclic)

    @property
    def worst_bits(self) -> int:
        """Bits of a cycle at worst, of both rates."""
        return sum(entry.worst.total for entry in self.cyclic)

    @property
    def feedback_ns(self) -> int:
        """From SYNC until the last feedback is in."""
        return self._sum_ns(Trigger.SYNC)

    @property
    def command_ns(self) -> int:
        """Time of the commands."""
        return self._sum_ns(Trigger.COMMAND)

    @property
    def cyclic_ns(self) -> int:
        """Time of all frames of a cycle."""
        return self.feedback_ns + self.command_ns

    @property
    def host_ns(self) -> int:
        """What is left between the last feedback and the last moment to send commands; negative: it doesn't fit."""
        return self.period_us * 1000 - self.cyclic_ns

    @property
    def longest_event_ns(self) -> int:
        """The longest event frame: it can be in the way of SYNC, of feedback and of commands."""
        events = [e.duration_ns for e in self.frames if e.frame.trigger is Trigger.EVENT and not e.frame.is_emergency]
        return max(events, default=0)

    @property
    def cyclic_load(self) -> float:
        """Share of the time that cyclic frames take at worst."""
        return self.cyclic_ns / (self.period_us * 1000)

    @property
    def load(self) -> float:
        """Share of the time in operation: cyclic frames and events, at worst, without requests and EMCY."""
        return sum(entry.duration_ns / entry.interval_ns for entry in self.frames if _is_sent(entry, Traffic.OPERATION))

    @property
    def late(self) -> tuple[FrameBudget, ...]:
        """The frames that may miss their deadline in operation."""
        return tuple(entry for entry in self.frames if entry.late_ns() > 0)

    @property
    def is_fit(self) -> bool:
        """Whether every frame gets through in time in operation."""
        return not self.late

    @property
    def line(self) -> str:
        """The verdict."""
        where = f"{self.contract.name} at {self.period_us} µs"
        if self.is_fit:
            return f"{where} fits: {us(self.cyclic_ns)} µs of cyclic frames, {us(self.host_ns)} µs left for the host"
        reasons = []
        if self.host_ns < 0:
            reasons.append(f"the cyclic frames need {us(self.cyclic_ns)} µs, {us(-self.host_ns)} µs too many")
        first, *more = sorted(self.late, key=lambda entry: (not entry.frame.is_cyclic, -entry.late_ns()))
        reasons.append(_describe_late(first, Traffic.OPERATION) + (f", {len(more)} more miss theirs" if more else ""))
        return f"{where} doesn't fit: {'; '.join(reasons)}"

    @property
    def notes(self) -> tuple[str, ...]:
        """What disturbs a contract, one line each."""
        notes = []
        if self.longest_event_ns:
            notes.append(f"each event frame in the way takes up to {us(self.longest_event_ns)} µs of the host's time")
        if any(entry.frame.trigger is Trigger.REQUEST for entry in self.frames):
            whose = "one SDO" if self.contract.arms == 1 else "one SDO of each host"
            notes.append(f"{whose} in every cycle: {self._describe_traffic(Traffic.REQUESTS)}")
        if any(entry.frame.is_emergency for entry in self.frames):
            notes.append(f"and every EMCY at once: {self._describe_traffic(Traffic.EMERGENCIES)}")
        open_ended = [entry.frame for entry in self.frames if not entry.frame.has_interval]
        if open_ended:
            notes.append(
                f"event frames without inhibit time (GenMsgDelayTime): {len(open_ended)}. Nothing bounds how often "
                f"they come; counted once per cycle time, or per {ASSUMED_INTERVAL_MS} ms"
            )
        return tuple(notes)

    def _describe_traffic(self, traffic: Traffic) -> str:
        if not self.cyclic:
            return "no cyclic frames"
        last = max(self.cyclic, key=lambda entry: entry.responses[traffic].time_ns)
        if last.late_ns(traffic):
            return _describe_late(last, traffic)
        return f"in time, {last.frame.name} within {us(last.responses[traffic].time_ns)} µs"


def us(time_ns: int) -> str:
    """Write a time in µs, with a decimal where there is one."""
    return f"{time_ns / 1000:.0f}" if time_ns % 1000 == 0 else f"{time_ns / 1000:.1f}"


def _describe_late(entry: FrameBudget, traffic: Traffic) -> str:
    response = entry.responses[traffic]
    about = "" if response.is_bounded else "at least "
    deadline_ns = entry.deadline_ns or 0
    return f"{entry.frame.name} misses its deadline of {us(deadline_ns)} µs by {about}{us(entry.late_ns(traffic))} µs"


def read_contract(text: bytes, name: str) -> Contract:
    """Read the timing of a DBC that `load_codec` has accepted. Raises CodecError."""
    database = cantools.database.load_string(text.decode("utf-8"), "dbc")
    if not isinstance(database, Database):
        raise CodecError(f"DBC {name} holds no CAN messages")
    definitions = database.dbc.attribute_definitions if database.dbc else {}
    if "Trigger" not in definitions:
        raise CodecError(f"DBC {name} doesn't say when its messages are sent: it has no Trigger attribute")
    frames = [_read_frame(message, name) for message in database.messages]
    return Contract(
        name,
        int(_attribute(database, "Baudrate")),
        int(_attribute(database, "BaudrateCANFD")),
        int(_attribute(database, "BusPeriod_us")),
        tuple(sorted(frames, key=lambda frame: frame.priority)),
    )


def _read_frame(message: Message, contract: str) -> ContractFrame:
    choices = list(message.dbc.attribute_definitions["Trigger"].choices or ()) if message.dbc else []
    value = _attribute(message, "Trigger")
    chosen = choices[value] if isinstance(value, int) and 0 <= value < len(choices) else value
    try:
        trigger = Trigger(chosen)
    except ValueError:
        known = ", ".join(trigger.value for trigger in Trigger)
        raise CodecError(f"DBC {contract}: {message.name}: Trigger = {chosen!r}; known: {known}") from None
    cycle_ms, inhibit_ms = int(_attribute(message, "GenMsgCycleTime")), int(_attribute(message, "GenMsgDelayTime"))
    return ContractFrame(
        message.name, message.frame_id, message.is_extended_frame, message.length, trigger, cycle_ms, inhibit_ms
    )


def _attribute(owner: Database | Message, name: str) -> int | str:
    """Value of an attribute, its default, or 0 where the DBC doesn't know it."""
    if owner.dbc is None or name not in owner.dbc.attribute_definitions:
        return 0
    attribute = owner.dbc.attributes.get(name)
    value = owner.dbc.attribute_definitions[name].default_value if attribute is None else attribute.value
    return value if isinstance(value, str) else int(value or 0)


def share_bus(contract: Contract, arms: int) -> Contract:
    """Return what is on a bus that several arms of a contract share, whatever their order on it.

    The devices' node ids follow each other from 1, the hosts' go down from the contract's. Raises CodecError for an
    identifier without node id.
    """
    if arms == 1:
        return contract
    nodes = {f.can_id & NODE_MASK for f in contract.frames if f.name != _HOST_HEARTBEAT and f.can_id & NODE_MASK}
    first, step = min(nodes, default=1), max(nodes, default=1) - min(nodes, default=1) + 1
    frames = [frame for frame in contract.frames if not (frame.is_extended or frame.can_id & NODE_MASK)]
    for arm in range(arms):
        for frame in contract.frames:
            if frame in frames:
                continue
            if frame.name == _HOST_HEARTBEAT:
                can_id = frame.can_id - arm
            else:
                can_id = move_id(frame.can_id, 1 - first + arm * step, 0, f"DBC {contract.name}: {frame.name}")
            frames.append(replace(frame, name=f"Arm{arm + 1}.{frame.name}", can_id=can_id))
    frames.sort(key=lambda frame: frame.priority)
    return replace(contract, name=f"{arms} × {contract.name}", frames=tuple(frames), arms=arms)


def check_budget(
    codec: Codec,
    period_us: int | None = None,
    bitrate: int | None = None,
    data_bitrate: int | None = None,
    arms: int = 1,
) -> Budget:
    """Find the budget of a contract, or of several arms of it on one bus.

    Period in µs and rates in bit/s default to the DBC's own. Raises CodecError.
    """
    contract = share_bus(read_contract(codec.text, codec.path.name), arms)
    return find_budget(contract, period_us, bitrate, data_bitrate)


def find_budget(
    contract: Contract, period_us: int | None = None, bitrate: int | None = None, data_bitrate: int | None = None
) -> Budget:
    """Find the budget of a contract; see `check_budget`."""
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
        for traffic in Traffic:
            entry.responses[traffic] = _respond(entries, place, traffic, bit_ns, period_ns, contract.arms)
    return Budget(contract, period_us, bitrate, data_bitrate, tuple(entries))


def _given(contract: Contract, attribute: str, chosen: int | None, declared: int) -> int:
    value = declared if chosen is None else chosen
    if value <= 0:
        raise CodecError(f"DBC {contract.name} has no {attribute}, and none is given")
    return value


def _is_sent(entry: FrameBudget, traffic: Traffic) -> bool:
    if entry.frame.trigger is Trigger.REQUEST:
        return traffic is not Traffic.OPERATION and entry.frame.can_id != _NMT_ID
    return not entry.frame.is_emergency or traffic is Traffic.EMERGENCIES


def _respond(
    entries: list[FrameBudget], place: int, traffic: Traffic, bit_ns: int, period_ns: int, hosts: int
) -> Response:
    """Response time of the frame at `place` in the order of arbitration, one request at most of a host in a period."""
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
    # A frame that this traffic doesn't have is judged as a single one.
    interval_ns = entry.interval_ns if _is_sent(entry, traffic) else ASSUMED_INTERVAL_MS * 1_000_000
    stream = Stream(entry.duration_ns, interval_ns)
    return response_time(stream, higher, blocking_ns, bit_ns, entry.deadline_ns)
