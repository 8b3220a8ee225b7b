"""Kills host, logger or emulated arm on a vcan, one process each, for damage_campaign.py.

host            its logger ends the log; the drives' watchdogs stop the arm
logger          the cycle goes on; what is in the file is saved by recover
emulator        the host says who is gone, ends with its documented status, and closes its log
host and logger, host and emulator   the same at once
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from kill_trials import LOSS_BOUND_S
from side_by_side import BIN, CHANNEL, TimingError, host_run, patient_config, running, wait_for

from adacd_hil.cli.output import ExitCode
from adacd_hil.lab.logs.check.log_check import check_log
from adacd_hil.lab.logs.recover import recover
from adacd_hil.log.log_files import LOG_NAME, TRUTH_NAME, LogError
from adacd_hil.log.reader import read_log
from adacd_hil.log.types.truth_topic import TRUTH
from adacd_hil.records import SchemeState

VICTIMS = ("host", "logger", "emulator", "host and logger", "host and emulator")
EARLIEST_S, LATEST_S = 1.5, 6.0
"""When somebody is killed, since the cycles began."""
PERIOD_US = 4000
"""Of the host's cycle. At 2 ms the one processor of a guest leaves the logger no time, and the log lags by seconds;
stalls of 50 ms are longer then than the 25.5 periods for which a drive can be told to do without SYNC."""
SETTINGS = """
[operator]
acknowledge_faults = 0
[controller]
Kp = [62.5, 5.0]
Kd = [6.25, 0.375]
"""
"""The arm's own gains are too much for this cycle; after a fault there is nobody to be killed."""
WATCHED_S = 2.0
"""How long the others go on."""
REST_S = 1.0
"""A drive brakes for a second at the most."""
STILL_RAD_S = 0.02
ATTEMPTS = 3


@dataclass
class VcanKill:
    """One kill. cycles: in the log. status, said: the host's and its last fault; None and empty of a victim.

    lost_s: from the last cycle in the log to the kill, where the host was killed. drives: their last states.
    """

    seed: int
    victim: str
    cycles: int = 0
    status: int | None = None
    said: str = ""
    lost_s: float = 0.0
    drives: list[str] = field(default_factory=list)
    rest_s: float | None = None
    violations: list[str] = field(default_factory=list)


def kill_on_vcan(seed: int) -> VcanKill:
    """Play a run, kill somebody, judge what is left; again where the run ended before."""
    problem = ""
    for _ in range(ATTEMPTS):
        with tempfile.TemporaryDirectory() as name:
            try:
                return _attempt(seed, Path(name))
            except TimingError as reason:
                problem = str(reason)
                print(f"seed {seed}: {problem}", file=sys.stderr)
    return VcanKill(seed, VICTIMS[seed % len(VICTIMS)], violations=[f"{ATTEMPTS} runs ended before: {problem}"])


def _attempt(seed: int, folder: Path) -> VcanKill:
    result = VcanKill(seed, VICTIMS[seed % len(VICTIMS)])
    wait_s = float(np.random.default_rng(seed).uniform(EARLIEST_S, LATEST_S))
    config = patient_config(folder, "certified", PERIOD_US, SETTINGS)
    with ExitStack() as stack:
        arm = _arm(folder)
        stack.callback(_kill, arm)
        begun = stack.enter_context(running(host_run(CHANNEL, folder, config), folder))
        time.sleep(wait_s)  # when the kill comes is drawn by lot
        if begun.process.poll() is not None:
            raise TimingError(f"the host ended by itself, exit status {begun.process.returncode}")
        killed_ns = time.time_ns()
        if begun.logger_pid is None:
            raise TimingError("the host has no logger")
        victims = _pids(result.victim, begun.process.pid, begun.logger_pid, arm.pid)
        for pid in reversed(victims):  # a logger ends when its host does
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                raise TimingError(f"process {pid} ended by itself") from None
        time.sleep(WATCHED_S)  # what the survivors do in this time is what is recorded
        if "host" not in result.victim:
            result.status = begun.end()
            result.said = str(begun.told.get("fault", ""))
        _await_closed(folder / "host" / LOG_NAME)
        if "emulator" not in result.victim:
            arm.terminate()
            said, _ = arm.communicate(timeout=30.0)
            result.drives = json.loads(said)["drive_states"]
    _judge(result, folder, killed_ns)
    return result


