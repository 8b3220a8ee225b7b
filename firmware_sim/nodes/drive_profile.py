"""The CiA 402 profile of a torque drive: its state machine as one table, how it stops, its limits.

The table has the standard's transition numbers. In cyclic synchronous torque the drive leaves the set-point and brakes
by itself: on the slow-down ramp, on the quick-stop ramp, or up to its current limit. Ramps by voltage limit don't exist
here: codes 4 and 8 are refused.

Torque in cyclic synchronous torque, per mille of rated torque:

    demand 0x6074 = target 0x6071 + offset 0x60B2, within −min(0x6072, 0x60E1) … +min(0x6072, 0x60E0)

Source: CiA 402-2 (IEC 61800-7-201): power drive system finite state automaton, controlword 0x6040, statusword 0x6041,
objects 0x605A to 0x605E, cyclic synchronous torque mode.
"""

import functools
from enum import Enum
from typing import NamedTuple

from adacd_hil.wire.codec import Codec
from adacd_hil.wire.time_marks import NEVER_NS
from firmware_sim.arm.sensing import VELOCITY_LSB_RAD_S, DriveMode
from firmware_sim.canopen.object_dictionary import ObjectDictionary
from firmware_sim.canopen.pdo import Pdos

_FAULT_RESET = 0x80  # bit 7 of the controlword
_VOLTAGE_ENABLED = 1 << 4  # of the statusword: the power stage has its supply


class DriveState(Enum):
    """States of CiA 402. A comment names the events that leave the state.

    A fault leaves all but START and the last two.
    """

    START = "start"  # by itself, at power-on or reset
    NOT_READY_TO_SWITCH_ON = "not ready to switch on"  # by itself, when initialised
    SWITCH_ON_DISABLED = "switch on disabled"  # shutdown
    READY_TO_SWITCH_ON = "ready to switch on"  # switch on, enable operation; back: disable voltage, quick stop
    SWITCHED_ON = "switched on"  # enable operation; back: shutdown, disable voltage, quick stop
    OPERATION_ENABLED = "operation enabled"  # disable operation, shutdown, disable voltage, quick stop
    QUICK_STOP_ACTIVE = "quick stop active"  # at standstill, or as 0x605A says enable operation; disable voltage
    FAULT_REACTION_ACTIVE = "fault reaction active"  # by itself at standstill
    FAULT = "fault"  # fault reset, once the cause is gone


class DriveEvent(Enum):
    """Events of the state machine: the controlword's commands, and changes that the drive finds itself."""

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


