"""A detector's statistics on logs, its thresholds for a wanted rate, and their effect: contacts found, delays, alarms.

A detector is over when some statistic of it is over its threshold: one per channel and joint. All its thresholds times
one factor make its ROC. Alarms are counted where thresholds were not chosen; contacts are those of all logs.

Thresholds are chosen on one half of the contact-free motion and checked on the other: of several logs, on every
other log; of one log, on every other tenth of its time, and its contacts alternate.
"""

import dataclasses
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.file_access import open_input
from adacd_hil.lab.score.rates import rate_bound_per_h, share_bounds
from adacd_hil.lab.score.report_wording import delay_figures
from adacd_hil.lab.thresholds.false_alarms import (
    BLOCK_S,
    TailCalibration,
    TooLittleMotionError,
    calibrate_detector,
    clusters,
    counted_hours,
    largest_ratio,
)
from adacd_hil.lab.thresholds.free_motion import LoggedMotion, read_motion
from adacd_hil.log.log_files import LogError
from adacd_hil.log.logged_run import Progress
from adacd_hil.log.time_window import WHOLE, TimeWindow
from adacd_hil.records import Vector
from adacd_hil.replay.log_source import LogSource
from adacd_hil.score.judge import Times, TrueContact, explained_times
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.setting_keys import changed_keys, keep_log_settings

Changes = dict[str, str]


FACTORS: Final = tuple(10.0 ** (k / 12.0) for k in range(-9, 19))
"""Of the thresholds along a ROC: 0.18 to 32."""
_LEAST: Final = 1e-9


class Trial(NamedTuple):
    """A detector's statistics during one true contact. since_s (k,): time since its onset.

    statistic: (k, channels, n). is_chosen_on: whether it is in the half that thresholds are chosen on. Both arrays are
    empty where the detector was not armed, which counts as missed. Samples in which no statistic is larger than before
    may be left out: no threshold is crossed there for the first time.
    """

    since_s: Vector
    statistic: Vector
    is_chosen_on: bool


def rising(trial: Trial) -> Trial:
    """Return a trial without the samples in which no statistic is larger than in all samples before.

    `delay_ms` gives the same for both.
    """
    if not len(trial.since_s):
        return trial
    flat = trial.statistic.reshape(len(trial.since_s), -1)
    before = np.fmax.accumulate(flat, axis=0)[:-1]
    is_kept = np.concatenate(([True], ~(flat[1:] <= before).all(axis=1)))
    return trial._replace(since_s=trial.since_s[is_kept], statistic=trial.statistic[is_kept])


@dataclass(frozen=True)
class Observed:
    """A detector's statistics.

    peaks (B, channels, n): largest per block of `BLOCK_S`, NaN where it isn't free of contact. is_chosen_on (B,):
    whether a block is in the half that thresholds are chosen on. trials: the contacts for which the logged scheme was
    armed; None if no log records the true contacts.
    """

    name: str
    peaks: Vector
    is_chosen_on: NDArray[np.bool_]
    trials: tuple[Trial, ...] | None

    def half(self, is_chosen_on: bool) -> Vector:
        """Return the peaks (B, channels, n) of the half to choose on if `is_chosen_on`, else of the half to check on.

        Blocks of the other half are NaN.
        """
        return np.where((self.is_chosen_on == is_chosen_on)[:, None, None], self.peaks, np.nan)


class Found(NamedTuple):
    """The effect of thresholds on part of the logs. hours: of contact-free motion. alarms: false ones.

    contacts: number of trials, None if the true contacts are unknown. delays_ms: of the contacts found.
    """

    hours: float
    alarms: int
    contacts: int | None
    delays_ms: tuple[float, ...]

    @property
    def rate_bound_per_h(self) -> float:
        """Upper bound, at `CONFIDENCE`, of the rate of false alarms, 1/h, by counting; inf without motion."""
        return rate_bound_per_h(self.alarms, self.hours)

    @property
    def share_bounds(self) -> tuple[float, float]:
        """The interval, low and high, at `CONFIDENCE`, of the share of contacts found; (0, 1) without contacts."""
        return share_bounds(len(self.delays_ms), self.contacts or 0)

    def by_key(self) -> dict[str, Any]:
        """Return the effect by the keys of tune.json: hours, false alarms, upper bound of their rate, contacts.

        If the contacts are known, also the number of those found, the bounds of their share, and the delays.
        """
        plain: dict[str, Any] = {
            "hours": self.hours,
            "false_alarms": self.alarms,
            "rate_bound_per_h": self.rate_bound_per_h,
            "contacts": self.contacts,
        }
        if self.contacts is None:
            return plain
        return plain | {
            "found": len(self.delays_ms),
            "share_bounds": self.share_bounds,
            "delay_ms": delay_figures(self.delays_ms),
        }


