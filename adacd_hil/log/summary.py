"""What the end of a log says of it: counts, and why it ended."""

from collections.abc import Mapping

RECOVERED = "recovered"
"""The ending of a recovered log."""
CUT = "cut"
"""The ending of a stretch of a log."""
MERGED = "merged"
"""The ending of several logs in one."""
COPY_ENDINGS = (RECOVERED, CUT, MERGED)
"""The endings of logs that are made of others."""
PLANNED_ENDINGS = ("closed", "continued", *COPY_ENDINGS)
LOST_KEY = "lost"
"""Of the summary of a recovered log: what was lost, in words; missing when nothing was."""
DROPPED_KEY = "dropped"
"""Of the summary: packets that are not in the log."""
_FRAME_TOPICS = {"/to_can_bus", "/from_can_bus", "/to_can_bus_fd", "/from_can_bus_fd"}


def count_frames(topics: Mapping[int, str], counts: Mapping[int, int]) -> int:
    """Count the frames in a file by its channels' topics and their counts of messages."""
    return sum(count for channel, count in counts.items() if topics.get(channel) in _FRAME_TOPICS)


def number(texts: Mapping[str, str], key: str) -> int:
    """Read a count; what isn't one counts as 0."""
    text = texts.get(key, "0")
    return int(text) if text.isdecimal() else 0
