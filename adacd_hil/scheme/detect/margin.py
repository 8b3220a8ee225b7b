"""Margins of detection: floor by the largest residual seen, smallest detectable push, and the change of both.

**Tail.** Each threshold is at least the largest residual that is to be expected in an hour, by the largest ones seen.

A threshold follows from noise and from the belief's uncertainty. Other errors, a friction that sticks at one place or a
sensor that errs, show as a residual that comes near the threshold. With excursions above a level that die out like a
Gaussian's, nu of them a second that are independent, and the largest of T seconds known, the largest of 1 / RATE is

    m(T) = sqrt(ln(nu / RATE) / ln(nu T)) times that,    nu = cut-off / pi,    T >= 1 s, m <= LARGEST

An error of the model has both signs in turn, a push has one. So the largest positive and the largest negative residual
are kept apart, each with half of the time seen, and the floor follows from the smaller one: a push that grows slowly
can't raise a threshold above m times the largest residual of the other sign. A residual counts once its block and the
next one are over; a sample held back from a contact doesn't count. It counts as no more than the threshold without the
floor. It is forgotten over FORGOTTEN_S without contact.

Shapes: peak, peak_now, peak_last (2, 2 C - 1, n), negative residuals first; tail_Nm (2 C - 1, n). Units: Nm.

**Sight.** The smallest push that detection finds in time.

A channel whose response to a step of 1 is g after WITHIN_S is then over its threshold h, whatever the sign, if

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
from adacd_hil.scheme.detect import sensitivity
from adacd_hil.scheme.detect.sensitivity import AGREES, MOVING
from adacd_hil.scheme.memory import Constants, MarginConstants, Memory
from adacd_hil.scheme.model import filter_bank
from adacd_hil.settings.configuration import Settings

HOUR_S = 3600.0
RATE_HZ = 1.0 / HOUR_S
"""Expected rate of excursions over the floor: one an hour."""
LARGEST = 1.6
"""With a larger one, the threshold of the first seconds of an arm with 1 kg hides a push of 0.1 Nm."""
FORGOTTEN_S = 600.0
BLOCK_S = 0.064
"""Longer than the hold-back of a touch before its detection."""


def constants_of(settings: Settings) -> MarginConstants:
    """Return the constants by which thresholds get a floor and the smallest push is estimated.

    excursions_Hz (2 C - 1,): independent excursions per second, by channel. shown (2 C - 1,): response to a step of 1
    after WITHIN_S. block_cycles, mean_cycles: length of a block of the tail, and of a mean of the smallest push.
    """
    a = np.array(settings.certified.cutoffs_rad_s)
    return MarginConstants(
        excursions_Hz=np.concatenate([a, a[1:]]) / np.pi,
        block_cycles=max(round(BLOCK_S / settings.bus.period_s), 1),
        mean_cycles=round(MEAN_S / settings.bus.period_s),
        shown=np.array(
            [filter_bank.step_response(WITHIN_S, *channel) for channel in filter_bank.channels_of(settings)]
        ),
    )


@compiled
def begin_tail(m: Memory) -> None:
    """Set the largest residuals, their floors `tail_Nm` and the time seen to 0, as for a new model."""
    m.margin.peak[:] = 0.0
    m.margin.tail_Nm[:] = 0.0
    m.margin.tail_s = 0.0
    discard_tail(m)


@compiled
def discard_tail(m: Memory) -> None:
    """Drop the residuals of the last block and the present one, as a contact is near; keep the largest ones."""
    m.margin.peak_now[:] = 0.0
    m.margin.peak_last[:] = 0.0
    m.margin.block_used = 0.0


@compiled
def follow_tail(k: Constants, m: Memory) -> None:
    """Add the residuals of one contact-free sample to the present block, except of joints that stood still lately.

    A residual counts as at most its threshold without the floor. At the end of a block renew the largest residuals, by
    the block before this one, and the floors `tail_Nm`; the largest ones fade over FORGOTTEN_S.
    """
    own = m.margin
    filters = m.filters.r.shape[0]
    for c in range(m.filters.y.shape[0]):
        still = m.sensitivity.still_smooth[c] if c < filters else m.sensitivity.still[filter_bank.filter_of(c, filters)]
        for i in range(m.filters.y.shape[1]):
            if still[i] < sensitivity.MOVING:
                seen = min(abs(m.filters.y[c, i]), m.sensitivity.h_model[c, i])
                sign = 0 if m.filters.y[c, i] < 0.0 else 1
                own.peak_now[sign, c, i] = max(own.peak_now[sign, c, i], seen)
    own.block_used += 1.0
    if own.block_used < k.margin.block_cycles:
        return
    block_s = own.block_used * k.period_s
    own.block_used = 0.0
    if np.max(own.peak_last) > 0.0:
        own.tail_s += block_s
    for c in range(m.filters.y.shape[0]):
        factor = tail_factor(k.margin.excursions_Hz[c], 0.5 * own.tail_s)
        for i in range(m.filters.y.shape[1]):
            for sign in range(2):
                kept = own.peak[sign, c, i] * (1.0 - block_s / FORGOTTEN_S)
                own.peak[sign, c, i] = max(kept, own.peak_last[sign, c, i])
                own.peak_last[sign, c, i] = own.peak_now[sign, c, i]
                own.peak_now[sign, c, i] = 0.0
            own.tail_Nm[c, i] = factor * min(own.peak[0, c, i], own.peak[1, c, i])


def rate_per_h(excursions_Hz: float, seen_s: float, largest_share: float) -> float:
    """Return the expected excursions over a threshold per hour for a Gaussian tail: 3600 nu (nu T)^(-1 / s²).

    excursions_Hz: nu, independent excursions per second. seen_s: T. largest_share: s, largest residual in T over the
    threshold; 1 / s = m(T) gives RATE. 0 without a residual.
    """
    if not largest_share**2 > 0.0:
        return 0.0
    seen = max(excursions_Hz * max(seen_s, 1.0), 1.01)
    return float(HOUR_S * excursions_Hz * seen ** (-1.0 / largest_share**2))


def largest_share(m: Memory) -> float:
    """Return the largest ratio of a kept residual (`peak`) to its present threshold, of all channels and joints."""
    return float(
        np.max(m.margin.peak.max(axis=0) / np.maximum(np.maximum(m.sensitivity.h_model, m.margin.tail_Nm), 1e-12))
    )


@compiled
def tail_factor(excursions_Hz: float, seen_s: float) -> float:
    """Return m(T), the factor on the largest residual of seen_s that gives the largest one to expect in 1 / RATE.

    It is at least 1 and at most LARGEST. excursions_Hz: nu, independent excursions per second.
    """
    share = math.log(excursions_Hz / RATE_HZ) / math.log(max(excursions_Hz * max(seen_s, 1.0), 1.01))
    return float(min(np.sqrt(max(share, 1.0)), LARGEST))


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


@compiled
def smallest_push(y: Vector, h: Vector, shown: Vector, joint: int) -> float:
    """Return the smallest push on a joint, Nm, detected within WITHIN_S if the present y and h stay as they are.

    joint: from 0.
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
    own = m.margin
    own.seen[:] = 0.0
    own.seen_worst_Nm[:] = 0.0
    own.seen_push_Nm[:] = 0.0
    own.sum_push_Nm[:] = 0.0
    own.sum_cycles[:] = 0.0
    own.dim_s[:] = 0.0


