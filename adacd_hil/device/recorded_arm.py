"""The arm from recorded frames: the ArmState of each cycle, as the live loop had it before the scheme's step.

A log has every frame in the order in which the host received or sent it, each with the time of the cycle that logged
it. The live loop used no other information:

- If the host sends SYNC, SYNC is the host's own. If it follows another host's, SYNC is the last one received with the
  time of the cycle. That frame may have been logged with the cycle before, as its last frame.
- A frame received before SYNC counts for the cycle before, whatever its stamp.
- A frame received after SYNC answers that SYNC or an earlier one; an earlier one if its stamp is older than SYNC:
  `answer_clock`. Frames that arrived after all cyclic ones were in, or after the wait was over, were read in the next
  cycle and are logged there.
- Frames before the host's NMT start are ignored: an earlier heartbeat counts as no heartbeat.
- An attempt begins with the host's NMT reset; it discards all earlier state.

Error frames are ignored. Of a cycle whose packet the logger dropped, all frames are unknown: from there on the states
may differ until every counter and age has been renewed.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.clock import VirtualClock
from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_watch import ArmWatch, watch_heartbeats
from adacd_hil.device.network import RESET_COMMUNICATION, START
from adacd_hil.device.profile import PlacedDevice
from adacd_hil.records import JOINTS, ArmBatch, ArmState
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.contract_frames import NMT_ID
from adacd_hil.wire.embedded_bus import EmbeddedBus

_Passed = Iterable[tuple[bool, Frame]]
"""Frames in the order of the log, True for sent."""


class Ticks(NamedTuple):
    """The beginnings of n cycles, as columns (n,) of int64.

    `t_ns`: when SYNC went out or came, as all messages of the cycle carry it; so do its frames, as cycle_t_ns.
    `periods`: since the cycle before, 1 unless some were skipped; the pause before an attempt is not counted.
    """

    cycle: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    periods: NDArray[np.int64]


class RecordedArm:
    """Turns the logged frames of one run into the states that its arm reported, attempt after attempt."""

    def __init__(self, settings: Settings, codec: Codec, devices: Sequence[PlacedDevice]) -> None:
        """Make the first arm. Raises CodecError when the contract lacks a frame or signal of the devices."""
        self._settings, self._codec = settings, codec
        self._is_following = settings.bus.follows
        self._devices = devices
        self._begin()

    def _begin(self) -> None:
        """Make a new arm and heartbeat watch, as at the start of an attempt; frames are dropped until `_start`."""
        settings = self._settings
        self._arm = Arm(settings, self._codec, self._devices, EmbeddedBus(VirtualClock()))  # with nobody on it
        self._heartbeats = watch_heartbeats(self._devices, settings.bus.heartbeat_ms, lambda _: None)
        self._watch = ArmWatch(settings, self._heartbeats.judge_nodes)
        self._is_running = False

    def read(self, ticks: Ticks, frames: NDArray[Any]) -> ArmBatch:
        """Return the states of the cycles in `ticks`, given all frames that were logged with, before or between them.

        `frames`: FRAME_DTYPE or LONG_FRAME_DTYPE of the log's reader. Consecutive calls take up a run piece by piece;
        frames that were logged after the last cycle of a piece may come with this call or with the next.
        """
        passed = _unpack(frames)
        states: list[ArmState] = []
        at = 0
        for tick in zip(*(column.tolist() for column in ticks), *self._bounds(ticks, frames), strict=True):
            cycle, t_ns, periods, sync, end = tick
            self._pass(islice(passed, sync - at))
            states.append(self._exchange(cycle, t_ns, periods, islice(passed, end - sync)))
            at = end
        self._pass(passed)
        return _batch_of(states)

    def _bounds(self, ticks: Ticks, frames: NDArray[Any]) -> tuple[list[int], list[int]]:
        """Return the indices in `frames` at which the frames of each of n cycles begin, and those at which they end.

        A cycle's frames begin with its SYNC; if SYNC was logged with the cycle before, with the first of its own.
        """
        cycle_t_ns, is_tx = frames["cycle_t_ns"], frames["is_tx"]
        is_sync = (frames["can_id"] == self._arm.sync_id) & (is_tx != self._is_following) & ~frames["is_error"]
        syncs = np.flatnonzero(is_sync & (is_tx | (frames["t_ns"] == cycle_t_ns)))
        first, end = (np.searchsorted(cycle_t_ns, ticks.t_ns, side) for side in ("left", "right"))
        last = np.concatenate(([-1], syncs))[np.searchsorted(syncs, end)]
        end = np.maximum.accumulate(end)  # also where a wall clock, by which SYNC was stamped, was set back
        begin = np.maximum(np.maximum(first, last), np.concatenate(([0], end[:-1])))
        return np.minimum(begin, end).tolist(), end.tolist()

    def _exchange(self, cycle: int, t_ns: int, periods: int, passed: _Passed) -> ArmState:
        """Begin a cycle, take its received frames, and return its state with the faults of `ArmWatch`.

        A frame stamped before SYNC counts as late. If no NMT start was logged before, the run counts as started.
        """
        if not self._is_running:  # a log whose beginning was cut off
            self._start()
        arm = self._arm
        arm.synchronise(cycle, t_ns, periods)
        for is_sent, frame in passed:
            if not is_sent:
                self._accept(frame, is_late=frame.t_ns < t_ns)
        return self._watch.judge(arm.state())

    def _pass(self, passed: _Passed) -> None:
        """Take received frames that passed between a cycle's end and the next SYNC, and follow sent NMT commands."""
        for is_sent, frame in passed:
            if not is_sent:
                self._accept(frame)
            elif frame.can_id == NMT_ID and frame.data:
                self._command(frame.data[0])

    def _command(self, nmt_command: int) -> None:
        """Begin anew at an NMT reset of a running arm; start an arm that doesn't run at NMT start; else do nothing."""
        if nmt_command == RESET_COMMUNICATION and self._is_running:
            self._begin()
        elif nmt_command == START and not self._is_running:
            self._start()

    def _start(self) -> None:
        self._heartbeats.start()
        self._is_running = True

    def _accept(self, frame: Frame, is_late: bool = False) -> None:
        """Give a received frame to the arm, else to the heartbeat watch; drop it before the host's NMT start.

        is_late: it arrived before the cycle's SYNC, so it answers an earlier one.
        """
        if self._is_running and not self._arm.accept(frame, is_late):
            self._heartbeats.accept(frame)


