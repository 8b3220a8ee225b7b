"""The effects of a scenario's faults over time: on frames, on measured values, and on nodes.

A bench passes the time to the plan at every SYNC and whenever `wait_ns` is over; then it reads the effects. The plan
recognises frames by the contract's identifiers. Nodes are places in `NODES`; times are ns.
"""

from collections.abc import Mapping, Sequence
from enum import Enum
from typing import NamedTuple

from adacd_hil.records import Event
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.time_marks import NEVER_NS
from firmware_sim.arm.sensing import TORQUE_LSB_NM
from firmware_sim.bench.fault_rows import (
    ANY_FRAME,
    FRAME_CHANGES,
    SIGNALS,
    FaultRow,
    Place,
    Sent,
    distort_value,
    find_frames,
    stream_seeds,
)
from firmware_sim.scenario.faults import NODES, FaultSettings

_BEFORE_NS = -1  # scenario time before the drives are enabled
_NOT_VALID = 0x01  # of 0x6150
_FRAME_KINDS = ("lose", "duplicate", "delay", "reorder", "corrupt", "freeze_counter")
_VALUE_KINDS = ("stick", "jump", "saturate")
_NODES_OWN = ("wrong_node_id", "duplicate_node_id", "drive_fault", "sensor_error", "clock_drift", "object_value")
"""Kinds whose effect the node keeps by itself, from power-on or since a `NodeAction`."""

Pair = tuple[int, int]


class ActionKind(Enum):
    """Actions on a node. A comment describes `NodeAction.value`, which the others don't use."""

    POWER_OFF = "power off"
    POWER_ON = "power on"
    LEAVE_BUS = "leave bus"
    RETURN_TO_BUS = "return to bus"
    EMERGENCY = "emergency"  # error code
    FAIL = "fail"  # error code
    MEND = "mend"
    SENSOR_STATUS = "sensor status"  # bits of 0x6150, 0: no error
    DRIFT = "drift"  # ppm, 0: no drift
    REPLACE_VALUE = "replace value"  # the object's, in counts
    OWN_VALUE = "own value"


class NodeAction(NamedTuple):
    """An action on a node that is due now. node: place in NODES.

    key: index and subindex of the object whose value changes.
    """

    kind: ActionKind
    node: int
    value: float = 0
    key: tuple[int, int] = (0, 0)


