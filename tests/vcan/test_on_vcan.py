"""Host and emulated arm as two processes on real SocketCAN."""

import contextlib
import json
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from experiment_runs import BIN, Played, Witness, candump, contents, demo, emulator, run_on_vcan

from adacd_hil.log.reader import read_log
from adacd_hil.settings.configuration_files import load_settings

pytestmark = [pytest.mark.vcan, pytest.mark.slow]

SEED = "7"
FIRST_CONTACT = """
extends = "demo_paper"
[operator]
script = [{ at_s = 4.5, request = "finish" }]
[termination]
hold_s = 1.5
[trajectory]
half_period_s = [1.125, 2.25]
"""
PUSH = """
about = "One push, soon."
lasts_s = 4.5
start_deg = [-30.0, -60.0]
[[contacts]]
at_s = 3.2
link = 1
point_m = 0.3
force_N = 10.0
duration_s = 0.5
"""
"""A short adaptation, one contact and the reaction to it: what comes after is the same code."""
TWO_CONTACTS = 'extends = "demo_paper"\n[operator]\nscript = [{ at_s = 14.5, request = "finish" }]\n'


@pytest.fixture(scope="module")
def lockstep(tmp_path_factory: pytest.TempPathFactory) -> Played:
    """Play an adaptation and a contact in lockstep, with candump listening."""
    folder = tmp_path_factory.mktemp("lockstep")
    (folder / "settings.toml").write_text(FIRST_CONTACT)
    (folder / "push.toml").write_text(PUSH)
    dump = folder / "candump.log"
    with contextlib.ExitStack() as stack:
        if shutil.which("candump"):
            stack.enter_context(candump(dump))
        stack.enter_context(emulator(folder, "--seed", SEED, "--scenario", str(folder / "push.toml")))
        return run_on_vcan(folder, "--clock", "lockstep", "--config", str(folder / "settings.toml"))


@pytest.mark.long
def test_lockstep_on_vcan_finds_the_contact_and_logs_the_same_as_the_embedded_bus_bit_for_bit(
    lockstep: Played, tmp_path: Path
) -> None:
    assert (lockstep.status, lockstep.json["state"], lockstep.json["dropped"]) == (0, "MONITOR", 0)
    assert {report.link for _, report in read_log(lockstep.log).contacts} == {1}
    files = [str(lockstep.folder / name) for name in ("settings.toml", "push.toml")]
    embedded = demo(tmp_path, "--seed", SEED, "--config", files[0], "--scenario", files[1])
    for name in ("run.mcap", "truth.mcap"):
        ours, theirs = (contents(folder / name) for folder in (embedded.folder, lockstep.folder))
        assert [topic for topic in ours if ours[topic] != theirs.get(topic)] == []
        assert len(ours["/truth" if name == "truth.mcap" else "/cycle"]) > 300_000


@pytest.fixture(scope="module")
def witness(lockstep: Played) -> Witness:
    if not shutil.which("candump"):
        pytest.skip("candump (Debian package can-utils) is not installed")
    return Witness(lockstep.folder / "candump.log")


@pytest.mark.long
def test_candump_sees_all_that_the_log_holds(lockstep: Played, witness: Witness) -> None:
    seen = Counter(line.split()[2] for line in witness.lines)
    frames = read_log(lockstep.log).frames
    logged = Counter(
        f"{frame['can_id']:03X}#{bytes(frame['data'][: frame['length']]).hex().upper()}" for frame in frames
    )
    unseen = (logged - seen).total()
    assert logged.total() > 25_000
    assert unseen <= witness.dropped  # what candump had no room for, the kernel has counted
    if witness.dropped:
        pytest.skip(f"candump had no room for {witness.dropped} frames on this machine, {unseen} of them logged")


STALLING = """
[bus]
command_patience_cycles = 250
max_age_cycles = 100
[realtime]
misses = 1000000
sample_period = "nominal"
"""


@pytest.mark.wallclock
@pytest.mark.realtime
def test_real_time_at_1_khz_detects_the_same_contacts(tmp_path: Path) -> None:
    # A shared machine stalls for longer than an arm should forgive. Here it may: stalls are counted, not hidden, and
    # contacts are judged only where the bus kept up as it has to on an arm.
    config = tmp_path / "patient.toml"
    config.write_text(TWO_CONTACTS + STALLING)
    with emulator(tmp_path, "--seed", SEED):
        played = run_on_vcan(tmp_path, "--config", str(config), "--clock", "realtime")
    stall = longest_stall_cycles(played.log)
    if stall > load_settings().bus.max_age_cycles:
        assert played.status in (0, 3, 4), played.stderr  # through, with a gap in the log, or stopped
        pytest.skip(
            f"the machine stalled for {stall} ms, so the contacts can't be compared; exit status {played.status}"
        )
    assert (played.status, played.json["dropped"]) == (0, 0), played.stderr
    report = subprocess.run(
        [BIN / "adacd-hil", "report", str(tmp_path), "--json"], capture_output=True, text=True, check=True
    )
    (described,) = json.loads(report.stdout)
    contacts = described["contacts"]
    assert (len(contacts), described["missed"], described["false_alarms"]) == (2, 0, 0)
    assert [contact["link_detected"] for contact in contacts] == [1, 1]
    assert all(contact["direction_ok"] for contact in contacts)
    assert described["cycle"]["clock"] == "realtime"


def longest_stall_cycles(path: Path) -> int:
    """Return the longest time without complete data in a log, in cycles, skipped ones included."""
    cycles = read_log(path).topics["/cycle"]
    complete = cycles["cycle"][cycles["frames_missing"] == 0]
    return int(np.diff(complete).max(initial=1)) - 1
