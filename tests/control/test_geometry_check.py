"""What a certificate says of the lengths that the host was told."""

import dataclasses

import pytest

from adacd_hil.control.geometry_check import geometry_event
from adacd_hil.scheme.identify.certificate import Certificate
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings

LENGTHS = (0.4, 0.25)
MASSES = (2.0, 1.0)


def inertia(l1: float, l2: float) -> tuple[float, float, float]:
    """Return a1, a2, a3 of uniform rods."""
    m1, m2 = MASSES
    a3 = m2 * l2**2 / 3.0
    return m1 * l1**2 / 3.0 + m2 * l1**2 + a3, m2 * l1 * l2 / 2.0, a3


def told(cad: tuple[float, ...], tilt_deg: float = 0.0) -> Settings:
    settings = load_settings("certified")
    estimator, mounting_deg = settings.estimator, None
    if tilt_deg:
        estimator = dataclasses.replace(estimator, gravity=True, P0=(*estimator.P0, 50.0, 50.0))
        mounting_deg, cad = (tilt_deg, -90.0), (*cad, 0.0, 0.0) if cad else ()
    arm = dataclasses.replace(settings.arm, link_length_m=LENGTHS, cad_theta=cad, mounting_deg=mounting_deg)
    return dataclasses.replace(settings, arm=arm, estimator=estimator)


FRICTION = (0.03, 0.015, 0.04, 0.02)
L1, L2 = LENGTHS
A1, A2, A3 = inertia(L1, L2)
A5 = 9.80665 * A2 / L1
CAD = (A1, A2, A3, 0.0, 0.0, 0.0, 0.0)
FLAT, UPRIGHT, TILTED = told(CAD), told(CAD, 90.0), told((), 30.0)
NO_MASSES, UPRIGHT_NO_MASSES = told(()), told((), 90.0)
HANGS = "arm.mounting_deg[1] = -90 deg; link 1 hangs at q1 = 90 deg"
ASSUMED = "assumed: arm.link_length_m"


@pytest.mark.parametrize(
    ("settings", "found", "gravity", "level", "says"),
    [
        (FLAT, inertia(L1, L2), (), "", ""),
        (FLAT, inertia(0.5, L2), (), "warning", "as if link 1 were 0.500 m long; arm.link_length_m[0] = 0.4 m"),
        (FLAT, inertia(0.32, L2), (), "warning", "as if link 1 were 0.320 m long; arm.link_length_m[0] = 0.4 m"),
        (FLAT, inertia(L1, 0.3126), (), "warning", "as if link 2 were 0.313 m long; arm.link_length_m[1] = 0.25 m"),
        (FLAT, inertia(L1, 0.2), (), "warning", "as if link 2 were 0.200 m long; arm.link_length_m[1] = 0.25 m"),
        (FLAT, (1.07 * A1, 0.92 * A2, 1.06 * A3), (), "", ""),  # the CAD model is off otherwise
        (FLAT, (A1 + 0.22, A2 + 0.1, A3 + 0.0625), (), "", ""),  # 1 kg at the tip
        (NO_MASSES, inertia(L1, L2), (), "info", f"{ASSUMED} = [0.4, 0.25] m"),
        (UPRIGHT_NO_MASSES, inertia(L1, L2), (3.0, A5), "info", f"{ASSUMED}[1] = 0.25 m"),
        (
            UPRIGHT_NO_MASSES,
            inertia(0.5, L2),
            (3.0, A5),
            "info",
            "to the level (arm.mounting_deg[0]); at 90 deg link 1",
        ),
        (UPRIGHT_NO_MASSES, inertia(0.5, L2), (3.0, A5), "info", "arm moves at 53 deg to the level"),
        (UPRIGHT_NO_MASSES, inertia(0.32, L2), (3.0, A5), "warning", "link 1 is 0.320 m long by inertia over gravity"),
        (TILTED, inertia(L1, L2), (3.0, 0.5 * A5), "info", f"{ASSUMED}[1] = 0.25 m"),  # no longer link
        (UPRIGHT, inertia(L1, L2), (13.7, A5), "", ""),
        (UPRIGHT, inertia(L1, 0.3125), (13.7, 1.25 * A5), "warning", "as if link 2 were"),
        (UPRIGHT, inertia(0.5, L2), (13.7, A5), "warning", "as if link 1 were"),
        (UPRIGHT, inertia(L1, L2), (-0.06 * A5, -0.02 * A5), "info", "the arm moves at 1 deg to the level"),
        (UPRIGHT, inertia(L1, L2), (-3.0 * A5, -A5), "warning", HANGS),
        (UPRIGHT_NO_MASSES, inertia(L1, L2), (-3.0 * A5, -A5), "warning", HANGS),
    ],
)
def test_what_contradicts_a_length_or_the_mounting_is_named_and_what_cannot_be_checked_is_said(
    settings: Settings, found: tuple[float, float, float], gravity: tuple[float, ...], level: str, says: str
) -> None:
    event = geometry_event(settings, Certificate((*found, *FRICTION, *gravity), (), (), (), (), (), (), False, ""))
    assert (event is not None) == bool(level)
    if event is not None:
        assert event.level == level
        assert says in event.message
