"""Settings of the bus and its time: sections `bus`, `data` and `lockstep`."""

from dataclasses import dataclass

from adacd_hil.settings.schema import ConfigError, setting


@dataclass(frozen=True)
class BusSettings:
    """Timing on the bus, and who else is on it."""

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


@dataclass(frozen=True)
class DataSettings:
    """How much of the cyclic data may be missing. Shares are of the cycles of any second with enabled drives."""

    blind_cycles: int = setting(
        5,
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
    """What stands for the time that passes by itself on an arm; lockstep only."""

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