@compiled
def follow_test(k: Constants, m: Memory) -> None:
    """Count each joint's least threshold in one sample of a test; keep the largest, and the largest `smallest_push`."""
    own = m.margin
    for i in range(own.dim_s.shape[0]):
        h = m.sensitivity.wide_threshold[i]
        place = int(math.log(max(h / LOWEST_NM, 1.0)) / WIDTH)
        own.seen[min(place, BINS - 1), i] += 1.0
        own.seen_worst_Nm[i] = max(own.seen_worst_Nm[i], h)
        own.seen_push_Nm[i] = max(own.seen_push_Nm[i], smallest_push(m.filters.y, m.sensitivity.h, k.margin.shown, i))


@compiled
def follow_sight(k: Constants, m: Memory) -> bool:
    """Add one contact-free sample of monitoring to the mean smallest push; return whether to revoke the certificate.

    True if a joint's mean over each MEAN_S of motion was over LESS times the worst of the test for BLIND_S in a row;
    False in cycles that end no mean. Skip a joint that stood still lately.
    """
    own = m.margin
    is_blind = False
    for i in range(own.dim_s.shape[0]):
        if m.sensitivity.still[filter_bank.LEARNT, i] >= MOVING:
            continue
        own.sum_push_Nm[i] += smallest_push(m.filters.y, m.sensitivity.h, k.margin.shown, i)
        own.sum_cycles[i] += 1.0
        if own.sum_cycles[i] < k.margin.mean_cycles:
            continue
        own.mean_push_Nm[i] = own.sum_push_Nm[i] / own.sum_cycles[i]
        is_dim = not own.mean_push_Nm[i] <= LESS * own.seen_push_Nm[i]
        own.dim_s[i] = own.dim_s[i] + MEAN_S if is_dim else 0.0
        own.sum_push_Nm[i] = 0.0
        own.sum_cycles[i] = 0.0
        is_blind = is_blind or own.dim_s[i] >= BLIND_S
    return is_blind