@dataclass(frozen=True)
class Choice:
    """Thresholds (channels, n) for a wanted rate, chosen on one half of the motion and checked on the other.

    chosen, checked: their effect on each half. calibration: the tail's, None where the motion is too short for one:
    then they are the largest values seen.
    """

    name: str
    thresholds: Vector
    calibration: TailCalibration | None
    chosen: Found
    checked: Found
    roc: tuple[tuple[float, Found, float | None], ...]
    """Factor on the thresholds, its effect, and the tail's rate per hour; None below its level or without a tail."""

    @property
    def extrapolation(self) -> float:
        """That of the calibration, on the half that thresholds are chosen on; infinite without a tail."""
        return math.inf if self.calibration is None else self.calibration.extrapolation

    @property
    def method(self) -> str:
        """A phrase that names the source of the thresholds, such as "tail model, extrapolated 12-fold"."""
        if self.calibration is None:
            return "the largest value seen: too little motion for a tail"
        if self.extrapolation <= 1.0:
            return "tail model"
        return f"tail model, extrapolated {self.extrapolation:.4g}-fold"


def choose(observed: Observed, rate_per_h: float) -> Choice:
    """Return thresholds chosen on one half of the motion, with the alarms and contacts found that they give on both.

    For these thresholds the tail's upper bound is `rate_per_h`; without a tail they are the largest values seen. The
    ROC has the alarms of the half to check on and the contacts of both. Raises TooLittleMotionError if the half to
    choose on has no contact-free motion.
    """
    first = observed.half(True)
    if np.isnan(first).all():
        raise TooLittleMotionError("no contact-free motion in the half that thresholds are chosen on")
    calibration = None
    try:
        calibrated, calibration = calibrate_detector(first, rate_per_h)
        thresholds = calibrated * calibration.bound / calibration.threshold
    except TooLittleMotionError:
        thresholds = np.nanmax(first, axis=0)
    thresholds = np.maximum(thresholds, _LEAST)
    held_out = observed.half(False)
    roc = tuple(
        (factor, _count(held_out, observed.trials, factor * thresholds), _predicted(calibration, factor))
        for factor in FACTORS
    )
    return Choice(
        observed.name,
        thresholds,
        calibration,
        _count(first, _half(observed.trials, True), thresholds),
        _count(held_out, _half(observed.trials, False), thresholds),
        roc,
    )


def _half(trials: tuple[Trial, ...] | None, is_chosen_on: bool) -> tuple[Trial, ...] | None:
    return None if trials is None else tuple(each for each in trials if each.is_chosen_on == is_chosen_on)


def _predicted(calibration: TailCalibration | None, factor: float) -> float | None:
    """Return the false alarms per hour that the fitted tail predicts if the thresholds are multiplied by `factor`.

    None without a calibration, and where the thresholds are below the level from which the tail holds.
    """
    if calibration is None:
        return None
    ratio = factor * calibration.bound / calibration.threshold
    return calibration.tail.rate_at(ratio) if ratio >= calibration.tail.level else None


def _count(peaks: Vector, trials: tuple[Trial, ...] | None, thresholds: Vector) -> Found:
    """Return the effect of thresholds (channels, n): alarms in block maxima (B, channels, n), and delays in trials."""
    alarms = clusters(largest_ratio(peaks, thresholds), 1.0).size
    delays = [delay_ms(trial, thresholds) for trial in trials or ()]
    return Found(
        counted_hours(peaks[:, 0, 0]),
        int(alarms),
        None if trials is None else len(trials),
        tuple(delay for delay in delays if delay is not None),
    )


def delay_ms(trial: Trial, thresholds: Vector) -> float | None:
    """Return the time from a contact's onset to its first sample with a statistic over its threshold, ms.

    None if no sample has one.
    """
    over = np.flatnonzero((trial.statistic > thresholds).any(axis=(1, 2)))
    return float(trial.since_s[over[0]]) * 1e3 if over.size else None


