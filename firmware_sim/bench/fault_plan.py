"""What a scenario's faults do now: to frames, to measured values, and to nodes.

A bench tells the plan the time at every SYNC and whenever `wait_ns` is over; then it asks. Frames are known by the
contract's identifiers. Nodes are places in `NODES`; times are ns.

Each row draws from a stream of its own, which follows from the seed, the row's kind, node and frame or signal, and how
many rows before it are alike in these. So rows that come or go leave the draws of the others alone, and so do the
numbers within a row. A row draws for each frame that it is about, whatever other rows do to that frame.
"""

import random
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from typing import NamedTuple

from adacd_hil.settings.schema import ConfigError
from adacd_hil.wire.codec import Codec, CodecError, MessageCodec
from adacd_hil.wire.e2e import Protection, crc8, crc16
from adacd_hil.wire.time_marks import NEVER_NS
from firmware_sim.arm.sensing import POSITION_LSB_RAD, TORQUE_COUNTS, TORQUE_LSB_NM, VELOCITY_LSB_RAD_S
from firmware_sim.scenario.faults import NODES, FaultSettings

EVERYBODY = -1
"""For `receive`: a frame that comes to all devices at once."""

PLANNED_PERIOD_NS = 1_000_000
"""How long a fault without length, such as a reboot, is active."""
_ANY_FRAME = -1  # in place of an identifier
_BEFORE_NS = -1  # scenario time before the drives are enabled
_NOT_VALID = 0x01  # of 0x6150
_DBC_NAMES = {
    "feedback": "Feedback",
    "torque": "Torque",
    "status": "Status",
    "command": "Command",
    "heartbeat": "Heartbeat",
    "emcy": "Emcy",
    "sdo_request": "SdoRequest",
    "sdo_response": "SdoResponse",
}
_SIGNALS = {"position": (0, POSITION_LSB_RAD), "velocity": (1, VELOCITY_LSB_RAD_S), "torque": (2, TORQUE_LSB_NM)}
_FRAME_KINDS = ("lose", "duplicate", "delay", "reorder", "corrupt", "freeze_counter")
_VALUE_KINDS = ("stick", "jump", "saturate")
_INSTANT_KINDS = ("reboot", "drive_fault")
_NODES_OWN = ("wrong_node_id", "duplicate_node_id", "drive_fault", "sensor_error", "clock_drift")
"""What a node does by itself once it has been told."""

Sent = list[tuple[int, bytes]]
Pair = tuple[int, int]
Place = tuple[int, int]
"""Node and identifier."""


class FaultEdge(NamedTuple):
    """A row that begins or ends now."""

    row: int
    begins: bool
    text: str


class ActionKind(Enum):
    """What happens to a node. `NodeAction.value` is in brackets."""

    POWER_OFF = "power off"
    POWER_ON = "power on"
    LEAVE_BUS = "leave bus"
    RETURN_TO_BUS = "return to bus"
    EMERGENCY = "emergency"  # error code
    FAIL = "fail"  # error code
    MEND = "mend"
    SENSOR_STATUS = "sensor status"  # bits of 0x6150, 0: none
    DRIFT = "drift"  # ppm, 0: none


class NodeAction(NamedTuple):
    """Something that happens to a node now."""

    kind: ActionKind
    node: int
    value: float = 0


