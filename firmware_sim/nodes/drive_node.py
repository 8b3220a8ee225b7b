"""An emulated torque drive: CiA 402 state machine, cyclic synchronous torque (mode 10), watchdogs.

A command frame is checked end to end when it arrives and, unless its PDO is mapped to act at once, acts at the next
SYNC. The motor has torque only in Operation enabled with mode 10; Quick stop active and Fault reaction active
brake, and so do shutdown and disable operation by 0x605B and 0x605C; everywhere else the arm coasts.

Units on the wire: position in encoder counts, velocity in the LSB of the contract, torque in per mille of rated torque
0x6076, rated torque in mNm of the joint, or in the count of an arm of one's own, behind the gear.

While the motor is powered, SDO writes only the controlword and, with an unprotected command frame, the target torque,
and clears the error history. While an RPDO brings the controlword, SDO writes only those that take the power away:
Disable voltage and Quick stop.

Source: CiA 402-2 (IEC 61800-7-201), state machine, controlword 0x6040, statusword 0x6041.
"""

from adacd_hil.wire.codec import Codec
from adacd_hil.wire.time_marks import NEVER_NS
from firmware_sim.arm.arms import EmulatedArm
from firmware_sim.arm.hardware_settings import HabitSettings
from firmware_sim.arm.sensing import ENCODER_COUNTS, VELOCITY_LSB_RAD_S, DriveMode
from firmware_sim.canopen.error_control import ERROR_CODES, WARNINGS, Watchdog
from firmware_sim.canopen.object_dictionary import Abort, one_of, refuse
from firmware_sim.nodes.device import Application, EmulatedDevice, MovableArm
from firmware_sim.nodes.drive_profile import (
    DISABLE,
    FAULT_REACTIONS,
    LONGEST_BRAKING_NS,
    QUICK_STOPS,
    RAMPS,
    REST_NS,
    REST_RAD_S,
    STATE_BITS,
    TRANSITIONS,
    DriveEvent,
    DriveState,
    Patience,
    Stop,
    TorqueLimits,
    decode_command,
    velocity_lsb,
)

CYCLIC_SYNCHRONOUS_TORQUE = 10
_HALT = 1 << 8  # of the controlword
_SWITCHING = -1  # on 0x6061, while the drive changes its mode
_BRAKE_WATCH_NS = 1_000_000  # how often a drive without SYNC looks whether it stands still

_ENABLE_OPERATION_WORD = 0x0F
_CONTROLWORD = (0x6040, 0)
_WARNING, _REMOTE, _INTERNAL_LIMIT, _FOLLOWS_TARGET = 1 << 7, 1 << 9, 1 << 11, 1 << 12
_DISARMING = (DriveEvent.DISABLE_VOLTAGE, DriveEvent.QUICK_STOP)
_ENABLED = DriveState.OPERATION_ENABLED
_POWERED = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)
_KIND_BITS = {2: 1 << 1, 4: 1 << 3}  # of 0x1001 by first digit of the error code: current, temperature
_RAMPED = {DriveEvent.SHUTDOWN: 0x605B, DriveEvent.SWITCH_ON: 0x605C}  # option codes of transitions 8 and 5
_EVENTS = frozenset({(0x6041, 0), (0x6061, 0), (0x603F, 0)})


def _held(count: float) -> int:
    """Return a value of 0x6064 or 0x606C as the nearest INTEGER32."""
    return round(min(max(count, -(2**31)), 2**31 - 1))


