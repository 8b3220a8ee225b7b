"""The arm's states as a log has them: `/arm`, with q, dq and tau_J of `/scheme`."""

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adacd_hil.device.recorded_arm import Ticks
from adacd_hil.log.log_files import LogError
from adacd_hil.log.reader import LogStream
from adacd_hil.log.types.topics import ARM, SCHEME
from adacd_hil.records import ArmBatch, FaultReason

_FIELDS: Final = frozenset(member.name for member in ARM.head)


def has_arms(path: Path) -> bool:
    """Return whether a log has the arm's states, all fields of /arm, in its first cycle; False without a cycle.

    Logs of earlier versions lack them. Raises LogError if the log can't be read.
    """
    for piece in LogStream(path, (ARM.name, SCHEME.name), cycles_per_piece=1, is_ahead=False):
        if len(piece.series[SCHEME.name]):
            arms = piece.series[ARM.name]
            return len(arms) > 0 and set(arms.fields) >= _FIELDS
    return False


def logged_arms(scheme: NDArray[Any], arm: NDArray[Any], ticks: Ticks) -> ArmBatch:
    """Return the arm's states of n cycles, from their records of /scheme and /arm (n,).

    Raises LogError for an unknown fault. ticks: number, time and periods of each cycle.
    """
    odd = np.flatnonzero(~np.isin(arm["fault"], [int(fault) for fault in FaultReason]))
    if odd.size:
        fault, cycle = arm["fault"][odd[0]], arm["cycle"][odd[0]]
        raise LogError(f"{ARM.name} has fault {fault} in cycle {cycle}, which this version does not know")
    return ArmBatch(
        cycle=ticks.cycle,
        t_ns=ticks.t_ns,
        periods=ticks.periods,
        q=scheme["q"].astype(np.float64),
        dq=scheme["dq"].astype(np.float64),
        tau_J=scheme["tau_J"].astype(np.float64),
        age_q=arm["age_q"].astype(np.int64),
        age_tau_J=arm["age_tau_J"].astype(np.int64),
        is_enabled=arm["is_enabled"].astype(np.bool_),
        is_complete=arm["is_complete"].astype(np.bool_),
        fault=arm["fault"].astype(np.uint8),
        is_late=arm["is_late"].astype(np.bool_),
        steps=arm["steps"].astype(np.int64),
        sampled_ns=ticks.t_ns - arm["sample_age_ns"],
    )
