"""Plays experiments for the tests: in one process, and as two processes on a bus.

Unless the arguments name another configuration it is `paper`, whose numbers take least time to compile.
"""

import contextlib
import json
import re
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from hang import HANG_S
from mcap.reader import make_reader
from topic_bytes import topic_bytes

BIN = Path(sys.executable).parent
PAPER = ("--config", "paper")


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
        [BIN / "adacd-hil", *arguments], capture_output=True, text=True, timeout=HANG_S, check=False, cwd=folder
    )
    print(f"status {done.returncode}", done.stdout, done.stderr, sep="\n")  # pytest shows it if the test fails
    return Played(folder, done.returncode, done.stdout, done.stderr)


def demo(folder: Path, *arguments: str) -> Played:
    """Play the experiment in one process."""
    return adacd_hil(folder, "demo", *PAPER, "--out", str(folder), "--json", *arguments)


class Emulating(subprocess.Popen[str]):
    """A `firmware-sim`. `said`: what it printed since it was ready, once it has ended: stdout and stderr."""

    said = ("", "")


@contextlib.contextmanager
def firmware_sim(*words: str | Path) -> Iterator[Emulating]:
    """Run `firmware-sim` while the block lasts; it is ready when the block begins."""
    command = [BIN / "firmware-sim", *words]
    with Emulating(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            for line in process.stderr:
                if line.strip() == "ready":
                    break
            yield process
        finally:
            process.terminate()
            process.said = process.communicate(timeout=HANG_S)
            print(f"status {process.returncode}", *process.said, sep="\n")


def emulator(folder: Path, *arguments: str) -> contextlib.AbstractContextManager[Emulating]:
    """Run an emulated arm on vcan while the block lasts."""
    return firmware_sim("run", "-i", "socketcan", "-c", "vcan0", "--out", folder, *arguments)


STANDARD_FRAMES = "vcan0,0:80000000"
"""candump's filter for 11-bit identifiers: how lockstep keeps time is not CANopen."""
WITNESS_BYTES = 512 * 1024 * 1024
"""Room for all frames of a run, of which a frame takes some 1 kB; the kernel takes it as the run needs it."""
TOKEN_ID = 0x7E3
"""Of a frame that only the witness's own side sends: what candump has written of it, it has written of all before."""


@dataclass(frozen=True)
class Witness:
    """What candump wrote down. `dropped`: frames for which the kernel had no room, by its own count."""

    path: Path

    @property
    def lines(self) -> list[str]:
        """The frames, but for the tokens."""
        token = f" {TOKEN_ID:03X}#"
        return [line for line in self.path.read_text().splitlines() if line.startswith("(") and token not in line]

    @property
    def dropped(self) -> int:
        """How many frames are not in `lines` though they were on the bus."""
        totals = re.findall(r"total drops (\d+)", self.path.read_text())
        return int(totals[-1]) if totals else 0


@contextlib.contextmanager
def candump(path: Path) -> Iterator[Witness]:
    """Write down what is on vcan0 from the beginning of the block to its end, however busy the machine is.

    The block begins once candump listens, and ends once it has written what waited for it.
    """
    command = ["candump", "-L", "-d", "-r", str(WITNESS_BYTES), STANDARD_FRAMES]
    witness = Witness(path)
    with path.open("w") as sink, subprocess.Popen(command, stdout=sink, stderr=subprocess.DEVNULL) as listener:
        try:
            _await_token(listener, path, 1)
            yield witness
            _await_token(listener, path, 2)
        finally:
            listener.terminate()
            listener.wait(HANG_S)


def _await_token(listener: "subprocess.Popen[bytes]", path: Path, number: int) -> None:
    """Send a token until candump has written it: one may find no room, or nobody who listens yet."""
    token = f"{TOKEN_ID:03X}#{number:02X}"
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as can:
        can.bind(("vcan0",))
        while token not in _end_of(path):
            can.send(struct.pack("=IB3x8s", TOKEN_ID, 1, bytes([number])))
            with contextlib.suppress(subprocess.TimeoutExpired):
                raise RuntimeError(f"candump ended with {listener.wait(0.05)}")


def _end_of(path: Path) -> str:
    """Return the last lines, as far as they are written."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 65536))
        return file.read().decode()


def run_on_vcan(folder: Path, *arguments: str) -> Played:
    """Run the host on vcan0."""
    on_bus = ("run", "-i", "socketcan", "-c", "vcan0", *PAPER)
    return adacd_hil(folder, *on_bus, "--out", str(folder), "--json", *arguments)


def contents(path: Path) -> dict[str, bytes]:
    """Return what a log holds, stamps included, by topic."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return {channel.topic: topic_bytes(path, channel.topic) for channel in summary.channels.values()}


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
        stdout, _ = host.communicate(timeout=HANG_S)
    return Played(folder, host.returncode, stdout, "".join(lines))


def other_contract(folder: Path) -> Path:
    """Write a configuration whose sensors are ours but for their scale, so that its contract is another."""
    ours = resources.files("adacd_hil") / "device_profiles" / "adacd-sensor.toml"
    profile = folder / "other-sensor.toml"
    profile.write_text(ours.read_text().replace("torque_Nm = 1e-6", "torque_Nm = 1e-5"))
    config = folder / "other-contract.toml"
    config.write_text(f'[devices]\nsensor = ["{profile}", "{profile}"]\ncontract = ""\n')
    return config
