"""Recordings in which one thing is changed by hand: read at once as far as possible, and frame by frame."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from recorded_arm_rig import Live, play, ticks_of

from adacd_hil.device.ordinary_cycles import OrdinaryCycles, OrdinaryStretch
from adacd_hil.device.recorded_arm import RecordedArm, Ticks
from adacd_hil.records import ArmBatch

pytestmark = pytest.mark.slow

SYNC, HEARTBEAT = 0x080, 0x703
FEEDBACK, TORQUE = 0x181, 0x183
DRIVE_STATUS, SENSOR_STATUS = 0x282, 0x284
PLACE = 300  # of the cycle that is changed, amid ordinary ones


class Recording(NamedTuple):
    """Frames and cycles of a quiet run."""

    frames: NDArray[Any]
    ticks: Ticks

    def find(self, can_id: int) -> int:
        """Find the first frame with an identifier from the changed cycle on."""
        frames = self.frames
        return int(np.flatnonzero((frames["can_id"] == can_id) & (frames["cycle_t_ns"] >= self.ticks.t_ns[PLACE]))[0])

    def without(self, can_id: int) -> "Recording":
        """Drop all frames with an identifier from the changed cycle on."""
        frames = self.frames
        is_left = (frames["can_id"] != can_id) | (frames["cycle_t_ns"] < self.ticks.t_ns[PLACE])
        return self._replace(frames=frames[is_left])

    def with_copy(self, can_id: int, is_error: bool = False, to: int | None = None) -> "Recording":
        """Repeat a frame, at another place if one is given."""
        place = self.find(can_id)
        frame = self.frames[place : place + 1].copy()
        frame["is_error"] = is_error
        return self._replace(frames=np.insert(self.frames, place + 1 if to is None else to, frame))


@pytest.fixture(scope="module")
def quiet(tmp_path_factory: pytest.TempPathFactory) -> Live:
    return play(tmp_path_factory.mktemp("quiet"), [], finish_s=0.1)


def _set(field: str, can_id: int, value: int, byte: int | None = None) -> Callable[[Recording], Recording]:
    def change(recording: Recording) -> Recording:
        place = recording.find(can_id)
        if byte is None:
            recording.frames[field][place] = int(recording.frames[field][place]) + value
        else:
            recording.frames[field][place, byte] ^= value
        return recording

    return change


def _delete(recording: Recording, can_id: int) -> Recording:
    return recording._replace(frames=np.delete(recording.frames, recording.find(can_id)))


def _move_before_sync(recording: Recording) -> Recording:
    place = recording.find(TORQUE)
    moved = recording.with_copy(TORQUE, to=recording.find(SYNC))
    return moved._replace(frames=np.delete(moved.frames, place + 1))


def _skip(recording: Recording) -> Recording:
    recording.ticks.periods[PLACE] = 12  # too many for the deadline watch
    return recording


def _lose_cycle(recording: Recording) -> Recording:
    t_ns = recording.ticks.t_ns[PLACE]
    ticks = Ticks(*(np.delete(column, PLACE) for column in recording.ticks))
    return Recording(recording.frames[recording.frames["cycle_t_ns"] != t_ns], ticks)


def _end_late(recording: Recording) -> Recording:
    place = recording.find(DRIVE_STATUS)
    recording.frames["t_ns"][place] -= 2_000_000
    later = np.flatnonzero(recording.frames["can_id"] == DRIVE_STATUS)
    return recording._replace(frames=np.delete(recording.frames, later[later > place]))


CHANGES: dict[str, Callable[[Recording], Recording]] = {
    "nothing": lambda recording: recording,
    "a torque with a wrong bit": _set("data", TORQUE, 0x10, 3),
    "a torque that is too long": _set("length", TORQUE, 1),
    "a torque that is missing": lambda recording: _delete(recording, TORQUE),
    "a torque that came twice": lambda recording: recording.with_copy(TORQUE),
    "a torque before SYNC": _move_before_sync,
    "a torque older than SYNC": _set("t_ns", TORQUE, -2_000_000),
    "an error with a torque's identifier": lambda recording: recording.with_copy(TORQUE, is_error=True),
    "a feedback that came twice": lambda recording: recording.with_copy(FEEDBACK),
    "a feedback that is too short": _set("length", FEEDBACK, -1),
    "a feedback older than SYNC": _set("t_ns", FEEDBACK, -2_000_000),
    "a position that jumps": _set("data", FEEDBACK, 0x10, 2),
    "a velocity that doesn't fit": _set("data", FEEDBACK, 0x10, 6),
    "SYNC twice": lambda recording: recording.with_copy(SYNC, to=recording.find(TORQUE) + 1),
    "no SYNC": lambda recording: _delete(recording, SYNC),
    "a drive's status older than SYNC": _set("t_ns", DRIVE_STATUS, -2_000_000),
    "a drive's last status older than SYNC": _end_late,
    "a drive's status of another state": _set("data", DRIVE_STATUS, 0x04, 0),
    "a drive's status of another mode": _set("data", DRIVE_STATUS, 0x01, 2),
    "a drive's status that is too short": _set("length", DRIVE_STATUS, -1),
    "no more status of a drive": lambda recording: recording.without(DRIVE_STATUS),
    "a sensor's status that says not valid": _set("data", SENSOR_STATUS, 0x01, 0),
    "a heartbeat that says stopped": _set("data", HEARTBEAT, 0x01, 0),
    "a heartbeat that is too long": _set("length", HEARTBEAT, 1),
    "no more heartbeats of a sensor": lambda recording: recording.without(HEARTBEAT),
    "skipped periods": _skip,
    "a cycle that was not logged": _lose_cycle,
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_is_read_at_once_is_what_is_read_frame_by_frame(
    change: str, quiet: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = quiet.log.frames.copy()
    ticks = Ticks(*(column[:600].copy() for column in ticks_of(quiet.log)))
    recording = CHANGES[change](Recording(frames[frames["cycle_t_ns"] <= ticks.t_ns[-1]], ticks))
    settings = dataclasses.replace(
        quiet.settings,
        arm=dataclasses.replace(quiet.settings.arm, sign=(-1, 1), torque_offset_Nm=(0.25, -0.5)),
        realtime=dataclasses.replace(quiet.settings.realtime, on_misses="hold"),
    )
    at_once, one_by_one = (RecordedArm(settings, quiet.codec) for _ in range(2))
    found = at_once.read(recording.ticks, recording.frames)
    monkeypatch.setattr(OrdinaryCycles, "read", lambda *_: OrdinaryStretch(0, 0, []))
    due = one_by_one.read(recording.ticks, recording.frames)
    assert [name for name in ArmBatch._fields if getattr(found, name).tobytes() != getattr(due, name).tobytes()] == []
    assert at_once._arm.frame_checks() == one_by_one._arm.frame_checks()
    assert at_once.exact_cycles < one_by_one.exact_cycles
