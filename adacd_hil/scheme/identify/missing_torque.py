"""Evidence that the model lacks a torque that depends on where the arm is.

Each sample that the belief learns, a row w of the regressor with its torque and variance R, also goes into the sums

    L = Σ v v'/R,   b = Σ v r/R,   r = tau_f - w prior,   v = (w, x)

with x the columns of `regressor` behind the filter that is learnt from. From a prior N(0, S²) of the parameters less
their mean, with x or without, each sum says how likely the samples are:

    log evidence = ½ b' S M^-1 S b - ½ log det M,   M = I + S L S

The model lacks a torque by place if x makes them e^GAIN times likelier, leaves less than 1 - SHARE of the weighted
squares that the basic model leaves, and comes to LEAST_NM rms. Of clean arms, with every error of
the error campaign but a tilt and a cable, the gain was -25 to -3, or the share below 0.4; tilts of 0.5 and 1
deg and a cable of 0.1 Nm came to a gain of 20 and more on a motion that shows them.

Asked of an adaptation as a whole, when it refuses a fit. A torque by place is asked for while the arm monitors, too: of
the first 2 s, the next 4, 8, 16 s and then of each 16 s of learnt samples. Not of longer ones: the drift of a sensor
over a minute looks like this. There one stretch is not enough, since on one way much depends on the place: what it says
must explain SAID_SHARE of the squares that the basic model leaves in a later one.

Shapes: p parameters, n joints, t = PLACE_TERMS, f = p + n t; evidence_L (n, f, f): by the joint of the row, lower half;
evidence_b, _basic, _full, _row, _scale (f,); evidence_M (f, f); evidence_said (n t,): coefficients of the last stretch
that came to a torque by place, all 0 if none did; missing_rms_Nm (n,): what was found last, 0 where nothing was.
"""

import math
from typing import Any

import numpy as np

from adacd_hil import linalg
from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, Vector
from adacd_hil.scheme.model import filter_bank
from adacd_hil.scheme.model.regressor import PLACE_TERMS
from adacd_hil.settings.configuration import Settings

EXPECTED_NM = 0.06
"""Standard deviation of a coefficient, of an arm that has a cable."""
GAIN, SHARE, LEAST_NM = 8.0, 0.6, 0.01
"""Of one stretch."""
SAID_SHARE = 0.4
LEAST_BACK = 0.2
"""Share of a joint's samples that are of its less frequent direction: on a way in one direction what depends on speed,
or on time, depends on the place."""
STILL = 0.05
"""Share of standstill in the filter's memory from which on friction may be any."""
FIRST_S, LONGEST_S = 2.0, 16.0
"""Learnt samples of which the first question is asked while the arm monitors, and each later one."""


def constants_of(settings: Settings, prior_std: Vector) -> dict[str, Vector]:
    """Return `evidence_std` (f,), and `evidence_first`, `evidence_longest` in learnt samples. prior_std (p,)."""
    learn_s = settings.bus.period_s * settings.certified.learn_every
    return {
        "evidence_std": np.concatenate([prior_std, np.full(JOINTS * PLACE_TERMS, EXPECTED_NM)]),
        "evidence_first": np.array(round(FIRST_S / learn_s)),
        "evidence_longest": np.array(round(LONGEST_S / learn_s)),
    }


