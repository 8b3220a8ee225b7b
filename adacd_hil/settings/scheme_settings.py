"""Settings of the schemes: `filter`, `estimator`, `termination` and `detector` of the paper's, `certified`."""

from dataclasses import dataclass

from adacd_hil.records import GRAVITY_PARAMETER_NAMES, PARAMETER_NAMES
from adacd_hil.settings.schema import ConfigError, setting


@dataclass(frozen=True)
class FilterSettings:
    """The torque filter, eq. (16): F(s) = b / (s + a)."""

    a_rad_s: float = setting(10.0, unit="rad/s", low=0.1, high=1000.0, meaning="cut-off of the torque filter")
    b_rad_s: float = setting(
        10.0, unit="rad/s", low=0.1, high=1000.0, meaning="gain; DC gain b/a scales every threshold"
    )


_GRAVITY_P0 = (50.0, 50.0)
"""Gravity torques are about ten times Coulomb friction, whose gain is 0.5; a gain goes with the square."""


@dataclass(frozen=True)
class EstimatorSettings:
    """The adaptation law, eq. (10): its kind, its gain, and whether gravity is estimated."""

    law: str = setting(
        "least_squares", choices=("least_squares", "gradient"), meaning="P from P(0) by least squares, or constant"
    )
    P0: tuple[float, ...] = setting(
        (8.0, 4.0, 4.0, 0.5, 0.5, 0.5, 0.5),
        low=0.0,
        high=1e6,
        meaning=f"diagonal of P(0), gain in continuous time, 1/s; a4 and a5 may be left out ({_GRAVITY_P0[0]:g})",
    )
    gravity: bool = setting(False, meaning="estimate a4 and a5: the joint axes are not vertical")

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the estimated parameters in the order of theta: a1 to F_c2; with `gravity` a4 and a5 follow."""
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
    """The end of adaptation: eq. (15), the evidence it needs, and the longest time."""

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
    """Collision detection: thresholds of eq. (14), standstill, upper thresholds, time to decide on the link."""

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


KIND_S = 0.1
"""Time from detection to the decision of a contact's kind by the certified scheme; its report is final then."""
FRICTION_TERMS = ("stribeck", "load", "asymmetric", "width", "dahl_short", "dahl_long")
"""Optional friction terms of the certified scheme, one parameter per joint each: `scheme.model.further_friction`."""
CROSS_TALK = "cross_talk"
"""Name of the parameter: share of the other joint's torque in a torque sensor's value, Nm/Nm."""

_KINDS = "inertia kg m², viscous Nm s/rad, Coulomb Nm, gravity Nm, torque offset Nm, lag s, further friction Nm"


