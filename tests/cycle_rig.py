"""The real-time cycle in virtual time: host and emulator on an embedded bus with a transmit queue between them."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

from queued_bus import QueuedBus

from adacd_hil.clock import VirtualClock
from adacd_hil.control.cycle import Cycle, RunResult
from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.control.pacing import GridPacer
from adacd_hil.device.arm import Arm
from adacd_hil.device.network import Master
from adacd_hil.log.reader import RunLog, read_log
from adacd_hil.log.recording.recorder import Recorder
from adacd_hil.settings.configuration import load_settings
from adacd_hil.settings.run_settings import OperatorSettings, RequestSettings
from adacd_hil.wire.bus import EmbeddedBus, Frame, Tap
from adacd_hil.wire.codec import load_codec
from firmware_sim.bench.bench import Bench
from firmware_sim.scenario.scenario import load_scenario

CODEC = load_codec()


class CycleRig:
    """`in_cycle` does something once, just after that SYNC has reached the devices."""

    def __init__(self, folder: Path, finish_s: float = 1.0, queue_length: int = 10) -> None:
        script = OperatorSettings(script=(RequestSettings(at_s=finish_s, request="finish"),))
        settings = self.settings = dataclasses.replace(load_settings("paper"), operator=script)
        self.clock = VirtualClock()
        self.in_cycle: dict[int, Callable[[], None]] = {}
        self.arrived: list[Frame] = []
        embedded = EmbeddedBus(self.clock)
        self.queue = QueuedBus(embedded, queue_length)
        self.bench = Bench(load_scenario("idle", "P"), CODEC, embedded.deliver)
        embedded.attach(self._on_frame)
        self.bench.boot()
        self.tap = Tap(self.queue, self.clock)
        self.arm = Arm(settings, CODEC, self.tap)
        self.master = Master(settings, CODEC, self.tap)
        pacer = GridPacer(self.clock, settings.bus.period_ns)
        operator = ScriptedOperator(settings.operator)
        self.cycle = Cycle(settings, self.tap, self.arm, self.master, pacer, operator, lambda _: None, self.clock)
        self.cycle.compile()
        self._path = folder / "run.mcap"
        self.recorder = Recorder(self._path, blocking=True)

    def _on_frame(self, frame: Frame) -> None:
        self.arrived.append(frame)
        self.bench.on_frame(frame)
        if frame.can_id == 0x080:
            self.in_cycle.pop(self.bench.cycle, lambda: None)()

    def run(self) -> RunResult:
        """Boot and run. Raises BusError."""
        self.master.reset()
        self.master.configure()
        self.master.start()
        return self.cycle.run(self.recorder)

    def read(self) -> RunLog:
        """End the log and read it."""
        self.recorder.close()
        return read_log(self._path)


def torque_of(frame: Frame) -> int:
    """Return the target torque of a command frame, 0 of any other."""
    return int.from_bytes(frame.data[4:6], "little", signed=True) if frame.can_id in (0x201, 0x202) else 0
