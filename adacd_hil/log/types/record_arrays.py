"""Message records and bus frames as numpy arrays, of our logs and of other programs' recordings.

The fields of `LONG_FRAME_DTYPE` come first in `RECORDED_FRAME_DTYPE` and mean the same; its other fields are for frames
that our own bus never has: remote frames, 29-bit identifiers below 0x800, FD frames without bit rate switch, several
channels.
Messages are gathered by topic, piece by piece. A piece ends before the first message whose publish time, which is its
cycle's, is higher than any before.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.log.types.message_types import FD_FRAME, LOG, MAX_DATA
from adacd_hil.log.types.topics import FROM_CAN_BUS, FROM_CAN_BUS_FD, TO_CAN_BUS, TO_CAN_BUS_FD
from adacd_hil.log.types.unpacking import is_log
from adacd_hil.records import Vector
from adacd_hil.wire.frame_lengths import CLASSIC_BYTES, MAX_STANDARD_ID

if TYPE_CHECKING:
    from adacd_hil.log.mcap.chunks import Contents


_MOST_SMALL = 1 << 15
"""Topics whose slots go into 16 bits."""
UNKNOWN, UNWANTED = -1, -2
"""Slots of channels that aren't gathered."""


class Topic(NamedTuple):
    """A topic of messages."""

    name: str
    type_name: str
    dtype: "np.dtype[Any] | None"  # of its records; None where their size varies

    @property
    def has_tail(self) -> bool:
        """Whether the topic is of FD frames, whose payloads end after as many bytes of `data` as their `count`.

        Their records are padded with zeros.
        """
        return self.type_name == FD_FRAME.name


def _frame_dtype(data_bytes: int) -> "np.dtype[Any]":
    return np.dtype(
        [
            ("t_ns", np.int64),  # when it passed
            ("cycle_t_ns", np.int64),  # t_ns of the cycle that it was logged with
            ("can_id", np.uint32),
            ("is_tx", np.bool_),
            ("is_error", np.bool_),
            ("length", np.uint8),  # so many bytes of the data count, the rest is zero
            ("data", np.uint8, (data_bytes,)),
        ]
    )


FRAME_DTYPE = _frame_dtype(CLASSIC_BYTES)
"""A frame of a log without FD frames."""
LONG_FRAME_DTYPE = _frame_dtype(MAX_DATA)
"""A frame of a log with FD frames, classic ones too: `data` (64,). All else is as in the other."""


SENT = TO_CAN_BUS.name.removeprefix("/")
"""In the names of topics of sent frames."""
FRAME_TOPICS = {
    topic.name: topic.channel().type.name for topic in (TO_CAN_BUS, FROM_CAN_BUS, TO_CAN_BUS_FD, FROM_CAN_BUS_FD)
}
"""The topics of frames and their types."""


def is_of_frames(topic: Topic) -> bool:
    """Return whether a topic has the name and the type of one of ours with bus frames."""
    return FRAME_TOPICS.get(topic.name) == topic.type_name


def frames_of(records: NDArray[Any], topic: Topic, epoch_ns: int) -> NDArray[Any]:
    """Convert the records of a topic of bus frames to frames (n,) of FRAME_DTYPE, or LONG_FRAME_DTYPE for FD frames.

    epoch_ns: subtracted from the file's times.
    """
    frames = np.empty(len(records), LONG_FRAME_DTYPE if topic.has_tail else FRAME_DTYPE)
    fill_times(frames, records, epoch_ns)
    frames["is_tx"] = SENT in topic.name
    for name in ("can_id", "length", "is_error", "data"):
        frames[name] = records[name]
    return frames


def fill_times(frames: NDArray[Any], records: NDArray[Any], epoch_ns: int) -> None:
    """Set t_ns and cycle_t_ns of frames (n,), in place, to the stamps and publish times of records (n,).

    epoch_ns: subtracted from the file's times.
    """
    frames["t_ns"] = records["sec"].astype(np.int64) * 1_000_000_000 + records["nanosec"] - epoch_ns
    frames["cycle_t_ns"] = records["publish_time"].astype(np.int64) - epoch_ns


