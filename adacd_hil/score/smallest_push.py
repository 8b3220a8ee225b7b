"""The smallest push that is found in time, as a distribution over cycles: see `adacd_hil.scheme.detect.sight`.

An estimate, since threshold and residual change meanwhile: of 300 pushes 2 % larger than at their moment 247 were found
in 100 ms, the others as the threshold rose. Of 300 as large as at the worst moment all were, after 59 ms at most.
"""

from dataclasses import dataclass

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, Vector
from adacd_hil.scheme.detect import sight, tail
from adacd_hil.score.distribution import Distribution
from adacd_hil.settings.configuration import Settings

PUSH_WITHIN = f"{1e3 * sight.WITHIN_S:g} ms"
"""In how much time it is found, as text."""


@dataclass(frozen=True)
class SmallestPush:
    """Percentiles, by PERCENTILE_NAMES, of each joint's smallest push found and of its threshold, Nm.

    hours: time in MONITOR without a touch. tail_rate_per_h: false alarms per hour to be expected, of all channels and
    joints together, if their residuals have the tail of a Gaussian.
    """

    push_Nm: tuple[dict[str, float], ...]
    threshold_Nm: tuple[dict[str, float], ...]
    hours: float
    tail_rate_per_h: float


class PushGatherer:
    """Gathers residuals and thresholds in MONITOR without contact, and the smallest push that would be found."""

    def __init__(self, settings: Settings) -> None:
        self._shown = sight.constants_of(settings).shown
        self._period_s = settings.bus.period_s
        self._excursions_Hz = tail.constants_of(settings).excursions_Hz
        self._share = np.zeros((self._shown.size, JOINTS))  # largest of residual over threshold
        self._push, self._threshold = ([Distribution() for _ in range(JOINTS)] for _ in range(2))

    def add_residuals(self, tau_ext: Vector, threshold: Vector) -> None:
        """Gather residuals and thresholds (k, channels, 2), k > 0, of the next cycles in MONITOR without contact."""
        push = np.zeros((len(tau_ext), JOINTS))
        _fill(tau_ext, threshold, self._shown, push)
        in_force = threshold.min(axis=1)
        self._share = np.maximum(self._share, (np.abs(tau_ext) / threshold).max(axis=0))
        for joint in range(JOINTS):
            self._push[joint].add_values(push[:, joint])
            self._threshold[joint].add_values(in_force[:, joint])

    def smallest_push(self) -> SmallestPush | None:
        """Return percentiles of push and threshold by joint, and the rate of false alarms to be expected.

        All cycles so far count; None before the first. `hours` is their time.
        """
        if not self._push[0].count:
            return None
        seen_s = self._push[0].count * self._period_s
        return SmallestPush(
            push_Nm=tuple(each.percentiles() for each in self._push),
            threshold_Nm=tuple(each.percentiles() for each in self._threshold),
            hours=seen_s / 3600.0,
            tail_rate_per_h=sum(
                tail.rate_per_h(float(nu), seen_s, float(share))
                for nu, shares in zip(self._excursions_Hz, self._share, strict=True)
                for share in shares
            ),
        )


@compiled
def _fill(tau_ext: Vector, threshold: Vector, shown: Vector, push: Vector) -> None:
    """Fill `push` (k, 2), Nm, by `sight.smallest_push` of k cycles. shown: each channel's response to a step."""
    for k in range(push.shape[0]):
        for i in range(push.shape[1]):
            push[k, i] = sight.smallest_push(tau_ext[k], threshold[k], shown, i)
