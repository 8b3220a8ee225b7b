"""Plays experiments for the tests: in one process, and as two processes on a bus.

Unless the arguments name another configuration it is `paper`, whose numbers take least time to compile.
"""

import contextlib
import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

BIN = Path(sys.executable).parent
LIMIT_S = 280
PAPER = ("--config", "paper")
MARK = "1ADACD0"  # how lockstep keeps time: 29-bit identifiers, none of CANopen


@dataclass(frozen=True)
class Played:
    """A command that has ended."""

    folder: Path
    status: int
    stdout: str
    stderr: str

    @property
    def json(self) -> Any:
        """What it printed, with --json."""
        return json.loads(self.stdout)

    @property
    def log(self) -> Path:
        return self.folder / "run.mcap"

    @property
    def error_lines(self) -> list[str]:
        """What it complained about."""
        return [line for line in self.stderr.splitlines() if line.startswith(("adacd-hil:", "firmware-sim:"))]


def adacd_hil(folder: Path, *arguments: str) -> Played:
    """Run `adacd-hil` with its output in `folder` where the command takes one."""
    done = subprocess.run(
        [BIN / "adacd-hil", *arguments], capture_output=True, text=True, timeout=LIMIT_S, check=False, cwd=folder
    )
    return Played(folder, done.returncode, done.stdout, done.stderr)


def demo(folder: Path, *arguments: str) -> Played:
    """Play the experiment in one process."""
    return adacd_hil(folder, "demo", *PAPER, "--out", str(folder), "--json", *arguments)


@contextlib.contextmanager
def emulator(folder: Path, *arguments: str) -> Iterator["subprocess.Popen[str]"]:
    """Run `firmware-sim` on vcan while the block lasts; it is ready when the block begins."""
    command = [BIN / "firmware-sim", "run", "-i", "socketcan", "-c", "vcan0", "--out", str(folder), *arguments]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            for line in process.stderr:
                if line.strip() == "ready":
                    break
            yield process
        finally:
            process.terminate()
            process.communicate(timeout=30)


@contextlib.contextmanager
def candump(dump: Path) -> Iterator[None]:
    """Write down what is on vcan0 while the block lasts."""
    command = ["candump", "-L", "-r", "16777216", "vcan0"]  # room for what it can't write down at once
    with dump.open("w") as sink, subprocess.Popen(command, stdout=sink) as listener:
        try:
            yield
        finally:
            listener.terminate()
            listener.wait(10)


def frames_of(dump: Path) -> str:
    """Return what candump saw of CANopen."""
    return "".join(line for line in dump.read_text().splitlines(keepends=True) if MARK not in line)


def run_on_vcan(folder: Path, *arguments: str) -> Played:
    """Run the host on vcan0."""
    on_bus = ("run", "-i", "socketcan", "-c", "vcan0", *PAPER)
    return adacd_hil(folder, *on_bus, "--out", str(folder), "--json", *arguments)


def run_while_killing(folder: Path, victim: "subprocess.Popen[str]", *arguments: str) -> Played:
    """Run the host on vcan0 and kill the emulator as soon as the arm moves."""
    on_bus = ("run", "-i", "socketcan", "-c", "vcan0", *PAPER)
    command = [BIN / "adacd-hil", *on_bus, "--out", folder, "--json", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder) as host:
        assert host.stderr is not None
        lines = []
        for line in host.stderr:
            lines.append(line)
            if "-> ADAPT" in line:
                victim.kill()
        stdout, _ = host.communicate(timeout=LIMIT_S)
    return Played(folder, host.returncode, stdout, "".join(lines))


def other_contract(folder: Path) -> Path:
    """Write a configuration whose sensors are ours but for their scale, so that its contract is another."""
    ours = resources.files("adacd_hil") / "device_profiles" / "adacd-sensor.toml"
    profile = folder / "other-sensor.toml"
    profile.write_text(ours.read_text().replace("torque_Nm = 1e-6", "torque_Nm = 1e-5"))
    config = folder / "other-contract.toml"
    config.write_text(f'[devices]\nsensor = ["{profile}", "{profile}"]\ncontract = ""\n')
    return config
