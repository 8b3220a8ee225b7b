"""Compares a first certificate with the configured link lengths; names lengths that can't be checked.

Torques at the joints depend on a length through the inertia alone:
    a2 = m2 c2 l1,   a1 - a3 = I1 + m1 c1² + m2 l1²,   a3 = I2 + m2 c2²        c: centre of mass, from the link's joint

so a link that is s times as long as configured, its masses in their places, has

    link 1:  a2 → s a2,  a1 - a3 → s² (a1 - a3),  a3 unchanged     link 2:  a2 → s a2,  a3 → s² a3,  a1 - a3 unchanged

relative to `arm.cad_theta`. With gravity a5 = m2 c2 g', and l1 = g' a2 / a5; g' = g sin(tilt) acts in the plane
of motion, and a tilt smaller than configured makes l1 longer. An a5 below 0 is gravity in the other direction.
"""

from typing import Final

import numpy as np

from adacd_hil.records import GRAVITY_M_S2, Event
from adacd_hil.scheme.identify.certificate import Certificate
from adacd_hil.scheme.model.regressor import A1, A2, A3, A5
from adacd_hil.settings.configuration import Settings

EVENT: Final = "geometry"
_ALIKE: Final = 0.08
"""Largest relative difference of two equal figures; the error of a CAD model."""
_LONGER: Final = 0.12
"""Smallest relative error of a length that is reported."""

_SEEN: Final = 0.1
"""Share of the expected a5 from which its sign counts: gravity hardly acts on an arm with less."""


def geometry_event(settings: Settings, certificate: Certificate) -> Event | None:
    """Compare the configured link lengths with a certificate of the arm without payload; return the event to report.

    A warning if a length or the mounting contradicts the certificate, an info if a smaller tilt explains it or torques
    can't check a length; else None.
    """
    theta, lengths = certificate.parameters, settings.arm.link_length_m
    cad, is_upright = settings.arm.cad_theta, len(theta) > A5
    has_masses = any(cad[: A3 + 1])
    event = _by_direction(settings, theta) if is_upright else None
    if event is None and has_masses:
        event = _by_cad(theta, cad, lengths)
    if event is None and is_upright:
        event = _by_gravity(settings, theta)
    if event is not None or has_masses:
        return event
    unchecked = f"arm.link_length_m[1] = {lengths[1]:g} m" if is_upright else f"arm.link_length_m = {list(lengths)} m"
    text = f"assumed: {unchecked}, which torques alone can't check; its error shifts places and forces of contacts"
    return Event("info", EVENT, text)


def _by_direction(settings: Settings, theta: tuple[float, ...]) -> Event | None:
    """Return a warning if gravity acts against the configured mounting, by the sign of a5; else None.

    theta (p,): of the certificate, with gravity. A negative a5 counts from a share of `_SEEN` of the size that a2 and
    the lengths predict. None also if they predict no positive a5.
    """
    expected_Nm = settings.gravity_m_s2 * theta[A2] / settings.arm.link_length_m[0]
    if theta[A5] >= -_SEEN * abs(expected_Nm) or expected_Nm <= 0.0:
        return None
    hangs_deg = settings.mounting_deg[1]
    opposite_deg = hangs_deg - 180.0 if hangs_deg > 0.0 else hangs_deg + 180.0
    text = f"a5 = {theta[A5]:.3g} Nm: gravity acts against the mounting, arm.mounting_deg[1] = {hangs_deg:g} deg"
    return Event("warning", EVENT, f"{text}; link 1 hangs at q1 = {opposite_deg:g} deg")


def _by_gravity(settings: Settings, theta: tuple[float, ...]) -> Event | None:
    """Compare the length of link 1 by inertia over gravity with the configured one; return an event if they differ.

    An info if link 1 seems longer, as a smaller tilt has the same effect; a warning if it seems shorter. None if they
    agree within a share of `_LONGER`, or a2 or a5 is 0.
    """
    configured_m, configured_tilt_deg = settings.arm.link_length_m[0], settings.mounting_deg[0]
    if theta[A2] == 0.0 or theta[A5] == 0.0:
        return None
    gravity_m_s2 = GRAVITY_M_S2 * np.sin(settings.tilt_rad)
    found_m = gravity_m_s2 * abs(theta[A2] / theta[A5])
    if 1.0 / (1.0 + _LONGER) <= found_m / configured_m <= 1.0 + _LONGER:
        return None
    setting = f"arm.link_length_m[0] = {configured_m:g} m"
    if found_m > configured_m:  # a smaller tilt has the same effect
        tilt_deg = np.degrees(np.arcsin(np.sin(settings.tilt_rad) * configured_m / found_m))
        text = (
            f"{setting} is right if the arm moves at {tilt_deg:.0f} deg to the level (arm.mounting_deg[0]); at "
            f"{configured_tilt_deg:g} deg link 1 is"
        )
        return Event("info", EVENT, f"{text} {found_m:.3f} m long by inertia over gravity")
    text = f"link 1 is {found_m:.3f} m long by inertia over gravity, or shorter; {setting}: measure it"
    return Event("warning", EVENT, f"{text}; places and forces of contacts are wrong by as much")


def _by_cad(theta: tuple[float, ...], cad: tuple[float, ...], lengths: tuple[float, float]) -> Event | None:
    """Return a warning if the inertias differ from the CAD model's as if one link had another length; else None.

    theta, cad: identified parameters, and those of the CAD model. The length must differ by more than a share of
    `_LONGER`, and the inertias fit it within a share of `_ALIKE`.
    """
    cross, near, far = (
        _ratio(theta[A2], cad[A2]),
        _ratio(theta[A1] - theta[A3], cad[A1] - cad[A3]),
        _ratio(theta[A3], cad[A3]),
    )
    for joint, (square, other) in enumerate(((near, far), (far, near))):
        if abs(cross - 1.0) > _LONGER and _is_alike(square, cross * cross) and _is_alike(other, 1.0):
            text = (
                f"a2, a1 - a3 and a3 are {cross:.2f}, {near:.2f} and {far:.2f} times those of arm.cad_theta, as if "
                f"link {joint + 1} were {cross * lengths[joint]:.3f} m long; arm.link_length_m[{joint}] = "
                f"{lengths[joint]:g} m: measure it; places and forces of contacts are wrong by as much"
            )
            return Event("warning", EVENT, text)
    return None


def _ratio(found: float, expected: float) -> float:
    return found / expected if expected else 0.0


def _is_alike(found: float, expected: float) -> bool:
    return abs(found / expected - 1.0) <= _ALIKE if expected else False
