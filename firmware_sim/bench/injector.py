"""The application of a scenario's faults to the bench: frames both ways, measured values, and the nodes themselves.

`firmware_sim.bench.fault_plan` decides which faults act now; the injector applies them. The delay of a host's frame
counts from the SYNC before it, because by SYNC the time of the frame within the period is unknown.

The devices' frames go to the bus at once, or later where a fault delays them (`Outbox`). By SYNC, time stands still
while the bench answers one, so the frames released within the next period go out together, in the order of release.
Marks tell a host in lockstep when each frame is released (`adacd_hil.wire.time_marks`); an undisturbed answer needs
no mark.
"""

import heapq
import itertools
from collections.abc import Callable, Sequence

from adacd_hil.records import JOINTS, Event
from adacd_hil.wire.bus import Bus
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.time_marks import DEVICE_MARK, NEVER_NS, MarkKind, pack_mark
from firmware_sim.arm.sensing import Measurement
from firmware_sim.bench.fault_plan import ActionKind, FaultPlan, NodeAction
from firmware_sim.bench.fault_rows import check_objects
from firmware_sim.body.sensors import count_Nm
from firmware_sim.canopen.object_dictionary import Send
from firmware_sim.nodes.device import EmulatedDevice
from firmware_sim.nodes.drive_node import DriveNode
from firmware_sim.nodes.sensor_node import SensorNode
from firmware_sim.scenario.scenario import Scenario


class Outbox:
    """Sends the devices' frames, at once or at a later time."""

    def __init__(self, send: Send) -> None:
        self.sent = 0
        """Frames that went out so far."""
        self.is_paced = False
        """Whether a host in lockstep hears marks."""
        self._send = send
        self._held: list[tuple[int, int, Callable[[], None]]] = []  # due, order of holding, function
        self._order = itertools.count()
        self._collected_ns: int | None = None

    @property
    def due_ns(self) -> int:
        """Time at which the next held frame or function is due, ns; NEVER_NS without one."""
        return self._held[0][0] if self._held else NEVER_NS

    def put(self, can_id: int, data: bytes) -> None:
        """Send a frame at once; between `collect` and `send_released`, hold it until the latter."""
        if self._collected_ns is None:
            self._put(can_id, data)
        else:
            self.put_later(self._collected_ns, can_id, data)

    def _put(self, can_id: int, data: bytes) -> None:
        self.sent += 1
        self._send(can_id, data)

    def put_later(self, due_ns: int, can_id: int, data: bytes) -> None:
        """Hold a frame until `due_ns`; `release` or `send_released` then sends it."""
        self.hold(due_ns, lambda: self._put(can_id, data))

    def hold(self, due_ns: int, act: Callable[[], None]) -> None:
        """Hold a function until `due_ns`; `release` or `send_released` then calls it."""
        heapq.heappush(self._held, (due_ns, next(self._order), act))

    def release(self, now_ns: int) -> None:
        """Send the held frames and call the held functions that are due by `now_ns`, the earliest first."""
        while self.due_ns <= now_ns:
            self._release_next()

    def _release_next(self) -> None:
        _, _, act = heapq.heappop(self._held)
        act()

    def collect(self, now_ns: int) -> None:
        """From now on, hold frames that are `put`, due at `now_ns`, until `send_released` sends them."""
        self._collected_ns = now_ns

    def send_released(self, sync_ns: int, until_ns: int) -> None:
        """End `collect`, send the held frames and call the held functions that are due before `until_ns`.

        In lockstep, RELEASE marks give the host their times after `sync_ns`, and an END mark follows the last.
        """
        self._collected_ns = None
        if self.is_paced:
            self.mark(MarkKind.RELEASE)
        released_ns = sync_ns
        while self.due_ns < until_ns:
            if self.is_paced and self.due_ns > released_ns:
                released_ns = self.due_ns
                self.mark(MarkKind.RELEASE, released_ns - sync_ns)
            self._release_next()
        if self.is_paced:
            self.mark(MarkKind.END)

    def mark(self, kind: MarkKind, t_ns: int = 0) -> None:
        """Send a mark to a host in lockstep at once, also during `collect`; `sent` doesn't count it.

        `t_ns`: as `MarkKind` defines it for the kind.
        """
        self._send(DEVICE_MARK, pack_mark(kind, t_ns))


