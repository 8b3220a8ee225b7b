"""Rows of faults one after the other in a lockstep run on vcan: the logs are those of the embedded bus, and candump's.

What each row does to a frame is tested in tests/firmware_sim. The host tolerates all of them, so the run ends as asked.
"""

import contextlib
import shutil
from collections import Counter
from pathlib import Path

import pytest
from experiment_runs import Played, Witness, candump, contents, emulator, run_on_vcan
from rig import SessionRig

from adacd_hil.log.log_files import TRUTH_NAME
from adacd_hil.log.reader import read_log
from adacd_hil.settings.configuration_files import load_settings
from firmware_sim.bench.bench_time import TruthLog
from firmware_sim.scenario.scenario import load_scenario

pytestmark = [pytest.mark.vcan, pytest.mark.slow]

SETTINGS = '[safety]\ntolerated_emergencies = [0x1000]\n[operator]\nscript = [{ at_s = 0.36, request = "finish" }]\n'
ROWS = {
    "lose": 'node = "sensor1", frame = "torque", count = 3',
    "duplicate": 'node = "sensor2", frame = "torque", duration_s = 0.015',
    "corrupt": 'node = "sensor1", frame = "torque", bits = 2, count = 3',
    "delay within a period": 'node = "sensor1", frame = "torque", delay_us = 300.0, duration_s = 0.015',
    "delay beyond a period": 'node = "sensor2", frame = "torque", delay_us = 1500.0, duration_s = 0.015',
    "reorder": 'node = "sensor2", frame = "torque", count = 1',
    "freeze_counter": 'node = "sensor1", frame = "torque", count = 3',
    "emcy_storm": 'node = "sensor2", code = 0x1000, rate_Hz = 500.0, duration_s = 0.015',
    "babble": 'node = "drive1", can_id = 0x7F0, rate_Hz = 2000.0, duration_s = 0.015',
    "lose SYNC": 'frame = "sync", count = 1',
}


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    folder = tmp_path_factory.mktemp("faults")
    rows = "\n".join(
        f'[[faults]]\nkind = "{name.split()[0]}"\nat_s = {0.03 * (place + 1):.2f}\n' + keys.replace(", ", "\n")
        for place, (name, keys) in enumerate(ROWS.items())
    )
    (folder / "scenario.toml").write_text(f"start_deg = [-30.0, -60.0]\nseed = 7\n{rows}\n")
    (folder / "settings.toml").write_text(SETTINGS)
    with contextlib.ExitStack() as stack:
        if shutil.which("candump"):
            stack.enter_context(candump(folder / "candump.log"))
        stack.enter_context(emulator(folder, "--scenario", str(folder / "scenario.toml")))
        return run_on_vcan(folder, "--clock", "lockstep", "--config", str(folder / "settings.toml"))


@pytest.fixture(scope="module")
def embedded(played: Played, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Play the same in this process; return where the logs are."""
    folder, files = tmp_path_factory.mktemp("embedded"), played.folder
    settings = load_settings(str(files / "settings.toml"))
    scenario = load_scenario(str(files / "scenario.toml"))
    with TruthLog(folder / TRUTH_NAME, blocking=True, scenario=scenario) as truth:
        watched = {"on_truth": truth.write, "on_event": truth.event}
        SessionRig(folder, settings, scenario, is_modelled=True, **watched).session.run()
    return folder


def test_the_host_goes_on_through_all_of_them(played: Played) -> None:
    assert (played.status, played.error_lines) == (0, [])


@pytest.mark.parametrize("name", ["run.mcap", TRUTH_NAME])
def test_the_logs_are_those_of_the_embedded_bus_bit_for_bit(played: Played, embedded: Path, name: str) -> None:
    ours, theirs = contents(embedded / name), contents(played.folder / name)
    assert [topic for topic in ours if ours[topic] != theirs.get(topic)] == []
    assert len(read_log(embedded / name).events) >= (2 * len(ROWS) if name == TRUTH_NAME else 3)


def test_candump_sees_all_that_the_log_holds(played: Played) -> None:
    if not shutil.which("candump"):
        pytest.skip("candump (Debian package can-utils) is not installed")
    witness = Witness(played.folder / "candump.log")
    seen = Counter(line.split()[2] for line in witness.lines)
    frames = read_log(played.log).frames
    logged = Counter(
        f"{frame['can_id']:03X}#{bytes(frame['data'][: frame['length']]).hex().upper()}" for frame in frames
    )
    assert logged.total() > 3_000
    assert (logged - seen).total() <= witness.dropped  # what candump had no room for, the kernel has counted