_S, _E = DriveState, DriveEvent
TRANSITIONS: dict[tuple[DriveState, DriveEvent], DriveState] = {
    (_S.START, _E.POWER_ON): _S.NOT_READY_TO_SWITCH_ON,  # 0
    (_S.NOT_READY_TO_SWITCH_ON, _E.INITIALISED): _S.SWITCH_ON_DISABLED,  # 1
    (_S.SWITCH_ON_DISABLED, _E.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 2
    (_S.READY_TO_SWITCH_ON, _E.SWITCH_ON): _S.SWITCHED_ON,  # 3
    # "Switch on and enable operation" in one word: 3 now, 4 with the next command.
    (_S.READY_TO_SWITCH_ON, _E.ENABLE_OPERATION): _S.SWITCHED_ON,  # 3
    (_S.SWITCHED_ON, _E.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 4
    (_S.OPERATION_ENABLED, _E.SWITCH_ON): _S.SWITCHED_ON,  # 5
    (_S.SWITCHED_ON, _E.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 6
    (_S.READY_TO_SWITCH_ON, _E.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 7
    (_S.READY_TO_SWITCH_ON, _E.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 7
    (_S.OPERATION_ENABLED, _E.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 8
    (_S.OPERATION_ENABLED, _E.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 9
    (_S.SWITCHED_ON, _E.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 10
    (_S.SWITCHED_ON, _E.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 10
    (_S.OPERATION_ENABLED, _E.QUICK_STOP): _S.QUICK_STOP_ACTIVE,  # 11
    (_S.QUICK_STOP_ACTIVE, _E.QUICK_STOP_DONE): _S.SWITCH_ON_DISABLED,  # 12
    (_S.QUICK_STOP_ACTIVE, _E.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 12
    **{
        (state, _E.FAULT_DETECTED): _S.FAULT_REACTION_ACTIVE  # 13
        for state in DriveState
        if state not in (_S.START, _S.FAULT_REACTION_ACTIVE, _S.FAULT)
    },
    (_S.FAULT_REACTION_ACTIVE, _E.FAULT_REACTION_DONE): _S.FAULT,  # 14
    (_S.FAULT, _E.FAULT_RESET): _S.SWITCH_ON_DISABLED,  # 15
    # Only where 0x605A lets the drive stay in Quick stop active.
    (_S.QUICK_STOP_ACTIVE, _E.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 16
}
"""State after an event in a state that it changes; a comment has the standard's number. CiA 402-2, figure "power drive
system finite state automaton" and its table of transitions."""

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


def decode_command(controlword: int, previous: int) -> DriveEvent | None:
    """Return the command of a controlword; None if it has none (CiA 402-2, command coding).

    `previous`: the controlword before it. Fault reset is the rising edge of bit 7; while bit 7 stays set, a controlword
    carries no command.
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


REST_RAD_S = 0.02  # standstill: a hundredth of the slowest motion that the arm makes
REST_NS = 10_000_000  # standstill lasts; passing through zero does not
LONGEST_BRAKING_NS = 1_000_000_000  # an arm that someone keeps pushing never stands still


class Stop(NamedTuple):
    """How an option code stops the drive. `mode` OFF: at once, without braking.

    stays: the drive then stays in Quick stop active.
    """

    mode: DriveMode
    stays: bool = False  # in Quick stop active


DISABLE = Stop(DriveMode.OFF)
QUICK_STOPS = {
    0: DISABLE,
    1: Stop(DriveMode.BRAKE_SLOWLY),
    2: Stop(DriveMode.BRAKE),
    3: Stop(DriveMode.BRAKE_HARD),
    5: Stop(DriveMode.BRAKE_SLOWLY, stays=True),
    6: Stop(DriveMode.BRAKE, stays=True),
    7: Stop(DriveMode.BRAKE_HARD, stays=True),
}
"""0x605A."""
RAMPS = {0: DISABLE, 1: Stop(DriveMode.BRAKE_SLOWLY)}
"""0x605B shutdown, 0x605C disable operation."""
FAULT_REACTIONS = {code: QUICK_STOPS[code] for code in (0, 1, 2, 3)}
"""0x605E."""


_SYNCS, _TOLERANCE = 0x2200, 0x2201
_NO_COMMAND_YET = 256  # SYNCs without a command: more than the longest patience, 0x2200
_NO_PATIENCE = 1 << 30  # a drive without 0x2200 doesn't count SYNCs
_TENTH_PERIODS = 15  # a drive without 0x2201: SYNC is missing after 1.5 periods
_UNLIMITED = 0xFFFF  # torque where the EDS lacks a limit
_TARGET, _OFFSET = 0x6071, 0x60B2
_MOST, _MOST_POSITIVE, _MOST_NEGATIVE = 0x6072, 0x60E0, 0x60E1


class TorqueLimits:
    """Target, offset and limits of torque, per mille of rated torque, as SDO or RPDO writes them.

    `demand` follows from them. A limit that the EDS lacks doesn't limit.
    """

    def __init__(self, dictionary: ObjectDictionary, pdos: Pdos) -> None:
        self.demand = 0
        """Torque demand 0x6074, per mille: target plus offset, within the limits."""
        self.is_limiting = False
        """Whether target plus offset lies beyond a torque limit, one cause of statusword bit 11."""
        self._values = {index: dictionary.default_or(0, index) for index in (_TARGET, _OFFSET)}
        for index in (_MOST, _MOST_POSITIVE, _MOST_NEGATIVE):
            self._values[index] = dictionary.default_or(_UNLIMITED, index)
        for index, permille in self._values.items():
            take = functools.partial(self._take, index)
            dictionary.serve(index, 0, functools.partial(self._values.__getitem__, index))
            dictionary.watch(index, 0, take)
            pdos.accept_values(index, 0, take)
            take(permille)

    def forget_target(self) -> None:
        """Set the target torque to 0."""
        self._take(_TARGET, 0)

    def _take(self, index: int, permille: int) -> None:
        """Store the value of object `index`, and set `demand` and `is_limiting`.

        In each direction the smaller of its own limit and of 0x6072 counts.
        """
        values = self._values
        values[index] = permille
        wanted, most = values[_TARGET] + values[_OFFSET], values[_MOST]
        self.demand = max(-min(most, values[_MOST_NEGATIVE]), min(wanted, most, values[_MOST_POSITIVE]))
        self.is_limiting = self.demand != wanted


class Patience:
    """How long an enabled drive goes without SYNC and without commands: 0x1006, 0x2200, 0x2201."""

    def __init__(self, dictionary: ObjectDictionary) -> None:
        self.silent_syncs = _NO_COMMAND_YET
        """SYNCs since the last command."""
        self.sync_ns = 0
        """When the last SYNC came, by the device's clock."""
        self._factory_period_us = self._period_us = dictionary.value(0x1006)
        dictionary.watch(0x1006, 0, self._set_period)
        self._values = {
            _SYNCS: dictionary.value_or(_NO_PATIENCE, _SYNCS),
            _TOLERANCE: dictionary.value_or(_TENTH_PERIODS, _TOLERANCE),
        }
        for index in self._values:
            dictionary.watch(index, 0, functools.partial(self._values.__setitem__, index))

    @property
    def is_command_missing(self) -> bool:
        """Whether 0x2200 SYNCs or more have come since the last command; True before the first command.

        Always False for a drive that lacks 0x2200.
        """
        return self.silent_syncs >= self._values[_SYNCS]

    @property
    def sync_due_ns(self) -> int:
        """Time on the device's clock from which SYNC counts as missing, ns: 0x2201 tenths of a period after the last.

        A drive that lacks 0x2201 waits for 1.5 periods. NEVER_NS while 0x1006 is 0; a drive whose EDS gives a period
        keeps its last period then.
        """
        if not self._period_us:
            return NEVER_NS
        return self.sync_ns + self._period_us * self._values[_TOLERANCE] * 100

    def forget_command(self) -> None:
        """Forget the last command: commands count as missing until the next one."""
        self.silent_syncs = _NO_COMMAND_YET

    def _set_period(self, period_us: int) -> None:
        # 0 is written to change 0x1019; a drive that has a period from its factory watches SYNC all the same.
        if period_us or not self._factory_period_us:
            self._period_us = period_us


def velocity_lsb(codec: Codec, number: int, factor: float) -> float | None:
    """Return a drive's LSB of velocity, rad/s: the contract's divided by `factor`; None if that is VELOCITY_LSB_RAD_S.

    With None the counts of the emulated arm are sent as they are. number: of the drive, 1 or 2. Raises CodecError if
    the DBC lacks its feedback.
    """
    message = codec.message(f"Drive{number}Feedback")
    scale = message.values[message.place("velocity")].scale / factor
    return None if scale == VELOCITY_LSB_RAD_S else scale