class Departure:
    """Collects frames, and sends them to the bus in one call."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._frames: list[tuple[int, bytes]] = []

    def send(self, can_id: int, data: bytes) -> None:
        """Store a frame; `send_waiting` sends it."""
        self._frames.append((can_id, data))

    def send_waiting(self) -> None:
        """Send the stored frames. Raises BusError if the bus refuses one; the unsent ones are lost, as by a reset."""
        if self._frames:
            frames, self._frames = self._frames, []
            self._bus.send_all(frames)


Handler = Callable[[bytes, int], None]
OnEvent = Callable[[int, Event], None]
"""Called with t_ns and the event."""


class Injector:
    """Applies the faults of one bench to frames, measured values and nodes."""

    def __init__(self, scenario: Scenario, codec: Codec, outbox: Outbox, on_event: OnEvent | None) -> None:
        """Begin before power-on. Raises ConfigError for a fault that doesn't fit the contract, as `find_frames`.

        on_event: called with t_ns and an event when a fault begins or ends; None: it isn't.
        """
        first, second = (count_Nm(scenario.sensors, joint) for joint in scenario.arm.wiring.sensor_joint)
        self.plan = FaultPlan(scenario.faults, scenario.seed, codec, (first, second))
        self._rows = scenario.faults
        self.now_ns = 0
        self.on_event = on_event
        self._outbox = outbox
        self._is_acknowledged = True
        self._power_on_ns = 0
        self._started_ns: int | None = None
        self._flooded_ns = 0  # up to here babbling nodes have sent
        self._devices: Sequence[EmulatedDevice] = ()
        self._drives: Sequence[DriveNode] = ()
        self._sensors: Sequence[SensorNode] = ()

    def attach(
        self, devices: Sequence[EmulatedDevice], drives: Sequence[DriveNode], sensors: Sequence[SensorNode]
    ) -> None:
        """Set the nodes on which faults act. Raises ConfigError as `check_objects`."""
        self._devices, self._drives, self._sensors = devices, drives, sensors
        check_objects(self._rows, devices)

    def power_on(self, t_ns: int) -> None:
        """Set `t_ns` as the time of power-on, from which some faults count."""
        self.now_ns = self._power_on_ns = t_ns

    def start(self, t_ns: int) -> None:
        """Set `t_ns` as scenario time 0, from which most faults count."""
        self._started_ns = t_ns

    @property
    def due_ns(self) -> int:
        """Time, ns, at which a fault next begins, ends, sends an EMCY or needs `flood` again; NEVER_NS if none will."""
        return min(self.now_ns + self.plan.wait_ns, self._flooded_ns if self.plan.is_flooding else NEVER_NS)

    def sender(self, place: int) -> Send:
        """Return the function by which the device `place` (index in NODES) sends; it applies faults to each frame."""
        outbox, plan = self._outbox, self.plan

        def put(can_id: int, data: bytes) -> None:
            for delay_ns, changed in plan.transmit(place, can_id, data):
                if delay_ns:
                    outbox.put_later(self.now_ns + delay_ns, can_id, changed)
                else:
                    outbox.put(can_id, changed)

        return put

    def receive(self, place: int, can_id: int, data: bytes, take: Handler, t_ns: int) -> bool:
        """Call `take` with a frame of the host, as faults change, repeat or delay it; return False if it is lost.

        False also while a frame waits for the next one to overtake it. A delayed frame is taken when the outbox
        releases it. place: index in NODES of the receiver, or EVERYBODY.
        """
        frames = self.plan.receive(place, can_id, data)
        for delay_ns, received in frames:
            if delay_ns == 0:
                take(received, t_ns)
            else:
                due_ns = t_ns + delay_ns
                self._outbox.hold(due_ns, lambda received=received, due_ns=due_ns: take(received, due_ns))  # type: ignore[misc]
        return bool(frames)

    def advance(self, now_ns: int, stamp_ns: int) -> None:
        """Begin and end the faults that are due by `now_ns`: report events stamped `stamp_ns`, and act on nodes.

        In lockstep, a mark tells the host when frames begin or cease to be acknowledged.
        """
        self.now_ns = now_ns
        scenario_ns = -1 if self._started_ns is None else now_ns - self._started_ns
        for event in self.plan.advance(scenario_ns, now_ns - self._power_on_ns):
            if self.on_event is not None:
                self.on_event(stamp_ns, event)
        for action in self.plan.actions():
            self._do(action, now_ns)
        if self._is_acknowledged != self.plan.is_acknowledged:
            self._is_acknowledged = self.plan.is_acknowledged
            if self._outbox.is_paced:
                self._outbox.mark(MarkKind.LIT if self._is_acknowledged else MarkKind.DARK)

    def late_ns(self, period_ns: int) -> int:
        """Return how late this SYNC reaches the devices, ns: 0 without such a fault, less than a period.

        It is random: call it once per SYNC.
        """
        return min(self.plan.sync_delay_ns(), period_ns - 1)

    def flood(self, period_ns: int) -> None:
        """Queue the frames that babbling nodes send in the period from now on, each until its time.

        Do nothing while no fault of kind `babble` is active.
        """
        if self.plan.is_flooding:
            self._flooded_ns = self.now_ns + period_ns
            for offset_ns, can_id, data in self.plan.babble(period_ns):
                self._outbox.put_later(self.now_ns + offset_ns, can_id, data)

    def count_heard(self, sync_id: int, data: bytes) -> tuple[int, ...]:
        """Return how often each device hears one SYNC: 0 off the bus or if it is lost, else 1 or more.

        Each fault that duplicates it doubles the number. Call it once per SYNC: it uses up hits of the faults. Faults
        of a SYNC to all devices at once don't count here.
        """
        plan = self.plan
        return tuple(
            len(plan.receive(place, sync_id, data)) * device.is_on_bus for place, device in enumerate(self._devices)
        )

    def sync(self, heard: Sequence[int], measured: Measurement, now_ns: int) -> None:
        """Call `on_sync` of the nodes that hear a SYNC, with the measured values as faults change them.

        heard: how often each device hears it, from `count_heard`; a node that hears it twice acts once.
        """
        position, velocity, torque = self.plan.distort(*measured)
        for joint, drive in enumerate(self._drives):
            if heard[joint]:
                is_distorted = velocity[joint] != measured.velocity_counts[joint]
                drive.on_sync(position[joint], velocity[joint], now_ns, is_distorted=is_distorted)
        for joint, sensor in enumerate(self._sensors):
            if heard[JOINTS + joint]:
                sensor.on_sync(torque[joint])

    def _do(self, action: NodeAction, t_ns: int) -> None:
        kind, place, value, key = action
        device = self._devices[place]
        match kind:
            case ActionKind.POWER_OFF:
                device.power_off(t_ns)
            case ActionKind.POWER_ON:
                device.power_on(t_ns)
            case ActionKind.LEAVE_BUS:
                device.leave_bus(t_ns)
            case ActionKind.RETURN_TO_BUS:
                device.return_to_bus(t_ns)
            case ActionKind.EMERGENCY:
                device.send_emergency(int(value), t_ns)
            case ActionKind.FAIL:
                self._drives[place].fail(int(value), t_ns)
            case ActionKind.MEND:
                self._drives[place].mend()
            case ActionKind.SENSOR_STATUS:
                self._sensors[place - JOINTS].set_error(int(value))
            case ActionKind.DRIFT:
                device.clock.set_drift(value, t_ns)
            case ActionKind.REPLACE_VALUE:
                device.replace_value(*key, int(value))
            case ActionKind.OWN_VALUE:
                device.replace_value(*key, None)
