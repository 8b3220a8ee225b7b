"""The smallest push that detection finds in time, and its change since the certificate.

A channel responds to a step of 1 by g after WITHIN_S. A step tau_ext takes it over its threshold h by then, whatever
the sign, if

    |tau_ext| > (h + |y|) / g

with y the channel's output without the push. A bare channel counts only if the smoothed one of its filter is over
AGREES h as well (`sensitivity`). Of all channels the least counts. The threshold *in force* is the least h.

Both are an estimate: they assume that thresholds and residuals stay as they are meanwhile. A certificate states them
over its test. While the arm monitors, the mean of the smallest push over each second of motion is compared with the
worst of that test. A mean of more than LESS times that is a warning. BLIND_S of it in a row take the certificate back.

Shapes: C filters, n joints; y, h (2 C - 1, n); shown (2 C - 1,): g; seen (bins, n): cycles by threshold in force;
seen_worst_Nm, seen_push_Nm, sum_push_Nm, sum_cycles, mean_push_Nm, dim_s (n,). Units: Nm.
"""

import math
from collections.abc import Iterable

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, Vector
from adacd_hil.scheme.detect import tail
from adacd_hil.scheme.detect.sensitivity import AGREES, MOVING
from adacd_hil.scheme.memory import Constants, Memory, SightConstants
from adacd_hil.scheme.model import filter_bank
from adacd_hil.settings.configuration import Settings

WITHIN_S = 0.1
"""The slowest filter is at 0.63 of a step by then, without its smoothing."""
LESS = 2.0
"""How many times the certificate's smallest push is allowed without a warning."""
STRAIN_NAMED, ROUGH_NAMED = 1.5, 4.0
"""From these values on, strain, and the square of the velocity's noise, are named as causes of a raised threshold."""
LOWEST_NM, WIDTH, BINS = 1e-3, 0.02, 512
"""Thresholds are counted in bins that are 2 % wide, from 1 mNm to 28 Nm."""
MEAN_S, BLIND_S = 1.0, 3.0
"""Motion over which the smallest push is averaged, and longest time for which the mean may be over LESS times."""


def constants_of(settings: Settings) -> SightConstants:
    """Return the constants by which the smallest push is estimated.

    shown (2 C - 1,): response of each channel to a step of 1 after WITHIN_S. mean_cycles: length of a mean.
    """
    return SightConstants(
        mean_cycles=round(MEAN_S / settings.bus.period_s),
        shown=np.array(
            [filter_bank.step_response(WITHIN_S, *channel) for channel in filter_bank.channels_of(settings)]
        ),
    )


@compiled
def smallest_push(y: Vector, h: Vector, shown: Vector, joint: int) -> float:
    """Return the smallest push on a joint, Nm, that is detected within WITHIN_S whatever its sign.

    It assumes that y and h stay as they are. y, h (2 C - 1, n): output and threshold of each channel, Nm. shown (2 C -
    1,): response of each channel to a step of 1, as in `constants_of`. joint: from 0.
    """
    filters = (y.shape[0] + 1) // 2
    least = np.inf
    for c in range(y.shape[0]):
        push = (h[c, joint] + abs(y[c, joint])) / shown[c]
        if c >= filters:
            smoothed = filter_bank.filter_of(c, filters)
            push = max(push, (AGREES * h[smoothed, joint] + abs(y[smoothed, joint])) / shown[smoothed])
        least = min(least, push)
    return float(least)


@compiled
def begin_sight(m: Memory) -> None:
    """Begin a test: set its counts of thresholds and its worst values to 0, and the sums and times of monitoring."""
    own = m.sight
    own.seen[:] = 0.0
    own.seen_worst_Nm[:] = 0.0
    own.seen_push_Nm[:] = 0.0
    own.sum_push_Nm[:] = 0.0
    own.sum_cycles[:] = 0.0
    own.dim_s[:] = 0.0


@compiled
def follow_test(k: Constants, m: Memory) -> None:
    """Count each joint's least threshold in one sample of a test; keep the largest, and the largest `smallest_push`."""
    own = m.sight
    for i in range(own.dim_s.shape[0]):
        h = m.sensitivity.wide_threshold[i]
        place = int(math.log(max(h / LOWEST_NM, 1.0)) / WIDTH)
        own.seen[min(place, BINS - 1), i] += 1.0
        own.seen_worst_Nm[i] = max(own.seen_worst_Nm[i], h)
        own.seen_push_Nm[i] = max(own.seen_push_Nm[i], smallest_push(m.filters.y, m.sensitivity.h, k.sight.shown, i))


