"""Ordinary cycles from recorded frames, many in one compiled call: every frame of the arm once, right, and nothing new.

A cycle is ordinary when no period was skipped, its SYNC was sent, both feedbacks and both torques came once after it
and pass their checks, and nothing else of what came changes more than an age: no drive's or sensor's status, no NMT
state. Then the ArmState is fresh, complete and without fault. The first cycle that is otherwise ends the stretch, and
with it all that this module knows: the live classes go on from there.

Kinds of frames, by identifier: 1 to 4 feedback 1, 2 and torque 1, 2; 5 to 8 the status of the same devices; 9 to 12
heartbeats; 13 what is never ordinary, as an EMCY or what only the host sends; 0 what the arm is not concerned with.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import Structured, compiled, released
from adacd_hil.device.arm_watch import OPERATIONAL
from adacd_hil.records import JOINTS
from adacd_hil.wire.cyclic_codec import counter_of, read_frame

DEVICES = 2 * JOINTS
STATUS = DEVICES
"""Kinds up to it are cyclic frames; beyond it status frames."""
HEARTBEAT = 2 * DEVICES
KINDS = 3 * DEVICES + 1
UNUSUAL = KINDS
"""Kind of the frames of which one ends a stretch."""
STANDARD_IDS = 0x800
MOST_WATCHED = 8

CHECKS = np.dtype(
    [
        ("length", np.int64),
        ("range_limit", np.float64),  # the end of the torque's range
        # What must stay as it is: data[byte] & mask == value.
        ("watched_count", np.int64),
        ("byte", np.int64, (MOST_WATCHED,)),
        ("mask", np.int64, (MOST_WATCHED,)),
        ("value", np.int64, (MOST_WATCHED,)),
        ("renews_status", np.int64),  # of a drive: its arrival makes the status young
    ]
)
"""Of each cyclic and status frame, beside what the codec checks."""
CONSTANTS = np.dtype(
    [
        ("sync_id", np.int64),
        ("period_s", np.float64),
        ("sign", np.float64, (JOINTS,)),
        ("torque_offset_Nm", np.float64, (JOINTS,)),
        ("status_age_limit", np.float64, (JOINTS,)),  # cycles; infinite where nothing is looked at
        ("patience_ns", np.int64),
    ]
)
MEMORY = np.dtype(
    [
        ("cycle", np.int64),
        ("counter", np.int64, (DEVICES,)),
        ("last", np.float64, (DEVICES,)),  # position or torque
        ("status_cycle", np.int64, (JOINTS,)),
        ("heard_ns", np.int64, (DEVICES,)),
        # The last frame of each kind: its place among the frames, -1 for none, and the cycle that it was taken for.
        ("frame", np.int64, (KINDS,)),
        ("frame_cycle", np.int64, (KINDS,)),
    ]
)


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


@released
def read_cycles(
    frames: FrameColumns,
    at: int,
    ticks: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]],
    constants: Structured,
    contract: tuple[Structured, Structured, Structured],
    kinds: NDArray[np.uint8],
    memory: Structured,
    is_enabled: bool,
    values: NDArray[np.float64],
) -> tuple[int, int]:
    """Read ordinary cycles; return how many, and where the frames of the last one begin.

    ticks: cycle, t_ns, periods (n,). contract: CHECKS of both kinds of frames, messages and signal rows of the cyclic
    ones, position and velocity or torque alone. values (n, devices, 2) gets position and velocity, and torque.
    """
    cycles, times_ns, periods = ticks
    found = np.empty(KINDS, np.int64)
    last = at
    for place in range(len(cycles)):
        cycle, t_ns = cycles[place], times_ns[place]
        if periods[place] != 1 or cycle != memory[0]["cycle"] + 1:
            return place, last
        end = _check(frames, t_ns, at, constants, contract, kinds, memory, found, values[place])
        if end < 0 or _is_old(frames, cycle, t_ns, constants, contract[0], memory, found, is_enabled):
            return place, last
        _keep(frames, cycle, t_ns, contract, memory, found, values[place])
        last, at = at, end
    return len(cycles), last


@compiled
def _check(
    frames: FrameColumns,
    t_ns: int,
    at: int,
    constants: Structured,
    contract: tuple[Structured, Structured, Structured],
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
        elif not frames.is_error[place] and can_id < STANDARD_IDS and kinds[can_id] > 0:
            kind = int(kinds[can_id])
            if kind == UNUSUAL or not has_sync or (kind <= STATUS and found[kind] >= 0):
                return -1
            if not _is_usual(frames, place, kind, t_ns, constants, contract, memory, values):
                return -1
            found[kind] = place
        place += 1
    for kind in range(1, STATUS + 1):
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
    contract: tuple[Structured, Structured, Structured],
    memory: Structured,
    values: NDArray[np.float64],
) -> bool:
    """Say whether a frame passes its checks and brings nothing new but values, which go into `values`."""
    data = frames.data
    length = int(frames.length[place])
    if kind > HEARTBEAT:
        return bool(length == 1 and int(data[place, 0]) & 0x7F == OPERATIONAL)
    checks, messages, rows = contract
    check = checks[kind - 1]
    if length != check["length"]:
        return False
    for slot in range(check["watched_count"]):
        if int(data[place, check["byte"][slot]]) & check["mask"][slot] != check["value"][slot]:
            return False
    if kind > STATUS:
        return True
    device = kind - 1
    counter, last = memory[0]["counter"][device], memory[0]["last"][device]
    period_s = constants[0]["period_s"]
    is_right = read_frame(data, place, length, messages[device], rows, counter, last, period_s, values[device])
    return bool(is_right and frames.t_ns[place] >= t_ns and abs(values[device, 0]) < check["range_limit"])


@compiled
def _is_old(
    frames: FrameColumns,
    cycle: int,
    t_ns: int,
    constants: Structured,
    checks: Structured,
    memory: Structured,
    found: NDArray[np.int64],
    is_enabled: bool,
) -> bool:
    """Say whether a heartbeat is overdue, or the status of an enabled drive."""
    for device in range(DEVICES):
        at = found[1 + HEARTBEAT + device]
        heard_ns = memory[0]["heard_ns"][device] if at < 0 else frames.t_ns[at]
        if t_ns - heard_ns > constants[0]["patience_ns"]:
            return True
    for joint in range(JOINTS):
        is_renewed = checks[joint]["renews_status"] > 0 or found[1 + STATUS + joint] >= 0
        age = 1 if is_renewed else cycle - memory[0]["status_cycle"][joint]
        if is_enabled and age > constants[0]["status_age_limit"][joint]:
            return True
    return False


@compiled
def _keep(
    frames: FrameColumns,
    cycle: int,
    t_ns: int,
    contract: tuple[Structured, Structured, Structured],
    memory: Structured,
    found: NDArray[np.int64],
    values: NDArray[np.float64],
) -> None:
    """Remember what the next cycle is compared with, and the last frames of each kind."""
    state = memory[0]
    checks, messages, _ = contract
    state["cycle"] = cycle
    for device in range(DEVICES):
        if messages[device]["profile"] > 0:
            state["counter"][device] = counter_of(frames.data, found[1 + device], messages[device]["profile"])
        state["last"][device] = values[device, 0]
    for kind in range(STATUS + 1, KINDS):
        if found[kind] >= 0:
            state["frame"][kind] = found[kind]
            state["frame_cycle"][kind] = cycle - 1 if frames.t_ns[found[kind]] < t_ns else cycle
    for joint in range(JOINTS):
        if checks[joint]["renews_status"] > 0:
            state["status_cycle"][joint] = cycle
        elif found[1 + STATUS + joint] >= 0:
            state["status_cycle"][joint] = state["frame_cycle"][1 + STATUS + joint]
    for device in range(DEVICES):
        at = found[1 + HEARTBEAT + device]
        if at >= 0:
            state["heard_ns"][device] = frames.t_ns[at]
