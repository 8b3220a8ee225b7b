"""Place and strength of a contact: force and lever arm from the external torques of a 2R arm.

One contact without friction pushes at right angles to its link. On link 2, with the lever arm r from joint 2:

    tau_2 = F r,   tau_1 = F (r + l1 cos q2)    =>    F = (tau_1 - tau_2) / (l1 cos q2),   r = tau_2 / F

When the arm begins to react, the torque of its drive jumps. Through the lag, this distorts some ten samples of both
joints: F is a third too large in the strongest one. So F is the largest median over a part of the strong samples.

At q2 = ±90° both joints carry the same information and F is unknown. Over a contact's strong samples r is the slope of
tau_2 over F by least squares; F's noise biases it by 2 % at 1 N, far below its standard deviation. On link 1 only the
moment is known: |F| >= |tau_1| / l1. A force along link 2 has no lever arm: one within asin(h_2 / (F l2)) of the link's
axis leaves joint 2 below its threshold h_2 wherever it is. It looks like a force on link 1 with F l1 |sin q2| =
|tau_1|. With friction, or two contacts, r may fall off the link.

Shapes: tau_ext_wide_hat (n, 2), Nm, filter undone; q2 (n,), rad; sigma (2,), its standard deviation, Nm.
"""

import math
from typing import NamedTuple

import numpy as np

from adacd_hil import linalg
from adacd_hil.compiled import compiled
from adacd_hil.records import Location, Vector

LARGEST_LEVER_SIGMA_M = 0.03
"""A lever arm with a larger standard deviation counts as unknown."""
SQUARE_COSINE = 0.17
"""|cos q2| within 10° of a right angle: there a percent of error in tau_1 - tau_2 is six of the force."""
WORTH = 0.5
"""Smaller samples, as a part of the strongest one, carry little information on the place: model error dominates."""

TOP_PARTS = 3
"""One in so many of a contact's strong samples: the force is a median over these. On a half-sine's top it takes off 1.5
%."""
TOP_PLACES = 16
"""At most twice as many windows of that part are tried: it bounds the work, whatever the number of samples."""

MODEL_SHARE = 0.015
"""Standard deviation of a large torque as a part of it: distortion of a blow by the mean and the velocity loop."""

TIP_M = 0.03
"""Distance past the tip up to which a touch, of the load for instance, counts as one of the link's end."""


class Place(NamedTuple):
    """Force at right angles to the touched link, and its lever arm from that link's joint, with standard deviations.

    location: how far they are known. A standard deviation is inf if its value is unknown.
    """

    location: Location
    force_N: float = 0.0
    force_sigma: float = math.inf
    lever_m: float = 0.0
    lever_sigma: float = math.inf


def on_link1(tau_1: float, sigma_1: float, length1_m: float) -> Place:
    """Return the smallest force on link 1 that has the moment `tau_1`, Nm, about joint 1, with an unknown lever arm.

    sigma_1: standard deviation of tau_1, Nm.
    """
    return Place(Location.LINK_1, tau_1 / length1_m, sigma_1 / length1_m)


def on_link2(tau_ext_wide_hat: Vector, q2: Vector, sigma: Vector, length_m: tuple[float, float]) -> Place:
    """Return the peak force and the lever arm of a contact on link 2, on the assumption of one touch without friction.

    tau_ext_wide_hat (n, 2), Nm, and q2 (n,), rad: of the contact's samples. sigma (2,): standard deviation of the
    torques, Nm. length_m: of both links. Force and lever are unknown if the links are nearly at a right angle; a lever
    off the link is returned with a location that names it so.
    """
    return Place(*_fit(tau_ext_wide_hat, q2, sigma, length_m[0], length_m[1]))


def blind_angle(force_N: float, lever_m: float, threshold_2: float) -> float:
    """Return the half-angle, rad, about link 2's axis within which a force of this size leaves joint 2 below threshold.

    pi / 2: a force of any direction at this lever arm does. threshold_2: of joint 2, Nm.
    """
    moment = abs(force_N * lever_m)
    return math.asin(threshold_2 / moment) if moment > threshold_2 else 0.5 * math.pi


