"""Detectors compared on one stream: delay against the size of a step, at equal predicted rates of false alarms.

The stream is recorded contact-free motion; a step of external torque is added to it at many instants, shaped by the lag
of the velocity: 1 - (1 + x) e^-x with x = 2 t / lag, a critically damped tracking loop. Everything here is linear up to
the statistics, so the sum equals the recording of a push, except for the motion that a push causes.

A delay is from the onset to the sample at which the detector exceeds its threshold, in ms; the bus cycle until the host
has that sample is not included. A step that is not found within `HORIZON_S` has a delay of more than that.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from adacd_hil.lab.detectors.detector_registry import detectors
from adacd_hil.lab.detectors.detectors import DetectorBank
from adacd_hil.lab.drawing import COLOURS, Drawing, note, style, write_figures
from adacd_hil.lab.thresholds.false_alarms import TailCalibration, TooLittleMotionError
from adacd_hil.lab.thresholds.recorded_thresholds import Statistics, calibrate_all
from adacd_hil.records import JOINTS, Vector

STEPS_NM: Final = (0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0)
ROC_STEP_NM: Final = 0.1
ROC_WITHIN_S: Final = 0.03
HORIZON_S: Final = 0.1
LOOP_LAG_S: Final = 1.6e-3
"""Lag of a 200 Hz tracking loop, with which the step reaches the measured velocity."""
WARM_UP_S: Final = 0.6  # until the slowest filter has forgotten earlier samples
_ONSETS: Final = 200
_ROC_RATES_PER_H: Final = tuple(10.0 ** (0.25 * k) for k in range(-12, 9))
NAME: Final = "detectors"


@dataclass(frozen=True)
class DelayRow:
    """One detector and joint, from 1. delay_ms: median delay of each step of `STEPS_NM`; inf if half are not found.

    found: share of each step's onsets found within `HORIZON_S`.
    """

    detector: str
    joint: int
    delay_ms: tuple[float, ...]
    found: tuple[float, ...]
    roc: tuple[float, ...]  # share of steps of ROC_STEP_NM found in ROC_WITHIN_S, per rate of `_ROC_RATES_PER_H`


@dataclass(frozen=True)
class Comparison:
    """All detectors at one rate of false alarms. hours: of motion.

    rows: one per detector and joint.
    """

    rate_per_h: float
    hours: float
    rows: tuple[DelayRow, ...]
    missing: tuple[str, ...]
    """Detectors whose tail can't be fitted from this motion."""

    @property
    def ranking(self) -> tuple[str, ...]:
        """Names of the detectors, best first, by the geometric mean of their median delays over all steps and joints.

        A delay below 0.1 ms counts as 0.1 ms. A step that is missed at half of its onsets or more counts as ten times
        `HORIZON_S`.
        """
        scores: dict[str, list[float]] = {}
        for row in self.rows:
            delays = np.minimum(np.maximum(row.delay_ms, 0.1), 1e4 * HORIZON_S)
            scores.setdefault(row.detector, []).extend(np.log(delays).tolist())
        return tuple(sorted(scores, key=lambda name: sum(scores[name]) / len(scores[name])))

    def by_key(self) -> dict[str, Any]:
        """Return the comparison by the keys of detectors.json: rate, hours, steps, ranking, missing detectors, rows."""
        return {
            "rate_per_h": self.rate_per_h,
            "hours": self.hours,
            "steps_Nm": STEPS_NM,
            "roc_step_Nm": ROC_STEP_NM,
            "roc_within_s": ROC_WITHIN_S,
            "roc_rates_per_h": _ROC_RATES_PER_H,
            "ranking": self.ranking,
            "missing": self.missing,
            "rows": self.rows,
        }

    def table(self) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
        """Return head and rows of a table for a terminal, best detector first.

        Each detector has a row per joint: its median delay per step, ms, and the share of the first step's onsets that
        was found. A dash stands for the median delay of a step that is missed at half of its onsets or more.
        """
        head = ("detector", "joint", *(f"{torque:g} Nm" for torque in STEPS_NM), f"found at {STEPS_NM[0]:g} Nm")
        order = {name: place for place, name in enumerate(self.ranking)}
        rows = [
            (
                row.detector,
                str(row.joint),
                *(f"{delay:.1f}" if math.isfinite(delay) else "–" for delay in row.delay_ms),
                f"{100.0 * row.found[0]:.0f} %",
            )
            for row in sorted(self.rows, key=lambda row: (order[row.detector], row.joint))
        ]
        return head, rows


