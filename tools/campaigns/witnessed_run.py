"""Plays host and emulated arm in one process in lockstep, and keeps what a judge from outside needs.

The wire at the host's end, what was true at each SYNC, the log's decisions, and what the user asked when. Nothing of it
passes through the host's own decoder.
"""

import contextlib
import dataclasses
import signal
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

import numpy as np
from numpy.typing import NDArray
from wire_record import OverdueError, WireRecord, WitnessBus

from adacd_hil.cli.connection import model_time
from adacd_hil.clock import VirtualClock
from adacd_hil.control.operator import FaultAnswer, Operator, ScriptedOperator
from adacd_hil.control.session import Session, SessionSummary
from adacd_hil.device.contract import load_contract
from adacd_hil.device.device_files import place_devices
from adacd_hil.log.log_files import LOG_NAME
from adacd_hil.log.reader import RunLog, read_log
from adacd_hil.log.types.topics import CONTACT, CONTROL, CYCLE, EVENTS, SCHEME
from adacd_hil.log.types.truth_topic import TRUTH_LAYOUT
from adacd_hil.records import Request, SchemeState
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.embedded_bus import EmbeddedBus
from firmware_sim.bench.bench import Bench
from firmware_sim.scenario.scenario import Scenario

START_ALLOWED_S = 40.0
"""Longest from the beginning of an attempt until it moves or has failed: boot, commissioning, enabling."""
END_ALLOWED_S = 20.0
"""Longest from the request to finish to the end of the run: a withdrawal, a contact that clears, parking, disabling."""
HANG_S = 900
"""Longest by the wall clock until a run is called hung; the slowest takes some 2 minutes on a busy machine."""


@dataclass(frozen=True)
class User:
    """What the user does besides the script. Times since the drives were enabled, s.

    words: further requests, at the wrong time or twice, in order of time. interrupts_s: when Ctrl-C is pressed.
    """

    words: tuple[tuple[float, Request], ...] = ()
    interrupts_s: tuple[float, ...] = ()


@dataclass
class _Notes:
    """When something was asked, ns of the host's clock."""

    finish_ns: int | None = None
    faults_ns: list[int] = field(default_factory=list)


class _Watching:
    """What both kinds of user have in common: it notes when the end was asked for, and presses Ctrl-C."""

    def __init__(self, script: ScriptedOperator, user: User, notes: _Notes, clock: VirtualClock) -> None:
        self._script, self._notes, self._clock = script, notes, clock
        self._words, self._interrupts_s = list(user.words), list(user.interrupts_s)
        self.session: Session | None = None
        self.on_finish = lambda: None

    def ask(self, elapsed_s: float | None, state: SchemeState) -> Request:
        if elapsed_s is not None and self._interrupts_s and elapsed_s >= self._interrupts_s[0]:
            self._interrupts_s.pop(0)
            if self.session is not None:
                self._note_finish()
                self.session.interrupt()
        if elapsed_s is not None and self._words and elapsed_s >= self._words[0][0] and state is not SchemeState.FAULT:
            return self._words.pop(0)[1]
        request = self._script.request(elapsed_s, state)
        if request is Request.FINISH:
            self._note_finish()
        return request

    def answer(self, elapsed_s: float) -> FaultAnswer:
        answer = self._script.answer_fault(elapsed_s)
        if answer is not FaultAnswer.WAIT:
            self._notes.faults_ns.append(self._clock.now_ns())
        return answer

    def _note_finish(self) -> None:
        if self._notes.finish_ns is None:
            self._notes.finish_ns = self._clock.now_ns()
        self.on_finish()


class _WatchedScript(ScriptedOperator):
    """The configuration's script, watched. The log says that a script was at work, and replay plays it once more."""

    def __init__(self, watching: _Watching, settings: Settings) -> None:
        super().__init__(settings.operator)
        self._watching = watching

    def request(self, elapsed_s: float | None, state: SchemeState) -> Request:
        """Return what the user asks now."""
        return self._watching.ask(elapsed_s, state)

    def answer_fault(self, elapsed_s: float) -> FaultAnswer:
        """Say how a faulted run goes on."""
        return self._watching.answer(elapsed_s)


class _WatchedPerson:
    """A person who says more than the script; the log says that somebody was there, and replay takes their word."""

    def __init__(self, watching: _Watching) -> None:
        self._watching = watching

    def request(self, elapsed_s: float | None, state: SchemeState) -> Request:
        """Return what the user asks now."""
        return self._watching.ask(elapsed_s, state)

    def answer_fault(self, elapsed_s: float) -> FaultAnswer:
        """Say how a faulted run goes on."""
        return self._watching.answer(elapsed_s)


