"""All detectors of `scheme.detectors` on the stream of logs, contacts included: what they show to a ROC.

The stream takes theta_hat as it is in the log, the lag as identified from all motion. Each contact is seen by
detectors that were at rest `WARM_UP_S` before it.
"""

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from adacd_hil.analysis.motion import Progress, TorqueStream
from adacd_hil.analysis.recorded_thresholds import Statistics, run_detectors
from adacd_hil.analysis.sweep.tune_logs import TunedLog
from adacd_hil.analysis.sweep.tune_roc import Observed, Touched, rising
from adacd_hil.records import Vector
from adacd_hil.scheme.detect import detectors

WARM_UP_S: Final = 0.6


def observe_detectors(logs: Sequence[TunedLog], progress: Progress = lambda _: None) -> list[Observed]:
    """Run all detectors over logs. Raises LogError, TooLittleMotionError."""
    settings = detectors.DetectorSettings()
    statistics = run_detectors([log.motion for log in logs], settings, progress)
    starts = np.cumsum([0, *(len(log.motion.is_free) for log in logs)])
    places = np.minimum(np.arange(len(statistics.peaks)) * logs[0].block, starts[-1] - 1)
    of_log = np.searchsorted(starts, places, side="right") - 1
    is_chosen_on = np.array(
        [
            log.is_chosen_on[min((place - starts[k]) // log.block, len(log.is_chosen_on) - 1)]
            for place, k in zip(places.tolist(), of_log.tolist(), strict=True)
            for log in (logs[k],)
        ]
    )
    touches: dict[str, list[Touched]] = {name: [] for name in settings.detectors}
    for log in logs:
        for touched in _touches(log, statistics):
            for name, rows in settings.detectors.items():
                touches[name].append(rising(touched._replace(statistic=touched.statistic[:, list(rows), :])))
    has_truth = any(log.windows is not None for log in logs)
    return [
        Observed(name, statistics.peaks[:, list(rows), :], is_chosen_on, tuple(touches[name]) if has_truth else None)
        for name, rows in settings.detectors.items()
    ]


def _touches(log: TunedLog, statistics: Statistics) -> Iterator[Touched]:
    """Run the detectors over each contact that the log's scheme was armed for."""
    waiting = sorted((window for window in log.windows or () if window.is_armed), key=lambda window: window.first)
    if not waiting:
        return
    constants = detectors.constants_of(statistics.settings, statistics.weights, log.motion.period_s)
    before = round(WARM_UP_S / log.motion.period_s)
    stream = TorqueStream(statistics.lag_s, statistics.settings.standstill_rad_s)
    held = tuple(np.empty((0, statistics.z.shape[1])) for _ in range(2))  # what may still be needed of the stream
    end = 0
    for motion in log.motion.pieces():
        held = tuple(np.concatenate(pair) for pair in zip(held, stream.add(motion), strict=True))
        end += len(motion.q)
        begin = end - len(held[0])
        for window in [window for window in waiting if window.last < end]:
            first = max(window.first - before, 0)
            rows = slice(first - begin, window.last + 1 - begin)
            shown: Vector = np.zeros((rows.stop - rows.start, len(statistics.settings.channels), held[0].shape[1]))
            z, held_Nm = (column[rows] for column in held)
            detectors.record(constants, detectors.new_memory(constants), z, held_Nm, 1, shown)
            since_s = (log.t_ns[window.first : window.last + 1] - log.t_ns[window.first]) * 1e-9
            yield Touched(since_s, shown[window.first - first :], window.is_chosen_on)
        waiting = [window for window in waiting if window.last >= end]
        needed = min((max(window.first - before, 0) for window in waiting), default=end)
        held = tuple(column[max(min(needed, end - before) - begin, 0) :] for column in held)
