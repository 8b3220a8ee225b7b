"""Runs with a log that can't be written: slow disk, full disk, logger killed or stopped. The bus is the witness."""

import argparse
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from side_by_side import (
    CHANNEL,
    Running,
    TimingError,
    emulator,
    host_run,
    patient_config,
    play_each,
    row,
    running,
    show_each,
    time_percentiles_us,
)
from witness import Seen, read_witness, times_after, witness

from adacd_hil.log.log_files import LOG_NAME, LogError
from adacd_hil.log.reader import read_log
from adacd_hil.log.types.topics import CYCLE
from firmware_sim.arm.sensing import POSITION_LSB_RAD

SYNC_ID, FEEDBACK_ID, LAST_COMMAND_ID, STATUS_ID = 0x080, 0x181, 0x202, 0x281
DISK_CASES = ("undisturbed", "slow", "full", "killed", "stopped")
SLOW_BYTES_S = 64 * 1024
STOPPED_S = 10.0
TMPFS_BYTES = 256 * 1024 * 1024
HOST_WITH_PIPE = """
import os, sys
from adacd_hil.cli.main import main
from adacd_hil.log.recording import recorder
pipe = sys.argv.pop(1)
recorder.create_file = lambda path: os.open(pipe, os.O_WRONLY)
main()
"""
"""The host, whose log goes into the FIFO that is its first argument."""


class SlowDisk:
    """A FIFO in place of the log, whose reader takes what comes, or `SLOW_BYTES_S` while it is slow."""

    def __init__(self, path: Path, copy: Path) -> None:
        os.mkfifo(path)
        self.is_slow = False
        self._path, self._copy = path, copy
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        with self._path.open("rb", buffering=0) as pipe, self._copy.open("wb") as file:
            while data := pipe.read(SLOW_BYTES_S // 10 if self.is_slow else 1 << 16):
                file.write(data)
                if self.is_slow:
                    time.sleep(0.1)  # the disk's speed

    def close(self) -> None:
        """Wait for the end of the pipe."""
        self._thread.join(60.0)


@contextmanager
def small_disk(folder: Path) -> Iterator[None]:
    """Mount a tmpfs on a folder. Raises TimingError where that isn't permitted."""
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={TMPFS_BYTES}", "tmpfs", folder], capture_output=True, check=False
    )
    if done.returncode:
        raise TimingError(f"no tmpfs for the full disk: {done.stderr.decode().strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", folder], check=False)


def fill(folder: Path) -> None:
    """Take all the room that is left on a disk."""
    with (folder / "filler").open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(1 << 16))
        except OSError:
            return


def describe_span(
    seen: Seen, begin_ns: int, end_ns: int, period_us: int, wall_less_monotonic_ns: int
) -> dict[str, Any]:
    """Say by the frames on the bus how the cycle went, and how far joint 1 moved, in a span of wall clock."""
    span = seen.between(begin_ns, end_ns)
    sync_ns = span.of(SYNC_ID).wall_ns
    position = span.of(FEEDBACK_ID).data.astype(np.uint32).astype(np.int32) * POSITION_LSB_RAD
    return {
        "cycles": len(sync_ns),
        "overruns": round((end_ns - begin_ns) / (period_us * 1e3)) - len(sync_ns),
        "lateness_us": time_percentiles_us((sync_ns - wall_less_monotonic_ns) % (period_us * 1000)),
        "command_us": time_percentiles_us(times_after(sync_ns, span.of(LAST_COMMAND_ID).wall_ns)),
        "moved_deg": float(np.degrees(np.ptp(position))) if len(position) else 0.0,
    }


def disturbance(
    case: str, out: Path, begun: Running, slow: SlowDisk | None
) -> tuple[Callable[[], None], Callable[[], None]]:
    """Return how a case begins and how it ends."""
    logger = begun.logger_pid or 0

    def nothing() -> None:
        return

    def be_slow(is_slow: bool) -> None:
        if slow is not None:
            slow.is_slow = is_slow

    return {
        "undisturbed": (nothing, nothing),
        "slow": (lambda: be_slow(True), lambda: be_slow(False)),
        "full": (lambda: fill(out), nothing),
        "killed": (lambda: os.kill(logger, signal.SIGKILL), nothing),
        "stopped": (lambda: os.kill(logger, signal.SIGSTOP), lambda: os.kill(logger, signal.SIGCONT)),
    }[case]


