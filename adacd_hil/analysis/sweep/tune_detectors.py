"""All detectors of `scheme.detectors` on the stream of logs, contacts included: what they show to a ROC.

The stream takes theta_hat as it is in the log, the lag as identified from all motion. Each contact is seen by
detectors that were at rest `WARM_UP_S` before it.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from adacd_hil.analysis.sweep.tune_logs import TunedLog
from adacd_hil.analysis.sweep.tune_roc import Observed, Touched
from adacd_hil.analysis.thresholds import Statistics, join_motions, run_detectors
from adacd_hil.records import Vector
from adacd_hil.scheme import detectors

WARM_UP_S: Final = 0.6


def observe_detectors(logs: Sequence[TunedLog]) -> list[Observed]:
    """Run all detectors over logs. Raises LogError, TooLittleMotionError."""
    settings = detectors.DetectorSettings()
    statistics = run_detectors(join_motions([log.motion for log in logs]), settings)
    places = np.minimum(np.arange(len(statistics.peaks)) * logs[0].block, len(statistics.motion.q) - 1)
    starts = np.cumsum([0, *(len(log.motion.q) for log in logs)])
    of_log = np.searchsorted(starts, places, side="right") - 1
    is_chosen_on = np.array(
        [
            log.is_chosen_on[min((place - starts[k]) // log.block, len(log.is_chosen_on) - 1)]
            for place, k in zip(places.tolist(), of_log.tolist(), strict=True)
            for log in (logs[k],)
        ]
    )
    touches = None
    if any(log.windows is not None for log in logs):
        touches = [touched for log in logs for touched in _touches(log, statistics)]
    return [
        Observed(
            name,
            statistics.peaks[:, list(rows), :],
            is_chosen_on,
            None
            if touches is None
            else tuple(each._replace(statistic=each.statistic[:, list(rows), :]) for each in touches),
        )
        for name, rows in settings.detectors.items()
    ]


def _touches(log: TunedLog, statistics: Statistics) -> list[Touched]:
    """Run the detectors over each contact that the log's scheme was armed for."""
    motion = log.motion
    windows = [window for window in log.windows or () if window.is_armed]
    if not windows:
        return []
    z, held_Nm = detectors.make_stream(
        motion.q,
        motion.dq,
        motion.tau_J,
        motion.theta,
        motion.interval_s,
        statistics.lag_s,
        statistics.settings.standstill_rad_s,
    )
    constants = detectors.constants_of(statistics.settings, statistics.weights, motion.period_s)
    before = round(WARM_UP_S / motion.period_s)
    touches = []
    for window in windows:
        begin = max(window.first - before, 0)
        count = window.last + 1 - begin
        shown: Vector = np.zeros((count, len(statistics.settings.channels), z.shape[1]))
        rows = slice(begin, window.last + 1)
        detectors.record(constants, detectors.new_memory(constants), z[rows], held_Nm[rows], 1, shown)
        since_s = (log.t_ns[window.first : window.last + 1] - log.t_ns[window.first]) * 1e-9
        touches.append(Touched(since_s, shown[window.first - begin :], window.is_chosen_on))
    return touches
