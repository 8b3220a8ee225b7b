"""The emulated arm on the bus: one body, two drives, two torque sensors, and the cycle of every SYNC.

At SYNC k: let the arm move to k with the torque that was latched at k − 1 → latch the commands that came since → sample
the arm → status frames that are due → feedback and torque frames, identifiers ascending → truth of k. The bench sends
the cyclic frames last: a host in lockstep goes on when it has them, and then it has all frames of this SYNC.

Time: `firmware_sim.bench.bench_time`; nodes: `firmware_sim.bench.bench_nodes`; faults: `firmware_sim.bench.injector`;
truth: `firmware_sim.bench.bench_time`.

The first SYNC after `boot` or an NMT reset (node or communication, of all nodes or of drive 1) is cycle `counter` − 1,
which is 0 for a master that begins at 1; from there the counter 1…240 is unwrapped. SYNCs that come twice or out of
order: `firmware_sim.canopen.error_control`.
"""

from collections.abc import Callable, Sequence
from copy import copy
from typing import Literal

from adacd_hil.log.types.truth_topic import TRUTH_LAYOUT
from adacd_hil.records import Vector
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.time_marks import HOST_MARK
from firmware_sim.bench.bench_nodes import BenchNodes
from firmware_sim.bench.bench_time import BenchTime, OnTruth, TruthFeed
from firmware_sim.bench.fault_rows import EVERYBODY
from firmware_sim.bench.injector import Handler, Injector, OnEvent, Outbox
from firmware_sim.body.body import Body
from firmware_sim.canopen.error_control import SyncOrder
from firmware_sim.canopen.object_dictionary import EmulatedContract, contract_of
from firmware_sim.nodes.device import RESET_COMMUNICATION, RESET_NODE, MovableArm
from firmware_sim.scenario.scenario import Scenario

ClockMode = Literal["sync", "wall"]
_FAULTS = TRUTH_LAYOUT.slices["faults"]