def describe_sight(m: Memory) -> str:
    """Return the smallest push, thresholds and residuals of the last test as one text, each as "joint 1 / joint 2"."""
    seen = np.cumsum(m.margin.seen, axis=0)
    worst_Nm = m.margin.seen_worst_Nm
    median, most = ([_quantile(seen[:, i], worst_Nm[i], share) for i in range(JOINTS)] for share in (0.5, 0.99))
    return (
        f"a push of {_by_joint(m.margin.seen_push_Nm)} Nm would be found within {1e3 * WITHIN_S:g} ms at the worst "
        f"moment of the test, thresholds {_by_joint(median)} Nm in the middle, {_by_joint(most)} in 99 %, "
        f"{_by_joint(worst_Nm)} at worst; its residuals came to {100.0 * largest_share(m):.0f} % of their thresholds"
    )


def describe_push(m: Memory) -> str:
    """Return the smallest push per joint that is found at the worst moment of the last test, as a short text."""
    pushes = " / ".join(f"{value:.2f}" for value in m.margin.seen_push_Nm)
    return f"pushes of {pushes} Nm at the joints: found within {1e3 * WITHIN_S:g} ms (estimate)"


def describe_dim(m: Memory) -> list[str]:
    """Return a line for each joint whose last mean smallest push is over LESS times the worst of the test.

    [] without such a joint. A line gives both pushes, for how long, and the cause.
    """
    own = m.margin
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
    if np.any(m.margin.tail_Nm[:, joint] > m.sensitivity.h_model[:, joint]):
        return "residuals of both signs have come near the thresholds: the arm moves otherwise than its model"
    if m.sensitivity.strain[joint] > STRAIN_NAMED:
        return f"contacts right after going on have raised its thresholds {m.sensitivity.strain[joint]:.1f} times"
    if m.sensitivity.velocity_roughness[joint] > ROUGH_NAMED:
        return (
            f"its velocity has {math.sqrt(m.sensitivity.velocity_roughness[joint]):.1f} times the noise of the settings"
        )
    if np.any(m.sensitivity.lost[:, joint] > 0.0):
        return "samples are missing"
    times = math.sqrt(m.sensitivity.unit[joint])
    return f"its residuals have come to {times:.1f} times what the settings call a good model's"


def _quantile(seen: Vector, worst_Nm: float, share: float) -> float:
    """Return the threshold, Nm, that this share of the cycles doesn't exceed, at most worst_Nm.

    seen (bins,): cycles up to each bin. The result is the upper end of a bin.
    """
    place = int(np.searchsorted(seen, share * seen[-1]))
    if place == BINS - 1:
        return float(worst_Nm)
    return min(LOWEST_NM * float(math.exp(WIDTH * (place + 1))), float(worst_Nm))


def _by_joint(values_Nm: Iterable[float]) -> str:
    return " / ".join(f"{value:.3f}" for value in values_Nm)
