"""One run from the first check to the closed log: boot the devices, compile, enable, cycle, disable."""

import json
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from threading import Timer
from typing import NamedTuple, Protocol

from adacd_hil import __version__
from adacd_hil.clock import LOCKSTEP, REALTIME, Clock, MonotonicClock, VirtualClock, wall_ns
from adacd_hil.control.cycle import Cycle, RunResult
from adacd_hil.control.cycle_compilation import compiling_cycle
from adacd_hil.control.fault_recovery import Recovery
from adacd_hil.control.operator import Operator, ScriptedOperator
from adacd_hil.control.pacing import Pacer, make_pacer, prepare_spin
from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_report import describe_checks
from adacd_hil.device.attached_devices import device_attachments
from adacd_hil.device.canopen_bus import DeviceError
from adacd_hil.device.network import Identity, Master
from adacd_hil.device.profile import PlacedDevice, enable_timeout_s
from adacd_hil.device.strangers import refuse_company
from adacd_hil.error_texts import error_text
from adacd_hil.file_access import write_new_file
from adacd_hil.log.log_files import CONFIG_NAME, DBC_NAME, LAYOUT_NAME, LOG_NAME, SCRIPTED, arithmetic
from adacd_hil.log.recording.processes import LiveService
from adacd_hil.log.recording.recorder import END_TIMEOUT_S, LogSummary, Recorder
from adacd_hil.log.types.topics import CERTIFIED_MODEL
from adacd_hil.records import Event, FaultReason, SchemeState
from adacd_hil.scheduling import RealtimeGrant, frozen_garbage, request_realtime, scheduler_name
from adacd_hil.scheme.identify.certificate import Certificate
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.toml_text import to_toml
from adacd_hil.wire.bus import Bus, BusError, Tap
from adacd_hil.wire.codec import Codec


@dataclass(frozen=True)
class SessionSummary:
    """Result of a session. `result`: of the last attempt, None if an error ended it; `error`: its line, or "".

    `has_started`: whether the devices were set to Operational, so that the arm may have moved. `reached`: cycles and
    state of the last attempt, however it ended. `recoveries`: number of acknowledged faults after which the run started
    again. `elapsed_s`: by the host's clock, from the first frame to the last, without compiling. `certificates`: those
    that were not taken back; `identities`: of the devices.
    """

    result: RunResult | None
    log: LogSummary
    grant: RealtimeGrant
    error: str
    has_started: bool
    reached: tuple[int, SchemeState]
    recoveries: int
    elapsed_s: float
    certificates: tuple[Certificate, ...]
    identities: tuple[Identity, ...]


class LiveView(Protocol):
    """Options of a live view that the user requested."""

    def server(self, settings: Settings) -> LiveService:
        """Return the service by which the log's writer opens the view. settings: of the arm that it shows."""


class ArmFile(Protocol):
    """A file about an arm that a run uses, such as a tare or a history."""

    def check_devices(self, identities: Sequence[Identity]) -> list[Event]:
        """Compare the devices found with the file's; return remarks as events. Raises DeviceError if they differ."""

    def attachments(self) -> dict[str, bytes]:
        """Return the contents that the log keeps of the file, by the attachment's name."""

    def metadata(self) -> dict[str, str]:
        """Return entries about the file for the log's metadata."""


class Attempt(NamedTuple):
    """Objects of one attempt to run the arm; a recovery makes new ones."""

    arm: Arm
    master: Master
    cycle: Cycle


class Ending(NamedTuple):
    """End of an attempt: by itself with a `result`, or by an `error`, in one line; is_bus_failed: by a BusError."""

    result: RunResult | None
    error: str
    is_bus_failed: bool

    @property
    def is_faulted(self) -> bool:
        """Return whether the attempt ended by a fault or an error, which the user may acknowledge."""
        return self.result is None or self.result.fault is not FaultReason.NONE


