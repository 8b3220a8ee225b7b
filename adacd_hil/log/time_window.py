"""A window of time in a log: from when until when, s since the beginning of the log, its first message."""

import math
from typing import NamedTuple

_CENTURY_S = 3.2e9


class TimeWindow(NamedTuple):
    """[start_s, end_s), s since the beginning of the log; infinite where it is not bounded."""

    start_s: float = float("-inf")
    end_s: float = float("inf")

    @property
    def is_whole(self) -> bool:
        """Whether it bounds nothing."""
        return self == TimeWindow()

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


WHOLE = TimeWindow()
EVER_NS = WHOLE.bounds_ns(0)
