"""The arm: two drives and two torque sensors joined into `ArmState`, and `ArmCommand` turned into frames.

The only place of sign, zero offset and torque ratio. Every value carries its age in cycles.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from adacd_hil.config import Settings
from adacd_hil.device.drive import Cia402State, Drive, option_codes, torque_limit_permille
from adacd_hil.device.emergency import name_error
from adacd_hil.device.heartbeat import PATIENCE_PERIODS
from adacd_hil.device.placement import Device, place_devices
from adacd_hil.device.torque_sensor import USABLE, SensorStatus, TorqueSensor
from adacd_hil.records import JOINTS, ArmCommand, ArmState, FaultReason, FrameChecks
from adacd_hil.wire.bus import Bus, Frame
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.e2e import E2eStatus

SYNC_OVERFLOW = 240
"""0x1019: the SYNC counter runs 1…240."""

_Take = Callable[[bytes, int], bool]
"""What takes a frame's data and its cycle, and says whether something cyclic came of it."""
_Command = tuple[list[float], bool, bool]
"""Commanded torque of each joint, Nm; whether the drives are to be enabled; whether they are to stop quickly."""
_COMPLETE = 0xF  # one bit per cyclic frame: feedback 1, 2, torque 1, 2


class SignalAge(NamedTuple):
    """How old the value of some signals of one device is, in cycles; `limit`: the oldest that is usable."""

    device: str
    signals: str
    age: int
    limit: int

    @property
    def is_over(self) -> bool:
        """Whether it is too old."""
        return self.age > self.limit


