"""Ordinary cycles from recorded frames, many in one compiled call: every frame of the arm once, right, and nothing new.

A cycle is ordinary when no period was skipped, its SYNC was sent, both feedbacks and both torques came once after it
and pass their checks, and nothing else of what came changes more than an age: no drive's or sensor's status, no NMT
state. Then the ArmState is fresh, complete and without fault. The first cycle that is otherwise ends the stretch, and
with it all that this module knows: the live classes go on from there.

Kinds of frames, by identifier: 1 to 4 feedback 1, 2 and torque 1, 2; 5 to 8 the status of the same devices; from 9 on
heartbeats; 0 what the arm is not concerned with.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import compiled, released
from adacd_hil.config import Settings
from adacd_hil.device.arm import Arm
from adacd_hil.device.drive import Drive
from adacd_hil.device.heartbeat import HEARTBEAT_ID, OPERATIONAL, HeartbeatWatch
from adacd_hil.device.torque_sensor import TorqueSensor
from adacd_hil.records import JOINTS, ArmBatch, ArmState, FaultReason
from adacd_hil.wire.codec import MessageCodec, SignalCodec
from adacd_hil.wire.e2e_batch import MOST_DATA_IDS, PROFILE_NUMBERS, counter_of, is_next

Structured = np.ndarray[Any, np.dtype[np.void]]

DEVICES = 2 * JOINTS
_STATUS = DEVICES
"""Kinds up to it are cyclic frames; beyond it status frames."""
_HEARTBEAT = 2 * DEVICES
_KINDS = 3 * DEVICES + 1
_STANDARD_IDS = 0x800
_MOST_WATCHED = 8
_MOST_BITS = 32
_MOST_CYCLES = 8192
"""Cycles of one call."""
_STATUS_BITS = 0x07
_ALWAYS_NS = 1 << 62

_MESSAGE = np.dtype(
    [
        ("length", np.int64),
        ("profile", np.int64),  # of the end-to-end header, 0 without
        ("data_ids", np.uint8, (MOST_DATA_IDS,)),
        # The values: position and velocity, or torque. value = raw * scale + offset
        ("first_byte", np.int64, (2,)),
        ("byte_count", np.int64, (2,)),
        ("is_signed", np.int64, (2,)),  # numba has no arrays of bool in a structure
        ("scale", np.float64, (2,)),
        ("offset", np.float64, (2,)),
        # Without header: largest step of position beyond velocity x time, or of torque; the end of the torque's range.
        ("step_limit", np.float64),
        ("range_limit", np.float64),
        # What must stay as it is: data[byte] & mask == value.
        ("watched_count", np.int64),
        ("byte", np.int64, (_MOST_WATCHED,)),
        ("mask", np.int64, (_MOST_WATCHED,)),
        ("value", np.int64, (_MOST_WATCHED,)),
        ("renews_status", np.int64),  # of a drive: its arrival makes the status young
    ]
)
_CONSTANTS = np.dtype(
    [
        ("sync_id", np.int64),
        ("period_s", np.float64),
        ("sign", np.float64, (JOINTS,)),
        ("torque_offset_Nm", np.float64, (JOINTS,)),
        ("status_age_limit", np.float64, (JOINTS,)),  # cycles; infinite where nothing is looked at
        ("patience_ns", np.int64),
    ]
)
_MEMORY = np.dtype(
    [
        ("cycle", np.int64),
        ("counter", np.int64, (DEVICES,)),
        ("last", np.float64, (DEVICES,)),  # position or torque
        ("status_cycle", np.int64, (JOINTS,)),
        ("heard_ns", np.int64, (DEVICES,)),
        # The last frame of each kind: its place among the frames, -1 for none, and the cycle that it was taken for.
        ("frame", np.int64, (_KINDS,)),
        ("frame_cycle", np.int64, (_KINDS,)),
    ]
)


class NotOrdinaryError(ValueError):
    """An arm whose frames can't be read at once; one line."""


