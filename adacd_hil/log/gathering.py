"""The messages of a stretch of a log, gathered by topic: records of fixed size, bus frames, payloads.

Where they go has room for a whole stretch, as much as the one before needed, so that nothing is joined afterwards. A
stretch ends before the first message whose publish time, which is its cycle's, is higher than any before.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.log import compiled_records as compiled
from adacd_hil.log.bus_frames import FRAME_DTYPE, FRAME_TOPICS, LONG_FRAME_DTYPE, copy_frames, is_of_frames
from adacd_hil.log.compiled_records import take, words_of
from adacd_hil.log.mcap.records import MESSAGE_HEAD
from adacd_hil.log.ros_types import CAN_FRAME_DTYPE, FD_FRAME_DTYPE, LOG, is_log
from adacd_hil.log.topic_records import Topic, record_dtype

_FIRST_ROOM = 256
_SPARE = 16
_SMALL_SHARE = 16
"""Records that fill less than this part of the memory get memory of their own, and don't hold on to the whole."""


class Stop(NamedTuple):
    """Where the walk stopped and why: CUT, DEFINITION, UNDEFINED (channel `culprit`) or BROKEN."""

    reason: int
    position: int
    end: int  # of the record there, where it is a definition
    culprit: int


class Gathered(NamedTuple):
    """What a stretch of a log holds, by topic."""

    records: dict[str, NDArray[np.uint8]]  # (n, size of a record): numpy would not copy what no field covers
    frames: NDArray[Any]  # (n,) of FRAME_DTYPE, or of LONG_FRAME_DTYPE where a frame is FD
    payloads: dict[str, list[bytes]]


def _frame_places() -> NDArray[np.int64]:
    """Say where a record has can_id, is_error, length and data: of a short frame, of a long one (2, 4)."""
    rows = []
    for dtype, length in ((CAN_FRAME_DTYPE, "dlc"), (FD_FRAME_DTYPE, "len")):
        fields: Any = record_dtype(dtype).fields
        rows.append([fields[name][1] for name in ("can_id", "is_error", length, "data")])
    return np.array(rows, np.int64)


