"""An emulated torque drive: CiA 402 state machine, cyclic synchronous torque (mode 10), watchdogs.

A command frame is checked end to end when it arrives, kept, and acts at the next SYNC. The motor has torque only in
Operation enabled with mode 10; Quick stop active and Fault reaction active brake; everywhere else the arm coasts.

Units on the wire: position in encoder counts, velocity in 0x606C's LSB, torque in per mille of rated torque 0x6076,
rated torque in mNm. Source: CiA 402-2 (IEC 61800-7-201), state machine, controlword 0x6040, statusword 0x6041.
"""

import struct
from collections.abc import Callable
from typing import NamedTuple

from adacd_hil.wire.codec import Codec
from adacd_hil.wire.e2e import E2eStatus
from firmware_sim.body import DriveMode
from firmware_sim.drive_states import STATE_BITS, DriveEvent, DriveState, decode_command, find_transition
from firmware_sim.object_dictionary import (
    EMCY_COMMUNICATION,
    EMCY_HEARTBEAT,
    EMCY_PDO_LENGTH,
    EMCY_RPDO_TIMEOUT,
    NEVER_NS,
    Abort,
    Device,
    refuse,
)

EMCY_SYNC = 0x8700
"""CiA 402 "sync controller": CiA 301 has no code for a missing SYNC (0x8140 is recovery from bus-off)."""
CYCLIC_SYNCHRONOUS_TORQUE = 10
_NO_COMMAND_YET = 256  # SYNCs without a command: more than the longest patience, 0x2200

_SYNC_PATIENCE_NS_PER_US = 1500  # an enabled drive faults after 1.5 periods (0x1006, µs) without SYNC
_REST_RAD_S = 0.02  # standstill: a hundredth of the slowest motion that the arm makes
_REST_NS = 10_000_000  # standstill lasts; passing through zero does not
_LONGEST_BRAKING_NS = 1_000_000_000  # an arm that someone keeps pushing never stands still
_BRAKE_WATCH_NS = 1_000_000  # how often a free-running drive looks whether it stands still

_COMMAND = struct.Struct("<Hh")
_FEEDBACK = struct.Struct("<ii")
_STATUS = struct.Struct("<HbhH")

_ENABLE_OPERATION_WORD = 0x0F
_REMOTE, _INTERNAL_LIMIT, _FOLLOWS_TARGET = 1 << 9, 1 << 11, 1 << 12
_STAY_IN_QUICK_STOP = 6  # 0x605A: brake, then stay in Quick stop active; 2: then Switch on disabled
_BRAKE_THEN_DISABLE = 2
_COAST = 0  # 0x605E: no torque at once; 2: brake first


_MOTOR_MODES = dict.fromkeys(DriveState, DriveMode.OFF) | {
    DriveState.OPERATION_ENABLED: DriveMode.TORQUE,
    DriveState.QUICK_STOP_ACTIVE: DriveMode.BRAKE,
    DriveState.FAULT_REACTION_ACTIVE: DriveMode.BRAKE,
}
_BRAKING = (DriveState.QUICK_STOP_ACTIVE, DriveState.FAULT_REACTION_ACTIVE)
_POWERED = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)


class Motor(NamedTuple):
    """What the drive knows of its motor without the bus: velocity in rad/s, torque in Nm."""

    velocity_rad_s: Callable[[], float]
    torque_Nm: Callable[[], float]


