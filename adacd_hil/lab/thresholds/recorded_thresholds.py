"""Thresholds from logs: contact-free motion, each detector's statistics on it, and the thresholds.

`free_motion` defines the motion that counts. The detectors run over all of this motion, and thresholds come from all of
their statistics. The velocity's lag (by regression of the stream on the filtered slope of the torque), the stream's
covariance and the causes of a threshold come from the same motion, of more than `MOST_SAMPLES` from pieces of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from adacd_hil.lab.detectors.detector_registry import CUTOFFS_RAD_S, FIRST_ORDER, SMOOTHED, channels, detectors
from adacd_hil.lab.detectors.detectors import (
    SMOOTHING_RAD_S,
    VELOCITY_LAG_S,
    DetectorBank,
    likelihood_weights,
    make_stream,
)
from adacd_hil.lab.signal_noise import low_pass, resolution, white_noise
from adacd_hil.lab.thresholds.false_alarms import (
    BLOCK_S,
    Sensing,
    TailCalibration,
    TooLittleMotionError,
    calibrate_detector,
    clusters,
    counted_hours,
    find_limits,
    gains,
    largest_ratio,
    mean_square,
)
from adacd_hil.lab.thresholds.free_motion import (
    LoggedMotion,
    Mask,
    Motion,
    read_motion,
    sample_of,
    torque_streams,
)
from adacd_hil.log.log_files import LogError
from adacd_hil.log.logged_run import Milestones, Progress
from adacd_hil.log.time_window import TimeWindow
from adacd_hil.printable import number_of
from adacd_hil.records import JOINTS, PARAMETER_NAMES, Vector
from adacd_hil.scheme.model.regressor import mass_matrix

_LONGEST_LAG_S: Final = 5e-3
_MODEL_RAD_S: Final = 20.0
"""Corner frequency below which the model's errors exceed the noise."""
_CHECKED_ALARMS: Final = 20.0  # alarms in the held-out half that are enough to compare with the prediction


def find_lag(motion: Motion) -> tuple[float, Vector]:
    """Return by how much the velocity is older than the torque, s, for both joints together and for each (n,).

    It is within 0 and `_LONGEST_LAG_S`. Only free samples in which both joints move count. A joint whose torque changes
    by no more than its noise has the lag of both together. If that holds for both, all are `VELOCITY_LAG_S`.
    """
    z, _ = make_stream(motion.q, motion.dq, motion.tau_J, motion.theta, motion.interval_s, lag_s=0.0)
    moving = motion.is_free & (np.abs(motion.dq) > 0.02).all(axis=1)
    _, slope_gain = gains((_MODEL_RAD_S,), motion.period_s, 0.0)
    top, bottom = np.zeros(JOINTS), np.zeros(JOINTS)
    for i in range(JOINTS):
        slope = np.diff(motion.tau_J[:, i], prepend=motion.tau_J[0, i]) / motion.period_s
        explained, by = (
            low_pass(series * motion.is_free, (_MODEL_RAD_S,), motion.period_s)[moving] for series in (z[:, i], slope)
        )
        top[i] = -float(explained @ by)
        # the noise of the torque has a slope, too, which is not in the stream
        bottom[i] = float(by @ by) - by.size * (slope_gain * float(white_noise(motion.tau_J[:, i]))) ** 2
    if not (bottom > 0.0).any():
        return VELOCITY_LAG_S, np.full(JOINTS, VELOCITY_LAG_S)
    known = np.maximum(bottom, 0.0)
    lag_s = min(max(float(top[known > 0.0].sum() / known.sum()), 0.0), _LONGEST_LAG_S)
    each = np.where(known > 0.0, top / np.where(known > 0.0, known, 1.0), lag_s)
    return lag_s, np.clip(each, 0.0, _LONGEST_LAG_S)


