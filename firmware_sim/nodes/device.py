"""One emulated CANopen device: NMT slave with object dictionary, PDOs, heartbeats, EMCY and watchdogs.

It starts no thread: heartbeats and every other timer run on the time that comes in as `t_ns`. Calls from a bench take
the bench's time; a device and its application exchange times of the device's own clock. Source: CiA 301, 7.2
(services), 7.3 (NMT), 7.5.2.32 (0x1029, error behaviour).
"""

from collections.abc import Mapping, Sequence
from enum import IntEnum
from functools import partial
from typing import Protocol

from adacd_hil.records import Vector
from adacd_hil.wire.codec import MessageCodec
from adacd_hil.wire.contract_frames import SYNC_OVERFLOW
from adacd_hil.wire.time_marks import NEVER_NS
from firmware_sim.arm.sensing import Measurement
from firmware_sim.canopen.error_control import (
    ErrorReporter,
    HeartbeatConsumer,
    HeartbeatProducer,
    SyncCounts,
    SyncKind,
    Watchdog,
)
from firmware_sim.canopen.object_dictionary import Abort, DeviceDescription, ObjectDictionary, Send, refuse
from firmware_sim.canopen.pdo import Pdos

_GENERIC, _COMMUNICATION = 0x01, 0x10  # bits of 0x1001
_RECOVERED_FROM_BUS_OFF = 0x8140
_CLEAR_HISTORY = (0x1003, 0)


class NmtState(IntEnum):
    """NMT states, CiA 301 figure 46. Every state but the first ends by an NMT command or without power."""

    INITIALISING = 0  # by itself: boot-up message, then Pre-operational
    STOPPED = 4
    OPERATIONAL = 5  # also to Pre-operational, without the master's heartbeat or off the bus
    PRE_OPERATIONAL = 127


_COMMANDED_STATES = {1: NmtState.OPERATIONAL, 2: NmtState.STOPPED, 128: NmtState.PRE_OPERATIONAL}
_EMCY_STATES = (NmtState.OPERATIONAL, NmtState.PRE_OPERATIONAL)
RESET_NODE, RESET_COMMUNICATION = 129, 130


class Application:
    """The application of a device: everything besides communication.

    `EmulatedDevice` calls the methods; here they are empty. Times `t_ns` are of the device's own clock.
    """

    @property
    def is_at_work(self) -> bool:
        """Whether the device is at work, so that its objects must not change; False unless overridden."""
        return False

    def act(self, t_ns: int) -> None:
        """Do nothing; subclasses act on the values of an RPDO that doesn't wait for SYNC, which have been written."""

    def mind_length(self, is_right: bool, t_ns: int) -> None:
        """Do nothing; subclasses react to an RPDO frame of wrong length, or (`is_right`) the first right one after."""

    def leave_operational(self, t_ns: int) -> None:
        """Do nothing; subclasses react to leaving Operational. EMCY messages can still be sent."""

    def enter_operational(self, t_ns: int) -> None:
        """Do nothing; subclasses react to entering Operational. PDOs are exchanged already."""

    def lose_heartbeat(self, t_ns: int) -> None:
        """Do nothing; subclasses react to the loss of the master's heartbeat, before its watchdog trips."""

    def distrust_sync(self, t_ns: int) -> None:
        """Do nothing; subclasses react to more than TOLERATED SYNCs that were repeated, early or out of sequence."""

    def note_error(self) -> None:
        """Do nothing; subclasses react to a possible change of the error register, 0x1001."""

    def restart_node(self, is_node_reset: bool) -> None:
        """Do nothing; subclasses reset their state. `is_node_reset`: False at a reset of the communication only."""


class MovableArm(Protocol):
    """An arm as its devices use it; the members mean the same as those of `firmware_sim.body.body.Body`."""

    @property
    def has_ideal_motors(self) -> bool: ...  # noqa: D102

    @property
    def is_torque_limited(self) -> tuple[bool, bool]: ...  # noqa: D102

    @property
    def motor_error_code(self) -> tuple[int, int]: ...  # noqa: D102

    @property
    def motor_torque_Nm(self) -> tuple[float, float]: ...  # noqa: D102

    @property
    def joint_temperature_C(self) -> tuple[float, float]: ...  # noqa: D102

    @property
    def drive_velocity_rad_s(self) -> tuple[float, float]: ...  # noqa: D102

    def start_scenario(self) -> None: ...  # noqa: D102

    def advance(  # noqa: D102
        self, torque_setpoint_Nm: Sequence[float], drive_mode: Sequence[int], tick_count: int
    ) -> None: ...

    def sample(self) -> Measurement: ...  # noqa: D102

    def truth(self, out: Vector) -> None: ...  # noqa: D102


