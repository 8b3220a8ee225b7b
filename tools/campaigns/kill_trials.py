"""Runs of the experiment in real time that are killed, for damage_campaign.py: what recover must save of each.

The host and the emulated arm are one process, the writer of the log is another. The emulator has a log and a writer of
its own, which nobody kills: it tells which cycle was the last.
"""

import contextlib
import os
import select
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from damage_trials import messages_of

from adacd_hil.lab.logs.check.log_check import check_log
from adacd_hil.lab.logs.recover import recover
from adacd_hil.log.log_files import LOG_NAME, TRUTH_NAME, LogError
from adacd_hil.log.reader import read_log
from adacd_hil.log.types.topics import CONTROL, CYCLE, JOINT_STATES, SCHEME

VICTIMS = ("writer", "control", "both")
LOSS_BOUND_S = 0.3
MOST_S = 4.0
"""Latest moment to kill, after the first cycles are on the disk."""
START_S = 600.0
"""Longest until then: everything is compiled before, the first time for minutes on a busy machine."""
ATTEMPTS = 3
"""A run that ends by itself before its moment, as one does that finds no time to compute, is played again."""
ROOT = Path(__file__).resolve().parents[2]
_DEMO = "from adacd_hil.cli.main import main; main()"


@dataclass(frozen=True)
class KillResult:
    """One killed run. `cycles`: saved; `lost_s`: from the last of them to the last that there was."""

    seed: int
    victim: str
    cycles: int
    lost_s: float
    exit_status: int
    violations: list[str]


class RunEndedError(Exception):
    """A run that ended before it was killed."""


def kill_trial(seed: int, folder: Path) -> KillResult:
    """Start a run, kill it, recover its log, judge the result."""
    for attempt in range(ATTEMPTS):
        try:
            return _attempt(seed, folder / str(attempt))
        except RunEndedError as error:
            print(f"seed {seed}: {error}", file=sys.stderr)
    return KillResult(seed, "none", 0, 0.0, 1, [f"{ATTEMPTS} runs ended before they were killed"])


def _attempt(seed: int, folder: Path) -> KillResult:
    victim = VICTIMS[seed % len(VICTIMS)]
    wait_s = float(np.random.default_rng(seed).uniform(0.0, MOST_S))
    command = [sys.executable, "-c", _DEMO, "demo", "--clock", "realtime", "--out", str(folder)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        path = folder / LOG_NAME
        try:
            writer = _wait_for_cycles(process, path)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(wait_s)
                raise RunEndedError(f"the run ended by itself, exit status {process.returncode}")
            killed_ns = time.monotonic_ns()
            _kill(victim, process.pid, writer)
            _wait_for_end(writer)
        finally:
            process.kill()
    return _judge(seed, victim, path, _last_cycle_ns(folder / TRUTH_NAME, killed_ns))


def _kill(victim: str, control: int, writer: int) -> None:
    if victim != "writer":
        os.kill(control, signal.SIGKILL)
    if victim != "control":
        try:
            os.kill(writer, signal.SIGKILL)
        except ProcessLookupError:
            if victim == "writer":
                raise RunEndedError("the log had ended") from None


def _last_cycle_ns(path: Path, killed_ns: int) -> int:
    """Return when the last cycle before the kill was, by the emulator's log, whose writer nobody killed."""
    end_s = time.monotonic() + START_S
    while (log := read_log(path)).problem and time.monotonic() < end_s:
        time.sleep(0.1)  # a stranger's file: there is nothing else to wait on
    times_ns = log.truth.t_ns
    return int(times_ns[times_ns <= killed_ns][-1])


def _wait_for_cycles(process: "subprocess.Popen[bytes]", path: Path) -> int:
    """Wait until cycles are on the disk; return the pid of the log's writer."""
    end_s = time.monotonic() + START_S
    while time.monotonic() < end_s:
        if process.poll() is not None:
            raise RunEndedError(f"the run ended by itself, exit status {process.returncode}")
        time.sleep(0.1)  # another process writes the file: there is nothing else to wait on
        if path.exists() and len(read_log(path, (CYCLE.name,)).cycle):
            return _writer_of(process.pid, path)
    raise RunEndedError(f"no cycle within {START_S:g} s")


def _writer_of(control: int, path: Path) -> int:
    """Find the child that has the log open."""
    children = Path(f"/proc/{control}/task/{control}/children").read_text().split()
    for child in map(int, children):
        links = (link.resolve() for link in Path(f"/proc/{child}/fd").iterdir())
        if path.resolve() in links:
            return child
    raise RunEndedError("nobody has the log open")


def _wait_for_end(pid: int) -> None:
    try:
        descriptor = os.pidfd_open(pid)
    except ProcessLookupError:
        return
    select.select([descriptor], [], [], START_S)
    os.close(descriptor)


def _judge(seed: int, victim: str, path: Path, last_ns: int) -> KillResult:
    before = messages_of(path)  # whatever mcap's reader finds up to the damage
    checked = check_log(path)
    violations = []
    if victim != "control" and not checked.errors:
        violations.append("check finds nothing")
    if victim == "control" and checked.errors:
        violations.append(f"the writer ended the log, and check finds {checked.findings[0].text}")
    try:
        recovery = recover(path)
    except LogError as error:
        return KillResult(seed, victim, 0, 0.0, 1, [str(error)])
    log = read_log(recovery.out)
    cycle = log.cycle["cycle"]
    if log.problem or check_log(recovery.out).errors:
        violations.append("the recovered log fails its check")
    if messages_of(recovery.out) != before:
        violations.append("the recovered log has other messages than mcap's reader finds before the damage")
    missing = int(cycle[-1] - cycle[0]) + 1 - len(cycle)
    skipped = int(log.cycle["overruns"][-1] - log.cycle["overruns"][0])  # by a host that was late
    if missing != skipped:
        violations.append(f"{missing} cycles are missing in between, of which the host skipped {skipped}")
    topics = {name: len(log.topics[name]) for name in (SCHEME.name, CONTROL.name, JOINT_STATES.name)}
    if any(abs(count - len(cycle)) > 1 for count in topics.values()):
        violations.append(f"{len(cycle)} cycles, but {topics}")
    lost_s = max(0, last_ns - int(log.cycle.t_ns[-1])) * 1e-9
    if lost_s > LOSS_BOUND_S:
        violations.append(f"lost {lost_s:.3f} s, more than {LOSS_BOUND_S:g} s")
    if victim != "control" and not recovery.losses.is_any:
        violations.append("recover says that nothing was lost")
    return KillResult(seed, victim, len(cycle), lost_s, 3 if recovery.losses.is_any else 0, violations)
