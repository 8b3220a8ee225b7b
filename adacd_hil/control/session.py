"""One run from the first check to the closed log: boot the devices, compile, enable, cycle, disable."""

import platform
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from adacd_hil import __version__
from adacd_hil.clock import Clock, MonotonicClock, VirtualClock, wall_ns
from adacd_hil.config import Settings, to_toml
from adacd_hil.control.cycle import Cycle, RunResult, SilenceError
from adacd_hil.control.operator import Operator
from adacd_hil.control.realtime import GridPacer, LockstepPacer, Pacer
from adacd_hil.device.arm import Arm
from adacd_hil.device.canopen_bus import DeviceError
from adacd_hil.device.network import Identity, Master
from adacd_hil.log.recorder import LogSummary, Recorder
from adacd_hil.records import Event
from adacd_hil.scheduling import RealtimeGrant, freeze_garbage, request_realtime, scheduler_name
from adacd_hil.wire.bus import Bus, BusError
from adacd_hil.wire.codec import Codec, contract_folder
from adacd_hil.wire.tap import Tap

LOG_NAME = "run.mcap"


@dataclass(frozen=True)
class SessionSummary:
    """How a session ended. `error`: empty, or the one line that ended the run early.

    `has_started`: whether the devices had been put into operation, so that the arm may have moved. `elapsed_s`: by
    the host's clock, from the first frame to the last, without compiling.
    """

    result: RunResult | None
    log: LogSummary
    grant: RealtimeGrant
    error: str
    has_started: bool
    elapsed_s: float


@dataclass
class Session:
    """One run on one bus. `clock` is a VirtualClock in lockstep and a MonotonicClock in real time."""

    settings: Settings
    codec: Codec
    bus: Bus
    clock: Clock
    operator: Operator
    out: Path
    interface: str
    metadata: dict[str, str] = field(default_factory=dict)
    progress: Callable[[str], None] = lambda _: None
    _cycle: Cycle | None = None
    _is_interrupted: bool = False
    _has_started: bool = False

    @property
    def is_lockstep(self) -> bool:
        """Whether cycles follow each other at once instead of on the grid."""
        return isinstance(self.clock, VirtualClock)

    def interrupt(self) -> None:
        """Ask the run to park the arm and end; a second time, to stop at once. Safe in a signal handler."""
        self._is_interrupted = True
        if self._cycle is not None:
            self._cycle.interrupt()

    def run(self) -> SessionSummary:
        """Run to the end. What ends the run early is in the summary; the log is closed and readable in any case.

        Raises LogError when the log can't be created.
        """
        tap = Tap(self.bus, self.clock)
        arm = Arm(self.settings, self.codec, tap)
        master = Master(self.settings, self.codec, tap, watch_host=not self.is_lockstep)
        cycle = Cycle(self.settings, tap, arm, master, self._pacer(), self.operator, self.progress, self.is_lockstep)
        self._cycle = cycle
        if self._is_interrupted:
            cycle.interrupt()
        self.progress("compiling")
        cycle.compile()
        # After compiling: a second of work at real-time priority would be paid back by 50 ms of throttling later.
        grant = RealtimeGrant(scheduler_name(), ()) if self.is_lockstep else request_realtime()
        for line in grant.missing:
            self.progress(f"not granted: {line}")
        recorder = self._open_log(grant)
        result, error = None, ""
        stopwatch = MonotonicClock()
        start_ns = stopwatch.now_ns()
        try:
            self.progress(f"looking for the arm on {tap.channel}")
            self._boot(master, recorder, tap)
            self.progress("running")
            result = self._run(cycle, master, recorder, tap)
            for line in arm.describe_checks():
                recorder.event(self.clock.now_ns(), Event("info", "frame checks", line))
        except (BusError, DeviceError, SilenceError) as reason:
            error = str(reason)
            recorder.cycle(self.clock.now_ns(), [], tap.take())
            recorder.event(self.clock.now_ns(), Event("error", "run", error))
        finally:
            log = recorder.close()
        elapsed_s = (stopwatch.now_ns() - start_ns) * 1e-9
        return SessionSummary(result, log, grant, error, self._has_started, elapsed_s)

    def _boot(self, master: Master, recorder: Recorder, tap: Tap) -> None:
        """Bring the devices from whatever they were in to pre-operational and configured. Raises DeviceError."""
        master.reset()
        for identity in master.identify():
            recorder.event(self.clock.now_ns(), Event("info", identity.name, _describe(identity)))
        master.configure()
        recorder.cycle(self.clock.now_ns(), [], tap.take())

    def _run(self, cycle: Cycle, master: Master, recorder: Recorder, tap: Tap) -> RunResult:
        if not self.is_lockstep:
            freeze_garbage()
        self._has_started = True
        try:
            master.start()
            return cycle.run(recorder)
        finally:
            self._stop(master, recorder, tap)

    def _stop(self, master: Master, recorder: Recorder, tap: Tap) -> None:
        """Take the devices out of operation, as far as the bus still carries it."""
        try:
            master.stop()
        except BusError as error:
            recorder.event(self.clock.now_ns(), Event("error", "run", f"devices were not stopped: {error}"))
        recorder.cycle(self.clock.now_ns(), [], tap.take())

    def _pacer(self) -> Pacer:
        if isinstance(self.clock, VirtualClock):
            return LockstepPacer(self.clock, self.settings.bus.period_ns)
        return GridPacer(self.clock, self.settings.bus.period_ns)

    def _open_log(self, grant: RealtimeGrant) -> Recorder:
        self.out.mkdir(parents=True, exist_ok=True)
        is_lockstep = self.is_lockstep
        attachments = {path.name: path.read_bytes() for path in sorted(contract_folder().glob("*.eds"))}
        attachments["arm.dbc"] = self.codec.text
        attachments["config.toml"] = to_toml(self.settings).encode()
        return Recorder(
            self.out / LOG_NAME,
            codec_path=self.codec.path,
            parameter_count=len(self.settings.estimator.parameter_names),
            attachments=attachments,
            metadata=self._metadata(grant),
            epoch_ns=0 if is_lockstep else wall_ns() - MonotonicClock().now_ns(),
            blocking=is_lockstep,
        )

    def _metadata(self, grant: RealtimeGrant) -> dict[str, str]:
        settings = self.settings
        return {
            "version": __version__,
            "git": _git_commit(),
            "config": settings.name,
            "profile": settings.arm.profile,
            "wire_version": str(self.codec.wire_version),
            "layout_digest": f"0x{self.codec.layout_digest:08X}",
            "interface": self.interface,
            "channel": self.bus.channel,
            "clock": "lockstep" if self.is_lockstep else "realtime",
            "scheduler": grant.scheduler,
            "period_us": str(settings.bus.period_us),
            "python": platform.python_version(),
            "machine": f"{platform.system()} {platform.release()} {platform.machine()}",
            **self.metadata,
        }


def _describe(identity: Identity) -> str:
    return (
        f"node {identity.node_id}: vendor 0x{identity.vendor:X}, product 0x{identity.product:X}, "
        f"revision 0x{identity.revision:X}, serial {identity.serial}"
    )


def _git_commit() -> str:
    """Name the commit of the source tree, empty when installed without one."""
    try:
        done = subprocess.run(
            ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"],
            capture_output=True,
            text=True,
            timeout=5.0,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip()
