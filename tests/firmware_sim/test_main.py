"""The emulator's command line: bad input, serving frames and time, how it ends."""

import itertools
import json
import os
import signal
import subprocess
import sys
import tomllib

import numpy as np
import pytest
from bench_host import Nmt
from hang import HANG_S
from served_bench import MS, START_ALL, ScriptedBus, enabling_script, run_main, serve

from adacd_hil.clock import VirtualClock
from adacd_hil.log.log_files import SCENARIO_NAME
from adacd_hil.log.reader import read_log
from adacd_hil.scheduling import RealtimeGrant
from adacd_hil.settings.parsing import parse
from firmware_sim.cli.service import StopRequest
from firmware_sim.scenario.scenario import Scenario, load_scenario

SOCKETCAN = ("run", "-i", "socketcan", "-c", "no_such_can0")


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("run",), 2, "--interface"),
        (("rum",), 2, "rum"),
        ((*SOCKETCAN, "--clock", "moon"), 2, "moon"),
        ((*SOCKETCAN, "--seed", "one"), 2, "--seed"),
        ((*SOCKETCAN, "--node-offset", "29"), 2, "'--node-offset': 29 is not in the range 0<=x<=28"),
        ((*SOCKETCAN, "--node-offset", "4", "--host-node", "5"), 2, "Drive1Emcy: node id 5 is the host's"),
        ((*SOCKETCAN, "--scenario", "papper"), 2, "did you mean 'paper'"),
        ((*SOCKETCAN, "--scenario", "missing.toml"), 2, "missing.toml"),
        ((*SOCKETCAN, "--out", "fifo"), 2, "fifo"),
        ((*SOCKETCAN, "--out", __file__), 2, "test_main.py"),
        (SOCKETCAN, 5, "no_such_can0"),
        (("run", "-i", "sockedcan", "-c", "can0"), 5, "did you mean 'socketcan'"),
        (("run", "-i", "udp_multicast", "-c", "239.0.0.1"), 5, "echoes"),
    ],
)
def test_bad_input_ends_with_one_line_and_its_exit_code(monkeypatch, tmp_path, capsys, arguments, code, words):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("fifo")
    assert run_main(*arguments) == code
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert printed.err.startswith("firmware-sim: ")
    assert words in printed.err


def test_all_that_answers_a_sync_is_handed_over_at_once():
    handed_over = []
    serve([(0, *START_ALL), (1, 0x080, b"\x01"), (2, 0x080, b"\x02")], 3, send_all=handed_over.append)
    assert [can_id for can_id, _ in handed_over[-1]] == [0x181, 0x182, 0x183, 0x184]


HEARTBEAT_100_MS = (0x601, bytes([0x2B, 0x17, 0x10, 0, 100, 0, 0, 0]))


@pytest.mark.parametrize("clock_mode", ["sync", "wall"])
def test_heartbeats_come_by_the_clock_while_no_sync_does(clock_mode):
    bus, _, _ = serve([(0, *HEARTBEAT_100_MS)], 1000, clock_mode)
    beats = [t_ns for t_ns, can_id, data in bus.sent if can_id == 0x701 and data == b"\x7f"]
    assert len(beats) in (9, 10)
    assert max(later - earlier for earlier, later in itertools.pairwise(beats)) <= 111 * MS


def test_by_sync_a_steady_sync_alone_moves_the_benchs_time():
    script = [(0, *START_ALL), *((k, 0x080, bytes([1 + k % 240])) for k in range(500))]
    _, bench, _ = serve(script, 500)
    assert bench.cycle == 499
    assert bench.now_ns == 499 * MS + 10 * MS  # and one idle wait at the end


def test_by_wall_clock_frames_that_wait_while_the_process_is_held_up_are_no_silence():
    bus, _, _ = serve(enabling_script(50), 51, "wall", stall_at_ms=30)
    emergencies = [(t_ns, can_id) for t_ns, can_id, _ in bus.sent if can_id in (0x081, 0x082)]
    assert emergencies == [(51_500_000, 0x081), (51_500_000, 0x082)]  # after the last SYNC, at 50 ms


LOST_TORQUE = """
[[faults]]
kind = "lose"
node = "sensor1"
frame = "torque"
at_s = 0.01
duration_s = 0.02
[[faults]]
kind = "silence"
node = "sensor2"
since = "power_on"
at_s = 9.0
"""


