"""Settings of the checks and measurements before a run: sections `safety`, `tare` and `history`."""

from dataclasses import dataclass

from adacd_hil.records import JOINTS
from adacd_hil.settings.schema import setting


@dataclass(frozen=True)
class SafetySettings:
    """Checks before torque."""

    commission_s: float = setting(
        0.2, unit="s", low=0.01, high=100.0, meaning="time at rest with complete data before the drives are enabled"
    )
    rest_velocity_rad_s: float = setting(0.05, unit="rad/s", low=1e-4, high=1.0, meaning="|dq| that counts as at rest")
    rest_torque_Nm: float = setting(1.0, unit="Nm", low=0.01, high=100.0, meaning="largest |tau_J| before enabling")
    phase_timeout_s: float = setting(5.0, unit="s", low=0.1, high=600.0, meaning="longest COMMISSION and ENABLE")
    tolerated_emergencies: tuple[int, ...] = setting(
        (0x8200, 0x8210, 0x8240),
        low=0x0100,
        high=0xFFFF,
        meaning="EMCY error codes that don't stop the arm; any other does at once; default: one odd SYNC, a PDO "
        "or a SYNC of the wrong length",
    )


@dataclass(frozen=True)
class TareSettings:
    """Tare of the joint torque sensors: how long, how still, how far apart, and how old.

    The bounds on spread and drift are a small part of the detection threshold (0.15 Nm); an offset that is off by the
    threshold is a contact that nobody made.
    """

    poses: int = setting(1, low=1, high=50, meaning="poses to measure in")
    window_s: float = setting(2.0, unit="s", low=0.1, high=600.0, meaning="measured time in each pose")
    settle_s: float = setting(0.5, unit="s", low=0.0, high=60.0, meaning="rest before the measurement of a pose")
    move_deg: float = setting(
        10.0, unit="deg", low=1.0, high=360.0, meaning="a new pose: some joint is further than this from the last one"
    )
    move_timeout_s: float = setting(
        120.0, unit="s", low=1.0, high=3600.0, meaning="longest wait for the user to move the arm to a new pose"
    )
    creep_limit_deg: float = setting(0.1, unit="deg", low=1e-4, high=10.0, meaning="largest travel while measuring")
    std_limit_Nm: float = setting(
        0.06, unit="Nm", low=1e-6, high=100.0, meaning="largest standard deviation; sensors have about 0.02"
    )
    peak_to_peak_limit_Nm: float = setting(
        0.5, unit="Nm", low=1e-6, high=100.0, meaning="largest difference of two samples; shows a short knock"
    )
    drift_limit_Nm: float = setting(
        0.02, unit="Nm", low=1e-6, high=100.0, meaning="largest difference of the means of the window's halves"
    )
    offset_limit_Nm: tuple[float, float] = setting(
        (2.0, 2.0), unit="Nm", low=1e-3, high=50.0, meaning="largest plausible offset; beyond it something pushes"
    )
    pose_limit_Nm: float = setting(
        0.1, unit="Nm", low=1e-6, high=100.0, meaning="vertical axes: largest spread of poses; else largest residual"
    )
    missing_limit: float = setting(0.01, low=0.0, high=0.5, meaning="largest share of cycles without complete data")
    gravity_model: str = setting(
        "estimated", choices=("estimated", "cad"), meaning="with estimator.gravity: a4, a5 from the poses, or the CAD's"
    )
    condition_limit: float = setting(
        30.0, low=1.0, high=1e6, meaning="largest condition number of the poses' equations for a4, a5 and offsets"
    )
    auto_zero_limit_Nm: float = setting(
        0.02, unit="Nm", low=1e-6, high=10.0, meaning="largest torque left after the sensor's own zero, 0x6125"
    )
    warn_age_h: float = setting(24.0, unit="h", low=0.0, high=1e5, meaning="age beyond which a run warns of a tare")
    max_age_h: float = setting(0.0, unit="h", low=0.0, high=1e5, meaning="age at which a run refuses a tare; 0: never")
    drift_Nm_sqrt_s: float = setting(
        2e-5, unit="Nm/√s", low=0.0, high=1.0, meaning="random walk of a sensor's zero; see its data sheet"
    )
    drift_Nm_K: float = setting(
        1e-3, unit="Nm/K", low=0.0, high=10.0, meaning="drift of a sensor's zero with temperature; see its data sheet"
    )
    temperature_K: float = setting(
        5.0, unit="K", low=0.0, high=200.0, meaning="largest difference of temperature since the tare"
    )

    def drift_variance(self, age_s: float) -> float:
        """Return by how much a sensor's zero may have moved in so long, as a variance in Nm²."""
        return (self.drift_Nm_K * self.temperature_K) ** 2 + self.drift_Nm_sqrt_s**2 * age_s


@dataclass(frozen=True)
class HistorySettings:
    """What the arm's last certificate, of another run, says of it; `run --history` fills it in from the arm's file."""

    date_utc: str = setting("", meaning="time of the last certificate, ISO 8601, UTC; empty: none")
    friction_Nm: tuple[float, ...] = setting(
        (), unit="Nm", low=-1000.0, high=1000.0, meaning="friction of joint 1 at 0.2, 0.6, 1.2 rad/s, then of joint 2"
    )
    friction_std_Nm: tuple[float, ...] = setting((), unit="Nm", low=0.0, high=1000.0, meaning="their deviations")
    inertia_kgm2: tuple[float, ...] = setting((), unit="kg m²", low=-1000.0, high=1000.0, meaning="inertias a1, a2, a3")
    inertia_std_kgm2: tuple[float, ...] = setting((), unit="kg m²", low=0.0, high=1000.0, meaning="their deviations")
    offset_Nm: tuple[float, ...] = setting(
        (), unit="Nm", low=-1000.0, high=1000.0, meaning="zero of each torque sensor, `arm.torque_offset_Nm` included"
    )
    offset_std_Nm: tuple[float, ...] = setting(
        (), unit="Nm", low=0.0, high=1000.0, meaning="their deviations, drift since the certificate included"
    )
    friction_share: float = setting(
        0.2, low=0.0, high=10.0, meaning="standard deviation of friction from run to run, as a share of it"
    )
    inertia_share: float = setting(0.02, low=0.0, high=10.0, meaning="the same of an inertia")

    def __post_init__(self) -> None:
        for name, values, count in (
            ("friction_Nm", self.friction_Nm, 3 * JOINTS),
            ("friction_std_Nm", self.friction_std_Nm, 3 * JOINTS),
            ("inertia_kgm2", self.inertia_kgm2, 3),
            ("inertia_std_kgm2", self.inertia_std_kgm2, 3),
            ("offset_Nm", self.offset_Nm, JOINTS),
            ("offset_std_Nm", self.offset_std_Nm, JOINTS),
        ):
            wanted = count if self.is_known else 0
            if len(values) != wanted:
                raise ValueError(
                    f"{name} has {len(values)} values, {wanted} expected with date_utc = {self.date_utc!r}"
                )

    @property
    def is_known(self) -> bool:
        """Whether there is a last certificate."""
        return bool(self.date_utc)
