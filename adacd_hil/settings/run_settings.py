"""Settings of a run: `operator`, `realtime`, `log`, `trajectory`, `excitation`, `controller` and `reaction`."""

from dataclasses import dataclass

from adacd_hil.records import JOINTS, Reaction
from adacd_hil.scheduling import ANY_CPU, ISOLATED_CPU
from adacd_hil.settings.schema import ConfigError, setting


@dataclass(frozen=True)
class RequestSettings:
    """One entry of the operator's script."""

    at_s: float = setting(unit="s", low=0.0, high=1e6, meaning="time of the request, since the drives were enabled")
    request: str = setting(choices=("payload", "payload_changed", "finish"), meaning="request of the user")


@dataclass(frozen=True)
class OperatorSettings:
    """The user, where a script plays the user."""

    script: tuple[RequestSettings, ...] = setting((), meaning="the user's requests, by time")
    acknowledge_after_s: float = setting(
        0.0, unit="s", low=0.0, high=3600.0, meaning="acknowledge a stop by itself after this time; 0: never"
    )
    acknowledge_faults: int = setting(0, low=0, high=1000, meaning="faults acknowledged without the user")
    acknowledge_fault_after_s: float = setting(
        1.0, unit="s", low=0.0, high=3600.0, meaning="time after which such a fault is acknowledged"
    )
    acknowledge_on_hardware: bool = setting(
        False, meaning="allow acknowledgement without the user where a real arm may be on the bus"
    )

    @property
    def acknowledges(self) -> bool:
        """Whether stops or faults are acknowledged by themselves."""
        return self.acknowledge_after_s > 0.0 or self.acknowledge_faults > 0


@dataclass(frozen=True)
class RealtimeSettings:
    """How the process that runs the cycle gets on time, and what is done when it doesn't."""

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
    """The log: what may wait for its writer, and when a part of it ends and the next one begins."""

    buffer_MiB: int = setting(
        4, unit="MiB", low=1, high=256, meaning="memory between control process and writer; 6 s of cycles at 1 kHz"
    )
    part_MiB: int = setting(
        512, unit="MiB", low=0, high=1_000_000, meaning="largest part, before compression; 0: any size"
    )
    part_min: float = setting(30.0, unit="min", low=0.0, high=1e6, meaning="longest part, log time; 0: any length")


REACTIONS = tuple(reaction.name.lower() for reaction in Reaction)
"""What can be done about a contact, as a configuration says it."""


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
        ((), ()), low=-2.0, high=2.0, meaning="amplitudes by joint and harmonic, rad"
    )
    sine: tuple[tuple[float, ...], tuple[float, ...]] = setting(
        ((), ()), low=-2.0, high=2.0, meaning="amplitudes by joint and harmonic, rad"
    )

    def __post_init__(self) -> None:
        for joint in range(JOINTS):
            cosine, sine = self.cosine[joint], self.sine[joint]
            if len(cosine) != len(sine):
                raise ConfigError(
                    f"joint {joint + 1} has {len(cosine)} values in `excitation.cosine`, "
                    f"{len(sine)} in `excitation.sine`"
                )
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
        (20.0, 30.0), unit="deg", low=0.1, high=360.0, meaning="largest |q - q_d| of an arm that nobody touches"
    )
    following_timeout_s: float = setting(
        0.1, unit="s", low=0.001, high=60.0, meaning="time beyond that window after which the run faults"
    )
    feedforward: bool = setting(True, meaning="feed the identified model forward once it is valid")


@dataclass(frozen=True)
class ReactionSettings:
    """What is done about a contact, by its level and link. Link 1's joint is joint 1; pairs of numbers are joints."""

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
        0.5, unit="s", low=0.0, high=60.0, meaning="time without a push after which the arm goes on from a contact"
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
        (0.2, 0.1), unit="Nm", low=0.0, high=100.0, meaning="admittance: external torque that moves nothing"
    )
    yield_limit_deg_s: tuple[float, float] = setting(
        (60.0, 90.0), unit="deg/s", low=1.0, high=360.0, meaning="float, admittance: speed that a push may give a joint"
    )
    slow_share: float = setting(0.2, low=0.0, high=1.0, meaning="slow_down: share of the speed that is kept")