@dataclass
class Session:
    """One run on one bus. `clock` is a VirtualClock in lockstep and a MonotonicClock in real time.

    `out`: folder of the log. `interface`: name of the bus's kind, for the log. `metadata`: further entries of the log.
    `progress`: prints a line for the user. `files`: of the arm, checked against the devices. `viewer_files`: attached
    to the log and written beside it, by name. `live`: None for no live view. `on_started` is called when the devices
    are set to Operational for the first time. `touched_ns`: see `RunNarration`.
    """

    settings: Settings
    codec: Codec
    devices: Sequence[PlacedDevice]
    bus: Bus
    clock: Clock
    operator: Operator
    out: Path
    interface: str
    metadata: dict[str, str] = field(default_factory=dict)
    progress: Callable[[str], None] = lambda _: None
    files: Sequence[ArmFile] = ()
    viewer_files: Mapping[str, bytes] = field(default_factory=dict)
    live: LiveView | None = None
    on_started: Callable[[], None] = lambda: None
    touched_ns: Callable[[], int | None] = lambda: None
    _cycle: Cycle | None = None
    _identities: tuple[Identity, ...] = ()
    _is_interrupted: bool = False
    _has_started: bool = False

    @property
    def is_lockstep(self) -> bool:
        """Return whether the run is in lockstep, by its clock: cycles follow each other at once, not on the grid."""
        return isinstance(self.clock, VirtualClock)

    def interrupt(self) -> None:
        """Ask the run to park the arm and end; by a second call, to end at once. Safe in a signal handler."""
        self._is_interrupted = True
        if self._cycle is not None:
            self._cycle.interrupt()

    def run(self) -> SessionSummary:
        """Run until the run is finished or interrupted, or a fault is not acknowledged; return the summary.

        The summary describes an early end. The log is closed and readable in any case.

        Raises LogExistsError if there is a log already, except of a start that failed; LogError or OSError if log or
        folder can't be created; ConfigError or CodecError for settings or a contract that can't be used.
        """
        if self.is_lockstep:  # a simulated arm moves by whole periods, however late the modelled host sends SYNC
            realtime = replace(self.settings.realtime, sample_period="nominal")
            self.settings = replace(self.settings, realtime=realtime)
        safety = replace(self.settings.safety, enable_timeout_s=enable_timeout_s(self.settings, self.devices))
        self.settings = replace(self.settings, safety=safety)  # logged, so that a replay needs no profiles
        tap = Tap(self.bus, self.clock)
        pacer = make_pacer(self.settings, self.clock, tap, self.codec.message("Sync").can_id)
        with compiling_cycle(self.settings):
            attempt = self._prepare(tap, pacer)
        # After compiling: a second of work at real-time priority would be paid back by 50 ms of throttling later.
        grant = self._request_realtime()
        for line in grant.missing:
            self.progress(f"not granted: {line}")
        spin = prepare_spin(pacer, self.settings, self.clock, grant)
        recorder = self._open_log(grant, spin)
        if recorder.live_url:
            self.progress(f"live view: {recorder.live_url}, layout for it: {self.out / LAYOUT_NAME}")
        for refusal in grant.missing:
            recorder.event(self.clock.now_ns(), Event("warning", "realtime", f"not granted: {refusal}"))
        recovery = Recovery(tap, self.clock, self.operator, recorder, self.progress, lambda: self._is_interrupted)
        stopwatch = MonotonicClock()
        start_ns = stopwatch.now_ns()
        recoveries = 0
        certificates: list[Certificate] = []
        try:
            while True:
                ending = self._attempt(attempt, recorder, tap)
                certificates += attempt.cycle.certificates
                if ending.is_bus_failed:
                    recovery.empty()
                if not (self._has_started and ending.is_faulted and recovery.await_acknowledgement()):
                    break
                recoveries += 1
                unserved = attempt.cycle.unserved
                attempt = self._prepare(tap, pacer)
                attempt.cycle.carry(unserved)
        finally:
            notice = Timer(1.0, self.progress, [f"waiting for the end of the log, {END_TIMEOUT_S:g} s at most"])
            notice.start()
            log = recorder.close()
            notice.cancel()
        elapsed_s = (stopwatch.now_ns() - start_ns) * 1e-9
        return SessionSummary(
            ending.result,
            log,
            grant,
            ending.error,
            self._has_started,
            attempt.cycle.reached,
            recoveries,
            elapsed_s,
            tuple(certificates),
            self._identities,
        )

    def _request_realtime(self) -> RealtimeGrant:
        if self.is_lockstep:
            return RealtimeGrant(scheduler_name())
        return request_realtime(self.settings.realtime_request)

    def _prepare(self, tap: Tap, pacer: Pacer) -> Attempt:
        """Make and compile the objects of a new attempt, and return them.

        If the run has been interrupted already, interrupt the new cycle, too.
        """
        arm = Arm(self.settings, self.codec, self.devices, tap)
        master = Master(self.settings, self.codec, self.devices, tap, watch_host=not self.is_lockstep)
        cycle = Cycle(self.settings, tap, arm, master, pacer, self.operator, self.progress, self.clock, self.touched_ns)
        cycle.compile()
        self._cycle = cycle
        if self._is_interrupted:
            cycle.interrupt()
        return Attempt(arm, master, cycle)

    def _attempt(self, attempt: Attempt, recorder: Recorder, tap: Tap) -> Ending:
        """Boot the devices, run until the run is finished, interrupted or faulted, and return how the attempt ended.

        In real time first refuse a bus on which another host runs the arm. Log and print an error of bus or devices
        instead of raising it. At the end log the counts of the frame checks, and each certificate.
        """
        arm, master, cycle = attempt
        try:
            self.progress(f"looking for the arm on {tap.channel}")
            if not self.is_lockstep:
                refuse_company(tap, self.clock, self.settings, self.codec, self.devices)
            self._boot(master, recorder, tap)
            self.progress("running")
            ending = Ending(self._run(cycle, master, recorder, tap), "", is_bus_failed=False)
        except (BusError, DeviceError) as reason:
            line = reason.line if isinstance(reason, DeviceError) else str(reason)
            ending = Ending(None, line, isinstance(reason, BusError))
            recorder.cycle(self.clock.now_ns(), [], tap.take_passed())
            recorder.event(self.clock.now_ns(), Event("error", "run", ending.error))
            self.progress(ending.error)
        for line in (*describe_checks(arm), *master.describe_checks()):
            recorder.event(self.clock.now_ns(), Event("info", "frame checks", line))
        for certificate in cycle.certificates:  # as numbers, to compare runs
            recorder.event(self.clock.now_ns(), Event("info", CERTIFIED_MODEL, json.dumps(certificate._asdict())))
        return ending

    def _boot(self, master: Master, recorder: Recorder, tap: Tap) -> None:
        """Reset and identify the devices, compare them with `files`, configure them; log their identities and remarks.

        Raises DeviceError if one doesn't answer, is another device than configured or in a file, or refuses a value;
        BusError if sending or receiving fails.
        """
        master.reset()
        self._identities = identities = tuple(master.identify())
        for identity in identities:
            recorder.event(self.clock.now_ns(), Event("info", identity.name, _describe(identity)))
        for file in self.files:
            for event in file.check_devices(identities):
                recorder.event(self.clock.now_ns(), event)
        master.configure()
        recorder.cycle(self.clock.now_ns(), [], tap.take_passed())

    def _run(self, cycle: Cycle, master: Master, recorder: Recorder, tap: Tap) -> RunResult:
        """Set the devices to Operational, run the cycles, set them to Pre-operational in any case; return the result.

        Before they become Operational for the first time, call `on_started`. Raises BusError if sending or receiving
        fails, in lockstep if no device answers.
        """
        if not self._has_started:
            self._has_started = True
            self.on_started()
        with frozen_garbage():
            try:
                master.start()
                return cycle.run(recorder)
            finally:
                self._stop(master, recorder, tap)

    def _stop(self, master: Master, recorder: Recorder, tap: Tap) -> None:
        """Set the devices to Pre-operational, and log the frames until then; log a BusError instead of raising it."""
        try:
            master.stop()
        except BusError as error:
            recorder.event(self.clock.now_ns(), Event("error", "run", f"devices were not stopped: {error}"))
        recorder.cycle(self.clock.now_ns(), [], tap.take_passed())

    def _open_log(self, grant: RealtimeGrant, spin: dict[str, str]) -> Recorder:
        """Create the log with its attachments and metadata, and the files beside it; return its recorder.

        spin: entries for the metadata. A log of a start that failed is renamed. Raises LogExistsError if there is
        another log already, LogError if it can't be created, OSError if the folder can't.
        """
        self.out.mkdir(parents=True, exist_ok=True)
        is_lockstep = self.is_lockstep
        attachments = device_attachments(self.devices)
        attachments[DBC_NAME] = self.codec.text
        attachments[CONFIG_NAME] = to_toml(self.settings).encode()
        for file in self.files:
            attachments |= file.attachments()
        attachments |= self.viewer_files
        with grant.unpinned():
            recorder = Recorder(
                self.out / LOG_NAME,
                messages=self.codec.messages.values(),
                parameter_count=len(self.settings.estimator.parameter_names),
                further_count=self.settings.further_count,
                channel_count=self.settings.channel_count,
                attachments=attachments,
                metadata={**self._metadata(grant), **spin},
                epoch_ns=0 if is_lockstep else wall_ns() - MonotonicClock().now_ns(),
                blocking=is_lockstep,
                settings=self.settings.log,
                live=None if self.live is None else self.live.server(self.settings),
            )
        self._write_beside(recorder)
        return recorder

    def _write_beside(self, recorder: Recorder) -> None:
        """Write the viewers' files, and a contract without a file, beside the log, which contains them, too.

        A file that can't be written is printed, logged and left out.
        """
        writes: list[Callable[[], object]] = [
            partial(write_new_file, self.out / name, content) for name, content in self.viewer_files.items()
        ]
        writes.append(partial(write_contract, self.codec, self.out))
        for write in writes:
            try:
                write()
            except OSError as error:
                text = f"beside the log: {error_text(error)}"
                self.progress(text)
                recorder.event(self.clock.now_ns(), Event("warning", "log", text))

    def _metadata(self, grant: RealtimeGrant) -> dict[str, str]:
        settings = self.settings
        return {
            "version": __version__,
            "git": git_commit(),
            "config": settings.name,
            "profile": settings.arm.profile,
            "wire_version": str(self.codec.wire_version),
            "layout_digest": f"0x{self.codec.layout_digest:08X}",
            "interface": self.interface,
            "channel": self.bus.channel,
            "clock": LOCKSTEP if self.is_lockstep else REALTIME,
            **grant.describe(),
            "period_us": str(settings.bus.period_us),
            "operator": SCRIPTED if isinstance(self.operator, ScriptedOperator) else "console",
            **arithmetic(),
            **{key: value for file in self.files for key, value in file.metadata().items()},
            **self.metadata,
        }


def _describe(identity: Identity) -> str:
    return (
        f"node {identity.node_id}: vendor 0x{identity.vendor:X}, product 0x{identity.product:X}, "
        f"revision 0x{identity.revision:X}, serial {identity.serial}"
    )


def write_contract(codec: Codec, folder: Path) -> Path:
    """Return the file of the contract; write a composed or moved contract, which has no file, to `folder`.

    Raises OSError, also when another file of that name is there.
    """
    if codec.path.is_file() and codec.path.read_bytes() == codec.text:
        return codec.path
    path = folder / codec.path.name
    write_new_file(path, codec.text)
    return path


def git_commit() -> str:
    """Return the commit of the source tree as `git describe` names it, `-dirty` for changed files; "" without one."""
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
