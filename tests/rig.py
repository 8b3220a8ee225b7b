"""Host and emulated arm at the two ends of one embedded bus, in virtual time: what tests of the host are built on."""

import dataclasses
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from queued_bus import QueuedBus

from adacd_hil.cli.connection import model_time
from adacd_hil.clock import VirtualClock
from adacd_hil.control.cycle import Cycle, RunResult
from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.control.pacing import GridPacer
from adacd_hil.control.session import ArmFile, Session, SessionSummary
from adacd_hil.device.arm import Arm
from adacd_hil.device.device_files import place_devices
from adacd_hil.device.network import Master
from adacd_hil.log.reader import RunLog, read_log
from adacd_hil.log.recording.recorder import Recorder
from adacd_hil.settings.arm_settings import BusSettings, LockstepSettings
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.run_settings import OperatorSettings, RequestSettings
from adacd_hil.wire.bus import Bus, Frame, Tap
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.dbc_contract import load_codec
from adacd_hil.wire.embedded_bus import EmbeddedBus
from firmware_sim.bench.bench import Bench
from firmware_sim.scenario.scenario import Scenario, load_scenario

CODEC = load_codec()
PERIOD_NS = 1_000_000
ENABLED_CYCLE = 203  # in lockstep always the same
TROUBLE_CYCLE = 450
QUICK_STOP, DISABLE_VOLTAGE, ENABLE_OPERATION = 0x0002, 0x0000, 0x000F


def scripted(config: str = "paper", finish_s: float = 2.0, **operator: Any) -> Settings:
    """Settings whose user asks to finish, and does what else is said of him; he acknowledges a fault after 0.25 s."""
    script = (RequestSettings(at_s=finish_s, request="finish"),)
    user = OperatorSettings(**({"script": script, "acknowledge_fault_after_s": 0.25} | operator))
    return dataclasses.replace(load_settings(config), operator=user)


