"""What a detector shows on logs, its thresholds for a wanted rate, and what they do: contacts found, delays, alarms.

A detector is over when some statistic of it is over its threshold: one per channel and joint. All its thresholds times
one factor make its ROC. Alarms are counted where thresholds were not chosen; contacts are those of all logs.
"""

import math
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.analysis.false_alarms import (
    Calibration,
    TooLittleMotionError,
    calibrate_detector,
    clusters,
    counted_hours,
    largest_ratio,
)
from adacd_hil.analysis.recorded_thresholds import BLOCK_S
from adacd_hil.analysis.score.confidence_bounds import rate_bound_per_h, share_bounds
from adacd_hil.analysis.score.score_words import delay_figures
from adacd_hil.records import Vector

FACTORS: Final = tuple(10.0 ** (k / 12.0) for k in range(-9, 19))
"""Of the thresholds along a ROC: 0.18 to 32."""
_LEAST: Final = 1e-9


class Touched(NamedTuple):
    """What a detector showed of one true contact: since_s (k,) its onset, statistic (k, channels, n).

    Both are empty where the detector was not armed, which counts as missed. Samples in which no statistic is larger
    than before may be left out: no threshold is crossed there for the first time.
    """

    since_s: Vector
    statistic: Vector
    is_chosen_on: bool


def rising(touched: Touched) -> Touched:
    """Leave out the samples in which no statistic is larger than in all before."""
    if not len(touched.since_s):
        return touched
    flat = touched.statistic.reshape(len(touched.since_s), -1)
    before = np.fmax.accumulate(flat, axis=0)[:-1]
    is_kept = np.concatenate(([True], ~(flat[1:] <= before).all(axis=1)))
    return touched._replace(since_s=touched.since_s[is_kept], statistic=touched.statistic[is_kept])


@dataclass(frozen=True)
class Observed:
    """What a detector showed: peaks (B, channels, n) per block of 0.1 s, NaN unless free; is_chosen_on (B,).

    touches: the contacts for which the logged scheme was armed; None where no log says what touched the arm.
    """

    name: str
    peaks: Vector
    is_chosen_on: NDArray[np.bool_]
    touches: tuple[Touched, ...] | None

    def half(self, is_chosen_on: bool) -> Vector:
        """Return the peaks of one half, NaN elsewhere."""
        return np.where((self.is_chosen_on == is_chosen_on)[:, None, None], self.peaks, np.nan)


class Found(NamedTuple):
    """What thresholds come to in some part of the logs. Delays in ms, of the contacts found; None of none."""

    hours: float
    alarms: int
    contacts: int | None
    delays_ms: tuple[float, ...]

    @property
    def rate_bound_per_h(self) -> float:
        """Upper 95 % bound of the rate of false alarms."""
        return rate_bound_per_h(self.alarms, self.hours)

    @property
    def share_bounds(self) -> tuple[float, float]:
        """The 95 % interval of the share of contacts that is found."""
        return share_bounds(len(self.delays_ms), self.contacts or 0)

    def as_json(self) -> dict[str, Any]:
        """Give it in plain values; what is not known is null."""
        bound = self.rate_bound_per_h
        plain: dict[str, Any] = {
            "hours": self.hours,
            "false_alarms": self.alarms,
            "rate_bound_per_h": bound if math.isfinite(bound) else None,
            "contacts": self.contacts,
        }
        if self.contacts is None:
            return plain
        return plain | {
            "found": len(self.delays_ms),
            "share_bounds": self.share_bounds,
            "delay_ms": dict(zip(("median", "p90", "max"), delay_figures(self.delays_ms), strict=True)),
        }


@dataclass(frozen=True)
class Choice:
    """Thresholds (channels, n) for a wanted rate, chosen on one half and checked on the other.

    calibration: the tail's, None where the motion is too short for one: then they are the largest values seen.
    """

    name: str
    thresholds: Vector
    calibration: Calibration | None
    chosen: Found
    checked: Found
    roc: tuple[tuple[float, Found, float | None], ...]
    """Factor, what it comes to, and the rate that the tail predicts, of those factors that it can speak of."""

    @property
    def extrapolation(self) -> float:
        """How far the wanted rate is below one alarm in the time thresholds are chosen on; infinite without a tail."""
        if self.calibration is None:
            return math.inf
        return 1.0 / (self.calibration.rate_per_h * self.calibration.tail.hours)

    @property
    def method(self) -> str:
        """Say where the thresholds come from."""
        if self.calibration is None:
            return "the largest value seen: too little motion for a tail"
        if self.extrapolation <= 1.0:
            return "tail model"
        return f"tail model, extrapolated {self.extrapolation:.4g}-fold"


def choose(observed: Observed, rate_per_h: float) -> Choice:
    """Choose thresholds on the first half and count on the other. Raises TooLittleMotionError without any motion.

    They are those at which the tail's upper 95 % bound is the wanted rate.
    """
    first = observed.half(True)
    if np.isnan(first).all():
        raise TooLittleMotionError("no contact-free motion in the half that thresholds are chosen on")
    calibration = None
    try:
        calibrated = calibrate_detector(first, BLOCK_S, rate_per_h)
        calibration = calibrated.calibration
        thresholds = calibrated.thresholds * calibration.bound / calibration.threshold
    except TooLittleMotionError:
        thresholds = np.nanmax(first, axis=0)
    thresholds = np.maximum(thresholds, _LEAST)
    held_out = observed.half(False)
    roc = tuple(
        (factor, _count(held_out, observed.touches, factor * thresholds), _predicted(calibration, factor))
        for factor in FACTORS
    )
    return Choice(
        observed.name,
        thresholds,
        calibration,
        _count(first, _half(observed.touches, True), thresholds),
        _count(held_out, _half(observed.touches, False), thresholds),
        roc,
    )


def _half(touches: tuple[Touched, ...] | None, is_chosen_on: bool) -> tuple[Touched, ...] | None:
    return None if touches is None else tuple(each for each in touches if each.is_chosen_on == is_chosen_on)


def _predicted(calibration: Calibration | None, factor: float) -> float | None:
    """Give the tail's rate at a factor on the thresholds, None below its level."""
    if calibration is None:
        return None
    ratio = factor * calibration.bound / calibration.threshold
    return calibration.tail.rate_at(ratio) if ratio >= calibration.tail.level else None


def _count(peaks: Vector, touches: tuple[Touched, ...] | None, thresholds: Vector) -> Found:
    alarms = clusters(largest_ratio(peaks, thresholds), 1.0, BLOCK_S).size
    delays = [delay_ms(touched, thresholds) for touched in touches or ()]
    return Found(
        counted_hours(peaks[:, 0, 0], BLOCK_S),
        int(alarms),
        None if touches is None else len(touches),
        tuple(delay for delay in delays if delay is not None),
    )


def delay_ms(touched: Touched, thresholds: Vector) -> float | None:
    """Give when some statistic is first over its threshold, ms after the onset; None: never."""
    over = np.flatnonzero((touched.statistic > thresholds).any(axis=(1, 2)))
    return float(touched.since_s[over[0]]) * 1e3 if over.size else None
