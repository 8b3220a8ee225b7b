"""What detection can see: thresholds in force, and the smallest push that is found in time.

A channel whose response to a step of 1 is g after WITHIN_S is then over its threshold h, whatever the sign, if

    |tau_ext| > (h + |y|) / g

with y what it shows without the push. A bare channel counts only if the smoothed one of its filter is over AGREES h as
well (`sensitivity`). Of all channels the least counts. The threshold *in force* is the least h.

Both are an estimate: they assume that thresholds and residuals stay as they are meanwhile. A certificate states them
over its test. While the arm monitors, a second in which a joint moves and the mean of the smallest push is more than
LESS times the worst of that test is said.

Shapes: C filters, n joints; y, h (2 C - 1, n); shown (2 C - 1,): g; seen (bins, n): cycles by threshold in force;
seen_worst_Nm, seen_push_Nm, sum_push_Nm, sum_cycles (n,). Units: Nm.
"""

import math
from typing import Any

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, Vector
from adacd_hil.scheme.detect.sensitivity import AGREES, MOVING
from adacd_hil.scheme.model import bank
from adacd_hil.settings.configuration import Settings

WITHIN_S = 0.1
"""The slowest filter is at 0.63 of a step by then, without its smoothing."""
LESS = 2.0
"""How many times the smallest push of the certificate it may be without a word."""
LOWEST_NM, WIDTH, BINS = 1e-3, 0.02, 512
"""Thresholds are counted in bins that are 2 % wide, from 1 mNm to 28 Nm."""
FEWEST = 100
"""Cycles of motion in a second from which on its mean says something."""


def constants_of(settings: Settings) -> dict[str, Vector]:
    """Return `shown` (2 C - 1,)."""
    return {"shown": np.array([bank.step_response(WITHIN_S, *channel) for channel in bank.channels_of(settings)])}


def shapes_of() -> dict[str, tuple[int, ...]]:
    """Return the shapes of what is remembered, by name."""
    each = (JOINTS,)
    return {
        "seen": (BINS, JOINTS),
        **dict.fromkeys(("seen_worst_Nm", "seen_push_Nm", "sum_push_Nm", "sum_cycles"), each),
    }


@compiled
def smallest_push(y: Vector, h: Vector, shown: Vector, joint: int) -> float:
    """Return the smallest push on a joint that is found within WITHIN_S if all stays as it is now."""
    filters = (y.shape[0] + 1) // 2
    least = np.inf
    for c in range(y.shape[0]):
        push = (h[c, joint] + abs(y[c, joint])) / shown[c]
        if c >= filters:
            smoothed = bank.filter_of(c, filters)
            push = max(push, (AGREES * h[smoothed, joint] + abs(y[smoothed, joint])) / shown[smoothed])
        least = min(least, push)
    return float(least)


@compiled
def begin(m: Any) -> None:
    """Begin a test."""
    m["seen"][:] = 0.0
    m["seen_worst_Nm"][:] = 0.0
    m["seen_push_Nm"][:] = 0.0
    m["sum_push_Nm"][:] = 0.0
    m["sum_cycles"][:] = 0.0


@compiled
def follow_test(k: Any, m: Any) -> None:
    """Take in one sample of a test, without contact."""
    for i in range(m["seen"].shape[1]):
        h = m["wide_threshold"][i]
        place = int(math.log(max(h / LOWEST_NM, 1.0)) / WIDTH)
        m["seen"][min(place, BINS - 1), i] += 1.0
        m["seen_worst_Nm"][i] = max(m["seen_worst_Nm"][i], h)
        m["seen_push_Nm"][i] = max(m["seen_push_Nm"][i], smallest_push(m["y"], m["h"], k["shown"], i))


@compiled
def follow(k: Any, m: Any) -> None:
    """Take in one sample of monitoring, without contact."""
    for i in range(m["seen"].shape[1]):
        if m["still"][bank.LEARNT, i] < MOVING:
            m["sum_push_Nm"][i] += smallest_push(m["y"], m["h"], k["shown"], i)
            m["sum_cycles"][i] += 1.0


def describe(m: Any) -> str:
    """Say what the last test has seen, joints separated by strokes."""
    seen = np.cumsum(m["seen"], axis=0)
    worst_Nm = m["seen_worst_Nm"]
    median, most = ([_quantile(seen[:, i], worst_Nm[i], share) for i in range(JOINTS)] for share in (0.5, 0.99))
    return (
        f"a push of {_by_joint(m['seen_push_Nm'])} Nm would be found within {1e3 * WITHIN_S:g} ms at the worst moment "
        f"of the test, thresholds {_by_joint(median)} Nm in the middle, {_by_joint(most)} in 99 %, "
        f"{_by_joint(worst_Nm)} at worst"
    )


def take_warning(m: Any) -> str:
    """Say which joints have seen less since the last call than in the test; empty if none."""
    lines = []
    for i in range(JOINTS):
        if m["sum_cycles"][i] >= FEWEST:
            push_Nm = m["sum_push_Nm"][i] / m["sum_cycles"][i]
            if push_Nm > LESS * m["seen_push_Nm"][i]:
                lines.append(
                    f"joint {i + 1} sees less than was certified: within {1e3 * WITHIN_S:g} ms it finds pushes from "
                    f"{push_Nm:.2f} Nm on, a second's mean; in the test from {m['seen_push_Nm'][i]:.2f} Nm on at worst"
                )
    for name in ("sum_push_Nm", "sum_cycles"):
        m[name] = 0.0
    return "; ".join(lines)


def _quantile(seen: Vector, worst_Nm: float, share: float) -> float:
    """Return the upper end of the bin up to which this share of the cycles is; the worst where that is less."""
    place = int(np.searchsorted(seen, share * seen[-1]))
    if place == BINS - 1:
        return float(worst_Nm)
    return min(LOWEST_NM * float(math.exp(WIDTH * (place + 1))), float(worst_Nm))


def _by_joint(values_Nm: Any) -> str:
    return " / ".join(f"{value:.3f}" for value in values_Nm)
