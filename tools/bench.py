"""Prints what one step, one cycle, the codec, the plant and the log hand-off cost: percentiles in µs.

    python tools/bench.py                   all; what needs a bus through tools/with-vcan
    python tools/bench.py --side-by-side    only the cycle over vcan, beside the C yardstick's and a straightforward
                                            loop's
    python tools/bench.py --vcan            only what needs a bus, on an interface vcan0 that is up

Absolute figures are this machine's; compare ratios of one run. numpy's percentiles, linear interpolation.
"""

import argparse
import dataclasses
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar
from unittest.mock import patch

import cantools
import numpy as np
import regressor_bench
from numpy.typing import NDArray
from side_by_side import BIN, CHANNEL, ENVIRONMENT, ROOT, TimingError, as_text, compare, emulator

from adacd_hil.cli.connection import model_time
from adacd_hil.clock import VirtualClock
from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.control.pacing import GridPacer, Tick
from adacd_hil.control.session import Session
from adacd_hil.device.device_files import place_devices
from adacd_hil.log.log_files import LOG_NAME
from adacd_hil.log.reader import read_log
from adacd_hil.log.recording.recorder import Recorder
from adacd_hil.log.types.topics import CYCLE, ChannelId, pack_scheme
from adacd_hil.records import ArmState, FaultReason, Request
from adacd_hil.scheme.pipeline.new_pipeline import new_pipeline
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.dbc_contract import contract_folder, load_codec
from adacd_hil.wire.embedded_bus import EmbeddedBus
from firmware_sim.arm.hardware_settings import MechanicsSettings
from firmware_sim.arm.sensing import DriveMode
from firmware_sim.bench.bench import Bench
from firmware_sim.body.body import Body
from firmware_sim.scenario.scenario import load_scenario

SYNC_ID = 0x080
REPEATS = 20_000
EVERYTHING = MechanicsSettings(
    static_Nm=(0.06, 0.03),
    sigma0_Nm_rad=(3000.0, 1500.0),
    sigma1_Nm_s=(5.0, 2.0),
    load_friction=(0.01, 0.01),
    viscous_drop_per_K=(0.02, 0.02),
    coulomb_drop_per_K=(0.01, 0.01),
    heat_capacity_J_K=(300.0, 200.0),
    stiffness_Nm_rad=(6000.0, 2000.0),
    damping_Nm_s=(2.0, 0.5),
    rotor_inertia_kg_m2=(0.3, 0.05),
    backlash_rad=(2e-4, 2e-4),
    ripple_Nm=(0.05, 0.03),
    ripple_share=(0.01, 0.01),
    motor_viscous_Nm_s=(0.1, 0.05),
    motor_coulomb_Nm=(0.2, 0.1),
    stop_low_deg=(-75.0, -120.0),
    stop_high_deg=(75.0, 120.0),
    tilt_deg=5.0,
)
WARM_UP = 1_000
SHORT_RUN = """
[operator]
script = [{ at_s = 10.0, request = "finish" }]

[bus]  # a machine that stalls is to be measured, not to fault the arm
command_patience_cycles = 250
max_age_cycles = 100
"""


def main() -> int:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(description="Benchmarks; prints percentiles in µs.")
    parser.add_argument("--rounds", type=int, default=3, help="of yardstick, host, straightforward loop; default 3")
    parser.add_argument("--seconds", type=float, default=8.0, help="of each block of a round; default 8")
    parser.add_argument("--side-by-side", action="store_true", help="the cycle beside the yardstick's only")
    parser.add_argument("--vcan", action="store_true", help="what runs on vcan only, on an interface vcan0 that is up")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures of the cycles to a file")
    chosen = parser.parse_args()
    if chosen.vcan:
        return bench_vcan(chosen)
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} CPUs, Python {platform.python_version()}")
    if not chosen.side_by_side:
        print(f"{'µs':44} {'p50':>8} {'p99':>8} {'p99.9':>8} {'max':>8}")
        bench_in_process()
        regressor_bench.print_table()
        sys.stdout.flush()
    again = [sys.executable, __file__, "--vcan", *sys.argv[1:]]
    return subprocess.run([ROOT / "tools/with-vcan", "--", *again], check=False).returncode


