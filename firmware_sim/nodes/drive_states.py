"""The state machine of CiA 402 drives as one table, with the standard's transition numbers.

Source: CiA 402-2 (IEC 61800-7-201), power drive system finite state automaton, controlword 0x6040, statusword 0x6041.
"""

from enum import Enum
from typing import NamedTuple

_FAULT_RESET = 0x80  # bit 7 of the controlword
_VOLTAGE_ENABLED = 1 << 4  # of the statusword: the power stage has its supply


class DriveState(Enum):
    """States of CiA 402. Each says how to get out of it."""

    START = "start"  # by itself, at power-on or reset
    NOT_READY_TO_SWITCH_ON = "not ready to switch on"  # by itself, when initialised
    SWITCH_ON_DISABLED = "switch on disabled"  # shutdown
    READY_TO_SWITCH_ON = "ready to switch on"  # switch on; back: disable voltage, quick stop
    SWITCHED_ON = "switched on"  # enable operation; back: shutdown, disable voltage, quick stop
    OPERATION_ENABLED = "operation enabled"  # disable operation, shutdown, disable voltage, quick stop
    QUICK_STOP_ACTIVE = "quick stop active"  # by itself at standstill; disable voltage
    FAULT_REACTION_ACTIVE = "fault reaction active"  # by itself at standstill
    FAULT = "fault"  # fault reset, once the cause is gone


class DriveEvent(Enum):
    """What moves the state machine: the controlword's commands and the drive's own findings."""

    SHUTDOWN = "shutdown"
    SWITCH_ON = "switch on, disable operation"  # one bit pattern; its meaning depends on the state
    ENABLE_OPERATION = "enable operation"
    DISABLE_VOLTAGE = "disable voltage"
    QUICK_STOP = "quick stop"
    FAULT_RESET = "fault reset"
    POWER_ON = "power on or reset"
    INITIALISED = "initialised"
    QUICK_STOP_DONE = "quick stop completed"
    FAULT_DETECTED = "fault detected"
    FAULT_REACTION_DONE = "fault reaction completed"


class Transition(NamedTuple):
    """One arrow of the state machine with the standard's number."""

    number: int
    source: DriveState
    event: DriveEvent
    target: DriveState


_S, _E = DriveState, DriveEvent
TRANSITIONS = (
    Transition(0, _S.START, _E.POWER_ON, _S.NOT_READY_TO_SWITCH_ON),
    Transition(1, _S.NOT_READY_TO_SWITCH_ON, _E.INITIALISED, _S.SWITCH_ON_DISABLED),
    Transition(2, _S.SWITCH_ON_DISABLED, _E.SHUTDOWN, _S.READY_TO_SWITCH_ON),
    Transition(3, _S.READY_TO_SWITCH_ON, _E.SWITCH_ON, _S.SWITCHED_ON),
    # "Switch on and enable operation" in one word: 3 now, 4 with the next command.
    Transition(3, _S.READY_TO_SWITCH_ON, _E.ENABLE_OPERATION, _S.SWITCHED_ON),
    Transition(4, _S.SWITCHED_ON, _E.ENABLE_OPERATION, _S.OPERATION_ENABLED),
    Transition(5, _S.OPERATION_ENABLED, _E.SWITCH_ON, _S.SWITCHED_ON),
    Transition(6, _S.SWITCHED_ON, _E.SHUTDOWN, _S.READY_TO_SWITCH_ON),
    Transition(7, _S.READY_TO_SWITCH_ON, _E.QUICK_STOP, _S.SWITCH_ON_DISABLED),
    Transition(7, _S.READY_TO_SWITCH_ON, _E.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    Transition(8, _S.OPERATION_ENABLED, _E.SHUTDOWN, _S.READY_TO_SWITCH_ON),
    Transition(9, _S.OPERATION_ENABLED, _E.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    Transition(10, _S.SWITCHED_ON, _E.QUICK_STOP, _S.SWITCH_ON_DISABLED),
    Transition(10, _S.SWITCHED_ON, _E.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    Transition(11, _S.OPERATION_ENABLED, _E.QUICK_STOP, _S.QUICK_STOP_ACTIVE),
    Transition(12, _S.QUICK_STOP_ACTIVE, _E.QUICK_STOP_DONE, _S.SWITCH_ON_DISABLED),
    Transition(12, _S.QUICK_STOP_ACTIVE, _E.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    *(
        Transition(13, state, _E.FAULT_DETECTED, _S.FAULT_REACTION_ACTIVE)
        for state in DriveState
        if state not in (_S.START, _S.FAULT_REACTION_ACTIVE, _S.FAULT)
    ),
    Transition(14, _S.FAULT_REACTION_ACTIVE, _E.FAULT_REACTION_DONE, _S.FAULT),
    Transition(15, _S.FAULT, _E.FAULT_RESET, _S.SWITCH_ON_DISABLED),
    # Only where 0x605A lets the drive stay in Quick stop active.
    Transition(16, _S.QUICK_STOP_ACTIVE, _E.ENABLE_OPERATION, _S.OPERATION_ENABLED),
)
"""CiA 402-2, figure "power drive system finite state automaton" and its table of transitions."""

_BY_SOURCE = {(row.source, row.event): row for row in TRANSITIONS}

STATE_BITS = {
    DriveState.START: 0x00,
    DriveState.NOT_READY_TO_SWITCH_ON: 0x00,
    DriveState.SWITCH_ON_DISABLED: 0x40 | _VOLTAGE_ENABLED,
    DriveState.READY_TO_SWITCH_ON: 0x21 | _VOLTAGE_ENABLED,
    DriveState.SWITCHED_ON: 0x23 | _VOLTAGE_ENABLED,
    DriveState.OPERATION_ENABLED: 0x27 | _VOLTAGE_ENABLED,
    DriveState.QUICK_STOP_ACTIVE: 0x07 | _VOLTAGE_ENABLED,
    DriveState.FAULT_REACTION_ACTIVE: 0x0F | _VOLTAGE_ENABLED,
    DriveState.FAULT: 0x08 | _VOLTAGE_ENABLED,
}
"""Bits 0 to 6 of the statusword; quick stop (bit 5) is 0 where the standard leaves it open."""


def find_transition(state: DriveState, event: DriveEvent) -> Transition | None:
    """Return the transition that `event` causes in `state`, None when it causes none."""
    return _BY_SOURCE.get((state, event))


def decode_command(controlword: int, previous: int) -> DriveEvent | None:
    """Name the command of a controlword, None when it carries none (CiA 402-2, command coding).

    Fault reset is the rising edge of bit 7; while bit 7 stays set there is no command.
    """
    if controlword & _FAULT_RESET:
        return None if previous & _FAULT_RESET else DriveEvent.FAULT_RESET
    if not controlword & 0x02:
        return DriveEvent.DISABLE_VOLTAGE
    if not controlword & 0x04:
        return DriveEvent.QUICK_STOP
    if not controlword & 0x01:
        return DriveEvent.SHUTDOWN
    return DriveEvent.ENABLE_OPERATION if controlword & 0x08 else DriveEvent.SWITCH_ON