class Gathering:
    """Gathers what `take` finds, stretch by stretch."""

    def __init__(self, cycles: int, epoch_ns: int, has_frame_records: bool) -> None:
        """Gather at most so many cycles at a time; of frames also the records if `has_frame_records`."""
        self.topics: list[Topic] = []
        self._has_frame_records = has_frame_records
        self._epoch_ns = epoch_ns
        self._frame_places = _frame_places()
        self._state = np.zeros(compiled.STATE, np.int64)
        self._state[compiled.LATEST_NS] = np.iinfo(np.int64).min
        self._state[compiled.MOST_CYCLES] = cycles
        self._slots = np.zeros((0, compiled.SLOT), np.int64)
        self._arena = np.empty(0, np.uint8)
        self._begin()

    @property
    def is_empty(self) -> bool:
        """Whether nothing has been gathered since the latest stretch."""
        return (
            not self._state[compiled.FRAMES] and not self._slots[:, compiled.FILLED].any() and not any(self._payloads)
        )

    def add(self, topic: Topic) -> int:
        """Gather one more topic; return its slot."""
        row = np.zeros(compiled.SLOT, np.int64)
        if topic.dtype is None:
            row[compiled.KIND] = compiled.IS_VARYING
        else:
            fields: Any = topic.dtype.fields
            size = topic.dtype.itemsize
            row[compiled.SIZE] = size
            row[compiled.TAIL] = fields["data"][1] if topic.has_tail else size
            row[compiled.COUNT] = fields["count"][1] if topic.has_tail else 0
            row[compiled.KIND] = self._kind(topic)
            row[compiled.ROOM] = _FIRST_ROOM if row[compiled.KIND] & compiled.IS_RECORDS else 0
        self.topics.append(topic)
        self._payloads.append([])
        self._slots = np.vstack((self._slots, row))
        self._lay_out(self._slots[:, compiled.ROOM].copy())
        return len(self.topics) - 1

    def _kind(self, topic: Topic) -> int:
        if not is_of_frames(topic):
            return compiled.IS_RECORDS
        frames = FRAME_TOPICS[topic.name]
        kind = compiled.IS_FRAME | compiled.IS_SENT * frames.is_tx | compiled.IS_LONG * frames.is_long
        return kind | compiled.IS_RECORDS * self._has_frame_records

    def walk(self, data: NDArray[np.uint8], start: int, end: int, channels: NDArray[np.int64]) -> Iterator[Stop]:
        """Gather the records from `start` to `end` of `data`; stop where something is for the caller to do.

        channels: slot of each channel (65536,), UNKNOWN or UNWANTED.
        """
        words = words_of(data)
        state = self._state
        state[compiled.POSITION] = start
        while True:
            reason = take(
                data,
                words,
                end,
                channels,
                self._slots,
                self._arena,
                self._arena_words,
                self._frames,
                self._frame_words,
                self._frame_dtype.itemsize,
                self._frame_places,
                self._epoch_ns,
                state,
            )
            position = int(state[compiled.POSITION])
            if reason == compiled.DONE:
                return
            if reason == compiled.FULL:
                self._grow()
            elif reason == compiled.FRAMES_FULL:
                self._set_frames(self._frame_dtype, 2 * self._frame_room)
            elif reason == compiled.LONG:
                self._set_frames(LONG_FRAME_DTYPE, self._frame_room)
            elif reason == compiled.VARYING:
                stop = position + compiled.RECORD_HEAD + int(words[position + 1])
                slot = int(state[compiled.CULPRIT])
                payload = data[position + MESSAGE_HEAD : stop].tobytes()
                if self.topics[slot].type_name != LOG.name or is_log(payload):
                    self._payloads[slot].append(payload)
                else:
                    state[compiled.WRONG] += 1
                state[compiled.POSITION] = stop
            elif reason == compiled.BROKEN:
                yield Stop(reason, position, position, 0)
                return
            else:
                stop = position + compiled.RECORD_HEAD + int(words[position + 1])
                yield Stop(int(reason), position, stop, int(state[compiled.CULPRIT]))
                if reason == compiled.DEFINITION:
                    state[compiled.POSITION] = stop

    def take_wrong(self) -> int:
        """Return how many messages weren't as long as their schema says, since it was asked the last time."""
        wrong = int(self._state[compiled.WRONG])
        self._state[compiled.WRONG] = 0
        return wrong

    def end(self) -> Gathered:
        """Return what has been gathered, and begin anew."""
        records = {}
        for topic, row in zip(self.topics, self._slots, strict=True):
            if row[compiled.KIND] & compiled.IS_RECORDS:
                size = int(row[compiled.FILLED] * row[compiled.SIZE])
                rows = self._arena[row[compiled.START] : row[compiled.START] + size]
                is_small = size * _SMALL_SHARE < len(self._arena)
                records[topic.name] = (rows.copy() if is_small else rows).reshape(-1, row[compiled.SIZE])
        frames = self._gathered_frames()
        payloads = {
            topic.name: payloads
            for topic, payloads in zip(self.topics, self._payloads, strict=True)
            if topic.dtype is None
        }
        self._begin()
        return Gathered(records, frames, payloads)

    def _begin(self) -> None:
        """Begin a stretch, with as much room as the one before needed."""
        is_gathered = self._slots[:, compiled.KIND] & compiled.IS_RECORDS > 0
        filled = self._slots[:, compiled.FILLED]
        room = is_gathered * (filled + filled // _SPARE + _SPARE)
        filled[:] = 0
        self._lay_out(room)
        self._payloads: list[list[bytes]] = [[] for _ in self.topics]
        count = int(self._state[compiled.FRAMES])
        self._state[compiled.FRAMES] = 0
        self._state[compiled.CYCLES] = 0
        self._set_frames(FRAME_DTYPE, count + count // _SPARE + _FIRST_ROOM)

    def _grow(self) -> None:
        """Make more room for all topics that will soon need it."""
        room = self._slots[:, compiled.ROOM]
        self._lay_out(np.where(2 * self._slots[:, compiled.FILLED] >= room, 2 * room, room))

    def _lay_out(self, room: NDArray[np.int64]) -> None:
        """Give each topic its place in new memory, for so many records each, and move there what it has."""
        before, arena = self._slots.copy(), self._arena
        sizes = room * self._slots[:, compiled.SIZE]
        self._slots[:, compiled.ROOM] = room
        self._slots[:, compiled.START] = np.cumsum(sizes) - sizes
        self._arena = np.empty(int(sizes.sum()) + compiled.WORD, np.uint8)
        self._arena_words = words_of(self._arena)
        for old, new in zip(before, self._slots, strict=True):
            size = old[compiled.FILLED] * old[compiled.SIZE]
            start = old[compiled.START]
            self._arena[new[compiled.START] : new[compiled.START] + size] = arena[start : start + size]

    def _set_frames(self, dtype: "np.dtype[Any]", room: int) -> None:
        """Hold frames as such a type, with room for so many; keep those that are there."""
        memory = np.empty(room * dtype.itemsize + compiled.WORD, np.uint8)
        count = int(self._state[compiled.FRAMES])
        if count:
            copy_frames(self._gathered_frames(), memory[: count * dtype.itemsize].view(dtype))
        self._frames, self._frame_words = memory, words_of(memory)
        self._frame_dtype, self._frame_room = dtype, room

    def _gathered_frames(self) -> NDArray[Any]:
        size = self._state[compiled.FRAMES] * self._frame_dtype.itemsize
        return self._frames[:size].view(self._frame_dtype)
