"""A second check of an ArmState: faults by the devices' heartbeats and by the host's own lateness.

The heartbeat consumer finds nodes that are silent, or not in the state that they should be in. Source: CiA 301 (4.2),
clause 7.2.8.2.2 (heartbeat protocol); t_ns is the host's time, the frames' stamps included.

The deadline policy decides the reaction when the host misses too many periods. A miss is a period that was skipped
whole: its SYNC was never sent. A SYNC that is late by less than a period is not a miss; the devices sample late, and
the scheme computes with the measured interval. Intended pauses, as between two attempts, are not misses.
`realtime.misses` of them within `realtime.misses_window_s` are too many. By `realtime.on_misses` the run then faults,
or the arm brakes to rest and holds its place until the user acknowledges, if the scheme has such a state.

A repeated event is reported at most once a second, with a count (`RateLimitedEvents`).
"""

from collections import deque
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass

from adacd_hil.device.profile import PlacedDevice
from adacd_hil.records import ArmState, Event, FaultReason
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.contract_frames import HEARTBEAT_ID


class Recurrence:
    """When an action is due: every so many cycles, from the first on; if its cycle is skipped, in the next one."""

    def __init__(self, interval_s: float, period_s: float) -> None:
        self._cycles = max(1, round(interval_s / period_s))
        self._due_cycle = 0

    def take_turn(self, cycle: int) -> bool:
        """Return whether it is due in this cycle; if so, set the next due cycle: a second call returns False.

        It is due in cycle 0 and in multiples of the interval; if one of these is skipped, in the next cycle with a
        call.
        """
        if cycle < self._due_cycle:
            return False
        self._due_cycle = cycle - cycle % self._cycles + self._cycles
        return True


REPEAT_NS = 1_000_000_000
"""Least time between two events of one kind."""


class EventSource:
    """Collects events in `events`; `take_events` returns those since the last call."""

    def __init__(self) -> None:
        self.events: list[Event] = []

    def take_events(self) -> list[Event]:
        """Return and forget the events since the last call."""
        events = self.events.copy()
        self.events.clear()
        return events


class RateLimitedEvents(EventSource):
    """Collects events, each kind at once, then at most once a second with the count of those between."""

    def __init__(self) -> None:
        super().__init__()
        self._said_ns: dict[Hashable, int] = {}
        self._unsaid: dict[Hashable, int] = {}

    def report(self, t_ns: int, kind: Hashable, event: Event, count: int = 1) -> None:
        """Report an event, or only count it if one of its kind was reported within the last second.

        The next reported event of the kind names the number of counted ones. `count`: how many the event stands for.
        """
        if not self.is_due(kind, t_ns):
            self._unsaid[kind] = self._unsaid.get(kind, 0) + count
            return
        more = self._unsaid.pop(kind, 0)
        self._said_ns[kind] = t_ns
        self.events.append(event._replace(message=f"{event.message} (and {more} before)") if more else event)

    def is_due(self, kind: Hashable, t_ns: int) -> bool:
        """Return whether `report` would report an event of a kind now: none was reported within the last second."""
        said_ns = self._said_ns.get(kind)
        return said_ns is None or t_ns - said_ns >= REPEAT_NS


_LOOKS = 0.1
"""Interval between two looks at the heartbeats, in heartbeat periods."""


class ArmWatch:
    """Sets the arm's fault when a device falls silent or leaves OPERATIONAL, or when the host is late.

    `lost`: the failed devices and their failures, one line each.
    """

    def __init__(self, settings: Settings, watch: Callable[[int], list[str]]) -> None:
        """`watch`: returns the failures of the devices' heartbeats at a time in ns, one line each."""
        self.lost: list[str] = []
        self.deadline = DeadlineWatch(settings)
        self._watch = watch
        self._looks = Recurrence(_LOOKS * settings.bus.heartbeat_ms * 1e-3, settings.bus.period_s)

    def judge(self, arm: ArmState) -> ArmState:
        """Return the arm's state with fault HEARTBEAT if a device's heartbeat fails, then as of `DeadlineWatch.judge`.

        A fault that is set already stays. `lost` is updated every `_LOOKS` of a heartbeat period. Call it once per
        cycle.
        """
        if self._looks.take_turn(arm.cycle):
            self.lost = self._watch(arm.t_ns)
        if self.lost and arm.fault is FaultReason.NONE:
            arm = arm._replace(fault=FaultReason.HEARTBEAT)
        return self.deadline.judge(arm)


PATIENCE_PERIODS = 2.5
"""Periods without a heartbeat until a node counts as silent, on the host and in 0x1016 of the devices: one heartbeat
may be lost and the next one be late by half a period, without waiting for a third."""
OPERATIONAL = 5
STATES = {0: "boot-up", 4: "STOPPED", 5: "OPERATIONAL", 127: "PRE-OPERATIONAL"}


@dataclass
class _WatchedNode:
    """A node and its last heartbeat. has_run: it was OPERATIONAL since `start`. complaint: its failure, or ""."""

    name: str
    node_id: int
    state: int | None = None
    heard_ns: int | None = None
    has_run: bool = False
    left_to: int | None = None
    """The last state other than OPERATIONAL since it was judged last, be it OPERATIONAL again by now."""
    complaint: str = ""


