"""What was known earlier in the run judges what is learnt later: a touch that has begun must be seen to end.

A hand that drags, or moves like a mass, has a column of the regressor, so a fit made while it is there explains it.
What tells it apart is that the arm was known without it before.

Over a touch the fit's earlier beliefs are *kept*, as rows of `evidence`: where a contact interrupted it all of them and
the one at the contact, where no one model explains the fit (`fit_check`) those of before the change, after a refuted
test all. When the touch began is not known, so a later fit must agree with each, in each quantity c that a hand can
look like, a joint's friction at some speed, an inertia, an offset that nothing anchors:

    c (theta - theta_0) <= max(floor, SIGMAS sqrt(c (P_0 + P) c'))

Friction and an offset that nothing anchors must agree both ways: who pushes the arm on takes friction away. Of an
inertia **less is the arm's**, and more is a touch that has not been seen to end. Where an anchor gives the offset, a
belief that differs has been leant on, and is forgotten; one with clearly less friction than none says nothing. The
first beliefs know little and bound little.

**Kept beliefs lapse** where fits in a row, without a contact between, agree with each other against them: LITTLE_FITS,
if they have more by LITTLE times a bound and by LITTLE_NM on the trajectory at most, for a touch that nobody noticed
bends the beliefs it comes into; LESS_FITS, if they have less friction, and no more of anything and the same offsets,
for the hand that was there before may have dragged. A hand as small as that, or that helps as long, is learnt then.
"""

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, Vector
from adacd_hil.scheme.identify import anchor, evidence, fit_check
from adacd_hil.scheme.identify.evidence import FRICTIONS, INERTIAS, KEPT, OFFSETS, REFUSED, VISCOUS
from adacd_hil.scheme.memory import Constants, EarlierConstants, Memory

YOUNG_STEPS = 1
"""The first ones are not kept: for so long a hand may have been there all the time, and nothing could tell."""
LITTLE, LITTLE_NM, LITTLE_FITS = 2.0, 0.06, 2.0
"""How many times a bound fits that agree may have more, what may come of that on the trajectory, and how many they must
be, so that the kept beliefs lapse."""
LESS_FITS = 5.0
"""So many in a row, some 7 s, if they have less friction: a hand that dragged has let go then."""
FRICTION_NM = 0.03
OFFSET_NM = 0.03
INERTIA_KGM2 = 0.006
INERTIA_SHARE = 0.03
"""Less than these, and less than this share of an inertia, is nothing."""


def constants_of() -> EarlierConstants:
    """Return `kept_floor`, `kept_share` (VISCOUS,): what is nothing; inf of a2, which any touch of the arm bends.

    A mass shows in a1 and a3.
    """
    floors = [FRICTION_NM] * FRICTIONS + [INERTIA_KGM2, np.inf, INERTIA_KGM2] + [OFFSET_NM] * JOINTS
    shares = np.repeat((0.0, INERTIA_SHARE, 0.0), (FRICTIONS, INERTIAS, JOINTS))
    return EarlierConstants(kept_floor=np.array(floors), kept_share=shares)


@compiled
def forget(m: Memory) -> None:
    """Keep nothing: a certificate stands, or the user says that nobody touches the arm."""
    _drop(m)
    m.earlier.refused_fits = 0.0
    m.earlier.has_lapsed = 0.0


@compiled
def _drop(m: Memory) -> None:
    m.earlier.kept_count = 0.0
    for s in range(KEPT, m.evidence.said.shape[0]):
        evidence.retract(m, s)


@compiled
def is_keeping(m: Memory) -> bool:
    """Tell whether something is kept that has not been forgotten since."""
    return bool(np.any(m.evidence.said_variance[KEPT:, 0] != np.inf))


@compiled
def keep(k: Constants, m: Memory) -> None:
    """Keep what the fit has come to, and how it came about, if nothing is kept yet: a touch may have begun.

    Of a fit that has changed on the way only what it had come to before.
    """
    m.earlier.refused_fits = 0.0
    if m.earlier.kept_count > 0.0 or m.fit_check.steps_used <= YOUNG_STEPS:
        return
    changed = fit_check.last_step_before_contradiction(k, m)
    keep_steps(k, m, int(m.fit_check.steps_used) - 1 if changed == fit_check.NONE else changed)
    if changed == fit_check.NONE:
        _keep(
            k,
            m,
            m.models.belief,
            m.models.P_belief,
            fit_check.unit_of(m.fit_check.fit_square, m.fit_check.fit_rows),
            0.0,
        )


@compiled
def keep_steps(k: Constants, m: Memory, last: int) -> None:
    """Keep the fit's steps up to this number, if nothing is kept yet."""
    if m.earlier.kept_count > 0.0:
        return
    _drop(m)
    m.earlier.refused_fits = 0.0
    steps = m.fit_check.steps_rows.shape[0]
    for number in range(max(int(m.fit_check.steps_used) - steps, YOUNG_STEPS), last + 1):
        s = number % steps
        age_s = fit_check.STEP_S * (m.fit_check.steps_used - 1.0 - number)
        unit = fit_check.unit_of(m.fit_check.steps_square[s], m.fit_check.steps_rows[s])
        _keep(k, m, m.fit_check.steps_theta[s], m.fit_check.steps_P[s], unit, age_s)


