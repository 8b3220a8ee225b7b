"""What was known earlier in the run judges what is learnt later: a touch that has begun must be seen to end.

A hand that drags, or moves like a mass, has a column of the regressor, so a fit made while it is there explains it.
What tells it apart is that the arm was known without it before.

**Within a fit** one model must explain all of it. With theta_0, P_0 what the fit had come to some time ago,

    (theta - theta_0) (P_0 - P)^-1 (theta - theta_0)' <= STEADY u

u: mean square of its residuals over that of the settings. More, and something has touched the arm or let go meanwhile;
likewise if the model doesn't explain each of its samples (`fit_check`). And what came later must come to the same
torque by itself, on all samples (`fit_check`, rms as in `fit_check`):

    |W_f (theta_late - theta)| <= LATER_NM + RMS_SHARE rms + LEARNT_SHARE sqrt(u) residual_Nm + sigma

sigma: where gravity acts, the standard deviation of that difference, by the beliefs; else 0. A part of the motion of
an arm in gravity hardly tells gravity from an offset, so later samples may not know the torque of earlier poses: by
sigma = 0.03 to 0.05 Nm of a level arm, which differed by 0.033 to 0.045 Nm and got no certificate.

This sees a weak touch of the beginning, when theta_0 is not known well enough to differ. Then all of the fit's beliefs
are kept.

**Over a touch** the fit's earlier beliefs are *kept*: where a contact interrupted it all of them and the one at the
contact, those of before a change. When the touch began is not known, so a later fit must agree with each, in each
quantity c that a hand can look like, a joint's friction at some speed, an inertia, an offset that nothing anchors:

    c (theta - theta_0) <= max(floor, SIGMAS sqrt(c (P_0 + P) c'))

Friction and an offset that nothing anchors must agree both ways: who pushes the arm on takes friction away. Of an
inertia **less is the arm's**, and more is a touch that has not been seen to end. Where an anchor gives the offset, a
belief that differs has been leant on, and is forgotten. The first beliefs know little and bound little. A variance's
part that the samples say is scaled by u, the prior's is not. A fit that a contact interrupts is asked as a finished one
is: if no one model explains it, only the beliefs from before the change are kept.

**Kept beliefs lapse** where fits in a row, without a contact between, agree with each other against them: LITTLE_FITS,
if they have more by LITTLE times a bound and by LITTLE_NM on the trajectory at most, for a touch that nobody noticed
bends the beliefs it comes into; LESS_FITS, if they have less friction, and no more of anything and the same offsets,
for the hand that was there before may have dragged. A hand as small as that, or that helps as long, is learnt then.

Shapes: p parameters, q quantities, s steps, n kept, and a refused fit behind them; rows (q, p); kept (n, p), P_kept
(n, p, p), kept_unit (n,), 0 of one that is forgotten, kept_age_s (n,); steps_theta (s, p), steps_P (s, p, p),
steps_square, steps_rows (s,); change, change_limit, change_age_s (q,): as compared last with the belief that it
contradicts most.
"""

import math
from typing import Any

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, PARAMETER_NAMES, Vector
from adacd_hil.scheme.detect.external_torque import LARGEST_UNIT
from adacd_hil.scheme.identify import anchor, fit_check
from adacd_hil.scheme.model.regressor import A5
from adacd_hil.settings.configuration import Settings

