"""A process that is stopped in the middle of a cycle must not go on with the torque that it had in mind."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from adacd_hil.clock import VirtualClock
from adacd_hil.config import OperatorSettings, RequestSettings, load_settings
from adacd_hil.control.cycle import Cycle
from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.control.realtime import GridPacer
from adacd_hil.device.arm import Arm
from adacd_hil.device.network import Master
from adacd_hil.log.reader import RunLog, read_log
from adacd_hil.log.recorder import Recorder
from adacd_hil.wire.bus import EmbeddedBus, Frame
from adacd_hil.wire.codec import load_codec
from adacd_hil.wire.tap import Tap
from firmware_sim.bench import Bench
from firmware_sim.scenario import load_scenario

pytestmark = pytest.mark.slow

CODEC = load_codec()
STALL_CYCLE = 800


def run_with_stall(folder: Path, stall_ns: int) -> RunLog:
    """Run by the grid in virtual time; in one cycle, time passes between SYNC and feedback."""
    script = OperatorSettings(script=(RequestSettings(at_s=1.0, request="finish"),))
    settings = dataclasses.replace(load_settings("paper"), operator=script)
    clock = VirtualClock()
    bus = EmbeddedBus(clock)
    bench = Bench(load_scenario("idle", "P"), CODEC, bus.deliver)

    def on_frame(frame: Frame) -> None:
        bench.on_frame(frame)
        if frame.can_id == 0x080 and bench.cycle == STALL_CYCLE:
            clock.sleep_until_ns(clock.now_ns() + stall_ns)

    bus.attach(on_frame)
    bench.boot()
    tap = Tap(bus, clock)
    arm, master = Arm(settings, CODEC, tap), Master(settings, CODEC, tap)
    pacer = GridPacer(clock, settings.bus.period_ns)
    operator = ScriptedOperator(settings.operator)
    cycle = Cycle(settings, tap, arm, master, pacer, operator, lambda _: None, is_lockstep=False, stopwatch=clock)
    cycle.compile()
    master.reset()
    master.configure()
    master.start()
    recorder = Recorder(folder / "run.mcap", blocking=True)
    try:
        cycle.run(recorder)
    finally:
        summary = recorder.close()
    return read_log(summary.path)


@pytest.mark.parametrize(("stall_ns", "is_zero"), [(2_900_000, False), (3_100_000, True)])
def test_a_command_that_comes_later_than_the_age_budget_carries_no_torque(
    tmp_path: Path, stall_ns: int, is_zero: bool
) -> None:
    log = run_with_stall(tmp_path, stall_ns)
    (row,) = np.flatnonzero(log.control["cycle"] == STALL_CYCLE)
    assert np.all(log.control["tau_c"][row - 1] != 0.0)
    assert np.all(log.control["tau_c"][row] == 0.0) == is_zero
    frames = log.frames[(log.frames["can_id"] == 0x201) & (log.frames["cycle_t_ns"] == log.control.t_ns[row])]
    torque = [int.from_bytes(data[4:6].tobytes(), "little", signed=True) for data in frames["data"]]
    assert (torque == [0]) == is_zero