def _arm(folder: Path) -> "subprocess.Popen[str]":
    """Start the emulated arm; its time goes by the clock, so that it falls to its own watchdogs."""
    command = [BIN / "firmware-sim", "run", "-i", "socketcan", "-c", CHANNEL, "--clock", "wall", "--scenario", "idle"]
    complaints = folder / "emulator.stderr"
    with complaints.open("w") as stderr:
        process = subprocess.Popen(
            [*command, "--out", folder, "--json"], stdout=subprocess.PIPE, stderr=stderr, text=True
        )
    wait_for("ready", process, complaints)
    return process


def _kill(process: "subprocess.Popen[str]") -> None:
    if process.poll() is None:
        process.kill()
    process.communicate()


def _pids(victim: str, host: int, logger: int, arm: int) -> list[int]:
    by_name = {"host": host, "logger": logger, "emulator": arm}
    return [by_name[name] for name in victim.split(" and ")]


def _await_closed(path: Path) -> None:
    """Wait until nobody has a file open, so that an orphaned logger has ended it."""
    end_s = time.monotonic() + 30.0
    while time.monotonic() < end_s and _is_open(path):
        time.sleep(0.05)  # a stranger's process: nothing tells when it closes a file


def _is_open(path: Path) -> bool:
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            if any(link.resolve() == path.resolve() for link in (entry / "fd").iterdir()):
                return True
        except OSError:
            continue
    return False


def _judge(result: VcanKill, folder: Path, killed_ns: int) -> None:
    """Look at log, truth and exit status."""
    path = folder / "host" / LOG_NAME
    is_cut = "logger" in result.victim
    checked = check_log(path)
    if not is_cut and checked.errors:
        result.violations.append(f"the log was to be ended, and check finds {checked.findings[0].text}")
    if is_cut:
        try:
            path = recover(path).out
        except LogError as error:
            result.violations.append(f"recover: {error}")
            return
    log = read_log(path)
    result.cycles = len(log.cycle)
    if not result.cycles:
        result.violations.append("no cycle was saved")
        return
    faults_ns = log.scheme.t_ns[log.scheme["state"] == SchemeState.FAULT]
    if len(faults_ns) and log.epoch_ns + int(faults_ns[0]) < killed_ns:
        raise TimingError("the host had stopped the arm by itself")
    if "host" in result.victim:
        result.lost_s = (killed_ns - log.epoch_ns - int(log.cycle.t_ns[-1])) * 1e-9
    if result.lost_s > LOSS_BOUND_S:
        result.violations.append(f"lost {result.lost_s:.3f} s, more than {LOSS_BOUND_S:g} s")
    messages = [logged.event.message for logged in log.events]
    told = status_violations(result.victim, result.status, messages)
    result.violations += [f"{text}; it says {result.said or 'nothing'}" for text in told]
    if "emulator" not in result.victim:
        result.violations += drive_violations(result.drives)
        truth = read_log(folder / TRUTH_NAME, (TRUTH.name,)).truth
        result.rest_s = rest_s(truth.t_ns, truth["dq"], killed_ns)
        if result.victim.startswith("host") and (result.rest_s is None or result.rest_s > REST_S):
            result.violations.append("the truth does not show the arm at rest")


def status_violations(victim: str, status: int | None, messages: Sequence[str]) -> list[str]:
    """Say what is wrong with the end of a host that was not the victim itself."""
    if victim == "emulator":
        if status != ExitCode.SAFETY_STOP:
            return [f"the arm has gone, and the host ended with status {status}, {ExitCode.SAFETY_STOP} expected"]
        return [] if any("FAULT" in text or "Drive1" in text for text in messages) else ["nobody says what has gone"]
    if victim == "logger" and status != ExitCode.PARTIAL:
        return [f"the log was cut, and the host ended with status {status}, {ExitCode.PARTIAL} expected"]
    return []


def drive_violations(states: Sequence[str]) -> list[str]:
    """Say which drives of a run that is over are still enabled."""
    return [f"drive {joint + 1} ends in {state}" for joint, state in enumerate(states) if state == "operation enabled"]


def rest_s(times_ns: Any, speed_rad_s: Any, killed_ns: int) -> float | None:
    """Return when the arm came to rest for good, s after the kill; None: the truth ends before, or it moves on."""
    after = times_ns > killed_ns
    if not after.any():
        return None
    moving = np.flatnonzero(after & (np.abs(speed_rad_s).max(axis=1) > STILL_RAD_S))
    if not len(moving):
        return 0.0
    last = int(moving[-1])
    return None if last == len(times_ns) - 1 else float(times_ns[last + 1] - killed_ns) * 1e-9