def shapes_of(count: int, waiting: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of what is remembered, by name, of a model with this many parameters and a ring so long."""
    full = count + JOINTS * PLACE_TERMS
    columns = (JOINTS, PLACE_TERMS)
    return {
        "X_old": columns, "X_f": columns, "X_learnt": columns, "ring_X": (waiting, *columns),
        "evidence_L": (JOINTS, full, full), "evidence_M": (full, full),
        "evidence_b": (full,), "evidence_basic": (full,), "evidence_full": (full,), "evidence_row": (full,),
        "evidence_scale": (full,),
        "evidence_said": (JOINTS * PLACE_TERMS,),
        "evidence_yy": (), "evidence_weight": (JOINTS,), "evidence_ways": (JOINTS, 2),
        "evidence_samples": (), "evidence_wanted": (),
        "missing_rms_Nm": (JOINTS,),
    }  # fmt: skip


@compiled
def forget(m: Any) -> None:
    """Forget the columns that were filtered."""
    m["X_f"][:] = 0.0
    m["X_learnt"][:] = 0.0


@compiled
def rest(m: Any) -> None:
    """Begin with a filter that has seen this pose for ever."""
    m["X_f"][:] = m["X"]


@compiled
def follow(m: Any, rates: Vector, smoothing: float, is_seen: bool) -> None:
    """Take the columns X (n, PLACE_TERMS) over one period to what is learnt from; after a gap the filter resumes.

    rates (3,): what one period does to the filter, see `filter_bank.FirstOrderHold`; smoothing: to the pole behind it.
    """
    decay, weight_old, weight_new = rates[0], rates[1], rates[2]
    X, X_old, X_f, X_learnt = m["X"], m["X_old"], m["X_f"], m["X_learnt"]
    for i in range(X.shape[0]):
        for term in range(PLACE_TERMS):
            if is_seen:
                X_f[i, term] = decay * X_f[i, term] + (weight_old * X_old[i, term] + weight_new * X[i, term])
            X_old[i, term] = X[i, term]
            X_learnt[i, term] = X_f[i, term] + smoothing * (X_learnt[i, term] - X_f[i, term])


@compiled
def keep(m: Any, slot: int) -> None:
    """Put the columns of this sample into a slot of the ring, where they wait with the row of the regressor."""
    m["ring_X"][slot] = m["X_learnt"]


@compiled
def clear(k: Any, m: Any) -> None:
    """Begin anew: with another arm, as one with another payload, or with a certificate."""
    _clear_sums(m)
    m["evidence_said"][:] = 0.0
    m["missing_rms_Nm"][:] = 0.0
    m["evidence_wanted"] = k["evidence_first"]


@compiled
def _clear_sums(m: Any) -> None:
    m["evidence_L"][:] = 0.0
    m["evidence_b"][:] = 0.0
    m["evidence_yy"] = 0.0
    m["evidence_weight"][:] = 0.0
    m["evidence_ways"][:] = 0.0
    m["evidence_samples"] = 0.0


@compiled
def add(k: Any, m: Any, slot: int, joint: int) -> None:
    """Take in the row of a joint from a slot of the ring, which is learnt; one that moves slowly tells nothing."""
    if m["ring_still"][slot, joint] > STILL:
        return
    v, count = m["evidence_row"], m["belief"].shape[0]
    R = m["ring_R"][slot, joint] + k["correlated"] * _rough_variance(k, m, joint)
    v[:] = 0.0
    v[:count] = m["ring_W"][slot, joint]
    v[count + PLACE_TERMS * joint : count + PLACE_TERMS * (joint + 1)] = m["ring_X"][slot, joint]
    r = -linalg.misfit(v, k["prior"], m["ring_tau"][slot, joint])
    L, b = m["evidence_L"][joint], m["evidence_b"]
    for j in range(v.shape[0]):
        if v[j] != 0.0:
            b[j] += v[j] * r / R
            for n in range(j + 1):
                L[j, n] += v[j] * v[n] / R
    m["evidence_ways"][joint, 1 if v[int(k["first_coulomb"]) + joint] > 0.0 else 0] += 1.0
    m["evidence_yy"] += r * r / R
    m["evidence_weight"][joint] += 1.0 / R


@compiled
def _rough_variance(k: Any, m: Any, joint: int) -> float:
    """Return what a velocity that is noisier than the settings say leaves in what is learnt, Nm²: an encoder's steps.

    At low speed they come slowly, so they count as the model's error does.
    """
    total = 0.0
    for j in range(m["M"].shape[1]):
        total += (m["velocity_roughness"][j] - 1.0) * m["M"][joint, j] ** 2
    return float(filter_bank.VELOCITY_STD_SHARE**2 * k["velocity_variance"][filter_bank.LEARNT] * total)


@compiled
def is_found_in_time(k: Any, m: Any) -> bool:
    """Take in that a sample was learnt while the arm monitors; once in a while tell whether two stretches agree."""
    m["evidence_samples"] += 1.0
    if m["evidence_samples"] < m["evidence_wanted"]:
        return False
    is_said = is_found(k, m)
    said = m["evidence_full"][m["belief"].shape[0] :].copy()
    is_agreed = _is_said_again(k, m)
    if is_said:
        m["evidence_said"][:] = said
    m["evidence_wanted"] = min(2.0 * m["evidence_wanted"], k["evidence_longest"])
    _clear_sums(m)
    return is_agreed


@compiled
def is_found(k: Any, m: Any) -> bool:
    """Tell whether the place explains what the model leaves of all samples; fill `missing_rms_Nm` (n,)."""
    m["missing_rms_Nm"][:] = 0.0
    if k["position_torque_Nm"] != 0.0:
        return False
    basic, full = m["evidence_basic"], m["evidence_full"]
    without = _log_evidence(m, m["evidence_b"], _scale_of(k, m, False), basic)
    gain = _log_evidence(m, m["evidence_b"], _scale_of(k, m, True), full) - without
    if not (gain > GAIN and _squares_left(m, full) < (1.0 - SHARE) * _squares_left(m, basic)):
        return False
    largest = 0.0
    for i in range(m["missing_rms_Nm"].shape[0]):
        ways = m["evidence_ways"][i]
        if np.min(ways) >= LEAST_BACK * np.sum(ways):
            largest = max(largest, _rms_Nm(m, i))
    if largest > LEAST_NM:
        _fill_missing(m)
    return bool(largest > LEAST_NM)


@compiled
def _scale_of(k: Any, m: Any, is_by_place: bool) -> Vector:
    """Return the prior's deviations (f,) of the model, and of the columns by place or 0 for them."""
    scale, count = m["evidence_scale"], m["belief"].shape[0]
    scale[:] = k["evidence_std"]
    if not is_by_place:
        scale[count:] = 0.0
    return scale  # type: ignore[no-any-return]


@compiled
def _is_said_again(k: Any, m: Any) -> bool:
    """Tell whether what an earlier stretch has said explains this one, of which `evidence_basic` is the model."""
    m["missing_rms_Nm"][:] = 0.0
    said, count, basic, full = m["evidence_said"], m["belief"].shape[0], m["evidence_basic"], m["evidence_full"]
    if k["position_torque_Nm"] != 0.0 or not np.any(said != 0.0):
        return False
    b = m["evidence_row"]
    b[:] = m["evidence_b"]
    for i in range(m["evidence_L"].shape[0]):
        for j in range(count):
            for n in range(said.shape[0]):
                b[j] -= m["evidence_L"][i, count + n, j] * said[n]
    _log_evidence(m, b, _scale_of(k, m, False), full)
    full[count : count + said.shape[0]] = said
    left = _squares_left(m, basic)
    explained = left - _squares_left(m, full)
    is_agreed = 0.5 * explained > GAIN and explained > SAID_SHARE * left
    if is_agreed:
        _fill_missing(m)
    return bool(is_agreed)


@compiled
def _fill_missing(m: Any) -> None:
    for i in range(m["missing_rms_Nm"].shape[0]):
        m["missing_rms_Nm"][i] = _rms_Nm(m, i)


@compiled
def _rms_Nm(m: Any, joint: int) -> float:
    """Return by how much the two models differ on a joint's samples."""
    apart = m["evidence_row"]
    for j in range(apart.shape[0]):
        apart[j] = m["evidence_full"][j] - m["evidence_basic"][j]
    square = linalg.quadratic(m["evidence_L"][joint], apart)
    return float(np.sqrt(square / max(m["evidence_weight"][joint], 1e-12)))


@compiled
def _log_evidence(m: Any, b: Vector, s: Vector, x: Vector) -> float:
    """Return the log evidence of the columns with a deviation s (f,) above 0, up to what all have; fill x (f,)."""
    M, count, log_det = m["evidence_M"], s.shape[0], 0.0
    for j in range(count):
        x[j] = s[j] * b[j]
        for n in range(j + 1):
            total = 0.0
            for i in range(m["evidence_L"].shape[0]):
                total += m["evidence_L"][i, j, n]
            M[j, n] = s[j] * total * s[n] + (1.0 if n == j else 0.0)
    linalg.factor(M, 1e-12)
    for j in range(count):
        log_det += 2.0 * math.log(M[j, j])
    linalg.solve_lower(M, x)
    square = linalg.dot(x, x)
    linalg.solve_upper(M, x)
    for j in range(count):
        x[j] *= s[j]
    return float(0.5 * (square - log_det))


@compiled
def _squares_left(m: Any, x: Vector) -> float:
    """Return Σ (r - v x)² / R."""
    total = m["evidence_yy"] - 2.0 * linalg.dot(x, m["evidence_b"])
    for i in range(m["evidence_L"].shape[0]):
        total += linalg.quadratic(m["evidence_L"][i], x)
    return float(max(total, 0.0))


def describe(m: Any) -> list[str]:
    """Say how large the torque is that the model lacks, in one line; none where none was found."""
    missing_Nm = m["missing_rms_Nm"].tolist()
    if not any(missing_Nm):
        return []
    torques = " and ".join(f"{rms:.3f} Nm rms in joint {i + 1}" for i, rms in enumerate(missing_Nm))
    return [
        f"a torque that depends on where the arm is, {torques}, is missing in the model: a cable, a base that is not "
        "mounted as arm.mounting_deg says (flat: not level), or a hand's spring"
    ]