class _Row:
    """One row and what it has done so far."""

    def __init__(self, index: int, settings: FaultSettings, seed: str, period_ns: int) -> None:
        self.index = index
        self.settings = settings
        self.draws = random.Random(seed)
        self.begin_ns = settings.onset_ns
        duration_ns = settings.duration_ns
        if settings.kind in _INSTANT_KINDS and not duration_ns:
            duration_ns = period_ns
        self.end_ns = NEVER_NS if duration_ns is None else self.begin_ns + duration_ns
        self.is_active = self.is_over = False
        self.hits_left = NEVER_NS if settings.count is None else settings.count
        self.sent = 0
        self.held: dict[int, Sent] = {}
        self.kept: dict[int, int] = {}

    @property
    def next_ns(self) -> int:
        """When it begins or ends."""
        return NEVER_NS if self.is_over else self.end_ns if self.is_active else self.begin_ns

    @property
    def flood_ns(self) -> int:
        """When the next frame of a flood is due."""
        rate_Hz = self.settings.rate_Hz or 0.0
        return self.begin_ns + round(self.sent * 1e9 / rate_Hz) if rate_Hz and self.hits_left > 0 else NEVER_NS

    def hit(self) -> bool:
        """Draw whether a frame or value is hit, and count it."""
        if self.hits_left <= 0 or not self.is_active:
            return False
        chance = self.settings.chance
        if chance < 1.0 and self.draws.random() >= chance:
            return False
        self.hits_left -= 1
        return True

    def late_ns(self) -> int:
        """Draw how late."""
        settings = self.settings
        jitter_us = settings.jitter_us * self.draws.random() if settings.jitter_us else 0.0
        return round(((settings.delay_us or 0.0) + jitter_us) * 1e3)


