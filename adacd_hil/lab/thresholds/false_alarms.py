"""The false-alarm budget: the threshold for a rate of false alarms, from contact-free motion.

A detector's statistic is kept as its largest value per block of time. Values above a level u that are less than
`CLUSTER_S` apart are one alarm, of which the largest value counts. A generalised Pareto tail describes the values above
u (peaks over threshold), by probability-weighted moments:

    rate(h) = rate(u) (1 + xi (h - u) / sigma)^(-1 / xi),          exponential at xi = 0

Below u the alarms are counted. Confidence bounds come from resampled clusters and a Poisson number of them; they cover
the uncertainty of the tail in the recorded motion, not motion that was not recorded.

A detector of several channels and joints is calibrated in two steps: each channel and joint for an equal share of the
wanted rate, then all together by one factor, from the tail of the largest ratio of statistic to threshold. So channels
that see the same noise share one alarm.

Units: Nm where the statistic is a torque; rates per hour. Sources: Hosking and Wallis, "Parameter and quantile
estimation for the generalized Pareto distribution", Technometrics 29 (1987); Coles, "An Introduction to Statistical
Modeling of Extreme Values", 2001, chapters 4 and 5.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import boxcox, inv_boxcox

from adacd_hil.lab.score.rates import CONFIDENCE
from adacd_hil.lab.signal_noise import low_pass
from adacd_hil.log.log_files import LogError
from adacd_hil.records import Vector

BLOCK_S: Final = 0.1
CLUSTER_S: Final = 0.5
"""Values above a threshold that are closer in time than this are one alarm."""
FITTED_CLUSTERS: Final = (25, 400)
"""Fewest and most clusters that a tail is fitted to; more lie too deep in the body, fewer are too uncertain."""
_SHAPES: Final = (-0.5, 0.25)
"""Bounds of xi. Encoder counts and friction are bounded, so most tails end; a heavier tail than the upper bound has not
been seen on contact-free motion and would make every extrapolation infinite."""
_RESAMPLES: Final = 400
_S_PER_H: Final = 3600.0


class TooLittleMotionError(LogError):
    """The recorded motion is too short for the figure; the message names the missing amount."""


def clusters(peaks: Vector, level: float) -> Vector:
    """Return the largest value of each alarm (m,) in block maxima (B,) of `BLOCK_S` each; NaN blocks don't count.

    Blocks above `level` that are at most `CLUSTER_S` apart are one alarm. Empty if there are none.
    """
    above = np.flatnonzero(np.nan_to_num(peaks, nan=-np.inf) > level)
    if above.size == 0:
        return np.zeros(0)
    starts = np.flatnonzero(np.r_[True, np.diff(above) * BLOCK_S > CLUSTER_S])
    return np.asarray(np.maximum.reduceat(peaks[above], starts))


@dataclass(frozen=True)
class Tail:
    """The tail of one statistic: a generalised Pareto distribution of the values above `level`."""

    level: float  # u
    scale: float  # sigma
    shape: float  # xi
    rate_per_h: float  # of alarms above u
    hours: float
    count: int  # clusters above u

    def rate_at(self, threshold: float) -> float:
        """Return the alarms per hour that the tail predicts at a threshold; `self.rate_per_h` at or below `self.level`.

        0 beyond the end of a tail that ends.
        """
        return float(_rates(threshold - self.level, self.scale, self.shape, self.rate_per_h))

    def threshold_at(self, rate_per_h: float) -> float:
        """Return the threshold at which the tail predicts this rate; `level` for a rate above `self.rate_per_h`."""
        return self.level + float(_excesses(rate_per_h, self.scale, self.shape, self.rate_per_h))


def _rates(excess: float, scale: Vector | float, shape: Vector | float, rate_per_h: Vector | float) -> Vector:
    """Return the alarms per hour that tails predict at an excess over their level; 0 past the end of a tail.

    rate_per_h: at the level. A negative excess counts as 0.
    """
    return np.asarray(np.nan_to_num(rate_per_h / inv_boxcox(max(excess, 0.0) / scale, shape)))


def _excesses(wanted_per_h: float, scale: Vector | float, shape: Vector | float, rate_per_h: Vector | float) -> Vector:
    """Return the excess over their level at which tails predict the wanted rate; 0 if it is above `rate_per_h`.

    rate_per_h: at the level.
    """
    return np.asarray(scale * boxcox(np.maximum(rate_per_h / wanted_per_h, 1.0), shape))


def _moments_fit(excesses: Vector) -> tuple[Vector, Vector]:
    """Return scale and shape of tails by probability-weighted moments, the shape within `_SHAPES`.

    excesses (..., m): over the level, ascending along the last axis.
    """
    count = excesses.shape[-1]
    weights = 1.0 - (np.arange(1, count + 1) - 0.35) / count
    first = excesses.mean(axis=-1)
    second = (excesses * weights).mean(axis=-1)
    difference = np.maximum(first - 2.0 * second, 1e-12 * first)
    shape = np.clip(2.0 - first / difference, *_SHAPES)
    # with the shape bounded the scale follows from the mean, sigma / (1 - xi)
    return np.maximum(first * (1.0 - shape), 1e-300), shape


def counted_hours(peaks: Vector) -> float:
    """Return the time of those block maxima (B,) that are not NaN, h."""
    return float(np.count_nonzero(~np.isnan(peaks))) * BLOCK_S / _S_PER_H


def threshold_by_count(peaks: Vector, alarms: float) -> float:
    """Return a threshold above which block maxima (B,) have at most `alarms` alarms, searched from the largest down.

    Of the levels before the first with more alarms it is the lowest with the most. Below those, alarms merge into few
    long ones, down to a single one at the smallest block. NaN blocks don't count.
    """
    found, most = float(np.nanmax(peaks)), 0
    for level in np.unique(peaks[~np.isnan(peaks)])[::-1]:
        count = clusters(peaks, level).size
        if count > alarms:
            break
        if count >= most:
            found, most = float(level), count
    return found


def fit_tail(peaks: Vector) -> Tail:
    """Return the tail fitted to block maxima (B,), NaN in blocks that aren't free of contact.

    Raises TooLittleMotionError for less motion than the fewest `FITTED_CLUSTERS` need, values that are all equal,
    or too few separate alarms.
    """
    hours = counted_hours(peaks)
    least, most = FITTED_CLUSTERS
    if hours * _S_PER_H < 4.0 * least * CLUSTER_S or float(np.nanmax(peaks)) <= float(np.nanmin(peaks)):
        raise TooLittleMotionError(
            f"{hours * _S_PER_H:.0f} s of contact-free motion are too few for a tail, "
            f"at least {4.0 * least * CLUSTER_S:.0f} s that move are needed"
        )
    # one alarm in twenty intervals of CLUSTER_S: with more, clusters merge
    wanted = min(most, max(least, int(0.05 * hours * _S_PER_H / CLUSTER_S)))
    levels = np.sort(peaks[~np.isnan(peaks)])[::-1]
    level, found = math.inf, np.zeros(0)
    for place in np.unique(np.geomspace(least, min(levels.size - 1, 40 * wanted), 16).astype(int)):
        deeper = clusters(peaks, float(levels[place]))
        if deeper.size > wanted:
            break
        if found.size < deeper.size:
            level, found = float(levels[place]), deeper
    if found.size < least // 2:
        raise TooLittleMotionError(f"only {found.size} peaks stand apart in {hours:.2f} h: the tail can't be fitted")
    scale, shape = _moments_fit(np.sort(found - level))
    return Tail(level, float(scale), float(shape), found.size / hours, hours, found.size)


@dataclass(frozen=True)
class TailCalibration:
    """A threshold for a wanted rate of alarms, its upper bounds by `CONFIDENCE`, and the tail that it comes from."""

    threshold: float
    bound: float  # upper confidence bound of the threshold
    rate_per_h: float  # wanted
    rate_bound_per_h: float  # upper confidence bound of the rate at `threshold`
    tail: Tail

    @property
    def extrapolation(self) -> float:
        """Rate of one alarm in the recorded time over the wanted rate; up to 1 nothing is extrapolated."""
        return 1.0 / (self.rate_per_h * self.tail.hours)


def calibrate(peaks: Vector, rate_per_h: float) -> TailCalibration:
    """Return the threshold for a rate of false alarms, with upper bounds, from block maxima (B,), NaN if not free.

    The bounds hold with `CONFIDENCE`. A rate below the tail's is predicted by the tail, another is counted. Raises
    TooLittleMotionError for too little motion, equal values, or too few separate alarms.
    """
    tail = fit_tail(peaks)
    if rate_per_h >= tail.rate_per_h:
        alarms = rate_per_h * tail.hours
        threshold = threshold_by_count(peaks, alarms)
        deviation = 1.6448536269514722 * math.sqrt(alarms)
        bound = threshold_by_count(peaks, max(alarms - deviation, 0.0))
        return TailCalibration(threshold, bound, rate_per_h, (alarms + deviation) / tail.hours, tail)
    generator = np.random.default_rng(0)
    threshold = tail.threshold_at(rate_per_h)
    excesses = clusters(peaks, tail.level) - tail.level
    fits = _moments_fit(np.sort(generator.choice(excesses, (_RESAMPLES, tail.count)), axis=1))
    rates = np.maximum(generator.poisson(tail.count, _RESAMPLES) / tail.hours, 1e-9)
    bound = tail.level + float(np.quantile(_excesses(rate_per_h, *fits, rates), CONFIDENCE))
    rate_bound = float(np.quantile(_rates(threshold - tail.level, *fits, rates), CONFIDENCE))
    return TailCalibration(threshold, max(bound, threshold), rate_per_h, max(rate_bound, rate_per_h), tail)


def largest_ratio(peaks: Vector, thresholds: Vector) -> Vector:
    """Return the largest ratio of each block (B,) of block maxima (B, channels, n) to thresholds (channels, n).

    NaN if one of the block's values is.
    """
    return np.asarray((peaks / thresholds).max(axis=(1, 2)))


def calibrate_detector(peaks: Vector, rate_per_h: float) -> tuple[Vector, TailCalibration]:
    """Return a detector's thresholds (channels, n) for a rate of alarms on any channel and joint, and the calibration.

    peaks (B, channels, n): block maxima, NaN where not free. The calibration is of all channels and joints together, of
    the largest ratio of statistic to threshold; its `threshold` is about 1. Raises TooLittleMotionError for too
    little motion, equal values, or too few separate alarms, of a channel and joint or of all together.
    """
    share = rate_per_h / (peaks.shape[1] * peaks.shape[2])
    thresholds = np.array(
        [[calibrate(peaks[:, row, i], share).threshold for i in range(peaks.shape[2])] for row in range(peaks.shape[1])]
    )
    together = calibrate(largest_ratio(peaks, thresholds), rate_per_h)
    thresholds *= together.threshold
    return thresholds, calibrate(largest_ratio(peaks, thresholds), rate_per_h)


def gains(poles_rad_s: Sequence[float], period_s: float, lag_s: float) -> tuple[float, float]:
    """Return the rms of the filtered stream over that of white noise: of the torque, Nm per Nm, and of the momentum.

    The second is in Nm per kg m² rad/s. poles_rad_s: of the filter of the stream, () for none. The stream takes the
    mean of two torques minus lag times their slope.
    """
    impulse = np.zeros(int(12.0 / min(poles_rad_s, default=math.inf) / period_s) + 3)  # until it has decayed
    impulse[0] = 1.0
    h = low_pass(impulse, poles_rad_s, period_s)
    before = np.r_[0.0, h[:-1]]
    torque = h * (0.5 - lag_s / period_s) + before * (0.5 + lag_s / period_s)
    return float(np.linalg.norm(torque)), float(np.linalg.norm(h - before) / period_s)


def peak_factor(rate_per_h: float, bandwidth_rad_s: float) -> float:
    """Return the number of standard deviations that Gaussian noise exceeds `rate_per_h` times an hour (Rice).

    At least sqrt(2). bandwidth_rad_s: of the noise.
    """
    crossings_per_h = 2.0 * bandwidth_rad_s / (2.0 * math.pi) * _S_PER_H
    return math.sqrt(2.0 * math.log(max(crossings_per_h / rate_per_h, math.e)))


@dataclass(frozen=True)
class Sensing:
    """Noise, resolution and model errors of one joint that determine a threshold."""

    torque_noise_Nm: float
    torque_LSB_Nm: float
    velocity_LSB_rad_s: float
    mass_row_kg_m2: float  # largest norm of the joint's row of M(q)
    momentum_noise_Nms: float  # per sample, of the velocity's noise beyond its resolution
    lag_error_s: float
    friction_error_Nm: float


def find_limits(
    z: Vector,
    tau_J: Vector,
    held_Nm: Vector,
    sensing: Sensing,
    poles_rad_s: Sequence[float],
    period_s: float,
    lag_s: float,
    rate_per_h: float,
) -> tuple[dict[str, float], float]:
    """Return the threshold of a joint's low-pass channel by cause, each alone, and that with an exact model, Nm.

    From contact-free motion: z, tau_J, held_Nm (N,). With exact model, lag and friction, only noise and resolution need
    a threshold.

    Random causes count with the height that Gaussian noise exceeds at the wanted rate. The rest of the stream while the
    joint moves is model error. An error of the lag counts with the steepest torque, one of the friction as it is;
    torque held by friction at standstill raises the threshold there and is not included.
    """
    torque, momentum = gains(poles_rad_s, period_s, lag_s)
    factor = peak_factor(rate_per_h, min(poles_rad_s))
    held = low_pass(held_Nm, poles_rad_s, period_s)
    moves = held <= 0.01 * max(float(held_Nm.max()), 1e-300)
    x = low_pass(z, poles_rad_s, period_s)[moves]
    slope = low_pass(np.r_[0.0, np.diff(tau_J)] / period_s, poles_rad_s, period_s)
    random = {
        "torque noise": torque * sensing.torque_noise_Nm,
        "torque LSB": torque * sensing.torque_LSB_Nm / math.sqrt(12.0),
        "velocity LSB": momentum * sensing.mass_row_kg_m2 * sensing.velocity_LSB_rad_s / math.sqrt(12.0),
    }
    unexplained = max(mean_square(x) - math.hypot(*random.values()) ** 2, 0.0)
    random["velocity noise"] = min(momentum * sensing.momentum_noise_Nms, math.sqrt(unexplained))
    causes = {name: factor * rms_Nm for name, rms_Nm in random.items()} | {
        "model": factor * math.sqrt(max(unexplained - random["velocity noise"] ** 2, 0.0)),
        "lag": abs(sensing.lag_error_s) * float(np.abs(slope).max()),
        "friction": abs(sensing.friction_error_Nm),
    }
    return causes, factor * math.hypot(*random.values())


def mean_square(x: Vector) -> float:
    """Return the mean square of a series (n,); 0 for an empty one."""
    return float(x @ x) / max(x.size, 1)
