"""Earlier beliefs of the run as judges of later fits: a touch that has begun must be seen to end.

A hand that drags, or moves like a mass, has a column of the regressor, so a fit made during the touch explains it. Only
the arm as it was known before, without the hand, reveals the touch.

Over a touch the fit's earlier beliefs are *kept*, as rows of `evidence`. `fit_check` stores the last STEPS of them.
After an interrupting contact the kept ones are all of these, and the one at the contact. After a fit that no one model
explains they are those from before the change; after a refuted test, all. The first belief is not kept. The beginning
of the touch is not known. So a later fit must agree with each kept belief, in each quantity c that a hand can imitate:
a joint's friction at some speed, an inertia, an offset without an anchor:

    c (theta - theta_0) <= max(floor, SIGMAS sqrt(c (P_0 + P) c'))

Friction and an offset without an anchor must agree both ways: a person who pushes the arm on takes friction away. For
an inertia **less is the arm's**, and more is a touch that has not been seen to end. If an anchor gives the offset, a
belief with another offset comes from a lean and is forgotten; a belief with clearly negative friction is not used. The
first beliefs are uncertain and bound little.

**Kept beliefs lapse** if fits in a row, without a contact between, agree with each other against them. LITTLE_FITS fits
suffice if they have more by LITTLE times a bound and by LITTLE_NM on the trajectory at most: an undetected touch bends
the beliefs that it enters. LESS_FITS suffice if they have less friction, no more of any quantity and the same offsets:
a hand that was there before may have dragged. A hand as small as that, or that helps as long, is learnt then.
"""

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, Vector
from adacd_hil.scheme.identify import anchor, evidence, fit_check
from adacd_hil.scheme.identify.evidence import FRICTIONS, INERTIAS, KEPT, OFFSETS, REFUSED, VISCOUS
from adacd_hil.scheme.memory import Constants, Memory

YOUNG_STEPS = 1
"""Number of first beliefs that are not kept: a hand may have been there all that time, without a trace."""
LITTLE, LITTLE_NM, LITTLE_FITS = 2.0, 0.06, 2.0
"""Kept beliefs lapse for fits that agree: largest excess over a bound, its largest torque on the trajectory, and number
of such fits."""
LESS_FITS = 5.0
"""So many fits in a row, some 7 s, with less friction: a hand that dragged has let go then."""
FRICTION_NM = 0.03
OFFSET_NM = 0.03
INERTIA_KGM2 = 0.006
INERTIA_SHARE = 0.03
"""Differences below these, and below this share of an inertia, are ignored."""


_KEPT_FLOOR = np.array([FRICTION_NM] * FRICTIONS + [INERTIA_KGM2, np.inf, INERTIA_KGM2] + [OFFSET_NM] * JOINTS)
_KEPT_SHARE = np.repeat((0.0, INERTIA_SHARE, 0.0), (FRICTIONS, INERTIAS, JOINTS))
"""Ignored differences by quantity (VISCOUS,), Nm or kg m², and as a share of the value; inf for a2, which any touch of
the arm bends. A mass shows in a1 and a3."""


@compiled
def forget(m: Memory) -> None:
    """Drop the beliefs kept from before a touch; clear the count of refused fits and `has_lapsed`.

    Called when a certificate stands, or the user confirms that the arm is free of contact.
    """
    _drop(m)
    m.earlier.refused_fits = 0.0
    m.earlier.has_lapsed = 0.0


@compiled
def _drop(m: Memory) -> None:
    """Empty the sources of evidence of all beliefs kept from before a touch, and set `kept_count` to 0."""
    m.earlier.kept_count = 0.0
    for s in range(KEPT, m.evidence.value.shape[0]):
        evidence.empty_source(m, s)


@compiled
def is_keeping(m: Memory) -> bool:
    """Return whether at least one belief from before a touch is kept as evidence."""
    return bool(np.any(m.evidence.variance[KEPT:, 0] != np.inf))


