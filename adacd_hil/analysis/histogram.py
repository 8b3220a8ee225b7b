"""Histograms and percentiles as text."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

PERCENTILES = (50.0, 99.0, 99.9, 100.0)
PERCENTILE_NAMES = ("p50", "p99", "p99.9", "max")
_BAR = 40


def percentiles(values: NDArray[np.int64] | NDArray[np.float64]) -> dict[str, float]:
    """Return p50, p99, p99.9 and max of values that occurred (no interpolation); empty without values."""
    if values.size == 0:
        return {}
    found = np.percentile(values, PERCENTILES, method="higher")
    return dict(zip(PERCENTILE_NAMES, map(float, found), strict=True))


def doubling_bins(values: NDArray[np.int64] | NDArray[np.float64], first: float, count: int) -> list[tuple[float, int]]:
    """Count values below first, 2 first, 4 first, …; the last bin has no upper bound (inf). Trailing empty bins go."""
    bounds = [first * 2.0**power for power in range(count - 1)] + [float("inf")]
    places = np.searchsorted(bounds, values, side="right")
    counts = np.bincount(places, minlength=count)
    bins = [(bound, int(amount)) for bound, amount in zip(bounds, counts, strict=True)]
    while len(bins) > 1 and bins[-1][1] == 0:
        bins.pop()
    return bins


def bar_chart(labels: Sequence[str], counts: Sequence[int]) -> list[str]:
    """Draw one line per bin: label, bar, count, share. A bin that isn't empty has a bar."""
    total, largest = sum(counts), max(counts, default=0)
    width = max((len(label) for label in labels), default=0)
    lines = []
    for label, count in zip(labels, counts, strict=True):
        bar = "#" * max(round(_BAR * count / largest), 1) if count else ""
        share = f"{100.0 * count / total:.2f} %" if total else ""
        lines.append(f"{label.rjust(width)}  {bar.ljust(_BAR)}  {count:>8}  {share:>8}")
    return lines
