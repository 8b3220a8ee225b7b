"""Which rows of long series stand for all of them: those in which one of the series is smallest or largest."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from adacd_hil.records import Vector

Rows = NDArray[np.int64]


def extreme_rows(series: Iterable[Vector], starts: Rows) -> Rows:
    """Choose of every bucket the rows in which a series (n,) is smallest and largest, the first of equal ones.

    starts: where the buckets begin, from 0, ascending. Rows ascend. NaN is chosen nowhere.
    """
    chosen: list[Rows] = [np.empty(0, np.int64)]
    for values in series:
        bucket = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(values)))
        for extreme in (np.fmin, np.fmax):
            hits = np.flatnonzero(values == extreme.reduceat(values, starts)[bucket])
            chosen.append(hits[np.diff(bucket[hits], prepend=-1) != 0])
    return np.unique(np.concatenate(chosen))