class Bench:
    """All devices of the emulated arm on the bus. Single-threaded: it sends frames from within the calls made to it."""

    def __init__(
        self,
        scenario: Scenario,
        codec: Codec,
        send: Callable[[int, bytes], None],
        *,
        clock_mode: ClockMode = "sync",
        on_truth: OnTruth | None = None,
        contract: EmulatedContract | None = None,
        on_event: OnEvent | None = None,
        on_answer: Callable[[], None] = lambda: None,
        arm: MovableArm | None = None,
    ) -> None:
        """Build and compile everything; the devices send no frame before `boot`.

        send: called with (identifier, data). clock_mode: the arm's time goes by SYNC ("sync"), or by the clock of
        `advance_to` and frames ("wall"). on_answer: called after each SYNC that devices answer, when all frames are
        sent. on_truth: called with (cycle, t_ns, block by TRUTH_LAYOUT) for each SYNC that is answered or, in "sync",
        lost by a fault; also for periods that pass by the clock until the arm rests, in "wall" from the fourth after a
        SYNC on. t_ns is the time of the SYNC frame, in lockstep the host's, and the block is valid until the next call.
        contract: which EDS files the devices have; default: those that go with the codec's DBC. on_event: called with
        t_ns and an event when a fault begins or ends. arm: None: a body of the scenario's.

        Raises ConfigError when a fault doesn't fit the contract or its device, as `find_frames` and `check_objects`;
        CodecError when the DBC lacks a message; OSError when an EDS can't be read.
        """
        self.cycle = -1
        """Number of the last SYNC, -1 before the first."""
        self.contract = contract or contract_of(codec)
        self._outbox = Outbox(send)
        self._is_wall = clock_mode == "wall"
        self._on_answer = on_answer
        self._order = SyncOrder(is_timed=self._is_wall)
        self._lost_syncs = 0  # before the last one
        self.is_scenario_started = False
        """Whether both drives have been ready for torque at the same SYNC, by `DriveNode.is_ready`."""
        self.injector = Injector(scenario, codec, self._outbox, on_event)
        self._plan = self.injector.plan
        self._body = arm or Body(scenario)
        self.rows = TruthFeed(self._fill_truth, on_truth)
        self._nodes = BenchNodes(scenario, codec, self.contract, self.injector, self._body, self._is_wall)
        self.devices, self.drives, self.sensors = self._nodes.devices, self._nodes.drives, self._nodes.sensors
        self.time = BenchTime(self._is_wall, self._nodes, self._body, self.injector, self._outbox, self.rows)
        self._sync_id = codec.message("Sync").can_id
        self._host_id = codec.node_id("HostHeartbeat")
        for device in self.devices:
            device.pdos.on_refresh = self._listen
        self._services: dict[int, Handler] = {
            codec.message("Nmt").can_id: self._on_nmt,
            codec.message("HostHeartbeat").can_id: self._on_host_heartbeat,
            **({} if self._is_wall else {HOST_MARK: self.time.take_mark}),
            **{0x600 + device.node_id: self._sdo_handler(0x600 + device.node_id) for device in self.devices},
        }

    @property
    def is_paced(self) -> bool:
        """Whether a host in lockstep paces the time by its marks."""
        return self._outbox.is_paced

    @property
    def is_operational(self) -> bool:
        """Whether all nodes are in NMT state Operational."""
        return all(device.is_operational for device in self.devices)

    @property
    def now_ns(self) -> int:
        """The bench's time, ns: by mode `wall` the clock's.

        By mode `sync` it is that of `boot` plus the periods since then, and goes on to the time of `advance_to` or of a
        host's mark where that is later.
        """
        return self.time.now_ns

    @property
    def due_ns(self) -> int:
        """Bench time, ns, at which a timer, a fault or a held frame is due next; call `advance_to` then.

        NEVER_NS if none is.
        """
        return self.time.due_ns

    @property
    def is_at_rest(self) -> bool:
        """Whether, for 50 ms, the arm has stood still by the drives' velocities and no drive has powered its motor.

        A call while the arm moves or a motor has power restarts that time. Motion between two calls is missed.
        """
        return self.time.is_at_rest

    def boot(self, t_ns: int = 0) -> None:
        """Set the time to `t_ns` and power on all devices, which send their boot-up messages.

        Faults from power-on begin after these messages, so they don't change or stop them.
        """
        self.time.begin(t_ns)
        self.injector.power_on(t_ns)
        for device in self.devices:
            device.power_on(t_ns)
        self.time.advance_faults(t_ns)
        self.time.poll(t_ns)

    def advance_to(self, t_ns: int) -> None:
        """Advance the time to `t_ns` without frames: heartbeats, event timers and watchdogs act when they are due.

        Faults and held frames do, too. An earlier time changes nothing. The arm moves in clock mode `wall`; in `sync`
        only while a drive brakes as it has lost its host. While it moves, rows of truth are added, as the constructor
        describes for `on_truth`.
        """
        self.time.advance_to(t_ns)

    def outlive_host(self) -> None:
        """In clock mode `sync`, advance the time without a host until the arm rests, at most LONGEST_ORPHANAGE_NS.

        Do nothing in `wall`, before the first SYNC, and in later calls until the next SYNC.
        """
        self.time.outlive_host()

    def release(self) -> None:
        """Leave lockstep after its host has gone: time follows the caller's clock again."""
        self._outbox.is_paced = False

    def on_frame(self, frame: Frame) -> None:
        """Take one frame from the bus: run a cycle on SYNC, and pass the others to the devices that receive them.

        Error frames have no effect. In clock mode `wall` every other frame first takes time and arm to the frame's
        time. In `sync` a SYNC advances both by its periods, and a host's mark advances the time as `advance_to` does.
        Devices ignore frames that they don't take.
        """
        can_id, data, t_ns, is_error = frame
        if is_error:
            return
        time = self.time
        if self._is_wall:
            time.reach(t_ns)
        if can_id == self._sync_id:
            time.advance_faults(t_ns, self._time_to_sync_ns(data))
            if not self.injector.receive(EVERYBODY, can_id, data, self._on_sync, t_ns) and not self._is_wall:
                self._miss_sync(data, t_ns)
        elif can_id in self._nodes.commands:
            for place, take in self._nodes.commands[can_id]:
                self.injector.receive(place, can_id, data, take, time.now_ns)
        elif can_id in self._services:
            self._services[can_id](data, time.now_ns)
            time.poll(time.now_ns)

    def _time_to_sync_ns(self, data: bytes) -> int:
        """Return by how much this SYNC moves the bench's time if a device hears it, ns.

        0 in clock mode `wall`, before the first SYNC, and if no device takes this one, for its length or its counter.
        """
        if self._is_wall or not self.time.has_begun or not any(self._nodes.listeners.takers(data)):
            return 0
        order = copy(self._order)
        self._compare(order, data, 0)
        return order.is_taken * order.periods * self._nodes.period_ns

    def _on_nmt(self, data: bytes, t_ns: int) -> None:
        for place, device in enumerate(self.devices):
            self.injector.receive(place, 0x000, data, device.on_nmt, t_ns)
        is_reset = len(data) == 2 and data[0] in (RESET_NODE, RESET_COMMUNICATION)
        if is_reset and data[1] in (0, self.devices[0].node_id):
            self._order.forget_last()
            self._nodes.listeners.forget_unheard()

    def _on_host_heartbeat(self, data: bytes, t_ns: int) -> None:
        def take(_data: bytes, t_ns: int) -> None:
            for device in self.devices:
                device.on_heartbeat(self._host_id, t_ns)

        self.injector.receive(EVERYBODY, 0x700 + self._host_id, data, take, t_ns)

    def _sdo_handler(self, can_id: int) -> Handler:
        """Return a handler that passes SDO requests with this identifier to every device that receives it."""

        def answer(data: bytes, t_ns: int) -> None:
            for place, device in enumerate(self.devices):
                if 0x600 + device.node_id == can_id:
                    self.injector.receive(place, can_id, data, device.on_sdo, t_ns)

        return answer

    def _on_sync(self, data: bytes, t_ns: int) -> None:
        """Run one cycle for a SYNC.

        If no device takes it, or it comes twice or out of order, report that to the devices that hear it.
        """
        takers = self._nodes.listeners.takers(data)
        if not (any(takers) and self._judge(data, t_ns)):
            self._ignore_sync(data, takers)
            return
        self.time.reach_sync(self._lost_syncs)
        late_ns = self.injector.late_ns(self._nodes.period_ns)
        if late_ns and self._is_wall:
            self._outbox.hold(self.time.now_ns + late_ns, lambda: self._answer(data, t_ns, 0))
            self.time.due_ns = min(self.time.due_ns, self._outbox.due_ns)
        else:
            self._answer(data, t_ns, late_ns)

    def _judge(self, data: bytes, t_ns: int) -> bool:
        """Compare a SYNC's counter with the one before, and return whether it is a new one, which devices take.

        If it is, advance `cycle` and store the number of lost SYNCs before it.
        """
        order = self._order
        last = order.counter
        self._compare(order, data, t_ns)
        if not order.is_taken:
            return False
        self._lost_syncs = order.periods - 1
        if last == 0:
            self.cycle = order.counter - 1
        else:
            self.cycle += order.periods
            if not self._is_wall:  # time that passed without SYNC has been counted
                self.cycle = max(self.cycle, self.rows.cycle + 1)
        return True

    def _compare(self, order: SyncOrder, data: bytes, t_ns: int) -> None:
        overflow = self._nodes.listeners.overflow if data else 0
        order.judge(data[0] if data else 0, overflow, t_ns, self._nodes.told_period_ns)

    def _ignore_sync(self, data: bytes, takers: Sequence[int]) -> None:
        """Report a SYNC that is not answered to the devices that hear it, and let due timers act.

        takers: 1 for each device that takes SYNCs of this length, else 0.
        """
        heard = self.injector.count_heard(self._sync_id, data)
        self._nodes.listeners.ignore(heard, takers, self._order.kind, self.time.now_ns)
        self.time.poll(self.time.now_ns)

    def _answer(self, data: bytes, t_ns: int, late_ns: int) -> None:
        """Let the devices sample and answer a SYNC, then log its truth.

        late_ns: in clock mode `sync`, how late it reaches them.
        """
        sync_ns = self.time.now_ns
        self.time.delay_sample(late_ns)
        takers = self._nodes.listeners.takers(data)
        if self._is_wall or (takers == self._nodes.listeners.everybody and self._is_plain):
            self._sample_and_send(data, takers)
            if self._is_wall:
                self._outbox.release(self.time.now_ns)
        else:
            self._outbox.collect(sync_ns + late_ns)
            self._sample_and_send(data, takers)
            self._outbox.send_released(sync_ns, sync_ns + self._nodes.period_ns)
        self.time.note_sent()
        self._on_answer()
        self.time.has_begun = True
        self.time.end_sync(self.cycle, t_ns)

    def _miss_sync(self, data: bytes, t_ns: int) -> None:
        """Advance to a SYNC that a fault keeps from all devices, send their other frames, and add a row of truth.

        Only in clock mode `sync`. Time and `cycle` stay, and the row repeats `cycle`, before the first SYNC that
        devices took, and if no device would take this one.
        """
        is_counted = self._order.counter != 0 and any(self._nodes.listeners.takers(data)) and self._judge(data, t_ns)
        if is_counted and self.time.has_begun:
            self._nodes.listeners.miss(self._lost_syncs + 1)
            self.time.pass_lost_syncs(self._lost_syncs + 1)
        self._outbox.collect(self.time.now_ns)
        self.time.poll(self.time.now_ns)
        self._outbox.send_released(self.time.now_ns, self.time.now_ns + self._nodes.period_ns)
        self.time.note_sent()
        self.time.end_sync(self.cycle, t_ns)

    def _fill_truth(self, block: Vector) -> None:
        self._body.truth(block)
        block[_FAULTS] = self._plan.mask

    @property
    def _is_plain(self) -> bool:
        """Whether just the contract's cyclic frames answer this SYNC.

        Then no fault is active but those whose effect a node keeps by itself (see `FaultPlan.is_quiet`), and no held
        frame is due within a period.
        """
        is_undisturbed = self._plan.is_quiet and self._outbox.due_ns >= self.time.now_ns + self._nodes.period_ns
        return is_undisturbed and self._nodes.has_all_answers

    def _sample_and_send(self, data: bytes, takers: Sequence[int]) -> None:
        """Give the nodes that hear and take this SYNC their measured values, let due timers act, send their answers.

        Power and faults decide which nodes hear it. Report its kind to these, or a wrong length to one that doesn't
        take it. In clock mode `sync`, a drive that doesn't hear or take it counts a lost SYNC. Starts the scenario at
        the first SYNC at which both drives are ready. takers: 1 for each device that takes this SYNC's length, else 0.
        """
        now_ns = self.time.now_ns
        heard = self.injector.count_heard(self._sync_id, data)
        self._nodes.listeners.report_sync(heard, takers, self._order.kind, self._lost_syncs, now_ns)
        heard = tuple(times * is_taken for times, is_taken in zip(heard, takers, strict=True))
        self.injector.sync(heard, self._nodes.sample(), now_ns)
        if not self._is_wall:  # by the clock, a drive that hears no SYNC has no period to count
            self._nodes.lose_sync(heard, now_ns)
        if now_ns >= self.time.due_ns or self._nodes.has_news:
            self.time.poll(now_ns)
        if not self.is_scenario_started and all(drive.is_ready for drive in self.drives):
            self.is_scenario_started = True
            self.injector.start(now_ns)
            self._body.start_scenario()
        for place, send in self._nodes.senders:
            if heard[place]:
                send()

    def _listen(self) -> None:
        """Update the frames that the nodes send and receive, by `BenchNodes.listen`."""
        self._nodes.listen()
