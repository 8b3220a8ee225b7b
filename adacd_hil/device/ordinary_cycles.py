"""One arm's frames laid out for compiled code, which reads ordinary cycles of a recording at once (`arm_batch`).

It takes over from the live classes where nothing is unusual: all that it needs to know stands in them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_batch import (
    CHECKS,
    CONSTANTS,
    DEVICES,
    HEARTBEAT,
    MEMORY,
    MOST_WATCHED,
    STANDARD_IDS,
    STATUS,
    UNUSUAL,
    FrameColumns,
    read_cycles,
)
from adacd_hil.device.arm_watch import HeartbeatWatch
from adacd_hil.device.cycle_frames import lay_out_frames
from adacd_hil.device.drive import Drive
from adacd_hil.device.torque_sensor import STATUS_BITS, TorqueSensor
from adacd_hil.records import JOINTS, ArmBatch, ArmState, FaultReason
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.codec import MessageCodec
from adacd_hil.wire.codec_columns import SignalCodec, signal_rows
from adacd_hil.wire.contract_frames import HEARTBEAT_ID

_MOST_CYCLES = 8192
"""Cycles of one call."""
_ALWAYS_NS = 1 << 62


class NotOrdinaryError(ValueError):
    """An arm whose frames can't be read at once; one line."""


class OrdinaryStretch(NamedTuple):
    """What one call has read. `last`: where the frames of the last of its cycles begin.

    `news`: of each kind of status frame and heartbeat the last one, as its place and the cycle that it was taken for.
    """

    cycles: int
    last: int
    news: list[tuple[int, int]]


class _Watched(NamedTuple):
    """One byte that must stay as it is: of which message, in which slot, and from where its value comes."""

    message: int
    slot: int
    read: Callable[[], int]
    down: int
    up: int


