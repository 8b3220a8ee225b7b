"""One drive as the host sees it: CiA 402 state, feedback, commands in cyclic synchronous torque.

Positions, velocities and torques are the device's own: sign and ratio belong to `adacd_hil.device.arm`.
Source: CiA 402-2 / IEC 61800-7-201, clause 10.3 (state machine), clause 16 (cyclic synchronous torque).
"""

from enum import IntEnum
from typing import NamedTuple

from adacd_hil.wire.codec import Codec
from adacd_hil.wire.e2e import E2eSender

MODE_CYCLIC_SYNCHRONOUS_TORQUE = 10

IMPLAUSIBLE_JUMP_RAD = 0.02
"""Position against velocity, per frame. The drive's velocity lags 1.6 ms, so 100 rad/s² leave 0.3 mrad; a flipped
high bit of the unprotected frame is at least 0.1 rad."""


class Cia402State(IntEnum):
    """States of the power drive system. Each value says how to get out of it."""

    NOT_READY_TO_SWITCH_ON = 0  # by itself, after the drive's self test
    SWITCH_ON_DISABLED = 1  # shutdown
    READY_TO_SWITCH_ON = 2  # switch on
    SWITCHED_ON = 3  # enable operation
    OPERATION_ENABLED = 4  # disable operation, shutdown, disable voltage, quick stop
    QUICK_STOP_ACTIVE = 5  # by itself at standstill, or disable voltage
    FAULT_REACTION_ACTIVE = 6  # by itself, when the reaction is done
    FAULT = 7  # fault reset, rising edge, cause gone


class Controlword(IntEnum):
    """Commands of 0x6040 in cyclic synchronous torque."""

    DISABLE_VOLTAGE = 0x0000
    QUICK_STOP = 0x0002
    SHUTDOWN = 0x0006
    SWITCH_ON = 0x0007
    ENABLE_OPERATION = 0x000F
    FAULT_RESET = 0x0080


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


class Transition(NamedTuple):
    """One transition that the host commands, with the standard's number."""

    number: int
    command: Controlword
    target: Cia402State


TOWARD_ENABLED: dict[Cia402State, Transition] = {
    Cia402State.SWITCH_ON_DISABLED: Transition(2, Controlword.SHUTDOWN, Cia402State.READY_TO_SWITCH_ON),
    Cia402State.READY_TO_SWITCH_ON: Transition(3, Controlword.SWITCH_ON, Cia402State.SWITCHED_ON),
    Cia402State.SWITCHED_ON: Transition(4, Controlword.ENABLE_OPERATION, Cia402State.OPERATION_ENABLED),
    Cia402State.FAULT: Transition(15, Controlword.FAULT_RESET, Cia402State.SWITCH_ON_DISABLED),
}
"""The way up. States that are not listed are left by the drive itself."""

_HOLD = {Cia402State.OPERATION_ENABLED: Controlword.ENABLE_OPERATION}


def decode_statusword(statusword: int) -> Cia402State:
    """Read the state from 0x6041; a pattern the standard doesn't list counts as not ready."""
    for mask, value, state in _STATUSWORD:
        if statusword & mask == value:
            return state
    return Cia402State.NOT_READY_TO_SWITCH_ON


class Drive:
    """One drive of the arm, joint 1 or 2."""

    def __init__(self, codec: Codec, joint: int, period_s: float) -> None:
        name = f"Drive{joint}"
        self.name = name
        self.node_id = codec.node_id(f"{name}Feedback")
        self.feedback_message = codec.message(f"{name}Feedback")
        self.status_message = codec.message(f"{name}Status")
        self._command_message = codec.message(f"{name}Command")
        self.command_id = self._command_message.can_id
        self._sender: E2eSender = self._command_message.sender()
        self._period_s = period_s
        self._received_position_rad: float | None = None
        self._received_cycle = 0
        self._fault_reset = False
        self.position_rad = 0.0
        self.velocity_rad_s = 0.0
        self.sample_cycle = -1
        """Cycle of the position and velocity in use; -1 before the first."""
        self.implausible_frames = 0
        self.state = Cia402State.NOT_READY_TO_SWITCH_ON
        self.mode = 0
        self.torque_actual_permille = 0
        self.error_code = 0

    def accept_feedback(self, data: bytes, cycle: int) -> bool:
        """Take one feedback frame of `cycle`; False when it is implausible and changes nothing."""
        if len(data) != self.feedback_message.length:
            self.implausible_frames += 1
            return False
        position, velocity = self.feedback_message.decode_values(data)
        last, self._received_position_rad = self._received_position_rad, position
        elapsed_s = (cycle - self._received_cycle) * self._period_s
        self._received_cycle = cycle
        if last is not None and not abs(position - last - velocity * elapsed_s) <= IMPLAUSIBLE_JUMP_RAD:
            self.implausible_frames += 1
            return False
        self.position_rad = position
        self.velocity_rad_s = velocity
        self.sample_cycle = cycle
        return True

    def accept_status(self, data: bytes) -> None:
        """Take one status frame; a frame of the wrong length changes nothing."""
        if len(data) != self.status_message.length:
            return
        statusword, mode, torque, error_code = self.status_message.decode_values(data)
        self.state = decode_statusword(int(statusword))
        self.mode = int(mode)
        self.torque_actual_permille = int(torque)
        self.error_code = int(error_code)

    @property
    def is_enabled(self) -> bool:
        """Whether the drive produces the commanded torque."""
        return self.state is Cia402State.OPERATION_ENABLED and self.mode == MODE_CYCLIC_SYNCHRONOUS_TORQUE

    def command(self, torque_permille: int, enable: bool, quick_stop: bool) -> bytes:
        """Encode one command frame; torque is zero unless the drive is wanted and enabled."""
        controlword = self._next_controlword(enable, quick_stop)
        if not (enable and self.is_enabled):
            torque_permille = 0
        return self._sender.protect(self._command_message.encode_raw(controlword, torque_permille))

    def _next_controlword(self, enable: bool, quick_stop: bool) -> int:
        if quick_stop:
            return Controlword.QUICK_STOP
        if not enable:
            return Controlword.DISABLE_VOLTAGE
        if self.state is Cia402State.FAULT:  # the edge counts, so low and high alternate
            self._fault_reset = not self._fault_reset
            return Controlword.FAULT_RESET if self._fault_reset else Controlword.DISABLE_VOLTAGE
        if self.state in TOWARD_ENABLED:
            return TOWARD_ENABLED[self.state].command
        return _HOLD.get(self.state, Controlword.DISABLE_VOLTAGE)
