"""Ordinary cycles of a recording, read at once by columns: every frame of the arm once, right, and nothing new.

A cycle is ordinary when no period was skipped, its SYNC was sent, both feedbacks and both torques came once after it
and pass their checks, and nothing else of what came changes more than an age: no drive's or sensor's status, no NMT
state. Then the ArmState is fresh, complete and without fault. The first cycle that is otherwise ends the stretch: the
live classes go on from there. They also hand over to it, where nothing is unusual, all that it needs to know.

Kinds of frames, by identifier: 1 to 4 feedback 1, 2 and torque 1, 2; 5 to 8 the status of the same devices; 9 to 12
heartbeats; 13 what is never ordinary, as an EMCY or what only the host sends; 0 what the arm is not concerned with.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_watch import OPERATIONAL, HeartbeatWatch
from adacd_hil.device.cycle_frames import STATUS_BITS, TorqueSensor, lay_out_frames
from adacd_hil.device.drive import Drive
from adacd_hil.records import JOINTS, ArmBatch, ArmState, FaultReason
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.codec import MessageCodec
from adacd_hil.wire.codec_columns import SignalCodec, signal_rows
from adacd_hil.wire.contract_frames import HEARTBEAT_ID
from adacd_hil.wire.cyclic_codec import read_frames

_DEVICES = 2 * JOINTS
_STATUS = _DEVICES
"""Kinds up to it are cyclic frames; beyond it status frames."""
_HEARTBEAT = 2 * _DEVICES
_UNUSUAL = 3 * _DEVICES + 1
"""Kind of the frames of which one ends a stretch."""
_STANDARD_IDS = 0x800
_FEWEST_CYCLES, _MOST_CYCLES = 32, 8192
"""Cycles that are looked at in one call: the more, the longer the last stretch was."""
_ALWAYS_NS = 1 << 62

_Numbers = NDArray[np.int64]


class FrameColumns(NamedTuple):
    """Recorded frames (f,) as columns, each in one piece; `data` (f, 8) or (f, 64)."""

    t_ns: NDArray[np.int64]
    cycle_t_ns: NDArray[np.int64]
    can_id: NDArray[np.uint32]
    is_tx: NDArray[np.bool_]
    is_error: NDArray[np.bool_]
    length: NDArray[np.uint8]
    data: NDArray[np.uint8]

    def cut(self, begin: int, end: int) -> "FrameColumns":
        """Return some of the frames."""
        columns: tuple[NDArray[Any], ...] = self
        return FrameColumns(*(column[begin:end] for column in columns))


def columns_of(frames: NDArray[Any]) -> FrameColumns:
    """Lay recorded frames out as columns."""
    return FrameColumns(*(np.ascontiguousarray(frames[name]) for name in FrameColumns._fields))


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
    """One byte that must stay as it is, and from where its value comes."""

    byte: int
    mask: int
    read: Callable[[], int]
    down: int
    up: int


class _Window(NamedTuple):
    """Some cycles (n,) that may be ordinary, and their frames (f,), both counted from 0.

    owner (f,): the cycle of each frame. kind (f,): of received frames, else 0. is_wrong (n,): cycles that are not
    ordinary.
    """

    frames: FrameColumns
    cycle: _Numbers
    t_ns: _Numbers
    owner: _Numbers
    kind: NDArray[np.uint8]
    is_wrong: NDArray[np.bool_]

    def find(self, kind: int) -> _Numbers:
        """Return which frames are of a kind."""
        return np.flatnonzero(self.kind == kind)

    def refuse(self, frames: NDArray[Any]) -> None:
        """Take the cycles of some frames for not ordinary."""
        self.is_wrong[self.owner[frames]] = True

    def require_one(self, frames: _Numbers) -> None:
        """Take the cycles for not ordinary to which not one of these frames belongs."""
        self.is_wrong[np.bincount(self.owner[frames], minlength=len(self.cycle)) != 1] = True

    def taken_for(self, frames: _Numbers) -> _Numbers:
        """Return the cycles that status frames are taken for: the one before, for what came before SYNC."""
        owner = self.owner[frames]
        return self.cycle[owner] - (self.frames.t_ns[frames] < self.t_ns[owner])

    def latest(self, frames: _Numbers, values: _Numbers, before: int) -> _Numbers:
        """Return for each cycle (n,) the value of the last of these frames up to it; `before`: where there is none."""
        last = np.searchsorted(self.owner[frames], np.arange(len(self.cycle)), "right")
        return np.concatenate(([before], values))[last]


class OrdinaryCycles:
    """Reads stretches of ordinary cycles of one arm."""

    def __init__(self, settings: Settings, arm: Arm, heartbeats: HeartbeatWatch) -> None:
        """Lay out what is compared. Raises NotOrdinaryError for an arm whose frames can't be read by columns."""
        if settings.bus.follows:
            raise NotOrdinaryError("SYNC is received")
        self._arm, self._heartbeats = arm, heartbeats
        self._period_s = settings.bus.period_s
        self._zero_rad = settings.arm.zero_rad
        self._sign, self._torque_offset_Nm = np.array(settings.arm.sign), np.array(settings.arm.torque_offset_Nm)
        self._messages, self._rows = lay_out_frames([device.cyclic_frame for device in arm.devices], is_brief=True)
        self._lengths = [0] * (2 * _DEVICES)
        self._range_Nm = [np.inf] * _DEVICES
        self._values = np.zeros((_DEVICES, _MOST_CYCLES, 2))
        self._most = _FEWEST_CYCLES
        self._kinds = np.zeros(_STANDARD_IDS, np.uint8)
        self._watched: list[list[_Watched]] = [[] for _ in range(2 * _DEVICES)]
        self._heartbeat_ids = [HEARTBEAT_ID + device.node_id for device in arm.devices]
        for index, drive in enumerate(arm.drives):
            self._lay_out_drive(index, drive)
        for index, sensor in enumerate(arm.sensors, JOINTS):
            self._lay_out_sensor(index, sensor)
        for can_id in arm.unusual_ids:
            self._name(can_id, _UNUSUAL)

    def _lay_out_drive(self, index: int, drive: Drive) -> None:
        self._lay_out_message(index, drive.feedback_message)
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
        self._lay_out_message(index, found)
        names = [signal.name for signal in found.values]
        if "status" in names:
            self._watch_status(index, found, sensor)
        elif sensor.status_in_header is not None:
            byte, shift = sensor.status_in_header
            self._watch(index, byte, STATUS_BITS << shift, lambda: sensor.status, up=shift)
        elif sensor.torque_range_Nm:
            self._range_Nm[index] = sensor.torque_range_Nm
        status = self._lay_out_status(index, sensor.status_message)
        if sensor.status_message is not None:
            self._watch_status(status, sensor.status_message, sensor)

    def _lay_out_message(self, index: int, found: MessageCodec) -> None:
        self._lengths[index] = found.length
        self._name(found.can_id, 1 + index)

    def _lay_out_status(self, index: int, found: MessageCodec | None) -> int:
        """Lay out a status frame; return the number of its message."""
        if found is not None:
            if found.is_protected:
                raise NotOrdinaryError(f"{found.name}: status frames count")
            self._lay_out_message(_STATUS + index, found)
        can_id = self._heartbeat_ids[index]
        if can_id in self._heartbeats.can_ids:
            self._name(can_id, 1 + _HEARTBEAT + index)
        return _STATUS + index

    def _name(self, can_id: int, kind: int) -> None:
        if can_id >= _STANDARD_IDS or self._kinds[can_id]:
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
        signal = found.values[found.place("status")]
        if signal.scale != 1.0 or signal.offset != 0.0:
            raise NotOrdinaryError(f"{found.name}.status is scaled")
        self._watch(number, self._place_of(found, signal)[0], STATUS_BITS, lambda: sensor.status)

    def _watch(self, number: int, byte: int, mask: int, read: Callable[[], int], down: int = 0, up: int = 0) -> None:
        self._watched[number].append(_Watched(byte, mask, read, down, up))

    def read(self, batch: ArmBatch, place: int, columns: FrameColumns, at: int, state: ArmState) -> OrdinaryStretch:
        """Fill `batch` from `place` on with ordinary cycles; their frames begin at `at`.

        `state`: of the cycle before, which the live classes took.
        """
        heard_ns = self._heard_ns(state)
        if heard_ns is None:
            return _NOTHING
        window = self._open(batch, place, columns, at, state.cycle)
        self._check_order(window)
        self._check_slow_frames(window, heard_ns, state.is_enabled)
        count = _first(window.is_wrong)
        for device in range(_DEVICES):
            count = self._read_device(window, device, count)
        self._most = min(max(2 * count, _FEWEST_CYCLES), _MOST_CYCLES)
        if not count:
            return _NOTHING
        self._fill(batch, slice(place, place + count), state.is_enabled)
        last, end = np.searchsorted(window.owner, (count - 1, count)).tolist()
        news: list[tuple[int, int]] = []
        for kind in range(_STATUS + 1, _UNUSUAL):
            newest = np.flatnonzero(window.kind[:end] == kind)[-1:]
            news += zip((at + newest).tolist(), window.taken_for(newest).tolist(), strict=True)
        return OrdinaryStretch(count, at + last, news)

    def _heard_ns(self, state: ArmState) -> dict[int, int] | None:
        """Say when the heartbeats were last heard; None where the live classes know of anything unusual."""
        arm = self._arm
        if state.fault is not FaultReason.NONE or state.is_late or not (state.is_complete and arm.has_all_frames):
            return None
        if not (arm.is_settled and all(device.is_steady for device in arm.devices)):
            return None
        return self._heartbeats.heard_ns()

    def _open(self, batch: ArmBatch, place: int, columns: FrameColumns, at: int, cycle: int) -> _Window:
        """Take the cycles that follow each other without a gap, and all frames up to the last one's."""
        chosen = slice(place, place + self._most)
        cycles, t_ns, periods = batch.cycle[chosen], batch.t_ns[chosen], batch.periods[chosen]
        count = _first((periods != 1) | (cycles != cycle + 1 + np.arange(len(cycles))))
        cycles, t_ns = cycles[:count], t_ns[:count]
        end = at + int(np.searchsorted(columns.cycle_t_ns[at:], t_ns[-1], "right")) if count else at
        frames = columns.cut(at, end)
        owner = np.searchsorted(t_ns, frames.cycle_t_ns)
        is_known = ~frames.is_tx & ~frames.is_error & (frames.can_id < _STANDARD_IDS)
        kind = np.zeros(len(owner), np.uint8)
        kind[is_known] = self._kinds[frames.can_id[is_known]]
        window = _Window(frames, cycles, t_ns, owner, kind, np.zeros(count, np.bool_))
        window.refuse(frames.cycle_t_ns != t_ns[owner])  # logged between two cycles
        return window

    def _check_order(self, window: _Window) -> None:
        """Look for one SYNC, and for one frame of each device after it."""
        frames = window.frames
        syncs = np.flatnonzero(frames.is_tx & (frames.can_id == self._arm.sync_id))
        window.require_one(syncs)
        for device in range(_DEVICES):
            window.require_one(window.find(1 + device))
        sync_at = np.zeros(len(window.cycle), np.int64)
        sync_at[window.owner[syncs]] = syncs
        window.refuse((window.kind > 0) & (np.arange(len(window.kind)) < sync_at[window.owner]))
        window.refuse(window.kind == _UNUSUAL)

    def _check_slow_frames(self, window: _Window, heard_ns: dict[int, int], is_enabled: bool) -> None:
        """Look for status frames and heartbeats that bring news, and for their age."""
        frames, patience_ns = window.frames, self._heartbeats.patience_ns
        for device, can_id in enumerate(self._heartbeat_ids):
            found = window.find(1 + _STATUS + device)
            is_long = frames.length[found] == self._lengths[_STATUS + device]
            window.refuse(found[~(is_long & self._is_unchanged(window, _STATUS + device, found))])
            if device < JOINTS and is_enabled and self._arm.drives[device].has_status_frame:
                status_cycle = window.latest(found, window.taken_for(found), self._arm.drives[device].status_cycle)
                window.is_wrong[window.cycle - status_cycle > self._arm.status_age_limits[device]] = True
            found = window.find(1 + _HEARTBEAT + device)
            is_running = (frames.length[found] == 1) & (frames.data[found, 0] & 0x7F == OPERATIONAL)
            window.refuse(found[~is_running])
            last_ns = window.latest(found, frames.t_ns[found], heard_ns.get(can_id, _ALWAYS_NS))
            window.is_wrong[window.t_ns - last_ns > patience_ns] = True

    def _is_unchanged(self, window: _Window, number: int, found: _Numbers) -> NDArray[np.bool_]:
        """Say of each frame of a message whether the bytes are as they were that must stay."""
        unchanged = np.ones(len(found), np.bool_)
        for byte, mask, read, down, up in self._watched[number]:
            unchanged &= window.frames.data[found, byte] & mask == (int(read()) >> down & 0xFF) << up
        return unchanged

    def _read_device(self, window: _Window, device: int, count: int) -> int:
        """Read the cyclic frames of a device in the first cycles; return in how many they are as they must be."""
        found = window.find(1 + device)[:count]
        is_right = (window.frames.t_ns[found] >= window.t_ns[:count]) & self._is_unchanged(window, device, found)
        found = found[: _first(~is_right)]
        values, one = self._values[device], self._arm.devices[device]
        count = read_frames(
            window.frames.data,
            window.frames.length,
            found,
            (self._messages, self._rows, device),
            (one.end_to_end.counter or 0, one.values[0]),
            self._period_s,
            values,
        )
        return _first(~(np.abs(values[:count, 0]) < self._range_Nm[device]))

    def _fill(self, batch: ArmBatch, read: slice, is_enabled: bool) -> None:
        values = self._values[:, : read.stop - read.start]
        batch.q[read] = self._sign * values[:JOINTS, :, 0].T - self._zero_rad
        batch.dq[read] = self._sign * values[:JOINTS, :, 1].T
        batch.tau_J[read] = self._sign * values[JOINTS:, :, 0].T - self._torque_offset_Nm
        batch.age_q[read] = batch.age_tau_J[read] = 0
        batch.is_enabled[read] = is_enabled
        batch.is_complete[read] = True
        batch.fault[read] = FaultReason.NONE
        batch.is_late[read] = False
        batch.steps[read] = 1
        batch.sampled_ns[read] = batch.t_ns[read]


_NOTHING = OrdinaryStretch(0, 0, [])


def _first(is_so: NDArray[np.bool_]) -> int:
    """Return the first place where it is so; how many there are, where nowhere."""
    return int(np.argmax(is_so)) if is_so.any() else len(is_so)