@dataclass(frozen=True)
class Statistics:
    """The detectors' statistics on contact-free motion, and all or N samples of it with their stream: z and held_Nm.

    held_Nm: torque that friction may hold. lag_s: by which dq is older than tau_J; lag_of_joint_s: the same by joint.
    """

    weights: Vector  # (n, ages, L), of the likelihood channels
    peaks: Vector  # (B, channels, n), of all motion; NaN where not all samples of a block are free
    z: Vector  # (N, n), 0 where not free
    held_Nm: Vector
    is_free: Mask
    motion: Motion
    lag_s: float
    lag_of_joint_s: Vector  # (n,)

    @property
    def hours(self) -> float:
        """Time of the blocks that are wholly free of contact, h."""
        return counted_hours(self.peaks[:, 0, 0])


def run_detectors(logs: Sequence[LoggedMotion], progress: Progress = lambda _: None) -> Statistics:
    """Run every detector over the motion of logs; return their statistics, and the lag and weights that they used.

    progress: called with a line on the cycles read. Raises LogError if a log can't be read or the logs differ in
    period, number of parameters or arm; TooLittleMotionError if motion is too short for the likelihood weights;
    DetectorError if a registered detector can't be used.
    """
    motion = sample_of(logs)
    lag_s, lag_of_joint_s = find_lag(motion)
    _, (z, held_Nm) = next(torque_streams([motion], lag_s))
    free = motion.is_free
    z[~free] = 0.0
    held_Nm[~free] = 0.0
    try:
        weights = likelihood_weights(z[free], lag_s, motion.period_s)
    except ValueError as error:
        raise TooLittleMotionError(f"{free.sum()} contact-free samples: {error}") from None
    peaks = _peaks(logs, DetectorBank(weights, motion.period_s), lag_s, progress)
    return Statistics(weights, peaks, z, held_Nm, free, motion, lag_s, lag_of_joint_s)


def _peaks(logs: Sequence[LoggedMotion], bank: DetectorBank, lag_s: float, progress: Progress) -> Vector:
    """Return the largest statistic per block of `BLOCK_S`, channel and joint (B, channels, n) over all logs in turn.

    NaN in blocks that are not wholly free of contact. Blocks begin anew with each log, so its last may be shorter.
    """
    peaks: list[Vector] = []
    count, total = 0, sum(len(log.is_free) for log in logs)
    milestones = Milestones(lambda at: progress(f"{log.path}: running the detectors, {at} of {total} cycles"))
    for log in logs:
        block = round(BLOCK_S / log.period_s)
        of_log: list[Vector] = []
        rest = np.empty((0, JOINTS)), np.empty((0, JOINTS))  # less than a block
        for motion, new in torque_streams(log.pieces(), lag_s):
            for column in new:
                column[~motion.is_free] = 0.0
            z, held_Nm = (np.concatenate(pair) for pair in zip(rest, new, strict=True))
            whole = len(z) // block * block
            of_log.append(bank.take_stream(z[:whole], held_Nm[:whole], block))
            rest, count = (z[whole:], held_Nm[whole:]), count + whole
            milestones.reach(count)
        peaks.append(np.concatenate([*of_log, bank.take_stream(*rest, block)]))
        peaks[-1][~np.logical_and.reduceat(log.is_free, np.arange(0, len(log.is_free), block))] = np.nan
    return np.concatenate(peaks)


@dataclass(frozen=True)
class ChannelRow:
    """One channel of a detector, a row of the thresholds file; tuples have a value per joint.

    threshold: Nm, but sigmas of likelihood and Nm s of cusum. limit: name of the cause that needs the largest
    threshold; achievable_Nm: threshold with an exact model; both are () for other than low-pass channels.
    """

    detector: str
    channel: str
    threshold: tuple[float, ...]
    limit: tuple[str, ...]
    achievable_Nm: tuple[float, ...]


@dataclass(frozen=True)
class DetectorRow:
    """Rates of a detector with all of its thresholds together, a row of the thresholds file.

    rate_bound_per_h: upper bound. bound_ratio: factor on the thresholds with which the bound is the wanted rate.
    predicted_per_h, measured_per_h: rate predicted from one half of the motion, and counted in the other; None if it is
    too short.
    """

    name: str
    rate_bound_per_h: float
    bound_ratio: float
    predicted_per_h: float | None
    measured_per_h: float | None