@compiled
def keep_fit(k: Constants, m: Memory) -> None:
    """Keep the fit's present belief and those of its stored steps as evidence, as a touch may have begun.

    The first YOUNG_STEPS steps are not kept. If the fit contradicts itself, keep only the steps up to the last before
    that, and not the present belief. Keep none before the second step, or if beliefs are kept already. Set the count of
    refused fits to 0 in any case.
    """
    m.earlier.refused_fits = 0.0
    if m.earlier.kept_count > 0.0 or m.fit_check.steps_used <= YOUNG_STEPS:
        return
    changed = fit_check.last_step_before_contradiction(k, m)
    keep_steps(k, m, int(m.fit_check.steps_used) - 1 if changed == fit_check.NONE else changed)
    if changed == fit_check.NONE:
        keep_belief(k, m, m.models.belief, m.models.P_belief, fit_check.fit_unit(m), 0.0)


@compiled
def keep_steps(k: Constants, m: Memory, last: int) -> None:
    """Keep as evidence the fit's beliefs at its stored steps up to number `last`, counted from 0 since its begin.

    The first YOUNG_STEPS are not kept; -1 or less keeps none. Set the count of refused fits to 0. Do nothing if beliefs
    are kept already.
    """
    if m.earlier.kept_count > 0.0:
        return
    _drop(m)
    m.earlier.refused_fits = 0.0
    steps = m.fit_check.steps_rows.shape[0]
    for number in range(max(int(m.fit_check.steps_used) - steps, YOUNG_STEPS), last + 1):
        s = number % steps
        age_s = fit_check.STEP_S * (m.fit_check.steps_used - 1.0 - number)
        unit = fit_check.unit_of(m.fit_check.steps_square[s], m.fit_check.steps_rows[s])
        keep_belief(k, m, m.fit_check.steps_theta[s], m.fit_check.steps_P[s], unit, age_s)


@compiled
def keep_belief(k: Constants, m: Memory, theta: Vector, P: Vector, unit: float, age_s: float) -> None:
    """Keep a belief as the next source of evidence; leave the source empty if a friction is clearly negative.

    unit: scale of its variances, see `fit_check.unit_of`. age_s: time since the belief was held. An empty source counts
    as kept, too, in `kept_count`.
    """
    s = KEPT + int(m.earlier.kept_count)
    if not _fill_source(k, m, s, theta, P, unit):
        evidence.empty_source(m, s)
    evidence.set_age(m, s, s + 1, age_s)
    m.earlier.kept_count += 1.0


@compiled
def _fill_source(k: Constants, m: Memory, s: int, theta: Vector, P: Vector, unit: float) -> bool:
    """Fill source `s` from a belief, theta (p,) and P (p, p); return False if a friction is clearly below 0.

    Clearly: by more than its floor and BELIEF_SIGMAS deviations; a person who pushes the arm on makes it look so. The
    rows are filled in any case, a negative friction or inertia as 0. Rows of viscous friction stay. unit: scale of the
    variances, see `fit_check.unit_of`.
    """
    has_friction = True
    for q in range(VISCOUS):
        value, variance = evidence.of_belief(k, q, theta, P, unit)
        least = -max(_KEPT_FLOOR[q], evidence.BELIEF_SIGMAS * np.sqrt(variance))
        has_friction = has_friction and (q >= FRICTIONS or not value < least)
        value = max(value, 0.0) if q < OFFSETS else value
        evidence.set_row(m, s, q, value, variance, max(_KEPT_FLOOR[q], _KEPT_SHARE[q] * abs(value)), 0.0)
    return has_friction


@compiled
def is_no_more(k: Constants, m: Memory) -> bool:
    """Return whether the fit agrees with the kept beliefs: same friction and unanchored offsets, no more inertia.

    Call `evidence.fit` before. Store the comparisons as evidence. Drop a kept belief that comes from a lean, see
    `_is_leant_on`. Count a fit that contradicts the others only by little, or has less friction and no more else; if
    enough such fits in a row agree, drop all kept beliefs, set `has_lapsed` and return True, see `_lapses`. True also
    without kept beliefs.
    """
    is_no_more = True
    for s in range(KEPT, KEPT + int(m.earlier.kept_count)):
        for q in range(VISCOUS):
            evidence.weigh(k, m, s, q)
        if _is_leant_on(k, m, s):
            evidence.empty_source(m, s)
        for q in range(VISCOUS):
            if q >= OFFSETS and not anchor.is_open(k, m, q - OFFSETS):
                evidence.skip_row(m, s, q)
            is_no_more = is_no_more and abs(evidence.excess(m, s, q)) <= 1.0
    if not is_keeping(m):
        m.earlier.kept_count = 0.0
    if is_no_more:
        return True
    has_lapsed = _lapses(k, m)
    if has_lapsed:
        _drop(m)
        m.earlier.has_lapsed = 1.0
    return has_lapsed


