"""Settings of the paper's scheme: sections `filter`, `estimator`, `termination` and `detector`."""

from dataclasses import dataclass

from adacd_hil.records import GRAVITY_PARAMETER_NAMES, PARAMETER_NAMES
from adacd_hil.settings.schema import ConfigError, setting


@dataclass(frozen=True)
class FilterSettings:
    """Eq. (16): F(s) = b / (s + a)."""

    a_rad_s: float = setting(10.0, unit="rad/s", low=0.1, high=1000.0, meaning="cut-off of the torque filter")
    b_rad_s: float = setting(
        10.0, unit="rad/s", low=0.1, high=1000.0, meaning="gain; DC gain b/a scales every threshold"
    )


_GRAVITY_P0 = (50.0, 50.0)
"""Gravity's torques are some ten times those of Coulomb friction, whose gain is 0.5; a gain goes by their square."""


@dataclass(frozen=True)
class EstimatorSettings:
    """Eq. (10)."""

    law: str = setting(
        "least_squares", choices=("least_squares", "gradient"), meaning="P from P(0) by least squares, or constant"
    )
    P0: tuple[float, ...] = setting(
        (8.0, 4.0, 4.0, 0.5, 0.5, 0.5, 0.5),
        low=0.0,
        high=1e6,
        meaning="diagonal of P(0), gain in continuous time, 1/s; a4 and a5 may be left out (50)",
    )
    gravity: bool = setting(False, meaning="estimate a4 and a5: the joint axes are not vertical")

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the estimated parameters, in order."""
        return PARAMETER_NAMES + (GRAVITY_PARAMETER_NAMES if self.gravity else ())

    def __post_init__(self) -> None:
        if self.gravity and len(self.P0) == len(PARAMETER_NAMES):
            object.__setattr__(self, "P0", self.P0 + _GRAVITY_P0)
        if len(self.P0) != len(self.parameter_names):
            names = ", ".join(self.parameter_names)
            raise ConfigError(
                f"`estimator.P0` has {len(self.P0)} values, {len(self.parameter_names)} expected: {names}"
            )


@dataclass(frozen=True)
class TerminationSettings:
    """Eq. (15) and the evidence it needs."""

    beta_Nm: float = setting(0.1, unit="Nm", low=0.001, high=100.0, meaning="bound on |tau_ext_hat| of each joint")
    hold_s: float = setting(5.0, unit="s", low=0.1, high=600.0, meaning="T: how long the bound must hold")
    timeout_s: float = setting(60.0, unit="s", low=1.0, high=3600.0, meaning="longest adaptation; then FAULT")
    travel_deg: float = setting(20.0, unit="deg", low=0.0, high=360.0, meaning="travel of each joint to count as moved")
    velocity_deg_s: float = setting(
        10.0, unit="deg/s", low=0.0, high=360.0, meaning="speed that each joint must reach both ways"
    )
    excitation_Nm2s: float = setting(
        2e-4, unit="Nm² s", low=0.0, high=1e6, meaning="smallest eigenvalue of the scaled information matrix"
    )
    excitation_scale: tuple[float, float, float, float] = setting(
        (0.1, 0.05, 0.05, 1.0),
        low=1e-6,
        high=1e6,
        meaning="parameter error that the motion must show: inertia kg m², viscous Nm s/rad, Coulomb Nm, gravity Nm",
    )


@dataclass(frozen=True)
class DetectorSettings:
    """Eq. (14)."""

    threshold_Nm: tuple[float, float] = setting((0.15, 0.15), unit="Nm", low=0.001, high=100.0, meaning="per joint")
    standstill_rad_s: float = setting(
        0.01, unit="rad/s", low=0.0, high=1.0, meaning="|dq| below which friction may hold any torque up to F_c; 0: off"
    )
    isolation_window_s: float = setting(
        0.05, unit="s", low=0.0, high=1.0, meaning="time from detection to the final decision on the link"
    )
    collision_Nm: tuple[float, float] = setting(
        (2.0, 1.0), unit="Nm", low=0.01, high=1000.0, meaning="upper threshold; `paper`: any contact is a collision"
    )