@dataclass(frozen=True)
class Thresholds:
    """Thresholds for a wanted rate of false alarms of a detector, from `hours` of contact-free motion in the logs.

    is_extrapolated: less than one alarm is expected in that motion. lag_s: of the velocity, identified. missing:
    detectors whose tail can't be fitted from this motion. notes: a line for each log, on how its alarms count.
    """

    rate_per_h: float
    hours: float
    is_extrapolated: bool
    lag_s: float
    logs: tuple[str, ...]
    missing: tuple[str, ...]
    notes: tuple[str, ...]
    detectors: tuple[DetectorRow, ...]
    channels: tuple[ChannelRow, ...]


def calibrate_all(
    statistics: Statistics, rate_per_h: float
) -> tuple[dict[str, tuple[Vector, TailCalibration]], tuple[str, ...]]:
    """Return each detector's thresholds and calibration for a rate of false alarms, and the names of those that failed.

    By name: thresholds (channels, n), and the calibration of all channels and joints together. A detector fails if its
    tail can't be fitted. Raises TooLittleMotionError if all fail.
    """
    found: dict[str, tuple[Vector, TailCalibration]] = {}
    missing: list[str] = []
    for name, places in detectors().items():
        try:
            found[name] = calibrate_detector(statistics.peaks[:, places], rate_per_h)
        except TooLittleMotionError as error:
            missing.append(name)
            problem = error
    if not found:
        raise problem
    return found, tuple(missing)


def compute_thresholds(statistics: Statistics, rate_per_h: float, logs: Sequence[LoggedMotion] = ()) -> Thresholds:
    """Return thresholds of all detectors for a rate of false alarms, with bounds, checks and causes; write no file.

    logs: of the statistics, named in the result. Raises TooLittleMotionError if no detector's tail can be fitted.
    """
    calibrated, missing = calibrate_all(statistics, rate_per_h)
    rows, channel_rows = [], []
    limits = channel_limits(statistics, rate_per_h)
    names, places_of = channels(), detectors()
    for name, (thresholds, calibration) in calibrated.items():
        places = places_of[name]
        check = check_prediction(statistics.peaks[:, places]) or (None, None)
        rows.append(DetectorRow(name, calibration.rate_bound_per_h, calibration.bound / calibration.threshold, *check))
        for threshold, place in zip(thresholds.tolist(), places, strict=True):
            limit, achievable_Nm = limits.get(names[place], ((), ()))
            channel_rows.append(ChannelRow(name, names[place], tuple(threshold), limit, achievable_Nm))
    return Thresholds(
        rate_per_h=rate_per_h,
        hours=statistics.hours,
        is_extrapolated=any(calibration.extrapolation > 1.0 for _, calibration in calibrated.values()),
        lag_s=statistics.lag_s,
        logs=tuple(str(log.path) for log in logs),
        missing=missing,
        notes=tuple(map(_alarms_note, logs)),
        detectors=tuple(rows),
        channels=tuple(channel_rows),
    )


def _alarms_note(log: LoggedMotion) -> str:
    """Return a line on how the alarms of a log count."""
    alarms = number_of(log.alarms, "detection")
    if log.contacts is None:
        return f"{log.path}: the true contacts are not known: {alarms} in MONITOR counted as contacts, none as false"
    return f"{log.path}: {alarms} in MONITOR, {log.false_alarms} of them false by the truth"


