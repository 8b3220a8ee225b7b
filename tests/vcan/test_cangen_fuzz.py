"""cangen at full rate on the arm's own bus: what host and emulated devices still promise while it floods them.

Random identifiers hit everything that CANopen leaves unprotected: SYNC moves the devices, NMT stops them, SDO answers
and status frames lie. So no run through such a flood is promised to succeed. Promised is: no crash and no hang; the run
ends with a documented status, and one that was cut short is a safety stop (4) or devices missing (5); whatever the run
took is in a readable log, its bad frames counted; afterwards no drive is enabled; the emulator serves the next run,
which, when the flood is over, succeeds as if nothing had been. An arm that nobody enables stays without torque. A flood
on an identifier that isn't the arm's is filtered in the kernel and changes no decision, to the bit.

Flooded runs are a campaign, `tools/campaigns/fuzz.py --cangen 60`; it sets the environment variable ADACD_HIL_FUZZ_S.
"""

import contextlib
import itertools
import json
import os
import shutil
import socket
import struct
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from experiment_runs import Played, emulator, run_on_vcan
from topic_bytes import topic_bytes

from adacd_hil.log.reader import read_log

pytestmark = [
    pytest.mark.vcan,
    pytest.mark.slow,
    pytest.mark.wallclock,
    pytest.mark.skipif(shutil.which("cangen") is None, reason="cangen (Debian package can-utils) is not installed"),
]

CAMPAIGN = pytest.mark.skipif("ADACD_HIL_FUZZ_S" not in os.environ, reason="a campaign: fuzz.py --cangen 60")
DURATION_S = float(os.environ.get("ADACD_HIL_FUZZ_S", "5"))
FLOOD = 20_000
"""Frames of random identifiers at an arm that nobody enables: 10 of each."""
RANDOM = ("-I", "r", "-L", "r", "-D", "r")
FOREIGN = ("-I", "3FF", "-L", "r", "-D", "r")
IMPATIENT = "[bus]\nfeedback_timeout_ms = 100\n"
"""In lockstep each cycle waits that long for a node that a random NMT command has silenced, half a second of cycles
after the fault included."""
GAPS_MS = ("2", "0")
"""Between frames of random identifiers. At full rate hardly a run gets through its boot; at 2 ms most do, and the flood
meets a moving arm."""
FOREIGN_GAP_MS = "0.2"
"""On an identifier that isn't the arm's. At full rate cangen leaves a machine with one CPU no time for the run."""
SHORT_RUN = '[operator]\nscript = [{ at_s = 0.5, request = "finish" }]\n'
OK, PARTIAL, SAFETY_STOP, BUS_MISSING = 0, 3, 4, 5
SAFE_STATES = {
    "not ready to switch on",
    "switch on disabled",
    "ready to switch on",
    "switched on",
    "fault reaction active",
    "fault",
}


@contextlib.contextmanager
def emulated_arm(folder: Path, outcome: list[dict[str, object]]) -> Iterator["subprocess.Popen[str]"]:
    """Run the emulator; after the block `outcome` holds what it reported, and it has ended by itself with status 0."""
    with emulator(folder, "--scenario", "idle", "--json") as process:
        yield process
        assert process.poll() is None, "the emulator ended during the flood"
    stdout, stderr = process.said
    assert (process.returncode, "Traceback" in stderr) == (0, False), stderr
    outcome.append(json.loads(stdout))


@contextlib.contextmanager
def cangen(*arguments: str, gap_ms: str = "0") -> Iterator[None]:
    """Flood vcan0 while the block lasts; a full transmit queue doesn't end it."""
    with subprocess.Popen(["cangen", "vcan0", "-g", gap_ms, "-i", *arguments]) as process:
        try:
            yield
            assert process.poll() is None, "cangen ended by itself"
        finally:
            process.terminate()


