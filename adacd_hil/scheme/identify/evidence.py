"""The table of evidence against a certificate: each source's value of each quantity, compared with the fit's.

A *quantity* is a column c of parameters that a touch can look like: a joint's friction at some speed, an inertia, a
torque offset, a viscous friction. A *source* knows quantities independently of the fit: an anchor of the offsets
(`anchor`), a belief from before a touch (`earlier`), the last certificate (`certificate`). One function weighs each
row, a source's value of a quantity:

    difference = c theta - value,    limit = slack + max(floor, sigmas sqrt(variance + c P c'))

and the source contradicts the fit if |difference| is over the limit; for a quantity of which less is the arm's, if the
difference itself is. A variance of inf: the source has no value. In c P c' the unit of the fit's residuals scales the
part that comes from the samples, and not the prior's part (`split`).

Two questions are not rows, since their column is not known beforehand: whether one model explains the whole of a fit
(`fit_check`), and whether the model lacks columns (`missing_torque`). `docs/scheme.md` lists which touch each row
detects, and which touches all rows miss.

Shapes: Q quantities, S sources, p parameters; columns (Q, p), columns_prior, torque_Nm (Q,); sigmas (S,), less_counts
(S, Q); value, variance, floor, slack, difference, limit (S, Q); age_s (S,); fitted, fitted_variance
(Q,).
"""

import numpy as np

from adacd_hil import linalg
from adacd_hil.compiled import compiled
from adacd_hil.records import FRICTION_SPEEDS_RAD_S, JOINTS, QUINTIC_PEAK_ACCELERATION, Vector
from adacd_hil.scheme.memory import Constants, EvidenceConstants, Memory
from adacd_hil.scheme.model.regressor import F_C1, F_V1
from adacd_hil.settings.configuration import Settings

_INERTIAS = ("a1", "a2", "a3")
FRICTIONS, INERTIAS = JOINTS * len(FRICTION_SPEEDS_RAD_S), len(_INERTIAS)
OFFSETS = FRICTIONS + INERTIAS
VISCOUS = OFFSETS + JOINTS
QUANTITIES = VISCOUS + JOINTS
"""First offset, first viscous friction, and number of quantities; frictions and inertias come before."""
ANCHORS, BELIEFS = 4, 9
LAST, REFUSED, KEPT = ANCHORS, ANCHORS + 1, ANCHORS + 2
SOURCES = KEPT + BELIEFS
"""Sources, in order: anchors, the last certificate, the fit that was refused before, beliefs from before a touch."""
ANCHOR_SIGMAS, LAST_SIGMAS = 4.0, 4.0
"""Two joints, two-sided: exceeded by 1.3e-4 of clean arms, at each comparison."""
BELIEF_SIGMAS = 3.5
"""With the floors of `earlier`: fits of 400 untouched arms had a median of 0.23 of the allowed excess, and a maximum of
0.73."""


def constants_of(settings: Settings, prior_std: Vector) -> EvidenceConstants:
    """Return the constants by which sources of evidence, such as an earlier certificate, bound a fit's quantities.

    A quantity is a joint's friction at one speed, an inertia, a torque offset, or a viscous friction. Each is a
    combination of the p parameters, its row of `columns`; columns_prior: its variance in the prior, by prior_std (p,).
    torque_Nm: largest torque of one unit of it on the trajectory; 0 for viscous friction, which the friction at a speed
    contains. sigmas: deviations that each source allows. less_counts: 1 if too little of it contradicts the source too.
    """
    unit = np.eye(prior_std.size)
    base = len(settings.estimator.parameter_names)
    friction = [v * unit[F_V1 + i] + unit[F_C1 + i] for i in range(JOINTS) for v in FRICTION_SPEEDS_RAD_S]
    inertia = unit[:INERTIAS]
    offset = [unit[base + i] for i in range(JOINTS)]
    columns = np.array([*friction, *inertia, *offset, *(unit[F_V1 + i] for i in range(JOINTS))])
    less_counts = np.ones((SOURCES, QUANTITIES))
    less_counts[LAST] = 0.0
    less_counts[KEPT:, FRICTIONS:OFFSETS] = 0.0
    return EvidenceConstants(
        columns=columns,
        columns_prior=columns**2 @ prior_std**2,
        torque_Nm=np.concatenate([np.ones(FRICTIONS), _accelerations(settings), np.ones(JOINTS), np.zeros(JOINTS)]),
        sigmas=np.repeat((ANCHOR_SIGMAS, LAST_SIGMAS, BELIEF_SIGMAS), (ANCHORS, 1, 1 + BELIEFS)),
        less_counts=less_counts,
    )


def _accelerations(settings: Settings) -> tuple[float, ...]:
    """Return the largest factors of a1, a2, a3 in a joint's torque on the trajectory, rad/s²."""
    travel_rad = 2.0 * np.radians(settings.trajectory.amplitude_deg)
    first, second = QUINTIC_PEAK_ACCELERATION * travel_rad / np.square(settings.trajectory.half_period_s)
    return first, 2.0 * first + second, first + second


def begin(m: Memory) -> None:
    """Empty all sources: set their variances and limits to inf."""
    m.evidence.variance[:] = np.inf
    m.evidence.limit[:] = np.inf


def set_source(m: Memory, s: int, value: Vector, variance: Vector, slack: Vector) -> None:
    """Set value, variance and slack, each (Q,), of all quantities of source `s`; keep its floor."""
    m.evidence.value[s], m.evidence.variance[s], m.evidence.slack[s] = value, variance, slack