def step_shape(samples: int, onset_s: float, period_s: float) -> Vector:
    """Return a unit step of external torque as it appears in the stream z (samples,), `onset_s` after sample 0.

    Each sample of the stream is the mean over the interval that ends with it; the step lags by LOOP_LAG_S.
    """
    t = np.arange(-1, samples) * period_s - onset_s
    x = np.maximum(2.0 * t / LOOP_LAG_S, 0.0)
    # the integral of 1 - (1 + x) e^-x over t
    impulse = 0.5 * LOOP_LAG_S * (x - 2.0 + (x + 2.0) * np.exp(-x))
    return np.asarray(np.diff(impulse) / period_s)


def compare_detectors(statistics: Statistics, rate_per_h: float, onsets: int = _ONSETS) -> Comparison:
    """Calibrate all detectors for one rate of false alarms, and measure their delays to steps added to the stream.

    onsets: number of random instants per step; the same at every call. Raises TooLittleMotionError if no detector can
    be calibrated or no contact-free stretch is long enough.
    """
    found, missing = calibrate_all(statistics, rate_per_h)
    period_s = statistics.motion.period_s
    before, after = round(WARM_UP_S / period_s), round(HORIZON_S / period_s) + 2
    bad = np.r_[0, np.cumsum(~statistics.is_free)]
    starts = np.arange(len(statistics.z) - before - after)
    starts = starts[bad[starts + before + after] == bad[starts]]
    if starts.size == 0:
        raise TooLittleMotionError(f"no contact-free stretch is as long as {WARM_UP_S + HORIZON_S:g} s")
    generator = np.random.default_rng(0)
    chosen = starts[np.sort(generator.integers(0, starts.size, onsets))]
    phases_s = generator.uniform(0.0, period_s, onsets)
    ratios = np.stack(
        [_ratios(statistics, found, chosen, phases_s, torque, before, after) for torque in STEPS_NM]
    )  # (steps, detectors, onsets, after, n), largest ratio so far
    delays_ms = _delays_ms(ratios, phases_s, period_s)
    until = round(ROC_WITHIN_S / period_s)
    largest = ratios[STEPS_NM.index(ROC_STEP_NM), :, :, until]
    rows = []
    for place, (name, (_, calibration)) in enumerate(found.items()):
        tail = calibration.tail
        factors = np.array([tail.threshold_at(rate) for rate in _ROC_RATES_PER_H])
        for i in range(JOINTS):
            delays = delays_ms[:, place, :, i]
            rows.append(
                DelayRow(
                    name,
                    i + 1,
                    tuple(float(np.median(delay)) for delay in delays),
                    tuple(np.isfinite(delays).mean(axis=1).tolist()),
                    tuple((largest[place, :, i] > factor).mean().item() for factor in factors),
                )
            )
    return Comparison(rate_per_h, statistics.hours, tuple(rows), missing)


def _ratios(
    statistics: Statistics,
    found: dict[str, tuple[Vector, TailCalibration]],
    starts: Vector,
    phases_s: Vector,
    torque_Nm: float,
    before: int,
    after: int,
) -> Vector:
    """Return each detector's largest ratio of statistic to threshold since the onset (detectors, onsets, after, n).

    found: thresholds (channels, n) and calibration by detector. starts: first sample of each part of
    `before` samples without and `after` samples with a step of `torque_Nm`; phases_s: time from sample `before` of the
    part to the onset.
    """
    period_s, places_of = statistics.motion.period_s, detectors()
    largest = np.zeros((len(found), len(starts), after, JOINTS))
    for k, (start, phase_s) in enumerate(zip(starts.tolist(), phases_s.tolist(), strict=True)):
        z = statistics.z[start : start + before + after].copy()
        z[before:] += torque_Nm * step_shape(after, phase_s, period_s)[:, None]
        held_Nm = statistics.held_Nm[start : start + before + after]
        shown = DetectorBank(statistics.weights, period_s).take_stream(z, held_Nm)
        for place, (name, (thresholds, _)) in enumerate(found.items()):
            over = (shown[before:, places_of[name]] / thresholds).max(axis=1)
            largest[place, k] = np.maximum.accumulate(over, axis=0)
    return largest