class FrameColumns(NamedTuple):
    """Recorded frames (f,) as columns, each in one piece; `data` (f, 8) or (f, 64)."""

    t_ns: NDArray[np.int64]
    cycle_t_ns: NDArray[np.int64]
    can_id: NDArray[np.uint32]
    is_tx: NDArray[np.bool_]
    is_error: NDArray[np.bool_]
    length: NDArray[np.uint8]
    data: NDArray[np.uint8]


def columns_of(frames: NDArray[Any]) -> FrameColumns:
    """Lay recorded frames out as columns."""
    return FrameColumns(*(np.ascontiguousarray(frames[name]) for name in FrameColumns._fields))


class Stretch(NamedTuple):
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
        self._messages = np.zeros(2 * DEVICES, _MESSAGE)
        self._constants = np.zeros(1, _CONSTANTS)
        self._memory = np.zeros(1, _MEMORY)
        self._values = np.zeros((_MOST_CYCLES, DEVICES, 2))
        self._kinds = np.zeros(_STANDARD_IDS, np.uint8)
        self._watched: list[_Watched] = []
        self._heartbeat_ids = [HEARTBEAT_ID + device.node_id for device in arm.devices]
        self._lay_out_arm(settings)
        for index, drive in enumerate(arm.drives):
            self._lay_out_drive(index, drive)
        for index, sensor in enumerate(arm.sensors, JOINTS):
            self._lay_out_sensor(index, sensor, settings.bus.period_s)

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
        _place_values(message, drive.feedback_message, ("position", "velocity"))
        message["step_limit"] = drive.position_jump_rad
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

    def _lay_out_sensor(self, index: int, sensor: TorqueSensor, period_s: float) -> None:
        found = sensor.torque_message
        message = self._lay_out_message(index, found)
        _place_values(message, found, ("torque",))
        message["step_limit"] = sensor.torque_rate_Nm_s * period_s
        message["range_limit"] = np.inf
        names = [signal.name for signal in found.values]
        if "status" in names:
            self._watch_status(index, found, sensor)
        elif sensor.status_in_header is not None:
            byte, shift = sensor.status_in_header
            self._watch(index, byte, _STATUS_BITS << shift, lambda: sensor.status, up=shift)
        elif sensor.torque_range_Nm:
            message["range_limit"] = sensor.torque_range_Nm
        status = self._lay_out_status(index, sensor.status_message)
        if sensor.status_message is not None:
            self._watch_status(status, sensor.status_message, sensor)

    def _lay_out_message(self, index: int, found: MessageCodec) -> Any:
        message = self._messages[index]
        message["length"] = found.length
        message["profile"] = PROFILE_NUMBERS[found.protection]
        message["data_ids"][: len(found.data_ids)] = list(found.data_ids)
        self._name(found.can_id, 1 + index)
        return message

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
        for byte in range(_byte_count(found, signal)):
            self._watch(number, found.first_byte(signal) + byte, 0xFF, read, down=8 * byte)

    def _watch_status(self, number: int, found: MessageCodec, sensor: TorqueSensor) -> None:
        """Watch the bits of a sensor's status."""
        signal = next(signal for signal in found.values if signal.name == "status")
        if signal.scale != 1.0 or signal.offset != 0.0 or signal.mask:
            raise NotOrdinaryError(f"{found.name}.status is scaled or shares a byte")
        self._watch(number, found.first_byte(signal), _STATUS_BITS, lambda: sensor.status)

    def _watch(self, number: int, byte: int, mask: int, read: Callable[[], int], down: int = 0, up: int = 0) -> None:
        message = self._messages[number]
        slot = int(message["watched_count"])
        if slot == _MOST_WATCHED:
            raise NotOrdinaryError("too many bytes to watch")
        message["watched_count"] = slot + 1
        message["byte"][slot], message["mask"][slot] = byte, mask
        self._watched.append(_Watched(number, slot, read, down, up))

    def read(self, batch: ArmBatch, place: int, frames: FrameColumns, at: int, state: ArmState) -> Stretch:
        """Fill `batch` from `place` on with ordinary cycles; their frames begin at `at`.

        `state`: of the cycle before, which the live classes took.
        """
        if not self._begin(state):
            return _NOTHING
        memory, constants, values = self._memory, self._constants[0], self._values
        most = slice(place, place + _MOST_CYCLES)
        ticks = batch.cycle[most], batch.t_ns[most], batch.periods[most]
        count, last = _read(
            frames, at, ticks, self._constants, self._messages, self._kinds, memory, state.is_enabled, self._values
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
        places, cycles = memory[0]["frame"].tolist(), memory[0]["frame_cycle"].tolist()
        return Stretch(count, last, [(at, cycle) for at, cycle in zip(places, cycles, strict=True) if at >= 0])

    def _begin(self, state: ArmState) -> bool:
        """Take over from the live classes, where nothing is unusual."""
        arm = self._arm
        if state.fault is not FaultReason.NONE or state.is_late or not (state.is_complete and arm.has_all_frames):
            return False
        heard_ns = self._heartbeats.heard_ns()
        if heard_ns is None or not all(device.is_steady for device in arm.devices):
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
            self._messages[number]["value"][slot] = (int(read()) >> down & 0xFF) << up
        return True


_NOTHING = Stretch(0, 0, [])


def _place_values(message: Any, found: MessageCodec, names: tuple[str, ...]) -> None:
    """Say where the values of a cyclic frame are and what a count is worth."""
    for slot, name in enumerate(names):
        signal = next(signal for signal in found.values if signal.name == name)
        message["first_byte"][slot] = found.first_byte(signal)
        message["byte_count"][slot] = _byte_count(found, signal)
        message["is_signed"][slot] = signal.raw_low < 0
        message["scale"][slot], message["offset"][slot] = signal.scale, signal.offset


def _byte_count(found: MessageCodec, signal: SignalCodec) -> int:
    """Count the bytes of a signal that has them for itself."""
    bits = (signal.raw_high - signal.raw_low).bit_length()
    if signal.mask or bits > _MOST_BITS:
        raise NotOrdinaryError(f"{found.name}.{signal.name} is part of a byte or has more than {_MOST_BITS} bits")
    return bits // 8


@released
def _read(
    frames: FrameColumns,
    at: int,
    ticks: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]],
    constants: Structured,
    messages: Structured,
    kinds: NDArray[np.uint8],
    memory: Structured,
    is_enabled: bool,
    values: NDArray[np.float64],
) -> tuple[int, int]:
    """Read ordinary cycles; return how many, and where the frames of the last one begin.

    ticks: cycle, t_ns, periods (n,). values (n, devices, 2) gets position and velocity, and torque.
    """
    cycles, times_ns, periods = ticks
    found = np.empty(_KINDS, np.int64)
    last = at
    for place in range(len(cycles)):
        cycle, t_ns = cycles[place], times_ns[place]
        if periods[place] != 1 or cycle != memory[0]["cycle"] + 1:
            return place, last
        end = _check(frames, t_ns, at, constants, messages, kinds, memory, found, values[place])
        if end < 0 or _is_old(frames, cycle, t_ns, constants, messages, memory, found, is_enabled):
            return place, last
        _keep(frames, cycle, t_ns, messages, memory, found, values[place])
        last, at = at, end
    return len(cycles), last


