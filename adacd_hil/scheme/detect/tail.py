"""The tail: a floor of each threshold by the largest residuals seen.

Each threshold is at least the largest residual that is to be expected in an hour, by the largest ones seen.

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
"""

import math

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.scheme.detect.sensitivity import MOVING
from adacd_hil.scheme.memory import Constants, Memory, TailConstants
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


def constants_of(settings: Settings) -> TailConstants:
    """Return the constants of the floor.

    excursions_Hz (2 C - 1,): independent excursions per second, by channel. block_cycles: length of a block.
    """
    a = np.array(settings.certified.cutoffs_rad_s)
    return TailConstants(
        excursions_Hz=np.concatenate([a, a[1:]]) / np.pi,
        block_cycles=max(round(BLOCK_S / settings.bus.period_s), 1),
    )


@compiled
def begin_tail(m: Memory) -> None:
    """Set the largest residuals, their floors `tail_Nm` and the time seen to 0, as for a new model."""
    m.tail.peak[:] = 0.0
    m.tail.tail_Nm[:] = 0.0
    m.tail.tail_s = 0.0
    discard_tail(m)


@compiled
def discard_tail(m: Memory) -> None:
    """Drop the residuals of the last block and the present one, as a contact is near; keep the largest ones."""
    m.tail.peak_now[:] = 0.0
    m.tail.peak_last[:] = 0.0
    m.tail.block_used = 0.0


@compiled
def follow_tail(k: Constants, m: Memory) -> None:
    """Add the residuals of one contact-free sample to the present block, except of joints that stood still lately.

    A residual counts as at most its threshold without the floor. At the end of a block renew the largest residuals, by
    the block before this one, and the floors `tail_Nm`; the largest ones fade over FORGOTTEN_S.
    """
    own = m.tail
    filters = m.filters.r.shape[0]
    for c in range(m.filters.y.shape[0]):
        still = m.sensitivity.still_smooth[c] if c < filters else m.sensitivity.still[filter_bank.filter_of(c, filters)]
        for i in range(m.filters.y.shape[1]):
            if still[i] < MOVING:
                seen = min(abs(m.filters.y[c, i]), m.sensitivity.h_model[c, i])
                sign = 0 if m.filters.y[c, i] < 0.0 else 1
                own.peak_now[sign, c, i] = max(own.peak_now[sign, c, i], seen)
    own.block_used += 1.0
    if own.block_used < k.tail.block_cycles:
        return
    block_s = own.block_used * k.period_s
    own.block_used = 0.0
    if np.max(own.peak_last) > 0.0:
        own.tail_s += block_s
    for c in range(m.filters.y.shape[0]):
        factor = tail_factor(k.tail.excursions_Hz[c], 0.5 * own.tail_s)
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
    """Return the largest ratio of a kept residual (`peak`) to its present threshold, of all channels and joints.

    The threshold is taken without the part for rest.
    """
    return float(np.max(m.tail.peak.max(axis=0) / np.maximum(np.maximum(m.sensitivity.h_model, m.tail.tail_Nm), 1e-12)))


@compiled
def tail_factor(excursions_Hz: float, seen_s: float) -> float:
    """Return m(T), the factor on the largest residual of seen_s that gives the largest one to expect in 1 / RATE.

    It is at least 1 and at most LARGEST. excursions_Hz: nu, independent excursions per second.
    """
    share = math.log(excursions_Hz / RATE_HZ) / math.log(max(excursions_Hz * max(seen_s, 1.0), 1.01))
    return float(min(np.sqrt(max(share, 1.0)), LARGEST))
