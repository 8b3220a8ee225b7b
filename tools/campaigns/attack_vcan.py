"""Plays attacks on a real vcan interface, for attack_campaign.py: emulator, host and attacker, each a process.

Emulator and host run in real time. A run that ends by itself before the attack begins, as one does on a machine that
stalls, is played again. Besides the attacks of attacks.py: what a second user does, and a host that is killed.
"""

import contextlib
import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from attacked_run import ATTACK_S, STOPS, Finding, expected_lines, finding, first_notice, scenario_of
from attacks import ATTACKS, MS, AttackCase, Forger, Repeated, find_attack
from side_by_side import BIN, ROOT, TimingError, emulator

from adacd_hil.log.log_files import LOG_NAME, TRUTH_NAME
from adacd_hil.log.reader import read_log
from adacd_hil.log.types.topics import EVENTS, SCHEME
from adacd_hil.log.types.truth_topic import TRUTH
from adacd_hil.settings.toml_text import to_toml

START_S = 600.0
"""Longest until the arm moves: everything is compiled before, the first time for minutes on a busy machine."""
END_S = 30.0
"""Longest from the end of an attack to the end of the host: it is asked to end by SIGTERM then."""
AFTER_S = 1.5
"""How long the arm is watched after the host has gone."""
ATTEMPTS = 4
ARMED_TO_ATTACK_S = 0.3
"""Least time between MONITOR and the attack."""

SECOND_USERS = {
    "second-run": ("run",),
    "second-commtest": ("commtest", "--seconds", "1"),
    "second-tare": ("tare",),
    "second-doctor": ("doctor",),
    "second-scan": ("scan",),
}
"""What somebody else may type beside a run, by name."""
READ_ONLY = ("second-scan",)
KILLED = "host-killed"
"""The host is killed; somebody else goes on with its heartbeat."""


class VoidError(Exception):
    """A run that ended before it could be attacked."""


PATIENCE = """
command_patience_cycles = 25
max_age_cycles = 10"""
BESIDE_A_START = """
command_patience_cycles = 250
max_age_cycles = 100
heartbeat_ms = 1000"""
"""Where a program starts beside the run: on the one processor of a guest that stops the others for half a second."""
SLOW_US = 5000
"""From this period on the arm is led more softly; at 10 ms its own gains are in a limit cycle."""


def config_of(name: str, period_us: int) -> str:
    """Return the host's settings: a slower cycle, and patience with a machine that stalls."""
    soft = "[controller]\nKp = [62.5, 5.0]\nKd = [6.25, 0.375]\n" if period_us >= SLOW_US else ""
    return f"""
extends = "certified"
[bus]
period_us = {period_us}
sync_patience_periods = 25.0{BESIDE_A_START if name in SECOND_USERS else PATIENCE}
[realtime]
misses = 1000000
[arm]
profile = "P"
[operator]
script = []
acknowledge_after_s = 0.0
{soft}"""


def names() -> list[str]:
    """Return everything that can be played here."""
    return ["nothing", *(case.name for case in ATTACKS), *SECOND_USERS, KILLED]


@dataclass
class Host:
    """A host that runs; its stderr is read by a thread, with the time of each line on the monotonic clock."""

    process: "subprocess.Popen[str]"
    lines: list[tuple[float, str]] = field(default_factory=list)
    has_ended: bool = False
    _news: threading.Condition = field(default_factory=threading.Condition)

    def listen(self) -> None:
        """Read stderr until it ends."""
        assert self.process.stderr is not None
        for line in self.process.stderr:
            with self._news:
                self.lines.append((time.monotonic(), line.rstrip()))
                self._news.notify_all()
        with self._news:
            self.has_ended = True
            self._news.notify_all()

    def await_line(self, text: str, timeout_s: float) -> float:
        """Wait until a line has `text`; return when it came. Raises VoidError."""
        with self._news:
            self._news.wait_for(lambda: self.has_ended or self._said(text), timeout_s)
            said = self._said(text)
        if said:
            return said[0]
        if not self.has_ended:
            raise VoidError(f"no {text!r} within {timeout_s:g} s")
        last = self.lines[-1][1] if self.lines else "nothing"
        raise VoidError(f"the host ended with status {self.process.wait(END_S)}, its last line: {last}")

    def _said(self, text: str) -> list[float]:
        return [at_s for at_s, line in self.lines if text in line]

    def lives_until(self, at_s: float) -> bool:
        """Wait until a time on the monotonic clock; false, and at once, where the host ends before."""
        with self._news:
            return not self._news.wait_for(lambda: self.has_ended, max(0.0, at_s - time.monotonic()))