class SteppedClock(VirtualClock):
    """Lets a bench live through the time that passes, in steps of at most a period."""

    def __init__(self) -> None:
        super().__init__()
        self.on_time: Callable[[int], None] = lambda t_ns: None
        self.oversleep_ns: Callable[[int], int] = lambda t_ns: 0

    def sleep_until_ns(self, t_ns: int) -> None:
        t_ns += self.oversleep_ns(t_ns)
        while self.now_ns() < t_ns:
            super().sleep_until_ns(min(t_ns, (self.now_ns() // PERIOD_NS + 1) * PERIOD_NS))
            self.on_time(self.now_ns())


class Rig:
    """The two ends of a bus, an arm with its set-up on each.

    `bus`: the embedded one; `host_bus`: its end at the host, behind a transmit queue of `queue_length` frames (0: none)
    or modelled as in lockstep. is_wall: the bench goes by the clock, which makes it live through what time passes.
    `tamper` drops (None) or changes a device's frame in a cycle of the bench. `before_sync`, `after_sync`: what is done
    once, just before or after the SYNC of that cycle reaches the devices. `sent`: what reached the devices.
    """

    def __init__(
        self,
        settings: Settings | str = "paper",
        scenario: Scenario | None = None,
        *,
        codec: Codec = CODEC,
        bus: EmbeddedBus | None = None,
        clock: VirtualClock | None = None,
        queue_length: int = 0,
        is_modelled: bool = False,
        is_wall: bool = False,
        **watched: Any,
    ) -> None:
        """`watched`: the bench's on_truth and on_event."""
        self.settings = load_settings(settings) if isinstance(settings, str) else settings
        self.codec = codec
        self.clock = clock or (SteppedClock() if is_wall else VirtualClock())
        self.bus = bus or EmbeddedBus(self.clock)
        self.queue = QueuedBus(self.bus, queue_length) if queue_length else None
        self.tamper: Callable[[int, int, bytes], bytes | None] = lambda cycle, can_id, data: data
        self.before_sync: dict[int, Callable[[], object]] = {}
        self.after_sync: dict[int, Callable[[], object]] = {}
        self.sent: list[Frame] = []
        self._is_wall = is_wall
        self._is_synchronised = False
        mode = "wall" if is_wall else "sync"
        self.bench = Bench(scenario or load_scenario("idle", "P"), codec, self.deliver, clock_mode=mode, **watched)
        self.bus.attach(self.on_frame)
        if isinstance(self.clock, SteppedClock):
            self.clock.on_time = self._on_time
        self.bench.boot()
        self.host_bus: Bus = self.queue or self.bus
        if is_modelled:
            self.host_bus = model_time(self.bus, self.clock, codec, self.settings)

    @cached_property
    def tap(self) -> Tap:
        return Tap(self.host_bus, self.clock)

    @cached_property
    def arm(self) -> Arm:
        return Arm(self.settings, self.codec, place_devices(self.settings), self.tap)

    @cached_property
    def master(self) -> Master:
        return Master(self.settings, self.codec, place_devices(self.settings), self.tap)

    def deliver(self, can_id: int, data: bytes) -> None:
        """Pass on what a device sends."""
        kept = self.tamper(self.bench.cycle, can_id, data)
        if kept is not None:
            self.bus.deliver(can_id, kept)

    def on_frame(self, frame: Frame) -> None:
        """Pass on what the host sends."""
        is_sync = frame.can_id == 0x080
        self.sent.append(frame)
        if is_sync:
            self.before_sync.pop(self.bench.cycle, lambda: None)()
        self.bench.on_frame(frame)
        if is_sync:
            self.after_sync.pop(self.bench.cycle, lambda: None)()
        self._follow()

    def _on_time(self, t_ns: int) -> None:
        self.bench.advance_to(t_ns)
        self._follow()
        if self._is_synchronised and t_ns % PERIOD_NS == 0:
            sync = bytes((1 + t_ns // PERIOD_NS % 240,))
            self.bus.deliver(0x080, sync)
            self.bench.on_frame(Frame(0x080, sync, t_ns))

    def _follow(self) -> None:
        """Let the queue be acknowledged as a bench that goes by the clock does."""
        is_acknowledged = self.bench.injector.plan.is_acknowledged
        if self._is_wall and self.queue is not None and self.queue.is_acknowledged != is_acknowledged:
            self.queue.is_acknowledged = is_acknowledged

    def start(self) -> None:
        """Bring the nodes into operation, as a host before this one may have done; `sent` begins anew."""
        self.master.reset()
        self.master.configure()
        self.master.start()
        self.sent.clear()

    def add_host(self) -> None:
        """Let another host send SYNC at 1 kHz; this one hears it."""
        self._is_synchronised = True

    def silence(self, node_id: int) -> None:
        """Take a node off the bus, its boot-up too."""
        self.tamper = lambda cycle, can_id, data: None if can_id & 0x7F == node_id else data
        self.forget()

    def forget(self) -> None:
        """Drop what waits for the host."""
        while self.bus.receive(0.0) is not None:
            pass


class SessionRig(Rig):
    """A rig with a session that logs in a folder; its script asks to finish after `finish_s` unless settings say so."""

    def __init__(
        self,
        folder: Path,
        settings: Settings | None = None,
        scenario: Scenario | None = None,
        *,
        finish_s: float = 2.0,
        acknowledge_faults: int = 0,
        files: Sequence[ArmFile] = (),
        **parts: Any,
    ) -> None:
        settings = settings or scripted(finish_s=finish_s, acknowledge_faults=acknowledge_faults)
        super().__init__(settings, scenario, **parts)
        operator, devices = ScriptedOperator(settings.operator), place_devices(settings)
        host = settings, self.codec, devices, self.host_bus, self.clock, operator, folder, "embedded"
        self.session = Session(*host, files=files)

    def run(self) -> tuple[SessionSummary, RunLog]:
        summary = self.session.run()
        return summary, read_log(summary.log.path)

    def play(self) -> tuple[RunResult, RunLog]:
        """Run to the end of the cycles; return how they ended, and the log."""
        summary, log = self.run()
        assert summary.result is not None
        return summary.result, log


def play_lockstep(
    folder: Path,
    operator: OperatorSettings,
    lockstep: LockstepSettings,
    scenario: Scenario | None = None,
    bus: BusSettings | None = None,
) -> tuple[RunLog, list[Frame]]:
    """Run on the modelled bus, as the product plays lockstep; give the log, and the frames that reached the devices."""
    settings = dataclasses.replace(load_settings(), operator=operator, lockstep=lockstep, bus=bus or BusSettings())
    rig = SessionRig(folder, settings, scenario, is_modelled=True)
    return rig.run()[1], rig.sent


class CycleRig(Rig):
    """A rig with the real-time cycle over a transmit queue, and its log."""

    def __init__(
        self,
        folder: Path,
        settings: Settings | None = None,
        scenario: Scenario | None = None,
        *,
        finish_s: float = 1.0,
        queue_length: int = 10,
        **parts: Any,
    ) -> None:
        super().__init__(settings or scripted(finish_s=finish_s), scenario, queue_length=queue_length, **parts)
        pacer, operator = GridPacer(self.clock, self.settings.bus.period_ns), ScriptedOperator(self.settings.operator)
        host = self.settings, self.tap, self.arm, self.master
        self.cycle = Cycle(*host, pacer, operator, lambda _: None, self.clock)
        self.cycle.compile()
        self._path = folder / "run.mcap"
        self.recorder = Recorder(self._path, messages=CODEC.messages.values(), blocking=True)

    def run(self) -> RunResult:
        """Boot and run. Raises BusError, DeviceError."""
        self.start()
        return self.cycle.run(self.recorder)

    def read(self) -> RunLog:
        """End the log and read it."""
        self.recorder.close()
        return read_log(self._path)


def torque_of(frame: Frame) -> int:
    """Return the target torque of a command frame, 0 of any other."""
    return int.from_bytes(frame.data[4:6], "little", signed=True) if frame.can_id in (0x201, 0x202) else 0


def torques_from(log: RunLog, cycle: int) -> np.ndarray:
    """Return the target torques on the wire from this cycle on."""
    start_ns = cycle * PERIOD_NS
    commands = [log.topics[f"/decoded/{name}"] for name in ("Drive1Command", "Drive2Command")]
    return np.concatenate([command["target_torque"][command.t_ns >= start_ns] for command in commands])


def controlwords(log: RunLog) -> np.ndarray:
    return log.topics["/decoded/Drive1Command"]["controlword"]


def messages(log: RunLog, name: str) -> list[str]:
    """Return the texts of a log's events of this name."""
    return [entry.event.message for entry in log.events if entry.event.name == name]


def transition(log: RunLog, state: str) -> str:
    """Return what the supervisor says of the one transition to this state."""
    (text,) = [text for text in messages(log, "supervisor") if f"-> {state}" in text]
    return text
