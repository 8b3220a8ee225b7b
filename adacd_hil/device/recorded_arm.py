"""The arm from recorded frames: the ArmState of each cycle, as the live loop had it before the scheme's step.

A log has every frame in the order in which the host took or sent it, and with it the time of the cycle that it was
logged with. That is all that the live loop went by:

- SYNC is the host's own where it sends it; where it follows another host's, the last one received with the time of the
  cycle. That one may have been logged with the cycle before, as its last frame.
- What was received before SYNC was taken for the cycle before, whatever its stamp.
- What was received after SYNC belongs to the cycle, or to the one before where its stamp is older than SYNC. Frames
  that came once all cyclic ones were in, or when the time for them was over, were read in the next cycle and stand
  there.
- Between the host's NMT reset and its NMT start only heartbeats count. What came before the reset was thrown away.
- An attempt begins with the reset; nothing of what was before survives it.

Error frames change nothing. Of a cycle whose packet the logger dropped nothing is known, its frames included: from
there on the states may differ until every counter and age has been renewed.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.clock import VirtualClock
from adacd_hil.config import Settings
from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_watch import ArmWatch
from adacd_hil.device.canopen_bus import NMT_ID
from adacd_hil.device.heartbeat import follow_devices
from adacd_hil.device.network import RESET_COMMUNICATION, START
from adacd_hil.device.placement import place_devices
from adacd_hil.records import JOINTS, ArmBatch, ArmState
from adacd_hil.wire.bus import EmbeddedBus, Frame
from adacd_hil.wire.codec import Codec

_Passed = list[tuple[bool, Frame]]
"""Frames in the order of the log, True for sent."""


class Ticks(NamedTuple):
    """The beginnings of n cycles, as columns (n,) of int64.

    `t_ns`: when SYNC went out or came, as all messages of the cycle carry it; so do its frames, as cycle_t_ns.
    `periods`: since the cycle before, 1 unless some were skipped.
    """

    cycle: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    periods: NDArray[np.int64]


class RecordedArm:
    """Turns what a log has of one run into what its arm reported, attempt after attempt.

    `beginnings`: places in the last batch with which an attempt began.
    """

    def __init__(self, settings: Settings, codec: Codec) -> None:
        """Place the devices. Raises ConfigError and CodecError as `Arm`."""
        self.beginnings: list[int] = []
        self._settings, self._codec = settings, codec
        self._is_following = settings.bus.follows
        self._devices = place_devices(settings)
        self._begin()

    def _begin(self) -> None:
        """Begin anew."""
        settings = self._settings
        self._arm = Arm(settings, self._codec, EmbeddedBus(VirtualClock()))  # with nobody on it
        self._heartbeats = follow_devices(self._devices, settings.bus.heartbeat_ms, lambda _: None)
        self._watch = ArmWatch(settings, self._heartbeats.watch)
        self._is_booting = False
        self._is_running = False

    def read(self, ticks: Ticks, frames: NDArray[Any]) -> ArmBatch:
        """Return the states of some cycles, given all frames that were logged with them, before or between them.

        `frames`: FRAME_DTYPE or LONG_FRAME_DTYPE of the log's reader. Consecutive calls take up a run piece by piece;
        what was logged after the last cycle of a piece may come with this call or with the next.
        """
        count = len(ticks.cycle)
        batch = _empty_batch(ticks)
        self.beginnings = []
        cycle_t_ns = np.ascontiguousarray(frames["cycle_t_ns"])
        firsts = np.searchsorted(cycle_t_ns, ticks.t_ns, "left").tolist()
        ends = np.searchsorted(cycle_t_ns, ticks.t_ns, "right").tolist()
        at = 0
        for place in range(count):
            self._pass(_unpack(frames[at : firsts[place]]))
            at = ends[place]
            self._exchange(batch, place, _unpack(frames[firsts[place] : at]))
        self._pass(_unpack(frames[at:]))
        return batch

    def _exchange(self, batch: ArmBatch, place: int, passed: _Passed) -> None:
        """Do what Exchange.read did with the frames of a cycle, and judge the state as the cycle did."""
        cycle, t_ns, periods = (int(column[place]) for column in (batch.cycle, batch.t_ns, batch.periods))
        sync_at = self._find_sync(passed, t_ns)
        self._pass(passed[:sync_at])
        if not self._is_running:  # a log whose beginning was cut off
            self._start()
        arm = self._arm
        if arm.cycle < 0:
            self.beginnings.append(place)
        arm.synchronise(cycle, t_ns, periods)
        for is_sent, frame in passed[sync_at:]:
            if not is_sent:
                self._accept(frame, is_late=frame.t_ns < t_ns)
        _put(batch, place, self._watch.judge(arm.state()))

    def _find_sync(self, passed: _Passed, t_ns: int) -> int:
        """Find SYNC among the frames of a cycle; 0 where it was logged before them."""
        sync_id, is_following = self._arm.sync_id, self._is_following
        places = [
            place
            for place, (is_sent, frame) in enumerate(passed)
            if frame.can_id == sync_id and is_sent != is_following and not frame.is_error
            if is_sent or frame.t_ns == t_ns
        ]
        return places[-1] if places else 0

    def _pass(self, passed: _Passed) -> None:
        """Take frames that came before a SYNC."""
        for is_sent, frame in passed:
            if not is_sent:
                self._accept(frame)
            elif frame.can_id == NMT_ID:
                self._command(frame.data[0])

    def _command(self, nmt_command: int) -> None:
        """Follow what the host told the devices: it does so at the beginning of an attempt and after its end only."""
        if nmt_command == RESET_COMMUNICATION:
            if self._is_running:
                self._begin()
            self._is_booting = True
        elif nmt_command == START and not self._is_running:
            self._start()

    def _start(self) -> None:
        self._heartbeats.start()
        self._is_running = True

    def _accept(self, frame: Frame, is_late: bool = False) -> None:
        if self._is_running and self._arm.accept(frame, is_late):
            return
        if self._is_running or self._is_booting:
            self._heartbeats.accept(frame)


def _unpack(frames: NDArray[Any]) -> _Passed:
    """Turn recorded frames into those of a bus."""
    if not len(frames):
        return []
    size = frames["data"].shape[1]
    data = frames["data"].tobytes()
    names = ("is_tx", "can_id", "length", "t_ns", "is_error")
    columns = zip(*(frames[name].tolist() for name in names), strict=True)
    return [
        (is_sent, Frame(can_id, data[place * size : place * size + length], t_ns, is_error))
        for place, (is_sent, can_id, length, t_ns, is_error) in enumerate(columns)
    ]


def _empty_batch(ticks: Ticks) -> ArmBatch:
    count = len(ticks.cycle)
    return ArmBatch(
        *ticks,
        q=np.empty((count, JOINTS)),
        dq=np.empty((count, JOINTS)),
        tau_J=np.empty((count, JOINTS)),
        age_q=np.empty((count, JOINTS), np.int64),
        age_tau_J=np.empty((count, JOINTS), np.int64),
        is_enabled=np.empty(count, np.bool_),
        is_complete=np.empty(count, np.bool_),
        fault=np.empty(count, np.uint8),
        is_late=np.empty(count, np.bool_),
    )


def _put(batch: ArmBatch, place: int, state: ArmState) -> None:
    columns: tuple[NDArray[Any], ...] = batch
    for column, value in zip(columns, state, strict=True):
        column[place] = value
