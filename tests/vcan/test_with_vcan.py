"""Real runs of tools/with-vcan: what passes through, what is left behind, and a frame over vcan0."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hang import HANG_S

WITH_VCAN = Path(__file__).resolve().parents[2] / "tools" / "with-vcan"
STATUS_USAGE = 2
STATUS_BUS_MISSING = 5
STATUS_TIMEOUT = 124
STATUS_NOT_FOUND = 127

EXCHANGE_A_FRAME = """
import os, socket, struct
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
print(f"{identifier:x} {length} {data.hex()}")
"""

SUM_IN_TWO_THREADS = """
import threading
import numpy as np
def add_up(seed):
    values = np.random.default_rng(seed).random(1 << 16)
    expected = values.sum()
    for _ in range(20000):
        sums[seed].append(values.sum() == expected)
sums = [], []
threads = [threading.Thread(target=add_up, args=(seed,)) for seed in range(2)]
for thread in threads: thread.start()
for thread in threads: thread.join()
print(all(sums[0]), all(sums[1]))
"""


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


@pytest.fixture(scope="module")
def bus() -> None:
    """Skip where no CAN can be had."""
    status, _, stderr = run("--", "true")
    if status == STATUS_BUS_MISSING:
        pytest.skip(stderr.decode().strip())
    assert status == 0, stderr.decode()


@pytest.fixture
def endless_run(bus: None, tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
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
def test_the_exit_status_passes_through(bus: None) -> None:
    status, _, _ = run("--", "sh", "-c", "exit 37")
    assert status == 37


@pytest.mark.slow
def test_stdout_and_stderr_stay_separate_and_carry_every_byte(bus: None) -> None:
    all_bytes = bytes(range(256)) * 1000
    script = "import os; b = bytes(range(256)) * 1000; os.write(2, b[::-1]); os.write(1, b)"
    _, stdout, stderr = run("--", sys.executable, "-c", script)
    assert stdout == all_bytes
    assert stderr == all_bytes[::-1]


@pytest.mark.slow
def test_working_directory_environment_and_umask_pass_through(bus: None, tmp_path: Path) -> None:
    folder = tmp_path / "a folder's name"
    folder.mkdir()
    value = "two\nlines with 'quotes' and $HOME"
    script = r'pwd; printf "%s\n" "$PASSED"; umask; echo written >file'
    _, stdout, _ = run("--", "sh", "-c", script, cwd=folder, env=os.environ | {"PASSED": value}, umask=0o027)
    assert stdout.decode() == f"{folder}\n{value}\n0027\n"
    assert (folder / "file").read_text() == "written\n"


@pytest.mark.slow
def test_two_processes_exchange_a_frame_over_vcan0(bus: None) -> None:
    _, stdout, stderr = run("--", sys.executable, "-c", EXCHANGE_A_FRAME)
    assert stdout == b"124 8 8877665544332211\n", stderr.decode()


@pytest.mark.slow
def test_each_thread_keeps_its_vector_registers(bus: None) -> None:
    status, stdout, stderr = run("--", sys.executable, "-c", SUM_IN_TWO_THREADS)
    assert (status, stderr) == (0, b"")
    assert stdout == b"True True\n"


@pytest.mark.slow
def test_a_missing_command_gives_127(bus: None) -> None:
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