def _unpack(frames: NDArray[Any]) -> Iterator[tuple[bool, Frame]]:
    """Yield (is_sent, frame) for each recorded frame, the frame as a bus has it."""
    data = frames["data"].tobytes()
    starts = range(0, len(data), frames["data"].shape[1])
    columns = (frames[name].tolist() for name in ("is_tx", "can_id", "length", "t_ns", "is_error"))
    for start, is_sent, can_id, length, t_ns, is_error in zip(starts, *columns, strict=True):
        yield is_sent, Frame(can_id, data[start : start + length], t_ns, is_error)


_KINDS: dict[str, Any] = {
    "is_enabled": np.bool_,
    "is_complete": np.bool_,
    "is_late": np.bool_,
    "fault": np.uint8,
    **dict.fromkeys(("q", "dq", "tau_J"), np.float64),
}
"""Types of an ArmBatch's columns that are not int64."""
_PAIRS = ("q", "dq", "tau_J", "age_q", "age_tau_J")


def _batch_of(states: list[ArmState]) -> ArmBatch:
    """Return the states of n cycles as columns, with the shapes and types of ArmBatch; n may be 0."""
    columns = list(zip(*states, strict=True)) if states else [()] * len(ArmBatch._fields)
    return ArmBatch(
        *(
            np.array(column, _KINDS.get(name, np.int64)).reshape(len(states), *([JOINTS] if name in _PAIRS else []))
            for name, column in zip(ArmBatch._fields, columns, strict=True)
        )
    )