STEADY = 400.0
"""Squared distance over u at which a fit has changed. Fits of 400 untouched arms, wide ones included, came to 0.06 of
it in the middle and to 0.18 at most. What the model doesn't know is in it too: cross-talk of 2 % comes to 680."""
LEARNT_SHARE = 2.5
"""How many times the rms of the learnt residuals, of their better part, it may differ beside that."""
LATER_NM = 0.02
"""With the rest of the limit: the same fits came to 0.31 of it in the middle, to 0.94 at most, in MuJoCo to 0.98."""
SMALLEST_SQUARE = 0.015
"""Least u of a fit that is asked whether it has changed."""
STEP_S = 0.2
STEPS = 8
"""The fit's own earlier beliefs: how far apart, and how many."""
YOUNG_STEPS = 1
"""The first ones are not kept: for so long a hand may have been there all the time, and nothing could tell."""
KEPT = STEPS + 1
"""How many beliefs may be kept: the steps, and that at the contact. Behind them is the place of a refused fit."""
LITTLE, LITTLE_NM, LITTLE_FITS = 2.0, 0.06, 2.0
"""How many times a bound fits that agree may have more, what may come of that on the trajectory, and how many they must
be, so that the kept beliefs lapse."""
LESS_FITS = 5.0
"""So many in a row, some 7 s, if they have less friction: a hand that dragged has let go then."""
SIGMAS = 3.5
"""With the floors below: the same fits had 0.23 of what is allowed more in the middle, 0.73 at most."""
SPEEDS_RAD_S = (0.2, 0.6, 1.2)
"""At which friction is compared: what viscous and Coulomb friction hide from each other shows in their sum."""
FRICTION_NM = 0.03
OFFSET_NM = 0.03
INERTIA_KGM2 = 0.006
INERTIA_SHARE = 0.03
"""Less than these, and less than this share of an inertia, is nothing."""
NOT_ASKED_KGM2 = 1000.0
"""Of a2: a mass shows in a1 and a3, and what else touches the arm bends a2."""
HARD = 2.0
"""Mean square of the learnt residuals in their hard moments over that of all: much of them is noise of the velocity."""
SMALLEST_UNIT = 0.1
"""Least unit of the variances; the rest of it as `sensitivity` has it."""
PEAK_ACCELERATION = 10.0 / math.sqrt(3.0)
"""Of a rest-to-rest quintic, over travel / duration²."""
_INERTIAS = ("a1", "a2", "a3")
FRICTIONS, INERTIAS = JOINTS * len(SPEEDS_RAD_S), len(_INERTIAS)
"""How many quantities are a joint's friction at some speed, and how many an inertia."""


def constants_of(settings: Settings, prior_std: Vector) -> dict[str, Vector]:
    """Return `compared` (q, p), `compared_floor`, `_share`, `_prior` (q,), `step_samples`, and `change_Nm` (q,).

    change_Nm: torque that one unit of the quantity makes at most on the trajectory. prior_std (p,).
    """
    unit = np.eye(prior_std.size)
    base = len(settings.estimator.parameter_names)
    viscous, coulomb = PARAMETER_NAMES.index("F_v1"), PARAMETER_NAMES.index("F_c1")
    friction = [v * unit[viscous + i] + unit[coulomb + i] for i in range(JOINTS) for v in SPEEDS_RAD_S]
    inertia = [unit[PARAMETER_NAMES.index(name)] for name in _INERTIAS]
    offset = [unit[base + i] for i in range(JOINTS)]
    rows = np.array(friction + inertia + offset)
    learn_s = settings.bus.period_s * settings.certified.learn_every
    return {
        "compared": rows,
        "compared_floor": np.array(
            [FRICTION_NM] * len(friction) + [INERTIA_KGM2, NOT_ASKED_KGM2, INERTIA_KGM2] + [OFFSET_NM] * JOINTS
        ),
        "compared_share": np.repeat((0.0, INERTIA_SHARE, 0.0), (len(friction), len(inertia), JOINTS)),
        "compared_prior": rows**2 @ prior_std**2,
        "change_Nm": np.concatenate([np.ones(len(friction)), _accelerations(settings), np.ones(JOINTS)]),
        "step_samples": np.array(max(round(STEP_S / learn_s), 1)),
    }


def _accelerations(settings: Settings) -> tuple[float, ...]:
    """Return the largest accelerations on the trajectory that go with a1, a2, a3, rad/s²."""
    travel_rad = 2.0 * np.radians(settings.trajectory.amplitude_deg)
    first, second = PEAK_ACCELERATION * travel_rad / np.square(settings.trajectory.half_period_s)
    return first, 2.0 * first + second, first + second