@dataclass(frozen=True)
class Truth:
    """What was true at each SYNC that the devices were to hear, column arrays of the same length n.

    sync: number of the host's SYNC from 0, over the whole run.
    """

    sync: NDArray[np.int64]
    block: NDArray[np.float64]  # (n, TRUTH_LAYOUT.size)

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """Return a field of TRUTH_LAYOUT, (n, size)."""
        return self.block[:, TRUTH_LAYOUT.slices[name]]

    def at_sync(self, syncs: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the row of each SYNC; of one that the devices didn't hear, the row before, -1 for none."""
        return np.asarray(np.searchsorted(self.sync, syncs, side="right") - 1, np.int64)


@dataclass(frozen=True)
class Played:
    """One run. `crash`: a traceback's last line. `overdue`: why it was ended from outside. Both empty when all is well.

    finish_ns: when the user first asked for the end, on the host's clock; None: never. enabled_at_end: drives that
    are in Operation enabled when the host has gone.
    """

    settings: Settings
    scenario: Scenario
    wire: WireRecord
    truth: Truth
    log: RunLog | None
    summary: SessionSummary | None
    crash: str
    overdue: str
    finish_ns: int | None
    end_ns: int
    enabled_at_end: tuple[bool, bool]


class HungError(BaseException):
    """No end by the wall clock; not an Exception, so that nothing on the way takes it for its own."""


@contextlib.contextmanager
def _at_most(seconds: int) -> Iterator[None]:
    """Raise HungError in this (main) thread when the block takes longer."""

    def ring(_number: int, _frame: FrameType | None) -> None:
        raise HungError(f"no end after {seconds} s by the wall clock")

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def allowed_after_finish_s(settings: Settings) -> float:
    """Return how long a run may go on after it was asked to end: each fault that is acknowledged begins anew."""
    operator = settings.operator
    again_s = operator.acknowledge_fault_after_s + START_ALLOWED_S / 2
    return END_ALLOWED_S + operator.acknowledge_faults * again_s


def allowed_s(settings: Settings) -> float:
    """Return how long a run may take if its end is never asked for: the script begins anew with each attempt."""
    operator = settings.operator
    last_s = max((entry.at_s for entry in operator.script), default=0.0)
    return (1 + operator.acknowledge_faults) * (START_ALLOWED_S + last_s + END_ALLOWED_S)


def play_witnessed(settings: Settings, scenario: Scenario, folder: Path, user: User | None = None) -> Played:
    """Play a run to its end, or until it is overdue. Raises ConfigError, CodecError for what can't be played."""
    folder.mkdir(parents=True, exist_ok=True)
    devices = place_devices(settings)
    codec = load_contract(settings, devices)
    clock = VirtualClock()
    embedded = EmbeddedBus(clock)
    bus = WitnessBus(model_time(embedded, clock, codec, settings), clock)
    bus.limit_ns = round(allowed_s(settings) * 1e9)
    syncs: list[int] = []
    blocks: list[NDArray[np.float64]] = []

    def on_truth(_cycle: int, _t_ns: int, block: NDArray[np.float64]) -> None:
        syncs.append(bus.syncs - 1)
        blocks.append(block.copy())

    bench = Bench(scenario, codec, embedded.deliver, on_truth=on_truth)

    def is_enabled() -> tuple[bool, bool]:
        first, second = (drive.state.name == "OPERATION_ENABLED" for drive in bench.drives)
        return first, second

    embedded.attach(bench.on_frame)
    bench.boot()
    notes, script = _Notes(), ScriptedOperator(settings.operator)
    watching = _Watching(script, user or User(), notes, clock)
    is_person = user is not None and bool(user.words)
    operator: Operator = _WatchedPerson(watching) if is_person else _WatchedScript(watching, settings)

    def on_finish() -> None:
        due_ns = (notes.finish_ns or 0) + round(allowed_after_finish_s(settings) * 1e9)
        bus.limit_ns = min(bus.limit_ns, due_ns)

    watching.on_finish = on_finish
    session = watching.session = Session(settings, codec, devices, bus, clock, operator, folder, "embedded")
    summary, crash, overdue = None, "", ""
    try:
        with _at_most(HANG_S):
            summary = session.run()
    except (OverdueError, HungError) as reason:
        overdue = str(reason)
    except Exception as reason:
        crash = f"{type(reason).__name__}: {reason}"
    path = folder / LOG_NAME
    return Played(
        settings=dataclasses.replace(settings),
        scenario=scenario,
        wire=WireRecord(codec.text, bus.passed),
        truth=Truth(np.array(syncs, np.int64), np.array(blocks).reshape(len(blocks), TRUTH_LAYOUT.size)),
        log=read_log(path, [topic.name for topic in (SCHEME, CONTROL, CONTACT, EVENTS, CYCLE)])
        if path.exists()
        else None,
        summary=summary,
        crash=crash,
        overdue=overdue,
        finish_ns=notes.finish_ns,
        end_ns=clock.now_ns(),
        enabled_at_end=is_enabled(),
    )
