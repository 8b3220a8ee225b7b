"""Settings of the arm, its devices and its bus: sections `arm`, `devices`, `bus`, `data` and `lockstep`.

Fields labelled `_deg` are in degrees; properties in radians beside some of them are for the code.
"""

from dataclasses import dataclass

import numpy as np

from adacd_hil.records import Vector
from adacd_hil.settings.schema import ConfigError, setting
from adacd_hil.settings.stated import ARM_PROFILES, BITRATES

UPRIGHT_DEG = 90.0
"""Tilt of a plane of motion in which all of gravity acts."""
SLIGHT_TILT_DEG = 2.0
"""Largest tilt at which the model may leave gravity out: 3.5 % of it acts, for `arm.position_torque_Nm` to cover."""


@dataclass(frozen=True)
class ArmSettings:
    """The arm as the host knows it, and properties that only the emulator uses."""

    profile: str = setting(ARM_PROFILES[0], choices=ARM_PROFILES, meaning="emulated arm that this configuration is for")
    link_length_m: tuple[float, float] = setting((0.35, 0.30), unit="m", low=0.01, high=5.0, meaning="joint to joint")
    rated_torque_Nm: tuple[float, float] = setting(
        (12.0, 6.0),
        unit="Nm",
        low=0.1,
        high=1000.0,
        meaning="rated torque of each drive at its joint: 0x6076, by gear and unit",
    )
    sign: tuple[int, int] = setting((1, 1), low=-1, high=1, meaning="+1 or -1: device direction to joint direction")
    zero_deg: tuple[float, float] = setting(
        (0.0, 0.0),
        unit="deg",
        low=-720.0,
        high=720.0,
        meaning="drive's position at q = 0, subtracted after the sign; at q2 = 0 the arm is stretched",
    )
    mounting_deg: tuple[float, float] | None = setting(
        None,
        unit="deg",
        low=-360.0,
        high=360.0,
        meaning="tilt of the plane of motion, 90: upright; q1 at which link 1 points down; absent: [90, -90]",
    )
    torque_offset_Nm: tuple[float, float] = setting(
        (0.0, 0.0), unit="Nm", low=-50.0, high=50.0, meaning="zero of each torque sensor, subtracted after the sign"
    )
    torque_offset_std_Nm: tuple[float, float] | None = setting(
        None, unit="Nm", low=1e-6, high=100.0, meaning="standard deviation of that zero; `--tare` sets it"
    )
    holding_torque_Nm: tuple[float, float] | None = setting(
        None,
        unit="Nm",
        low=0.0,
        high=1000.0,
        meaning="largest torque that brake, friction and cogging hold without power; 0: free; absent: unknown",
    )
    position_torque_Nm: float = setting(
        0.0,
        unit="Nm",
        low=0.0,
        high=10.0,
        meaning="`certified`: largest torque that depends on the arm's place, as of a cable or a tilted base; 0: none",
    )
    torque_limit_Nm: tuple[float, float] = setting(
        (12.0, 6.0), unit="Nm", low=0.0, high=1000.0, meaning="largest commanded torque"
    )
    torque_error_share: float = setting(
        0.3, low=0.01, high=10.0, meaning="largest difference of commanded and actual torque, part of rated torque"
    )
    torque_rate_limit_Nm_s: tuple[float, float] = setting(
        (2000.0, 1000.0), unit="Nm/s", low=1.0, high=1e6, meaning="largest rate of the commanded torque"
    )
    position_limit_deg: tuple[float, float] = setting(
        (75.0, 120.0), unit="deg", low=1.0, high=720.0, meaning="largest |q|; beyond it the run faults"
    )
    velocity_limit_deg_s: tuple[float, float] = setting(
        (250.0, 300.0), unit="deg/s", low=1.0, high=3600.0, meaning="largest |dq|; beyond it the run faults"
    )
    cad_theta: tuple[float, ...] = setting((), low=0.0, meaning="the CAD model's parameters; empty: no model")
    # Properties of the emulated arm of this file; the host doesn't use them.
    mass_kg: tuple[float, float] | None = setting(
        None, unit="kg", low=1e-4, high=1000.0, meaning="mass of each link, for the emulator only"
    )
    center_m: tuple[float, float] | None = setting(
        None, unit="m", low=-5.0, high=5.0, meaning="its centre from the link's joint, for the emulator; absent: middle"
    )
    inertia_kg_m2: tuple[float, float] | None = setting(
        None, unit="kg m²", low=0.0, high=1000.0, meaning="about that centre, for the emulator; absent: a rod's"
    )
    viscous_Nm_s: tuple[float, float] | None = setting(
        None, unit="Nm s/rad", low=0.0, high=1e4, meaning="viscous friction, for the emulator only"
    )
    coulomb_Nm: tuple[float, float] | None = setting(
        None, unit="Nm", low=0.0, high=1e3, meaning="Coulomb friction, for the emulator only"
    )

    def __post_init__(self) -> None:
        for key in ("center_m", "inertia_kg_m2"):
            if getattr(self, key) is not None and self.mass_kg is None:
                raise ConfigError(f"`arm.{key}` needs `arm.mass_kg` beside it")
        if any(sign == 0 for sign in self.sign):
            raise ValueError(f"sign = {self.sign} must be +1 or -1 for each joint")
        if self.mounting_deg is not None and not 0.0 <= self.mounting_deg[0] <= UPRIGHT_DEG:
            raise ConfigError(f"`arm.mounting_deg[0]` = {self.mounting_deg[0]:g} deg must be within 0 to 90 deg")

    @property
    def zero_rad(self) -> Vector:
        """Drive's position at q = 0, after the sign, rad (2,)."""
        return _radians(self.zero_deg)

    @property
    def position_limit_rad(self) -> Vector:
        """Largest |q|, rad (2,)."""
        return _radians(self.position_limit_deg)

    @property
    def velocity_limit_rad_s(self) -> Vector:
        """Largest |dq|, rad/s (2,)."""
        return _radians(self.velocity_limit_deg_s)


