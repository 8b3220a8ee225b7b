"""Windows of time in a log, in s since the beginning of the log, its first message."""

import math
from typing import NamedTuple

_CENTURY_S = 3.2e9


class TimeWindow(NamedTuple):
    """A stretch of a log, [start_s, end_s), s since its beginning; infinite where it is not bounded."""

    start_s: float = float("-inf")
    end_s: float = float("inf")

    @property
    def is_whole(self) -> bool:
        """Whether the window has neither begin nor end, so that it is the whole log."""
        return self == TimeWindow()

    @property
    def text(self) -> str:
        """The window in a command's words, such as "from 3 s until 5 s"; "" for the whole log."""
        words = (("from", self.start_s), ("until", self.end_s))
        return " ".join(f"{word} {bound_s:g} s" for word, bound_s in words if math.isfinite(bound_s))

    def bounds_ns(self, start_ns: int) -> tuple[int, int]:
        """Return begin and end of the window, ns; start_ns: the time of the log's first message, on the same clock.

        An infinite bound is `_CENTURY_S` away.
        """
        first_ns, end_ns = (start_ns + round(min(max(bound_s, -_CENTURY_S), _CENTURY_S) * 1e9) for bound_s in self)
        return first_ns, end_ns

    @property
    def named_bounds(self) -> dict[str, float]:
        """Begin and end of the window, s, as `from_s` and `until_s`, the names in results; infinite without a bound."""
        return {"from_s": self.start_s, "until_s": self.end_s}


WHOLE = TimeWindow()
EVER_NS = WHOLE.bounds_ns(0)
