"""Host and emulator on one embedded bus, where a test can make something go wrong in a given cycle."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np

from adacd_hil.clock import VirtualClock
from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.control.session import Session, SessionSummary
from adacd_hil.log.reader import RunLog, read_log
from adacd_hil.settings.configuration import load_settings
from adacd_hil.settings.run_settings import OperatorSettings, RequestSettings
from adacd_hil.wire.bus import EmbeddedBus, Frame
from adacd_hil.wire.codec import load_codec
from firmware_sim.bench.bench import Bench
from firmware_sim.scenario.scenario import load_scenario

CODEC = load_codec()
ENABLED_CYCLE = 203  # in lockstep always the same
TROUBLE_CYCLE = 1000
QUICK_STOP, DISABLE_VOLTAGE, ENABLE_OPERATION = 0x0002, 0x0000, 0x000F


class Rig:
    """`tamper` drops or changes the devices' frames; `in_cycle` does something once, just before that SYNC."""

    def __init__(self, folder: Path, finish_s: float = 2.0, acknowledge_faults: int = 0) -> None:
        script = (RequestSettings(at_s=finish_s, request="finish"),)
        operator = OperatorSettings(
            script=script, acknowledge_faults=acknowledge_faults, acknowledge_fault_after_s=0.25
        )
        settings = dataclasses.replace(load_settings("paper"), operator=operator)
        clock = VirtualClock()
        self.bus = EmbeddedBus(clock)
        self.tamper: Callable[[int, int, bytes], bytes | None] = lambda cycle, can_id, data: data
        self.in_cycle: dict[int, Callable[[], None]] = {}
        self.bench = Bench(load_scenario("idle", "P"), CODEC, self._deliver)
        self.bus.attach(self._on_frame)
        self.bench.boot()
        self.session = Session(settings, CODEC, self.bus, clock, ScriptedOperator(operator), folder, "embedded")

    def _deliver(self, can_id: int, data: bytes) -> None:
        kept = self.tamper(self.bench.cycle, can_id, data)
        if kept is not None:
            self.bus.deliver(can_id, kept)

    def _on_frame(self, frame: Frame) -> None:
        if frame.can_id == 0x080:
            self.in_cycle.pop(self.bench.cycle, lambda: None)()
        self.bench.on_frame(frame)

    def run(self) -> tuple[SessionSummary, RunLog]:
        summary = self.session.run()
        return summary, read_log(summary.log.path)


def torques_from(log: RunLog, cycle: int) -> np.ndarray:
    """Return the target torques on the wire from this cycle on."""
    start_ns = cycle * 1_000_000
    commands = [log.decoded[name] for name in ("Drive1Command", "Drive2Command")]
    return np.concatenate([command["target_torque"][command.t_ns >= start_ns] for command in commands])


def controlwords(log: RunLog) -> np.ndarray:
    return log.decoded["Drive1Command"]["controlword"]