class EmulatedDevice(ObjectDictionary):
    """A CANopen device: its communication; `attach` gives it an application."""

    def __init__(
        self,
        node_id: int,
        description: DeviceDescription,
        send: Send,
        messages: Mapping[int, MessageCodec],
        longest_pdo: int,
    ) -> None:
        """Read the EDS; the device sends no frame before `power_on`. Raises OSError if the EDS can't be read.

        `messages`: the contract's, by identifier. `longest_pdo`: in bytes.
        """
        super().__init__(node_id, description, self._send)
        self.clock = NodeClock()
        self.is_powered = True
        self._is_bus_off = False
        self.state = NmtState.INITIALISING
        self.is_operational = False
        self.is_faulty = False
        """Whether the application is in a fault, 0x1001 bit 0."""
        self.fault_bits = 0
        """Bits of 0x1001 that name the kind of that fault."""
        self.now_ns = 0
        """Time of the last request, for timers that it starts."""
        self.power_on_ns = 0
        """When the device got its power, by its own clock."""
        self.pause_ns = 0
        """For how long after an SDO answer the device hears no further request."""
        self._answered_ns: int | None = None
        self._put_on_bus = send
        self._application = Application()
        self._producer = HeartbeatProducer(self, self._send, lambda: self.state, lambda: self.now_ns)
        self._consumer = HeartbeatConsumer(
            self, self.lose_heartbeat, partial(self.clear, Watchdog.HEARTBEAT), lambda: self.now_ns
        )
        self._errors = ErrorReporter(self, self._send, lambda: self.error_register, lambda: self.state in _EMCY_STATES)
        self.tripped = self._errors.tripped
        """Watchdogs that are tripped now."""
        self.sync_counts = SyncCounts(self)
        self.restore(0x1FFF)  # error control gets the defaults of its objects
        self.is_locked = self._is_locked_at_work
        self.watch(0x1006, 0, check=self._check_period)
        self.sync_overflow = self.value(0x1019) if self.has(0x1019) else None
        """0x1019: the last SYNC counter before 1, 0 for SYNCs without counter; None where the EDS lacks it."""
        self.watch(0x1019, 0, self._set_overflow, self._check_overflow)
        self.open_at_work = frozenset({_CLEAR_HISTORY})
        """Objects that SDO may write while the device is at work."""
        self.pdos = Pdos(self, send, messages, longest_pdo)
        self.pdos.own_ns = self.clock.own_ns

    @property
    def is_on_bus(self) -> bool:
        """Whether it has power and its controller takes part in the bus."""
        return self.is_powered and not self._is_bus_off

    @property
    def error_register(self) -> int:
        """Error register 0x1001: bits 0 and 4 while a watchdog is tripped, the fault's bits during a fault.

        The fault's bits are bit 0 and those that name its kind.
        """
        register = _GENERIC | _COMMUNICATION if self.tripped else 0
        return register | (_GENERIC | self.fault_bits if self.is_faulty else 0)

    def attach(self, application: Application) -> None:
        """Set the application, which then gets received values and state changes."""
        self._application = application
        self.pdos.act, self.pdos.mind_length = application.act, application.mind_length

    def replace_value(self, index: int, subindex: int, value: int | None) -> None:
        """Give an object a value in place of its own, in PDOs and by SDO; None: its own value again.

        The PDOs are bound anew.
        """
        super().replace_value(index, subindex, value)
        self.pdos.refresh()

    def power_on(self, t_ns: int) -> None:
        """Switch the power on: send the boot-up message, begin the heartbeats, and enter Pre-operational.

        In bus-off the device stays silent. t_ns: the bench's time.
        """
        self.is_powered = True
        self.power_on_ns = self.clock.own_ns(t_ns)
        self._boot(self.power_on_ns)

    def power_off(self, _t_ns: int) -> None:
        """Switch the power off: the device neither sends nor hears.

        Written values, errors and application state are lost; values of `replace_value` and the clock's drift stay. The
        argument has no effect.
        """
        self.is_powered = False
        self._errors.forget_messages()
        self.is_operational = False
        self.state = NmtState.INITIALISING
        self.pdos.set_operational(False, self.now_ns)
        self._reset(is_node_reset=True)

    def leave_bus(self, t_ns: int) -> None:
        """Put the controller into bus-off: the device neither sends nor hears.

        An operational device goes to Pre-operational, the default of 0x1029. t_ns: the bench's time.
        """
        self._is_bus_off = True
        if self.is_operational:
            self._enter(NmtState.PRE_OPERATIONAL, self.clock.own_ns(t_ns))

    def return_to_bus(self, t_ns: int) -> None:
        """End `leave_bus`: a device with power takes part in the bus again, and sends an EMCY (0x8140).

        The EMCY waits for the inhibit time, and is not sent if the NMT state or 0x1014 forbids it. t_ns: the bench's
        time.
        """
        self._is_bus_off = False
        if self.is_on_bus:
            self._errors.report_error(_RECOVERED_FROM_BUS_OFF, self.clock.own_ns(t_ns))

    def send_emergency(self, code: int, t_ns: int) -> None:
        """Add an error code to the history and send its EMCY at once, whatever the inhibit time.

        The history gets the code in any case. No EMCY is sent off the bus, or if the NMT state or 0x1014 forbids it.
        After it the inhibit time begins anew. t_ns: the bench's time.
        """
        self._errors.report_at_once(code, self.clock.own_ns(t_ns))

    def _boot(self, t_ns: int) -> None:
        """Send the boot-up message, begin the heartbeats, and enter Pre-operational."""
        self._send(0x700 + self.node_id, bytes([NmtState.INITIALISING]))
        self._producer.begin_heartbeats(t_ns)
        self._enter(NmtState.PRE_OPERATIONAL, t_ns)

    def on_nmt(self, data: bytes, t_ns: int) -> None:
        """Change the NMT state or reset the device by an NMT command.

        Commands of another length than 2, unknown ones, those to other devices and all off the bus have no effect. A
        reset sends the boot-up message. t_ns: the bench's time.
        """
        if len(data) != 2 or data[1] not in (0, self.node_id) or not self.is_on_bus:
            return
        self.now_ns = t_ns = self.clock.own_ns(t_ns)
        command = data[0]
        if command in _COMMANDED_STATES:
            self._enter(_COMMANDED_STATES[command], t_ns)
        elif command in (RESET_NODE, RESET_COMMUNICATION):
            self._enter(NmtState.INITIALISING, t_ns)
            self._reset(command == RESET_NODE)
            self._boot(t_ns)

    def on_sdo(self, data: bytes, t_ns: int) -> None:
        """Answer an SDO request of 8 bytes; ignore it off the bus, in Stopped and within `pause_ns` of an answer.

        Requests of another length are ignored. t_ns: the bench's time.
        """
        if not self.is_on_bus:
            return
        self.now_ns = t_ns = self.clock.own_ns(t_ns)
        if self.pause_ns and self._answered_ns is not None and t_ns - self._answered_ns < self.pause_ns:
            return
        if len(data) == 8 and self.state != NmtState.STOPPED:
            self._answered_ns = t_ns
            self.on_request(data, t_ns)

    def on_heartbeat(self, node_id: int, t_ns: int) -> None:
        """Note another node's heartbeat, if it is the monitored one; ignore it off the bus. t_ns: the bench's time."""
        if self.is_on_bus:
            self._consumer.on_heartbeat(node_id, self.clock.own_ns(t_ns))

    def lose_heartbeat(self, t_ns: int) -> None:
        """React to the master's silence: call the application, trip the watchdog, leave Operational.

        The latter is the default of 0x1029 (CiA 301). t_ns: the device's own time.
        """
        self._application.lose_heartbeat(t_ns)
        self.trip(Watchdog.HEARTBEAT, t_ns)
        if self.is_operational:
            self._enter(NmtState.PRE_OPERATIONAL, t_ns)

    def note_sync(self, kind: SyncKind, lost: int, t_ns: int) -> None:
        """Count a SYNC and the `lost` ones before it; trip or clear the watchdogs SYNC_ORDER and SYNC_LENGTH.

        Outside Operational and off the bus do nothing. If this one is repeated, early or out of sequence, and more than
        TOLERATED were, call the application's `distrust_sync`. t_ns: the bench's time.
        """
        if not (self.is_operational and self.is_on_bus):
            return
        t_ns = self.clock.own_ns(t_ns)
        counts = self.sync_counts
        counts.count_sync(kind, lost)
        if kind is SyncKind.WRONG_LENGTH:
            self.trip(Watchdog.SYNC_LENGTH, t_ns)
        elif kind is SyncKind.RIGHT:
            self.clear(Watchdog.SYNC_LENGTH, t_ns)
            if counts.is_in_order:
                self.clear(Watchdog.SYNC_ORDER, t_ns)
        else:
            self.trip(Watchdog.SYNC_ORDER, t_ns)
            if not counts.is_time_base:
                self._application.distrust_sync(t_ns)

    def trip(self, watchdog: Watchdog, t_ns: int) -> None:
        """Trip a watchdog and send its EMCY, unless it is tripped already.

        Call the application's `note_error` in any case. t_ns: the device's own time.
        """
        self._errors.trip(watchdog, t_ns, self._time_ms(t_ns))
        self._application.note_error()

    def clear(self, watchdog: Watchdog, t_ns: int) -> None:
        """Clear a watchdog whose cause has gone, with an EMCY of code 0; do nothing if it isn't tripped.

        Then call the application's `note_error`. t_ns: the device's own time.
        """
        if watchdog in self.tripped:
            self._errors.clear(watchdog, t_ns, self._time_ms(t_ns))
            self._application.note_error()

    def report_fault(self, code: int, t_ns: int) -> None:
        """Send the EMCY of a fault that no watchdog has found, and add its code to the history.

        The EMCY waits for the inhibit time. t_ns: the device's own time.
        """
        self._errors.report_error(code, t_ns, time_ms=self._time_ms(t_ns))

    def report_no_error(self, t_ns: int) -> None:
        """Report the reset of a fault by an EMCY with code 0, after the inhibit time. t_ns: the device's own time."""
        self._errors.report_error(0, t_ns)

    def poll(self, t_ns: int) -> int:
        """Send heartbeats and EMCYs that are due, detect the master's silence; return when the next timer is due.

        Both times are ns on the device's own clock.
        """
        return min(self._producer.send_due(t_ns), self._consumer.find_silence(t_ns), self._errors.send_waiting(t_ns))

    def _is_locked_at_work(self, index: int, subindex: int) -> bool:
        """Return whether SDO may not write an object: the device is at work, and the object isn't in `open_at_work`."""
        return self._application.is_at_work and (index, subindex) not in self.open_at_work

    def _check_period(self, period_us: int) -> None:
        """Abort an SDO write (DEVICE_STATE) that changes the SYNC period, 0x1006, while the device is Operational."""
        if self.is_operational and period_us != self.value(0x1006):
            refuse(Abort.DEVICE_STATE)

    def _check_overflow(self, overflow: int) -> None:
        """Abort an SDO write of an invalid SYNC overflow, 0x1019, or a change while 0x1006 is not 0: CiA 301, 7.5.2.22.

        Invalid are 1 and more than SYNC_OVERFLOW.
        """
        if overflow == 1 or overflow > SYNC_OVERFLOW:
            refuse(Abort.VALUE_RANGE)
        if overflow != self.value(0x1019) and self.value(0x1006) != 0:
            refuse(Abort.DEVICE_STATE)

    def _set_overflow(self, overflow: int) -> None:
        self.sync_overflow = overflow

    def _send(self, can_id: int, data: bytes) -> None:
        """Send a frame that isn't a PDO, unless the device is off the bus."""
        if self.is_on_bus:
            self._put_on_bus(can_id, data)

    def _time_ms(self, t_ns: int) -> int:
        return (t_ns - self.power_on_ns) // 1_000_000

    def _enter(self, state: NmtState, t_ns: int) -> None:
        """Change the NMT state; begin or end PDOs, and report leaving and entering Operational to the application.

        Leaving is reported before the change, entering after it. t_ns: the device's own time.
        """
        was_operational, self.is_operational = self.is_operational, state == NmtState.OPERATIONAL
        if was_operational and not self.is_operational:
            self._application.leave_operational(t_ns)
        self.state = state
        self.pdos.set_operational(self.is_operational, t_ns)
        if self.is_operational and not was_operational:
            self._application.enter_operational(t_ns)

    def _reset(self, is_node_reset: bool) -> None:
        """Restore the EDS's values of all objects, or of the communication profile only, and reset the application.

        is_node_reset: all objects; then tripped watchdogs and SYNC counts are forgotten, too. In both cases the PDOs
        restart their sequences.
        """
        self.restore(0xFFFF if is_node_reset else 0x1FFF)
        self.pdos.restart_sequences()
        if is_node_reset:
            self._errors.forget_trips()
            self.sync_counts.forget_counts()
        self._application.restart_node(is_node_reset)