class FaultPlan:
    """The faults of one scenario over time."""

    def __init__(
        self,
        rows: Sequence[FaultSettings],
        seed: int,
        codec: Codec,
        torque_count_Nm: tuple[float, float] = (TORQUE_LSB_NM, TORQUE_LSB_NM),
    ) -> None:
        """Begin before power-on. `torque_count_Nm`: torque of one count of each sensor.

        Raises ConfigError for a fault that doesn't fit the contract, as `find_frames`.
        """
        self._torque_count_Nm = torque_count_Nm
        self.mask = 0
        """Bit i: row i is active."""
        self._rows = tuple(
            FaultRow(index, row, seed_text)
            for index, (row, seed_text) in enumerate(zip(rows, stream_seeds(rows, seed), strict=True))
        )
        self._places = tuple(find_frames(codec, index, row) for index, row in enumerate(rows))
        self._messages = codec.by_id
        self._scenario_ns, self._power_ns = _BEFORE_NS, _BEFORE_NS
        self._sending: dict[Place, tuple[FaultRow, ...]] = {}
        self._receiving: dict[Place, tuple[FaultRow, ...]] = {}
        self._silent: frozenset[int] = frozenset()
        self._distorting: tuple[FaultRow, ...] = ()
        self._slowing: tuple[FaultRow, ...] = ()
        self._babbling: tuple[FaultRow, ...] = ()
        self._actions: list[NodeAction] = []
        self._off: frozenset[int] = frozenset()
        self._off_bus: frozenset[int] = frozenset()
        self._bits: dict[int, int] = {}
        self._drifts: dict[int, float] = {}
        self._replaced: dict[tuple[int, tuple[int, int]], int] = {}

    @property
    def wait_ns(self) -> int:
        """Longest time from the last `advance` to the next one, ns: until a row begins, ends or sends an EMCY.

        NEVER_NS if none will. Rows whose clock has not begun don't count.
        """
        waits_ns = (
            max(0, row.due_ns - now_ns)
            for row in self._rows
            if (now_ns := self._now_ns(row)) >= 0 and row.due_ns < NEVER_NS
        )
        return min(waits_ns, default=NEVER_NS)

    @property
    def is_acknowledged(self) -> bool:
        """Whether some device has power and is on the bus, so that the host's frames get their acknowledge bit."""
        return len(self._off | self._off_bus) < len(NODES)

    @property
    def is_quiet(self) -> bool:
        """Whether no frame is held back, no action on a node is left, and no fault is active that the bench applies.

        Active faults of the kinds `_NODES_OWN` don't count: the node keeps their effect by itself.
        """
        is_acting = any(row.is_active and row.settings.kind not in _NODES_OWN for row in self._rows)
        return not (is_acting or self._actions or any(row.held for row in self._rows))

    @property
    def is_flooding(self) -> bool:
        """Whether a fault of kind `babble` is active."""
        return bool(self._babbling)

    def advance(self, scenario_ns: int, since_power_on_ns: int = _BEFORE_NS) -> list[Event]:
        """Set the time, begin and end the faults that are due, queue their actions.

        Return an event for each beginning and end, fault by fault in the order of the plan; empty if none is due. A
        fault whose whole time lies between two calls begins at the second, and then lasts for its duration.

        scenario_ns: since both drives were enabled, negative before. since_power_on_ns: negative if no time counts from
        there. Neither may go back; this is not checked.
        """
        self._scenario_ns, self._power_ns = scenario_ns, since_power_on_ns
        events = [event for row in self._rows for event in self._move(row)]
        if events:
            self._take_over()
        return events

    def actions(self) -> list[NodeAction]:
        """Return and remove the actions on nodes that are due now, in the order in which they were queued."""
        taken, self._actions = self._actions, []
        return taken

    def transmit(self, node: int, can_id: int, data: bytes) -> Sent:
        """Return the frames that faults make of a node's frame: delay in ns and data; [] if it is not sent.

        Without a fault it is the frame itself, with delay 0. It isn't sent if the node is silent, or if the frame is
        lost or waits until the next one overtakes it, which then brings both. Each call uses up hits and random draws.
        node: index in NODES.
        """
        if node in self._silent:
            return []
        rows = self._sending.get((node, can_id)) or self._sending.get((node, ANY_FRAME))
        return self._change(rows, can_id, data) if rows else [(0, data)]

    def receive(self, node: int, can_id: int, data: bytes) -> Sent:
        """Return the frames that faults make of a host's frame to a node: delay in ns and data; [] if it is lost.

        Without a fault it is the frame itself, with delay 0. It is [] also while the frame waits to be overtaken by the
        next one, which then brings both. Each call uses up hits and random draws. node: index in NODES. For a frame to
        all devices call it with `EVERYBODY` first, then with each of the returned frames for each node.
        """
        rows = self._receiving.get((node, can_id))
        return self._change(rows, can_id, data) if rows else [(0, data)]

    def distort(self, position: Pair, velocity: Pair, torque: Pair) -> tuple[Pair, Pair, Pair]:
        """Return the measured values with the active faults applied, unchanged without any; call once per SYNC.

        Pairs are by device (Drive1, Drive2; Sensor1, Sensor2), in counts of POSITION_LSB_RAD, VELOCITY_LSB_RAD_S and
        `torque_count_Nm`.
        """
        if not self._distorting:
            return position, velocity, torque
        values = [list(position), list(velocity), list(torque)]
        for row in self._distorting:
            which, lsb = SIGNALS[row.settings.signal or ""]
            for node in row.settings.nodes:
                joint = node % 2
                count = lsb or self._torque_count_Nm[joint]
                values[which][joint] = distort_value(row, node, values[which][joint], count)
        (position1, position2), (velocity1, velocity2), (torque1, torque2) = values
        return (position1, position2), (velocity1, velocity2), (torque1, torque2)

    def sync_delay_ns(self) -> int:
        """Return the delay, ns, with which this SYNC reaches the devices: the sum over the faults that hit it.

        0 if none hits it. Call it once per SYNC: each call uses up hits and random draws.
        """
        return sum(row.late_ns() for row in self._slowing if row.hit())

    def babble(self, period_ns: int) -> list[tuple[int, int, bytes]]:
        """Return the flood's frames within `period_ns` from the last `advance` on: offset in ns, identifier, data.

        Each frame is counted and returned once, also by overlapping calls. Frames that were due before that `advance`
        are left out, uncounted. While all nodes of a row are off the bus, its frames are only counted.
        """
        frames = []
        for row in self._babbling:
            settings = row.settings
            now_ns = self._now_ns(row)
            end_ns = min(now_ns + period_ns, row.end_ns)
            data = bytes(8) if settings.data is None else bytes.fromhex(settings.data)
            while (due_ns := row.flood_ns) < end_ns:
                row.sent += 1
                if due_ns < now_ns:
                    continue  # that time passed before the call
                row.hits_left -= 1
                if not self._off.union(self._off_bus).issuperset(settings.nodes):
                    frames.append((due_ns - now_ns, settings.can_id or 0, data))
        return sorted(frames)

    def _now_ns(self, row: FaultRow) -> int:
        return self._power_ns if row.settings.is_from_power_on else self._scenario_ns

    def _move(self, row: FaultRow) -> list[Event]:
        """Begin or end a row if it is due, and return these events. Queue the EMCYs of its storm that are due.

        A row without hits left ends, too.
        """
        events: list[Event] = []
        now_ns = self._now_ns(row)
        if not row.is_active and not row.is_over and row.begin_ns <= now_ns:
            row.is_active = True
            if row.end_ns <= now_ns:  # else it would not act at all
                row.begin_ns, row.end_ns = now_ns, now_ns + row.end_ns - row.begin_ns
            self._begin(row)
            events.append(Event("warning", f"fault {row.index}", f"begins: {row.settings.text}"))
        if row.is_active and row.settings.kind == "emcy_storm":
            self._storm(row)
        if row.is_active and (now_ns >= row.end_ns or row.hits_left <= 0):
            row.is_active, row.is_over = False, True
            events.append(Event("info", f"fault {row.index}", f"ends: {row.settings.text}"))
        return events

    def _begin(self, row: FaultRow) -> None:
        """Queue both actions of a reboot or drive fault without duration: off and on, or failure and repair.

        Rows of other kinds, or with a duration, queue nothing here.
        """
        settings = row.settings
        for node in settings.nodes:
            if settings.kind == "reboot" and not settings.duration_ns:
                self._actions += [NodeAction(ActionKind.POWER_OFF, node), NodeAction(ActionKind.POWER_ON, node)]
            elif settings.kind == "drive_fault" and not settings.duration_ns:
                code = settings.code or 0
                self._actions += [NodeAction(ActionKind.FAIL, node, code), NodeAction(ActionKind.MEND, node)]

    def _take_over(self) -> None:
        """Set `mask` and the tables of effects by the rows that are active now.

        Queue actions for the nodes that changed.
        """
        active = [row for row in self._rows if row.is_active]
        self.mask = sum(1 << row.index for row in active)
        self._distorting = _of(active, *_VALUE_KINDS)
        self._slowing = _of(active, "late_sync")
        self._babbling = _of(active, "babble")
        self._silent = _nodes_of(_of(active, "silence"))
        self._sort_frames()
        self._switch(active)

    def _sort_frames(self) -> None:
        """Set the tables of the rows that change each frame, sent and received, in the scenario's order.

        A row that holds a frame back stays in them.
        """
        rows = _of([row for row in self._rows if row.is_active or row.held], *_FRAME_KINDS)
        received = [row for row in rows if row.settings.is_received]
        sent = [row for row in rows if not row.settings.is_received]
        self._receiving = _by_place(received, self._places)
        self._sending = _by_place(sent, self._places)
        for node, can_id in self._sending:
            rows_of_any = self._sending.get((node, ANY_FRAME), ())
            if can_id != ANY_FRAME and rows_of_any:
                both = {*self._sending[node, can_id], *rows_of_any}
                self._sending[node, can_id] = tuple(sorted(both, key=lambda row: row.index))

    def _switch(self, active: list[FaultRow]) -> None:
        """Queue the actions for changes of power, bus, failures, sensor status, clocks, objects.

        Not those of reboots and drive faults without a duration, see `_begin`.
        """
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
        replaced = {
            (node, row.settings.object_key): row.settings.raw or 0
            for node, row in _each_node(_of(active, "object_value"))
        }
        for node, key in sorted(self._replaced.keys() - replaced.keys()):
            self._actions.append(NodeAction(ActionKind.OWN_VALUE, node, key=key))
        for (node, key), raw in sorted(replaced.items() - self._replaced.items()):
            self._actions.append(NodeAction(ActionKind.REPLACE_VALUE, node, raw, key))
        self._replaced = replaced

    def _switch_failures(self, failing: tuple[FaultRow, ...]) -> None:
        """Queue the failure of a drive whose fault begins, and its repair once no fault is left on it.

        Only faults with a duration count.
        """
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

    def _storm(self, row: FaultRow) -> None:
        """Queue the EMCY messages of a storm that are due by now."""
        now_ns = min(self._now_ns(row), row.end_ns - 1)
        (node,) = row.settings.nodes
        while row.flood_ns <= now_ns:
            row.sent += 1
            row.hits_left -= 1
            self._actions.append(NodeAction(ActionKind.EMERGENCY, node, row.settings.code or 0))

    def _change(self, rows: tuple[FaultRow, ...], can_id: int, data: bytes) -> Sent:
        """Return the frames to send for one frame after each of the rows in turn has changed it: delay in ns and data.

        [] if it is lost, or held back by `reorder`; the result for the next frame then has both. Each call uses up hits
        of the rows.
        """
        frames: Sent = [(0, data)]
        for row in rows:
            if row.settings.kind == "reorder":
                frames = self._swap(row, can_id, frames)
            elif row.hit():
                frames = FRAME_CHANGES[row.settings.kind](row, self._messages.get(can_id), frames)
        return frames

    def _swap(self, row: FaultRow, can_id: int, frames: Sent) -> Sent:
        """Hold a frame that is hit until the next with its identifier has overtaken it; return the frames to send now.

        That is [] for the frame held back, both for the next one, and the frames as they are without a hit.
        """
        if can_id in row.held:
            overtaken = row.held.pop(can_id)
            if not row.is_active:
                self._sort_frames()
            return frames + overtaken
        if not (row.hit() and frames):
            return frames
        row.held[can_id] = frames
        return []


def _of(rows: Sequence[FaultRow], *kinds: str) -> tuple[FaultRow, ...]:
    return tuple(row for row in rows if row.settings.kind in kinds)


def _nodes_of(rows: Sequence[FaultRow]) -> frozenset[int]:
    return frozenset(node for row in rows for node in row.settings.nodes)


def _each_node(rows: Sequence[FaultRow]) -> list[tuple[int, FaultRow]]:
    return [(node, row) for row in rows for node in row.settings.nodes]


def _by_place(rows: Sequence[FaultRow], places: Sequence[frozenset[Place]]) -> dict[Place, tuple[FaultRow, ...]]:
    found: dict[Place, tuple[FaultRow, ...]] = {}
    for row in rows:
        for place in places[row.index]:
            found[place] = (*found.get(place, ()), row)
    return found