_TENTHS = 10


class Window(NamedTuple):
    """The rows [first, last] of a log in which a true contact explains an alarm, see `score.judge`.

    number: the contact's. is_chosen_on: the contact is in the half that thresholds are chosen on.
    """

    number: int
    first: int
    last: int
    is_armed: bool  # in MONITOR at its onset
    is_chosen_on: bool


@dataclass(frozen=True)
class TunedLog:
    """A log of N cycles, or the N of them in `stretch`. digest: SHA-256 of the file. settings: those to start from.

    t_ns (N,): times. windows: of the true contacts that begin in those, None if unknown. is_chosen_on (B,): whether a
    block of `BLOCK_S` is in the half that thresholds are chosen on.
    """

    path: Path
    digest: str
    settings: Settings
    motion: LoggedMotion
    t_ns: NDArray[np.int64]  # (N,)
    windows: tuple[Window, ...] | None
    is_chosen_on: NDArray[np.bool_]
    stretch: TimeWindow

    @property
    def block(self) -> int:
        """Number of cycles in a block of `BLOCK_S`."""
        return round(BLOCK_S / self.motion.period_s)


def read_logs(
    paths: Sequence[Path],
    config: str | None = None,
    stretch: TimeWindow = WHOLE,
    progress: Progress = lambda _: None,
) -> list[TunedLog]:
    """Read logs, or a stretch of each, with contact-free motion and true contacts, for tuning.

    config: name or file of the settings to start from, in place of the logs' own. progress: called with a line on the
    cycles read. Raises LogError if a log can't be read, has no free motion, or has other settings of the scheme than
    the first; ConfigError or CodecError if settings or contract can't be used.
    """
    logs = [_read(path, place, len(paths), config, stretch, progress) for place, path in enumerate(paths)]
    first = logs[0]
    for other in logs[1:]:
        differing = changed_keys(_tunable(first.settings), _tunable(other.settings))
        if differing:
            raise LogError(
                f"logs {first.path} and {other.path} have different settings, such as {next(iter(differing))}: tune "
                "them apart, or say with --config what to start from"
            )
    return logs


def _tunable(settings: Settings) -> Settings:
    """Return the default settings with the sections of `settings` on which the scheme's numbers depend."""
    names = ("scheme", "filter", "estimator", "termination", "detector", "certified")
    return dataclasses.replace(Settings(), **{name: getattr(settings, name) for name in names})


