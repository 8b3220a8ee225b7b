"""One drive as the host sees it: CiA 402 state, feedback, commands in cyclic synchronous torque.

Positions, velocities and torques are the device's own: sign and ratio belong to `adacd_hil.device.arm`.
Source: CiA 402-2 / IEC 61800-7-201, clause 10.3 (state machine), clause 16 (cyclic synchronous torque).
"""

from collections import deque
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

from adacd_hil.device.cyclic_device import CyclicDevice
from adacd_hil.device.profile import PlacedDevice, ProfileSettings
from adacd_hil.records import FaultReason
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.codec import Codec, CodecError, MessageCodec

MODE_CYCLIC_SYNCHRONOUS_TORQUE = 10

DISABLE_CYCLES = 20
"""Cycles of disabling at the end of a run: drives need two, the rest shows in the log that they did."""


class Cia402State(IntEnum):
    """States of the power drive system. The comment beside each value names the way out of it."""

    NOT_READY_TO_SWITCH_ON = 0  # by itself, after the drive's self test
    SWITCH_ON_DISABLED = 1  # shutdown
    READY_TO_SWITCH_ON = 2  # switch on
    SWITCHED_ON = 3  # enable operation
    OPERATION_ENABLED = 4  # disable operation, shutdown, disable voltage, quick stop
    QUICK_STOP_ACTIVE = 5  # by itself at standstill, or with 0x605A from 5 on, disable voltage
    FAULT_REACTION_ACTIVE = 6  # by itself, when the reaction is done
    FAULT = 7  # fault reset, rising edge, cause gone


class Controlword(IntEnum):
    """Commands of 0x6040 in cyclic synchronous torque."""

    DISABLE_VOLTAGE = 0x0000
    QUICK_STOP = 0x0002
    SHUTDOWN = 0x0006
    SWITCH_ON = 0x0007
    ENABLE_OPERATION = 0x000F
    FAULT_RESET = 0x0080  # the rising edge of bit 7


_STATUSWORD = (  # mask, value: IEC 61800-7-201 table 30
    (0x4F, 0x00, Cia402State.NOT_READY_TO_SWITCH_ON),
    (0x4F, 0x40, Cia402State.SWITCH_ON_DISABLED),
    (0x6F, 0x21, Cia402State.READY_TO_SWITCH_ON),
    (0x6F, 0x23, Cia402State.SWITCHED_ON),
    (0x6F, 0x27, Cia402State.OPERATION_ENABLED),
    (0x6F, 0x07, Cia402State.QUICK_STOP_ACTIVE),
    (0x4F, 0x0F, Cia402State.FAULT_REACTION_ACTIVE),
    (0x4F, 0x08, Cia402State.FAULT),
)


_WAY_UP = {
    Cia402State.SWITCH_ON_DISABLED: Controlword.SHUTDOWN,  # transition 2
    Cia402State.READY_TO_SWITCH_ON: Controlword.SWITCH_ON,  # 3
    Cia402State.SWITCHED_ON: Controlword.ENABLE_OPERATION,  # 4
}
"""The next command on the way to Operation enabled, by state. States that are not listed get disable voltage; FAULT
and QUICK_STOP_ACTIVE have rules of their own. IEC 61800-7-201, table of transitions."""

_FIRST_STAYING_OPTION = 5
"""0x605A: from 5 on the drive stays in QUICK_STOP_ACTIVE; below it goes on to SWITCH_ON_DISABLED at standstill."""
_INTERNAL_LIMIT = 1 << 11  # of the statusword; torque: the drive has less than commanded
_RECENT_COMMANDS = 8
"""Commands with which a drive's actual torque is compared: it is of some cycles ago, through a current loop."""
_TARGET_REACHED = 1 << 10  # of the statusword; in QUICK_STOP_ACTIVE with such an option: the drive stands still
_STANDSTILL_RAD_S = 0.02
"""Speed of the joint that counts as standing still, for drives that leave bit 10 alone."""


class _StatusPlaces(NamedTuple):
    """Places of a status's signals among a message's values; -1: not in the message."""

    statusword: int = -1
    mode_display: int = -1
    torque_actual: int = -1
    error_code: int = -1


_NO_STATUS = _StatusPlaces()
_JUDGED = ("statusword", "mode_display", "torque_actual")
"""What the host judges of a status: whether the drive is enabled, and its torque. It only shows the error code."""


def option_codes(settings: Settings, profile: ProfileSettings) -> tuple[int | None, int | None]:
    """Return the values for 0x605A (quick stop) and 0x605E (fault reaction): the configuration's, else the profile's.

    None for a value that neither gives.
    """
    chosen = settings.devices
    quick_stop, fault_reaction = chosen.quick_stop_option, chosen.fault_reaction_option
    return (
        profile.quick_stop_option if quick_stop is None else quick_stop,
        profile.fault_reaction_option if fault_reaction is None else fault_reaction,
    )