def joined_frames(pieces: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return frames joined in the given order, of LONG_FRAME_DTYPE if any of the arrays is, else of FRAME_DTYPE."""
    is_long = any(piece.dtype == LONG_FRAME_DTYPE for piece in pieces)
    dtype = LONG_FRAME_DTYPE if is_long else FRAME_DTYPE
    whole = [_lengthened(piece) if is_long else piece for piece in pieces]
    items = np.concatenate((np.empty(0, _item(dtype)), *(piece.view(_item(dtype)) for piece in whole)))
    return items.view(dtype)


def reordered_frames(frames: NDArray[Any], order: NDArray[np.int64]) -> NDArray[Any]:
    """Return frames in another order; order: their indices (n,)."""
    return frames.view(_item(frames.dtype))[order].view(frames.dtype)


def _item(dtype: "np.dtype[Any]") -> str:
    """Return the numpy type of a frame's bytes, which numpy copies as a whole and not field by field."""
    return f"V{dtype.itemsize}"


def _lengthened(frames: NDArray[Any]) -> NDArray[Any]:
    """Return frames as LONG_FRAME_DTYPE, their data padded with zeros; the same array if they are of that type."""
    if frames.dtype == LONG_FRAME_DTYPE:
        return frames
    long = np.zeros(len(frames), LONG_FRAME_DTYPE)
    for name in FRAME_DTYPE.names or ():
        if name != "data":
            long[name] = frames[name]
    long["data"][:, :CLASSIC_BYTES] = frames["data"]
    return long


MOST_NS = 1 << 62
"""Of a time, either way: the year 2116."""
MOST_CHANNELS = 256
PIECE_FRAMES = 10_000
"""Frames that a reader of recordings gives at a time."""
RECORDED_FRAME_DTYPE = np.dtype(
    [
        *LONG_FRAME_DTYPE.descr,  # `length` of a remote frame is its DLC, and its data are zero
        ("channel", np.uint16),  # index of its name
        ("is_extended", np.bool_),
        ("is_remote", np.bool_),
        ("is_fd", np.bool_),
        ("has_rate_switch", np.bool_),  # BRS
        ("has_error_state", np.bool_),  # ESI
    ]
)
"""A recorded frame."""


class FrameLog(NamedTuple):
    """The frames of a recording, in its order."""

    channels: tuple[str, ...]  # "" where the recording gives no name
    frames: NDArray[Any]  # (n,) of RECORDED_FRAME_DTYPE
    epoch_ns: int = 0  # offset from t_ns to the times in the file
    problem: str = ""  # defect, one line; "" for a whole recording


def is_plain(frames: NDArray[Any]) -> NDArray[np.bool_]:
    """Return for each frame (n,) whether a `Bus` receives it.

    It does not receive remote frames, nor frames with a 29-bit identifier up to 0x7FF. It receives error frames with
    any identifier.
    """
    is_as_wide = (frames["can_id"] > MAX_STANDARD_ID) == frames["is_extended"]
    return np.asarray(~frames["is_remote"] & (is_as_wide | frames["is_error"]))


def is_sendable(frames: NDArray[Any]) -> NDArray[np.bool_]:
    """Return for each frame (n,) whether a bus end of ours can send it.

    Error frames, FD frames of up to 8 bytes and frames that are not plain, see `is_plain`, can't be sent. An FD frame
    that was recorded without bit rate switch counts as sendable, but is sent with it.
    """
    is_short_fd = frames["is_fd"] & (frames["length"] <= CLASSIC_BYTES)
    return np.asarray(is_plain(frames) & ~frames["is_error"] & ~is_short_fd)


def receivable_frames(frames: NDArray[Any]) -> NDArray[Any]:
    """Return the frames that a bus end of ours could receive, see `is_plain`, as (k,) of LONG_FRAME_DTYPE."""
    chosen = frames[is_plain(frames)]
    logged = np.zeros(len(chosen), LONG_FRAME_DTYPE)
    for name in LONG_FRAME_DTYPE.names or ():
        logged[name] = chosen[name]
    return logged


Numbers = NDArray[np.int64]


_NOT_FIELDS = ("record_length", "log_time", "publish_time", "sec", "nanosec")


class Series:
    """The messages of one topic: `series["tau_J"]` is float64 (n, 2), a copy; a field of one number is (n,).

    `series[name]` raises KeyError for an unknown field.
    """

    def __init__(self, records: NDArray[Any], epoch_ns: int) -> None:
        self.records = records
        """The records as they are in the file (n,), structured."""
        self._epoch_ns = epoch_ns

    def __len__(self) -> int:
        return len(self.records)

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the fields, without the times."""
        return tuple(name for name in self.records.dtype.names or () if name not in _NOT_FIELDS)

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self.fields:
            raise KeyError(f"no field {name!r}; there are {', '.join(self.fields)}")
        return self.records[name].copy()

    @property
    def t_ns(self) -> NDArray[np.int64]:
        """Time of each message (n,), ns, on the clock of the run."""
        stamp_ns = self.records["sec"].astype(np.int64) * 1_000_000_000 + self.records["nanosec"]
        return np.asarray(stamp_ns - self._epoch_ns, np.int64)

    def part(self, rows: slice | NDArray[np.bool_]) -> "Series":
        """Return the messages in a slice, or those where a mask (n,) is True."""
        return Series(self.records[rows], self._epoch_ns)

    def between(self, first_ns: int, end_ns: int) -> "Series":
        """Return the messages with times from `first_ns` on and before `end_ns`, ns on the clock of the run."""
        t_ns = self.t_ns
        return self.part((t_ns >= first_ns) & (t_ns < end_ns))

    @property
    def block(self) -> Vector:
        """Bytes of each message from the first float64 field on, read as float64 (n, k); (n, 0) without such a field.

        In /scheme and /control that is the logged block. Fields of other types behind it become meaningless numbers, or
        raise ValueError.
        """
        fields: Mapping[str, Any] = self.records.dtype.fields or {}
        offsets = [int(fields[name][1]) for name in self.fields if fields[name][0].base == np.dtype("<f8")]
        if not offsets:
            return np.empty((len(self), 0))
        rows = np.ascontiguousarray(self.records).view(np.uint8).reshape(len(self), self.records.dtype.itemsize)
        return rows[:, min(offsets) :].copy().view(np.float64)


class Piece(NamedTuple):
    """A stretch of a log that ends with whole cycles: consecutive pieces have all of it, in the order of the file.

    The records of a cycle are those with one publish time, one after the other in the file. An event that happens
    between two cycles counts as one.
    """

    series: Mapping[str, Series]
    """Requested topics of fixed size without those of bus frames; of a stream our own ones even when empty."""
    frames: NDArray[Any]
    """(n,) of FRAME_DTYPE, or LONG_FRAME_DTYPE in a piece with FD frames; both ways, in the order of the bus."""
    payloads: Mapping[str, list[bytes]]
    """Requested topics of varying size, such as /events."""


class PieceBuilder:
    """Gathers messages by topic, until a piece has enough cycles. The slot of a topic is its index in `topics`."""

    def __init__(self, cycles: int, epoch_ns: int) -> None:
        """Gather pieces of at most `cycles` cycles; epoch_ns: offset of the times in the file from t_ns."""
        self.topics: list[Topic] = []
        self.wrong = 0
        """Messages that weren't as long as their schema says."""
        self._most_cycles = cycles
        self._epoch_ns = epoch_ns
        self._cycles = 0  # of the piece: how often the publish time has risen
        self._latest_ns = np.iinfo(np.int64).min
        self._rows: list[list[NDArray[np.uint8]]] = []  # (n, size of a record): numpy copies no bytes outside of fields
        self._payloads: list[list[bytes]] = []
        self._frames: list[NDArray[Any]] = []

    @property
    def is_empty(self) -> bool:
        """Whether no message has been gathered since the latest piece."""
        return not (self._frames or any(self._rows) or any(self._payloads))

    def add_topic(self, topic: Topic) -> int:
        """Add a topic whose messages are gathered; return its slot."""
        self.topics.append(topic)
        self._rows.append([])
        self._payloads.append([])
        return len(self.topics) - 1

    def add_messages(self, contents: "Contents", messages: slice, slots: NDArray[np.int32]) -> Iterator[Piece]:
        """Gather consecutive messages of chunks; yield each piece that is full.

        messages: which of `contents`. slots (n,): index in `topics` for each message; UNWANTED: it is skipped.
        """
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
            yield self.take_piece()
            cycles -= self._most_cycles
            start = stop
        self._gather(contents, messages.start + start, slots[start:])
        self._cycles = int(cycles[-1])

    def take_piece(self) -> Piece:
        """Return what has been gathered since the last piece, and begin a new piece."""
        series, payloads = {}, {}
        for topic, rows, texts in zip(self.topics, self._rows, self._payloads, strict=True):
            if topic.dtype is None:
                payloads[topic.name] = texts
            elif not is_of_frames(topic):
                whole = np.concatenate((np.empty((0, topic.dtype.itemsize), np.uint8), *rows))
                series[topic.name] = Series(whole.view(topic.dtype)[:, 0], self._epoch_ns)
                rows.clear()
        piece = Piece(series, joined_frames(self._frames), payloads)
        self._payloads = [[] for _ in self.topics]
        self._frames = []
        return piece

    def _gather(self, contents: "Contents", first: int, slots: NDArray[np.int32]) -> None:
        """Sort consecutive messages into their topics, and count in `wrong` those of another length than their type.

        first: the index of the first one in `contents`. slots (n,): as for `add_messages`.
        """
        small = slots.astype(np.int16) if len(self.topics) < _MOST_SMALL else slots
        order = np.argsort(small, kind="stable")  # of 16 bits a radix sort
        messages = order + first
        starts, ends = contents.starts[messages], contents.ends[messages]
        bounds = np.cumsum(np.bincount(slots - UNWANTED, minlength=-UNWANTED)[: -UNWANTED + len(self.topics)])
        frames = []
        for slot in np.flatnonzero(np.diff(bounds[-UNWANTED - 1 :])).tolist():
            own = slice(*bounds[slot - UNWANTED - 1 : slot - UNWANTED + 1])
            topic = self.topics[slot]
            if topic.dtype is None:
                self._take_payloads(contents, messages[own], slot)
                continue
            is_right, rows = _rows_of(contents, starts[own], ends[own] - starts[own], topic)
            self.wrong += own.stop - own.start - len(rows)
            if not is_of_frames(topic):
                self._rows[slot].append(rows)
            elif len(rows):
                places = order[own] if is_right is None else order[own][is_right]
                frames.append((places, frames_of(rows.view(topic.dtype)[:, 0], topic, self._epoch_ns)))
        if frames:
            sequence = np.argsort(np.concatenate([places for places, _ in frames]))
            self._frames.append(reordered_frames(joined_frames([part for _, part in frames]), sequence))

    def _take_payloads(self, contents: "Contents", messages: Numbers, slot: int) -> None:
        """Gather the payloads of a topic of varying size; count an event that can't be unpacked in `wrong`."""
        is_event = self.topics[slot].type_name == LOG.name
        for message in messages.tolist():
            payload = contents.payload(message)
            if is_event and not is_log(payload):
                self.wrong += 1
            else:
                self._payloads[slot].append(payload)


def _rows_of(
    contents: "Contents", starts: Numbers, sizes: Numbers, topic: Topic
) -> tuple[NDArray[np.bool_] | None, NDArray[np.uint8]]:
    """Return which of a topic's messages have the right length (n,), None: all; and the records of these (k, size).

    starts, sizes (n,): of the messages, in the bytes of `contents`.
    """
    assert topic.dtype is not None
    most = topic.dtype.itemsize
    is_right = sizes == most
    if topic.has_tail:
        fields: Any = topic.dtype.fields
        tails = sizes - fields["data"][1]
        counts = contents.rows(starts + fields["count"][1], 4).view("<u4")[:, 0]
        is_right = (tails >= 0) & (sizes <= most) & (counts == tails)
    if is_all := bool(is_right.all()):
        rows = contents.rows(starts, most)
    else:
        rows, sizes = contents.rows(starts[is_right], most), sizes[is_right]
    if topic.has_tail:
        rows[np.arange(most) >= sizes[:, np.newaxis]] = 0
    return None if is_all else is_right, rows