@compiled
def follow_sight(k: Constants, m: Memory) -> bool:
    """Add one contact-free sample of monitoring to the mean smallest push; return whether to revoke the certificate.

    True if a joint's mean over each MEAN_S of motion was over LESS times the worst of the test for BLIND_S in a row;
    False in cycles that end no mean. Skip a joint that stood still lately.
    """
    own = m.sight
    is_blind = False
    for i in range(own.dim_s.shape[0]):
        if m.sensitivity.still[filter_bank.LEARNT, i] >= MOVING:
            continue
        own.sum_push_Nm[i] += smallest_push(m.filters.y, m.sensitivity.h, k.sight.shown, i)
        own.sum_cycles[i] += 1.0
        if own.sum_cycles[i] < k.sight.mean_cycles:
            continue
        own.mean_push_Nm[i] = own.sum_push_Nm[i] / own.sum_cycles[i]
        is_dim = not own.mean_push_Nm[i] <= LESS * own.seen_push_Nm[i]
        own.dim_s[i] = own.dim_s[i] + MEAN_S if is_dim else 0.0
        own.sum_push_Nm[i] = 0.0
        own.sum_cycles[i] = 0.0
        is_blind = is_blind or own.dim_s[i] >= BLIND_S
    return is_blind


def describe_sight(m: Memory) -> str:
    """Return smallest push and thresholds of the last test, each as "joint 1 / joint 2", as one text.

    With the largest ratio of a kept residual to its threshold, of all joints, in %.
    """
    seen = np.cumsum(m.sight.seen, axis=0)
    worst_Nm = m.sight.seen_worst_Nm
    median, most = ([_quantile(seen[:, i], worst_Nm[i], share) for i in range(JOINTS)] for share in (0.5, 0.99))
    return (
        f"a push of {_by_joint(m.sight.seen_push_Nm)} Nm would be found within {1e3 * WITHIN_S:g} ms at the worst "
        f"moment of the test, thresholds {_by_joint(median)} Nm in the middle, {_by_joint(most)} in 99 %, "
        f"{_by_joint(worst_Nm)} at worst; its residuals came to {100.0 * tail.largest_share(m):.0f} % of their "
        "thresholds"
    )


def describe_push(m: Memory) -> str:
    """Return the smallest push per joint that is found at the worst moment of the last test, as a short text."""
    pushes = " / ".join(f"{value:.2f}" for value in m.sight.seen_push_Nm)
    return f"pushes of {pushes} Nm at the joints: found within {1e3 * WITHIN_S:g} ms (estimate)"


def describe_dim(m: Memory) -> list[str]:
    """Return a line for each joint whose last mean smallest push is over LESS times the worst of the test.

    [] without such a joint. A line gives both pushes, for how long, and the cause.
    """
    own = m.sight
    return [
        f"joint {i + 1} sees less than was certified: for {own.dim_s[i]:g} s of motion it has found pushes from "
        f"{own.mean_push_Nm[i]:.2f} Nm on within {1e3 * WITHIN_S:g} ms, in the test from "
        f"{own.seen_push_Nm[i]:.2f} Nm on at worst; {_why_dim(m, i)}"
        for i in range(JOINTS)
        if own.dim_s[i] > 0.0
    ]


def _why_dim(m: Memory, joint: int) -> str:
    """Return the first cause that applies to the raised thresholds of a joint, from 0, as text.

    The last cause, residuals over the settings', is returned if no other applies.
    """
    if np.any(m.tail.tail_Nm[:, joint] > m.sensitivity.h_model[:, joint]):
        return "residuals of both signs have come near the thresholds: the arm moves otherwise than its model"
    if m.sensitivity.strain[joint] > STRAIN_NAMED:
        return f"contacts right after going on have raised its thresholds {m.sensitivity.strain[joint]:.1f} times"
    if m.sensitivity.velocity_roughness[joint] > ROUGH_NAMED:
        return (
            f"its velocity has {math.sqrt(m.sensitivity.velocity_roughness[joint]):.1f} times the noise of the settings"
        )
    if np.any(m.lost.lost_Nm2[:, joint] > 0.0):
        return "samples are missing"
    times = math.sqrt(m.sensitivity.unit[joint])
    return f"its residuals have come to {times:.1f} times what the settings call a good model's"


def _quantile(seen: Vector, worst_Nm: float, share: float) -> float:
    """Return the threshold, Nm, that this share of the cycles doesn't exceed, at most worst_Nm.

    seen (bins,): cycles up to each bin. The result is the upper end of a bin, or worst_Nm if that is lower or the bin
    is the last one.
    """
    place = int(np.searchsorted(seen, share * seen[-1]))
    if place == BINS - 1:
        return float(worst_Nm)
    return min(LOWEST_NM * float(math.exp(WIDTH * (place + 1))), float(worst_Nm))


def _by_joint(values_Nm: Iterable[float]) -> str:
    return " / ".join(f"{value:.3f}" for value in values_Nm)
