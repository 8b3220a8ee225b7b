"""What was known earlier in the run judges what is learnt later: a touch that has begun must be seen to end.

A hand that drags, or moves like a mass, has a column of the regressor, so a fit made while it is there explains it.
What tells it apart is that the arm was known without it before.

**Within a fit** one model must explain all of it. With theta_0, P_0 what the fit had come to some time ago,

    (theta - theta_0) (P_0 - P)^-1 (theta - theta_0)' <= STEADY u

u: mean square of its residuals over that of the settings. More, and something has touched the arm or let go meanwhile;
likewise if the model doesn't explain each of its samples (`fit_check`). And what came later must come to the same
torque by itself, on all samples (`fit_check`, rms as in `fit_check`):

    |W_f (theta_late - theta)| <= LATER_NM + RMS_SHARE rms + LEARNT_SHARE sqrt(u) residual_Nm

This sees a weak touch of the beginning, when theta_0 is not known well enough to differ. Then all of the fit's beliefs
are kept.

**Over a touch** the fit's earlier beliefs are *kept*: where a contact interrupted it all of them and the one at the
contact, those of before a change, or where a test has refuted the model all of them and the model. When the touch began
is not known, so a later fit must agree with each, in each quantity c that a hand can look like, a joint's friction at
some speed, an inertia, an offset that nothing anchors:

    c (theta - theta_0) <= max(floor, SIGMAS sqrt(c (P_0 + P) c'))

The first ones know little and bound little. The last ones may have been touched, and say anything. So one that is
apart from an earlier one (`fit_check`) is forgotten: with each of the last samples that the next fit learns, one
pair is compared.

A hand that doesn't help the arm only adds friction and inertia. So **less is the arm's**, and more is a touch that has
not been seen to end. Of an offset that nothing anchors neither value is known to be the arm's, so both signs count; of
one that is anchored the fit's value is, so a belief that differs has been leant on, and is forgotten. A variance's part
that the samples say is scaled by u, the prior's is not.

Shapes: p parameters, q quantities, s steps, n kept; rows (q, p); kept (n, p), P_kept (n, p, p), kept_unit (n,), 0 of
one that is forgotten, kept_age_s (n,); apart_n, apart_s: the pair that is compared next, the later one first;
steps_theta (s, p), steps_P (s, p, p), steps_square, steps_rows (s,); change, change_limit, change_age_s (q,): as
compared last with the belief that it contradicts most.
"""

from typing import Any

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, PARAMETER_NAMES, Vector
from adacd_hil.scheme.detect.external_torque import LARGEST_UNIT
from adacd_hil.scheme.identify import anchor, fit_check
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
"""How many beliefs may be kept: the steps, and what the fit had come to in the end."""
PAIRS = KEPT * (KEPT - 1) // 2
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
_INERTIAS = ("a1", "a2", "a3")
FRICTIONS, INERTIAS = JOINTS * len(SPEEDS_RAD_S), len(_INERTIAS)
"""How many quantities are a joint's friction at some speed, and how many an inertia."""


def constants_of(settings: Settings, prior_std: Vector) -> dict[str, Vector]:
    """Return `compared` (q, p), `compared_floor`, `_share`, `_prior` (q,), `step_samples` and `apart_samples` (2,).

    prior_std (p,). apart_samples: of an arm's fit, and of a payload's.
    """
    unit = np.eye(prior_std.size)
    base = len(settings.estimator.parameter_names)
    viscous, coulomb = PARAMETER_NAMES.index("F_v1"), PARAMETER_NAMES.index("F_c1")
    friction = [v * unit[viscous + i] + unit[coulomb + i] for i in range(JOINTS) for v in SPEEDS_RAD_S]
    inertia = [unit[PARAMETER_NAMES.index(name)] for name in _INERTIAS]
    offset = [unit[base + i] for i in range(JOINTS)]
    rows = np.array(friction + inertia + offset)
    certified = settings.certified
    learn_s = settings.bus.period_s * certified.learn_every
    return {
        "compared": rows,
        "compared_floor": np.array(
            [FRICTION_NM] * len(friction) + [INERTIA_KGM2, NOT_ASKED_KGM2, INERTIA_KGM2] + [OFFSET_NM] * JOINTS
        ),
        "compared_share": np.repeat((0.0, INERTIA_SHARE, 0.0), (len(friction), len(inertia), JOINTS)),
        "compared_prior": rows**2 @ prior_std**2,
        "step_samples": np.array(max(round(STEP_S / learn_s), 1)),
        "apart_samples": np.array([(fit_s - certified.hold_back_s) / learn_s - PAIRS for fit_s in certified.fit_s]),
    }


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
        "kept": (KEPT, count),
        "P_kept": (KEPT, count, count),
        "kept_unit": (KEPT,),
        "kept_age_s": (KEPT,),
        "apart_s": (),
        "apart_n": (),
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
    if m["has_kept"] != 0.0 and m["fit_samples"] > k["apart_samples"][int(m["is_payload"])]:
        _compare_kept(m)
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


@compiled
def keep(m: Any) -> None:
    """Keep what the fit has come to, and how it came about, if nothing is kept yet: a touch may have begun."""
    if m["has_kept"] == 0.0 and m["steps_used"] > YOUNG_STEPS:
        _keep_steps(m, int(m["steps_used"]) - 1)
        _keep(m, m["belief"], m["P_belief"], unit_of(m["fit_square"], m["fit_rows"]), 0.0)


@compiled
def keep_refuted(m: Any) -> None:
    """Do so with a model whose test has failed.

    Not with a new payload: hands have been on the arm, and friction may depend on the load.
    """
    if m["is_payload"] == 0.0:
        keep(m)