@contextlib.contextmanager
def host(channel: str, config: Path, out: Path) -> Iterator[Host]:
    """Run a host while the block lasts."""
    command = [BIN / "adacd-hil", "run", "-i", "socketcan", "-c", channel, "--config", config, "--out", out]
    with subprocess.Popen(
        [*command, "--clock", "realtime", "--json"],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        running = Host(process)
        listener = threading.Thread(target=running.listen, daemon=True)
        listener.start()
        try:
            yield running
        finally:
            if process.poll() is None:
                process.kill()
            process.wait()
            listener.join(5.0)


def play_on_vcan(name: str, channel: str, period_us: int, folder: Path) -> Finding:
    """Play one attack; again where the machine spoilt it."""
    for attempt in range(ATTEMPTS):
        place = folder / f"{name}-{attempt}"
        place.mkdir(parents=True, exist_ok=True)
        try:
            return _attempt(name, channel, period_us, place)
        except (VoidError, TimingError) as reason:
            print(f"{name}: {reason}", file=sys.stderr)
    return _void(name)


def _void(name: str) -> Finding:
    return Finding(name, "", 0, None, "", False, None, None, None, 0.0, 0.0, 0.0, "spoilt by the machine", "VOID")


def case_of(name: str) -> AttackCase:
    """Return the row of an attack; of a second user one that nobody plays on a socket."""
    if name in {case.name for case in ATTACKS}:
        return find_attack(name)
    if name == KILLED:
        about = "the host is killed; its heartbeat goes on"
    elif name in SECOND_USERS:
        about = f"adacd-hil {' '.join(SECOND_USERS[name])} beside the run"
    else:
        about = "nobody attacks"
    return AttackCase(name, about, _nobody, must_stop=name == KILLED, named_by="another|somebody|in use|drives|already")


def _nobody(forger: Forger) -> Repeated:
    return Repeated(forger, (), 1000 * MS, 0)


def _attempt(name: str, channel: str, period_us: int, folder: Path) -> Finding:
    case = case_of(name)
    config = folder / "attack.toml"
    config.write_text(config_of(name, period_us))
    status, second = None, ""
    with contextlib.ExitStack() as stack:
        attacker = stack.enter_context(_attacker(name, channel, case.lasts_s))
        scenario = folder / "scenario.toml"
        scenario.write_text(to_toml(scenario_of(case)))
        options = ("--clock", "wall", "--scenario", str(scenario), "--out", str(folder))
        arm = stack.enter_context(emulator(channel, *options, folder=folder))
        running = stack.enter_context(host(channel, config, folder))
        enabled_s = running.await_line("ENABLE -> ADAPT", START_S)
        armed_s = running.await_line("-> MONITOR", 60.0)
        if not running.lives_until(max(enabled_s + ATTACK_S, armed_s + ARMED_TO_ATTACK_S)):
            raise VoidError("the host ended before the attack")
        begin_ns = time.time_ns()
        if attacker is not None:
            told = _go(attacker, case.lasts_s)
            begin_ns = int(told["first_ns"] or told["begin_ns"])
        elif name in SECOND_USERS:
            status, second = _second_user(name, channel, config, folder)
        elif name == KILLED:
            running.process.kill()
            told = _go(stack.enter_context(_heartbeats(channel)), case.lasts_s)
        else:
            running.lives_until(time.monotonic() + case.lasts_s)
            told = {"forged": 0}
        forged = 0 if name in SECOND_USERS else int(told["forged"])
        ended = _end(running)
        with contextlib.suppress(subprocess.TimeoutExpired):
            arm.wait(AFTER_S)
    return _judge(case, folder, begin_ns, forged, ended, status, second)


@contextlib.contextmanager
def _attacker(name: str, channel: str, seconds: float) -> Iterator["subprocess.Popen[str] | None"]:
    """Start the attacker, ready to begin; None where the attack is none of frames."""
    if name not in {case.name for case in ATTACKS}:
        yield None
        return
    command = [sys.executable, ROOT / "tools" / "campaigns" / "attacker.py", name, channel, "--seconds", str(seconds)]
    with _waiting(command) as process:
        yield process


@contextlib.contextmanager
def _heartbeats(channel: str) -> Iterator["subprocess.Popen[str]"]:
    command = [
        sys.executable,
        ROOT / "tools" / "campaigns" / "attacker.py",
        "heartbeat-of-host",
        channel,
        "--seconds",
        "1.5",
    ]
    with _waiting(command) as process:
        yield process


@contextlib.contextmanager
def _waiting(command: list[Any]) -> Iterator["subprocess.Popen[str]"]:
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            if process.stdout.readline().strip() != "ready":
                raise VoidError("the attacker did not start")
            yield process
        finally:
            process.kill()


def _go(attacker: "subprocess.Popen[str]", seconds: float) -> dict[str, Any]:
    """Let the attacker begin, wait for its end, return what it tells."""
    assert attacker.stdin is not None
    assert attacker.stdout is not None
    attacker.stdin.write("go\n")
    attacker.stdin.flush()
    line = attacker.stdout.readline()
    if not line:
        raise VoidError(f"the attacker ended without a word after {seconds:g} s")
    told: dict[str, Any] = json.loads(line)
    return told


def _second_user(name: str, channel: str, config: Path, folder: Path) -> tuple[int, str]:
    """Run another command on the same arm; return its exit status and its last two lines.

    It gets the time that is left: a guest has one processor, and a program that starts takes it from the emulated
    devices, which no second user of an arm does.
    """
    out = folder / "second"
    out.mkdir(exist_ok=True)
    command, *further = SECOND_USERS[name]
    arguments = [command, "-i", "socketcan", "-c", channel, "--config", str(config), *further]
    if command in ("run", "commtest"):
        arguments += ["--out", str(out)]
    if command == "tare":
        arguments += ["--out", str(out / "tare.toml")]
    try:
        done = subprocess.run(
            ["chrt", "--idle", "0", BIN / "adacd-hil", *arguments], capture_output=True, text=True, timeout=60.0,
            check=False, cwd=out, stdin=subprocess.DEVNULL,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return -1, "still running after 60 s"
    said = [line for line in (done.stdout + done.stderr).splitlines() if line.strip()]
    return done.returncode, " / ".join(said[-2:])


def _end(running: Host) -> str:
    """Ask the host to end, if it has not; return how it ended."""
    if running.process.poll() is None:
        running.process.send_signal(signal.SIGTERM)
    try:
        running.process.wait(END_S)
    except subprocess.TimeoutExpired:
        running.process.kill()
        return f"HUNG: no end {END_S:g} s after SIGTERM"
    return f"status {running.process.returncode}"


def _judge(
    case: AttackCase, folder: Path, begin_ns: int, forged: int, ended: str, status: int | None, second: str
) -> Finding:
    """Read host's log and emulator's truth, both by the wall clock."""
    log = read_log(folder / LOG_NAME, (SCHEME.name, EVENTS.name))
    events = [entry._replace(t_ns=entry.t_ns + log.epoch_ns) for entry in log.events]
    stops_ns = log.scheme.t_ns[np.isin(log.scheme["state"], STOPS)] + log.epoch_ns
    truth = read_log(folder / TRUTH_NAME, (TRUTH.name,)).truth
    if not len(truth):
        raise VoidError("the emulator has left no truth")
    noticed_ns, line = first_notice(events, begin_ns, expected_lines(case))
    found = finding(case, forged, begin_ns, noticed_ns, line, truth.t_ns, truth.block, stops_ns, ended)
    if case.name == "nothing":
        found.verdict = "ok" if noticed_ns is None else "FALSE ALARM"
    if case.name in SECOND_USERS:
        found.verdict = second_verdict(case.name, status, second, found)
        found.noticed_by = f"status {status}: {second} | {line}"
    if case.name == KILLED:
        found.verdict = "ok" if found.rest_ms is not None and found.rest_ms <= 1000.0 else "NOT AT REST"
    if ended.startswith("HUNG"):
        found.verdict = "HUNG"
    return found


def second_verdict(name: str, status: int | None, second: str, found: Finding) -> str:
    """Say whether a second user was refused, by name, without harm to the run."""
    problems = []
    if found.stopped_ms is not None:
        problems.append("RUN DISTURBED")
    if name not in READ_ONLY and status == 0:
        problems.append("NOT REFUSED")
    if name not in READ_ONLY and status and not any(word in second.lower() for word in _NAMES):
        problems.append("NOT NAMED")
    return ", ".join(problems) or "ok"


_NAMES = ("another", "somebody", "in use", "already", "drives", "sync")