@compiled
def follow(m: Memory, period_s: float) -> None:
    """Add one period to the age of each source."""
    for s in range(m.evidence.age_s.shape[0]):
        m.evidence.age_s[s] += period_s


@compiled
def set_age(m: Memory, first: int, last: int, age_s: float) -> None:
    """Set the age of the sources first .. last - 1: the time since their values were measured."""
    m.evidence.age_s[first:last] = age_s


@compiled
def set_row(m: Memory, s: int, q: int, value: float, variance: float, floor: float, slack: float) -> None:
    """Fill a row: the value of quantity q by source s, and its variance, inf if the source has no value.

    floor: least difference from the fit that counts; slack: added to the limit. Both in the quantity's unit.
    """
    own = m.evidence
    own.value[s, q] = value
    own.variance[s, q] = variance
    own.floor[s, q] = floor
    own.slack[s, q] = slack


@compiled
def empty_source(m: Memory, s: int) -> None:
    """Set the variances of source `s` to inf, so that it contradicts no fit; clear its last comparison."""
    m.evidence.variance[s] = np.inf
    m.evidence.difference[s] = 0.0
    m.evidence.limit[s] = np.inf


@compiled
def skip_row(m: Memory, s: int, q: int) -> None:
    """Clear the comparison of source `s` in quantity `q` until it is weighed again; keep its value."""
    m.evidence.difference[s, q] = 0.0
    m.evidence.limit[s, q] = np.inf


@compiled
def fit(k: Constants, m: Memory, theta: Vector, P: Vector, unit: float) -> None:
    """Set `fitted` and `fitted_variance` (Q,) to a model's value and variance of each quantity.

    theta (p,), P (p, p): the model. unit: scale of the samples' part of its variances, see `split`.
    """
    for q in range(m.evidence.fitted.shape[0]):
        value, variance = of_belief(k, q, theta, P, unit)
        put_fitted(m, q, value, variance)


@compiled
def put_fitted(m: Memory, q: int, value: float, variance: float) -> None:
    """Store the fitted value and variance of quantity `q`, for `weigh`."""
    m.evidence.fitted[q] = value
    m.evidence.fitted_variance[q] = variance


@compiled
def of_belief(k: Constants, q: int, theta: Vector, P: Vector, unit: float) -> tuple[float, float]:
    """Return a belief's value of quantity `q`, c theta, and its variance, c P c with the samples' part times `unit`."""
    column = k.evidence.columns[q]
    return linalg.dot(column, theta), split(linalg.quadratic(P, column), k.evidence.columns_prior[q], unit)


@compiled
def split(variance: float, prior: float, unit: float) -> float:
    """Return a variance after scaling the samples' part of it by `unit`, and not the prior's part.

    The inverses of both parts add up to the inverse of `variance`. If `variance` is over `prior`, return `prior`.
    """
    return 1.0 / (1.0 / prior + max(1.0 / variance - 1.0 / prior, 0.0) / unit)


@compiled
def weigh(k: Constants, m: Memory, s: int, q: int) -> float:
    """Return the fit's value of quantity `q` less that of source `s`, over its limit; store `difference` and `limit`.

    Call `fit` or `put_fitted` before. The fit contradicts the source beyond ±1. 0 if the source has no value, or if
    only more of `q` counts and the fit has less. NaN stays NaN in each case.
    """
    own = m.evidence
    difference = own.fitted[q] - own.value[s, q]
    if own.variance[s, q] == np.inf or (difference < 0.0 and not k.evidence.less_counts[s, q]):
        difference = 0.0 if np.isfinite(difference) else difference
    std = np.sqrt(own.variance[s, q] + own.fitted_variance[q])
    own.difference[s, q] = difference
    own.limit[s, q] = own.slack[s, q] + max(own.floor[s, q], k.evidence.sigmas[s] * std)
    return float(difference / own.limit[s, q])


@compiled
def excess(m: Memory, s: int, q: int) -> float:
    """Return the result of the last `weigh` of source `s` and quantity `q`; 0 if the row was cleared since."""
    return float(m.evidence.difference[s, q] / m.evidence.limit[s, q])


@compiled
def largest_excess(m: Memory, first: int, last: int, q: int) -> int:
    """Return the source whose last `excess` of quantity `q` is largest in size, the first of equals.

    first, last: the sources compared are those from first to last - 1; without any return `first`.
    """
    worst = first
    for s in range(first, last):
        if not abs(excess(m, s, q)) <= abs(excess(m, worst, q)):
            worst = s
    return worst


def named(excesses: Vector) -> list[tuple[int, str, str]]:
    """Return index, name and unit of each quantity with an excess (Q,) over 1; of a joint's frictions only the largest.

    Order: frictions, inertias, offsets, viscous frictions.
    """
    speeds = len(FRICTION_SPEEDS_RAD_S)
    found = []
    for i in range(JOINTS):
        q = speeds * i + int(np.argmax(excesses[speeds * i : speeds * (i + 1)]))
        found.append((q, f"friction of joint {i + 1} at {FRICTION_SPEEDS_RAD_S[q - speeds * i]:g} rad/s", "Nm"))
    found += [(q, name, "kg m²") for q, name in enumerate(_INERTIAS, FRICTIONS)]
    found += [(OFFSETS + i, f"torque offset of joint {i + 1}", "Nm") for i in range(JOINTS)]
    found += [(VISCOUS + i, f"viscous friction of joint {i + 1}", "Nm s/rad") for i in range(JOINTS)]
    return [(q, what, unit) for q, what, unit in found if excesses[q] > 1.0]
