"""Settings of a run: operator, real time, log, motion, reactions, safety, tare, history."""

from dataclasses import dataclass

from adacd_hil.records import FRICTION_SPEEDS_RAD_S, JOINTS, Reaction
from adacd_hil.scheduling import ANY_CPU, ISOLATED_CPU
from adacd_hil.settings.schema import ConfigError, setting


@dataclass(frozen=True)
class RequestSettings:
    """One entry of the operator's script."""

    at_s: float = setting(unit="s", low=0.0, high=1e6, meaning="time of the request, since the drives were enabled")
    request: str = setting(choices=("payload", "payload_changed", "finish"), meaning="request of the user")


@dataclass(frozen=True)
class OperatorSettings:
    """The user's role: requests by script, automatic acknowledgement."""

    script: tuple[RequestSettings, ...] = setting((), meaning="the user's requests, by time")
    acknowledge_after_s: float = setting(
        0.0, unit="s", low=0.0, high=3600.0, meaning="acknowledge a stop by itself after this time; 0: never"
    )
    acknowledge_faults: int = setting(0, low=0, high=1000, meaning="faults acknowledged without the user")
    acknowledge_fault_after_s: float = setting(
        1.0, unit="s", low=0.0, high=3600.0, meaning="time after which such a fault is acknowledged"
    )
    acknowledge_on_hardware: bool = setting(
        False, meaning="allow automatic acknowledgement where a real arm may be on the bus"
    )

    @property
    def acknowledges(self) -> bool:
        """Whether stops or faults are acknowledged automatically."""
        return self.acknowledge_after_s > 0.0 or self.acknowledge_faults > 0


@dataclass(frozen=True)
class RealtimeSettings:
    """Real-time scheduling of the control process, and its behaviour when cycles are late."""

    scheduler: str = setting(
        "fifo", choices=("fifo", "deadline", "other"), meaning="SCHED_FIFO, SCHED_DEADLINE, or none of real time"
    )
    priority: int = setting(80, low=1, high=98, meaning="of SCHED_FIFO; threaded interrupts have 50, the kernel 99")
    cpu: str = setting(
        ANY_CPU, meaning="processor of the control process: its number, 'isolated' (the first isolated one) or 'any'"
    )
    lock_memory: bool = setting(True, meaning="lock all memory, with a reserve")
    spin_us: float = setting(
        -1.0,
        unit="µs",
        low=-1.0,
        high=1000.0,
        meaning="time before SYNC in which the process reads the clock instead of sleeping; -1: measured",
    )
    sample_period: str = setting(
        "measured",
        choices=("measured", "nominal"),
        meaning="interval that the scheme integrates over: between SYNCs, or `bus.period_us` as for a simulated arm "
        "that moves by whole periods; lockstep is nominal",
    )
    misses: int = setting(10, low=1, high=1_000_000, meaning="skipped periods within the window that are too many")
    misses_window_s: float = setting(1.0, unit="s", low=0.01, high=60.0, meaning="window in which they are counted")
    on_misses: str = setting(
        "stop", choices=("stop", "hold"), meaning="FAULT; or, while detection is on, brake and hold until acknowledged"
    )

    def __post_init__(self) -> None:
        if self.cpu not in (ANY_CPU, ISOLATED_CPU) and not self.cpu.isdecimal():
            raise ConfigError(f"`realtime.cpu` = {self.cpu!r} must be a processor's number, 'isolated' or 'any'")
        if self.scheduler == "deadline" and self.cpu != ANY_CPU:
            raise ConfigError(
                f"`realtime.cpu` = {self.cpu!r} can't be had with `realtime.scheduler` = 'deadline', which the kernel "
                "refuses to a process that is pinned; start it in an exclusive cpuset instead"
            )