def _read(path: Path, place: int, count: int, config: str | None, stretch: TimeWindow, progress: Progress) -> TunedLog:
    """Read a log for tuning. place, count: its index among the logs and their number, by which its half is chosen.

    The other arguments are as of `read_logs`. Raises LogError, ConfigError or CodecError if the log, its settings or
    its contract can't be used.
    """
    own = LogSource(path).settings
    motion = read_motion(path, stretch, progress, with_times=True)
    blocks = -(-len(motion.t_ns) // round(BLOCK_S / motion.period_s))
    tenths = np.arange(blocks) * _TENTHS // blocks
    is_all_chosen_on = None if count == 1 else place % 2 == 0
    is_chosen_on = tenths % 2 == 0 if is_all_chosen_on is None else np.full(blocks, is_all_chosen_on)
    windows = None if motion.contacts is None else _windows(motion.contacts, motion.t_ns, is_all_chosen_on)
    with open_input(path) as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    settings = own if config is None else keep_log_settings(own, load_settings(config, own.arm.profile))
    return TunedLog(path, digest, settings, motion, motion.t_ns, windows, is_chosen_on, stretch)


def _windows(contacts: Sequence[TrueContact], t_ns: Times, is_all_chosen_on: bool | None) -> tuple[Window, ...]:
    """Return the window of each contact in a log.

    is_all_chosen_on: whether all its contacts are in the half that thresholds are chosen on; None: they alternate by
    their number. t_ns (N,): times of the log's cycles.
    """
    onsets_ns, until_ns = explained_times(contacts)
    firsts = np.searchsorted(t_ns, onsets_ns).tolist()
    lasts = (np.searchsorted(t_ns, until_ns, side="right") - 1).tolist()
    return tuple(
        Window(
            number=contact.number,
            first=first,
            last=max(last, first),
            is_armed=contact.is_armed,
            is_chosen_on=contact.number % 2 == 1 if is_all_chosen_on is None else is_all_chosen_on,
        )
        for contact, first, last in zip(contacts, firsts, lasts, strict=True)
    )


LIMITS: Final = (
    "The arm in the logs moved as its own scheme had it move. After a contact it braked when that scheme found it, the "
    "excitation was the recorded one, and a payload was changed when it was: what an earlier reaction, another motion "
    "or another arm would have come to is not in these figures. Delays are on the host's clock, from the true onset."
)


@dataclass(frozen=True)
class TuningOutcome:
    """The outcome of replays of all logs with the same settings.

    adaptation_s: of finished ones, unfinished: number of others. missed, false_alarms: None without the truth. hours:
    in MONITOR, of logs with the truth. delays_ms: of the contacts found for which the logged scheme was armed.
    armed_false_alarms: of the false alarms those in MONITOR.
    """

    adaptation_s: tuple[float, ...]
    unfinished: int
    missed: int | None
    false_alarms: int | None
    hours: float
    delays_ms: tuple[float, ...]
    armed_false_alarms: int
    notes: tuple[str, ...] = ()
    """Of the replays, a line each: parts of a log that could not be replayed or judged."""


@dataclass(frozen=True)
class Candidate:
    """A filter and a gain with the thresholds chosen for them. changes: settings that differ, thresholds included.

    outcome: of the replays with them. problems: why they are not fit, () if they are.
    """

    name: str
    changes: Changes
    choice: Choice
    outcome: TuningOutcome
    problems: tuple[str, ...]


@dataclass(frozen=True)
class Tuning:
    """The result of tuning. own: outcome with the logs' own settings.

    best: the suggestion, None if no candidate is fit. detectors: those of `lab.detectors`, () where the motion is too
    short for them. notes: a line each.
    """

    rate_per_h: float
    logs: tuple[TunedLog, ...]
    own: TuningOutcome
    candidates: tuple[Candidate, ...]
    best: Candidate | None
    detectors: tuple[Choice, ...]
    notes: tuple[str, ...]

    @property
    def is_shown(self) -> bool:
        """Whether the half to check on shows the wanted rate: the upper bound there is not above it.

        False without a suggestion.
        """
        return self.best is not None and self.best.choice.checked.rate_bound_per_h <= self.rate_per_h


def free_hours(log: TunedLog) -> float:
    """Return the time of the log's contact-free samples, h: in MONITOR, with the truth also after a false alarm."""
    return float(log.motion.is_free.sum()) * log.motion.period_s / 3600.0


def tuning_by_key(found: Tuning) -> dict[str, Any]:
    """Return the result by the keys of tune.json, from rate_per_h to limits; `suggested` is None without a suggestion.

    `json_text` writes the values: some are tuples, arrays and paths.
    """

    def candidate(each: Candidate) -> dict[str, Any]:
        return {
            "name": each.name,
            "changes": each.changes,
            "problems": each.problems,
            "thresholds": _choice(each.choice),
            "replayed": _outcome(each.outcome),
        }

    return {
        "rate_per_h": found.rate_per_h,
        "is_shown": found.is_shown,
        "logs": [
            {
                "path": log.path,
                "sha256": log.digest,
                "free_h": free_hours(log),
                "contacts": None if log.windows is None else len(log.windows),
            }
            for log in found.logs
        ],
        "own": _outcome(found.own),
        "suggested": None if found.best is None else candidate(found.best),
        "candidates": [candidate(each) for each in found.candidates],
        "detectors": [_choice(choice) | {"name": choice.name} for choice in found.detectors],
        "notes": found.notes,
        "limits": LIMITS,
    }


def _outcome(outcome: TuningOutcome) -> dict[str, Any]:
    return {
        "adaptations": len(outcome.adaptation_s),
        "unfinished": outcome.unfinished,
        "adaptation_s": outcome.adaptation_s,
        "missed": outcome.missed,
        "false_alarms": outcome.false_alarms,
        "monitored_h": outcome.hours,
        "delay_ms": delay_figures(outcome.delays_ms),
    }


def _choice(choice: Choice) -> dict[str, Any]:
    return {
        "thresholds": choice.thresholds,
        "method": choice.method,
        "chosen_on": choice.chosen.by_key(),
        "checked_on": choice.checked.by_key(),
        "roc": [
            {"factor": factor, "predicted_per_h": predicted} | found.by_key() for factor, found, predicted in choice.roc
        ],
    }