def run_disk_case(case: str, chosen: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Run the host undisturbed, then disturbed; the bus is the witness. Raises TimingError."""
    out = folder / "host"
    out.mkdir()
    seen_path = folder / "witness.bin"
    watched = (SYNC_ID, FEEDBACK_ID, LAST_COMMAND_ID, STATUS_ID)
    with ExitStack() as stack:
        if case == "full":
            stack.enter_context(small_disk(out))
        slow = SlowDisk(folder / "slow", folder / "copy.mcap") if case == "slow" else None
        stack.enter_context(emulator(CHANNEL, "--scenario", "idle", "--clock", chosen.clock, folder=folder))
        counts = stack.enter_context(witness(CHANNEL, watched, seen_path, folder))
        config = patient_config(folder, more=chosen.settings)
        run = host_run(CHANNEL, folder, config)
        if slow is not None:
            run.command[:1] = [sys.executable, "-c", HOST_WITH_PIPE, folder / "slow"]
        begun = stack.enter_context(running(run, folder))
        begin, end = disturbance(case, out, begun, slow)
        time.sleep(2.0)  # the drives are enabled by now
        marks_ns = [time.time_ns()]
        time.sleep(chosen.seconds)  # before, then with the disturbance: what is measured
        marks_ns.append(time.time_ns())
        begin()
        time.sleep(chosen.stopped if case == "stopped" else chosen.seconds)
        end()
        marks_ns.append(time.time_ns())
        status = begun.end()
        if slow is not None:
            slow.close()
        log = folder / "copy.mcap" if slow is not None else out / LOG_NAME
        problem = log_problem(log)
    seen = read_witness(seen_path)
    offset_ns = time.time_ns() - time.monotonic_ns()
    devices = json.loads((folder / "emulator.json").read_text() or "{}")
    last_status = seen.of(STATUS_ID).data[-1:]
    return {
        "before": describe_span(seen, marks_ns[0], marks_ns[1], 1000, offset_ns),
        "during": describe_span(seen, marks_ns[1], marks_ns[2], 1000, offset_ns),
        "witness": counts,
        "status": status,
        "said": begun.told,
        "log_problem": problem,
        "drive_states": devices.get("drive_states"),
        "error_codes": devices.get("error_codes"),
        "rejected_commands": devices.get("rejected_commands"),
        "last_statusword": [int(value) & 0xFFFF for value in last_status],
        "events": [line for line in begun.complaints.read_text().splitlines() if "log" in line],
    }


def log_problem(path: Path) -> str:
    """Say what is wrong with a log; empty for a whole one."""
    try:
        log = read_log(path, (CYCLE.name,))
    except LogError as error:
        return str(error)
    return log.problem


def run_disk(chosen: argparse.Namespace) -> dict[str, Any]:
    """Run every case of a log that can't be written."""
    return play_each(chosen.case or DISK_CASES, lambda case, folder: run_disk_case(case, chosen, folder))


def show_disk(result: dict[str, Any]) -> str:
    """Lay out what `run_disk` measured."""
    return show_each("µs, by the frames on the bus", result, _disk_lines)


def _disk_lines(case: str, each: dict[str, Any]) -> list[str]:
    said = each["said"]
    return [
        *(
            row(f"{case}, {span}: {title}", each[span][what])
            for what, title in (("command_us", "SYNC to last command"), ("lateness_us", "lateness of SYNC"))
            for span in ("before", "during")
        ),
        f"  exit status {each['status']}, fault {said.get('fault')}, dropped {said.get('dropped')}, log error "
        f"{said.get('log_error')!r}, log {each['log_problem'] or 'whole'}; overruns {each['before']['overruns']} "
        f"and {each['during']['overruns']}; joint 1 moved {each['during']['moved_deg']:.0f} deg meanwhile; "
        f"drives {each['drive_states']}, errors {each['error_codes']}; the witness lost "
        f"{each['witness'].get('lost')} frames",
    ]
