"""Frames recorded on the bus by another program, as the cycles of a run: candump, BLF, ASC, MF4, or our own log.

A recording has the frames of the bus and their times; a log of ours has the host's decisions too. So the replay orders
a recording as the host would have read it. SYNC begins a cycle, and its counter gives the cycle's number. The host
would have read a frame in the next cycle if it came after all cyclic frames of a cycle, or after the host's wait for
them.

**With a run's log** (`against`) cycles, times and requests are the run's, and all decisions are compared with it; the
frames are the recording's. **Without** one, the configuration's script plays the user; cycles at the end in which the
drives are commanded off are taken for the host's disabling, in which the scheme doesn't run.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.device.arm import FEEDBACK_SHARE
from adacd_hil.device.device_files import place_devices
from adacd_hil.device.drive import DISABLE_CYCLES
from adacd_hil.device.profile import PlacedDevice
from adacd_hil.device.recorded_arm import Ticks
from adacd_hil.log.frames.frame_log import of_one_channel, read_frames
from adacd_hil.log.log_files import LogError
from adacd_hil.log.reader import LogStream, Piece, Series
from adacd_hil.log.types.record_arrays import FRAME_TOPICS, receivable_frames
from adacd_hil.log.types.topics import CYCLE, SCHEME
from adacd_hil.replay.log_source import CycleStretch, LogSource, Part, Places, find_resets
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.contract_frames import SYNC_OVERFLOW
from adacd_hil.wire.time_marks import ANSWERS

_REALTIME: Final = (0.9, 1.1)
"""Median interval of SYNC over the period, of a bus that runs in real time; in lockstep it runs as fast as it can."""
_NOWHERE: Final = np.int64(2**62)


class CanRecording(NamedTuple):
    """A recording in the order in which the host met it.

    frames (m,); owner (m,): number of the cycle in which the host met each, ascending, and below the first one before
    that; since (m,), offset_ns (m,): number of the cycle whose SYNC came before it on the bus, and the time since then.
    number (n,), t_ns (n,): of each SYNC, the cycle and the time. is_realtime: their interval is within `_REALTIME`.
    """

    frames: NDArray[Any]
    owner: Places
    since: Places
    offset_ns: Places
    number: Places
    t_ns: Places
    is_realtime: bool
    problem: str

    def in_time(self, number: Places, t_ns: Places, part: slice) -> NDArray[Any]:
        """Return copies of the frames in the slice `part`, with t_ns and cycle_t_ns on the clock of given cycles.

        number, t_ns (n,): these cycles, ascending, and their times. A cycle that isn't given gets 1 ns more than the
        last given one before it, or 1 ns less than the first. So t_ns may fall where several cycles in a row are
        missing; the order of the frames stays.
        """
        frames = self.frames[part].copy()
        frames["t_ns"] = _time_of(self.since[part], number, t_ns) + self.offset_ns[part]
        frames["cycle_t_ns"] = _time_of(self.owner[part], number, t_ns)
        return frames


def _time_of(wanted: Places, number: Places, t_ns: Places) -> Places:
    """Return the times of the cycles `wanted` (m,), from ascending cycles `number` (n,) and their times `t_ns`.

    A cycle that isn't among them gets 1 ns more than the last one before it, or 1 ns less than the first one.
    """
    place = np.searchsorted(number, wanted)
    is_known = number[np.minimum(place, len(number) - 1)] == wanted
    before = np.where(place > 0, t_ns[np.maximum(place - 1, 0)] + 1, t_ns[0] - 1)
    return np.where(is_known, t_ns[np.minimum(place, len(number) - 1)], before)


def load_recording(path: Path, settings: Settings, codec: Codec) -> CanRecording:
    """Read a recording, and put its frames in the order in which the host would have read them.

    Received frames after all cyclic ones of a cycle, and in real time those after the host's wait, go to the next
    cycle, but for those before an attempt's first SYNC. Of several CAN channels, the one with SYNCs counts; frames that
    a `Bus` doesn't receive are dropped. By the DBC's senders the host's frames count as sent. Raises LogError if it
    can't be read, or has no SYNC with a counter, or SYNCs of two channels; CodecError if the DBC lacks Sync or a
    device's cyclic frame.
    """
    found = read_frames(path)
    sync_id = codec.message("Sync").can_id
    (syncs,) = of_one_channel([found.frames[found.frames["can_id"] == sync_id]], found.channels, path)
    frames = receivable_frames(found.frames[np.isin(found.frames["channel"], syncs["channel"])])
    frames["is_tx"] = np.isin(frames["can_id"], [m.can_id for m in codec.messages.values() if "HOST" in m.senders])
    sync = np.flatnonzero((frames["can_id"] == sync_id) & ~frames["is_error"] & (frames["length"] > 0))
    if sync.size == 0:
        raise LogError(f"{path} has no SYNC (0x{sync_id:03X}) with a counter: nothing says what a cycle is")
    t_ns = frames["t_ns"][sync]
    period_ns = settings.bus.period_ns
    share = float(np.median(np.diff(t_ns))) / period_ns if sync.size > 1 else 1.0
    is_realtime = _REALTIME[0] <= share <= _REALTIME[1]
    number = _unwrap(frames["data"][sync, 0].astype(np.int64), t_ns, period_ns if is_realtime else 0)
    places = np.arange(len(frames))
    before = np.searchsorted(sync, places, side="right") - 1
    since = np.maximum(before, 0)
    offset_ns = frames["t_ns"] - t_ns[since]
    is_after = places > _complete(frames, sync, [codec.message(name).can_id for name in ANSWERS])[since]
    if is_realtime:
        is_after |= offset_ns > FEEDBACK_SHARE * period_ns
    resets = np.searchsorted(find_resets(frames), places, side="right")
    is_boot = resets > resets[sync][since]  # frames before the first SYNC of an attempt are read at once
    is_moved = is_after & ~frames["is_tx"] & (before >= 0) & ~is_boot
    numbers = np.concatenate(([number[0] - 1], number, [number[-1] + 1]))
    owner = numbers[before + 1 + is_moved]
    order = np.argsort(owner, kind="stable")
    return CanRecording(
        frames[order], owner[order], number[since][order], offset_ns[order], number, t_ns, is_realtime, found.problem
    )


def _unwrap(counter: Places, t_ns: Places, period_ns: int) -> Places:
    """Return cycle numbers (n,) from the counters 1…240 of the cycles' SYNCs.

    Equal ones in a row count as one cycle apart. Their times, t_ns, give the turns of the counter in a gap; period_ns
    0: they don't, as in lockstep.
    """
    steps = np.diff(counter) % SYNC_OVERFLOW
    if period_ns:
        periods = np.rint(np.diff(t_ns) / period_ns)
        steps = steps + SYNC_OVERFLOW * np.maximum(np.rint((periods - steps) / SYNC_OVERFLOW), 0).astype(np.int64)
    numbers = np.concatenate(([counter[0] - 1], np.where(steps == 0, 1, steps)))
    return np.asarray(np.cumsum(numbers), np.int64)


def _complete(frames: NDArray[Any], sync: Places, can_ids: list[int]) -> Places:
    """Return for each cycle (n,) the index of the frame that completes its cyclic ones; `_NOWHERE` if one is missing.

    sync: indices of the SYNCs. can_ids: of the cyclic frames.
    """
    ends = np.append(sync[1:], len(frames))
    latest = np.zeros(len(sync), np.int64)
    for can_id in can_ids:
        places = np.append(np.flatnonzero((frames["can_id"] == can_id) & ~frames["is_error"]), _NOWHERE)
        first = places[np.searchsorted(places, sync)]
        latest = np.maximum(latest, np.where(first < ends, first, _NOWHERE))
    return latest


class RecordingAgainstLog(LogSource):
    """A recording's frames in the cycles of a run's log."""

    is_recording = True

    def __init__(self, path: Path, against: Path) -> None:
        """Open a recording and the log of its run, and number the recording's cycles as the run's.

        Raises LogError if one of them can't be read or has no SYNC, or the log has no valid settings or no DBC;
        CodecError for an invalid DBC.
        """
        super().__init__(against)
        recording = load_recording(path, self.settings, self.codec)
        shift = _find_cycle(recording, self.codec, against) - int(recording.number[0])
        self._recording = recording._replace(
            number=recording.number + shift, owner=recording.owner + shift, since=recording.since + shift
        )
        self._recorded = path
        self._given = 0
        self._missing = 0

    def _open(self, with_frames: bool) -> LogStream:  # noqa: ARG002 (the frames are the recording's)
        return super()._open(with_frames=False)

    def _piece(self, piece: Piece) -> Piece:
        """Return a piece of the log with the recording's frames, without the cycles that the recording lacks.

        Count the latter. Call it for all pieces, in the order of the log.
        """
        cycles = piece.series[self._partner]
        number, t_ns = cycles["cycle"].astype(np.int64), cycles.t_ns
        recording = self._recording
        is_there = np.isin(number, recording.number)
        self._missing += int((~is_there).sum())
        series = dict(piece.series)
        for name in (self._partner, SCHEME.name):
            records = series[name].records
            is_known = np.isin(records["publish_time"], cycles.records["publish_time"][is_there])
            series[name] = Series(records[is_known], self._stream.epoch_ns)
        if not is_there.any():
            return piece._replace(series=series, frames=recording.frames[:0])
        end = int(np.searchsorted(recording.owner, number[is_there][-1], side="right"))
        frames = recording.in_time(number[is_there], t_ns[is_there], slice(self._given, end))
        self._given = end
        return piece._replace(series=series, frames=frames)

    def notes(self) -> list[str]:
        """Return the gaps and defects of log and recording that can't be replayed or compared, as lines."""
        notes = super().notes()
        if self._missing:
            notes.insert(0, f"{self._missing} cycles of the run are not in {self._recorded.name}")
        if self._recording.problem:
            notes.insert(0, self._recording.problem)
        return notes


