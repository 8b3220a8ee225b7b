"""Host and emulator in one process on the modelled bus: lockstep as the product plays it."""

import dataclasses
from pathlib import Path

from adacd_hil.cli.connection import model_time
from adacd_hil.clock import VirtualClock
from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.control.session import Session
from adacd_hil.log.reader import RunLog, read_log
from adacd_hil.settings.bus_settings import BusSettings, LockstepSettings
from adacd_hil.settings.configuration import load_settings
from adacd_hil.settings.run_settings import OperatorSettings
from adacd_hil.wire.bus import EmbeddedBus, Frame
from adacd_hil.wire.codec import load_codec
from firmware_sim.bench.bench import Bench
from firmware_sim.scenario.scenario import Scenario, load_scenario

CODEC = load_codec()


def play(
    folder: Path,
    operator: OperatorSettings,
    lockstep: LockstepSettings,
    scenario: Scenario | None = None,
    bus: BusSettings | None = None,
) -> tuple[RunLog, list[Frame]]:
    """Run to the end; give the log, and the host's frames as they reach the devices."""
    settings = dataclasses.replace(load_settings(), operator=operator, lockstep=lockstep, bus=bus or BusSettings())
    clock = VirtualClock()
    embedded = EmbeddedBus(clock)
    bench = Bench(scenario or load_scenario("idle"), CODEC, embedded.deliver)
    arrived: list[Frame] = []

    def on_frame(frame: Frame) -> None:
        arrived.append(frame)
        bench.on_frame(frame)

    embedded.attach(on_frame)
    bench.boot()
    modelled = model_time(embedded, clock, CODEC, settings)
    summary = Session(settings, CODEC, modelled, clock, ScriptedOperator(operator), folder, "embedded").run()
    return read_log(summary.log.path), arrived
