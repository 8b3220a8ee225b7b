"""The margin of a running detector: how far the residuals of contact-free motion stay below their thresholds.

Source of the law of block maxima: E. J. Gumbel, "Statistics of Extremes", 1958.
"""

import math

import numpy as np
from numpy.typing import NDArray

from adacd_hil.records import JOINTS, Vector

HORIZON_BLOCKS = 3600.0
"""Blocks over which the largest peak is expected: of 1 s each, an hour."""
MEMORY_BLOCKS = 300
"""Memory of the mean and the deviation, and number of blocks after which the reference is set."""
WARN_SHARE = 0.75
"""Part of the reference below which a margin is reported."""


class MarginWatch:
    """Monitors the distance of contact-free peaks from the thresholds during a run.

    Each block, of a second for instance, gives the largest ratio of statistic to threshold per joint. The margin is one
    over the largest ratio to be expected within the horizon, by a Gumbel law for block maxima whose mean and deviation
    follow the last blocks; bounded tails stay below it.
    """

    def __init__(self) -> None:
        """Begin without blocks and without a reference."""
        self._mean = np.zeros(JOINTS)
        self._square = np.zeros(JOINTS)
        self._blocks = 0
        self.reference: Vector | None = None
        """Margin per joint (n,) when the watch had settled; None until then."""

    def add_block(self, ratio: Vector) -> None:
        """Add each joint's largest ratio (n,) of statistic to threshold in a contact-free block.

        Ignore the block if a ratio is NaN or inf. Set `reference` at block number `MEMORY_BLOCKS`.
        """
        if not np.isfinite(ratio).all():
            return
        self._blocks += 1
        share = 1.0 / min(self._blocks, MEMORY_BLOCKS)
        self._mean += share * (ratio - self._mean)
        self._square += share * (ratio * ratio - self._square)
        if self._blocks == MEMORY_BLOCKS:
            self.reference = self.margin

    def forget(self) -> None:
        """Drop all blocks and the reference, as after a change of the model or the thresholds."""
        self._blocks = 0
        self.reference = None

    @property
    def margin(self) -> Vector:
        """Threshold over the peak expected within the horizon, per joint (n,); inf before the first block."""
        if self._blocks == 0:
            return np.full(self._mean.shape, np.inf)
        scale = np.sqrt(np.maximum(self._square - self._mean**2, 0.0)) * math.sqrt(6.0) / math.pi
        # mode of the largest in the horizon: mean - Euler's constant * scale + ln(horizon) * scale
        expected = self._mean + (math.log(HORIZON_BLOCKS) - 0.5772156649015329) * scale
        return np.asarray(1.0 / np.maximum(expected, 1e-9))

    @property
    def warning(self) -> str:
        """Text on joints with a margin below WARN_SHARE of the reference; "" without such a joint.

        "" also without a reference. For example `joint 1: margin 1.4 x, was 2.1 x`.
        """
        if self.reference is None:
            return ""
        margin = self.margin
        shrunk: NDArray[np.bool_] = margin < WARN_SHARE * self.reference
        return "; ".join(
            f"joint {i + 1}: margin {margin[i]:.1f} x, was {self.reference[i]:.1f} x" for i in np.flatnonzero(shrunk)
        )