@compiled
def _check(
    frames: FrameColumns,
    t_ns: int,
    at: int,
    constants: Structured,
    messages: Structured,
    kinds: NDArray[np.uint8],
    memory: Structured,
    found: NDArray[np.int64],
    values: NDArray[np.float64],
) -> int:
    """Go through the frames of a cycle; return where they end, -1 when one is unusual, missing or there twice."""
    found[:] = -1
    has_sync = False
    place = at
    while place < len(frames.t_ns) and frames.cycle_t_ns[place] == t_ns:
        can_id = int(frames.can_id[place])
        if frames.is_tx[place]:
            if can_id == constants[0]["sync_id"]:
                if has_sync:
                    return -1
                has_sync = True
        elif not frames.is_error[place] and can_id < _STANDARD_IDS and kinds[can_id] > 0:
            kind = int(kinds[can_id])
            if not has_sync or (kind <= _STATUS and found[kind] >= 0):
                return -1
            if not _is_usual(frames, place, kind, t_ns, constants, messages, memory, values):
                return -1
            found[kind] = place
        place += 1
    for kind in range(1, _STATUS + 1):
        if found[kind] < 0:
            return -1
    return place


@compiled
def _is_usual(
    frames: FrameColumns,
    place: int,
    kind: int,
    t_ns: int,
    constants: Structured,
    messages: Structured,
    memory: Structured,
    values: NDArray[np.float64],
) -> bool:
    """Say whether a frame passes its checks and brings nothing new but values, which go into `values`."""
    data = frames.data
    length = int(frames.length[place])
    if kind > _HEARTBEAT:
        return bool(length == 1 and int(data[place, 0]) & 0x7F == OPERATIONAL)
    message = messages[kind - 1]
    if length != message["length"]:
        return False
    for slot in range(message["watched_count"]):
        if int(data[place, message["byte"][slot]]) & message["mask"][slot] != message["value"][slot]:
            return False
    if kind > _STATUS:
        return True
    device = kind - 1
    last = memory[0]["last"][device]
    values[device, 0] = _value(data, place, message, 0)
    if device < JOINTS:
        values[device, 1] = _value(data, place, message, 1)
    if message["profile"] == 0:
        step = values[device, 0] - last
        if device < JOINTS:
            step -= values[device, 1] * constants[0]["period_s"]
        is_right = abs(step) <= message["step_limit"]
    else:
        counter = memory[0]["counter"][device]
        is_right = is_next(data, place, length, message["profile"], message["data_ids"], counter)
    return bool(is_right and frames.t_ns[place] >= t_ns and abs(values[device, 0]) < message["range_limit"])


