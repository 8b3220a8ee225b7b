"""The margin of a running detector: how far the residuals of contact-free motion stay below their thresholds.

Source of the law of block maxima: E. J. Gumbel, "Statistics of Extremes", 1958.
"""

import math

import numpy as np
from numpy.typing import NDArray

from adacd_hil.records import Vector


class MarginWatch:
    """Watches how far the contact-free peaks stay below the thresholds while a run goes on.

    Fed once per block, of a second say, with the largest ratio of statistic to threshold of each joint. The margin is
    one over the largest ratio to be expected within the horizon, by a Gumbel law for block maxima whose mean and
    deviation follow the last blocks; bounded tails stay below it.
    """

    def __init__(
        self, joints: int, horizon_blocks: float = 3600.0, memory_blocks: float = 300.0, warn_share: float = 0.75
    ) -> None:
        """Begin without a reference. horizon: 3600 blocks of 1 s are an hour. warn_share: of the first margin."""
        self._forget = 1.0 / memory_blocks
        self._horizon = math.log(horizon_blocks)
        self._warn_share = warn_share
        self._mean = np.zeros(joints)
        self._square = np.zeros(joints)
        self._blocks = 0
        self._settled = round(memory_blocks)
        self.reference: Vector | None = None
        """Margin per joint (n,) when the watch had settled; None until then."""

    def add(self, ratio: Vector) -> None:
        """Take in one contact-free block's largest ratio of each joint (n,); one that isn't finite is left out."""
        if not np.isfinite(ratio).all():
            return
        self._blocks += 1
        share = max(self._forget, 1.0 / self._blocks)
        self._mean += share * (ratio - self._mean)
        self._square += share * (ratio * ratio - self._square)
        if self._blocks == self._settled:
            self.reference = self.margin

    def restart(self) -> None:
        """Forget everything: the model or the thresholds have changed."""
        self._blocks = 0
        self.reference = None

    @property
    def margin(self) -> Vector:
        """Threshold over expected peak of each joint (n,); infinite before the first block."""
        if self._blocks == 0:
            return np.full(self._mean.shape, np.inf)
        scale = np.sqrt(np.maximum(self._square - self._mean**2, 0.0)) * math.sqrt(6.0) / math.pi
        # mode of the largest of so many: mean - Euler's constant * scale + ln(horizon) * scale
        expected = self._mean + (self._horizon - 0.5772156649015329) * scale
        return np.asarray(1.0 / np.maximum(expected, 1e-9))

    @property
    def warning(self) -> str:
        """Say which joint's margin has shrunk: `joint 1: margin 1.4 x, was 2.1 x`; "" while none has."""
        if self.reference is None:
            return ""
        margin = self.margin
        shrunk: NDArray[np.bool_] = margin < self._warn_share * self.reference
        return "; ".join(
            f"joint {i + 1}: margin {margin[i]:.1f} x, was {self.reference[i]:.1f} x" for i in np.flatnonzero(shrunk)
        )
