"""The first frames of a queue of received ones."""

from collections import deque

from adacd_hil.wire.bus import Frame


def take_first(received: deque[Frame], most: int) -> list[Frame]:
    """Remove up to `most` frames from a queue and return them: none behind an error frame, and an error frame alone."""
    frames: list[Frame] = []
    while received and len(frames) < most:
        if received[0].is_error:
            return frames or [received.popleft()]
        frames.append(received.popleft())
    return frames