def blind_angle_of_link1(tau_1: float, q2: float, length_m: tuple[float, float], threshold_2: float) -> float:
    """Return the half-angle, rad, about link 2's axis within which a force at its end looks like a force on link 1.

    tau_1: torque of joint 1, Nm, which that force would have caused; threshold_2: of joint 2, Nm. 0 if the links are in
    line: a force along link 2 has no torque then.
    """
    across = abs(math.sin(q2))
    return blind_angle(abs(tau_1) / (length_m[0] * across), length_m[1], threshold_2) if across > 0.0 else 0.0


@compiled
def _top(forces: Vector) -> float:
    """Return the moving median of forces (n,) that is largest in size, with its sign; 0 without forces.

    Each median is over n / TOP_PARTS forces; at most 2 TOP_PLACES windows, evenly spaced, are tried.
    """
    count = forces.shape[0]
    width = max(count // TOP_PARTS, 1)
    step = max((count - width) // TOP_PLACES, 1)
    best = 0.0
    for k in range(0, count - width + 1, step):
        middle = float(np.median(forces[k : k + width]))
        if abs(middle) > abs(best):
            best = middle
    return best


@compiled
def _fit(
    tau: Vector, q2: Vector, sigma: Vector, length1_m: float, length2_m: float
) -> tuple[Location, float, float, float, float]:
    """Fit one force across link 2 to the strong samples; return location, force, its sigma, lever, its sigma.

    Strong: at least WORTH of the strongest. Lever: the force's arm from joint 2. Units: N and m. A sigma is inf if its
    value is unknown. The location is SINGULAR, with all unknown, if link 2 is nearly at a right angle to link 1;
    INCONSISTENT or BEYOND_TIP if the lever is off the link; UNCERTAIN if its sigma is too large; else KNOWN.
    """
    weight = np.abs(tau[:, 0]) / sigma[0] + np.abs(tau[:, 1]) / sigma[1]
    strongest = int(np.argmax(weight))
    arm = length1_m * np.cos(q2[strongest])
    if abs(np.cos(q2[strongest])) < SQUARE_COSINE:
        return Location.SINGULAR, 0.0, np.inf, 0.0, np.inf
    strong = weight >= WORTH * np.max(weight)
    tau_1, tau_2 = tau[:, 0][strong], tau[:, 1][strong]
    forces = (tau_1 - tau_2) / (length1_m * np.cos(q2[strong]))
    squares, products = linalg.dot(forces, forces), linalg.dot(forces, tau_2)
    force = _top(forces)
    sigma_1 = np.hypot(sigma[0], MODEL_SHARE * tau[strongest, 0])
    sigma_2 = np.hypot(sigma[1], MODEL_SHARE * tau[strongest, 1])
    force_sigma = np.hypot(sigma_1, sigma_2) / abs(arm)
    if not squares > 0.0:
        return Location.UNCERTAIN, force, force_sigma, 0.0, np.inf
    lever = products / squares
    # Deviation of tau_2 - r F = tau_2 (1 + r / arm) - tau_1 r / arm. Neighbours share their noise: they count as one.
    share = lever / arm
    lever_sigma = np.hypot(sigma_2 * (1.0 + share), sigma_1 * share) / abs(force)
    margin = 3.0 * lever_sigma
    if lever < -margin or lever > length2_m + TIP_M + max(margin, length2_m):
        return Location.INCONSISTENT, force, force_sigma, lever, lever_sigma
    if lever > length2_m + TIP_M + margin:
        return Location.BEYOND_TIP, force, force_sigma, lever, lever_sigma
    if lever_sigma > LARGEST_LEVER_SIGMA_M:
        return Location.UNCERTAIN, force, force_sigma, lever, lever_sigma
    return Location.KNOWN, force, force_sigma, lever, lever_sigma