_BILLION = 1_000_000_000


class NodeClock:
    """A device's own clock: that of the bench, until it is set to run fast or slow.

    Everything that a device times goes by it: heartbeats, event timers, inhibit times, watchdogs, the time in an EMCY.
    Its times and the bench's are integer ns. A clock that stops drifting keeps its lead.
    """

    def __init__(self) -> None:
        self.is_true = True
        """Whether it is the bench's time."""
        self._since_ns = self._own_since_ns = 0
        self._rate = _BILLION  # own ns in a second of the bench

    def set_drift(self, drift_ppm: float, t_ns: int) -> None:
        """Let the clock run fast by `drift_ppm` from the bench's time `t_ns` on, without a jump.

        Negative: slow, 0: no drift.
        """
        self._own_since_ns = self.own_ns(t_ns)
        self._since_ns = t_ns
        self._rate = _BILLION + round(drift_ppm * 1000)
        self.is_true = self._rate == _BILLION and self._own_since_ns == t_ns

    def own_ns(self, t_ns: int) -> int:
        """Return the device's time, ns, at the bench's time `t_ns`."""
        if self.is_true:
            return t_ns
        return self._own_since_ns + (t_ns - self._since_ns) * self._rate // _BILLION

    def bench_ns(self, own_ns: int) -> int:
        """Return the first bench time, ns, at which the device's time is at least `own_ns`; NEVER_NS for NEVER_NS."""
        if self.is_true or own_ns >= NEVER_NS:
            return own_ns
        return self._since_ns - (own_ns - self._own_since_ns) * _BILLION // -self._rate


