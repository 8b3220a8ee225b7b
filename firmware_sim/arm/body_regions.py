"""The human body as ISO/TS 15066:2016 Annex A models it: mass, spring constant and limits of each body region.

The standard's two-mass model has a region of effective mass m_H behind a linear spring of constant K (table A.3). Its
limits (table A.2) are for quasi-static contact, where the region is clamped; in transient contact, where it can recoil,
they are twice as high. For skull, forehead and face the table has no transient factor: contact there is to be
prevented. Force limits are per region, pressure limits per area of a region: 29 areas, pain onset of 100 adults.
"""

from dataclasses import dataclass
from typing import Final

TRANSIENT_FACTOR: Final = 2.0
"""Transient over quasi-static limit, force and pressure alike; table A.2."""


@dataclass(frozen=True)
class BodyRegion:
    """One row of table A.3 with its rows of table A.2."""

    mass_kg: float  # effective mass m_H
    spring_N_mm: float  # effective spring constant K
    force_N: float  # quasi-static limit
    areas: tuple[tuple[str, float], ...]  # area, quasi-static limit of the pressure in N/cm²
    has_transient_limit: bool = True

    @property
    def stiffness_N_m(self) -> float:
        """Spring constant in N/m."""
        return 1000.0 * self.spring_N_mm

    @property
    def pressure_N_cm2(self) -> float:
        """Quasi-static limit of the region's most sensitive area."""
        return min(pressure for _, pressure in self.areas)

    @property
    def transient_force_N(self) -> float | None:
        """Transient limit; None where the standard gives none."""
        return TRANSIENT_FACTOR * self.force_N if self.has_transient_limit else None

    @property
    def transient_pressure_N_cm2(self) -> float | None:
        """Transient limit of the most sensitive area; None where the standard gives none."""
        return TRANSIENT_FACTOR * self.pressure_N_cm2 if self.has_transient_limit else None


BODY_REGIONS: Final = {
    "skull_forehead": BodyRegion(4.4, 150.0, 130.0, (("middle of forehead", 130.0), ("temple", 110.0)), False),
    "face": BodyRegion(4.4, 75.0, 65.0, (("masticatory muscle", 110.0),), False),
    "neck": BodyRegion(1.2, 50.0, 150.0, (("neck muscle", 140.0), ("seventh neck vertebra", 210.0))),
    "back_shoulder": BodyRegion(40.0, 35.0, 210.0, (("shoulder joint", 160.0), ("fifth lumbar vertebra", 210.0))),
    "chest": BodyRegion(40.0, 25.0, 140.0, (("sternum", 120.0), ("pectoral muscle", 170.0))),
    "abdomen": BodyRegion(40.0, 10.0, 110.0, (("abdominal muscle", 140.0),)),
    "pelvis": BodyRegion(40.0, 25.0, 180.0, (("pelvic bone", 210.0),)),
    "upper_arm_elbow": BodyRegion(3.0, 30.0, 150.0, (("deltoid muscle", 190.0), ("humerus", 220.0))),
    "lower_arm_wrist": BodyRegion(
        2.0, 40.0, 160.0, (("radial bone", 190.0), ("forearm muscle", 180.0), ("arm nerve", 180.0))
    ),
    "hand_finger": BodyRegion(
        0.6,
        75.0,
        140.0,
        (
            ("forefinger pad, dominant", 300.0),
            ("forefinger pad, other", 270.0),
            ("forefinger end joint, dominant", 280.0),
            ("forefinger end joint, other", 220.0),
            ("thenar eminence", 200.0),
            ("palm, dominant", 260.0),
            ("palm, other", 260.0),
            ("back of the hand, dominant", 200.0),
            ("back of the hand, other", 190.0),
        ),
    ),
    "thigh_knee": BodyRegion(75.0, 50.0, 220.0, (("thigh muscle", 250.0), ("kneecap", 220.0))),
    "lower_leg": BodyRegion(75.0, 60.0, 130.0, (("middle of shin", 220.0), ("calf muscle", 210.0))),
}
"""Regions by the name that a scenario uses."""
