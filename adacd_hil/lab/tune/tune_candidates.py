"""Candidates of tuning on the logs: the scheme with other filters and gains, replayed, and all detectors of the stream.

The paper's scheme is replayed with thresholds that no residual exceeds: every candidate keeps monitoring, and its
residual is seen; the model is frozen while it does. The certified scheme keeps learning, but not from samples over a
threshold: it is replayed with its own thresholds, and its statistic is the largest ratio to them, which grow with
`certified.noise_sigmas` and `certified.model_sigmas` (but for the friction that is allowed at standstill).

Detectors (`lab.detectors`) take the stream with theta_hat as it is in the log and the lag as identified from all
motion. Each contact is seen by detectors that were at rest `WARM_UP_S` before it.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adacd_hil.device.recorded_arm import Ticks
from adacd_hil.lab.detectors.detector_registry import detectors
from adacd_hil.lab.detectors.detectors import DetectorBank
from adacd_hil.lab.thresholds.detector_comparison import WARM_UP_S
from adacd_hil.lab.thresholds.free_motion import torque_streams
from adacd_hil.lab.thresholds.recorded_thresholds import Statistics, run_detectors
from adacd_hil.lab.tune.tune_roc import Changes, Observed, Trial, TunedLog, Window, rising
from adacd_hil.log.logged_run import Progress, is_armed_in
from adacd_hil.records import JOINTS, Vector
from adacd_hil.replay.replay import replay_many
from adacd_hil.scheme.pipeline.pipeline import SchemeBatch, layout_of
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.parsing import bounds_of
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.scheme_settings import CertifiedSettings, DetectorSettings
from adacd_hil.settings.setting_keys import apply_settings

_FILTER_FACTORS: Final = (1.0, 0.5, 2.0, 4.0)
_GAIN_FACTORS: Final = (1.0, 0.3, 3.0)
_THRESHOLDS_NM: Final = bounds_of(DetectorSettings, "threshold_Nm")
_NOTHING_EXCEEDS_Nm: Final = _THRESHOLDS_NM[1]
"""The largest threshold that a configuration may have."""

Places = NDArray[np.int64]


def candidates(settings: Settings) -> list[Changes]:
    """Return the changes of filter and gain to try, {} first: the settings as they are.

    Values are TOML, by key. Changes that the configuration's bounds refuse are left out.
    """
    tried: list[Changes] = []
    for filter_factor in _FILTER_FACTORS:
        for gain_factor in _GAIN_FACTORS:
            changes: Changes = {}
            if filter_factor != 1.0:
                changes |= _filter(settings, filter_factor)
            if gain_factor != 1.0:
                changes |= _gain(settings, gain_factor)
            try:
                apply_settings(settings, changes)
            except ConfigError:
                continue
            tried.append(changes)
    return tried


def _filter(settings: Settings, factor: float) -> Changes:
    """Return the changed settings, as TOML by key, that multiply the filter's cut-offs by `factor`.

    In the paper's filter these are a and b, so its gain at rest stays.
    """
    if settings.scheme == "certified":
        return {"certified.cutoffs_rad_s": in_toml([factor * each for each in settings.certified.cutoffs_rad_s])}
    pair = {"a_rad_s": settings.filter.a_rad_s, "b_rad_s": settings.filter.b_rad_s}
    return {f"filter.{name}": in_toml(factor * value) for name, value in pair.items()}


def _gain(settings: Settings, factor: float) -> Changes:
    """Return the changed setting, as TOML by key, that weighs a sample `factor` times as much.

    Certified scheme: `residual_Nm` / sqrt(factor). Paper's scheme: factor * `P0`.
    """
    if settings.scheme == "certified":
        return {"certified.residual_Nm": in_toml(settings.certified.residual_Nm / factor**0.5)}
    return {"estimator.P0": in_toml([factor * each for each in settings.estimator.P0])}


def in_toml(value: float | Sequence[float]) -> str:
    """Return a number, or an array of several, as TOML with four significant digits."""
    if isinstance(value, int | float):
        return repr(float(f"{value:.4g}"))
    return "[" + ", ".join(in_toml(each) for each in value) + "]"


def thresholds_as_changes(settings: Settings, thresholds: Vector) -> Changes:
    """Return chosen thresholds (1, channels) as changed settings, rounded up, within the configuration's bounds.

    Paper's scheme: Nm per joint. Certified scheme: one factor on `noise_sigmas` and `model_sigmas`.
    """
    up = 1.0005  # so that four digits are never below the chosen value
    if settings.scheme == "certified":
        factor = up * float(thresholds[0, 0])
        own = {name: factor * getattr(settings.certified, name) for name in ("noise_sigmas", "model_sigmas")}
        within = {name: float(np.clip(value, *bounds_of(CertifiedSettings, name))) for name, value in own.items()}
        return {f"certified.{name}": in_toml(value) for name, value in within.items()}
    return {"detector.threshold_Nm": in_toml(np.clip(up * thresholds[0], *_THRESHOLDS_NM).tolist())}


def observe_candidates(logs: Sequence[TunedLog], tried: Sequence[Changes], progress: Progress) -> list[Observed]:
    """Replay the logs with every candidate; return the statistics of each, in the order of `tried`.

    Raises LogError, ConfigError or CodecError if a log, a candidate's settings or a contract can't be used.
    """
    by_log = [_replayed(log, tried, progress) for log in logs]
    has_truth = any(log.windows is not None for log in logs)
    return [
        Observed(
            name_of(changes),
            np.concatenate([one.peaks() for one in all_logs]),
            np.concatenate([log.is_chosen_on for log in logs]),
            tuple(trial for one in all_logs for trial in one.trials()) if has_truth else None,
        )
        for changes, all_logs in zip(tried, zip(*by_log, strict=True), strict=True)
    ]


def _replayed(log: TunedLog, tried: Sequence[Changes], progress: Progress) -> "list[ShownLog]":
    """Replay a log with every candidate; return the statistics of each on it."""
    progress(f"replaying {log.path} with {len(tried)} filters and gains")
    variants = [_monitoring(apply_settings(log.settings, changes)) for changes in tried]
    shown = [ShownLog(log, settings) for settings in variants]
    replay_many(
        log.path,
        variants,
        progress,
        watch=lambda place, ticks, batch: shown[place].take_stretch(ticks, batch),
        stretch=log.stretch,
    )
    return shown


def name_of(changes: Mapping[str, str]) -> str:
    """Return the name of a candidate by its changed settings, "KEY=VALUE, …"; "as it is" without a change.

    `filter.b_rad_s` is left out.
    """
    return ", ".join(f"{key}={value}" for key, value in changes.items() if key != "filter.b_rad_s") or "as it is"


def _monitoring(settings: Settings) -> Settings:
    """Return settings of the paper's scheme with thresholds that nothing exceeds, so that it never reacts.

    Those of the certified scheme are returned unchanged.
    """
    if settings.scheme == "certified":
        return settings
    thresholds = (_NOTHING_EXCEEDS_Nm, _NOTHING_EXCEEDS_Nm)
    return dataclasses.replace(settings, detector=dataclasses.replace(settings.detector, threshold_Nm=thresholds))


class ShownLog:
    """The statistics of one candidate on one log of N cycles.

    Call `take_stretch` for each batch of replayed cycles, in the order of time, then `trials`.
    """

    def __init__(self, log: TunedLog, settings: Settings) -> None:
        self._log = log
        self._is_certified = settings.scheme == "certified"
        self._slices = layout_of(settings).slices
        self._channels = 1 if self._is_certified else JOINTS
        self._peaks = np.full((len(log.is_chosen_on), 1, self._channels), -np.inf)
        self._windows = [window for window in log.windows or () if window.is_armed]
        self._parts: dict[Window, list[Trial]] = {}  # of the contacts at whose onset the candidate was armed

    def take_stretch(self, ticks: Ticks, batch: SchemeBatch) -> None:
        """Add a batch of replayed cycles to the largest statistics per block, and to those of the contacts in it.

        Blocks take armed cycles that are free of contact only. Cycles that the log lacks are skipped. Call it in the
        order of time. ticks, batch: times and results of the same cycles.
        """
        rows = np.minimum(np.searchsorted(self._log.t_ns, ticks.t_ns), len(self._log.t_ns) - 1)
        known = np.flatnonzero(self._log.t_ns[rows] == ticks.t_ns)
        if known.size == 0:
            return
        rows, statistic = rows[known], self._statistic_of(batch.block[known])
        is_armed = is_armed_in(batch.previous_state[known])
        counted = np.flatnonzero(is_armed & self._log.motion.is_free[rows])
        if counted.size:
            blocks = rows[counted] // self._log.block
            starts = np.flatnonzero(np.diff(blocks, prepend=-1))
            largest = np.maximum.reduceat(statistic[counted], starts, axis=0)
            self._peaks[blocks[starts]] = np.maximum(self._peaks[blocks[starts]], largest)
        for window in self._windows:
            if window.first <= rows[-1] and rows[0] <= window.last:
                self._take_window(window, rows, statistic, is_armed)

    def _take_window(self, window: Window, rows: Places, statistic: Vector, is_armed: NDArray[np.bool_]) -> None:
        """Add the cycles of a batch that lie in a contact. rows, statistic, is_armed: of the batch, one per cycle.

        A contact at whose onset the candidate isn't armed is skipped.
        """
        first, end = np.searchsorted(rows, (window.first, window.last + 1)).tolist()
        if first < len(rows) and rows[first] == window.first and is_armed[first]:
            self._parts[window] = []
        if window in self._parts:
            since_s = (self._log.t_ns[rows[first:end]] - self._log.t_ns[window.first]) * 1e-9
            self._parts[window].append(rising(Trial(since_s, statistic[first:end], window.is_chosen_on)))

    def _statistic_of(self, block: Vector) -> Vector:
        """Return the statistic that chosen thresholds are compared with (k, 1, channels), from k cycles of /scheme.

        Certified scheme: largest ratio to the thresholds in force. Paper's scheme: residual, Nm, less
        the part of the threshold beyond the configured one.
        """
        if self._is_certified:
            bank, threshold = (block[:, self._slices[name]] for name in ("tau_ext_bank", "threshold_bank"))
            return np.asarray((np.abs(bank) / threshold).max(axis=1))[:, None, None]
        allowance = block[:, self._slices["threshold"]] - _NOTHING_EXCEEDS_Nm
        return np.asarray(np.abs(block[:, self._slices["tau_ext_hat"]]) - allowance)[:, None, :]

    def peaks(self) -> Vector:
        """Return the largest statistic per block (B, 1, channels).

        NaN in blocks that aren't wholly free of contact, or in which the candidate never was in MONITOR.
        """
        peaks = np.where(np.isfinite(self._peaks), self._peaks, np.nan)
        whole = np.logical_and.reduceat(self._log.motion.is_free, np.arange(len(peaks)) * self._log.block)
        peaks[~whole] = np.nan
        return peaks

    def trials(self) -> list[Trial]:
        """Return the statistics during each contact for which the logged scheme was armed, in the order of the log.

        Empty where the candidate wasn't armed. Call it after the last batch.
        """
        return [self._trial(window) for window in self._windows]

    def _trial(self, window: Window) -> Trial:
        unarmed = Trial(np.zeros(0), np.zeros((0, 1, self._channels)), window.is_chosen_on)
        since_s, statistic, _ = zip(*self._parts.get(window, [unarmed]), strict=True)
        return rising(Trial(np.concatenate(since_s), np.concatenate(statistic), window.is_chosen_on))


def observe_detectors(logs: Sequence[TunedLog], progress: Progress) -> list[Observed]:
    """Run all detectors over logs; return the statistics of each, in the order of `detectors`.

    progress: called with a line on the cycles read. Raises LogError if a log can't be read or the logs differ in
    period, number of parameters or arm; TooLittleMotionError if motion is too short; DetectorError if a registered
    detector can't be used.
    """
    places_of = detectors()
    statistics = run_detectors([log.motion for log in logs], progress)
    is_chosen_on = np.concatenate([log.is_chosen_on for log in logs])
    trials: dict[str, list[Trial]] = {name: [] for name in places_of}
    for log in logs:
        for trial in _trials(log, statistics):
            for name, places in places_of.items():
                trials[name].append(rising(trial._replace(statistic=trial.statistic[:, places])))
    has_truth = any(log.windows is not None for log in logs)
    return [
        Observed(name, statistics.peaks[:, places], is_chosen_on, tuple(trials[name]) if has_truth else None)
        for name, places in places_of.items()
    ]


def _trials(log: TunedLog, statistics: Statistics) -> Iterator[Trial]:
    """Yield the statistics of all channels during each contact for which the logged scheme was armed.

    The order is that of the log's pieces in which the contacts end, within a piece that of their onsets. Raises
    LogError if the log can't be read.
    """
    waiting = sorted((window for window in log.windows or () if window.is_armed), key=lambda window: window.first)
    if not waiting:
        return
    before = round(WARM_UP_S / log.motion.period_s)
    held = tuple(np.empty((0, statistics.z.shape[1])) for _ in range(2))  # stream that contacts may still need
    end = 0
    for motion, new in torque_streams(log.motion.pieces(), statistics.lag_s):
        held = tuple(np.concatenate(pair) for pair in zip(held, new, strict=True))
        end += len(motion.q)
        begin = end - len(held[0])
        for window in [window for window in waiting if window.last < end]:
            first = max(window.first - before, 0)
            rows = slice(first - begin, window.last + 1 - begin)
            bank = DetectorBank(statistics.weights, log.motion.period_s)
            shown = bank.take_stream(held[0][rows], held[1][rows])
            since_s = (log.t_ns[window.first : window.last + 1] - log.t_ns[window.first]) * 1e-9
            yield Trial(since_s, shown[window.first - first :], window.is_chosen_on)
        waiting = [window for window in waiting if window.last >= end]
        needed = min((max(window.first - before, 0) for window in waiting), default=end)
        held = tuple(column[max(min(needed, end - before) - begin, 0) :] for column in held)
