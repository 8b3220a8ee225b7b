"""Real runs of tools/with-vcan: what passes through, what is left behind, and a frame over vcan0."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from hang import HANG_S

WITH_VCAN = Path(__file__).resolve().parents[2] / "tools" / "with-vcan"
STATUS_USAGE = 2
STATUS_BUS_MISSING = 5
STATUS_TIMEOUT = 124
STATUS_NOT_FOUND = 127

EVERYTHING = """
import json, os, socket, struct, sys, threading
import numpy as np
FRAME = struct.Struct("=IB3x8s")
near, far = (socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) for _ in range(2))
for end in (near, far):
    end.bind(("vcan0",))
    end.settimeout(1200.0)
if os.fork() == 0:
    identifier, length, data = FRAME.unpack(far.recv(FRAME.size))
    far.send(FRAME.pack(identifier + 1, length, data[::-1]))
    os._exit(0)
near.send(FRAME.pack(0x123, 8, bytes.fromhex("1122334455667788")))
identifier, length, data = FRAME.unpack(near.recv(FRAME.size))
def add_up(seed):
    values = np.random.default_rng(seed).random(1 << 16)
    expected = values.sum()
    for _ in range(5000):
        sums[seed].append(values.sum() == expected)
sums = [], []
threads = [threading.Thread(target=add_up, args=(seed,)) for seed in range(2)]
for thread in threads: thread.start()
for thread in threads: thread.join()
mask = os.umask(0)
os.umask(mask)
report = {"folder": os.getcwd(), "passed": os.environ["PASSED"], "umask": mask}
report |= {"frame": [identifier, length, data.hex()], "sums": [all(map(bool, one)) for one in sums]}
open("report.json", "w").write(json.dumps(report))
every = bytes(range(256)) * 1000
os.write(2, every[::-1])
os.write(1, every)
sys.exit(37)
"""
"""Writes down what it finds, exchanges a frame, adds up in two threads, and ends with its own exit status."""


def start(*arguments: str, **options: Any) -> subprocess.Popen[bytes]:
    """Start the launcher with separate output pipes."""
    command = [sys.executable, str(WITH_VCAN), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options)


def run(*arguments: str, **options: Any) -> tuple[int, bytes, bytes]:
    """Run the launcher to its end; returns status, stdout and stderr."""
    process = start(*arguments, **options)
    stdout, stderr = process.communicate(timeout=HANG_S)
    return process.returncode, stdout, stderr


def find_processes(word: str) -> list[int]:
    """Find the living processes that have this word in their command line."""
    found = []
    for file in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            is_found = os.fsencode(word) in file.read_bytes()
        except OSError:
            continue
        if is_found:
            found.append(int(file.parent.name))
    return found


class Passed(NamedTuple):
    """What came of a command that did everything, in one boot."""

    folder: Path
    status: int
    stdout: bytes
    stderr: bytes

    @property
    def report(self) -> dict[str, Any]:
        report: dict[str, Any] = json.loads((self.folder / "report.json").read_text())
        return report


PASSED = "two\nlines with 'quotes' and $HOME"


@pytest.fixture(scope="module")
def passed(tmp_path_factory: pytest.TempPathFactory) -> Passed:
    """Run it; skip where no CAN can be had."""
    folder = tmp_path_factory.mktemp("a folder's name")
    ended = run("--", sys.executable, "-c", EVERYTHING, cwd=folder, env=os.environ | {"PASSED": PASSED}, umask=0o027)
    if ended[0] == STATUS_BUS_MISSING:
        pytest.skip(ended[2].decode().strip())
    return Passed(folder, *ended)


@pytest.fixture
def endless_run(passed: Passed, tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Start a command that never ends, in a process of its own too; its processes all name tmp_path."""
    forever = "sleep infinity & echo started; while :; do sleep 1; done"
    process = start(
        "--timeout", "6", "--", "sh", "-c", forever, str(tmp_path), env=os.environ | {"TMPDIR": str(tmp_path)}
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"started\n"
    assert len(find_processes(str(tmp_path))) > 1
    yield process
    process.kill()
    process.communicate()


@pytest.mark.slow
def test_the_exit_status_and_every_byte_of_both_outputs_pass_through(passed: Passed) -> None:
    every = bytes(range(256)) * 1000
    assert passed.status == 37
    assert (passed.stdout, passed.stderr) == (every, every[::-1])


@pytest.mark.slow
def test_working_directory_environment_and_umask_pass_through(passed: Passed) -> None:
    report = passed.report
    assert (report["folder"], report["passed"], report["umask"]) == (str(passed.folder), PASSED, 0o027)


@pytest.mark.slow
def test_two_processes_exchange_a_frame_over_vcan0(passed: Passed) -> None:
    assert passed.report["frame"] == [0x124, 8, "8877665544332211"]


@pytest.mark.slow
def test_each_thread_keeps_its_vector_registers(passed: Passed) -> None:
    assert passed.report["sums"] == [True, True]


@pytest.mark.slow
def test_a_missing_command_gives_127(passed: Passed) -> None:
    status, _, _ = run("--", "no-such-command")
    assert status == STATUS_NOT_FOUND


@pytest.mark.slow
def test_a_timeout_ends_everything(endless_run: subprocess.Popen[bytes], tmp_path: Path) -> None:
    assert endless_run.wait(HANG_S) == STATUS_TIMEOUT
    assert find_processes(str(tmp_path)) == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_terminated_launcher_leaves_nothing_behind(endless_run: subprocess.Popen[bytes], tmp_path: Path) -> None:
    endless_run.terminate()
    assert endless_run.wait(HANG_S) == 128 + signal.SIGTERM
    assert find_processes(str(tmp_path)) == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("arguments", [[], ["--"], ["--can", "a/b", "--", "true"], ["--timeout", "-1", "--", "true"]])
def test_a_usage_error_gives_2(arguments: list[str]) -> None:
    status, _, _ = run(*arguments)
    assert status == STATUS_USAGE