@dataclass(frozen=True)
class CertifiedSettings:
    """The certified scheme: prior and process noise of the parameters, evidence for a certificate, thresholds.

    Lists of seven numbers are by kind of parameter: inertia, viscous friction, Coulomb friction, gravity, torque
    offset, lag, further friction.
    """

    cutoffs_rad_s: tuple[float, ...] = setting(
        (10.0, 50.0, 200.0), unit="rad/s", low=1.0, high=1000.0, meaning="filters of the bank, from slow to fast"
    )
    smoothing_rad_s: float = setting(
        200.0, unit="rad/s", low=10.0, high=3000.0, meaning="second low-pass behind each filter, against velocity noise"
    )
    noise_sigmas: float = setting(6.5, low=1.0, high=50.0, meaning="threshold in deviations of the torque's noise")
    model_sigmas: float = setting(3.25, low=1.0, high=50.0, meaning="threshold, in standard deviations of the model")
    friction_terms: tuple[str, ...] = setting(
        ("stribeck", "load", "dahl_short", "dahl_long"),
        choices=FRICTION_TERMS,
        meaning="friction beyond viscous and Coulomb",
    )
    dahl_rad: tuple[float, float] = setting(
        (0.001, 0.004), unit="rad", low=1e-6, high=1.0, meaning="bristle lengths of dahl_short and dahl_long"
    )
    cross_talk_std: float = setting(
        0.01,
        low=0.0,
        high=0.5,
        meaning="share of the other joint's torque in a sensor's value, a standard deviation; 0: not identified",
    )
    still_rad_s: float = setting(
        0.002,
        unit="rad/s",
        low=0.0,
        high=1.0,
        meaning="|dq| below which a joint may stand still; above the noise of dq",
    )
    coulomb_width_rad_s: float = setting(
        0.0, unit="rad/s", low=0.0, high=1.0, meaning="Coulomb friction is F_c tanh(dq / width); 0: F_c sgn(dq)"
    )
    stribeck_rad_s: float = setting(
        0.05, unit="rad/s", low=1e-3, high=10.0, meaning="speed over which static friction falls off"
    )
    prior_std: tuple[float, ...] = setting(
        (1.0, 0.5, 0.5, 10.0, 0.3, 0.001, 0.2), low=0.0, high=1e6, meaning=f"prior standard deviation: {_KINDS}"
    )
    enough_std: tuple[float, ...] = setting(
        (0.02, 0.04, 0.04, 0.2, 0.04, 0.004, 0.2),
        low=0.0,
        high=1e6,
        meaning=f"largest standard deviation for a certificate: {_KINDS}",
    )
    drift_std: tuple[float, ...] = setting(
        (0.0, 0.0015, 0.0015, 0.0, 0.0005, 0.0, 0.0015),
        low=0.0,
        high=1e3,
        meaning=f"drift in a second of monitoring, standard deviation: {_KINDS}",
    )
    model_error: tuple[float, ...] = setting(
        (0.003, 0.01, 0.01, 0.01, 0.0, 0.1, 0.1), low=0.0, high=1.0, meaning=f"part that no model explains: {_KINDS}"
    )
    payload_std_kg: float = setting(3.0, unit="kg", low=0.0, high=1000.0, meaning="deviation of a payload's mass")
    payload_inertia_std: float = setting(
        0.02, unit="kg m²", low=0.0, high=100.0, meaning="deviation of its inertia about its own centre"
    )
    residual_Nm: float = setting(0.02, unit="Nm", low=1e-4, high=10.0, meaning="deviation of one filtered residual")
    learn_every: int = setting(4, low=1, high=100, meaning="the estimator learns from one sample in so many")
    hold_back_s: float = setting(
        0.06, unit="s", low=0.0, high=1.0, meaning="how long a sample waits until it is learnt; a contact discards it"
    )
    recover_s: float = setting(
        0.5, unit="s", low=0.0, high=60.0, meaning="time after a contact in which samples are not learnt"
    )
    fit_s: tuple[float, float] = setting(
        (1.4, 0.45), unit="s", low=0.05, high=600.0, meaning="shortest fit: of the arm, of a payload"
    )
    test_s: tuple[float, float] = setting(
        (0.6, 0.35), unit="s", low=0.05, high=600.0, meaning="test of the frozen model: of the arm, with a payload"
    )
    beta_Nm: float = setting(
        0.1, unit="Nm", low=1e-3, high=100.0, meaning="test: largest |tau_ext_hat| of the slowest filter"
    )
    excitation_Nm2s: float = setting(
        5e-5, unit="Nm² s", low=0.0, high=1e6, meaning="smallest eigenvalue of the scaled information matrix"
    )
    condition: float = setting(1e5, low=1.0, high=1e12, meaning="largest condition number of the same matrix")
    refine_s: float = setting(4.0, unit="s", low=0.1, high=3600.0, meaning="test of a refined model before it is used")
    torque_noise_Nm: float = setting(0.02, unit="Nm", low=0.0, high=10.0, meaning="torque sensor, rms of one sample")
    velocity_noise_rad_s: float = setting(
        3.3e-3, unit="rad/s", low=0.0, high=1.0, meaning="velocity, largest error of one sample"
    )
    lag_s: float = setting(
        0.00125, unit="s", low=0.0, high=0.1, meaning="expected lag of the velocity behind the torque; identified"
    )
    standstill_share: float = setting(1.0, low=0.0, high=10.0, meaning="share of F_c that is uncertain at rest")

    def __post_init__(self) -> None:
        if len(self.cutoffs_rad_s) < 2:
            raise ConfigError(f"`certified.cutoffs_rad_s` has {len(self.cutoffs_rad_s)} values, at least 2 expected")
        if list(self.cutoffs_rad_s) != sorted({*self.cutoffs_rad_s}):
            raise ConfigError(f"`certified.cutoffs_rad_s` = {self.cutoffs_rad_s} must go from slow to fast")
        if len({*self.friction_terms}) < len(self.friction_terms):
            raise ConfigError(f"`certified.friction_terms` = {self.friction_terms} has a term twice")
        for name in ("prior_std", "enough_std", "drift_std", "model_error"):
            count = len(getattr(self, name))
            if count != 7:
                raise ConfigError(f"`certified.{name}` has {count} values, 7 expected: {_KINDS}")
