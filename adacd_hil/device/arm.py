"""The arm: two drives and two torque sensors joined into `ArmState`, and `ArmCommand` turned into frames.

Sign, zeros and torque ratio are applied here. Every value carries its age in cycles.
"""

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from adacd_hil.device.answer_clock import KEPT, AnswerClock, newest_sample
from adacd_hil.device.drive import Drive
from adacd_hil.device.profile import PlacedDevice
from adacd_hil.device.strangers import Strangers
from adacd_hil.device.torque_sensor import TorqueSensor
from adacd_hil.records import JOINTS, ArmCommand, ArmState, FaultReason, FrameChecks
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import Bus, Frame
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.contract_frames import EMERGENCY_ID, SYNC_OVERFLOW
from adacd_hil.wire.e2e import E2eStatus

FEEDBACK_SHARE = 0.7
"""Part of the period in which feedback is awaited in real time. On a classic bus at 1 Mbit/s it is in after 565 µs at
the worst, and two commands need 230 µs before the next SYNC."""

_Take = Callable[[bytes, int], bool]
"""Takes a status frame's data and its cycle."""
_Command = tuple[list[float], bool, bool]
"""Commanded torque of each joint, Nm; whether the drives are to be enabled; whether they are to stop quickly."""
_COMPLETE = 0xF  # one bit per cyclic frame: feedback 1, 2, torque 1, 2
_EMERGENCY_BYTES = 8
_REMEMBERED_CYCLES = 8