@compiled
def _value(data: NDArray[np.uint8], row: int, message: Any, slot: int) -> float:
    """Decode one value of a frame."""
    first, count = message["first_byte"][slot], message["byte_count"][slot]
    raw = 0
    for byte in range(count):
        raw |= int(data[row, first + byte]) << (8 * byte)
    if message["is_signed"][slot] > 0 and raw >> (8 * count - 1) > 0:
        raw -= 1 << (8 * count)
    return float(raw * message["scale"][slot] + message["offset"][slot])


@compiled
def _is_old(
    frames: FrameColumns,
    cycle: int,
    t_ns: int,
    constants: Structured,
    messages: Structured,
    memory: Structured,
    found: NDArray[np.int64],
    is_enabled: bool,
) -> bool:
    """Say whether a heartbeat is overdue, or the status of an enabled drive."""
    for device in range(DEVICES):
        at = found[1 + _HEARTBEAT + device]
        heard_ns = memory[0]["heard_ns"][device] if at < 0 else frames.t_ns[at]
        if t_ns - heard_ns > constants[0]["patience_ns"]:
            return True
    for joint in range(JOINTS):
        is_renewed = messages[joint]["renews_status"] > 0 or found[1 + _STATUS + joint] >= 0
        age = 1 if is_renewed else cycle - memory[0]["status_cycle"][joint]
        if is_enabled and age > constants[0]["status_age_limit"][joint]:
            return True
    return False


@compiled
def _keep(
    frames: FrameColumns,
    cycle: int,
    t_ns: int,
    messages: Structured,
    memory: Structured,
    found: NDArray[np.int64],
    values: NDArray[np.float64],
) -> None:
    """Remember what the next cycle is compared with, and the last frames of each kind."""
    state = memory[0]
    state["cycle"] = cycle
    for device in range(DEVICES):
        if messages[device]["profile"] > 0:
            state["counter"][device] = counter_of(frames.data, found[1 + device], messages[device]["profile"])
        state["last"][device] = values[device, 0]
    for kind in range(_STATUS + 1, _KINDS):
        if found[kind] >= 0:
            state["frame"][kind] = found[kind]
            state["frame_cycle"][kind] = cycle - 1 if frames.t_ns[found[kind]] < t_ns else cycle
    for joint in range(JOINTS):
        if messages[joint]["renews_status"] > 0:
            state["status_cycle"][joint] = cycle
        elif found[1 + _STATUS + joint] >= 0:
            state["status_cycle"][joint] = state["frame_cycle"][1 + _STATUS + joint]
    for device in range(DEVICES):
        at = found[1 + _HEARTBEAT + device]
        if at >= 0:
            state["heard_ns"][device] = frames.t_ns[at]
