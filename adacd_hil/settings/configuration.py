"""A configuration: all sections as one value."""

import math
from dataclasses import dataclass

import numpy as np

from adacd_hil.records import GRAVITY_M_S2, JOINTS, POSITION_TERMS, Vector
from adacd_hil.scheduling import RealtimeRequest
from adacd_hil.settings.arm_settings import (
    SLIGHT_TILT_DEG,
    UPRIGHT_DEG,
    ArmSettings,
    BusSettings,
    DataSettings,
    DevicesSettings,
    LockstepSettings,
)
from adacd_hil.settings.run_settings import (
    ControllerSettings,
    ExcitationSettings,
    HistorySettings,
    LogSettings,
    OperatorSettings,
    ReactionSettings,
    RealtimeSettings,
    SafetySettings,
    TareSettings,
    TrajectorySettings,
)
from adacd_hil.settings.schema import ConfigError, setting
from adacd_hil.settings.scheme_settings import (
    CROSS_TALK,
    KIND_S,
    CertifiedSettings,
    DetectorSettings,
    EstimatorSettings,
    FilterSettings,
    TerminationSettings,
)


@dataclass(frozen=True)
class Settings:
    """All settings of a run, resolved. Its log has them attached."""

    name: str = setting("", meaning="name of the configuration")
    scheme: str = setting("paper", choices=("paper", "certified"), meaning="the paper's scheme, or the one beyond it")
    arm: ArmSettings = setting(ArmSettings, meaning="the arm")
    bus: BusSettings = setting(BusSettings, meaning="timing on the bus")
    data: DataSettings = setting(DataSettings, meaning="how much of the cyclic data may be missing")
    devices: DevicesSettings = setting(DevicesSettings, meaning="drives and sensors")
    filter: FilterSettings = setting(FilterSettings, meaning="torque filter")
    estimator: EstimatorSettings = setting(EstimatorSettings, meaning="adaptation law")
    termination: TerminationSettings = setting(TerminationSettings, meaning="end of adaptation")
    detector: DetectorSettings = setting(DetectorSettings, meaning="collision detection")
    certified: CertifiedSettings = setting(CertifiedSettings, meaning="the scheme beyond the paper")
    reaction: ReactionSettings = setting(ReactionSettings, meaning="reactions to a contact")
    trajectory: TrajectorySettings = setting(TrajectorySettings, meaning="the motion")
    excitation: ExcitationSettings = setting(ExcitationSettings, meaning="the motion of the certified adaptation")
    controller: ControllerSettings = setting(ControllerSettings, meaning="joint controller")
    operator: OperatorSettings = setting(OperatorSettings, meaning="scripted user")
    lockstep: LockstepSettings = setting(LockstepSettings, meaning="modelled time of the host")
    realtime: RealtimeSettings = setting(RealtimeSettings, meaning="being on time")
    safety: SafetySettings = setting(SafetySettings, meaning="checks before torque")
    tare: TareSettings = setting(TareSettings, meaning="tare of the torque sensors")
    history: HistorySettings = setting(HistorySettings, meaning="the arm's last certificate")
    log: LogSettings = setting(LogSettings, meaning="the log")
    assumed: tuple[str, ...] = setting((), meaning="keys whose values are guesses; `doctor` asks for each of them")

    @property
    def blind_cycles(self) -> int:
        """Cycles in a row without a fresh sample that fault the run.

        The larger of `data.blind_cycles` and `bus.max_age_cycles`.
        """
        return max(self.data.blind_cycles, self.bus.max_age_cycles)

    @property
    def commission_cycles(self) -> int:
        """Cycles in a row, with complete data, that must pass the checks at rest before the drives are enabled.

        Those of `safety.commission_s`, at least one. A cycle with incomplete data that passes doesn't end the row.
        """
        return max(1, round(self.safety.commission_s / self.bus.period_s))

    @property
    def cutoff_rad_s(self) -> float:
        """Cut-off of the filter of `tau_ext_hat`, rad/s: the slowest of the certified scheme's bank, or the paper's."""
        return self.certified.cutoffs_rad_s[0] if self.scheme == "certified" else self.filter.a_rad_s

    @property
    def report_s(self) -> float:
        """Time from the detection of a contact to its final report, s."""
        return KIND_S if self.scheme == "certified" else self.detector.isolation_window_s

    @property
    def further_names(self) -> tuple[str, ...]:
        """Names of the certified scheme's parameters after the dynamic ones; () for the paper's.

        Kind by kind, a name per joint, such as "offset1", "offset2". Offsets and lags are always there; the settings
        add friction terms, cross-talk and torques by position.
        """
        if self.scheme == "paper":
            return ()
        by_place = POSITION_TERMS if self.arm.position_torque_Nm > 0.0 else ()
        between = (CROSS_TALK,) if self.certified.cross_talk_std > 0.0 else ()
        kinds = ("offset", "lag", *self.certified.friction_terms, *between, *by_place)
        return tuple(f"{kind}{joint + 1}" for kind in kinds for joint in range(JOINTS))

    @property
    def further_count(self) -> int:
        """Number of `further_names`."""
        return len(self.further_names)

    @property
    def filter_count(self) -> int:
        """Number of filters in the certified scheme's bank; 0 for the paper's scheme."""
        return len(self.certified.cutoffs_rad_s) if self.scheme == "certified" else 0

    @property
    def channel_count(self) -> int:
        """Number of channels per joint, residuals with a threshold each, in the certified scheme's bank; else 0.

        Each filter has a smoothed channel, each but the slowest also an unsmoothed one.
        """
        return max(2 * self.filter_count - 1, 0)

    @property
    def cad_theta(self) -> Vector:
        """The CAD model's parameters (p,); (0,) without CAD model."""
        return np.array(self.arm.cad_theta, dtype=np.float64)

    @property
    def mounting_deg(self) -> tuple[float, float]:
        """Tilt of the plane of motion (0: level, 90: upright), and the q1 at which link 1 hangs down; deg.

        Without `arm.mounting_deg`: (90, -90) with `estimator.gravity`, else (0, 0).
        """
        if self.arm.mounting_deg is not None:
            return self.arm.mounting_deg
        return (UPRIGHT_DEG, -90.0) if self.estimator.gravity else (0.0, 0.0)

    @property
    def tilt_rad(self) -> float:
        """Tilt of the plane of motion, rad."""
        return math.radians(self.mounting_deg[0])

    @property
    def gravity_m_s2(self) -> float:
        """Gravity in the plane of motion, m/s²; 0 if the model has no gravity."""
        return GRAVITY_M_S2 * math.sin(self.tilt_rad) if self.estimator.gravity else 0.0

    @property
    def level_rad(self) -> float:
        """The q1 at which link 1 is level and q1 grows uphill, rad; 0 if the model has no gravity."""
        return math.radians(self.mounting_deg[1] + 90.0) if self.estimator.gravity else 0.0

    @property
    def realtime_request(self) -> RealtimeRequest:
        """Real-time request of the control process to the operating system."""
        wish = self.realtime
        return RealtimeRequest(wish.scheduler, wish.priority, wish.cpu, wish.lock_memory, self.bus.period_ns)

    def __post_init__(self) -> None:
        tilt_deg, names = self.mounting_deg[0], self.estimator.parameter_names
        if self.estimator.gravity and tilt_deg == 0.0:
            raise ConfigError("`arm.mounting_deg[0]` = 0 deg: gravity does not act, but `estimator.gravity` = true")
        if tilt_deg > SLIGHT_TILT_DEG and not self.estimator.gravity:
            raise ConfigError(
                f"`arm.mounting_deg[0]` = {tilt_deg:g} deg: gravity acts on the joints; `estimator.gravity` = true "
                f"expected above {SLIGHT_TILT_DEG:g} deg"
            )
        if len(self.arm.cad_theta) not in (0, len(names)):
            gravity = " (`estimator.gravity` adds a4 and a5, Nm)" if self.estimator.gravity else ""
            raise ConfigError(
                f"`arm.cad_theta` has {len(self.arm.cad_theta)} values, {len(names)} expected: "
                f"{', '.join(names)}{gravity}; [] without CAD model"
            )
        if self.bus.host_node in (*self.devices.drive_node, *self.devices.sensor_node):
            raise ConfigError(f"`bus.host_node` = {self.bus.host_node} is the node id of a device")