def check_prediction(peaks: Vector) -> tuple[float, float] | None:
    """Calibrate a detector on every other tenth of the motion, and count its alarms in the rest; return both rates.

    The first is the rate, 1/h, that it was calibrated for, such that the rest should have `_CHECKED_ALARMS`; the
    second is the counted one. None if half of the motion is too short. peaks (B, channels, n).
    """
    tenth = -(-len(peaks) // 10)
    is_first = np.arange(len(peaks)) // tenth % 2 == 0
    seen, held_out = peaks.copy(), peaks.copy()
    seen[~is_first] = np.nan
    held_out[is_first] = np.nan
    hours = counted_hours(held_out[:, 0, 0])
    try:
        rate = _CHECKED_ALARMS / hours
        thresholds, _ = calibrate_detector(seen, rate)
    except (TooLittleMotionError, ZeroDivisionError):
        return None
    return rate, clusters(largest_ratio(held_out, thresholds), 1.0).size / hours


def channel_limits(statistics: Statistics, rate_per_h: float) -> dict[str, tuple[tuple[str, ...], tuple[float, ...]]]:
    """Return, by name of a low-pass channel, its threshold's largest cause, and its threshold with an exact model, Nm.

    Both per joint.
    """
    motion, free, period_s = statistics.motion, statistics.is_free, statistics.motion.period_s
    places = np.flatnonzero(free)
    masses = np.array([mass_matrix(motion.q[k], motion.theta[k]) for k in places[:: max(1, places.size // 200)]])
    largest = np.linalg.norm(masses, axis=2).max(axis=0).tolist()
    torque_gain, momentum_gain = gains((), period_s, statistics.lag_s)
    poles_of: dict[str, tuple[float, ...]] = {
        name: (cutoff,) for name, cutoff in zip(FIRST_ORDER, CUTOFFS_RAD_S, strict=True)
    }
    poles_of |= {name: (cutoff, SMOOTHING_RAD_S) for name, cutoff in zip(SMOOTHED, CUTOFFS_RAD_S, strict=True)}
    by_joint: dict[str, list[tuple[str, float]]] = {name: [] for name in poles_of}
    for i in range(JOINTS):
        z, held_Nm, tau_J, dq = (
            column[free, i] for column in (statistics.z, statistics.held_Nm, motion.tau_J, motion.dq)
        )
        moves = held_Nm == 0.0
        x, direction = (low_pass(series, (_MODEL_RAD_S,), period_s)[moves] for series in (z, np.sign(dq)))
        torque_LSB, velocity_LSB = resolution(tau_J), resolution(dq)
        # the slope of the velocity's noise dominates single samples: no other part is as fast
        noise = float(white_noise(tau_J))
        fast = mean_square(z[moves]) - (torque_gain * noise) ** 2
        rest = fast / momentum_gain**2 - (largest[i] * velocity_LSB) ** 2 / 12.0
        sensing = Sensing(
            torque_noise_Nm=max(noise**2 - torque_LSB**2 / 12.0, 0.0) ** 0.5,
            torque_LSB_Nm=torque_LSB,
            velocity_LSB_rad_s=velocity_LSB,
            mass_row_kg_m2=largest[i],
            momentum_noise_Nms=max(rest, 0.0) ** 0.5,
            lag_error_s=float(statistics.lag_of_joint_s[i] - statistics.lag_s),
            friction_error_Nm=float(x @ direction) / max(float(direction @ direction), 1e-300),
        )
        for name, poles_rad_s in poles_of.items():
            causes, achievable_Nm = find_limits(
                z, tau_J, held_Nm, sensing, poles_rad_s, period_s, statistics.lag_s, rate_per_h
            )
            by_joint[name].append((max(causes, key=lambda cause: causes[cause]), achievable_Nm))
    limits = {}
    for name, found in by_joint.items():
        largest_causes, achievables_Nm = zip(*found, strict=True)
        limits[name] = largest_causes, achievables_Nm
    return limits


def thresholds_of_logs(
    paths: Sequence[Path], rate_per_h: float, stretch: TimeWindow, progress: Progress
) -> tuple[Thresholds, Statistics]:
    """Return all detectors' thresholds from the contact-free motion of logs, and the statistics that they come from.

    stretch: part of each log. rate_per_h: wanted false alarms of each detector. progress: called with a line on the
    cycles read. Raises LogError for a log that can't be used or is of another arm than the first, TooLittleMotionError
    if all together are too short, DetectorError if a registered detector can't be used.
    """
    logs = []
    for path in paths:
        log = read_motion(path, stretch, progress)
        if log.parameters < len(PARAMETER_NAMES):
            raise LogError(f"log {path} has {log.parameters} parameters")
        logs.append(log)
    statistics = run_detectors(logs, progress)
    return compute_thresholds(statistics, rate_per_h, logs), statistics
