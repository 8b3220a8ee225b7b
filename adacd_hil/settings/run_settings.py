"""Settings of a run: sections `operator`, `realtime` and `log`."""

from dataclasses import dataclass

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