def _find_cycle(recording: CanRecording, codec: Codec, against: Path) -> int:
    """Return the run's number of a recording's first cycle: there the devices' answers are equal, bit for bit.

    The counter gives the cycle except for multiples of 240. If no cycle fits, return the recording's own first number.
    """
    wanted = _answers(recording.frames[recording.owner == recording.number[0]], codec)
    first = int(recording.number[0])
    for piece in LogStream(against, (*FRAME_TOPICS, CYCLE.name)):
        cycles = piece.series[CYCLE.name]
        number, t_ns = cycles["cycle"].astype(np.int64), cycles.t_ns
        for row in np.flatnonzero((number - first) % SYNC_OVERFLOW == 0).tolist():
            ends = np.searchsorted(piece.frames["cycle_t_ns"], (t_ns[row], t_ns[row] + 1))
            if wanted and wanted == _answers(piece.frames[slice(*ends.tolist())], codec):
                return int(number[row])
    return first


def _answers(frames: NDArray[Any], codec: Codec) -> dict[int, bytes]:
    """Return the data of the first cyclic frame of each device, by identifier; a device without one is left out."""
    answers: dict[int, bytes] = {}
    for can_id in (codec.message(name).can_id for name in ANSWERS):
        mine = frames[(frames["can_id"] == can_id) & ~frames["is_error"]]
        if len(mine):
            answers[can_id] = mine["data"][0, : int(mine["length"][0])].tobytes()
    return answers