class Arm:
    """Both joints on one bus. Per cycle: `synchronise`, `accept` each frame, `state`, `send_command`."""

    def __init__(self, settings: Settings, codec: Codec, devices: Sequence[PlacedDevice], bus: Bus) -> None:
        """`devices`: Drive1, Drive2, Sensor1, Sensor2. Raises CodecError when the contract lacks a frame or signal."""
        self.drives = tuple(Drive(settings, codec, device) for device in devices[:JOINTS])
        self.sensors = tuple(TorqueSensor(settings, codec, device) for device in devices[JOINTS:])
        self.devices: tuple[Drive | TorqueSensor, ...] = (*self.drives, *self.sensors)
        self._judged: tuple[Drive | TorqueSensor, ...] = (*self.sensors, *self.drives)  # in the order of their faults
        self._bus = bus
        self.sync_id = codec.message("Sync").can_id
        self._is_following = settings.bus.follows
        self._is_pipelined = settings.bus.is_pipelined
        self._pending: _Command | None = None
        self.sign = settings.arm.sign
        self.zero_rad: tuple[float, ...] = tuple(settings.arm.zero_rad.tolist())
        self._signs = np.array(self.sign * 3)  # of positions, velocities, torques
        self._zeros = np.array((*self.zero_rad, *(0.0,) * JOINTS, *settings.arm.torque_offset_Nm))
        self.limits = settings.arm
        self._permille_per_Nm = tuple(
            sign * 1000.0 / rated for sign, rated in zip(settings.arm.sign, settings.arm.rated_torque_Nm, strict=True)
        )
        self.max_age_cycles = settings.bus.max_age_cycles
        self.gear_ratios = tuple(device.settings.scale.gear_ratio for device in devices[:JOINTS])
        self._places = {device.can_id: place for place, device in enumerate(self.devices)}  # of cyclic frames
        self._status_takers: dict[int, _Take] = {
            device.status_message.can_id: device.accept_status
            for device in self.devices
            if device.status_message is not None
        }
        self._cycle = -1
        self._t_ns = 0
        self._periods = 1
        self.received = 0
        """Bits of the devices whose cyclic frame of this cycle is in and passed its checks."""
        self.received_before = deque([_COMPLETE] * _REMEMBERED_CYCLES, maxlen=_REMEMBERED_CYCLES)
        """`received` of the last cycles, the present one excepted."""
        self._seen = 0
        self.was_enabled = False
        self._ordinal = -1  # of the last SYNC
        self._sync_cycles, self._sync_ns = [-1] * KEPT, [0] * KEPT  # of the last SYNCs, by ordinal
        self._clocks = tuple(AnswerClock() for _ in self.devices)
        self._sampled_ordinal = self._sampled_cycle = -1  # of the last complete sample
        self._last_data = [b""] * len(self.devices)
        self.repeats = [0] * len(self.devices)
        """How often each device's frame came again, the same or with the same counter."""
        self.strangers = Strangers(settings, codec, devices)
        self._emergency_ids = {EMERGENCY_ID + device.node_id: device for device in self.devices}
        self._tolerated_codes = frozenset(settings.safety.tolerated_emergencies)
        self._emergencies: dict[str, int] = {}
        self.has_all_frames = False
        """Whether all cyclic frames of this cycle are in, passed their checks or not."""

    @property
    def cycle(self) -> int:
        """The present cycle; -1 before the first SYNC."""
        return self._cycle

    def synchronise(self, cycle: int, t_ns: int, periods: int) -> None:
        """Begin a cycle: send SYNC, unless another host sends it, then the pipelined commands of `send_command`.

        First, count a miss of each device whose frame the ending cycle lacks, and extend `received_before`. Pipelined
        commands are sent without torque if `periods` exceeds `bus.max_age_cycles`. `cycle`, `t_ns`: number and host
        time of this SYNC. `periods`: since the previous SYNC. Raises BusError if the bus refuses a frame.
        """
        if self._cycle >= 0:
            if not self.has_all_frames:
                self._miss()
            self.received_before.append(self.received)
        self._cycle = cycle
        self._t_ns = t_ns
        self._ordinal += 1
        place = self._ordinal % KEPT
        self._sync_cycles[place], self._sync_ns[place] = cycle, t_ns
        self._periods = periods
        self.received = 0
        self._seen = 0
        self.has_all_frames = False
        frames: tuple[tuple[int, bytes], ...] = (
            () if self._is_following else ((self.sync_id, bytes((1 + cycle % SYNC_OVERFLOW,))),)
        )
        if self._pending is not None:
            tau_c, enable, quick_stop = self._pending
            is_stale = periods > self.max_age_cycles
            frames += self._encode([0.0] * JOINTS if is_stale else tau_c, enable, quick_stop)
            self._pending = None
        self._bus.send_all(frames)

    def _miss(self) -> None:
        """Count a miss of each device whose frame did not come in the cycle that ends now.

        A frame of the right length has come, even if it failed its check.
        """
        for bit, device in enumerate(self.devices):
            if not self._seen & (1 << bit):
                device.miss()

    def accept(self, frame: Frame, is_late: bool = False) -> bool:
        """Take a frame; return True for a cyclic or status frame of the arm, and for one that only this host may send.

        A cyclic or status frame that fails a check is True, too, but its values are not used. A frame that only this
        host may send is judged by `strangers`, which reports other senders. All others are False: EMCY, whose code is
        kept, heartbeats, SDO answers, error frames. `is_late`: the frame arrived before SYNC, so it answers an earlier
        one.
        """
        if frame.is_error:
            return False
        place = self._places.get(frame.can_id)
        if place is not None:
            self._answer(frame, place, self._ordinal - 1 if is_late and self._ordinal else self._ordinal)
            return True
        take_status = self._status_takers.get(frame.can_id)
        if take_status is not None:
            take_status(frame.data, self._cycle - self._periods if is_late else self._cycle)
            return True
        self._hear_emergency(frame)
        return self.strangers.judge_host_frame(frame, self._cycle)

    def _answer(self, frame: Frame, place: int, newest: int) -> None:
        """Take a cyclic frame of device `place` as the answer to a SYNC, or refuse it if it answers none.

        Its values are used only if its check passes. After a restart of the device's counter, each SYNC up to `newest`
        counts as answered. `newest`: ordinal of the last SYNC before the frame; -1: none was sent, and the frame is
        ignored.
        """
        if newest < 0:
            return  # no SYNC was sent yet
        device, clock, data = self.devices[place], self._clocks[place], frame.data
        offset_ns = frame.t_ns - self._sync_ns[newest % KEPT]
        step = device.end_to_end.step_of(data)
        ordinal: int | None = newest
        if clock.answered != newest - 1 or step == 0:  # nearly every frame answers the SYNC after the last answered one
            ordinal = None if step == 0 else self._find(place, newest, offset_ns, step, data)
        if ordinal is None:
            self._refuse(frame, place, step, is_second=clock.answered is not None and clock.answered >= newest)
            return
        is_present = ordinal == self._ordinal
        if is_present and len(data) == device.cyclic_length:
            self._seen |= 1 << place
            self.has_all_frames = self._seen == _COMPLETE
        is_revised = clock.answered == ordinal  # the frame taken for this answer was the previous SYNC's
        if is_revised:
            clock.keep(ordinal - 1, device.values)
        if device.accept_cyclic(data, self._sync_cycles[ordinal % KEPT]):
            clock.set_answered(ordinal, newest, offset_ns, device.is_protected)
            clock.keep(ordinal, device.values)
            self._last_data[place] = data
            if is_present:
                self.received |= 1 << place
        elif device.end_to_end.status is E2eStatus.WRONG_SEQUENCE:
            clock.begin_anew(newest)  # the device restarted its counter
        elif device.end_to_end.status is E2eStatus.SYNC or (not device.is_protected and is_present):
            clock.set_answered(ordinal, newest, offset_ns, device.is_protected)

    def _find(self, place: int, newest: int, offset_ns: int, step: int | None, data: bytes) -> int | None:
        """Return the ordinal of the SYNC that a frame answers; None if all SYNCs up to `newest` are answered already.

        `place`: index of its device. `newest`: ordinal of the last SYNC before the frame, which came `offset_ns` after
        it. `step`: advance of its alive counter, None without one.
        """
        if place >= JOINTS:
            return self._clocks[place].find(newest, offset_ns, step)
        error = partial(self.drives[place].position_error, data)
        return self._clocks[place].find(newest, offset_ns, step, error, self._soonest_ns(place))

    def _soonest_ns(self, place: int) -> int:
        """Return the least usual time from SYNC to an answer, ns, of this device and all whose frame is missing yet.

        0 while one of these times is unknown.
        """
        places = (bit for bit in range(len(self._clocks)) if bit == place or not self._seen >> bit & 1)
        return min(self._clocks[bit].earliest_ns for bit in places)

    def _refuse(self, frame: Frame, place: int, step: int | None, is_second: bool) -> None:
        """Count a frame that answers no SYNC as a repeat or a failed check, or report it; its values are not used.

        It is a repeat if it equals the last frame or has its counter (`step` 0). It is reported as another sender's if
        the newest SYNC is answered already (`is_second`), the frame differs, passes its checks, and is no straggler.
        """
        device, data = self.devices[place], frame.data
        is_right = len(data) == device.cyclic_length and device.end_to_end.is_signed(data)
        is_same = data == self._last_data[place]
        self.repeats[place] += step == 0 or (is_right and is_same)
        if step == 0 or not is_right:
            device.accept_cyclic(data, self._cycle)  # the check counts it
        if is_second and is_right and not is_same:
            behind = 0 if not step else device.end_to_end.counter_range - step
            if not self._clocks[place].take_straggler(behind):
                self.strangers.report_second_frame(frame, device.name, self._cycle)

    def _hear_emergency(self, frame: Frame) -> None:
        """Keep the error code of a device's EMCY, unless `safety.tolerated_emergencies` has it.

        An EMCY with code 0x00xx, error reset, deletes the device's code. Ignore other frames, and an EMCY of another
        length than 8 bytes. Source: CiA 301, clause 7.2.7.
        """
        device = self._emergency_ids.get(frame.can_id)
        if device is None or len(frame.data) != _EMERGENCY_BYTES:
            return
        code = int.from_bytes(frame.data[:2], "little")
        if code >> 8 == 0:
            self._emergencies.pop(device.name, None)
        elif code not in self._tolerated_codes:
            self._emergencies[device.name] = code

    @property
    def missing_frames(self) -> int:
        """Number of cyclic frames of this cycle that are not in or failed their checks."""
        return (_COMPLETE & ~self.received).bit_count()

    def missing_names(self) -> list[str]:
        """Return the names of the devices whose cyclic frame of this cycle is not in or failed its checks."""
        return [device.name for bit, device in enumerate(self.devices) if not self.received & (1 << bit)]

    def state(self) -> ArmState:
        """Return the state of this cycle. Call it once per cycle, since it stores that the sample is used.

        Its values are those of the newest SYNC that all devices have answered, if no state had them yet. Else they are
        the newest of each device, and `is_complete` is False.
        """
        cycle = self._cycle
        if self.received == _COMPLETE:
            return self._state_of(self._ordinal, [device.values for device in self.devices], (cycle,) * 4)
        sample = newest_sample(self._clocks, self._ordinal, self._sampled_ordinal)
        if sample is not None:
            ordinal, values = sample
            return self._state_of(ordinal, values, (self._sync_cycles[ordinal % KEPT],) * len(self.devices))
        return self._state_of(
            None, [device.values for device in self.devices], [device.sample_cycle for device in self.devices]
        )

    def _state_of(self, ordinal: int | None, values: Sequence[tuple[float, ...]], sampled: Sequence[int]) -> ArmState:
        """Return the state from each device's values and the cycle of their sample, both in the order of `devices`.

        The values are the devices' own, in rad, rad/s and Nm. Sign, zero and torque offset are applied. `ordinal`: of
        the SYNC that all devices have answered, whose sample now counts as used; None: the sample is incomplete.
        """
        cycle = self._cycle
        ages = tuple(cycle - own for own in sampled)
        steps, sampled_ns = 0, self._t_ns
        if ordinal is not None:
            steps = sampled[0] - self._sampled_cycle if self._sampled_ordinal >= 0 else 1
            sampled_ns = self._sync_ns[ordinal % KEPT]
            self._sampled_ordinal, self._sampled_cycle = ordinal, sampled[0]
        is_enabled = all(drive.is_enabled for drive in self.drives)
        (q, dq), (tau_J,) = zip(*values[:JOINTS], strict=True), zip(*values[JOINTS:], strict=True)
        measured = self._signs * np.array(q + dq + tau_J) - self._zeros
        return ArmState(
            cycle=cycle,
            t_ns=self._t_ns,
            periods=self._periods,
            q=measured[:JOINTS],
            dq=measured[JOINTS : 2 * JOINTS],
            tau_J=measured[2 * JOINTS :],
            age_q=ages[:JOINTS],
            age_tau_J=ages[JOINTS:],
            is_enabled=is_enabled,
            is_complete=ordinal is not None,
            fault=self._device_fault(is_enabled),
            steps=steps,
            sampled_ns=sampled_ns,
        )

    def _device_fault(self, is_enabled: bool) -> FaultReason:
        """Return the arm's first fault, NONE without one, and store whether the drives have been enabled.

        is_enabled: both drives are enabled now. In order: DRIVE if the drives are no longer enabled; a sensor's or
        drive's own fault; DRIVE or SENSOR for a kept EMCY; FOREIGN_FRAMES for another sender.
        """
        has_dropped_out = self.was_enabled and not is_enabled
        self.was_enabled |= is_enabled
        if has_dropped_out:
            return FaultReason.DRIVE
        for device in self._judged:
            if (fault := device.fault(self._cycle, is_enabled)) is not FaultReason.NONE:
                return fault
        if self._emergencies:
            is_drive = any(drive.name in self._emergencies for drive in self.drives)
            return FaultReason.DRIVE if is_drive else FaultReason.SENSOR
        return FaultReason.FOREIGN_FRAMES if self.strangers.have_acted(self._cycle) else FaultReason.NONE

    def send_command(self, command: ArmCommand) -> None:
        """Send the commands of this cycle, to act at the next SYNC; if pipelined, keep them until then.

        Commands that were kept for longer than `bus.max_age_cycles` are sent without torque. Raises BusError if the bus
        refuses a frame.
        """
        values = command.tau_c.tolist(), command.enable, command.quick_stop
        if self._is_pipelined:
            self._pending = values
        else:
            self._bus.send_all(self._encode(*values))

    def _encode(self, tau_c: list[float], enable: bool, quick_stop: bool) -> tuple[tuple[int, bytes], ...]:
        """Return (identifier, data) of each drive's command; each call advances the alive counters.

        tau_c: of each joint, Nm. enable: go one state nearer to Operation enabled, else disable voltage. quick_stop:
        has precedence over enable.
        """
        return tuple(
            (drive.command_id, drive.command(round(tau * ratio), enable, quick_stop))
            for drive, ratio, tau in zip(self.drives, self._permille_per_Nm, tau_c, strict=True)
        )

    def frame_checks(self) -> FrameChecks:
        """Return each device's counts so far: frames by end-to-end status, missing and implausible frames."""
        return FrameChecks(
            self._cycle,
            tuple(tuple(device.end_to_end.counts) for device in self.devices),
            tuple(device.implausible_frames for device in self.devices),
        )