@dataclass(frozen=True)
class LogSettings:
    """The log: memory for its writer, and the length of its parts."""

    buffer_MiB: int = setting(
        4, unit="MiB", low=1, high=256, meaning="memory between control process and writer; 3 s of `certified` at 1 kHz"
    )
    part_MiB: int = setting(
        512, unit="MiB", low=0, high=1_000_000, meaning="largest part, before compression; 0: any size"
    )
    part_min: float = setting(30.0, unit="min", low=0.0, high=1e6, meaning="longest part, log time; 0: any length")


REACTIONS = tuple(reaction.name.lower() for reaction in Reaction)
"""Names of the reactions to a contact, as in a configuration."""


@dataclass(frozen=True)
class TrajectorySettings:
    """Quintic motion between two corners."""

    amplitude_deg: tuple[float, float] = setting((30.0, 60.0), unit="deg", low=0.0, high=180.0, meaning="± per joint")
    half_period_s: tuple[float, float] = setting(
        (1.125, 4.5), unit="s", low=0.1, high=60.0, meaning="as printed (1.125, 4.5); synchronous (2.25, 2.25)"
    )
    approach_deg_s: float = setting(90.0, unit="deg/s", low=1.0, high=360.0, meaning="peak speed to the start corner")


@dataclass(frozen=True)
class ExcitationSettings:
    """The motion of the certified scheme's adaptation: periodic, from the trajectory's start corner at rest.

    In amplitudes of the trajectory, q_d = -1 + sum_n cosine_n (cos(n w t) - 1) + sine_n sin(n w t), w = 2 pi / period.
    """

    period_s: float = setting(0.0, unit="s", low=0.0, high=600.0, meaning="its period; 0: adapt on the trajectory")
    cosine: tuple[tuple[float, ...], tuple[float, ...]] = setting(
        ((), ()), low=-2.0, high=2.0, meaning="multiples of `trajectory.amplitude_deg`, by joint and harmonic"
    )
    sine: tuple[tuple[float, ...], tuple[float, ...]] = setting(
        ((), ()), low=-2.0, high=2.0, meaning="multiples of `trajectory.amplitude_deg`, by joint and harmonic"
    )

    def __post_init__(self) -> None:
        counts = [len(values) for values in (*self.cosine, *self.sine)]
        if len(set(counts)) > 1:
            raise ConfigError(
                f"`excitation.cosine` has {counts[:JOINTS]} values by joint, `excitation.sine` {counts[JOINTS:]}; "
                "the same number of all expected"
            )
        for joint in range(JOINTS):
            cosine, sine = self.cosine[joint], self.sine[joint]
            velocity = sum((n + 1) * value for n, value in enumerate(sine))
            acceleration = sum((n + 1) ** 2 * value for n, value in enumerate(cosine))
            if abs(velocity) > 1e-3 or abs(acceleration) > 1e-3:
                raise ConfigError(
                    f"excitation of joint {joint + 1} does not begin at rest: the sum of n sine_n = {velocity:.3g}, "
                    f"of n² cosine_n = {acceleration:.3g}, each within 0.001"
                )


@dataclass(frozen=True)
class ControllerSettings:
    """Joint PD plus identified feedforward."""

    Kp: tuple[float, float] = setting((250.0, 20.0), unit="Nm/rad", low=0.0, high=1e5, meaning="position gain")
    Kd: tuple[float, float] = setting((12.5, 0.75), unit="Nm s/rad", low=0.0, high=1e4, meaning="velocity gain")
    following_window_deg: tuple[float, float] = setting(
        (20.0, 30.0), unit="deg", low=0.1, high=360.0, meaning="largest |q - q_d| of an arm without contact"
    )
    following_timeout_s: float = setting(
        0.1, unit="s", low=0.001, high=60.0, meaning="time beyond that window after which the run faults"
    )
    feedforward: bool = setting(True, meaning="feed the identified model forward once it is valid")


