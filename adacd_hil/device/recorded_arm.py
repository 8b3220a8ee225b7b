"""The arm from recorded frames: the ArmState of each cycle, as the live loop had it before the scheme's step.

A log has every frame in the order in which the host took or sent it, and with it the time of the cycle that it was
logged with. That is all that the live loop went by:

- SYNC is the host's own where it sends it; where it follows another host's, the last one received with the time of the
  cycle. That one may have been logged with the cycle before, as its last frame.
- What was received before SYNC was taken for the cycle before, whatever its stamp.
- What was received after SYNC came for that SYNC or an earlier one, for an earlier one where its stamp is older than
  SYNC: `answer_clock`. Frames that came once all cyclic ones were in, or when the time for them was over, were read in
  the next cycle and stand there.
- Before the host's NMT start nothing counts: a heartbeat of before it says no more than none.
- An attempt begins with the host's NMT reset; nothing of what was before survives it.

Error frames change nothing. Of a cycle whose packet the logger dropped nothing is known, its frames included: from
there on the states may differ until every counter and age has been renewed.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.clock import VirtualClock
from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_watch import ArmWatch, follow_devices
from adacd_hil.device.network import RESET_COMMUNICATION, START
from adacd_hil.device.ordinary_cycles import FrameColumns, NotOrdinaryError, OrdinaryCycles, columns_of
from adacd_hil.device.profile import place_devices
from adacd_hil.records import JOINTS, ArmBatch, ArmState
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import EmbeddedBus, Frame
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.contract_frames import NMT_ID

_Passed = list[tuple[bool, Frame]]
"""Frames in the order of the log, True for sent."""


class Ticks(NamedTuple):
    """The beginnings of n cycles, as columns (n,) of int64.

    `t_ns`: when SYNC went out or came, as all messages of the cycle carry it; so do its frames, as cycle_t_ns.
    `periods`: since the cycle before, 1 unless some were skipped; the pause before an attempt counts for none.
    """

    cycle: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    periods: NDArray[np.int64]


class RecordedArm:
    """Turns what a log has of one run into what its arm reported, attempt after attempt.

    `beginnings`: places in the last batch with which an attempt began. `exact_cycles`: how many cycles so far went
    through the live classes; the others were read at once.
    """

    def __init__(self, settings: Settings, codec: Codec) -> None:
        """Place the devices. Raises ConfigError and CodecError as `Arm`."""
        self.beginnings: list[int] = []
        self.exact_cycles = 0
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
        self._ordinary = self._make_ordinary()
        self._state: ArmState | None = None
        self._is_running = False

    def read(self, ticks: Ticks, frames: NDArray[Any]) -> ArmBatch:
        """Return the states of some cycles, given all frames that were logged with them, before or between them.

        `frames`: FRAME_DTYPE or LONG_FRAME_DTYPE of the log's reader. Consecutive calls take up a run piece by piece;
        what was logged after the last cycle of a piece may come with this call or with the next.
        """
        batch = _empty_batch(ticks)
        self.beginnings = []
        columns = columns_of(frames)
        at = place = 0
        while place < len(batch.cycle):
            cycles, at = self._skip(batch, place, columns, at)
            place += cycles
            first, end = self._find(columns, at, int(batch.t_ns[place]))
            self._pass(_unpack(columns, at, first))
            self._exchange(batch, place, _unpack(columns, first, end))
            at = end
            place += 1
        self._pass(_unpack(columns, at, len(frames)))
        return batch

    @staticmethod
    def _find(columns: FrameColumns, at: int, t_ns: int) -> tuple[int, int]:
        """Find the frames of a cycle, from `at` on: where they begin and end."""
        rest = columns.cycle_t_ns[at:]
        first, end = np.searchsorted(rest, t_ns, "left"), np.searchsorted(rest, t_ns, "right")
        return at + int(first), at + int(end)

    def _make_ordinary(self) -> OrdinaryCycles | None:
        """Make what reads ordinary cycles at once, where that is possible."""
        try:
            return OrdinaryCycles(self._settings, self._arm, self._heartbeats)
        except NotOrdinaryError:
            return None

    def _skip(self, batch: ArmBatch, place: int, columns: FrameColumns, at: int) -> tuple[int, int]:
        """Read ordinary cycles at once, as many as there are; return how many of them the live classes can do without.

        Also return where the next frames begin. The last cycle that is ordinary goes through the live classes, so that
        these stand where they would stand had they taken all.
        """
        if self._ordinary is None or self._state is None:
            return 0, at
        stretch = self._ordinary.read(batch, place, columns, at, self._state)
        skipped = stretch.cycles - 1
        if skipped <= 0:
            return 0, at
        last = place + skipped - 1
        self._arm.pass_by(skipped, int(batch.cycle[last]), int(batch.t_ns[last]))
        for news, cycle in stretch.news:
            ((_, frame),) = _unpack(columns, news, news + 1)
            if not self._arm.accept_past(frame, cycle):
                self._heartbeats.accept(frame)
        return skipped, stretch.last

    def _exchange(self, batch: ArmBatch, place: int, passed: _Passed) -> None:
        """Do what Exchange.read did with the frames of a cycle, and judge the state as the cycle did."""
        t_ns = int(batch.t_ns[place])
        sync_at = self._find_sync(passed, t_ns)
        self._pass(passed[:sync_at])
        if not self._is_running:  # a log whose beginning was cut off
            self._start()
        arm = self._arm
        if arm.cycle < 0:
            self.beginnings.append(place)
        arm.synchronise(int(batch.cycle[place]), t_ns, int(batch.periods[place]))
        for is_sent, frame in passed[sync_at:]:
            if not is_sent:
                self._accept(frame, is_late=frame.t_ns < t_ns)
        self._state = self._watch.judge(arm.state())
        self.exact_cycles += 1
        _put(batch, place, self._state)

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
            elif frame.can_id == NMT_ID and frame.data:
                self._command(frame.data[0])

    def _command(self, nmt_command: int) -> None:
        """Follow what the host told the devices: it does so at the beginning of an attempt and after its end only."""
        if nmt_command == RESET_COMMUNICATION and self._is_running:
            self._begin()
        elif nmt_command == START and not self._is_running:
            self._start()

    def _start(self) -> None:
        self._heartbeats.start()
        self._is_running = True

    def _accept(self, frame: Frame, is_late: bool = False) -> None:
        if self._is_running and not self._arm.accept(frame, is_late):
            self._heartbeats.accept(frame)


def _unpack(columns: FrameColumns, first: int, end: int) -> _Passed:
    """Turn some recorded frames into those of a bus."""
    if first == end:
        return []
    t_ns, _, can_id, is_tx, is_error, length, data = (column[first:end] for column in columns)
    return [
        (was_sent, Frame(identifier, payload[:size].tobytes(), stamp_ns, is_wrong))
        for was_sent, identifier, payload, size, stamp_ns, is_wrong in zip(
            is_tx.tolist(), can_id.tolist(), data, length.tolist(), t_ns.tolist(), is_error.tolist(), strict=True
        )
    ]


def _empty_batch(ticks: Ticks) -> ArmBatch:
    count = len(ticks.cycle)
    return ArmBatch(
        cycle=np.array(ticks.cycle, np.int64),
        t_ns=np.array(ticks.t_ns, np.int64),
        periods=np.array(ticks.periods, np.int64),
        q=np.empty((count, JOINTS)),
        dq=np.empty((count, JOINTS)),
        tau_J=np.empty((count, JOINTS)),
        age_q=np.empty((count, JOINTS), np.int64),
        age_tau_J=np.empty((count, JOINTS), np.int64),
        is_enabled=np.empty(count, np.bool_),
        is_complete=np.empty(count, np.bool_),
        fault=np.empty(count, np.uint8),
        is_late=np.empty(count, np.bool_),
        steps=np.empty(count, np.int64),
        sampled_ns=np.empty(count, np.int64),
    )


def _put(batch: ArmBatch, place: int, state: ArmState) -> None:
    columns: tuple[NDArray[Any], ...] = batch
    for column, value in zip(columns, state, strict=True):
        column[place] = value
