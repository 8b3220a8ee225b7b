"""The messages of a log gathered by topic: records of fixed size, bus frames, payloads; piece by piece.

A piece ends before the first message whose publish time, which is its cycle's, is higher than any before.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.log.bus_frames import frames_of, is_of_frames, joined_frames, reordered_frames
from adacd_hil.log.mcap.chunk_contents import Contents
from adacd_hil.log.ros_types import LOG, is_log
from adacd_hil.log.topic_records import Topic

_SPARE = 16
UNKNOWN, UNWANTED = -1, -2
"""Slots of channels that aren't gathered."""
Numbers = NDArray[np.int64]


class RawPiece(NamedTuple):
    """What a piece of a log holds, by topic."""

    records: dict[str, NDArray[np.uint8]]  # (n, size of a record): numpy would not copy what no field covers
    frames: NDArray[Any]  # (n,) of FRAME_DTYPE, or of LONG_FRAME_DTYPE where a frame is FD
    payloads: dict[str, list[bytes]]


class _Rows:
    """Rows of one size, in memory that has room for as many as were there before."""

    def __init__(self, size: int) -> None:
        self._begin(size, 0)

    def _begin(self, size: int, room: int) -> None:
        self._memory = np.empty((room + room // _SPARE, size), np.uint8)
        self.count = 0

    def add(self, rows: NDArray[np.uint8]) -> None:
        """Add rows."""
        count = self.count + len(rows)
        if count > len(self._memory):
            memory = np.empty((max(count, 2 * len(self._memory)), rows.shape[1]), np.uint8)
            memory[: self.count] = self._memory[: self.count]
            self._memory = memory
        self._memory[self.count : count] = rows
        self.count = count

    def end(self) -> NDArray[np.uint8]:
        """Return all rows, and begin anew."""
        rows = self._memory[: self.count]
        self._begin(rows.shape[1], self.count)
        return rows


class PieceBuilder:
    """Gathers messages; a topic's place in `topics` is its slot."""

    def __init__(self, cycles: int, epoch_ns: int, has_frame_records: bool) -> None:
        """Gather at most so many cycles at a time; of frames also the records if `has_frame_records`."""
        self.topics: list[Topic] = []
        self.wrong = 0
        """Messages that weren't as long as their schema says."""
        self._most_cycles = cycles
        self._epoch_ns = epoch_ns
        self._has_frame_records = has_frame_records
        self._cycles = 0  # of the piece: how often the publish time has risen
        self._latest_ns = np.iinfo(np.int64).min
        self._rows: list[_Rows] = []
        self._payloads: list[list[bytes]] = []
        self._frames: list[NDArray[Any]] = []

    @property
    def is_empty(self) -> bool:
        """Whether nothing has been gathered since the latest piece."""
        return not (self._frames or any(rows.count for rows in self._rows) or any(self._payloads))

    def add_topic(self, topic: Topic) -> int:
        """Gather one more topic; return its slot."""
        self.topics.append(topic)
        self._rows.append(_Rows(topic.dtype.itemsize if topic.dtype is not None else 0))
        self._payloads.append([])
        return len(self.topics) - 1

    def add(self, contents: Contents, messages: slice, slots: NDArray[np.int32]) -> Iterator[RawPiece]:
        """Gather some messages of chunks, and give the pieces that are whole with them. slots (n,): of each message."""
        publish_ns = contents.publish_times[messages].view(np.int64)
        if not len(publish_ns):
            return
        latest_ns = np.maximum.accumulate(np.concatenate(([self._latest_ns], publish_ns)))
        self._latest_ns = int(latest_ns[-1])
        cycles = self._cycles + np.cumsum(publish_ns > latest_ns[:-1])
        start = 0
        while cycles[-1] > self._most_cycles:
            stop = int(np.searchsorted(cycles, self._most_cycles, side="right"))
            self._gather(contents, messages.start + start, slots[start:stop])
            yield self.end()
            cycles -= self._most_cycles
            start = stop
        self._gather(contents, messages.start + start, slots[start:])
        self._cycles = int(cycles[-1])

    def end(self) -> RawPiece:
        """Return what has been gathered, and begin anew."""
        records, payloads = {}, {}
        for topic, rows, texts in zip(self.topics, self._rows, self._payloads, strict=True):
            if topic.dtype is None:
                payloads[topic.name] = texts
            elif self._has_frame_records or not is_of_frames(topic):
                records[topic.name] = rows.end()
        piece = RawPiece(records, joined_frames(self._frames), payloads)
        self._payloads = [[] for _ in self.topics]
        self._frames = []
        return piece

    def _gather(self, contents: Contents, first: int, slots: NDArray[np.int32]) -> None:
        """Gather consecutive messages, of which the first has the number `first`."""
        frames = []
        for slot in np.flatnonzero(np.bincount(slots - UNWANTED)[-UNWANTED:]).tolist():
            topic = self.topics[slot]
            messages = np.flatnonzero(slots == slot) + first
            if topic.dtype is None:
                self._take_payloads(contents, messages, slot)
                continue
            messages, rows = self._take_rows(contents, messages, topic)
            if is_of_frames(topic) and len(rows):
                frames.append((messages, frames_of(rows.view(topic.dtype)[:, 0], topic, self._epoch_ns)))
            if self._has_frame_records or not is_of_frames(topic):
                self._rows[slot].add(rows)
        if frames:
            order = np.argsort(np.concatenate([messages for messages, _ in frames]))
            self._frames.append(reordered_frames(joined_frames([part for _, part in frames]), order))

    def _take_payloads(self, contents: Contents, messages: Numbers, slot: int) -> None:
        is_event = self.topics[slot].type_name == LOG.name
        for message in messages.tolist():
            payload = contents.payload(message)
            if is_event and not is_log(payload):
                self.wrong += 1
            else:
                self._payloads[slot].append(payload)

    def _take_rows(self, contents: Contents, messages: Numbers, topic: Topic) -> tuple[Numbers, NDArray[np.uint8]]:
        """Copy the records of a topic, of those messages that are as long as they must be; return these, too."""
        assert topic.dtype is not None
        sizes = contents.ends[messages] - contents.starts[messages]
        most = topic.dtype.itemsize
        if topic.has_tail:
            fields: Any = topic.dtype.fields
            tails = sizes - fields["data"][1]
            counts = contents.rows(contents.starts[messages] + fields["count"][1], 4).view("<u4")[:, 0]
            is_right = (tails >= 0) & (sizes <= most) & (counts == tails)
        else:
            is_right = sizes == most
        if not is_right.all():
            self.wrong += int(np.count_nonzero(~is_right))
            messages, sizes = messages[is_right], sizes[is_right]
        rows = contents.rows(contents.starts[messages], most)
        if topic.has_tail:
            rows[np.arange(most) >= sizes[:, np.newaxis]] = 0
        return messages, rows