@compiled
def _keep(k: Constants, m: Memory, theta: Vector, P: Vector, unit: float, age_s: float) -> None:
    s = KEPT + int(m.earlier.kept_count)
    if not _say(k, m, s, theta, P, unit):
        evidence.retract(m, s)
    evidence.date(m, s, s + 1, age_s)
    m.earlier.kept_count += 1.0


@compiled
def _say(k: Constants, m: Memory, s: int, theta: Vector, P: Vector, unit: float) -> bool:
    """Fill a source's rows with what a belief says; tell whether no friction is clearly less than none.

    Who pushes the arm on looks like less than none: what is less counts as none.
    """
    has_friction = True
    for q in range(VISCOUS):
        value, variance = evidence.of_belief(k, q, theta, P, unit)
        least = -max(k.earlier.kept_floor[q], evidence.BELIEF_SIGMAS * np.sqrt(variance))
        has_friction = has_friction and (q >= FRICTIONS or not value < least)
        value = max(value, 0.0) if q < OFFSETS else value
        evidence.say(m, s, q, value, variance, max(k.earlier.kept_floor[q], k.earlier.kept_share[q] * abs(value)), 0.0)
    return has_friction


@compiled
def is_no_more(k: Constants, m: Memory) -> bool:
    """Tell whether the fit has the friction of what was kept, no more inertia, and no other unanchored offset.

    The fit's offsets keep to their anchors. A kept belief whose offsets don't has been leant on, and is forgotten.
    """
    is_no_more = True
    for s in range(KEPT, KEPT + int(m.earlier.kept_count)):
        for q in range(VISCOUS):
            evidence.weigh(k, m, s, q)
        if _is_leant_on(k, m, s):
            evidence.retract(m, s)
        for q in range(VISCOUS):
            if q >= OFFSETS and not anchor.is_open(k, m, q - OFFSETS):
                evidence.pass_over(m, s, q)
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
    """Tell whether a kept belief has another offset than the fit where an anchor gives it, or excludes the other."""
    for i in range(m.anchor.anchor_Nm.shape[1]):
        q = OFFSETS + i
        is_another = abs(evidence.excess(m, s, q)) > 1.0
        if is_another and (not anchor.is_open(k, m, i) or anchor.is_excluded(m, i, m.evidence.said[s, q])):
            return True
    return False


@compiled
def _lapses(k: Constants, m: Memory) -> bool:
    """Tell whether enough fits in a row have been refused for the same, as large as it is; remember this one."""
    is_little, is_less, is_same, friction_Nm, else_Nm = True, True, True, 0.0, 0.0
    for q in range(VISCOUS):
        s = evidence.foremost(m, KEPT, KEPT + int(m.earlier.kept_count), q)
        excess = evidence.excess(m, s, q)
        is_little = is_little and abs(excess) <= (LITTLE if excess > 0.0 or q >= FRICTIONS else 1.0)
        is_less = is_less and excess <= 1.0 and (q < OFFSETS or excess >= -1.0)
        change_Nm = abs(m.evidence.difference[s, q]) * k.evidence.torque_Nm[q] if abs(excess) > 1.0 else 0.0
        if q < FRICTIONS:
            friction_Nm = max(friction_Nm, change_Nm)
        else:
            else_Nm += change_Nm
        is_same = is_same and (m.earlier.refused_fits == 0.0 or abs(evidence.weigh(k, m, REFUSED, q)) <= 1.0)
    _say(
        k,
        m,
        REFUSED,
        m.models.belief,
        m.models.P_belief,
        fit_check.unit_of(m.fit_check.fit_square, m.fit_check.fit_rows),
    )
    m.earlier.refused_fits = m.earlier.refused_fits + 1.0 if is_same else 1.0
    if is_little and friction_Nm + else_Nm <= LITTLE_NM:
        return bool(m.earlier.refused_fits >= LITTLE_FITS)
    return bool(is_less and m.earlier.refused_fits >= LESS_FITS)


def describe_more(m: Memory) -> list[str]:
    """Say in which quantities the fit contradicts what was kept, by how much and since when, a line each.

    Of a joint's friction only the speed at which it stands out most.
    """
    excesses = np.abs(m.evidence.difference[KEPT:] / m.evidence.limit[KEPT:])
    worst = KEPT + np.argmax(excesses, axis=0)
    return [_changed(m, worst[q], q, what, unit) for q, what, unit in evidence.named(excesses.max(axis=0))]


def _changed(m: Memory, s: int, q: int, what: str, unit: str) -> str:
    change, limit, age_s = (
        float(m.evidence.difference[s, q]),
        float(m.evidence.limit[s, q]),
        float(m.evidence.said_age_s[s]),
    )
    is_helped = q < FRICTIONS and change < 0.0
    why = "a hand helps the motion, or one that dragged has let go"
    if not is_helped:
        why = "a touch that began then has not been seen to end, or the arm does what the model doesn't know"
    return (
        f"{what} is {abs(change):.3f} {unit} {'more' if change > 0.0 else 'less'} than {age_s:.1f} s ago, "
        f"bound {limit:.3f} {unit}: {why}"
    )