@dataclass(frozen=True)
class ReactionSettings:
    """Reaction to a contact, by its level and link. Pairs of numbers are by joint."""

    distance_deg: tuple[float, float] = setting((8.0, 8.0), unit="deg", low=0.0, high=90.0, meaning="how far back")
    velocity_limit_deg_s: tuple[float, float] = setting(
        (100.0, 120.0), unit="deg/s", low=1.0, high=720.0, meaning="largest desired speed while withdrawing"
    )
    acceleration_limit_deg_s2: tuple[float, float] = setting(
        (700.0, 900.0), unit="deg/s²", low=10.0, high=20_000.0, meaning="largest desired acceleration"
    )
    position_margin_deg: float = setting(
        3.0, unit="deg", low=0.0, high=90.0, meaning="how far the withdrawal stays from the position limits"
    )
    clear_s: float = setting(
        0.5, unit="s", low=0.0, high=60.0, meaning="time without a push after which the arm resumes after a contact"
    )
    patience_s: float = setting(
        10.0, unit="s", low=0.1, high=3600.0, meaning="a contact that lasts longer must be acknowledged"
    )
    contact: tuple[str, str] = setting(
        ("stop", "stop"), choices=REACTIONS, meaning="to a contact of link 1, of link 2; `paper` knows collisions only"
    )
    collision: tuple[str, str] = setting(
        ("withdraw", "withdraw"), choices=REACTIONS, meaning="reaction to a collision of link 1, of link 2"
    )
    start: str = setting(
        "desired",
        choices=("desired", "measured"),
        meaning="stop, withdraw: from where the arm was to be, or also from where a blow has thrown it",
    )
    rebound_s: float = setting(
        0.0, unit="s", low=0.0, high=1.0, meaning="how long a blow may throw the arm faster than its velocity limit"
    )
    two_sided: str = setting(
        "float", choices=("stop", "float"), meaning="reaction to a push from the other side, as in a clamp"
    )
    damping_Nm_s: tuple[float, float] = setting(
        (1.0, 0.4), unit="Nm s/rad", low=0.0, high=100.0, meaning="float: damping of each joint"
    )
    friction_share: float = setting(
        0.7, low=0.0, high=1.0, meaning="float: share of the identified friction that is compensated"
    )
    mass_kg_m2: tuple[float, float] = setting(
        (0.15, 0.06), unit="kg m²", low=1e-3, high=100.0, meaning="admittance: virtual inertia of each joint"
    )
    drag_Nm_s: tuple[float, float] = setting(
        (3.0, 1.2), unit="Nm s/rad", low=1e-3, high=1000.0, meaning="admittance: virtual damping of each joint"
    )
    deadband_Nm: tuple[float, float] = setting(
        (0.2, 0.1), unit="Nm", low=0.0, high=100.0, meaning="admittance: dead band of the external torque"
    )
    yield_limit_deg_s: tuple[float, float] = setting(
        (60.0, 90.0), unit="deg/s", low=1.0, high=360.0, meaning="float, admittance: speed that a push may give a joint"
    )
    slow_share: float = setting(0.2, low=0.0, high=1.0, meaning="slow_down: share of the speed that is kept")


@dataclass(frozen=True)
class SafetySettings:
    """Checks before torque and in the first motion, and the EMCY codes that a run tolerates."""

    commission_s: float = setting(
        0.2, unit="s", low=0.01, high=100.0, meaning="time at rest with complete data before the drives are enabled"
    )
    rest_velocity_rad_s: float = setting(0.05, unit="rad/s", low=1e-4, high=1.0, meaning="|dq| that counts as at rest")
    rest_torque_Nm: float = setting(1.0, unit="Nm", low=0.01, high=100.0, meaning="largest |tau_J| before enabling")
    first_motion_error: float = setting(
        0.3,
        low=0.0,
        high=0.9,
        meaning="first motion: share by which sensed and commanded torque, or position and velocity, may differ before "
        "the run faults; 0: not compared",
    )
    phase_timeout_s: float = setting(5.0, unit="s", low=0.1, high=600.0, meaning="longest COMMISSION and ENABLE")
    enable_timeout_s: float | None = setting(
        None,
        unit="s",
        low=0.1,
        high=600.0,
        meaning="longest ENABLE; absent: phase_timeout_s, or the drives' profiles' time if longer",
    )
    tolerated_emergencies: tuple[int, ...] = setting(
        (0x8200, 0x8210, 0x8240),
        low=0x0100,
        high=0xFFFF,
        meaning="EMCY error codes that don't stop the arm; any other does at once; default: one odd SYNC, a PDO "
        "or a SYNC of the wrong length",
    )

    def __post_init__(self) -> None:
        if self.phase_timeout_s <= self.commission_s:
            raise ConfigError(
                f"`safety.phase_timeout_s` = {self.phase_timeout_s:g} s must be longer than `safety.commission_s` = "
                f"{self.commission_s:g} s, else COMMISSION never ends well"
            )