@compiled
def _is_leant_on(k: Constants, m: Memory, s: int) -> bool:
    """Return whether kept belief `s` has another torque offset than the fit, and an anchor speaks for the fit's.

    An anchor does if it bounds the joint's offset, or excludes the kept belief's.
    """
    for i in range(m.anchor.anchor_Nm.shape[1]):
        q = OFFSETS + i
        is_another = abs(evidence.excess(m, s, q)) > 1.0
        if is_another and (not anchor.is_open(k, m, i) or anchor.is_excluded(m, i, m.evidence.value[s, q])):
            return True
    return False


@compiled
def _lapses(k: Constants, m: Memory) -> bool:
    """Count a fit that contradicts the kept beliefs; return whether enough such fits in a row agree to drop them.

    Enough: LITTLE_FITS if this fit differs by little, LESS_FITS if it has less friction and otherwise no more. A fit
    that disagrees with the refused one before starts the count at 1. Store the fit as source REFUSED.
    """
    own = m.earlier
    is_little, is_less, is_same, friction_Nm, else_Nm = True, True, True, 0.0, 0.0
    for q in range(VISCOUS):
        s = evidence.largest_excess(m, KEPT, KEPT + int(own.kept_count), q)
        excess = evidence.excess(m, s, q)
        is_little = is_little and abs(excess) <= (LITTLE if excess > 0.0 or q >= FRICTIONS else 1.0)
        is_less = is_less and excess <= 1.0 and (q < OFFSETS or excess >= -1.0)
        change_Nm = abs(m.evidence.difference[s, q]) * k.evidence.torque_Nm[q] if abs(excess) > 1.0 else 0.0
        if q < FRICTIONS:
            friction_Nm = max(friction_Nm, change_Nm)
        else:
            else_Nm += change_Nm
        is_same = is_same and (own.refused_fits == 0.0 or abs(evidence.weigh(k, m, REFUSED, q)) <= 1.0)
    _fill_source(k, m, REFUSED, m.models.belief, m.models.P_belief, fit_check.fit_unit(m))
    own.refused_fits = own.refused_fits + 1.0 if is_same else 1.0
    if is_little and friction_Nm + else_Nm <= LITTLE_NM:
        return bool(own.refused_fits >= LITTLE_FITS)
    return bool(is_less and own.refused_fits >= LESS_FITS)


def describe_more(m: Memory) -> list[str]:
    """Return a line for each quantity in which the fit contradicts a kept belief: how much, since when, likely cause.

    Of several beliefs the line names that with the largest excess, of a joint's friction only the speed with the
    largest. [] without a contradiction.
    """
    excesses = np.abs(m.evidence.difference[KEPT:] / m.evidence.limit[KEPT:])
    worst = KEPT + np.argmax(excesses, axis=0)
    return [_changed(m, worst[q], q, what, unit) for q, what, unit in evidence.named(excesses.max(axis=0))]


def _changed(m: Memory, s: int, q: int, what: str, unit: str) -> str:
    """Return a line about a contradiction: change of quantity `q` since kept belief `s`, its age, bound, likely cause.

    what, unit: name and unit of the quantity.
    """
    own = m.evidence
    change, limit, age_s = own.difference[s, q], own.limit[s, q], own.age_s[s]
    is_helped = q < FRICTIONS and change < 0.0
    why = "a hand helps the motion, or one that dragged has let go"
    if not is_helped:
        why = "a touch that began then has not been seen to end, or the arm does what the model doesn't know"
    return (
        f"{what} is {abs(change):.3f} {unit} {'more' if change > 0.0 else 'less'} than {age_s:.1f} s ago, "
        f"bound {limit:.3f} {unit}: {why}"
    )
