"""Rows of the truth: one at every SYNC, and on from the last one, a row per period, where none comes."""

from collections.abc import Callable

import numpy as np

from adacd_hil.records import TRUTH_LAYOUT, Vector

OnTruth = Callable[[int, int, Vector], None]
"""Called with cycle, t_ns of the SYNC frame, and a block by TRUTH_LAYOUT that is valid until the next call."""


class TruthRows:
    """Numbers and stamps the rows of one bench."""

    def __init__(self, fill: Callable[[Vector], None], on_truth: OnTruth | None) -> None:
        """`fill`: fills a block with what is true now."""
        self.on_truth = on_truth
        self.cycle = -1
        """Of the last row, -1 before the first."""
        self.sync_ns = 0
        """The bench's time at the last SYNC."""
        self._fill = fill
        self._block = np.zeros(TRUTH_LAYOUT.size)
        self._stamp_ns = self._sync_stamp_ns = self._sync_cycle = 0

    def tell_sync(self, cycle: int, stamp_ns: int, now_ns: int) -> None:
        """Tell the row of a SYNC at the bench's `now_ns`."""
        self.sync_ns, self._sync_stamp_ns, self._sync_cycle = now_ns, stamp_ns, cycle
        self._tell(cycle, stamp_ns)

    def tell_next(self, period_ns: int) -> None:
        """Tell a row a period after the last one."""
        self._tell(self.cycle + 1, self._stamp_ns + period_ns)

    def tell_overdue(self, periods: int, period_ns: int) -> None:
        """Tell a row so many periods after the last SYNC."""
        self._tell(self._sync_cycle + periods, self._sync_stamp_ns + periods * period_ns)

    def _tell(self, cycle: int, stamp_ns: int) -> None:
        self.cycle, self._stamp_ns = cycle, stamp_ns
        if self.on_truth is not None:
            self._fill(self._block)
            self.on_truth(cycle, stamp_ns, self._block)
