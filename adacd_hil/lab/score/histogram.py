"""Histograms of times: their bins, and bars as text."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.score.distribution import Values

BINS_PER_DECADE = 20


DECADES = 6
"""Of a histogram with logarithmic bins, from 1 on: of times in µs up to 1 s."""


_BAR = 40


class LogHistogram(NamedTuple):
    """Counts (n,) of values in bins of equal width on a logarithmic axis, between `edges` (n + 1,).

    below: values less than the first edge, negative ones too. above: values from the last edge on.
    """

    edges: NDArray[np.float64]
    counts: NDArray[np.int64]
    below: int
    above: int

    def joined(self, other: "LogHistogram") -> "LogHistogram":
        """Return the sum of this histogram and another one with the same bins."""
        return LogHistogram(self.edges, self.counts + other.counts, self.below + other.below, self.above + other.above)

    def trimmed(self) -> "LogHistogram":
        """Return the histogram without the empty bins at both ends."""
        filled = np.flatnonzero(self.counts)
        first, end = (int(filled[0]), int(filled[-1]) + 1) if filled.size else (0, 0)
        return self._replace(edges=self.edges[first : end + 1], counts=self.counts[first:end])


def log_histogram(values: Values) -> LogHistogram:
    """Return a histogram of values in logarithmic bins from 1 on; a value on an edge belongs to the upper bin."""
    edges = np.logspace(0.0, DECADES, BINS_PER_DECADE * DECADES + 1)
    places = np.bincount(np.searchsorted(edges, values, side="right"), minlength=edges.size + 1)
    return LogHistogram(edges, places[1:-1], int(places[0]), int(places[-1]))


def doubling_bins(values: Values, first: float, count: int) -> list[tuple[float, int]]:
    """Return upper bound and number of values of each bin: below first, 2 first, 4 first, …; the last bound is inf.

    count: largest number of bins. Empty bins at the end are left out.
    """
    bounds = [first * 2.0**power for power in range(count - 1)] + [float("inf")]
    places = np.searchsorted(bounds, values, side="right")
    counts = np.bincount(places, minlength=count)
    bins = [(bound, int(amount)) for bound, amount in zip(bounds, counts, strict=True)]
    while len(bins) > 1 and bins[-1][1] == 0:
        bins.pop()
    return bins


def bar_chart(labels: Sequence[str], counts: Sequence[int]) -> list[str]:
    """Return one line of text per bin: label, bar, count, share. A bin that isn't empty has a bar."""
    total, largest = sum(counts), max(counts, default=0)
    width = max((len(label) for label in labels), default=0)
    lines = []
    for label, count in zip(labels, counts, strict=True):
        bar = "#" * max(round(_BAR * count / largest), 1) if count else ""
        share = f"{100.0 * count / total:.2f} %" if total else ""
        lines.append(f"{label.rjust(width)}  {bar.ljust(_BAR)}  {count:>8}  {share:>8}")
    return lines