class FaultPlan:
    """The faults of one scenario over time."""

    def __init__(self, rows: Sequence[FaultSettings], seed: int, period_ns: int, codec: Codec) -> None:
        """Begin before power-on. `period_ns`: SYNC's. Raises ConfigError for a frame that the contract hasn't."""
        self.mask = 0
        """Bit i: row i is active."""
        self.is_quiet = True
        """Whether nothing acts on frames or values and nothing is left to be done; then `advance` is all it needs."""
        self._period_ns = period_ns
        self._rows = tuple(
            _Row(index, row, seed_text, period_ns) for index, (row, seed_text) in enumerate(_seeds(rows, seed))
        )
        self._places = tuple(_find_frames(codec, index, row) for index, row in enumerate(rows))
        self._messages = codec.by_id
        self._scenario_ns, self._power_ns = _BEFORE_NS, _BEFORE_NS
        self._next_scenario_ns = self._next_power_ns = NEVER_NS
        self._sending: dict[Place, tuple[_Row, ...]] = {}
        self._receiving: dict[Place, tuple[_Row, ...]] = {}
        self._silent: frozenset[int] = frozenset()
        self._distorting: tuple[_Row, ...] = ()
        self._slowing: tuple[_Row, ...] = ()
        self._babbling: tuple[_Row, ...] = ()
        self._actions: list[NodeAction] = []
        self._off: frozenset[int] = frozenset()
        self._off_bus: frozenset[int] = frozenset()
        self._bits: dict[int, int] = {}
        self._drifts: dict[int, float] = {}
        self._plan_next()

    @property
    def wait_ns(self) -> int:
        """How long after the last `advance` a row begins or ends by time, or a node's storm goes on, at the latest."""
        wait_ns = NEVER_NS
        for now_ns, next_ns in (
            (self._scenario_ns, self._next_scenario_ns),
            (self._power_ns, self._next_power_ns),
        ):
            if now_ns >= 0 and next_ns < NEVER_NS:
                wait_ns = min(wait_ns, max(0, next_ns - now_ns))
        return wait_ns

    @property
    def is_acknowledged(self) -> bool:
        """Whether some device has power and is on the bus, so that what the host sends is acknowledged."""
        return len(self._off | self._off_bus) < len(NODES)

    @property
    def is_flooding(self) -> bool:
        """Whether `babble` has something to say."""
        return bool(self._babbling)

    def advance(self, scenario_ns: int, since_power_on_ns: int = _BEFORE_NS) -> list[FaultEdge]:
        """Let time pass; return the rows that begin and end, in order.

        scenario_ns: since both drives were enabled, negative before. since_power_on_ns: negative where nothing is to
        count from there. Neither goes back.
        """
        self._scenario_ns, self._power_ns = scenario_ns, since_power_on_ns
        is_due = scenario_ns >= self._next_scenario_ns or since_power_on_ns >= self._next_power_ns
        if not is_due and self.is_quiet:
            return []
        edges = [edge for row in self._rows for edge in self._move(row)]
        if edges:
            self._take_over()
        self._plan_next()
        self._find_quiet()
        return edges

    def actions(self) -> list[NodeAction]:
        """Take what happens to nodes now, in order."""
        taken, self._actions = self._actions, []
        self._find_quiet()
        return taken

    def transmit(self, node: int, can_id: int, data: bytes) -> list[tuple[int, int, bytes]]:
        """Return what becomes of a frame that a node sends: delay in ns, identifier, data of each."""
        if node in self._silent:
            return []
        rows = self._sending.get((node, can_id)) or self._sending.get((node, _ANY_FRAME))
        if not rows:
            return [(0, can_id, data)]
        return [(delay_ns, can_id, changed) for delay_ns, changed in self._change(rows, can_id, data)]

    def receive(self, node: int, can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        """Return what becomes of a frame of the host on its way to a node: delay in ns and data of each.

        A frame that comes to all devices is asked for with `EVERYBODY` first, and what is left of it for each node.
        """
        rows = self._receiving.get((node, can_id))
        return self._change(rows, can_id, data) if rows else [(0, data)]

    def distort(self, position: Pair, velocity: Pair, torque: Pair) -> tuple[Pair, Pair, Pair]:
        """Return what the devices take for measured in the body's counts, joint 1 and 2 each. Once per SYNC."""
        if not self._distorting:
            return position, velocity, torque
        values = [list(position), list(velocity), list(torque)]
        for row in self._distorting:
            which, lsb = _SIGNALS[row.settings.signal or ""]
            for node in row.settings.nodes:
                joint = node % 2
                values[which][joint] = self._distort(row, node, values[which][joint], lsb)
        (position1, position2), (velocity1, velocity2), (torque1, torque2) = values
        return (position1, position2), (velocity1, velocity2), (torque1, torque2)

    def sync_delay_ns(self) -> int:
        """Draw how late this SYNC reaches the devices. Once per SYNC."""
        return sum(row.late_ns() for row in self._slowing if row.hit())

    def babble(self, period_ns: int) -> list[tuple[int, int, bytes]]:
        """Return the flood's frames within `period_ns` from the last `advance` on: offset in ns, identifier, data."""
        frames = []
        for row in self._babbling:
            settings = row.settings
            now_ns = self._now_ns(row)
            end_ns = min(now_ns + period_ns, row.end_ns)
            data = bytes(8) if settings.data is None else bytes.fromhex(settings.data)
            while (due_ns := row.flood_ns) < end_ns:
                row.sent += 1
                if due_ns < now_ns:
                    continue  # nobody asked for that time
                row.hits_left -= 1
                if not self._off.union(self._off_bus).issuperset(settings.nodes):
                    frames.append((due_ns - now_ns, settings.can_id or 0, data))
        return sorted(frames)

    def _now_ns(self, row: _Row) -> int:
        return self._power_ns if row.settings.is_from_power_on else self._scenario_ns

    def _move(self, row: _Row) -> list[FaultEdge]:
        """Let a row begin or end if it is time."""
        edges: list[FaultEdge] = []
        now_ns = self._now_ns(row)
        if not row.is_active and not row.is_over and row.begin_ns <= now_ns:
            row.is_active = True
            self._begin(row)
            edges.append(FaultEdge(row.index, True, f"begins: {row.settings.text}"))
        if row.is_active and row.settings.kind == "emcy_storm":
            self._storm(row)
        if row.is_active and (now_ns >= row.end_ns or row.hits_left <= 0):
            row.is_active, row.is_over = False, True
            edges.append(FaultEdge(row.index, False, f"ends: {row.settings.text}"))
        return edges

    def _begin(self, row: _Row) -> None:
        """Do what happens to nodes once, without an end."""
        settings = row.settings
        for node in settings.nodes:
            if settings.kind == "reboot" and not settings.duration_ns:
                self._actions += [NodeAction(ActionKind.POWER_OFF, node), NodeAction(ActionKind.POWER_ON, node)]
            elif settings.kind == "drive_fault" and not settings.duration_ns:
                code = settings.code or 0
                self._actions += [NodeAction(ActionKind.FAIL, node, code), NodeAction(ActionKind.MEND, node)]

    def _take_over(self) -> None:
        """Make the tables of what acts now, and let happen to nodes what follows."""
        active = [row for row in self._rows if row.is_active]
        self.mask = sum(1 << row.index for row in active)
        self._distorting = _of(active, *_VALUE_KINDS)
        self._slowing = _of(active, "late_sync")
        self._babbling = _of(active, "babble")
        self._silent = _nodes_of(_of(active, "silence"))
        self._sort_frames()
        self._switch(active)

    def _sort_frames(self) -> None:
        """Find the rows of each frame, in their order."""
        rows = _of([row for row in self._rows if row.is_active or row.held], *_FRAME_KINDS)
        received = [row for row in rows if row.settings.is_received]
        sent = [row for row in rows if not row.settings.is_received]
        self._receiving = _by_place(received, self._places)
        self._sending = _by_place(sent, self._places)
        for node, can_id in self._sending:
            rows_of_any = self._sending.get((node, _ANY_FRAME), ())
            if can_id != _ANY_FRAME and rows_of_any:
                both = {*self._sending[node, can_id], *rows_of_any}
                self._sending[node, can_id] = tuple(sorted(both, key=lambda row: row.index))

    def _switch(self, active: list[_Row]) -> None:
        """Let happen to nodes what has changed: power, bus, failures, sensor status, clocks."""
        lasting = [row for row in active if row.settings.kind == "power_loss" or row.settings.duration_ns]
        off = _nodes_of(_of(lasting, "power_loss", "reboot"))
        off_bus = _nodes_of(_of(active, "bus_off"))
        self._act(ActionKind.POWER_OFF, off - self._off)
        self._act(ActionKind.LEAVE_BUS, off_bus - self._off_bus)
        self._act(ActionKind.POWER_ON, self._off - off)
        self._act(ActionKind.RETURN_TO_BUS, self._off_bus - off_bus)
        self._off, self._off_bus = off, off_bus
        self._switch_failures(_of(lasting, "drive_fault"))
        bits: dict[int, int] = {}
        for node, row in _each_node(_of(active, "sensor_error")):
            bits[node] = bits.get(node, 0) | (row.settings.status or _NOT_VALID)
        drifts: dict[int, float] = {}
        for node, row in _each_node(_of(active, "clock_drift")):
            drifts[node] = drifts.get(node, 0.0) + (row.settings.drift_ppm or 0.0)
        self._act_by_value(ActionKind.SENSOR_STATUS, self._bits, bits)
        self._act_by_value(ActionKind.DRIFT, self._drifts, drifts)
        self._bits, self._drifts = bits, drifts

    def _switch_failures(self, failing: tuple[_Row, ...]) -> None:
        for row in self._rows:
            if row.settings.kind != "drive_fault" or not row.settings.duration_ns:
                continue
            (node,) = row.settings.nodes
            if row in failing and not row.sent:
                row.sent = 1
                self._actions.append(NodeAction(ActionKind.FAIL, node, row.settings.code or 0))
            elif row.is_over and row.sent == 1:
                row.sent = 2
                if not any(node in other.settings.nodes for other in failing):
                    self._actions.append(NodeAction(ActionKind.MEND, node))

    def _act(self, kind: ActionKind, nodes: frozenset[int]) -> None:
        self._actions.extend(NodeAction(kind, node) for node in sorted(nodes))

    def _act_by_value(self, kind: ActionKind, before: Mapping[int, float], after: Mapping[int, float]) -> None:
        for node in range(len(NODES)):
            value = after.get(node, 0)
            if value != before.get(node, 0):
                self._actions.append(NodeAction(kind, node, value))

    def _storm(self, row: _Row) -> None:
        """Let the EMCY messages happen that are due by now."""
        now_ns = min(self._now_ns(row), row.end_ns - 1)
        (node,) = row.settings.nodes
        while row.flood_ns <= now_ns:
            row.sent += 1
            row.hits_left -= 1
            self._actions.append(NodeAction(ActionKind.EMERGENCY, node, row.settings.code or 0))

    def _change(self, rows: tuple[_Row, ...], can_id: int, data: bytes) -> Sent:
        """Let the rows act on one frame, one after the other."""
        frames: Sent = [(0, data)]
        for row in rows:
            if row.settings.kind == "reorder":
                frames = self._swap(row, can_id, frames)
            elif row.hit():
                frames = _CHANGES[row.settings.kind](row, self._messages.get(can_id), frames)
        return frames

    def _swap(self, row: _Row, can_id: int, frames: Sent) -> Sent:
        """Hold a frame back until the next with its identifier has overtaken it."""
        if can_id in row.held:
            overtaken = row.held.pop(can_id)
            if not row.is_active:
                self._sort_frames()
                self._find_quiet()
            return frames + overtaken
        if not (row.hit() and frames):
            return frames
        row.held[can_id] = frames
        return []

    @staticmethod
    def _distort(row: _Row, node: int, counts: int, lsb: float) -> int:
        """Return what becomes of one value."""
        settings = row.settings
        if not row.hit():
            return counts
        is_torque = settings.signal == "torque"
        if settings.kind == "stick":
            return row.kept.setdefault(node, counts)
        if settings.kind == "jump":
            moved = counts + round((settings.step or 0.0) / lsb)
            return min(max(moved, TORQUE_COUNTS[0]), TORQUE_COUNTS[1]) if is_torque else moved
        if settings.value is None:
            return TORQUE_COUNTS[counts >= 0]
        bound = round(settings.value / lsb)
        return min(max(counts, -bound), bound)

    def _plan_next(self) -> None:
        """Find out when something begins, ends or happens next."""
        by_scenario = [row for row in self._rows if not row.settings.is_from_power_on]
        by_power = [row for row in self._rows if row.settings.is_from_power_on]
        self._next_scenario_ns = min(map(_next_ns, by_scenario), default=NEVER_NS)
        self._next_power_ns = min(map(_next_ns, by_power), default=NEVER_NS)

    def _find_quiet(self) -> None:
        is_acting = any(row.is_active and row.settings.kind not in _NODES_OWN for row in self._rows)
        self.is_quiet = not (is_acting or self._actions or any(row.held for row in self._rows))


def _next_ns(row: _Row) -> int:
    is_storming = row.is_active and row.settings.kind == "emcy_storm"
    return min(row.next_ns, row.flood_ns) if is_storming else row.next_ns


def _of(rows: Sequence[_Row], *kinds: str) -> tuple[_Row, ...]:
    return tuple(row for row in rows if row.settings.kind in kinds)


def _nodes_of(rows: Sequence[_Row]) -> frozenset[int]:
    return frozenset(node for row in rows for node in row.settings.nodes)


def _each_node(rows: Sequence[_Row]) -> list[tuple[int, _Row]]:
    return [(node, row) for row in rows for node in row.settings.nodes]


def _by_place(rows: Sequence[_Row], places: Sequence[frozenset[Place]]) -> dict[Place, tuple[_Row, ...]]:
    found: dict[Place, tuple[_Row, ...]] = {}
    for row in rows:
        for place in places[row.index]:
            found[place] = (*found.get(place, ()), row)
    return found


def _lose(_row: _Row, _message: MessageCodec | None, _frames: Sent) -> Sent:
    return []


def _duplicate(_row: _Row, _message: MessageCodec | None, frames: Sent) -> Sent:
    return [frame for frame in frames for _ in range(2)]


def _delay(row: _Row, _message: MessageCodec | None, frames: Sent) -> Sent:
    late_ns = row.late_ns()
    return [(delay_ns + late_ns, data) for delay_ns, data in frames]


def _corrupt(row: _Row, _message: MessageCodec | None, frames: Sent) -> Sent:
    return [(delay_ns, _flip(row, data)) for delay_ns, data in frames]


def _flip(row: _Row, data: bytes) -> bytes:
    """Flip the bits of the mask, or random ones."""
    settings = row.settings
    bits = int.from_bytes(data, "little")
    if settings.mask is not None:
        bits ^= int.from_bytes(bytes.fromhex(settings.mask)[: len(data)], "little")
    else:
        size = 8 * len(data)
        for bit in row.draws.sample(range(size), min(settings.bits or 1, size)):
            bits ^= 1 << bit
    return bits.to_bytes(len(data), "little")


def _freeze_counter(row: _Row, message: MessageCodec | None, frames: Sent) -> Sent:
    if message is None:
        return frames
    return [
        (delay_ns, _freeze(row, message, data) if len(data) == message.length else data) for delay_ns, data in frames
    ]


def _freeze(row: _Row, message: MessageCodec, data: bytes) -> bytes:
    """Give a protected frame the counter of the first one, and the CRC that goes with it."""
    frame = bytearray(data)
    if message.protection is Protection.PROFILE_2:
        counter = row.kept.setdefault(message.can_id, data[1] & 0x0F)
        frame[1] = data[1] & 0xF0 | counter
        frame[0] = crc8(frame, message.data_ids[counter])
    else:
        frame[2] = row.kept.setdefault(message.can_id, data[2])
        frame[:2] = crc16(frame, message.data_ids).to_bytes(2, "little")
    return bytes(frame)


_CHANGES: dict[str, Callable[[_Row, MessageCodec | None, Sent], Sent]] = {
    "lose": _lose,
    "duplicate": _duplicate,
    "delay": _delay,
    "corrupt": _corrupt,
    "freeze_counter": _freeze_counter,
}


def _seeds(rows: Sequence[FaultSettings], seed: int) -> list[tuple[FaultSettings, str]]:
    """Give each row the name of its stream."""
    counts: dict[str, int] = {}
    named = []
    for row in rows:
        name = f"{row.kind} {row.node} {row.frame} {row.signal}"
        counts[name] = counts.get(name, 0) + 1
        named.append((row, f"{seed} {name} {counts[name]}"))
    return named


def _find_frames(codec: Codec, index: int, row: FaultSettings) -> frozenset[Place]:
    """Return node and identifier of the frames that a row is about. Raises ConfigError."""
    if row.frame is None:
        return frozenset()
    if row.frame == "any":
        return frozenset((node, _ANY_FRAME) for node in row.nodes)
    try:
        if row.is_broadcast:
            return frozenset([(EVERYBODY, codec.message(_broadcast_name(row)).can_id)])
        found = [(node, _message(codec, row, node)) for node in row.nodes]
    except CodecError as error:
        raise ConfigError(f"faults[{index}]: frame {row.frame!r} is not in {codec.path.name}: {error}") from None
    for _, message in found:
        if row.kind == "freeze_counter" and not message.is_protected:
            raise ConfigError(f"faults[{index}]: {message.name} has no counter to freeze in {codec.path.name}")
    return frozenset((node, message.can_id) for node, message in found)


def _broadcast_name(row: FaultSettings) -> str:
    return "HostHeartbeat" if row.frame == "heartbeat" else (row.frame or "").capitalize()


def _message(codec: Codec, row: FaultSettings, node: int) -> MessageCodec:
    frame = row.frame or ""
    if frame in ("sync", "nmt"):
        return codec.message(frame.capitalize())
    return codec.message(f"{NODES[node].capitalize()}{_DBC_NAMES[frame]}")