def shapes_of(count: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of what is remembered, by name, of a model with this many parameters."""
    quantities = (FRICTIONS + INERTIAS + JOINTS,)
    return {
        "fit_square": (),
        "fit_rows": (),
        "fit_samples": (),
        "steps_used": (),
        "steps_theta": (STEPS, count),
        "steps_P": (STEPS, count, count),
        "steps_square": (STEPS,),
        "steps_rows": (STEPS,),
        "has_kept": (),
        "kept_count": (),
        "refused_fits": (),
        "has_lapsed": (),
        "kept": (KEPT + 1, count),
        "P_kept": (KEPT + 1, count, count),
        "kept_unit": (KEPT + 1,),
        "kept_age_s": (KEPT + 1,),
        "later": (count,),
        "change": quantities,
        "change_limit": quantities,
        "change_age_s": quantities,
    }


@compiled
def begin(m: Any) -> None:
    """Begin a fit: it has no earlier beliefs yet. What was kept stays."""
    m["steps_used"] = 0.0
    m["fit_square"] = 0.0
    m["fit_rows"] = 0.0
    m["fit_samples"] = 0.0


@compiled
def follow(k: Any, m: Any) -> None:
    """Take in that the fit has learnt a sample."""
    m["fit_samples"] += 1.0
    if m["fit_samples"] % k["step_samples"] != 0.0:
        return
    s = int(m["steps_used"]) % m["steps_rows"].shape[0]
    m["steps_theta"][s] = m["belief"]
    m["steps_P"][s] = m["P_belief"]
    m["steps_square"][s] = m["fit_square"]
    m["steps_rows"][s] = m["fit_rows"]
    m["steps_used"] += 1.0


@compiled
def forget(m: Any) -> None:
    """Keep nothing: a certificate stands, or the user says that nobody touches the arm."""
    m["has_kept"] = 0.0
    m["refused_fits"] = 0.0
    m["has_lapsed"] = 0.0


@compiled
def keep(k: Any, m: Any) -> None:
    """Keep what the fit has come to, and how it came about, if nothing is kept yet: a touch may have begun."""
    m["refused_fits"] = 0.0
    if m["has_kept"] == 0.0 and m["steps_used"] > YOUNG_STEPS and is_steady(m) and is_explained(k, m):
        _keep_steps(m, int(m["steps_used"]) - 1)
        _keep(m, m["belief"], m["P_belief"], unit_of(m["fit_square"], m["fit_rows"]), 0.0)


@compiled
def _keep_steps(m: Any, last: int) -> None:
    """Keep the fit's steps up to this number, in place of nothing."""
    steps = m["steps_rows"].shape[0]
    m["kept_count"] = 0.0
    m["refused_fits"] = 0.0
    for number in range(max(int(m["steps_used"]) - steps, YOUNG_STEPS), last + 1):
        s = number % steps
        age_s = STEP_S * (m["steps_used"] - 1.0 - number)
        unit = unit_of(m["steps_square"][s], m["steps_rows"][s])
        _keep(m, m["steps_theta"][s], m["steps_P"][s], unit, age_s)


@compiled
def _keep(m: Any, theta: Vector, P: Vector, unit: float, age_s: float) -> None:
    n = int(m["kept_count"])
    m["kept"][n] = theta
    m["P_kept"][n] = P
    m["kept_unit"][n] = unit
    m["kept_age_s"][n] = age_s
    m["kept_count"] += 1.0
    m["has_kept"] = 1.0


@compiled
def unit_of(square: float, rows: float) -> float:
    """Return u of residuals whose squares, over their variances, have this sum, in their hard moments."""
    return min(max(HARD * square / max(rows, 1.0), SMALLEST_UNIT), LARGEST_UNIT)


@compiled
def late_square(m: Any) -> float:
    """Return u of the later half of the fit, so that what touched its beginning doesn't count; 1 of a short one."""
    used = int(m["steps_used"])
    if used < 2:
        return 1.0
    steps = m["steps_rows"].shape[0]
    s = max(used // 2 - 1, used - steps) % steps
    return float((m["fit_square"] - m["steps_square"][s]) / max(m["fit_rows"] - m["steps_rows"][s], 1.0))


@compiled
def is_steady(m: Any) -> bool:
    """Tell whether one model explains the whole fit; if not, keep what it had come to before it changed."""
    used, steps = int(m["steps_used"]), m["steps_rows"].shape[0]
    for number in range(used - 1, max(used - steps, 0) - 1, -1):
        if not changed_share(m, number % steps) <= 1.0:
            if m["has_kept"] == 0.0:
                _keep_steps(m, number)
            return False
    return True


@compiled
def changed_share(m: Any, s: int) -> float:
    """Return how much of its limit the distance of step s from the whole fit is."""
    distance = fit_check.distance(m, m["steps_theta"][s], m["steps_P"][s], m["belief"], m["P_belief"])
    return float(distance / (STEADY * max(_better_square(m, s), SMALLEST_SQUARE)))


@compiled
def _better_square(m: Any, s: int) -> float:
    """Return u of the residuals up to step s, or of those after it, the smaller."""
    early = m["steps_square"][s] / max(m["steps_rows"][s], 1.0)
    late = (m["fit_square"] - m["steps_square"][s]) / max(m["fit_rows"] - m["steps_rows"][s], 1.0)
    return float(min(early, late))


@compiled
def is_explained(k: Any, m: Any) -> bool:
    """Tell whether the fit's model explains each of its samples; if not, keep what it had come to before the first."""
    first = fit_check.first_unexplained(m)
    if first >= 0 and m["has_kept"] == 0.0:
        _keep_steps(m, int(first // k["step_samples"]) - 1)
    return first < 0


@compiled
def is_borne_out(k: Any, m: Any) -> bool:
    """Tell whether the fit's later samples alone come to its torque; if not, keep all that it had come to on the way.

    Not asked of a payload's fit.
    """
    used, steps = int(m["steps_used"]), m["steps_rows"].shape[0]
    if m["is_payload"] != 0.0:
        return True
    for number in range(max(used - steps, 0), used):
        if not later_share(k, m, number % steps) <= 1.0:
            if m["has_kept"] == 0.0:
                _keep_steps(m, used - 1)
            return False
    return True


@compiled
def later_share(k: Any, m: Any, s: int) -> float:
    """Return how much of its limit the torque is by which what came after step s differs from the fit."""
    if not fit_check.find_later(m, m["steps_theta"][s], m["steps_P"][s], m["belief"], m["P_belief"]):
        return np.inf
    limit_Nm = LATER_NM + fit_check.RMS_SHARE * fit_check.better_rms(m)
    limit_Nm += LEARNT_SHARE * k["residual_Nm"] * np.sqrt(_better_square(m, s))
    if int(k["base"]) <= A5:
        return float(fit_check.largest_torque(m, m["later"]) / limit_Nm)
    unit = unit_of(m["fit_square"], m["fit_rows"])
    return fit_check.later_share(m, m["steps_P"][s], m["P_belief"], limit_Nm, unit)


@compiled
def is_no_more(k: Any, m: Any) -> bool:
    """Tell whether the fit has the friction of what was kept, no more inertia, and no other unanchored offset.

    The fit's offsets keep to their anchors. A kept belief whose offsets don't has been leant on, and is forgotten.
    """
    if m["has_kept"] == 0.0:
        return True
    unit = unit_of(m["fit_square"], m["fit_rows"])
    m["change"][:] = 0.0
    m["change_limit"][:] = 1.0
    m["has_kept"] = 0.0
    for n in range(int(m["kept_count"])):
        if m["kept_unit"][n] > 0.0 and _is_touched(k, m, n, unit):
            m["kept_unit"][n] = 0.0
        if m["kept_unit"][n] > 0.0:
            m["has_kept"] = 1.0
            _note_change(k, m, n, unit)
    if np.all(np.abs(m["change"]) <= m["change_limit"]):
        return True
    if _lapses(k, m, unit):
        m["has_kept"] = 0.0
        m["has_lapsed"] = 1.0
        return True
    return False


@compiled
def _lapses(k: Any, m: Any, unit: float) -> bool:
    """Tell whether enough fits in a row have been refused for the same, as large as it is; remember this one."""
    last = m["kept"].shape[0] - 1
    is_little, is_less, is_same, friction_Nm, else_Nm = True, True, True, 0.0, 0.0
    for q in range(m["change"].shape[0]):
        excess = m["change"][q] / m["change_limit"][q]
        is_little = is_little and abs(excess) <= (LITTLE if excess > 0.0 or q >= FRICTIONS else 1.0)
        is_less = is_less and excess <= 1.0 and (q < FRICTIONS + INERTIAS or excess >= -1.0)
        change_Nm = abs(m["change"][q]) * k["change_Nm"][q] if abs(excess) > 1.0 else 0.0
        if q < FRICTIONS:
            friction_Nm = max(friction_Nm, change_Nm)
        else:
            else_Nm += change_Nm
        if m["refused_fits"] > 0.0:
            change, limit = _compare(k, m, last, q, unit)
            is_same = is_same and abs(change) <= limit
    m["kept"][last] = m["belief"]
    m["P_kept"][last] = m["P_belief"]
    m["kept_unit"][last] = unit
    m["refused_fits"] = m["refused_fits"] + 1.0 if is_same else 1.0
    if is_little and friction_Nm + else_Nm <= LITTLE_NM:
        return bool(m["refused_fits"] >= LITTLE_FITS)
    return bool(is_less and m["refused_fits"] >= LESS_FITS)


@compiled
def _is_touched(k: Any, m: Any, n: int, unit: float) -> bool:
    """Tell whether a kept belief has a hand in it: in its anchored offset, or in friction that is less than none.

    The offset is another than the fit's, or one that the anchor excludes.
    """
    joints = m["bound_Nm"].shape[1]
    first_offset = m["change"].shape[0] - joints
    for i in range(joints):
        change, limit = _compare(k, m, n, first_offset + i, unit)
        is_another = not abs(change) <= limit
        if is_another and (not anchor.is_open(k, m, i) or anchor.is_excluded(m, i, m["judged_Nm"][i] - change)):
            return True
    for q in range(FRICTIONS):
        known = split(variance_of(k["compared"][q], m["P_kept"][n]), k["compared_prior"][q], m["kept_unit"][n])
        if value_of(k["compared"][q], m["kept"][n]) < -max(k["compared_floor"][q], SIGMAS * np.sqrt(known)):
            return True
    return False


@compiled
def _note_change(k: Any, m: Any, n: int, unit: float) -> None:
    """Note each quantity where the fit contradicts a kept belief more than those before it."""
    first_offset = m["change"].shape[0] - m["bound_Nm"].shape[1]
    for q in range(m["change"].shape[0]):
        change, limit = _compare(k, m, n, q, unit)
        is_either = anchor.is_open(k, m, q - first_offset) if q >= first_offset else False
        is_either = is_either or q < FRICTIONS
        is_asked = is_either or (change > 0.0 and q < first_offset) or not np.isfinite(change)
        if is_asked and not abs(change) * m["change_limit"][q] <= abs(m["change"][q]) * limit:
            m["change"][q], m["change_limit"][q], m["change_age_s"][q] = change, limit, m["kept_age_s"][n]


@compiled
def _compare(k: Any, m: Any, n: int, q: int, unit: float) -> tuple[float, float]:
    """Return by how much the fit has more of a quantity than a kept belief, and how much is nothing."""
    row, prior = k["compared"][q], k["compared_prior"][q]
    before, now = value_of(row, m["kept"][n]), value_of(row, m["belief"])
    if q < FRICTIONS + INERTIAS:
        before = max(before, 0.0)  # who pushes the arm on looks like less than none
    known = split(variance_of(row, m["P_kept"][n]), prior, m["kept_unit"][n])
    fitted = split(variance_of(row, m["P_belief"]), prior, unit)
    floor = max(k["compared_floor"][q], k["compared_share"][q] * abs(before))
    return now - before, max(floor, SIGMAS * np.sqrt(known + fitted))


@compiled
def value_of(row: Vector, theta: Vector) -> float:
    """Return c theta. row, theta (p,)."""
    total = 0.0
    for j in range(row.shape[0]):
        if row[j] != 0.0:
            total += row[j] * theta[j]
    return float(total)


@compiled
def variance_of(row: Vector, P: Vector) -> float:
    """Return c P c'. row (p,), P (p, p)."""
    total = 0.0
    for j in range(row.shape[0]):
        if row[j] != 0.0:
            for n in range(row.shape[0]):
                total += row[j] * P[j, n] * row[n]
    return float(total)


@compiled
def split(variance: float, prior: float, unit: float) -> float:
    """Return a variance of which `unit` scales what the samples say, and not what the prior does."""
    return 1.0 / (1.0 / prior + max(1.0 / variance - 1.0 / prior, 0.0) / unit)


def describe_more(m: Any) -> list[str]:
    """Say in which quantities the fit contradicts what was kept, by how much and since when, a line each.

    Of a joint's friction only the speed at which it stands out most.
    """
    excess = np.abs(m["change"]) / m["change_limit"]
    return [_changed(m, q, what, unit) for q, what, unit in foremost(excess)]


def foremost(excess: Vector) -> list[tuple[int, str, str]]:
    """Return place, name and unit of each quantity whose excess is over 1; of a joint's friction only the largest.

    excess: (q,), or without the offsets.
    """
    speeds = len(SPEEDS_RAD_S)
    found = []
    for i in range(JOINTS):
        q = speeds * i + int(np.argmax(excess[speeds * i : speeds * (i + 1)]))
        found.append((q, f"friction of joint {i + 1} at {SPEEDS_RAD_S[q - speeds * i]:g} rad/s", "Nm"))
    found += [(q, name, "kg m²") for q, name in enumerate(_INERTIAS, FRICTIONS)]
    found += [
        (q, f"torque offset of joint {i + 1}", "Nm") for i, q in enumerate(range(FRICTIONS + INERTIAS, excess.size))
    ]
    return [(q, what, unit) for q, what, unit in found if excess[q] > 1.0]


def _changed(m: Any, q: int, what: str, unit: str) -> str:
    change, limit, age_s = float(m["change"][q]), float(m["change_limit"][q]), float(m["change_age_s"][q])
    is_helped = q < FRICTIONS and change < 0.0
    why = "a hand helps the motion, or one that dragged has let go"
    if not is_helped:
        why = "a touch that began then has not been seen to end, or the arm does what the model doesn't know"
    return (
        f"{what} is {abs(change):.3f} {unit} {'more' if change > 0.0 else 'less'} than {age_s:.1f} s ago, "
        f"bound {limit:.3f} {unit}: {why}"
    )