class OrdinaryCycles:
    """Reads stretches of ordinary cycles of one arm."""

    def __init__(self, settings: Settings, arm: Arm, heartbeats: HeartbeatWatch) -> None:
        """Lay out what the compiled code reads. Raises NotOrdinaryError for an arm whose frames it can't read."""
        if settings.bus.follows:
            raise NotOrdinaryError("SYNC is received")
        self._arm, self._heartbeats = arm, heartbeats
        self._checks = np.zeros(2 * DEVICES, CHECKS)
        frames = [device.cyclic_frame for device in arm.devices]
        self._contract = (self._checks, *lay_out_frames(frames, is_brief=True))
        self._constants = np.zeros(1, CONSTANTS)
        self._memory = np.zeros(1, MEMORY)
        self._values = np.zeros((_MOST_CYCLES, DEVICES, 2))
        self._kinds = np.zeros(STANDARD_IDS, np.uint8)
        self._watched: list[_Watched] = []
        self._heartbeat_ids = [HEARTBEAT_ID + device.node_id for device in arm.devices]
        self._lay_out_arm(settings)
        for index, drive in enumerate(arm.drives):
            self._lay_out_drive(index, drive)
        for index, sensor in enumerate(arm.sensors, JOINTS):
            self._lay_out_sensor(index, sensor)
        for can_id in arm.unusual_ids:
            self._name(can_id, UNUSUAL)

    def _lay_out_arm(self, settings: Settings) -> None:
        constants = self._constants[0]
        constants["sync_id"] = self._arm.sync_id
        constants["period_s"] = settings.bus.period_s
        constants["sign"] = settings.arm.sign
        constants["torque_offset_Nm"] = settings.arm.torque_offset_Nm
        constants["status_age_limit"] = self._arm.status_age_limits
        constants["patience_ns"] = self._heartbeats.patience_ns

    def _lay_out_drive(self, index: int, drive: Drive) -> None:
        message = self._lay_out_message(index, drive.feedback_message)
        message["range_limit"] = np.inf
        message["renews_status"] = int(not drive.has_status_frame)
        status = self._lay_out_status(index, drive.status_message)
        for number, found in ((index, drive.feedback_message), (status, drive.status_message)):
            if found is None or (number == index and drive.has_status_frame):
                continue
            for signal in found.values:
                if signal.name == "statusword":
                    self._watch_number(number, found, signal, lambda: drive.statusword)
                elif signal.name == "mode_display":
                    self._watch_number(number, found, signal, lambda: drive.mode)

    def _lay_out_sensor(self, index: int, sensor: TorqueSensor) -> None:
        found = sensor.torque_message
        message = self._lay_out_message(index, found)
        message["range_limit"] = np.inf
        names = [signal.name for signal in found.values]
        if "status" in names:
            self._watch_status(index, found, sensor)
        elif sensor.status_in_header is not None:
            byte, shift = sensor.status_in_header
            self._watch(index, byte, STATUS_BITS << shift, lambda: sensor.status, up=shift)
        elif sensor.torque_range_Nm:
            message["range_limit"] = sensor.torque_range_Nm
        status = self._lay_out_status(index, sensor.status_message)
        if sensor.status_message is not None:
            self._watch_status(status, sensor.status_message, sensor)

    def _lay_out_message(self, index: int, found: MessageCodec) -> Any:
        message = self._checks[index]
        message["length"] = found.length
        self._name(found.can_id, 1 + index)
        return message

    def _lay_out_status(self, index: int, found: MessageCodec | None) -> int:
        """Lay out a status frame; return the number of its message."""
        if found is not None:
            if found.is_protected:
                raise NotOrdinaryError(f"{found.name}: status frames count")
            self._lay_out_message(STATUS + index, found)
        can_id = self._heartbeat_ids[index]
        if can_id in self._heartbeats.can_ids:
            self._name(can_id, 1 + HEARTBEAT + index)
        return STATUS + index

    def _name(self, can_id: int, kind: int) -> None:
        if can_id >= STANDARD_IDS or self._kinds[can_id]:
            raise NotOrdinaryError(f"identifier 0x{can_id:X} is extended or stands for two frames")
        self._kinds[can_id] = kind

    def _watch_number(self, number: int, found: MessageCodec, signal: SignalCodec, read: Callable[[], int]) -> None:
        """Watch all bytes of a signal that is a whole number."""
        if signal.scale != 1.0 or signal.offset != 0.0:
            raise NotOrdinaryError(f"{found.name}.{signal.name} is scaled")
        begin, size = self._place_of(found, signal)
        for byte in range(size):
            self._watch(number, begin + byte, 0xFF, read, down=8 * byte)

    @staticmethod
    def _place_of(found: MessageCodec, signal: SignalCodec) -> tuple[int, int]:
        """Return where a signal that has its bytes for itself begins, and how many it has."""
        if signal.mask:
            raise NotOrdinaryError(f"{found.name}.{signal.name} is part of a byte")
        row = signal_rows(found.signals)[found.signals.index(signal)]
        return int(row["byte"]), int(row["size"])

    def _watch_status(self, number: int, found: MessageCodec, sensor: TorqueSensor) -> None:
        """Watch the bits of a sensor's status."""
        signal = next(signal for signal in found.values if signal.name == "status")
        if signal.scale != 1.0 or signal.offset != 0.0:
            raise NotOrdinaryError(f"{found.name}.status is scaled")
        self._watch(number, self._place_of(found, signal)[0], STATUS_BITS, lambda: sensor.status)

    def _watch(self, number: int, byte: int, mask: int, read: Callable[[], int], down: int = 0, up: int = 0) -> None:
        message = self._checks[number]
        slot = int(message["watched_count"])
        if slot == MOST_WATCHED:
            raise NotOrdinaryError("too many bytes to watch")
        message["watched_count"] = slot + 1
        message["byte"][slot], message["mask"][slot] = byte, mask
        self._watched.append(_Watched(number, slot, read, down, up))

    def read(self, batch: ArmBatch, place: int, frames: FrameColumns, at: int, state: ArmState) -> OrdinaryStretch:
        """Fill `batch` from `place` on with ordinary cycles; their frames begin at `at`.

        `state`: of the cycle before, which the live classes took.
        """
        if not self._begin(state):
            return _NOTHING
        memory, constants, values = self._memory, self._constants[0], self._values
        most = slice(place, place + _MOST_CYCLES)
        ticks = batch.cycle[most], batch.t_ns[most], batch.periods[most]
        count, last = read_cycles(
            frames, at, ticks, self._constants, self._contract, self._kinds, memory, state.is_enabled, self._values
        )
        read = slice(place, place + count)
        batch.q[read] = constants["sign"] * values[:count, :JOINTS, 0]
        batch.dq[read] = constants["sign"] * values[:count, :JOINTS, 1]
        batch.tau_J[read] = constants["sign"] * values[:count, JOINTS:, 0] - constants["torque_offset_Nm"]
        batch.age_q[read] = batch.age_tau_J[read] = 0
        batch.is_enabled[read] = state.is_enabled
        batch.is_complete[read] = True
        batch.fault[read] = FaultReason.NONE
        batch.is_late[read] = False
        batch.steps[read] = 1
        batch.sampled_ns[read] = batch.t_ns[read]
        places, cycles = memory[0]["frame"].tolist(), memory[0]["frame_cycle"].tolist()
        return OrdinaryStretch(count, last, [(at, cycle) for at, cycle in zip(places, cycles, strict=True) if at >= 0])

    def _begin(self, state: ArmState) -> bool:
        """Take over from the live classes, where nothing is unusual."""
        arm = self._arm
        if state.fault is not FaultReason.NONE or state.is_late or not (state.is_complete and arm.has_all_frames):
            return False
        heard_ns = self._heartbeats.heard_ns()
        if heard_ns is None or not (arm.is_settled and all(device.is_steady for device in arm.devices)):
            return False
        memory = self._memory[0]
        memory["cycle"] = state.cycle
        memory["counter"] = [device.end_to_end.counter or 0 for device in arm.devices]
        memory["last"] = [
            *(drive.position_rad for drive in arm.drives),
            *(sensor.torque_Nm for sensor in arm.sensors),
        ]
        memory["status_cycle"] = [drive.status_cycle for drive in arm.drives]
        memory["heard_ns"] = [heard_ns.get(can_id, _ALWAYS_NS) for can_id in self._heartbeat_ids]
        memory["frame"] = -1
        for number, slot, read, down, up in self._watched:
            self._checks[number]["value"][slot] = (int(read()) >> down & 0xFF) << up
        return True


_NOTHING = OrdinaryStretch(0, 0, [])
