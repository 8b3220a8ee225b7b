"""Two rigid links that move as a planar model says: what a URDF needs and the model's parameters don't tell.

The parameters of eq. (17) are lumped, in the frame of `records.PARAMETER_NAMES`:

    a1 - a3 = I1 + m1 c1² + m2 l1²     a2 = l1 m2 c2     a3 = I2 + m2 c2²     a4 = g (m1 c1 + m2 l1)     a5 = g m2 c2

m mass kg, c place of the centre of mass along the link m, I inertia about it kg m², l length m. Every distribution of
masses that fits is as right as any other: torque and motion are the same. Link 2's centre of mass must lie within
l1 a2 / (a1 - a3) < c2 < l1 a3 / a2, or an inertia is negative; the geometric mean of both is taken. Link 1 is a uniform
rod, unless gravity says where its centre of mass is.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

GRAVITY_M_S2 = 9.80665
_A1, _A2, _A3, _A4, _A5 = 0, 1, 2, 7, 8
_ROD_C, _ROD_I = 1.0 / 2.0, 1.0 / 12.0  # of a uniform rod: place of its centre and inertia about it
_AGREEMENT = 0.01
"""Share by which a5 may differ from what a2 makes of it."""


class LinkBody(NamedTuple):
    """One link's mass in kg, its centre along the link in m, inertia about it in kg m²."""

    mass_kg: float
    center_m: float
    inertia_kg_m2: float


class ModelError(ValueError):
    """Parameters that belong to no rigid links; one line."""


def find_bodies(theta: Sequence[float], length1_m: float) -> tuple[LinkBody, LinkBody]:
    """Find two links with these parameters (p,), 7 or 9 of them. Raises ModelError when there are none."""
    alpha, beta, gamma = theta[_A1] - theta[_A3], theta[_A2], theta[_A3]
    if not (gamma > 0.0 and alpha * gamma > beta * beta):
        raise ModelError(f"a1 = {theta[_A1]:g}, a2 = {beta:g}, a3 = {gamma:g} kg m² belong to no rigid links")
    if beta > 0.0:
        center2_m = length1_m * math.sqrt(gamma / alpha)
        mass2_kg = beta / (length1_m * center2_m)
    else:
        center2_m, mass2_kg = 0.0, 0.5 * alpha / length1_m**2
    second = LinkBody(mass2_kg, center2_m, gamma - mass2_kg * center2_m**2)
    left = alpha - mass2_kg * length1_m**2  # of link 1 about joint 1
    if len(theta) <= _A5:
        mass1_kg = left / ((_ROD_C**2 + _ROD_I) * length1_m**2)
        return LinkBody(mass1_kg, _ROD_C * length1_m, _ROD_I * mass1_kg * length1_m**2), second
    expected_Nm = GRAVITY_M_S2 * mass2_kg * center2_m
    if abs(theta[_A5] - expected_Nm) > _AGREEMENT * max(expected_Nm, theta[_A5]):
        raise ModelError(f"a5 = {theta[_A5]:g} Nm, but a2 = {beta:g} kg m² makes it {expected_Nm:g} Nm")
    moment = theta[_A4] / GRAVITY_M_S2 - mass2_kg * length1_m
    if moment == 0.0:
        return LinkBody(3.0 * left / length1_m**2, 0.0, left), second
    center1_m = math.copysign(min(_ROD_C * length1_m, 0.5 * left / abs(moment)), moment)
    return LinkBody(moment / center1_m, center1_m, left - moment * center1_m), second
