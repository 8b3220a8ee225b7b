"""Frames of the bus as the reader gives them: those of all topics of frames, both ways, in one array."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.log.ros_types import CAN_FRAME, FD_FRAME, MAX_DATA
from adacd_hil.log.topic_records import Topic
from adacd_hil.wire.bus import CLASSIC_BYTES


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