class Arm:
    """Both joints on one bus. Per cycle: `synchronise`, `accept` each frame, `state`, `write`."""

    def __init__(self, settings: Settings, codec: Codec, bus: Bus) -> None:
        """Place the devices.

        Raises ConfigError when a device profile can't be used, CodecError when the contract lacks a signal.
        """
        period_s = settings.bus.period_s
        devices = place_devices(settings)
        self.drives = tuple(_make_drive(settings, codec, device) for device in devices[:JOINTS])
        self.sensors = tuple(_make_sensor(codec, device, period_s) for device in devices[JOINTS:])
        self.devices: tuple[Drive | TorqueSensor, ...] = (*self.drives, *self.sensors)
        self._bus = bus
        self.sync_id = codec.message("Sync").can_id
        self._is_following = settings.bus.follows
        self._is_pipelined = settings.bus.is_pipelined
        self._pending: _Command | None = None
        self._sign = settings.arm.sign
        self._offset_Nm = settings.arm.torque_offset_Nm
        self._position_limit_deg = settings.arm.position_limit_deg
        self._velocity_limit_deg_s = settings.arm.velocity_limit_deg_s
        self._permille_per_Nm = tuple(
            sign * 1000.0 / rated for sign, rated in zip(settings.arm.sign, settings.arm.rated_torque_Nm, strict=True)
        )
        self._max_age = settings.bus.max_age_cycles
        self.status_age_limits = tuple(_status_age_limit(device, period_s) for device in devices[:JOINTS])
        """How old each drive's status may be, in cycles; infinite where nothing is expected."""
        self._handlers = self._build_handlers()
        self._cycle = -1
        self._t_ns = 0
        self._periods = 1
        self._received = 0
        self._seen = 0
        self._was_enabled = False
        self.has_all_frames = False
        """Whether all cyclic frames of this cycle are in, passed their checks or not."""

    def _build_handlers(self) -> dict[int, tuple[_Take, int]]:
        handlers: dict[int, tuple[_Take, int]] = {}
        for joint, (drive, sensor) in enumerate(zip(self.drives, self.sensors, strict=True)):
            handlers[drive.feedback_message.can_id] = (drive.accept_feedback, 1 << joint)
            handlers[sensor.torque_message.can_id] = (sensor.accept_torque, 4 << joint)
            if drive.status_message is not None:
                handlers[drive.status_message.can_id] = (drive.accept_status, 0)
            if sensor.status_message is not None:
                handlers[sensor.status_message.can_id] = (sensor.accept_status, 0)
        return handlers

    @property
    def cycle(self) -> int:
        """The present cycle; -1 before the first SYNC."""
        return self._cycle

    def synchronise(self, cycle: int, t_ns: int, periods: int) -> None:
        """Begin a cycle: every device samples on this SYNC, every drive takes its last command. Raises BusError.

        SYNC is sent here, unless another host sends it; pipelined commands leave behind it.
        """
        if self._cycle >= 0 and not self.has_all_frames:
            self._miss()
        self._cycle = cycle
        self._t_ns = t_ns
        self._periods = periods
        self._received = 0
        self._seen = 0
        self.has_all_frames = False
        frames: tuple[tuple[int, bytes], ...] = (
            () if self._is_following else ((self.sync_id, bytes((1 + cycle % SYNC_OVERFLOW,))),)
        )
        if self._pending is not None:
            tau_c, enable, quick_stop = self._pending
            is_stale = periods > self._max_age
            frames += self._encode([0.0] * JOINTS if is_stale else tau_c, enable, quick_stop)
            self._pending = None
        self._bus.send_all(frames)

    def _miss(self) -> None:
        """Let every device note that its frame of the cycle that ends now did not come."""
        for bit, device in enumerate(self.devices):
            if not self._seen & (1 << bit):
                device.miss()

    def accept(self, frame: Frame, is_late: bool = False) -> bool:
        """Take one frame; False when it is not one of the arm's. A frame that fails a check changes nothing.

        `is_late`: it belongs to the cycle before.
        """
        handler = self._handlers.get(frame.can_id)
        if handler is None or frame.is_error:
            return False
        take, bit = handler
        if is_late:
            take(frame.data, self._cycle - self._periods)
            return True
        self._seen |= bit
        self.has_all_frames = self._seen == _COMPLETE
        if take(frame.data, self._cycle):
            self._received |= bit
        return True

    def accept_past(self, frame: Frame, cycle: int) -> bool:
        """Take one frame of a cycle that is over; False when it is not one of the arm's."""
        handler = self._handlers.get(frame.can_id)
        if handler is not None:
            handler[0](frame.data, cycle)
        return handler is not None

    @property
    def is_complete(self) -> bool:
        """Whether all cyclic frames of this cycle are in and passed their checks."""
        return self._received == _COMPLETE

    @property
    def missing_frames(self) -> int:
        """Count the cyclic frames of this cycle that are not in or failed their checks."""
        return (_COMPLETE & ~self._received).bit_count()

    def missing_names(self) -> list[str]:
        """Name the devices whose cyclic frame of this cycle is not in or failed its checks."""
        names = [drive.name for drive in self.drives] + [sensor.name for sensor in self.sensors]
        return [name for bit, name in enumerate(names) if not self._received & (1 << bit)]

    def state(self) -> ArmState:
        """Join what has been received into the state of this cycle."""
        (drive1, drive2), (sensor1, sensor2) = self.drives, self.sensors
        sign1, sign2 = self._sign
        offset1, offset2 = self._offset_Nm
        cycle = self._cycle
        is_enabled = drive1.is_enabled and drive2.is_enabled
        return ArmState(
            cycle=cycle,
            t_ns=self._t_ns,
            periods=self._periods,
            q=np.array((sign1 * drive1.position_rad, sign2 * drive2.position_rad)),
            dq=np.array((sign1 * drive1.velocity_rad_s, sign2 * drive2.velocity_rad_s)),
            tau_J=np.array((sign1 * sensor1.torque_Nm - offset1, sign2 * sensor2.torque_Nm - offset2)),
            age_q=(cycle - drive1.sample_cycle, cycle - drive2.sample_cycle),
            age_tau_J=(cycle - sensor1.sample_cycle, cycle - sensor2.sample_cycle),
            is_enabled=is_enabled,
            is_complete=self.is_complete,
            fault=self._device_fault(is_enabled),
        )

    def _device_fault(self, is_enabled: bool) -> FaultReason:
        has_dropped_out = self._was_enabled and not is_enabled
        self._was_enabled |= is_enabled
        if has_dropped_out:
            return FaultReason.DRIVE
        sensor1, sensor2 = self.sensors
        if not (sensor1.status in USABLE and sensor2.status in USABLE):
            return FaultReason.SENSOR
        (drive1, drive2), (limit1, limit2) = self.drives, self.status_age_limits
        if is_enabled and (self._cycle - drive1.status_cycle > limit1 or self._cycle - drive2.status_cycle > limit2):
            return FaultReason.DATA_AGE
        return FaultReason.NONE

    def ages(self) -> list[SignalAge]:
        """Return the age of every signal that the arm is run by, against its limit."""
        cycle = self._cycle
        ages = []
        for drive, status_limit in zip(self.drives, self.status_age_limits, strict=True):
            ages.append(SignalAge(drive.name, "position, velocity", cycle - drive.sample_cycle, self._max_age))
            if drive.has_status_frame and not math.isinf(status_limit):
                ages.append(SignalAge(drive.name, "statusword", cycle - drive.status_cycle, int(status_limit)))
        for sensor in self.sensors:
            ages.append(SignalAge(sensor.name, "torque", cycle - sensor.sample_cycle, self._max_age))
        return ages

    def write(self, command: ArmCommand) -> None:
        """Send the commands of this cycle, to act at the next SYNC; pipelined, keep them until then. Raises BusError.

        What has been kept for longer than a value may be old carries no torque.
        """
        values = command.tau_c.tolist(), command.enable, command.quick_stop
        if self._is_pipelined:
            self._pending = values
        else:
            self._bus.send_all(self._encode(*values))

    def _encode(self, tau_c: list[float], enable: bool, quick_stop: bool) -> tuple[tuple[int, bytes], ...]:
        (drive1, drive2), (ratio1, ratio2), (tau1, tau2) = self.drives, self._permille_per_Nm, tau_c
        return (
            (drive1.command_id, drive1.command(round(tau1 * ratio1), enable, quick_stop)),
            (drive2.command_id, drive2.command(round(tau2 * ratio2), enable, quick_stop)),
        )

    def frame_checks(self) -> FrameChecks:
        """Return what the checks have said of all cyclic frames so far."""
        return FrameChecks(
            self._cycle,
            tuple(tuple(device.end_to_end.counts) for device in self.devices),
            tuple(device.implausible_frames for device in self.devices),
        )

    def describe_checks(self) -> list[str]:
        """Say how many cyclic frames of each device passed and failed their checks, one line each."""
        return [_describe_checks(device) for device in self.devices]

    def describe_faults(self) -> list[str]:
        """Say what is wrong with each device, one line each; empty when nothing is.

        A drive's fault with the name of its error, a sensor's status, and signals that are older than their limit.
        """
        lines = []
        for drive in self.drives:
            if drive.state in (Cia402State.FAULT, Cia402State.FAULT_REACTION_ACTIVE) or drive.error_code:
                name = f": {name_error(drive.error_code)}" if drive.error_code else ""
                lines.append(f"{drive.name}: {drive.state.name}, error code 0x{drive.error_code:04X}{name}")
            elif self._was_enabled and not drive.is_enabled:
                lines.append(
                    f"{drive.name}: {drive.state.name}, mode {drive.mode}, OPERATION_ENABLED in mode 10 expected"
                )
        for sensor in self.sensors:
            if sensor.status:
                lines.append(f"{sensor.name}: status 0x{int(sensor.status):02X}: {_describe_status(sensor.status)}")
        lines.extend(
            f"{age.device}: {age.signals} {age.age} cycles old, {age.limit} allowed"
            for age in self.ages()
            if age.is_over
        )
        return lines

    def describe_excess(self) -> list[str]:
        """Say which joint is beyond which of the arm's limits, one line each; empty when none is."""
        lines = []
        for joint, (drive, sign) in enumerate(zip(self.drives, self._sign, strict=True)):
            for quantity, value, bound, unit in (
                ("position", drive.position_rad, self._position_limit_deg[joint], "deg"),
                ("velocity", drive.velocity_rad_s, self._velocity_limit_deg_s[joint], "deg/s"),
            ):
                value_deg = math.degrees(sign * value)
                if abs(value_deg) > bound:
                    lines.append(f"joint {joint + 1}: {quantity} {value_deg:.2f} {unit}, ±{bound:g} {unit} allowed")
        return lines