def show(name: str, times_us: NDArray[np.float64]) -> None:
    """Print one row."""
    p50, p99, p999 = np.percentile(times_us, [50.0, 99.0, 99.9])
    print(f"{name:44} {p50:8.2f} {p99:8.2f} {p999:8.2f} {times_us.max():8.1f}")


def time_calls(name: str, call: Callable[[], object]) -> None:
    """Time single calls, the clock's own cost taken off."""
    clock = time.perf_counter_ns
    times_ns = np.empty(REPEATS)
    for _ in range(WARM_UP):
        call()
    for index in range(REPEATS):
        start_ns = clock()
        call()
        times_ns[index] = clock() - start_ns
    overhead_ns = min(-(clock() - clock()) for _ in range(1000))
    show(name, np.maximum(times_ns - overhead_ns, 0.0) * 1e-3)


def bench_in_process() -> None:
    """Time the parts that need no second process but the logger's."""
    codec = load_codec()
    peer = cantools.database.load_file(contract_folder() / "arm.dbc")
    feedback, command = codec.message("Drive1Feedback"), codec.message("Drive1Command")
    their_feedback, their_command = (
        peer.get_message_by_name("Drive1Feedback"),
        peer.get_message_by_name("Drive1Command"),
    )
    wire = bytes(feedback.encode_raw(50_066, -2_400))
    sender = command.sender()
    fields = {"e2e_crc": 0, "e2e_counter": 0, "e2e_status": 0, "controlword": 15, "target_torque": -123}
    time_calls("codec: decode feedback", lambda: feedback.decode_values(wire))
    time_calls("cantools: decode feedback", lambda: their_feedback.decode(wire))
    time_calls("codec: encode and protect command", lambda: sender.protect(command.encode_raw(15, -123)))
    time_calls("cantools: encode command, no protection", lambda: their_command.encode(fields))

    settings = load_settings("paper")
    pipeline = new_pipeline(settings)
    pipeline.compile_cycle()
    arm = ArmState(
        0, 0, 1, np.array((0.1, 0.2)), np.array((0.01, 0.02)), np.zeros(2), (0, 0), (0, 0), True, True, FaultReason.NONE
    )
    time_calls("scheme: one step", lambda: pipeline.step(arm))

    scenario = load_scenario("paper", "P")
    body = Body(scenario)
    torques, modes = (0.1, 0.05), (DriveMode.TORQUE, DriveMode.TORQUE)
    time_calls("plant: 1 ms of arm, drives and sensors", lambda: (body.advance(torques, modes), body.sample()))
    rich = Body(dataclasses.replace(scenario, mechanics=EVERYTHING))
    time_calls(
        "plant: the same with every option of [mechanics]", lambda: (rich.advance(torques, modes), rich.sample())
    )
    bench_log(pipeline.step(arm), wire)
    bench_embedded()


def bench_log(output: object, wire: bytes) -> None:
    """Time handing a cycle with seven frames to the logger's process, without waiting for it."""
    frames = [(False, Frame(0x181, wire, 0))] * 7
    with tempfile.TemporaryDirectory() as folder:
        recorder = Recorder(Path(folder) / "bench.mcap", messages=load_codec().messages.values(), blocking=False)
        message = pack_scheme(output, Request.NONE)  # type: ignore[arg-type]

        def hand_over() -> None:
            recorder.cycle(0, [(ChannelId.SCHEME, message)], frames)

        for _ in range(WARM_UP):
            hand_over()
        times_ns = np.empty(5000)
        for index in range(times_ns.size):
            time.sleep(200e-6)  # the writer keeps up, as it does at 1 kHz
            start_ns = time.perf_counter_ns()
            hand_over()
            times_ns[index] = time.perf_counter_ns() - start_ns
        dropped = recorder.close().dropped
    show(f"log: hand over a cycle with 7 frames ({dropped} lost)", times_ns * 1e-3)


