"""Message records and bus frames as numpy arrays: what a log gives, and what recordings of other programs give.

The fields of `LONG_FRAME_DTYPE` come first in `RECORDED_FRAME_DTYPE` and mean the same; what is beyond them is what our
own bus never has: remote frames, 29-bit identifiers below 0x800, FD frames without bit rate switch, several channels.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from adacd_hil.log.mcap.records import MESSAGE_HEAD
from adacd_hil.log.types.message_types import CAN_FRAME, FD_FRAME, MAX_DATA
from adacd_hil.wire.bus import CLASSIC_BYTES, MAX_STANDARD_ID


class Payload(NamedTuple):
    """The layout of a topic's payloads. `has_tail`: they end in bytes, counted by the field `count`, that fill `data`.

    Records of such payloads are padded with zeros to those with the longest tail.
    """

    dtype: "np.dtype[Any]"
    has_tail: bool = False


PayloadLayout = Callable[[Channel, Schema], Payload | None]
"""Describes the payloads of a channel; None where their size varies otherwise."""


def record_dtype(payload: "np.dtype[Any]") -> "np.dtype[Any]":
    """Describe a whole message record with such a payload."""
    assert payload.names is not None
    assert payload.fields is not None
    fields = [payload.fields[name] for name in payload.names]
    layout = {
        "names": ["record_length", "log_time", "publish_time", *payload.names],
        "formats": ["<u8", "<u8", "<u8", *(field[0] for field in fields)],
        "offsets": [1, 15, 23, *(MESSAGE_HEAD + int(field[1]) for field in fields)],
        "itemsize": MESSAGE_HEAD + payload.itemsize,
    }
    return np.dtype(layout)  # type: ignore[call-overload,no-any-return]


class Topic(NamedTuple):
    """A topic of messages."""

    name: str
    type_name: str
    dtype: "np.dtype[Any] | None"  # of its records; None where their size varies
    has_tail: bool

    @classmethod
    def of(cls, name: str, type_name: str, payload: Payload | None) -> "Topic":
        """Describe a topic by its payloads."""
        if payload is None:
            return cls(name, type_name, None, has_tail=False)
        return cls(name, type_name, record_dtype(payload.dtype), payload.has_tail)


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


class FrameTopic(NamedTuple):
    """A topic of frames."""

    type_name: str
    is_tx: bool
    is_long: bool


FRAME_TOPICS = {
    "/to_can_bus": FrameTopic(CAN_FRAME.name, is_tx=True, is_long=False),
    "/from_can_bus": FrameTopic(CAN_FRAME.name, is_tx=False, is_long=False),
    "/to_can_bus_fd": FrameTopic(FD_FRAME.name, is_tx=True, is_long=True),
    "/from_can_bus_fd": FrameTopic(FD_FRAME.name, is_tx=False, is_long=True),
}
"""The topics of frames."""


def is_of_frames(topic: Topic) -> bool:
    """Say whether a topic is one of ours with bus frames."""
    return topic.name in FRAME_TOPICS and FRAME_TOPICS[topic.name].type_name == topic.type_name


def frames_of(records: NDArray[Any], topic: Topic, epoch_ns: int) -> NDArray[Any]:
    """Make frames of the records of a topic of frames; epoch_ns: what their times are less than those of the file."""
    kind = FRAME_TOPICS[topic.name]
    frames = np.empty(len(records), LONG_FRAME_DTYPE if kind.is_long else FRAME_DTYPE)
    frames["t_ns"] = records["sec"].astype(np.int64) * 1_000_000_000 + records["nanosec"] - epoch_ns
    frames["cycle_t_ns"] = records["publish_time"].astype(np.int64) - epoch_ns
    frames["is_tx"] = kind.is_tx
    frames["length"] = records["len" if kind.is_long else "dlc"]
    for name in ("can_id", "is_error", "data"):
        frames[name] = records[name]
    return frames


def joined_frames(pieces: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Join frames in order, as long ones where some are."""
    is_long = any(piece.dtype == LONG_FRAME_DTYPE for piece in pieces)
    dtype = LONG_FRAME_DTYPE if is_long else FRAME_DTYPE
    whole = [_lengthened(piece) if is_long else piece for piece in pieces]
    items = np.concatenate((np.empty(0, _item(dtype)), *(piece.view(_item(dtype)) for piece in whole)))
    return items.view(dtype)


def reordered_frames(frames: NDArray[Any], order: NDArray[np.int64]) -> NDArray[Any]:
    """Put frames into another order."""
    return frames.view(_item(frames.dtype))[order].view(frames.dtype)


def _item(dtype: "np.dtype[Any]") -> str:
    """Name the type of a frame's bytes, which numpy copies as a whole and not field by field."""
    return f"V{dtype.itemsize}"


def _lengthened(frames: NDArray[Any]) -> NDArray[Any]:
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

    channels: tuple[str, ...]  # "" where the recording names none
    frames: NDArray[Any]  # (n,) of RECORDED_FRAME_DTYPE
    epoch_ns: int = 0  # what was added to t_ns for the times in the file
    problem: str = ""  # what is missing, one line; "" for a whole recording


def is_plain(frames: NDArray[Any]) -> NDArray[np.bool_]:
    """Say which frames a bus end of ours can receive (n,): none remote, none of 29 bits that reads as 11-bit."""
    is_as_wide = (frames["can_id"] > MAX_STANDARD_ID) == frames["is_extended"]
    return np.asarray(~frames["is_remote"] & (is_as_wide | frames["is_error"]))


def is_sendable(frames: NDArray[Any]) -> NDArray[np.bool_]:
    """Say which frames a bus end of ours can send as they are (n,): of FD frames those of more than 8 bytes."""
    is_short_fd = frames["is_fd"] & (frames["length"] <= CLASSIC_BYTES)
    return np.asarray(is_plain(frames) & ~frames["is_error"] & ~is_short_fd)


def as_logged(frames: NDArray[Any]) -> NDArray[Any]:
    """Return what a bus end of ours would have received and sent of them, (k,) of LONG_FRAME_DTYPE."""
    chosen = frames[is_plain(frames)]
    logged = np.zeros(len(chosen), LONG_FRAME_DTYPE)
    for name in LONG_FRAME_DTYPE.names or ():
        logged[name] = chosen[name]
    return logged