@dataclass(frozen=True)
class DevicesSettings:
    """Devices on the bus, by joint, and the contract that describes their frames."""

    drive: tuple[str, str] = setting(
        ("adacd-drive", "adacd-drive"), meaning="device profile: a built-in name or a file"
    )
    sensor: tuple[str, str] = setting(
        ("adacd-sensor", "adacd-sensor"), meaning="device profile: a built-in name or a file"
    )
    drive_node: tuple[int, int] = setting((1, 2), low=1, high=126, meaning="CANopen node ids")
    sensor_node: tuple[int, int] = setting((3, 4), low=1, high=126, meaning="CANopen node ids")
    contract: str = setting("arm", meaning="a DBC in dbc/ by name, or a file; empty: composed from the profiles")
    boot_timeout_s: float = setting(
        2.0, unit="s", low=0.1, high=60.0, meaning="longest wait for the nodes to boot after a reset of communication"
    )
    start: str = setting("sensors_first", choices=("sensors_first", "all"), meaning="order of the NMT start commands")
    reread_ms: int = setting(
        100, unit="ms", low=0, high=60_000, meaning="how often one object of the set-up is read again; 0: never"
    )
    quick_stop_option: int | None = setting(None, low=0, high=8, meaning="0x605A of the drives; unset: the profile's")
    fault_reaction_option: int | None = setting(
        None, low=0, high=4, meaning="0x605E of the drives; unset: the profile's"
    )
    bitrate: int = setting(
        BITRATES[1], unit="bit/s", low=BITRATES[0], high=BITRATES[1], meaning="of a composed contract"
    )
    data_bitrate: int = setting(
        5_000_000, unit="bit/s", low=0, high=8_000_000, meaning="bit rate of its CAN FD data phase; 0: classic CAN"
    )

    def __post_init__(self) -> None:
        nodes = (*self.drive_node, *self.sensor_node)
        if len(set(nodes)) != len(nodes):
            raise ValueError(f"node ids {', '.join(map(str, nodes))} of drives and sensors must differ")


def _radians(degrees: tuple[float, float]) -> Vector:
    return np.radians(np.array(degrees, dtype=np.float64))