def _delays_ms(ratios: Vector, phases_s: Vector, period_s: float) -> Vector:
    """Return delays (..., onsets, n), ms, from the largest ratios since the onset (..., onsets, after, n).

    inf where the ratio never exceeds 1. phases_s (onsets,): time from the first of these samples to the onset; a delay
    is 0 at least.
    """
    over = ratios > 1.0
    first = over.argmax(axis=-2) * period_s - phases_s[:, None]
    return np.where(over[..., -1, :], np.maximum(first, 0.0) * 1e3, np.inf)


_DELAY_TICKS_MS: Final = (1, 2, 5, 10, 20, 50, 100)
_LOOKS: Final = ("alarm", "cad", "identified", "joint1", "joint2", "bar", "beside", "muted")


def draw_comparison(comparison: Comparison) -> Drawing:
    """Draw median delay against step size, and the share found against the rate of false alarms, a column per joint."""
    with style():
        figure = Figure(figsize=(10.0, 7.2))
        grid = figure.subplots(2, JOINTS)
        figure.subplots_adjust(left=0.065, right=0.985, bottom=0.075, top=0.86, wspace=0.16, hspace=0.42)
        colours = {name: COLOURS[_LOOKS[place % len(_LOOKS)]] for place, name in enumerate(comparison.ranking)}
        lines = {}
        for row in comparison.rows:
            delays, shares = grid[0, row.joint - 1], grid[1, row.joint - 1]
            look = {"color": colours[row.detector], "linewidth": 2.0 if row.detector == comparison.ranking[0] else 1.1}
            shown = np.where(np.isfinite(row.delay_ms), row.delay_ms, np.nan)
            (lines[row.detector],) = delays.plot(STEPS_NM, shown, marker="o", markersize=3.0, **look)
            shares.plot(_ROC_RATES_PER_H, np.array(row.roc) * 100.0, **look)
        for i in range(JOINTS):
            delays, shares = grid[0, i], grid[1, i]
            delays.set(xscale="log", yscale="log", xlabel="step of external torque, Nm", ylabel="median delay, ms")
            delays.set_title(f"Joint {i + 1}")
            delays.set_xticks(STEPS_NM, [f"{torque:g}" for torque in STEPS_NM])
            delays.set_yticks(_DELAY_TICKS_MS, [f"{delay_ms:g}" for delay_ms in _DELAY_TICKS_MS])
            delays.minorticks_off()
            shares.set(xscale="log", ylim=(-3.0, 103.0), xlabel="predicted false alarms per hour", ylabel="found, %")
            shares.set_title(f"Joint {i + 1}")
            shares.axvline(comparison.rate_per_h, color=COLOURS["muted"], linewidth=0.8, linestyle=":")
            note(delays, f"at {comparison.rate_per_h:g} false alarms per hour")
            note(shares, f"steps of {ROC_STEP_NM:g} Nm, within {1e3 * ROC_WITHIN_S:.0f} ms")
        figure.legend(
            [lines[name] for name in comparison.ranking],
            comparison.ranking,
            loc="upper right",
            bbox_to_anchor=(0.985, 0.985),
            ncols=4,
        )
        caption = (
            f"Thresholds of every channel and joint for {comparison.rate_per_h:g} false alarms per hour of a detector, "
            f"predicted from {comparison.hours:.2f} h of motion. A curve ends where fewer than half of the steps are "
            f"found within {1e3 * HORIZON_S:.0f} ms. Best over all steps: {comparison.ranking[0]}."
        )
        return Drawing(NAME, "Detectors on one stream", caption, figure)


def write_comparison(comparison: Comparison, out_dir: Path) -> tuple[Path, ...]:
    """Write detectors.json, .png and .svg into a folder; return their paths.

    Raises LogError if they can't be written.
    """
    return write_figures(out_dir, NAME, comparison.by_key(), [draw_comparison(comparison)])