class RecordingAlone:
    """A recording without a log: its decisions are not compared, and the configuration's script plays the user."""

    has_arms = False
    is_recording = True

    def __init__(self, path: Path, settings: Settings, codec: Codec) -> None:
        """Read the recording. In a recording of a bus in lockstep, samples get the nominal period.

        Raises LogError or CodecError as `load_recording` does.
        """
        self._recording = load_recording(path, settings, codec)
        self._path = path
        self.codec = codec
        self.metadata: Mapping[str, str] = {}
        self.settings = settings
        if not self._recording.is_realtime:
            self.settings = replace(settings, realtime=replace(settings.realtime, sample_period="nominal"))
        self._is_headless = False

    @property
    def start_ns(self) -> int:
        """Time of the first SYNC, ns; where the bus was in lockstep, its cycle's number times the period."""
        return int(self._t_ns()[0])

    def _t_ns(self) -> Places:
        """Return the time of each cycle's SYNC (n,), ns; where the bus was in lockstep, its number times the period."""
        recording = self._recording
        return recording.t_ns if recording.is_realtime else recording.number * self.settings.bus.period_ns

    def devices(self, settings: Settings) -> list[PlacedDevice]:
        """Return the devices that the settings name. Raises ConfigError if one can't be loaded."""
        return place_devices(settings)

    def parts(self, with_frames: bool) -> Iterator[Part]:  # noqa: ARG002 (there are only frames)
        """Yield one part, with a stretch of cycles per attempt.

        The last cycles of an attempt, in which the host disables the drives, are left out. with_frames has no effect:
        the recording has only frames.
        """
        yield Part(list(self._stretches()), {}, ())

    def _stretches(self) -> Iterator[CycleStretch]:
        """Yield the cycles of each attempt, without those at its end that disable the drives.

        An attempt begins with the host's reset of the devices' communication. If the recording has none before its
        first cycle, the first attempt begins with that cycle, and `_is_headless` is set. Attempts with no cycle left
        are skipped.
        """
        recording = self._recording
        number, t_ns = recording.number, self._t_ns()
        frames = recording.in_time(number, t_ns, slice(None))
        resets = find_resets(frames)
        rows = np.searchsorted(number, recording.owner[resets], side="right")
        begins = {row: place for row, place in zip(rows.tolist(), resets.tolist(), strict=True) if row < len(number)}
        self._is_headless = 0 not in begins
        begins.setdefault(0, 0)
        starts = sorted(begins)
        for attempt, (start, end) in enumerate(pairwise([*starts, len(number)])):
            mine = frames[begins[start] : begins.get(end, len(frames))]
            kept = end - _count_disabling_cycles(mine, t_ns[start:end], self.codec)
            if kept > start:
                ticks = Ticks(
                    number[start:kept], t_ns[start:kept], np.diff(number[start:kept], prepend=number[start] - 1)
                )
                yield CycleStretch(
                    attempt=attempt,
                    is_begin=True,
                    is_exact=False,
                    ticks=ticks,
                    frames=mine,
                    arms=None,
                    requests=None,
                    scheme=None,
                )

    def notes(self) -> list[str]:
        """Return the defects of the recording that can't be replayed, a line each; call it after `parts`."""
        notes = [self._recording.problem] if self._recording.problem else []
        if self._is_headless:
            notes.append(f"{self._path.name} begins in the middle of a run: the scheme begins with INIT there")
        return notes


def _count_disabling_cycles(frames: NDArray[Any], t_ns: Places, codec: Codec) -> int:
    """Return how many cycles at the end of an attempt command no drive on, at most DISABLE_CYCLES.

    Cycles without a command frame count, too. t_ns: of the attempt's cycles (n,).
    """
    commands = [codec.message(name) for name in ("Drive1Command", "Drive2Command")]
    for count, cycle_ns in enumerate(t_ns[: -DISABLE_CYCLES - 1 : -1].tolist()):
        for message in commands:
            is_mine = (frames["cycle_t_ns"] == cycle_ns) & (frames["can_id"] == message.can_id)
            at = [signal.name for signal in message.signals].index("controlword")
            data = [row[: message.length].tobytes() for row in frames["data"][is_mine]]
            if any(message.decode(each)[at] for each in data):
                return count
    return min(DISABLE_CYCLES, len(t_ns))