class DriveNode:
    """One drive on the bus. `motor_mode` and `torque_Nm` are what its motor is told until the next SYNC."""

    def __init__(
        self,
        device: Device,
        codec: Codec,
        number: int,
        motor: Motor,
        rated_torque_Nm: float,
        send: Callable[[int, bytes], None],
        is_free_running: bool,
    ) -> None:
        """Connect the node to its device.

        `number`: 1 or 2, as in the DBC's names. `is_free_running`: time passes without SYNC, so SYNC is watched.
        """
        self.device = device
        self.motor_mode = DriveMode.OFF
        self.torque_Nm = 0.0
        self.state = DriveState.START
        self.has_news = False
        """Whether the status frame is due because of a change."""
        self._motor = motor
        self._send = send
        self._is_free_running = is_free_running
        command = codec.message(f"Drive{number}Command")
        self._command_length = command.length
        self._receiver = command.receiver()
        self._feedback_id = codec.message(f"Drive{number}Feedback").can_id
        self._status_id = codec.message(f"Drive{number}Status").can_id
        self._rated_mNm = round(rated_torque_Nm * 1000)
        self._position = self._velocity = 0
        self._pending: tuple[int, int] | None = None
        self._controlword = self._target = 0
        self._error_code = 0
        self._is_cause_present: Callable[[int], bool] | None = None
        self._silent_syncs = _NO_COMMAND_YET
        self._sync_ns = self._command_ns = self._braking_since_ns = self._moving_ns = 0
        self._command_frame = bytes(self._command_length)
        self._is_length_wrong = False
        self._mode = self._max_torque = self._patience_syncs = 0
        self._is_receiving = self._is_sending_feedback = self._is_sending_status = False
        self._status_period_ns = self._status_inhibit_ns = self._deadline_ns = self._sync_patience_ns = 0
        self._status_due_ns = NEVER_NS
        self._status_allowed_ns = 0
        self._configure(codec)
        device.attach(self)
        self.restart(is_node_reset=True)

    def _configure(self, codec: Codec) -> None:
        """Connect the objects of the dictionary."""
        device = self.device
        device.serve(0x2000, 1, lambda: codec.wire_version)
        device.serve(0x2000, 2, lambda: codec.layout_digest)
        device.serve(0x2100, 1, lambda: self._command_frame[0])
        device.serve(0x2100, 2, lambda: self._command_frame[1])
        device.serve(0x603F, 0, lambda: self._error_code)
        device.serve(0x6040, 0, lambda: self._controlword)
        device.serve(0x6041, 0, lambda: self.statusword)
        device.serve(0x6061, 0, lambda: self._mode)
        device.serve(0x6064, 0, lambda: self._position)
        device.serve(0x606C, 0, lambda: self._velocity)
        device.serve(0x6071, 0, lambda: self._target)
        device.serve(0x6076, 0, lambda: self._rated_mNm)
        device.serve(0x6077, 0, lambda: self._torque_permille)
        device.watch(0x6040, 0, check=self._obey_by_sdo)
        device.watch(0x6071, 0, check=self._set_target)
        device.watch(0x605A, 0, check=_one_of(_BRAKE_THEN_DISABLE, _STAY_IN_QUICK_STOP))
        device.watch(0x605E, 0, check=_one_of(_COAST, _BRAKE_THEN_DISABLE))
        device.watch(0x6060, 0, self._set_mode, _one_of(0, CYCLIC_SYNCHRONOUS_TORQUE))
        device.watch(0x6072, 0, self._set_max_torque)
        device.watch(0x6076, 0, check=self._check_rated_torque)
        device.watch(0x1006, 0, self._set_sync_period)
        device.watch(0x1400, 5, self._set_deadline)
        device.watch(0x2200, 0, self._set_patience, _at_least_one)
        device.watch(0x1801, 3, self._set_status_inhibit)
        device.watch(0x1801, 5, self._set_status_period)
        self._set_sync_period(device.value(0x1006))
        self._set_max_torque(device.value(0x6072))
        self._set_patience(device.value(0x2200))
        self._set_status_period(device.value(0x1801, 5))

    @property
    def is_enabled(self) -> bool:
        """Whether the drive is in Operation enabled."""
        return self.state is DriveState.OPERATION_ENABLED

    @property
    def rejected_commands(self) -> int:
        """Command frames so far that failed the end-to-end check."""
        return self._receiver.rejected

    @property
    def statusword(self) -> int:
        """0x6041. Target reached (bit 10) has no meaning in mode 10 and stays 0."""
        word = STATE_BITS[self.state] | _REMOTE
        if self.is_enabled and self._mode == CYCLIC_SYNCHRONOUS_TORQUE:
            word |= _FOLLOWS_TARGET
            if abs(self._target) > self._max_torque:
                word |= _INTERNAL_LIMIT
        return word

    @property
    def error_code(self) -> int:
        """0x603F: the fault that is latched, 0 for none."""
        return self._error_code

    def on_command(self, data: bytes, t_ns: int) -> None:
        """Take a command frame in, for the next SYNC; one that fails a check changes nothing."""
        if not self._is_receiving:
            return
        if len(data) != self._command_length:
            if not self._is_length_wrong:
                self.device.report_error(EMCY_PDO_LENGTH, t_ns)
            self._is_length_wrong = True
            return
        if self._receiver.check(data) > E2eStatus.OK_SOME_LOST:
            return
        if self._is_length_wrong:
            self._is_length_wrong = False
            if self._error_code == 0:
                self.device.clear_error(t_ns)
        self._command_frame = data
        self._pending = _COMMAND.unpack_from(data, 2)

    def on_sync(self, position: int, velocity: int, t_ns: int) -> None:
        """Let the pending command act. `position`, `velocity`: sampled at this SYNC."""
        self._sync_ns = t_ns
        self._position, self._velocity = position, velocity
        pending = self._pending
        if pending is None:
            self._miss_command(t_ns)
        else:
            self._pending = None
            self._silent_syncs = 0
            self._command_ns = t_ns
            controlword, self._target = pending
            if controlword != _ENABLE_OPERATION_WORD or not self.is_enabled:
                self._obey(controlword, t_ns)
            self._controlword = controlword
        if self.state in _BRAKING:
            self._watch_standstill(t_ns)
        self._drive_motor()

    def send_feedback(self) -> None:
        """Send what was sampled at the last SYNC."""
        if self._is_sending_feedback:
            self._send(self._feedback_id, _FEEDBACK.pack(self._position, self._velocity))

    def on_lost_sync(self, t_ns: int) -> None:
        """Live through a period whose SYNC never came, in a bench that counts periods by SYNC counters."""
        self._miss_command(t_ns)
        if self.state in _BRAKING:
            self._watch_standstill(t_ns)
        self._drive_motor()

    def poll(self, t_ns: int) -> int:
        """Do what is due by time; return when something is due next."""
        due_ns = self.device.poll(t_ns)
        if self.is_enabled:
            due_ns = min(due_ns, self._watch_bus(t_ns))
        if self._is_free_running and self.state in _BRAKING:
            self._watch_standstill(t_ns)
            due_ns = min(due_ns, t_ns + _BRAKE_WATCH_NS)
        if self._is_sending_status:
            if (self.has_news and t_ns >= self._status_allowed_ns) or t_ns >= self._status_due_ns:
                self._send_status(t_ns)
            due_ns = min(due_ns, self._status_allowed_ns if self.has_news else self._status_due_ns)
        self._drive_motor()
        return due_ns

    def leave_operational(self, t_ns: int) -> None:
        """Fault: without PDOs there is no command."""
        if self.state in _POWERED:
            self._fault(EMCY_COMMUNICATION, t_ns)

    def lose_heartbeat(self, t_ns: int) -> None:
        """Fault when powered."""
        if self.state in _POWERED:
            self._fault(EMCY_HEARTBEAT, t_ns)
        else:
            self.device.report_error(EMCY_HEARTBEAT, t_ns)

    def find_heartbeat(self, t_ns: int) -> None:
        """Clear the error; a fault stays latched."""
        if self._error_code == 0:
            self.device.clear_error(t_ns)

    def refresh(self) -> None:
        """Take over which PDOs are exchanged; a new Operational begins with a status frame."""
        device = self.device
        self._is_receiving = device.is_pdo_active(0x1400)
        self._is_sending_feedback = device.is_pdo_active(0x1800)
        was_sending = self._is_sending_status
        self._is_sending_status = device.is_pdo_active(0x1801)
        self.has_news |= self._is_sending_status and not was_sending
        if not self._is_receiving:
            self._pending = None

    def restart(self, is_node_reset: bool) -> None:
        """Forget the command sequence; a node reset also runs the state machine from its start (0, 1)."""
        self._receiver.restart()
        self._pending = None
        if not is_node_reset:
            return
        self._error_code = 0
        self._is_cause_present = None
        self._controlword = self._target = 0
        self._silent_syncs = _NO_COMMAND_YET
        self.state = DriveState.START
        self._apply(DriveEvent.POWER_ON, 0)
        self._apply(DriveEvent.INITIALISED, 0)
        self._drive_motor()

    def _obey_by_sdo(self, controlword: int) -> None:
        self._obey(controlword, self.device.now_ns)
        self._controlword = controlword
        self._drive_motor()

    def _obey(self, controlword: int, t_ns: int) -> None:
        """Carry out a controlword."""
        event = decode_command(controlword, self._controlword)
        if event is None:
            return
        if event is DriveEvent.FAULT_RESET:
            self._reset_fault(t_ns)
            return
        if event is DriveEvent.ENABLE_OPERATION:
            if self.state is DriveState.SWITCHED_ON and not self._is_receiving:
                return  # no torque without a way to command it
            if self.state is DriveState.QUICK_STOP_ACTIVE and self.device.value(0x605A) != _STAY_IN_QUICK_STOP:
                return
        self._apply(event, t_ns)

    def _apply(self, event: DriveEvent, t_ns: int) -> None:
        transition = find_transition(self.state, event)
        if transition is None:
            return
        self.state = transition.target
        self.motor_mode = _MOTOR_MODES[self.state]
        self.has_news = True
        if self.state in _BRAKING:
            self._braking_since_ns = self._moving_ns = t_ns

    def _reset_fault(self, t_ns: int) -> None:
        """Leave Fault, unless what caused it is still there."""
        if self.state is not DriveState.FAULT or (self._is_cause_present is not None and self._is_cause_present(t_ns)):
            return
        self._apply(DriveEvent.FAULT_RESET, t_ns)
        self._error_code = 0
        self._is_cause_present = None
        self.device.clear_error(t_ns)

    def _fault(self, code: int, t_ns: int) -> None:
        """Latch a fault; the first one counts."""
        if self.state in (DriveState.FAULT_REACTION_ACTIVE, DriveState.FAULT):
            return
        self._error_code = code
        self._is_cause_present = {
            EMCY_RPDO_TIMEOUT: self._is_command_missing,
            EMCY_SYNC: self._is_sync_missing,
            EMCY_HEARTBEAT: lambda _: self.device.is_heartbeat_lost,
            EMCY_COMMUNICATION: lambda _: not self.device.is_operational,
        }[code]
        self._target = 0
        self._apply(DriveEvent.FAULT_DETECTED, t_ns)
        if self.device.value(0x605E) == _COAST:
            self._apply(DriveEvent.FAULT_REACTION_DONE, t_ns)
        self._drive_motor()
        self.device.report_error(code, t_ns)

    def _miss_command(self, t_ns: int) -> None:
        self._silent_syncs += 1
        if self.is_enabled and self._silent_syncs >= self._patience_syncs:
            self._fault(EMCY_RPDO_TIMEOUT, t_ns)

    def _watch_bus(self, t_ns: int) -> int:
        """Fault when SYNC or commands stay away for too long; return when to look again."""
        due_ns = NEVER_NS
        if self._is_free_running:
            if self._is_sync_missing(t_ns):
                self._fault(EMCY_SYNC, t_ns)
            due_ns = self._sync_ns + self._sync_patience_ns
        if self._deadline_ns:
            if t_ns - self._command_ns >= self._deadline_ns:
                self._fault(EMCY_RPDO_TIMEOUT, t_ns)
            due_ns = min(due_ns, self._command_ns + self._deadline_ns)
        return due_ns if self.is_enabled else t_ns

    def _is_sync_missing(self, t_ns: int) -> bool:
        return t_ns - self._sync_ns >= self._sync_patience_ns

    def _is_command_missing(self, t_ns: int) -> bool:
        is_late = self._deadline_ns > 0 and t_ns - self._command_ns >= self._deadline_ns
        return is_late or self._silent_syncs >= self._patience_syncs

    def _watch_standstill(self, t_ns: int) -> None:
        """End the braking once the motor stands still, or after the longest time."""
        if abs(self._motor.velocity_rad_s()) > _REST_RAD_S:
            self._moving_ns = t_ns
        if t_ns - self._moving_ns < _REST_NS and t_ns - self._braking_since_ns < _LONGEST_BRAKING_NS:
            return
        if self.state is DriveState.FAULT_REACTION_ACTIVE:
            self._apply(DriveEvent.FAULT_REACTION_DONE, t_ns)
        elif self.device.value(0x605A) == _BRAKE_THEN_DISABLE:
            self._apply(DriveEvent.QUICK_STOP_DONE, t_ns)

    def _drive_motor(self) -> None:
        """Tell the motor what the state allows: torque only in Operation enabled with mode 10."""
        if self.is_enabled and self._mode == CYCLIC_SYNCHRONOUS_TORQUE:
            limit = self._max_torque
            self.torque_Nm = max(-limit, min(limit, self._target)) * self._rated_mNm * 1e-6
        else:
            self.torque_Nm = 0.0

    @property
    def _torque_permille(self) -> int:
        permille = round(self._motor.torque_Nm() * 1e6 / self._rated_mNm)
        return max(-0x8000, min(0x7FFF, permille))

    def _send_status(self, t_ns: int) -> None:
        self.has_news = False
        self._status_allowed_ns = t_ns + self._status_inhibit_ns
        self._status_due_ns = t_ns + self._status_period_ns if self._status_period_ns else NEVER_NS
        status = _STATUS.pack(self.statusword, self._mode, self._torque_permille, self._error_code)
        self._send(self._status_id, status)

    def _set_target(self, permille: int) -> None:
        self._target = permille

    def _set_mode(self, mode: int) -> None:
        self.has_news |= mode != self._mode
        self._mode = mode
        self._drive_motor()

    def _set_max_torque(self, permille: int) -> None:
        self._max_torque = permille

    def _check_rated_torque(self, rated_mNm: int) -> None:
        """Accept the motor's rating only: it can't be changed."""
        if rated_mNm != self._rated_mNm:
            refuse(Abort.VALUE_RANGE)

    def _set_sync_period(self, period_us: int) -> None:
        self._sync_patience_ns = period_us * _SYNC_PATIENCE_NS_PER_US

    def _set_deadline(self, deadline_ms: int) -> None:
        self._deadline_ns = deadline_ms * 1_000_000

    def _set_patience(self, syncs: int) -> None:
        """Set how many SYNCs in a row without a new valid command fault an enabled drive."""
        self._patience_syncs = syncs

    def _set_status_inhibit(self, tenths_ms: int) -> None:
        self._status_inhibit_ns = tenths_ms * 100_000

    def _set_status_period(self, period_ms: int) -> None:
        self._status_period_ns = period_ms * 1_000_000
        self.has_news = True


def _at_least_one(value: int) -> None:
    if value < 1:
        refuse(Abort.VALUE_RANGE)


def _one_of(*allowed: int) -> Callable[[int], None]:
    def check(value: int) -> None:
        if value not in allowed:
            refuse(Abort.VALUE_RANGE)

    return check