def torque_limit_permille(settings: Settings, joint: int) -> int:
    """Return the largest commanded torque of joint 0 or 1 as per mille of rated torque, at most 0xFFFF, for 0x6072."""
    arm = settings.arm
    return min(0xFFFF, round(1000 * arm.torque_limit_Nm[joint] / arm.rated_torque_Nm[joint]))


def shows_mode(codec: Codec, name: str) -> bool:
    """Return whether some frame of a drive carries the mode, 0x6061."""
    frames = (codec.messages.get(f"{name}{message}") for message in ("Feedback", "Status"))
    return any(signal.name == "mode_display" for frame in frames if frame is not None for signal in frame.values)


def decode_statusword(statusword: int) -> Cia402State:
    """Return the state by 0x6041; a pattern that the standard doesn't list counts as NOT_READY_TO_SWITCH_ON."""
    for mask, value, state in _STATUSWORD:
        if statusword & mask == value:
            return state
    return Cia402State.NOT_READY_TO_SWITCH_ON


class Drive(CyclicDevice):
    """One drive of the arm, joint 1 or 2. Its status may be in a frame of its own or in the feedback."""

    def __init__(self, settings: Settings, codec: Codec, placed: PlacedDevice) -> None:
        """Raise CodecError when the contract lacks a message or signal, or a command has one that can't be filled."""
        super().__init__(settings, codec, placed, "Feedback", "position")
        self._command_message = codec.message(f"{self.name}Command")
        self.command_id = self._command_message.can_id
        self._sender = self._command_message.sender()
        self._quick_stop_option, _ = option_codes(settings, placed.settings)
        self._position_jump_rad = placed.settings.plausibility.position_jump_rad
        self._velocity_at = self._message.place("velocity")
        self._feedback_status = _status_places(self._message)
        self._status_places = _NO_STATUS if self.status_message is None else _status_places(self.status_message)
        self._command, self._controlword_at, self._torque_at = _command_template(
            self._command_message, torque_limit_permille(settings, placed.joint)
        )
        cyclic, slow = self._feedback_status, self._status_places
        self.has_status_frame = any(getattr(cyclic, name) < 0 <= getattr(slow, name) for name in _JUDGED)
        """Whether statusword, mode or actual torque, which the host judges, come in a status frame alone."""
        if max(cyclic.statusword, slow.statusword) < 0:
            raise CodecError(f"{self.name}: no message carries signal statusword")
        self._last_controlword = Controlword.DISABLE_VOLTAGE
        self.recent_permille: deque[int] = deque([0], maxlen=_RECENT_COMMANDS)
        """Commanded torque of the last cycles, per mille of rated torque."""
        self.values = 0.0, 0.0  # position, rad, and velocity, rad/s
        self.state = Cia402State.NOT_READY_TO_SWITCH_ON
        self.statusword = 0
        # If no frame shows the mode, the master has compared 0x6061 before the start, if `_enter_mode` could.
        self.mode = 0 if shows_mode(codec, self.name) else MODE_CYCLIC_SYNCHRONOUS_TORQUE
        self.is_enabled = False
        """Whether the drive produces the commanded torque."""
        self.torque_actual_permille = 0
        self.torque_cycle = -1
        """Cycle of the last frame with the actual torque; -1 before the first."""
        self.error_code = 0

    def fault(self, cycle: int, is_enabled: bool) -> FaultReason:
        """Return DATA_AGE if the drives are enabled (`is_enabled`) and a needed status frame is too old.

        Needed: as of `has_status_frame`; too old: older than `status_age_limit`. Else DRIVE if a bounded value is
        outside its bounds, or a status with such values missing or too old; else NONE. The drive's own FAULT state and
        `error_code` don't count here.
        """
        if is_enabled and self.has_status_frame and cycle - self.status_cycle > self.status_age_limit:
            return FaultReason.DATA_AGE
        return FaultReason.DRIVE if self.has_excess(cycle) else FaultReason.NONE

    def _is_plausible(self, values: Sequence[float], last: float, cycles: int) -> bool:
        travel = values[self._velocity_at] * (cycles * self._period_s)
        return abs(values[self._main_at] - last - travel) <= self._position_jump_rad

    def _use(self, data: bytes, values: Sequence[float], cycle: int) -> None:  # noqa: ARG002 (as of all devices)
        self.values = values[self._main_at], values[self._velocity_at]
        self.sample_cycle = cycle
        self._take_status(values, self._feedback_status, cycle)

    def _use_status(self, values: Sequence[float], cycle: int) -> None:
        self._take_status(values, self._status_places, cycle)

    @property
    def is_limited(self) -> bool:
        """Whether the drive reports that a limit of its own keeps it from the commanded torque."""
        return bool(self.statusword & _INTERNAL_LIMIT)

    def position_error(self, data: bytes, periods: int) -> float:
        """Return by how much a frame's position misses the last frame's plus `periods` of travel, rad.

        The travel is that at this frame's velocity. At least 0; 0 before the first frame, for a protected drive, and
        for a wrong length. The frame is not stored.
        """
        if self._received is None or len(data) != self.cyclic_length:
            return 0.0
        values = self._message.decode_values(data)
        travel = values[self._velocity_at] * periods * self._period_s
        return abs(values[self._main_at] - self._received - travel)

    def _take_status(self, values: Sequence[float], at: _StatusPlaces, cycle: int) -> None:
        """Store the signals of the status that a frame of `cycle` carries; those that it lacks keep their values.

        at: their places among `values`.
        """
        if at.statusword >= 0:
            self.statusword = int(values[at.statusword])
            self.state = decode_statusword(self.statusword)
        if at.mode_display >= 0:
            self.mode = int(values[at.mode_display])
        self.is_enabled = self.state is Cia402State.OPERATION_ENABLED and self.mode == MODE_CYCLIC_SYNCHRONOUS_TORQUE
        if at.torque_actual >= 0:
            self.torque_actual_permille = int(values[at.torque_actual])
            self.torque_cycle = cycle
        if at.error_code >= 0:
            self.error_code = int(values[at.error_code])

    def command(self, torque_permille: int, enable: bool, quick_stop: bool) -> bytes:
        """Return the next command frame: one state nearer to Operation enabled if `enable`, else disable voltage.

        `quick_stop` has precedence over both. Torque is zero unless the drive is enabled in cyclic synchronous torque,
        `enable` is set and `quick_stop` is not. Each call advances the frame's alive counter, and notes the torque in
        `recent_permille`.
        """
        is_wanted = enable and not quick_stop
        controlword = self._next_controlword() if is_wanted else Controlword.DISABLE_VOLTAGE
        if quick_stop:
            controlword = Controlword.QUICK_STOP
        self._last_controlword = controlword
        raw = self._command
        raw[self._controlword_at] = controlword
        torque = torque_permille if is_wanted and self.is_enabled else 0
        raw[self._torque_at] = torque
        self.recent_permille.append(torque)
        return self._sender.protect(self._command_message.encode_raw(*raw))

    def _next_controlword(self) -> Controlword:
        """Return the controlword that leads one state nearer to Operation enabled; disable voltage if there is none.

        In OPERATION_ENABLED it is enable operation. In FAULT, fault reset and disable voltage alternate; in
        QUICK_STOP_ACTIVE, quick stop as long as the drive must brake.
        """
        if self.state is Cia402State.OPERATION_ENABLED:  # nearly always
            return Controlword.ENABLE_OPERATION
        if self.state is Cia402State.FAULT:  # the edge counts, so low and high alternate
            is_high = self._last_controlword is Controlword.FAULT_RESET
            return Controlword.DISABLE_VOLTAGE if is_high else Controlword.FAULT_RESET
        if self.state is Cia402State.QUICK_STOP_ACTIVE:
            return Controlword.QUICK_STOP if self._is_quick_stopping else Controlword.DISABLE_VOLTAGE
        return _WAY_UP.get(self.state, Controlword.DISABLE_VOLTAGE)

    @property
    def _is_quick_stopping(self) -> bool:
        """Whether the drive, in QUICK_STOP_ACTIVE, must be left to brake: disable voltage would let it coast.

        False if 0x605A is unknown, and for an option from `_FIRST_STAYING_OPTION` on once the drive stands still.
        """
        option = self._quick_stop_option
        if option is None:
            return False
        if option < _FIRST_STAYING_OPTION:
            return True  # it leaves by itself
        is_halted = bool(self.statusword & _TARGET_REACHED) or abs(self.values[1]) <= _STANDSTILL_RAD_S
        return not is_halted


def _status_places(message: MessageCodec) -> _StatusPlaces:
    places = {signal.name: place for place, signal in enumerate(message.values)}
    return _StatusPlaces(**{name: places[name] for name in _StatusPlaces._fields if name in places})


def _command_template(message: MessageCodec, max_torque_permille: int) -> tuple[list[int], int, int]:
    """Return the raw values of a command with the constant ones filled in, and where controlword and torque are.

    Raises CodecError for a signal that the host can't fill, or if one of these two is missing.
    """
    constants = {
        "controlword": 0,
        "target_torque": 0,
        "torque_offset": 0,
        "max_torque": max_torque_permille,
        "mode": MODE_CYCLIC_SYNCHRONOUS_TORQUE,
    }
    template = []
    for signal in message.values:
        if signal.name not in constants:
            raise CodecError(f"{message.name}: signal {signal.name} is none that the host can fill")
        template.append(constants[signal.name])
    return template, message.place("controlword"), message.place("target_torque")
