"""The emulated arm on the bus: one body, two drives, two torque sensors, and the time that they live in.

At SYNC k:  latch the commands that came since SYNC k − 1 → sample the body → status frames that are due → feedback and
torque frames, identifiers ascending → truth of k → integrate to k + 1 with the latched torque. The cyclic frames come
last, so that a host in lockstep, which goes on when it has them, has everything of this SYNC.

Two clocks:

    sync   every SYNC is one period (0x1006), however long it took to come: the same frames in give the same frames
           out, bit for bit. A lost SYNC is seen by the gap in its counter, and its period is integrated too.
    wall   the body moves by the given clock on a 100 µs grid and a SYNC samples it where it is. The drives watch that
           SYNC keeps coming.

By SYNC, heartbeats and deadlines go by the given clock while no SYNC comes, and so does the braking that they cause. A
host in lockstep says itself how much time passes (`adacd_hil.wire.time_marks`), and hears from the bench what
doesn't come at once. Once a host has died, `outlive_host` lets pass what time it takes the arm to come to rest. The
truth is told on the way, a row per period, numbered and stamped on from the last SYNC.

The first SYNC after boot-up or an NMT reset communication (of all nodes or of drive 1) is cycle `counter` − 1, which is
0 for a master that begins at 1; from there the counter 1…240 is unwrapped. SYNCs that come twice or out of order:
`firmware_sim.canopen.sync_order`.
"""

from collections.abc import Callable, Sequence
from typing import Literal, Protocol

from adacd_hil.records import JOINTS, TRUTH_LAYOUT, Vector
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.codec import Codec, contract_folder
from adacd_hil.wire.time_marks import HOST_MARK, NEVER_NS, MarkKind, answers_to_sync, unpack_mark
from firmware_sim.arm.scripted_contact import TICK_S
from firmware_sim.bench.fault_plan import PLANNED_PERIOD_NS
from firmware_sim.bench.injector import Handler, Injector, OnEvent
from firmware_sim.bench.outbox import Outbox
from firmware_sim.bench.truth_log import OnTruth, TruthFeed
from firmware_sim.body.body import Body, Measurement
from firmware_sim.body.sensors import converter_ends
from firmware_sim.canopen.contracts import EmulatedContract, contract_of, longest_pdo
from firmware_sim.canopen.object_dictionary import Abort, refuse
from firmware_sim.canopen.sync_order import SyncKind, SyncOrder
from firmware_sim.nodes.device import RESET_COMMUNICATION, RESET_NODE, EmulatedDevice, SyncListeners
from firmware_sim.nodes.drive_node import DriveNode, Motor
from firmware_sim.nodes.sensor_node import SensorNode
from firmware_sim.scenario.faults import device_ids, own_messages
from firmware_sim.scenario.scenario import Scenario

ClockMode = Literal["sync", "wall"]
_TICK_NS = round(TICK_S * 1e9)
_NODES = ("Drive1", "Drive2", "Sensor1", "Sensor2")
_LONGEST_PERIOD_US = 100_000

LONGEST_ORPHANAGE_NS = 5_000_000_000
"""How long an arm is watched whose host has died; braking takes 1 s at most, what coasts with friction a few more."""
_OVERDUE_PERIODS = 4
"""By the clock, without SYNC for so long the truth goes on by itself; a lost SYNC or two leave a gap as ever."""
_REST_RAD_S, _REST_NS = 0.02, 50_000_000
"""At rest: slower than that for so long, as far as the drives can tell."""

_FAULTS = TRUTH_LAYOUT.slices["faults"]


class Movable(Protocol):
    """The arm itself, as far as its devices have to do with it; `Body` says what each means."""

    @property
    def motor_torque_Nm(self) -> tuple[float, float]:
        """Torque that the drives know."""

    @property
    def is_torque_limited(self) -> tuple[bool, bool]:
        """Whether each drive wants more torque than it may have."""

    @property
    def motor_error_code(self) -> tuple[int, int]:
        """Fault that each motor calls for, 0 for none."""

    @property
    def joint_temperature_C(self) -> tuple[float, float]:
        """Temperature of each joint."""

    @property
    def drive_velocity_rad_s(self) -> tuple[float, float]:
        """Velocity that the drives know."""

    def start_scenario(self) -> None:
        """Take note that the drives are enabled."""

    def advance(
        self, torque_setpoint_Nm: Sequence[float], drive_mode: Sequence[int], tick_count: int | None = None
    ) -> None:
        """Move by some ticks."""

    def sample(self) -> Measurement:
        """Measure."""

    def truth(self, out: Vector) -> None:
        """Fill in what is true."""