class CountedBus:
    """The devices' end of an embedded bus; remembers how long they took for each period."""

    def __init__(self, bench: Bench) -> None:
        self.period_ns: list[int] = []
        self._bench = bench
        self._spent_ns = 0

    def on_frame(self, frame: Frame) -> None:
        """Pass a frame on."""
        start_ns = time.perf_counter_ns()
        if frame.can_id == SYNC_ID:
            self.period_ns.append(self._spent_ns)
            self._spent_ns = 0
        self._bench.on_frame(frame)
        self._spent_ns += time.perf_counter_ns() - start_ns


class StampedPacer(GridPacer):
    """A grid in virtual time that remembers when, by the wall clock, each cycle began."""

    began_ns: ClassVar[list[int]] = []

    def next(self) -> Tick:
        """Begin a cycle."""
        self.began_ns.append(time.perf_counter_ns())
        return super().next()


def bench_embedded() -> None:
    """Run ten seconds in lockstep on the embedded bus, bus model on, and print the pace."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "short.toml").write_text(SHORT_RUN)
        settings = load_settings(str(Path(folder) / "short.toml"), "P")
        clock = VirtualClock()
        embedded = EmbeddedBus(clock)
        codec = load_codec()
        bench = Bench(load_scenario("idle", "P"), codec, embedded.deliver)
        counted = CountedBus(bench)
        embedded.attach(counted.on_frame)
        bench.boot()
        bus = model_time(embedded, clock, codec, settings)
        operator = ScriptedOperator(settings.operator)
        with patch("adacd_hil.control.pacing.GridPacer", StampedPacer):
            summary = Session(
                settings, codec, place_devices(settings), bus, clock, operator, Path(folder), "embedded"
            ).run()
        assert summary.result is not None
        show("devices: 1 ms of plant, sensors and drives", np.array(counted.period_ns[WARM_UP:]) * 1e-3)
        show("embedded bus, lockstep: one cycle of all", np.diff(StampedPacer.began_ns[WARM_UP:]) * 1e-3)
        played_s = summary.result.cycles * settings.bus.period_s
        print(f"  {played_s:.1f} s played in {summary.elapsed_s:.1f} s: {played_s / summary.elapsed_s:.1f} x real time")


def bench_vcan(chosen: argparse.Namespace) -> int:
    """Run host and emulator as two processes on vcan0: in lockstep, then in real time beside the yardstick."""
    if not chosen.side_by_side and (status := bench_lockstep()):
        return status
    try:
        described = compare(chosen.rounds, chosen.seconds)
    except TimingError as error:
        print(f"bench: {error}", file=sys.stderr)
        return 1
    print(as_text(described))
    if chosen.json is not None:
        chosen.json.write_text(json.dumps(described, indent=2) + "\n")
    return 0


def bench_lockstep() -> int:
    """Print how long a run of ten seconds takes in lockstep; return the exit status."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "short.toml").write_text(SHORT_RUN)
        where = ["-i", "socketcan", "-c", CHANNEL]
        command = [BIN / "adacd-hil", "run", *where, "--config", folder / "short.toml", "--clock", "lockstep"]
        with emulator(CHANNEL, "--scenario", "idle", folder=folder):
            start_s = time.perf_counter()
            done = subprocess.run(
                [*command, "--out", folder], capture_output=True, text=True, check=False, env=ENVIRONMENT
            )
            elapsed_s = time.perf_counter() - start_s
        if done.returncode:
            print(done.stderr, file=sys.stderr)
            return done.returncode
        count = len(read_log(folder / LOG_NAME, (CYCLE.name,)).cycle)
        print(f"vcan, lockstep: {count} cycles in {elapsed_s:.1f} s with start-up", flush=True)
        return 0


if __name__ == "__main__":
    sys.exit(main())