class SyncListeners:
    """Reports each SYNC to the devices of a bench, with the number lost before."""

    def __init__(self, devices: Sequence[EmulatedDevice]) -> None:
        self._devices = devices
        self.everybody = (1,) * len(devices)
        """Every device, once each."""
        self._nobody = (0,) * len(devices)
        self._unheard = [0] * len(devices)
        self._takers: dict[int, tuple[int, ...]] = {}
        self.overflow = SYNC_OVERFLOW
        """The last SYNC counter before 1."""
        for device in devices:
            device.watch(0x1019, 0, lambda _: self._sort())
        self._sort()

    def forget_unheard(self) -> None:
        """Forget the SYNCs that devices have not heard: they won't be reported as lost."""
        self._unheard = [0] * len(self._devices)

    def takers(self, data: bytes) -> tuple[int, ...]:
        """Return 1 for each device that takes SYNCs of this length, by its 0x1019; else 0.

        A device whose EDS lacks 0x1019 takes both lengths, 0 and 1 byte. All 0 for more than one byte.
        """
        return self._takers.get(len(data), self._nobody)

    def report_sync(self, heard: Sequence[int], takers: Sequence[int], kind: SyncKind, lost: int, t_ns: int) -> None:
        """Report the kind of a SYNC to the devices that hear it, each with the number of SYNCs that it missed before.

        heard: how often each device hears it; the second time counts as repeated. A SYNC that a device doesn't hear is
        kept as missed for its next report. takers: 1 for each device that takes its length, else 0: to that one it is
        of wrong length. lost: SYNCs that the counter skipped, missed by all. t_ns: the bench's time.
        """
        for place, device in enumerate(self._devices):
            self._unheard[place] += lost
            if heard[place] == 0:
                self._unheard[place] += 1
                continue
            device.note_sync(kind if takers[place] else SyncKind.WRONG_LENGTH, self._unheard[place], t_ns)
            self._unheard[place] = 0
            for _ in range(heard[place] - 1):
                device.note_sync(SyncKind.REPEATED, 0, t_ns)

    def ignore(self, heard: Sequence[int], takers: Sequence[int], kind: SyncKind, t_ns: int) -> None:
        """Report the kind of a SYNC that no device answers, without lost ones before it.

        heard: how often each device hears it. takers: 1 for each device that takes its length, else 0.
        """
        for place, device in enumerate(self._devices):
            for _ in range(heard[place]):
                device.note_sync(kind if takers[place] else SyncKind.WRONG_LENGTH, 0, t_ns)

    def miss(self, count: int) -> None:
        """Add `count` lost SYNCs for every device; the next `report_sync` reports them."""
        self._unheard = [unheard + count for unheard in self._unheard]

    def _sort(self) -> None:
        """Update the devices that take SYNCs with and without counter, and `overflow`, by their 0x1019."""
        overflows = [device.sync_overflow for device in self._devices]
        self._takers = {
            0: tuple(int(not overflow) for overflow in overflows),
            1: tuple(int(overflow != 0) for overflow in overflows),
        }
        self.overflow = next((overflow for overflow in overflows if overflow), SYNC_OVERFLOW)