class Bench:
    """Everything on the device's end of the bus. Single-threaded: it sends from within the calls made to it."""

    def __init__(
        self,
        scenario: Scenario,
        codec: Codec,
        send: Callable[[int, bytes], None],
        *,
        clock_mode: ClockMode = "sync",
        seed: int | None = None,
        on_truth: OnTruth | None = None,
        contract: EmulatedContract | None = None,
        on_event: OnEvent | None = None,
        on_answer: Callable[[], None] = lambda: None,
    ) -> None:
        """Build and compile everything; nothing is sent before `boot`.

        send: called with (identifier, data). on_answer: called when all that answers a SYNC has been sent. seed:
        outweighs the scenario's. on_truth: called each cycle with (cycle, t_ns of the SYNC frame, block by
        TRUTH_LAYOUT), the block being valid until the next call. contract: which EDS files the devices have; default:
        those that go with the codec's DBC. on_event: called with t_ns, level, name and text when a fault begins or
        ends.
        Raises ConfigError when a fault is about a frame that the contract hasn't, CodecError when the DBC lacks a
        message, OSError when an EDS can't be read.
        """
        self.now_ns = 0
        """The bench's time: of `boot` plus, by SYNC, the periods since then; by wall, the clock's."""
        self.cycle = -1
        """Number of the last SYNC, -1 before the first."""
        self._outbox = Outbox(send)
        self._granted = 0  # frames that had gone out when time was last granted
        self._granted_ns = 0  # on the host's clock
        self._ahead_ns = 0  # of the bench's time over the host's
        self._answers = answers_to_sync(codec)
        self._has_all_answers = False
        self._scenario = scenario
        self._seed = seed
        self._is_wall = clock_mode == "wall"
        self._rows = TruthFeed(self._fill_truth, on_truth)
        self._on_answer = on_answer
        self._order = SyncOrder(is_timed=self._is_wall)
        self._lost_syncs = 0  # before the last one
        self._is_orphaned = False  # time passes that no host gives
        self._has_outlived = False  # a host, since the last SYNC
        self._moving_ns = 0  # when the arm last moved, or could
        self._has_moved = False
        self._is_started = False
        self._due_ns = NEVER_NS
        self._body_ns = 0
        self.contract = contract or contract_of(codec)
        folder = contract_folder()
        files = [self.contract.drive_eds if n.startswith("Drive") else self.contract.sensor_eds for n in _NODES]
        right_ids = [codec.node_id(f"{name}Heartbeat") for name in _NODES]
        ids = device_ids(scenario.faults, right_ids)
        longest = longest_pdo(codec)
        plan_seed = scenario.seed if seed is None else seed
        self._injector = Injector(scenario, plan_seed, PLANNED_PERIOD_NS, codec, self._outbox, on_event)
        self.devices = tuple(
            EmulatedDevice(
                ids[i],
                folder / files[i],
                self._injector.sender(i),
                own_messages(codec.by_id, right_ids[i], ids[i]),
                longest,
            )
            for i in range(len(_NODES))
        )
        rated_Nm = scenario.arm.rated_torque_Nm
        self.drives = tuple(
            DriveNode(self.devices[i], codec, i + 1, self._motor(i), rated_Nm[i], self._is_wall) for i in range(JOINTS)
        )
        self.sensors = tuple(self._make_sensor(i, codec) for i in range(JOINTS))
        self._injector.attach(self.devices, self.drives, self.sensors)
        self._period_ns = self.devices[0].value(0x1006) * 1000
        for device in self.devices:
            device.watch(0x1006, 0, check=_check_period)
        self.devices[0].watch(0x1006, 0, self._set_period)
        self._listeners = SyncListeners(self.devices)
        self._body = self._build_body()
        self._sync_id = codec.message("Sync").can_id
        self._host_id = codec.node_id("HostHeartbeat")
        self._commands: dict[int, tuple[tuple[int, Handler], ...]] = {}
        self._senders: tuple[tuple[int, Callable[[], None]], ...] = ()
        for device in self.devices:
            device.on_pdo_change = self._listen
        self._services: dict[int, Handler] = {
            codec.message("Nmt").can_id: self._on_nmt,
            codec.message("HostHeartbeat").can_id: self._on_host_heartbeat,
            **({} if self._is_wall else {HOST_MARK: self._on_mark}),
            **{0x600 + device.node_id: self._sdo_handler(0x600 + device.node_id) for device in self.devices},
        }

    @property
    def on_truth(self) -> OnTruth | None:
        """Called once per cycle with what is true."""
        return self._rows.on_truth

    @on_truth.setter
    def on_truth(self, on_truth: OnTruth) -> None:
        self._rows.on_truth = on_truth

    @property
    def on_event(self) -> OnEvent | None:
        """Called with t_ns, level, name and text when a fault begins or ends."""
        return self._injector.on_event

    @on_event.setter
    def on_event(self, on_event: OnEvent) -> None:
        self._injector.on_event = on_event

    @property
    def is_paced(self) -> bool:
        """Whether a host in lockstep says how much time passes."""
        return self._outbox.is_paced

    @property
    def is_acknowledged(self) -> bool:
        """Whether some device has power and is on the bus, so that what the host sends is acknowledged."""
        return self._injector.plan.is_acknowledged

    @property
    def is_operational(self) -> bool:
        """Whether all nodes are in NMT state Operational."""
        return all(device.is_operational for device in self.devices)

    @property
    def is_scenario_started(self) -> bool:
        """Whether both drives have been in Operation enabled at once."""
        return self._is_started

    @property
    def due_ns(self) -> int:
        """When something is due by time; call `advance_to` then."""
        return self._due_ns

    def boot(self, t_ns: int = 0) -> None:
        """Power on at `t_ns`: every node announces itself."""
        self.now_ns = self._body_ns = t_ns
        self._injector.power_on(t_ns)
        for device in self.devices:
            device.power_on(t_ns)
        self._advance_faults(t_ns)
        self._poll(t_ns)

    def on_frame(self, frame: Frame) -> None:
        """Take one frame from the bus."""
        can_id, data, t_ns, is_error = frame
        if is_error:
            return
        if self._is_wall and t_ns > self.now_ns:
            self.now_ns = t_ns
        if can_id == self._sync_id:
            if self._injector.has_faults:
                self._advance_faults(t_ns, self._time_to_sync_ns(data))
            is_heard = self._injector.receive_by_all(can_id, data, self._on_sync, t_ns)
            if not (is_heard or self._is_wall):
                self._miss_sync(data, t_ns)
        elif can_id in self._commands:
            for place, take in self._commands[can_id]:
                self._injector.receive(place, can_id, data, take, self.now_ns)
        elif can_id in self._services:
            self._services[can_id](data, self.now_ns)
            self._poll(self.now_ns)

    def advance_to(self, t_ns: int) -> None:
        """Let time pass without frames: heartbeats, event timers, watchdogs; by wall clock the body moves too."""
        while self._due_ns <= t_ns:
            self._live(max(self._due_ns, self.now_ns))
        self._move_to(t_ns)

    def _live(self, t_ns: int) -> None:
        """Reach `t_ns` and do what is due then."""
        self._move_to(t_ns)
        self._advance_faults(t_ns)
        self._outbox.release(self.now_ns)
        self._poll(self.now_ns)

    def _advance_faults(self, stamp_ns: int, ahead_ns: int = 0) -> None:
        """Let faults begin and end by now, or by what is `ahead_ns` of it."""
        if self._injector.has_faults:
            self._injector.advance(self.now_ns + ahead_ns, self.host_ns + ahead_ns if self.is_paced else stamp_ns)
            self._injector.flood(self._period_ns)

    def _time_to_sync_ns(self, data: bytes) -> int:
        """Say by how much this SYNC moves the bench's time, if it is heard."""
        if self._is_wall or not self._has_moved:
            return 0
        counter, last = data[0] if data else 0, self._order.counter
        periods = (counter - last) % self._listeners.overflow if counter and last else 1
        return periods * self._period_ns

    @property
    def is_at_rest(self) -> bool:
        """Whether the arm has stood still for a while and no drive powers its motor."""
        return self._has_rested(self.now_ns)

    def outlive_host(self) -> None:
        """By SYNC, let the time pass that no host gives any more, until the arm is at rest, for 5 s at most.

        The drives then miss their SYNC as by the clock. Once per host; by the clock time passes anyway.
        """
        if self._is_wall or not self._has_moved or self._has_outlived:
            return
        self._has_outlived = self._is_orphaned = True
        for drive in self.drives:
            drive.is_free_running = True
        end_ns = self.now_ns + LONGEST_ORPHANAGE_NS
        self._body_ns = self.now_ns
        self._poll(self.now_ns)
        while not self.is_at_rest and self.now_ns < end_ns:
            self.advance_to(self.now_ns + self._period_ns)
        for drive in self.drives:
            drive.is_free_running = False
        self._is_orphaned = False

    def release(self) -> None:
        """Let time go by the given clock again: the host in lockstep has gone."""
        self._outbox.is_paced = False

    @property
    def host_ns(self) -> int:
        """The bench's time on the clock of a host in lockstep."""
        return self.now_ns - self._ahead_ns

    def _on_mark(self, data: bytes, _t_ns: int) -> None:
        """Let time pass until the host's next frame, or until something is sent."""
        mark = unpack_mark(data)
        if mark is None or mark[0] is not MarkKind.ADVANCE:
            return
        host_ns = mark[1]
        if not self.is_paced or host_ns < self._granted_ns:
            self._outbox.is_paced = True
            self._ahead_ns = self.now_ns - host_ns
        target_ns = host_ns + self._ahead_ns
        outbox = self._outbox
        while outbox.sent == self._granted and self._due_ns <= target_ns:
            self._live(max(self._due_ns, self.now_ns))
        if outbox.sent == self._granted:
            self._move_to(target_ns)
        self._granted = outbox.sent
        self._granted_ns = self.host_ns
        outbox.mark(MarkKind.GRANT, self._granted_ns)

    def _on_nmt(self, data: bytes, t_ns: int) -> None:
        for place, device in enumerate(self.devices):
            self._injector.receive(place, 0x000, data, device.on_nmt, t_ns)
        is_reset = len(data) == 2 and data[0] in (RESET_NODE, RESET_COMMUNICATION)
        if is_reset and data[1] in (0, self.devices[0].node_id):
            self._order.restart()
            self._listeners.restart()

    def _on_host_heartbeat(self, data: bytes, t_ns: int) -> None:
        def take(_data: bytes, t_ns: int) -> None:
            for device in self.devices:
                device.on_heartbeat(self._host_id, t_ns)

        self._injector.receive_by_all(0x700 + self._host_id, data, take, t_ns)

    def _sdo_handler(self, can_id: int) -> Handler:
        """Let every device with this node id answer."""

        def answer(data: bytes, t_ns: int) -> None:
            for place, device in enumerate(self.devices):
                if 0x600 + device.node_id == can_id:
                    self._injector.receive(place, can_id, data, device.on_sdo, t_ns)

        return answer

    def _on_sync(self, data: bytes, t_ns: int) -> None:
        """Run one cycle."""
        takers = self._listeners.takers(data)
        if not (any(takers) and self._judge(data, t_ns)):
            self._ignore_sync(data, takers)
            return
        if self._is_wall:
            self._move_to(self.now_ns)
        elif self._has_moved:
            self._live_through_lost_syncs(self._lost_syncs)
            self.now_ns += self._period_ns
        late_ns = self._injector.late_ns(self._period_ns)
        if late_ns and self._is_wall:
            self._outbox.hold(self.now_ns + late_ns, lambda: self._answer(data, t_ns, 0))
            self._due_ns = min(self._due_ns, self._outbox.due_ns)
        else:
            self._answer(data, t_ns, late_ns)

    def _judge(self, data: bytes, t_ns: int) -> bool:
        """Place a SYNC among those before and count the cycles; tell whether devices take it."""
        order = self._order
        last = order.counter
        order.judge(data[0] if data else 0, self._listeners.overflow if data else 0, t_ns, self._period_ns)
        if not order.is_taken:
            return False
        self._lost_syncs = order.periods - 1
        if last == 0:
            self.cycle = order.counter - 1
        else:
            self.cycle += order.periods
            if not self._is_wall:  # time that passed without SYNC has been counted
                self.cycle = max(self.cycle, self._rows.cycle + 1)
        return True

    def _ignore_sync(self, data: bytes, takers: Sequence[int]) -> None:
        """Let the devices take note of a SYNC that none of them answers."""
        listeners, is_quiet = self._listeners, self._injector.is_quiet
        heard = listeners.everybody if is_quiet else self._injector.hear(self._sync_id, data)
        listeners.ignore(heard, takers, self._order.kind, self.now_ns)
        self._poll(self.now_ns)

    def _answer(self, data: bytes, t_ns: int, late_ns: int) -> None:
        """Sample and answer a SYNC that reaches the devices now, or by SYNC `late_ns` after its time."""
        sync_ns = self.now_ns
        late_ticks = late_ns // _TICK_NS
        if late_ticks:
            self._advance_body(late_ticks)
        is_for_all = self._listeners.takers(data) == self._listeners.everybody
        if self._is_wall or (is_for_all and self._is_plain):
            self._sample_and_send(data)
            if self._is_wall:
                self._outbox.release(self.now_ns)
        else:
            self._outbox.collect(sync_ns + late_ns)
            self._sample_and_send(data)
            self._outbox.close(sync_ns, sync_ns + self._period_ns)
        self._granted = self._outbox.sent
        self._on_answer()
        self._tell_truth(t_ns)
        if not self._is_wall:
            self._has_moved = True
            self._advance_body(self._period_ns // _TICK_NS - late_ticks)

    def _advance_body(self, tick_count: int) -> None:
        """Let the body move with what its motors are told."""
        drive1, drive2 = self.drives
        torque_Nm = (drive1.torque_Nm, drive2.torque_Nm)
        self._body.advance(torque_Nm, (drive1.motor_mode, drive2.motor_mode), tick_count)

    def _miss_sync(self, data: bytes, t_ns: int) -> None:
        """By SYNC, live through one that a fault keeps from all devices; what they send besides goes out."""
        is_counted = self._order.counter != 0 and any(self._listeners.takers(data)) and self._judge(data, t_ns)
        if is_counted and self._has_moved:
            self._listeners.miss(self._lost_syncs + 1)
            self._live_through_lost_syncs(self._lost_syncs + 1)
        self._outbox.collect(self.now_ns)
        self._poll(self.now_ns)
        self._outbox.close(self.now_ns, self.now_ns + self._period_ns)
        self._granted = self._outbox.sent
        self._tell_truth(t_ns)

    def _tell_truth(self, t_ns: int) -> None:
        """Say what is true at this SYNC, which came at `t_ns`."""
        self._rows.tell_sync(self.cycle, self.host_ns if self.is_paced else t_ns, self.now_ns)
        self._has_outlived = False

    def _fill_truth(self, block: Vector) -> None:
        self._body.truth(block)
        block[_FAULTS] = self._injector.plan.mask

    def _tell_on(self) -> None:
        """Without a SYNC, say what is true at the body's time once per period, as long as the arm moves."""
        if self._has_rested(self._body_ns):
            return
        if not self._is_wall:
            self._rows.tell_next(self._period_ns)
            return
        overdue, rest_ns = divmod(self._body_ns - self._rows.sync_ns, self._period_ns)
        if overdue >= _OVERDUE_PERIODS and rest_ns < _TICK_NS:
            self._rows.tell_overdue(overdue, self._period_ns)

    def _has_rested(self, now_ns: int) -> bool:
        """Whether the arm has stood still for a while, and no drive could move it; asked while it may move."""
        is_powered = any(drive.motor_mode for drive in self.drives)
        if is_powered or max(map(abs, self._body.drive_velocity_rad_s)) > _REST_RAD_S:
            self._moving_ns = now_ns
        return now_ns - self._moving_ns >= _REST_NS

    @property
    def _is_plain(self) -> bool:
        """Whether all cyclic frames, undisturbed and without company, answer this SYNC."""
        is_undisturbed = self._injector.is_quiet and self._outbox.due_ns >= self.now_ns + self._period_ns
        return is_undisturbed and self._has_all_answers

    def _sample_and_send(self, data: bytes) -> None:
        """Give the nodes their samples, and let them send."""
        now_ns = self.now_ns
        drive1, drive2 = self.drives
        sensor1, sensor2 = self.sensors
        measured = self._body.sample()
        listeners, order, lost = self._listeners, self._order, self._lost_syncs
        takers = listeners.takers(data)
        heard: Sequence[int] = listeners.everybody
        if self._injector.is_quiet and takers == heard:
            if listeners.is_remembering or lost or order.kind is not SyncKind.RIGHT:
                listeners.tell(heard, takers, order.kind, lost, now_ns)
            (position1, position2), (velocity1, velocity2), (torque1, torque2) = measured
            drive1.on_sync(position1, velocity1, now_ns)
            drive2.on_sync(position2, velocity2, now_ns)
            sensor1.on_sync(torque1)
            sensor2.on_sync(torque2)
        else:
            heard = self._injector.hear(self._sync_id, data)
            listeners.tell(heard, takers, order.kind, lost, now_ns)
            heard = [times * is_taken for times, is_taken in zip(heard, takers, strict=True)]
            self._injector.sync(heard, measured, now_ns)
            if not self._is_wall:  # by the clock, a drive that hears no SYNC has nothing to count
                self._lose_sync(heard)
        if now_ns >= self._due_ns or drive1.has_news or drive2.has_news or sensor1.has_news or sensor2.has_news:
            self._poll(now_ns)
        if not self._is_started and drive1.is_enabled and drive2.is_enabled:
            self._is_started = True
            self._injector.start(now_ns)
            self._body.start_scenario()
        for place, send in self._senders:
            if heard[place]:
                send()

    def _lose_sync(self, heard: Sequence[int]) -> None:
        for drive, has_heard in zip(self.drives, heard, strict=False):  # the drives come first
            if not has_heard:
                drive.on_lost_sync(self.now_ns)

    def _live_through_lost_syncs(self, count: int) -> None:
        drive1, drive2 = self.drives
        for _ in range(count):
            self.now_ns += self._period_ns
            drive1.on_lost_sync(self.now_ns)
            drive2.on_lost_sync(self.now_ns)
            self._advance_body(self._period_ns // _TICK_NS)

    def _move_to(self, t_ns: int) -> None:
        """Let the bench's time reach `t_ns`; by wall clock the body too, by SYNC only if its host has died.

        A host that dies sends no SYNC. What its drives do then must end, so their braking goes by time.
        """
        self.now_ns = max(self.now_ns, t_ns)
        drive1, drive2 = self.drives
        if not (self._is_wall or self._is_orphaned or drive1.is_left_alone or drive2.is_left_alone):
            self._body_ns = self.now_ns
            return
        step_ns = _TICK_NS if self._is_wall else self._period_ns
        rows = self._rows
        overdue_ns = rows.sync_ns + _OVERDUE_PERIODS * self._period_ns if rows.cycle >= 0 else NEVER_NS
        while self._body_ns + step_ns <= t_ns:
            self._body_ns += step_ns
            self._has_moved = True
            if not self._is_wall:
                self._tell_on()  # by SYNC the body is a period ahead of the last truth
            self._advance_body(step_ns // _TICK_NS)
            if self._is_wall and self._body_ns >= overdue_ns:
                self._tell_on()

    def _listen(self) -> None:
        """Take over which PDOs the devices exchange."""
        self._senders = tuple((i, send) for i, device in enumerate(self.devices) for send in device.pdos.on_sync)
        self._has_all_answers = self._answers == frozenset().union(*(device.pdos.answers for device in self.devices))
        commands: dict[int, tuple[tuple[int, Handler], ...]] = {}
        for place, device in enumerate(self.devices):
            for can_id, take in device.pdos.handlers():
                commands[can_id] = (*commands.get(can_id, ()), (place, take))
        self._commands = commands

    def _poll(self, t_ns: int) -> None:
        """Do what is due by time and remember when to look again."""
        drive1, drive2 = self.drives
        sensor1, sensor2 = self.sensors
        self._due_ns = min(drive1.poll(t_ns), drive2.poll(t_ns), sensor1.poll(t_ns), sensor2.poll(t_ns))
        if self._injector.has_faults:
            self._due_ns = min(self._due_ns, self._injector.due_ns, self._outbox.due_ns)

    def _motor(self, joint: int) -> Motor:
        return Motor(
            velocity_rad_s=lambda: self._body.drive_velocity_rad_s[joint],
            torque_Nm=lambda: self._body.motor_torque_Nm[joint],
            is_limited=lambda: self._body.is_torque_limited[joint],
            error_code=lambda: self._body.motor_error_code[joint],
        )

    def _make_sensor(self, joint: int, codec: Codec) -> SensorNode:
        return SensorNode(
            self.devices[JOINTS + joint],
            codec,
            joint + 1,
            converter_ends(self._scenario.sensors, joint),
            lambda: self._body.joint_temperature_C[joint],
        )

    def _build_body(self) -> Movable:
        return Body(self._scenario, seed=self._seed)

    def _set_period(self, period_us: int) -> None:
        if period_us:  # 0 is written to change 0x1019; the period stays
            self._period_ns = period_us * 1000


def _check_period(period_us: int) -> None:
    """Accept whole ticks, and 0."""
    if not 0 <= period_us <= _LONGEST_PERIOD_US or period_us * 1000 % _TICK_NS:
        refuse(Abort.VALUE_RANGE)
