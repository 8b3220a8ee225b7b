"""Real runs of tools/with-vcan: what passes through, and what is left behind."""

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

EVERYTHING = """
import os, sys
every = bytes(range(256)) * 1000
os.write(2, every[::-1])
os.write(1, every)
sys.exit(37)
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
def passed() -> tuple[int, bytes, bytes]:
    """Run it; skip where no CAN can be had."""
    ended = run("--", sys.executable, "-c", EVERYTHING)
    if ended[0] == STATUS_BUS_MISSING:
        pytest.skip(ended[2].decode().strip())
    return ended


@pytest.fixture
def endless_run(passed: tuple[int, bytes, bytes], tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
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
def test_the_exit_status_and_every_byte_of_both_outputs_pass_through(passed: tuple[int, bytes, bytes]) -> None:
    every = bytes(range(256)) * 1000
    assert passed == (37, every, every[::-1])


@pytest.mark.slow
@pytest.mark.parametrize(("is_terminated", "status"), [(False, STATUS_TIMEOUT), (True, 128 + signal.SIGTERM)])
def test_a_timeout_and_a_signal_end_everything(
    endless_run: subprocess.Popen[bytes], tmp_path: Path, is_terminated: bool, status: int
) -> None:
    if is_terminated:
        endless_run.terminate()
    assert endless_run.wait(HANG_S) == status
    assert find_processes(str(tmp_path)) == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("arguments", [[], ["--"], ["--can", "a/b", "--", "true"], ["--timeout", "-1", "--", "true"]])
def test_a_usage_error_gives_2(arguments: list[str]) -> None:
    status, _, _ = run(*arguments)
    assert status == STATUS_USAGE
