"""A stretch of a log: from when until when, s since the beginning of the log, which is its first message."""

import math
from pathlib import Path
from typing import NamedTuple

from adacd_hil.log.errors import LogError
from adacd_hil.log.stream import LogStream

_CENTURY_S = 3.2e9


class Stretch(NamedTuple):
    """[start_s, end_s), s since the beginning of the log; infinite where it is not bounded."""

    start_s: float = float("-inf")
    end_s: float = float("inf")

    @property
    def is_whole(self) -> bool:
        """Whether it bounds nothing."""
        return self == Stretch()

    @property
    def text(self) -> str:
        """Say it as a command is asked for it; nothing of the whole log."""
        words = (("from", self.start_s), ("until", self.end_s))
        return " ".join(f"{word} {bound_s:g} s" for word, bound_s in words if math.isfinite(bound_s))

    def bounds_ns(self, start_ns: int) -> tuple[int, int]:
        """Give its bounds on a clock on which the log begins at `start_ns`."""
        first_ns, end_ns = (start_ns + round(min(max(bound_s, -_CENTURY_S), _CENTURY_S) * 1e9) for bound_s in self)
        return first_ns, end_ns

    def as_json(self) -> dict[str, float | None]:
        """Give its bounds, s; None where it is not bounded."""
        bounds = (("from_s", self.start_s), ("until_s", self.end_s))
        return {name: bound_s if math.isfinite(bound_s) else None for name, bound_s in bounds}


WHOLE = Stretch()
EVER_NS = WHOLE.bounds_ns(0)


def start_of_log(path: Path) -> int | None:
    """Return the time of the first message of a log of ours, ns of the run's clock; None without one. Raises LogError.

    The host's first frames come before its first decisions.
    """
    stream = LogStream(path, cycles_per_piece=1)
    for piece in stream:
        times = [event.t_ns for event in stream.events(piece)[:1]]
        there = [series.records for series in piece.series.values() if len(series)]
        times += [int(records["publish_time"][0]) - stream.epoch_ns for records in there]
        times += piece.frames["cycle_t_ns"][:1].tolist()
        if times:
            return min(times)
    return None


def begin_of_log(path: Path) -> int:
    """Return the time of the first message as `start_of_log`. Raises LogError also when there is none."""
    start_ns = start_of_log(path)
    if start_ns is None:
        raise LogError(f"log {path} has no message")
    return start_ns