@dataclass(frozen=True)
class BusSettings:
    """Timing on the bus, and the other hosts on it."""

    period_us: int = setting(1000, unit="µs", low=500, high=10_000, meaning="SYNC period, 0x1006")
    heartbeat_ms: int = setting(100, unit="ms", low=10, high=10_000, meaning="heartbeat period, 0x1017")
    command_patience_cycles: int = setting(
        10, low=1, high=255, meaning="SYNCs without a new command until a drive faults by itself, 0x2200"
    )
    sync_patience_periods: float = setting(
        1.5, low=1.1, high=25.5, meaning="periods without SYNC until a drive faults by itself, 0x2201 in tenths"
    )
    max_age_cycles: int = setting(3, low=1, high=100, meaning="age of the oldest usable value; older faults the run")
    feedback_timeout_ms: int = setting(
        1000, unit="ms", low=1, high=60_000, meaning="lockstep: longest wait for one cycle's feedback"
    )
    arms: int = setting(1, low=1, high=7, meaning="arms of this contract on the bus, each with its own host")
    host_node: int = setting(127, low=1, high=127, meaning="node id of this host; each host on the bus has its own")
    sync: str = setting(
        "produce", choices=("produce", "follow"), meaning="send SYNC, or begin each cycle with that of another host"
    )
    schedule: str = setting(
        "same_cycle",
        choices=("same_cycle", "pipelined"),
        meaning="commands leave when they are ready, to act at the next SYNC; or behind that one, to act one later",
    )
    sync_timeout_ms: int = setting(
        100, unit="ms", low=1, high=60_000, meaning="follow: longest wait for SYNC; the drives stop earlier"
    )

    def __post_init__(self) -> None:
        if self.follows and not self.is_shared:
            raise ConfigError("`bus.sync` = 'follow' needs another arm's host on the bus, but `bus.arms` = 1")

    @property
    def is_shared(self) -> bool:
        """Whether other hosts and their arms are on the bus."""
        return self.arms > 1

    @property
    def follows(self) -> bool:
        """Whether another host sends SYNC."""
        return self.sync == "follow"

    @property
    def is_pipelined(self) -> bool:
        """Whether the commands of a cycle leave behind the SYNC of the next."""
        return self.schedule == "pipelined"

    @property
    def period_s(self) -> float:
        """SYNC period in s."""
        return self.period_us * 1e-6

    @property
    def period_ns(self) -> int:
        """SYNC period in ns."""
        return self.period_us * 1000


DATA_WINDOW_S = 1.0
"""Shares of missing data are judged over this time."""
SHORTEST_DATA_WINDOW = 0.2
"""Smallest part of that time that is judged when the attempt ends in it."""


OLD_CYCLES = 1
"""Age up to which a value counts as fresh."""
MOST_BLIND_CYCLES = 5
"""Cycles without data in which an arm may go on: half a degree at 100 deg/s and 1 ms. On a real arm no setting allows
more; on an emulated one the gate lets the torque fade beyond, whatever `data.blind_cycles` says."""


@dataclass(frozen=True)
class DataSettings:
    """How much of the cyclic data may be missing. Shares are of the cycles of each second with enabled drives."""

    blind_cycles: int = setting(
        MOST_BLIND_CYCLES,
        low=2,
        high=1000,
        meaning="cycles in a row without a fresh sample that fault the run; at least `bus.max_age_cycles`",
    )
    incomplete_share: float = setting(
        0.1, low=0.0, high=1.0, meaning="share of cycles with a missing or late frame from which on the run warns"
    )
    no_new_data_share: float = setting(
        0.05, low=0.0, high=1.0, meaning="the same for cycles without a new frame of one device"
    )
    repeated_share: float = setting(
        0.01, low=0.0, high=1.0, meaning="the same for cycles with a repeated frame of one device"
    )


@dataclass(frozen=True)
class LockstepSettings:
    """Modelled durations of the host and the bus; lockstep only."""

    latency: str = setting(
        "constant",
        choices=("constant", "uniform", "lognormal"),
        meaning="distribution of the host's time between the last feedback and its commands",
    )
    latency_us: float = setting(
        60.0, unit="us", low=0.0, high=1e6, meaning="constant: it; uniform: the lowest; lognormal: the median"
    )
    latency_high_us: float = setting(
        200.0, unit="us", low=0.0, high=1e6, meaning="uniform: its highest; lognormal: exceeded by 1 in 1000"
    )
    stall_us: float = setting(0.0, unit="us", low=0.0, high=1e7, meaning="how much longer a stalled cycle takes")
    stall_every_s: float = setting(0.0, unit="s", low=0.0, high=1e6, meaning="mean time between stalls; 0: none")
    seed: int = setting(1, low=0, high=2**63 - 1, meaning="seed of the latency")
    stuffing: str = setting(
        "exact", choices=("exact", "worst"), meaning="length of frames: by their bits, or the longest that can be"
    )
    queue: str = setting(
        "identifier", choices=("identifier", "fifo"), meaning="which of the host's waiting frames is sent first"
    )

    def __post_init__(self) -> None:
        if self.latency != "constant" and self.latency_high_us < self.latency_us:
            raise ConfigError(
                f"`lockstep.latency_high_us` = {self.latency_high_us:g} us is below `lockstep.latency_us` = "
                f"{self.latency_us:g} us"
            )
        if self.latency == "lognormal" and self.latency_us <= 0.0:
            raise ConfigError(
                "`lockstep.latency_us` = 0 us can't be the median of a lognormal distribution; above 0 us"
            )