@pytest.mark.slow
@pytest.mark.parametrize("clock_mode", ["sync", "wall"])
def test_the_truth_log_says_at_which_cycle_a_fault_began_and_ended(monkeypatch, capsys, tmp_path, clock_mode):
    clock = VirtualClock()
    bus = ScriptedBus(clock, StopRequest(), 0)
    bus.script.extend(((t_ms + 1) * MS, can_id, data) for t_ms, can_id, data in enabling_script(60))
    monkeypatch.setattr("firmware_sim.cli.emulator_main.MonotonicClock", lambda: clock)
    monkeypatch.setattr("firmware_sim.cli.emulator_main.wall_ns", lambda: 10**18)
    monkeypatch.setattr("firmware_sim.cli.emulator_main.open_devices_end", lambda *_: bus)
    monkeypatch.setattr("firmware_sim.cli.emulator_main.request_realtime", lambda: RealtimeGrant("SCHED_OTHER"))
    monkeypatch.setattr("firmware_sim.cli.emulator_main.freeze_garbage", lambda: None)
    scenario = tmp_path / "scenario.toml"
    scenario.write_text(LOST_TORQUE)
    options = ("--scenario", str(scenario), "--clock", clock_mode, "--out", str(tmp_path), "--once", "--json")
    assert run_main("run", "-i", "scripted", "-c", "scripted", *options) == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["cycles"] == 60
    assert told.err.splitlines()[-1] == "firmware-sim: the host was silent for 2 s, with the drives in Operational"
    log = read_log(tmp_path / "truth.mcap")
    edges = np.flatnonzero(np.diff(log.truth["faults"])) + 1
    assert [(entry.t_ns, entry.event.message.split(":")[0]) for entry in log.events] == [
        (log.truth.t_ns[edges[0]], "begins"),
        (log.truth.t_ns[edges[1]], "ends"),
    ]
    assert [log.metadata[f"fault_{index}"] for index in range(2)] == [
        "lose torque of sensor1, duration_s 0.02, at 0.01 s since enabled",
        "silence of sensor2, at 9 s since power on",
    ]
    assert parse(Scenario, tomllib.loads(log.attachments[SCENARIO_NAME].decode())) == load_scenario(str(scenario))


def test_frames_that_waited_since_before_power_on_are_dropped():
    _, bench, _ = serve([], 50, waiting=[(0, 0x080, b"\x05"), (0, *START_ALL)])
    assert bench.cycle == -1
    assert not bench.is_operational


STOP, RESET = ((0x000, bytes([command, 0])) for command in (Nmt.STOP, Nmt.RESET_COMMUNICATION))


@pytest.mark.parametrize(
    ("script", "end_ms"),
    [
        ([(100, *RESET), (3000, *START_ALL), (3500, *STOP)], 3500),
        ([(100, *RESET), (3000, *START_ALL), (3500, *RESET)], 3500),
        ([(100, *START_ALL), (101, 0x080, b"\x01"), (102, *STOP)], 102),  # without a pause
        ([(0, *START_ALL), (500, 0x000, bytes([Nmt.RESET_NODE, 1])), (1500, *STOP)], 1500),  # one node has left
        ([(3000, *START_ALL), (4000, 0x080, b"\x01")], 6000),  # 2 s after the last word of a host that started them
    ],
)
def test_once_ends_when_the_host_that_started_the_nodes_stops_or_resets_them_or_is_silent(script, end_ms):
    _, _, clock = serve(script, 60_000, is_once=True)
    assert end_ms * MS <= clock.now_ns() <= (end_ms + 20) * MS


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.wallclock
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_before_a_host_ends_it_with_exit_code_0_and_leaves_nothing(tmp_path, number):
    run = [sys.executable, "-m", "firmware_sim.cli.emulator_main", "run", "-i", "virtual", "-c", "test"]
    command = [*run, "--scenario", "idle", "--out", tmp_path / "out", "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        while (line := process.stderr.readline()) != "ready\n":
            assert line.startswith("compiling,")
        process.send_signal(number)
        out, err = process.communicate(timeout=HANG_S)
    finally:
        process.kill()
    assert (process.returncode, err) == (0, "")
    report = json.loads(out)
    assert (report["cycles"], report["truth"]) == (0, None)
    assert list(tmp_path.iterdir()) == []
