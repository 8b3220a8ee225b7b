"""Further friction: optional friction terms, linear in their parameters, beside viscous and Coulomb friction.

    stribeck     sgn(dq) exp(-(dq / v_s)²)      static friction that falls off with speed, Nm
    load         sgn(dq) |tau_J|                friction in proportion to the transmitted torque, Nm/Nm
    asymmetric   |sgn(dq)|                      half the difference of the two directions' Coulomb friction, Nm
    width        -x / cosh²(x), x = dq / w      a width of tanh that is not w, to first order: F_c log(width / w), Nm
    dahl_short   z - sgn(dq)                    deficit of Coulomb friction after a reversal, until bristles of a length
    dahl_long                                   d have bent the other way: z' = dq (1 - z sgn(dq)) / d, Nm

sgn stands for tanh(dq / w), or with w = 0 for the sign itself, 0 of a joint that may stand still (no `width` then).
One parameter per joint and term, in the order of the settings. While a joint moves its asymmetry looks like an offset
of its torque sensor; only rest separates the two.

Bristles don't bend while a joint may stand still. Two lengths together stand for those between them.

Shapes: dq, tau_J (n,); bent (2, n): z of the short and of the long ones; Y_h (n, p).
"""

import math

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import Vector
from adacd_hil.settings.scheme_settings import FRICTION_TERMS

STRIBECK, LOAD, ASYMMETRIC, WIDTH, DAHL_SHORT, DAHL_LONG = range(len(FRICTION_TERMS))
SHARES = {"load": 0.25, "dahl": 0.5}
"""Share of the prior of further friction, by the first part of a term's name; 1 for the others."""


@compiled
def smooth_sign(dq: float, still_rad_s: float, width_rad_s: float) -> float:
    """Return tanh(dq / width); for a width of 0 the sign of dq, or 0 if |dq| is below still_rad_s."""
    if width_rad_s > 0.0:
        return float(math.tanh(dq / width_rad_s))
    return float(np.sign(dq)) if abs(dq) >= still_rad_s else 0.0


@compiled
def bend_bristles(dq: Vector, period_s: float, still_rad_s: float, dahl_rad: Vector, bent: Vector) -> None:
    """Advance `bent` (2, n), the bristles' bend of each length dahl_rad (2,), by one period; -1 or 1: they slide.

    A joint slower than still_rad_s keeps its bend.
    """
    for length in range(bent.shape[0]):
        for i in range(dq.shape[0]):
            if abs(dq[i]) >= still_rad_s:
                sign = np.sign(dq[i])
                bent[length, i] = sign + (bent[length, i] - sign) * math.exp(-abs(dq[i]) * period_s / dahl_rad[length])


@compiled
def fill_terms(
    dq: Vector,
    tau_J: Vector,
    terms: Vector,
    speeds: tuple[float, float, float],
    bent: Vector,
    first_column: int,
    Y_h: Vector,
) -> None:
    """Fill the columns of Y_h (n, p) for the optional friction terms, from `first_column` on, by term and then joint.

    terms: their indices in `FRICTION_TERMS`. speeds: still, width w and v_s, rad/s. bent (2, n): of the bristles, see
    `bend_bristles`.
    """
    count = dq.shape[0]
    still_rad_s, width_rad_s, stribeck_rad_s = speeds
    for position in range(terms.shape[0]):
        for i in range(count):
            sign = smooth_sign(dq[i], still_rad_s, width_rad_s)
            if terms[position] == STRIBECK:
                value = sign * math.exp(-((dq[i] / stribeck_rad_s) ** 2))
            elif terms[position] == LOAD:
                value = sign * abs(tau_J[i])
            elif terms[position] == ASYMMETRIC:
                value = abs(sign)
            elif terms[position] == DAHL_SHORT or terms[position] == DAHL_LONG:
                value = bent[0 if terms[position] == DAHL_SHORT else 1, i] - sign
            else:
                x = dq[i] / width_rad_s if width_rad_s > 0.0 else 0.0
                value = -x / np.cosh(min(abs(x), 300.0)) ** 2
            Y_h[i, first_column + position * count + i] = value
