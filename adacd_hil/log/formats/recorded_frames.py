"""Frames as recordings have them, in arrays: all that any of the formats knows of a frame.

The fields of `bus_frames.LONG_FRAME_DTYPE` come first and mean the same; what is beyond them is what our own bus never
has: remote frames, 29-bit identifiers below 0x800, FD frames without bit rate switch, several channels.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.log.bus_frames import LONG_FRAME_DTYPE
from adacd_hil.wire.bus import CLASSIC_BYTES, MAX_STANDARD_ID

MOST_NS = 1 << 62
"""Of a time, either way: the year 2116."""
MOST_CHANNELS = 256
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