class HeartbeatWatch:
    """Follows the heartbeats of some nodes, while they should be operational."""

    def __init__(self, nodes: Iterable[tuple[str, int]], period_ms: int, report: Callable[[Event], None]) -> None:
        """`nodes`: name and node id. `period_ms`: of their heartbeats.

        `report` gets an event when a node falls silent or leaves OPERATIONAL, and when it is back.
        """
        self._nodes = {HEARTBEAT_ID + node_id: _WatchedNode(name, node_id) for name, node_id in nodes}
        self._patience_ns = round(PATIENCE_PERIODS * period_ms * 1_000_000)
        self._report = report
        self._is_watching = False
        self._since_ns: int | None = None

    def start(self) -> None:
        """Expect OPERATIONAL from now on; forget earlier failures, and count silence from the next `judge_nodes` on."""
        self._is_watching = True
        self._since_ns = None
        for node in self._nodes.values():
            node.has_run = False
            node.left_to = None
            node.complaint = ""

    def stop(self) -> None:
        """Stop watching: `judge_nodes` returns [] and reports nothing until `start`."""
        self._is_watching = False

    def accept(self, frame: Frame) -> None:
        """Store the state and time of a watched node's heartbeat.

        If the node left OPERATIONAL, remember that until the next `judge_nodes`, even if it returns before. Ignore
        other frames, error frames, and frames of another length than one byte.
        """
        node = self._nodes.get(frame.can_id)
        if node is None or frame.is_error or len(frame.data) != 1:
            return
        node.state = frame.data[0] & 0x7F
        node.heard_ns = frame.t_ns
        if node.state == OPERATIONAL:
            node.has_run = True
        elif node.has_run:
            node.left_to = node.state

    def judge_nodes(self, t_ns: int) -> list[str]:
        """Return a line per node that is silent, or was in another state than OPERATIONAL since the last call.

        Return [] if the watch is stopped. For the allowed silence after `start` a node that hasn't been OPERATIONAL yet
        passes. Report an event when a failure begins, changes or ends.
        """
        if not self._is_watching:
            return []
        if self._since_ns is None:
            self._since_ns = t_ns
        lines = []
        for node in self._nodes.values():
            line = self._judge(node, t_ns, self._since_ns)
            if line:
                lines.append(line)
        return lines

    def _judge(self, node: _WatchedNode, t_ns: int, since_ns: int) -> str:
        """Return a node's failure now in one line, or ""; report one that is new, another than the last, or over.

        since_ns: time of the first judgement after `start`.
        """
        heard_ns = since_ns if node.heard_ns is None else max(node.heard_ns, since_ns)
        silent_ns = t_ns - heard_ns
        state = node.state if node.left_to is None else node.left_to
        node.left_to = None
        if silent_ns > self._patience_ns:
            complaint = "silent"
            text = f"no heartbeat for {silent_ns // 1_000_000} ms, {self._patience_ns // 1_000_000} ms allowed"
        elif (
            state is not None
            and state != OPERATIONAL
            # A heartbeat from before the start command took effect may still be on its way.
            and (node.has_run or t_ns - since_ns > self._patience_ns)
        ):
            complaint = f"state {state}"
            text = f"is {STATES.get(state, f'in NMT state {state}')}, OPERATIONAL expected"
        else:
            if node.complaint:
                self._report(Event("info", node.name, "heartbeat: OPERATIONAL again"))
                node.complaint = ""
            return ""
        if complaint != node.complaint:
            node.complaint = complaint
            self._report(Event("error", node.name, f"heartbeat: {text}"))
        return f"{node.name} (node {node.node_id}): {text}"


def watch_heartbeats(
    devices: Iterable[PlacedDevice], period_ms: int, report: Callable[[Event], None]
) -> HeartbeatWatch:
    """Return a watch, not yet started, over the heartbeats of the devices whose EDS lets the host set their period."""
    return HeartbeatWatch(
        [(device.name, device.node_id) for device in devices if device.is_heartbeat_known], period_ms, report
    )


class DeadlineWatch:
    """Counts the misses of one attempt over a sliding window."""

    def __init__(self, settings: Settings) -> None:
        realtime = settings.realtime
        self._most = realtime.misses
        self._window_s = realtime.misses_window_s
        self._window_cycles = max(1, round(realtime.misses_window_s / settings.bus.period_s))
        self._is_holding = realtime.on_misses == "hold"
        self._misses: deque[tuple[int, int]] = deque()  # cycle that came late, periods skipped before it
        self._count = 0

    def judge(self, arm: ArmState) -> ArmState:
        """Count the periods skipped before a cycle; return its state, changed if there were too many recently.

        Too many: `realtime.misses` within `realtime.misses_window_s`. Then `is_late` is set if `realtime.on_misses` is
        hold; else the fault is DEADLINE, unless there is another. Call it once per cycle.
        """
        misses = self._misses
        if arm.periods > 1:
            misses.append((arm.cycle, arm.periods - 1))
            self._count += arm.periods - 1
        while misses and arm.cycle - misses[0][0] >= self._window_cycles:
            self._count -= misses.popleft()[1]
        if self._count < self._most:
            return arm
        if self._is_holding:
            return arm._replace(is_late=True)
        return arm._replace(fault=FaultReason.DEADLINE) if arm.fault is FaultReason.NONE else arm

    def describe_misses(self) -> list[str]:
        """Return [line] with the number of periods missed within the window until now; [] if none was."""
        line = f"{self._count} periods missed within {self._window_s:g} s; {self._most} are too many"
        return [line] if self._count else []