def _make_drive(settings: Settings, codec: Codec, device: Device) -> Drive:
    quick_stop_option, _ = option_codes(settings, device.settings)
    return Drive(
        codec,
        device.joint + 1,
        settings.bus.period_s,
        quick_stop_option,
        torque_limit_permille(settings, device.joint),
        device.settings.plausibility.position_jump_rad,
    )


def _make_sensor(codec: Codec, device: Device, period_s: float) -> TorqueSensor:
    bounds = device.settings.plausibility
    return TorqueSensor(codec, device.joint + 1, period_s, bounds.torque_rate_Nm_s, bounds.torque_range_Nm)


def _status_age_limit(device: Device, period_s: float) -> float:
    """Return how many cycles old a drive's status may be: 2.5 of its periods; infinite where it has no period."""
    status = device.pdo("Status")
    if status is None or not status.event_timer_ms:
        return math.inf
    return math.ceil(PATIENCE_PERIODS * status.event_timer_ms * 1e-3 / period_s)


def _describe_checks(device: Drive | TorqueSensor) -> str:
    tally = device.end_to_end.tally()
    if device.is_protected:
        return f"{device.name}: " + ", ".join(f"{count} {status.name}" for status, count in tally)
    missing = dict(tally)[E2eStatus.NO_NEW_DATA]
    return (
        f"{device.name}: unprotected, {device.implausible_frames} implausible, {missing} {E2eStatus.NO_NEW_DATA.name}"
    )


def _describe_status(status: SensorStatus) -> str:
    words = (
        (SensorStatus.POSITIVE_OVERLOAD, "positive overload"),
        (SensorStatus.NEGATIVE_OVERLOAD, "negative overload"),
        (SensorStatus.NOT_VALID, "not valid"),
    )
    return ", ".join(text for bit, text in words if status & bit)