def await_feedback() -> None:
    """Start the nodes and send SYNC until drive 1 answers: then it has heard all that came before."""
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as can:
        can.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, struct.pack("=II", 0x181, 0x7FF))
        can.bind(("vcan0",))
        can.settimeout(0.1)
        for counter in itertools.count():
            for can_id, data in ((0x000, b"\1\0"), (0x080, bytes([1 + counter % 240]))):
                can.send(struct.pack("=IB3x8s", can_id, len(data), data))
            with contextlib.suppress(TimeoutError):
                can.recv(16)
                return


def short_run(folder: Path, extra: str = "") -> Played:
    """Boot, enable, adapt for half a second, park; `extra` is more of the configuration."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "short.toml").write_text(SHORT_RUN + extra)
    return run_on_vcan(folder, "--clock", "lockstep", "--config", str(folder / "short.toml"))


def check_ending(played: Played) -> None:
    """The host ended in a documented way, said why, and left a readable log."""
    assert "Traceback" not in played.stderr, played.stderr
    assert played.status in (OK, PARTIAL, SAFETY_STOP, BUS_MISSING), played.stderr
    if played.status in (OK, PARTIAL, SAFETY_STOP) and "state" in played.json:
        is_faulted = played.json["state"] == "FAULT"
        assert is_faulted is (played.status == SAFETY_STOP)
    if played.status == BUS_MISSING:
        assert len(played.error_lines) == 1, played.stderr
    read_log(played.log)


@CAMPAIGN
def test_runs_through_a_flood_of_random_frames_end_safely_and_the_next_one_succeeds(tmp_path: Path) -> None:
    outcome: list[dict[str, object]] = []
    endings: list[int] = []
    with emulated_arm(tmp_path, outcome):
        end_s = time.monotonic() + DURATION_S
        while len(endings) < len(GAPS_MS) or time.monotonic() < end_s:
            gap_ms = GAPS_MS[len(endings) % len(GAPS_MS)]
            with cangen(*RANDOM, gap_ms=gap_ms):
                played = short_run(tmp_path / f"run{len(endings)}", IMPATIENT)
            check_ending(played)
            endings.append(played.status)
        after = short_run(tmp_path / "after")
    print(f"cangen: {len(endings)} runs, exit statuses {sorted(endings)}")
    assert after.status == OK, after.stderr
    (described,) = outcome
    assert set(described["drive_states"]) <= SAFE_STATES  # type: ignore[call-overload]


@pytest.mark.long
def test_a_flood_of_random_frames_moves_no_arm_that_nobody_enables(tmp_path: Path) -> None:
    outcome: list[dict[str, object]] = []
    with emulated_arm(tmp_path, outcome):
        subprocess.run(["cangen", "vcan0", "-g", "0", "-i", "-n", str(FLOOD), *RANDOM], check=True)
        await_feedback()
    (described,) = outcome
    assert set(described["drive_states"]) <= SAFE_STATES  # type: ignore[call-overload]
    truth = read_log(tmp_path / "truth.mcap").topics.get("/truth")
    assert truth is not None
    assert len(truth.t_ns) > 0
    assert float(abs(truth["tau_J"]).max()) == 0.0


@CAMPAIGN
def test_a_flood_that_is_not_the_arms_changes_no_decision(tmp_path: Path) -> None:
    outcome: list[dict[str, object]] = []
    with emulated_arm(tmp_path, outcome):
        quiet = short_run(tmp_path / "quiet")
    with emulated_arm(tmp_path, outcome), cangen(*FOREIGN, gap_ms=FOREIGN_GAP_MS):
        flooded = short_run(tmp_path / "flooded")
    assert (quiet.status, flooded.status) == (OK, OK), flooded.stderr
    for topic in ("/scheme", "/control"):
        assert topic_bytes(flooded.log, topic) == topic_bytes(quiet.log, topic)
    assert [described["rejected_commands"] for described in outcome] == [[0, 0], [0, 0]]
