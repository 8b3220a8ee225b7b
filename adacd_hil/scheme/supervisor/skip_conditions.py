"""Conditions under which the supervisor's state cannot change; replay uses them to skip cycles.

A cycle's findings are the kernel's bits of `Observation` and those of the arm, `ArmFinding`, in one number.
"""

from enum import IntFlag
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.compiled import compiled
from adacd_hil.records import ArmBatch, FaultReason

NEVER = 1 << 60
"""More cycles or periods than any run has."""


class ArmFinding(IntFlag):
    """What an ArmState says beside its measurements; bits that neither `Observation` nor its joints use."""

    ENABLED = 1 << 40
    COMPLETE = 1 << 41
    LATE = 1 << 42
    FAULTY = 1 << 43
    OLD = 1 << 44  # a value older than a cycle, which is too old if it stays so or exceeds its budget


class Calm(NamedTuple):
    """Bounds within which a cycle only counts; a cycle outside one of them has to be looked at.

    watched, expected: findings & watched is expected. cycles: so many may pass. periods: fewer than these may pass.
    due: the cycle's number is below.
    """

    watched: int
    expected: int
    cycles: int = NEVER
    periods: int = NEVER
    due: int = NEVER


def findings_of(arms: ArmBatch) -> NDArray[np.int64]:
    """Return the bits of `ArmFinding` of each cycle (n,)."""
    oldest = np.maximum(arms.age_q.max(axis=1, initial=0), arms.age_tau_J.max(axis=1, initial=0))
    findings = np.zeros(arms.cycle.size, dtype=np.int64)
    for bit, holds in (
        (ArmFinding.ENABLED, arms.is_enabled),
        (ArmFinding.COMPLETE, arms.is_complete),
        (ArmFinding.LATE, arms.is_late),
        (ArmFinding.FAULTY, arms.fault != FaultReason.NONE),
        (ArmFinding.OLD, oldest > 1),
    ):
        findings[holds] |= int(bit)
    return findings


@compiled
def is_calm(calm: Calm, findings: int, periods: int, cycle: int) -> bool:
    """Tell whether a cycle is within the bounds. periods: that have passed since they were drawn, its own included."""
    return findings & calm.watched == calm.expected and periods < calm.periods and cycle < calm.due
