"""Percentiles of values that come piece by piece, in bounded memory.

Up to `EXACT` values all of them are kept, and percentiles are values that occurred. Further ones are counted in bins
that are 2^-12 of a value wide, and a percentile is the end of its bin that is nearer to 0: less than the value that
occurred by 0.024 % at most, and a whole number up to 4096 as it is. The smallest and the largest value are exact.
Values nearer to 0 than 2^-30 count as 0, sizes from 2^63 on as infinite; NaN is left out.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

PERCENTILES = (50.0, 99.0, 99.9, 100.0)
PERCENTILE_NAMES = (*(f"p{share:g}" for share in PERCENTILES[:-1]), "max")
LOW_PERCENTILE_NAMES = (*(f"p{100.0 - share:g}" for share in PERCENTILES[:-1]), "min")

Values = NDArray[np.int64] | NDArray[np.float64]


EXACT: Final = 500_000
"""Values that are kept as they are: eight minutes at 1 kHz."""
_BINS_PER_OCTAVE: Final = 12
"""Bits of the mantissa that tell two bins apart."""
_SHIFT: Final = 52 - _BINS_PER_OCTAVE
_LOW, _HIGH = 2.0**-30, 2.0**63


def _code(size: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return exponent and first bits of the mantissa as a number (k,), in the order of the sizes (k,).

    Sizes must be at least 0. Those with the same number share a bin.
    """
    return np.ascontiguousarray(size).view(np.int64) >> _SHIFT


_FIRST: Final = int(_code(np.array([_LOW]))[0])
_SIDE: Final = int(_code(np.array([_HIGH]))[0]) - _FIRST + 1
"""Bins of each sign."""


class Distribution:
    """Percentiles of the values added so far, in bounded memory."""

    def __init__(self) -> None:
        self.count = 0
        self._kept: list[NDArray[np.float64]] = []
        self._bins: NDArray[np.int64] | None = None  # of -_SIDE to _SIDE, once there are more than EXACT values
        self._range = (np.inf, -np.inf)

    def add_values(self, values: Values) -> None:
        """Add values (k,) to the distribution; nan is left out.

        Beyond the limit of exact values, all are counted in bins from now on.
        """
        new = np.asarray(values, dtype=np.float64)
        new = new[~np.isnan(new)]
        if new.size == 0:
            return
        self.count += new.size
        self._range = (min(self._range[0], float(new.min())), max(self._range[1], float(new.max())))
        if self._bins is not None:
            self._sort_in(new)
            return
        self._kept.append(new)
        if self.count > EXACT:
            kept, self._kept = self._kept, []
            for part in kept:
                self._sort_in(part)

    def _sort_in(self, values: NDArray[np.float64]) -> None:
        """Count values (k,), without NaN, in their bins; make the bins at the first call."""
        size = np.minimum(np.abs(values), _HIGH)
        place = np.maximum(_code(size) - _FIRST + 1, 0)
        place = np.where(values < 0.0, -place, place)
        low = int(place.min())
        counts = np.bincount(place - low)
        if self._bins is None:
            self._bins = np.zeros(2 * _SIDE + 1, np.int64)
        self._bins[_SIDE + low : _SIDE + low + counts.size] += counts

    def percentiles(self) -> dict[str, float]:
        """Return PERCENTILES by PERCENTILE_NAMES; {} without a value.

        Up to `EXACT` values each is one that occurred. Of more, all but the smallest and the largest value are the ends
        of their bins that are nearer to 0.
        """
        return dict(zip(PERCENTILE_NAMES, map(self._at, self._ranks()), strict=False))

    def low_percentiles(self) -> dict[str, float]:
        """Return the mirrored PERCENTILES by LOW_PERCENTILE_NAMES, for values that mustn't be small; {} without any.

        Up to `EXACT` values each is one that occurred. Of more, all but the smallest and the largest value are the ends
        of their bins that are nearer to 0.
        """
        mirrored = (self.count - 1 - rank for rank in self._ranks())
        return dict(zip(LOW_PERCENTILE_NAMES, map(self._at, mirrored), strict=False))

    def median(self) -> float:
        """Return the median, of an even number the mean of the middle two.

        Beyond `EXACT` values each of these is the end of its bin that is nearer to 0. NaN without a value.
        """
        if self.count == 0:
            return float("nan")
        return 0.5 * (self._at((self.count - 1) // 2) + self._at(self.count // 2))

    def _ranks(self) -> list[int]:
        """Return the ranks of PERCENTILES, from 0 in ascending order, rounded up; [] without a value."""
        return [int(np.ceil(share / 100.0 * (self.count - 1))) for share in PERCENTILES] if self.count else []

    def _at(self, rank: int) -> float:
        """Return the value of a rank from 0 in ascending order; if the values are in bins, its bin's end nearer to 0.

        The first and the last are exact.
        """
        if rank in (0, self.count - 1):
            return self._range[rank != 0]
        if self._bins is None:
            self._kept = [np.sort(np.concatenate(self._kept), kind="stable")]  # fast where they are sorted already
            return float(self._kept[0][rank])
        place = int(np.searchsorted(np.cumsum(self._bins), rank, side="right")) - _SIDE
        if place == 0:
            return 0.0
        code = np.array([_FIRST + abs(place) - 1], np.int64)
        size = float((code << _SHIFT).view(np.float64)[0]) if abs(place) < _SIDE else float("inf")
        return min(max(size if place > 0 else -size, self._range[0]), self._range[1])
