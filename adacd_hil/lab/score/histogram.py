"""Histograms of times: their bins, and bars as text."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adacd_hil.score.distribution import Values

EDGES: Final = np.logspace(0.0, 6.0, 121)
"""Of a histogram with logarithmic bins, twenty per decade: of times in µs from 1 to 1 s."""
_BAR = 40


def log_counts(values: Values) -> NDArray[np.int64]:
    """Return the numbers of values below EDGES, in each bin between them, and above (len(EDGES) + 1,).

    A value on an edge belongs to the upper bin.
    """
    return np.histogram(values, (-np.inf, *EDGES, np.inf))[0]


def histogram_by_key(counts: NDArray[np.int64]) -> dict[str, Any]:
    """Return a histogram by the keys of report.json, without the empty bins at both ends; counts: of `log_counts`.

    "counts" are those between the remaining "edges", "below" and "above" those outside of all EDGES.
    """
    below, *inside, above = counts.tolist()
    filled = np.flatnonzero(inside)
    first, end = (int(filled[0]), int(filled[-1]) + 1) if filled.size else (0, 0)
    return {"edges": EDGES[first : end + 1], "counts": inside[first:end], "below": below, "above": above}


def doubling_bins(values: Values, first: float, count: int) -> list[tuple[float, int]]:
    """Return (upper bound, number of values) of bins whose bounds double from `first` on; bin `count` ends at inf.

    A value on a bound belongs to the upper bin. count: largest number of bins. Empty bins at the end are left out,
    except the first.
    """
    bounds = [first * 2.0**power for power in range(count - 1)] + [float("inf")]
    counts, _ = np.histogram(values, [-np.inf, *bounds])
    bins = list(zip(bounds, counts.tolist(), strict=True))
    while len(bins) > 1 and bins[-1][1] == 0:
        bins.pop()
    return bins


def bar_chart(labels: Sequence[str], counts: Sequence[int]) -> list[str]:
    """Return a line of text per bin: label, bar, count, share.

    The largest count has a bar of `_BAR` signs, any other but 0 at least one sign.
    """
    total, largest = sum(counts), max(counts, default=0)
    width = max((len(label) for label in labels), default=0)
    lines = []
    for label, count in zip(labels, counts, strict=True):
        bar = "#" * max(round(_BAR * count / largest), 1) if count else ""
        share = f"{100.0 * count / total:.2f} %" if total else ""
        lines.append(f"{label.rjust(width)}  {bar.ljust(_BAR)}  {count:>8}  {share:>8}")
    return lines