@compiled
def _keep_steps(m: Any, last: int) -> None:
    """Keep the fit's steps up to this number, in place of nothing."""
    steps = m["steps_rows"].shape[0]
    m["kept_count"] = 0.0
    m["apart_s"], m["apart_n"] = 0.0, 1.0
    for number in range(max(int(m["steps_used"]) - steps, YOUNG_STEPS), last + 1):
        s = number % steps
        age_s = STEP_S * (m["steps_used"] - 1.0 - number)
        _keep(m, m["steps_theta"][s], m["steps_P"][s], unit_of(m["steps_square"][s], m["steps_rows"][s]), age_s)


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
    return float(fit_check.largest_torque(m, m["later"]) / limit_Nm)


@compiled
def _compare_kept(m: Any) -> None:
    """Compare the next pair of kept beliefs, if one is left; forget the later one if they are apart."""
    s, n = int(m["apart_s"]), int(m["apart_n"])
    if n >= m["kept_count"]:
        return
    is_judged = s < n and m["kept_unit"][s] > 0.0 and m["kept_unit"][n] > 0.0
    if is_judged and fit_check.is_apart(
        m, m["kept"][s], m["P_kept"][s], m["kept"][n], m["P_kept"][n], m["kept_unit"][n]
    ):
        m["kept_unit"][n] = 0.0
    m["apart_s"] = float(s + 1)
    if s + 1 >= n:
        m["apart_s"], m["apart_n"] = 0.0, float(n + 1)


@compiled
def is_no_more(k: Any, m: Any) -> bool:
    """Tell whether the fit has no more friction and inertia, and no other unanchored offset, than what was kept.

    The fit's offsets keep to their anchors. A kept belief whose offsets don't has been leant on, and is forgotten.
    """
    if m["has_kept"] == 0.0:
        return True
    while m["apart_n"] < m["kept_count"]:
        _compare_kept(m)
    unit = unit_of(m["fit_square"], m["fit_rows"])
    m["change"][:] = 0.0
    m["change_limit"][:] = 1.0
    is_agreed = True
    m["has_kept"] = 0.0
    for n in range(int(m["kept_count"])):
        if m["kept_unit"][n] > 0.0 and _is_leant(k, m, n, unit):
            m["kept_unit"][n] = 0.0
        if m["kept_unit"][n] > 0.0:
            m["has_kept"] = 1.0
            is_agreed = _is_agreed(k, m, n, unit) and is_agreed
    return is_agreed


@compiled
def _is_leant(k: Any, m: Any, n: int, unit: float) -> bool:
    """Tell whether an anchored offset of a kept belief is another than the fit's, or any that its anchor excludes."""
    joints = m["bound_Nm"].shape[1]
    first_offset = m["change"].shape[0] - joints
    for i in range(joints):
        change, limit = _compare(k, m, n, first_offset + i, unit)
        is_another = not abs(change) <= limit
        if is_another and (not anchor.is_open(k, m, i) or anchor.is_excluded(m, i, m["judged_Nm"][i] - change)):
            return True
    return False


@compiled
def _is_agreed(k: Any, m: Any, n: int, unit: float) -> bool:
    """Tell whether the fit agrees with a kept belief; note each quantity where it contradicts this one most."""
    first_offset = m["change"].shape[0] - m["bound_Nm"].shape[1]
    is_agreed = True
    for q in range(m["change"].shape[0]):
        change, limit = _compare(k, m, n, q, unit)
        more = change
        if q >= first_offset:
            more = abs(change) if anchor.is_open(k, m, q - first_offset) else 0.0
        if not more * m["change_limit"][q] <= abs(m["change"][q]) * limit:
            m["change"][q], m["change_limit"][q], m["change_age_s"][q] = change, limit, m["kept_age_s"][n]
        is_agreed = is_agreed and more <= limit
    return bool(is_agreed)


@compiled
def _compare(k: Any, m: Any, n: int, q: int, unit: float) -> tuple[float, float]:
    """Return by how much the fit has more of a quantity than a kept belief, and how much is nothing."""
    row, prior = k["compared"][q], k["compared_prior"][q]
    before, now = 0.0, 0.0
    for j in range(row.shape[0]):
        if row[j] != 0.0:
            before += row[j] * m["kept"][n, j]
            now += row[j] * m["belief"][j]
    if q < FRICTIONS + INERTIAS:
        before = max(before, 0.0)  # who pushes the arm on looks like less than none
    known = split(variance_of(row, m["P_kept"][n]), prior, m["kept_unit"][n])
    fitted = split(variance_of(row, m["P_belief"]), prior, unit)
    floor = max(k["compared_floor"][q], k["compared_share"][q] * abs(before))
    return now - before, max(floor, SIGMAS * np.sqrt(known + fitted))


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


def describe_more(k: Any, m: Any) -> list[str]:
    """Say of which quantities the fit has more than what was kept, by how much and since when, a line each.

    Of a joint's friction only the speed at which it stands out most.
    """
    excess = m["change"] / m["change_limit"]
    excess[-JOINTS:] = [abs(excess[i - JOINTS]) if anchor.is_open(k, m, i) else 0.0 for i in range(JOINTS)]
    return [_more(m, q, what, unit) for q, what, unit in foremost(excess)]


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


def _more(m: Any, q: int, what: str, unit: str) -> str:
    change, limit, age_s = float(m["change"][q]), float(m["change_limit"][q]), float(m["change_age_s"][q])
    return (
        f"{what} is {abs(change):.3f} {unit} {'more' if change > 0.0 else 'less'} than {age_s:.1f} s ago, "
        f"bound {limit:.3f} {unit}: a touch that began then has not been seen to end"
    )