class DriveNode(Application):
    """One drive on the bus. `motor_mode` and `torque_Nm`, the set-point, are its command to the motor."""

    def __init__(
        self,
        device: EmulatedDevice,
        codec: Codec,
        place: int,
        arm: MovableArm,
        described: EmulatedArm,
        is_free_running: bool,
        habits: HabitSettings,
    ) -> None:
        """Connect the node to its device, whose application it becomes.

        `place`: 0 for Drive1, 1 for Drive2. `described`: the arm, with the wiring and the counts of its drives.
        `is_free_running`: time passes without SYNC, so SYNC is watched. Raises CodecError when the DBC lacks the
        drive's command or feedback.
        """
        self.device = device
        self.motor_mode = DriveMode.OFF
        self.torque_Nm = 0.0
        self.state = DriveState.START
        self.has_news = False
        """Whether a change waits to be sent on the bus."""
        self._pdos = device.pdos
        self._clock = device.clock
        self._tripped = device.tripped
        self._arm = arm
        wiring = described.wiring
        self._joint = wiring.drive_joint[place]
        self._sign, self._torque_sign = wiring.drive_sign[place], wiring.torque_sign[place]
        self.is_free_running = is_free_running
        """Whether time passes without SYNC, so that SYNC is watched."""
        count_Nm = described.rated_count_Nm[place]
        self._rated_counts = round(described.rated_torque_Nm[self._joint] / count_Nm)
        self._rated_mNm = self._rated_counts if count_Nm == 1e-3 else self._rated_counts * count_Nm * 1e3
        self._position_scale = (described.increments_per_joint_rev[place] or ENCODER_COUNTS) / ENCODER_COUNTS
        self._velocity_lsb_rad_s = velocity_lsb(codec, place + 1, described.velocity_factor[place])
        self._position = self._velocity = 0
        self._limits = TorqueLimits(device, self._pdos)
        self._demand = self._acted_commands = 0
        self._received_word: int | None = None
        self._controlword = 0
        self.error_code = 0
        """0x603F: the fault that is latched, 0 without a fault."""
        self._cause: Watchdog | None = None
        self._failure = 0
        self._is_found_by_time = False
        self._stop = DISABLE
        self._ramp_end: DriveEvent | None = None
        self._is_braking = False
        self._is_motor_limited = self._is_limiting = False
        self._braking_ns = self._moving_ns = 0  # when it began to brake, and when it last moved
        self._mode = self._wanted_mode = device.default_or(0, 0x6060)
        self._habits = habits
        self._has_habits = habits != HabitSettings()
        # On 0x6061: the mode shown now, the one once its time has passed, and the one until then.
        self._shown_mode = self._told_mode = self._meanwhile = self._mode
        self._told_ns = 0
        self._enabling_ns: int | None = None
        """Time of the first command Enable operation; None without one."""
        device.pause_ns = round(habits.pause_ms * 1e6)
        self._patience = Patience(device)
        self._serve(codec)
        self._configure(is_protected=codec.message(f"Drive{place + 1}Command").is_protected)
        device.attach(self)
        self.restart_node(is_node_reset=True)

    def _serve(self, codec: Codec) -> None:
        """Register readers of the drive's live objects in the object dictionary."""
        serve = self.device.serve
        serve(0x2000, 1, lambda: codec.wire_version)
        serve(0x2000, 2, lambda: codec.layout_digest)
        serve(0x2202, 0, lambda: self._acted_commands & 0xFFFF)
        serve(0x2212, 0, lambda: self._obstacle)
        serve(0x603F, 0, lambda: self.error_code)
        serve(0x6040, 0, lambda: self._controlword)
        serve(0x6041, 0, lambda: self.statusword)
        serve(0x6061, 0, lambda: self._shown_mode if self._has_habits else self._mode)
        serve(0x6064, 0, lambda: self._position)
        serve(0x606C, 0, lambda: self._velocity)
        serve(0x6074, 0, lambda: self._demand)
        serve(0x6076, 0, lambda: self._rated_counts)
        serve(0x6077, 0, lambda: self._torque_permille)

    def _configure(self, is_protected: bool) -> None:
        """Register checks of writes by SDO or PDO of the drive's objects, and the functions that take the values.

        `is_protected`: the command frame is, so SDO doesn't write the target torque while the drive is at work.
        """
        device = self.device
        device.open_at_work |= {_CONTROLWORD} if is_protected else {_CONTROLWORD, (0x6071, 0)}
        self._pdos.events = _EVENTS
        self._pdos.accept_values(*_CONTROLWORD, self._receive_word)
        device.watch(*_CONTROLWORD, check=self._obey_by_sdo)
        device.watch(0x605A, 0, check=one_of(*QUICK_STOPS))
        device.watch(0x605B, 0, check=one_of(*RAMPS))
        device.watch(0x605C, 0, check=one_of(*RAMPS))
        device.watch(0x605E, 0, check=one_of(*FAULT_REACTIONS))
        device.watch(0x6060, 0, self._want_mode, one_of(0, CYCLIC_SYNCHRONOUS_TORQUE))
        device.watch(0x6060, 0, check=self._check_halt)

    @property
    def is_enabled(self) -> bool:
        """Whether the drive is in Operation enabled."""
        return self.state is DriveState.OPERATION_ENABLED

    @property
    def is_ready(self) -> bool:
        """Whether a master may command torque: Operation enabled; a drive with habits also shows mode 10."""
        return self.is_enabled and (not self._has_habits or self._shown_mode == CYCLIC_SYNCHRONOUS_TORQUE)

    @property
    def is_at_work(self) -> bool:
        """Whether the drive is in Operation enabled or Quick stop active: watchdogs and limits may not change."""
        return self.state in _POWERED

    @property
    def is_left_alone(self) -> bool:
        """Whether the drive brakes after a fault because its master is lost.

        A timeout, not a SYNC, has shown the loss, and the loss lasts.
        """
        is_reacting = self.state is DriveState.FAULT_REACTION_ACTIVE
        return is_reacting and self._is_found_by_time and self._cause in self._tripped

    @property
    def rejected_commands(self) -> int:
        """Number of command frames so far that failed the end-to-end check."""
        return self._pdos.rejected_frames

    @property
    def statusword(self) -> int:
        """0x6041, by state, warning of the command PDO, whether torque follows the target (bit 12), and limits.

        Limits (bit 11) show only with bit 12. Target reached (bit 10) has no meaning in mode 10 and stays 0.
        """
        word = STATE_BITS[self.state] | _REMOTE
        if Watchdog.COMMAND_PDO in self._tripped:
            word |= _WARNING
        if self._follows_target:
            word |= _FOLLOWS_TARGET
            if self._limits.is_limiting or self._is_motor_limited:
                word |= _INTERNAL_LIMIT
        return word

    @property
    def _follows_target(self) -> bool:
        return self.state is _ENABLED and self._mode == CYCLIC_SYNCHRONOUS_TORQUE and self._ramp_end is None

    def on_sync(self, position: int, velocity: int, t_ns: int, *, is_distorted: bool = False) -> None:
        """Take the measured values, carry out the waiting command, check the watchdogs, and command the motor.

        `position`, `velocity`: sampled at this SYNC, in counts of POSITION_LSB_RAD and VELOCITY_LSB_RAD_S. t_ns: the
        bench's time. `is_distorted`: a fault changed the velocity, so it is used in place of the motor's own where the
        contract has another LSB.
        """
        t_ns = self._clock.own_ns(t_ns)
        self._patience.sync_ns = t_ns
        self._position = position if self._position_scale == 1.0 else _held(position * self._position_scale)
        lsb_rad_s = self._velocity_lsb_rad_s
        if lsb_rad_s is None:
            self._velocity = velocity
        else:
            speed_rad_s = velocity * VELOCITY_LSB_RAD_S if is_distorted else self._speed_rad_s
            self._velocity = _held(speed_rad_s / lsb_rad_s)
        if self._pdos.act_on_sync(t_ns):
            self._patience.silent_syncs = 0
            self._acted_commands += 1
        else:
            self._miss_command(t_ns)
        if self._tripped:
            self._clear_watchdogs(t_ns)
        self._obey_received(t_ns)
        if self._mode != self._wanted_mode:
            self._change_mode()
        if self._has_habits:
            self._keep_habits(t_ns)
        self._watch_motor(t_ns)
        if self._is_braking:
            self._watch_standstill(t_ns)
        self._drive_motor()
        if self._pdos.compare():
            self.has_news = True

    def act(self, t_ns: int) -> None:
        """Carry out the command of an RPDO that doesn't wait for SYNC, and command the motor.

        t_ns: the device's own time.
        """
        self._obey_received(t_ns)
        self._drive_motor()

    def mind_length(self, is_right: bool, t_ns: int) -> None:
        """Trip the length watchdog if an RPDO's frame has a wrong length, else clear it if it is tripped.

        EMCYs and the error register show it, the statusword doesn't, and the drive doesn't fault. t_ns: the device's
        own time.
        """
        if not is_right:
            self.device.trip(Watchdog.LENGTH, t_ns)
        else:
            self.device.clear(Watchdog.LENGTH, t_ns)

    def on_lost_sync(self, t_ns: int) -> None:
        """Count a SYNC that this drive has not heard as one without a command.

        Too many latch a fault of an enabled drive. Check motor and standstill, and command the motor. Benches that
        count lost SYNCs by the SYNC counter call it. t_ns: the bench's time.
        """
        t_ns = self._clock.own_ns(t_ns)
        self._miss_command(t_ns)
        self._watch_motor(t_ns)
        if self._is_braking:
            self._watch_standstill(t_ns)
        self._drive_motor()

    def poll(self, t_ns: int) -> int:
        """Act on timers that are due, and send event-driven frames; return when the next timer is due.

        Both times are ns of the bench.
        """
        t_ns = self._clock.own_ns(t_ns)
        due_ns = self.device.poll(t_ns)
        self._feel_failure(t_ns)
        if self._has_habits:
            self._keep_habits(t_ns)
            due_ns = min(due_ns, self._told_ns if self._told_ns > t_ns else NEVER_NS)
        if self.is_enabled:
            due_ns = min(due_ns, self._watch_bus(t_ns))
        if self._is_braking and (self.is_free_running or self.is_left_alone):
            self._watch_standstill(t_ns)
            due_ns = min(due_ns, t_ns + _BRAKE_WATCH_NS)
        if self.has_news:
            self.has_news = False
            self._pdos.notify()
        due_ns = min(due_ns, self._pdos.poll(t_ns))
        self._drive_motor()
        return self._clock.bench_ns(due_ns)

    def fail(self, code: int, t_ns: int) -> None:
        """Latch a fault with this error code, 0x603F, now or once the drive has power.

        Until `mend` a fault reset has no effect, and the fault returns after a reset of the node. A fault that is
        latched already keeps its code. t_ns: the bench's time.
        """
        self._failure = code
        self._feel_failure(self._clock.own_ns(t_ns))

    def mend(self) -> None:
        """Remove the failure that `fail` set; its fault stays latched until it is reset."""
        self._failure = 0

    def _feel_failure(self, t_ns: int) -> None:
        """Latch the fault of a failure that `fail` has set, if the drive has power. t_ns: the device's own time."""
        if self._failure and self.device.is_powered:
            self._latch(self._failure, None, t_ns)

    def leave_operational(self, t_ns: int) -> None:
        """Latch a fault in Operation enabled or Quick stop active: without PDOs no command arrives."""
        if self.state in _POWERED:
            self._fault(Watchdog.OPERATIONAL, t_ns)

    def enter_operational(self, t_ns: int) -> None:
        """Clear the watchdog of Operational, and that of the command PDO if a PDO brings commands.

        A fault stays latched.
        """
        self.device.clear(Watchdog.OPERATIONAL, t_ns)
        self._find_command_pdo(t_ns)

    def lose_heartbeat(self, t_ns: int) -> None:
        """Latch a fault in Operation enabled or Quick stop active; in other states do nothing."""
        if self.state in _POWERED:
            self._fault(Watchdog.HEARTBEAT, t_ns, is_found_by_time=True)

    def distrust_sync(self, t_ns: int) -> None:
        """Latch a fault in Operation enabled: torque acts at SYNC, which is no time base any more."""
        if self.is_enabled:
            self._fault(Watchdog.SYNC, t_ns)

    def restart_node(self, is_node_reset: bool) -> None:
        """Forget the controlword that waits.

        At a node reset (`is_node_reset`) also forget fault, target torque and controlword, and run the state
        machine up to Switch on disabled.
        """
        self._received_word = None
        if not is_node_reset:
            return
        self.error_code = 0
        self._cause = None
        self.device.is_faulty = False
        self.device.fault_bits = 0
        self._controlword = _HALT if self._habits.is_halted else 0
        self._acted_commands = 0
        self._enabling_ns = None
        self._limits.forget_target()
        self._mode = self._wanted_mode
        self._ramp_end = None
        self._patience.forget_command()
        self.state = DriveState.START
        self._apply(DriveEvent.POWER_ON, 0)
        self._apply(DriveEvent.INITIALISED, 0)
        self._drive_motor()

    def _receive_word(self, controlword: int) -> None:
        self._received_word = controlword

    def _obey_received(self, t_ns: int) -> None:
        """Carry out the controlword that an RPDO brought, if any, and store it as the last one."""
        controlword, self._received_word = self._received_word, None
        if controlword is None:
            return
        if controlword != _ENABLE_OPERATION_WORD or self.state is not _ENABLED:
            self._obey(controlword, t_ns)
        self._controlword = controlword

    def _obey_by_sdo(self, controlword: int) -> None:
        if self._pdos.brings(*_CONTROLWORD) and decode_command(controlword, self._controlword) not in _DISARMING:
            refuse(Abort.DEVICE_STATE)
        self._obey(controlword, self.device.now_ns)
        self._controlword = controlword
        self._drive_motor()

    def _obey(self, controlword: int, t_ns: int) -> None:
        """Carry out the command of a controlword, if it has one that this state allows.

        Enable operation in Switched on trips a watchdog instead if no PDO brings commands, and waits for `enable_s` of
        the habits; in a quick stop it acts only if that stays. Any other command clears that watchdog. Shutdown and
        disable operation of an enabled drive may brake first; further ones during that do nothing.
        """
        event = decode_command(controlword, self._controlword)
        if event is None:
            return
        if event is not DriveEvent.ENABLE_OPERATION:
            self.device.clear(Watchdog.COMMAND_PDO, t_ns)
        if event is DriveEvent.FAULT_RESET:
            self._reset_fault(t_ns)
            return
        if event is DriveEvent.ENABLE_OPERATION:
            if self.state is DriveState.SWITCHED_ON and self._obstacle:
                self.has_news |= Watchdog.COMMAND_PDO not in self._tripped
                self.device.trip(Watchdog.COMMAND_PDO, t_ns)
                return
            if self.state is DriveState.QUICK_STOP_ACTIVE and not self._stop.stays:
                return
            if self._habits.enable_s and self.state is DriveState.SWITCHED_ON:
                self._enabling_ns = t_ns if self._enabling_ns is None else self._enabling_ns
                return
        self._enabling_ns = None
        if self.is_enabled and event in _RAMPED:
            if self._ramp_end is None:
                self._ramp_down(event, t_ns)
            return
        self._apply(event, t_ns)

    def _ramp_down(self, event: DriveEvent, t_ns: int) -> None:
        """Make the transition of an event, shutdown or disable operation, or begin to brake if its option code says so.

        After braking, `_watch_standstill` makes the transition.
        """
        stop = RAMPS[self.device.value_or(0, _RAMPED[event])]
        if stop is DISABLE:
            self._apply(event, t_ns)
            return
        self._ramp_end = event
        self._brake(stop, t_ns)

    def _apply(self, event: DriveEvent, t_ns: int) -> None:
        """Make the transition of an event and set the motor's mode by the new state; do nothing if this state has none.

        Quick stop and fault reaction begin to brake by their option codes; with code 0 they end at once.
        """
        state = TRANSITIONS.get((self.state, event))
        if state is None:
            return
        self.state = state
        self._ramp_end = None
        self._is_braking = False
        self.motor_mode = DriveMode.TORQUE if self.is_enabled else DriveMode.OFF
        self.has_news = True
        if self.state is DriveState.QUICK_STOP_ACTIVE:
            self._stop_by(QUICK_STOPS[self.device.value_or(2, 0x605A)], DriveEvent.QUICK_STOP_DONE, t_ns)
        elif self.state is DriveState.FAULT_REACTION_ACTIVE:
            self._stop_by(FAULT_REACTIONS[self.device.value_or(2, 0x605E)], DriveEvent.FAULT_REACTION_DONE, t_ns)

    def _stop_by(self, stop: Stop, done: DriveEvent, t_ns: int) -> None:
        """Begin to brake as `stop` says, or apply the event `done` at once if that is DISABLE: no braking."""
        if stop is DISABLE:
            self._apply(done, t_ns)
        else:
            self._brake(stop, t_ns)

    def _brake(self, stop: Stop, t_ns: int) -> None:
        self._stop = stop
        self.motor_mode = stop.mode
        self._is_braking = True
        self.has_news = True
        self._braking_ns = self._moving_ns = t_ns

    def _reset_fault(self, t_ns: int) -> None:
        """Leave the state Fault for Switch on disabled, with an EMCY.

        Do nothing in other states or while the cause is there.
        """
        if self.state is not DriveState.FAULT or self._is_cause_present(t_ns):
            return
        self._apply(DriveEvent.FAULT_RESET, t_ns)
        self.error_code = 0
        self._cause = None
        self.device.is_faulty = False
        self.device.fault_bits = 0
        self.device.report_no_error(t_ns)

    def _fault(self, cause: Watchdog, t_ns: int, is_found_by_time: bool = False) -> None:
        """Latch the fault of a watchdog and trip it; do nothing while a fault is latched.

        is_found_by_time: a timeout, not a SYNC, showed the cause.
        """
        self._latch(ERROR_CODES[cause], cause, t_ns, is_found_by_time)

    def _latch(self, code: int, cause: Watchdog | None, t_ns: int, is_found_by_time: bool = False) -> None:
        """Latch a fault, begin the fault reaction, and send the EMCY; do nothing while a fault is latched.

        The target torque becomes 0. code: 0x603F. cause: None: no watchdog. is_found_by_time: a timeout, not a SYNC,
        showed the cause.
        """
        if self.state in (DriveState.FAULT_REACTION_ACTIVE, DriveState.FAULT):
            return
        self.error_code = code
        self._cause = cause
        self._is_found_by_time = is_found_by_time
        self.device.is_faulty = True
        self.device.fault_bits = _KIND_BITS.get(code >> 12, 0)
        self._limits.forget_target()
        self._apply(DriveEvent.FAULT_DETECTED, t_ns)
        self._drive_motor()
        if cause is None:
            self.device.report_fault(code, t_ns)
        else:
            self.device.trip(cause, t_ns)

    def _watch_motor(self, t_ns: int) -> None:
        """Latch a fault that the motor's I²t or temperature calls for.

        Set `has_news` if a torque limit begins or ceases to act.
        """
        arm, joint = self._arm, self._joint
        if not arm.has_ideal_motors and (code := arm.motor_error_code[joint]):
            self._latch(code, None, t_ns)
        is_limited = not arm.has_ideal_motors and arm.is_torque_limited[joint]
        is_limiting = self._limits.is_limiting and self._follows_target
        if is_limited != self._is_motor_limited or is_limiting != self._is_limiting:
            self._is_motor_limited, self._is_limiting = is_limited, is_limiting
            self.has_news = True

    def _is_cause_present(self, t_ns: int) -> bool:
        """Return whether the cause of the fault is still there, so that a reset would do nothing.

        A failure of drive or motor counts, and a tripped watchdog that doesn't only warn. Missing commands count only
        if they caused this fault.
        """
        if self._failure or self._tripped - WARNINGS or self._arm.motor_error_code[self._joint]:
            return True
        return self._cause is Watchdog.COMMAND and self._is_command_missing(t_ns)

    def _clear_watchdogs(self, t_ns: int) -> None:
        """Clear, at a SYNC, the watchdogs of SYNC, command and command PDO whose causes have gone."""
        if self.device.sync_counts.is_in_order:
            self.device.clear(Watchdog.SYNC, t_ns)
        if not self._is_command_missing(t_ns):
            self.device.clear(Watchdog.COMMAND, t_ns)
        self._find_command_pdo(t_ns)

    def _find_command_pdo(self, t_ns: int) -> None:
        """Clear the watchdog of the command PDO, with an EMCY of code 0, if an active RPDO brings commands.

        0x2212 is 0 then, which also needs NMT Operational. Do nothing if the watchdog isn't tripped.
        """
        if not self._obstacle:
            self.device.clear(Watchdog.COMMAND_PDO, t_ns)

    def _miss_command(self, t_ns: int) -> None:
        """Count a SYNC without a command; after too many (0x2200) latch a fault if the drive is enabled."""
        self._patience.silent_syncs += 1
        if self.is_enabled and self._patience.is_command_missing:
            self._fault(Watchdog.COMMAND, t_ns)

    def _watch_bus(self, t_ns: int) -> int:
        """Latch a fault if SYNC is missing or an RPDO is late; return when to check again, ns.

        SYNC counts only if `is_free_running`. Both times are of the device's own clock; the result is `t_ns` after a
        fault.
        """
        due_ns = NEVER_NS
        if self.is_free_running:
            due_ns = self._patience.sync_due_ns
            if t_ns >= due_ns:
                self._fault(Watchdog.SYNC, t_ns, is_found_by_time=True)
        late_ns = self._pdos.deadline_ns
        if t_ns >= late_ns:
            self._fault(Watchdog.COMMAND, t_ns, is_found_by_time=True)
        return min(due_ns, late_ns) if self.is_enabled else t_ns

    @property
    def _obstacle(self) -> int:
        """0x2212, reason against Operation enabled: 0 none, 1 not in Operational, 2 no active RPDO brings commands."""
        if self._pdos.is_commandable:
            return 0
        return 2 if self.device.is_operational else 1

    def _is_command_missing(self, t_ns: int) -> bool:
        return self._patience.is_command_missing or t_ns >= self._pdos.deadline_ns

    def _watch_standstill(self, t_ns: int) -> None:
        """End the braking once the motor has stood still for `REST_NS`, or has braked for `LONGEST_BRAKING_NS`.

        The state then changes, except in a quick stop that stays. Call it often while the drive brakes.
        """
        if abs(self._speed_rad_s) > REST_RAD_S:
            self._moving_ns = t_ns
        if t_ns - self._moving_ns < REST_NS and t_ns - self._braking_ns < LONGEST_BRAKING_NS:
            return
        if self.state is DriveState.FAULT_REACTION_ACTIVE:
            self._apply(DriveEvent.FAULT_REACTION_DONE, t_ns)
        elif self._ramp_end is not None:
            self._apply(self._ramp_end, t_ns)
        elif not self._stop.stays:
            self._apply(DriveEvent.QUICK_STOP_DONE, t_ns)

    def _drive_motor(self) -> None:
        """Set torque demand, per mille, to that of `TorqueLimits`, and the set-point, Nm, to the same torque.

        Both are 0 outside Operation enabled, in another mode than 10, and in a ramp down.
        """
        self._demand = self._limits.demand if self._follows_target else 0
        self.torque_Nm = self._demand * self._rated_mNm * 1e-6

    @property
    def _speed_rad_s(self) -> float:
        return self._sign * self._arm.drive_velocity_rad_s[self._joint]

    @property
    def _torque_permille(self) -> int:
        permille = round(self._torque_sign * self._arm.motor_torque_Nm[self._joint] * 1e6 / self._rated_mNm)
        return max(-0x8000, min(0x7FFF, permille))

    def _keep_habits(self, t_ns: int) -> None:
        """Update the mode shown on 0x6061, and carry out a delayed Enable operation, when `HabitSettings` says so."""
        if self._enabling_ns is not None and t_ns - self._enabling_ns >= self._habits.enable_s * 1e9:
            self._enabling_ns = None
            self._apply(DriveEvent.ENABLE_OPERATION, t_ns)
        if self._habits.shows_mode == "enabled" and not self.is_enabled:
            return
        if self._mode != self._told_mode:
            self._meanwhile = _SWITCHING if self._habits.shows_change else self._shown_mode
            self._told_mode, self._told_ns = self._mode, t_ns + round(self._habits.mode_s * 1e9)
        shown = self._told_mode if t_ns >= self._told_ns else self._meanwhile
        self.has_news |= shown != self._shown_mode
        self._shown_mode = shown

    def _check_halt(self, _mode: int) -> None:
        if self._habits.is_halted and self._controlword & _HALT:
            refuse(Abort.DEVICE_STATE)

    def _want_mode(self, mode: int) -> None:
        """Store a wanted mode; it is set at the next SYNC in Operation enabled, at once in other states."""
        self._wanted_mode = mode
        if not self.is_enabled:
            self._change_mode()

    def _change_mode(self) -> None:
        self.has_news |= self._mode != self._wanted_mode
        self._mode = self._wanted_mode
        self._drive_motor()
