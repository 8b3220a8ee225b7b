"""Frames of the bus as the reader gives them: those of all topics of frames, both ways, in one array."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.log.ros_types import CAN_FRAME, FD_FRAME, MAX_DATA
from adacd_hil.log.topic_records import Topic
from adacd_hil.wire.bus import MAX_CLASSIC_BYTES


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


FRAME_DTYPE = _frame_dtype(MAX_CLASSIC_BYTES)
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


def copy_frames(frames: NDArray[Any], to: NDArray[Any]) -> None:
    """Copy frames to others of their type, or of the longer one."""
    data = frames["data"]
    for name in FRAME_DTYPE.fields or ():
        if name != "data":
            to[name] = frames[name]
    to["data"][:, : data.shape[1]] = data
    to["data"][:, data.shape[1] :] = 0


def joined_frames(pieces: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Join frames in order, as long ones where some are."""
    dtype = LONG_FRAME_DTYPE if any(piece.dtype == LONG_FRAME_DTYPE for piece in pieces) else FRAME_DTYPE
    frames = np.empty(sum(map(len, pieces)), dtype)
    place = 0
    for piece in pieces:
        copy_frames(piece, frames[place : place + len(piece)])
        place += len(piece)
    return frames