@dataclass(frozen=True)
class TareSettings:
    """Tare of the joint torque sensors: poses, durations, limits of spread and drift, age.

    The bound on drift is a small part of the detection threshold (0.15 Nm): an offset that is wrong by the threshold
    reads as a contact. Bounds on single samples are larger: the offset is the mean of many.
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
        """Return the variance of a sensor's zero, Nm², `age_s` after its measurement, by time and temperature."""
        return (self.drift_Nm_K * self.temperature_K) ** 2 + self.drift_Nm_sqrt_s**2 * age_s


HISTORY_LARGEST = 1000.0
"""Bound of each of its values, Nm or kg m²."""
_FRICTION_AT = f"joint 1 at {', '.join(f'{speed:g}' for speed in FRICTION_SPEEDS_RAD_S)} rad/s, then of joint 2"


@dataclass(frozen=True)
class HistorySettings:
    """The arm's last certificate, of an earlier run; `run --history` reads it from the arm's file."""

    date_utc: str = setting("", meaning="time of the last certificate, ISO 8601, UTC; empty: none")
    friction_Nm: tuple[float, ...] = setting(
        (), unit="Nm", low=-HISTORY_LARGEST, high=HISTORY_LARGEST, meaning=f"friction of {_FRICTION_AT}"
    )
    friction_std_Nm: tuple[float, ...] = setting(
        (), unit="Nm", low=0.0, high=HISTORY_LARGEST, meaning="their deviations"
    )
    inertia_kgm2: tuple[float, ...] = setting(
        (), unit="kg m²", low=-HISTORY_LARGEST, high=HISTORY_LARGEST, meaning="inertias a1, a2, a3"
    )
    inertia_std_kgm2: tuple[float, ...] = setting(
        (), unit="kg m²", low=0.0, high=HISTORY_LARGEST, meaning="their deviations"
    )
    offset_Nm: tuple[float, ...] = setting(
        (),
        unit="Nm",
        low=-HISTORY_LARGEST,
        high=HISTORY_LARGEST,
        meaning="zero of each torque sensor, `arm.torque_offset_Nm` included",
    )
    offset_std_Nm: tuple[float, ...] = setting(
        (), unit="Nm", low=0.0, high=HISTORY_LARGEST, meaning="their deviations, drift since the certificate included"
    )
    friction_share: float = setting(
        0.2, low=0.0, high=10.0, meaning="standard deviation of friction from run to run, as a share of it"
    )
    inertia_share: float = setting(0.02, low=0.0, high=10.0, meaning="the same of an inertia")

    def __post_init__(self) -> None:
        frictions = len(FRICTION_SPEEDS_RAD_S) * JOINTS
        for name, count in (
            ("friction_Nm", frictions),
            ("friction_std_Nm", frictions),
            ("inertia_kgm2", 3),
            ("inertia_std_kgm2", 3),
            ("offset_Nm", JOINTS),
            ("offset_std_Nm", JOINTS),
        ):
            found, wanted = len(getattr(self, name)), count if self.is_known else 0
            if found != wanted:
                raise ValueError(f"{name} has {found} values, {wanted} expected with date_utc = {self.date_utc!r}")

    @property
    def is_known(self) -> bool:
        """Whether a last certificate is given: its date isn't empty."""
        return bool(self.date_utc)
