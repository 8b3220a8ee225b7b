"""A long run beside processes that take processor and disk, judged by the rules that every run must keep."""

import argparse
import contextlib
import os
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from judged_log import judged_log
from run_rules import Case, Violation, clear_contacts, judge
from side_by_side import (
    CHANNEL,
    TimingError,
    emulator,
    head,
    host_run,
    patient_config,
    row,
    running,
    time_percentiles_us,
)
from timing_hour import write_contacts

from adacd_hil.log.log_files import LOG_NAME, TRUTH_NAME
from adacd_hil.log.reader import Series, read_log
from adacd_hil.log.types.topics import CYCLE
from adacd_hil.records import SchemeState
from adacd_hil.settings.configuration_files import load_settings
from firmware_sim.scenario.scenario import load_scenario

COUNTED = ("command-counter", "sync-counter", "log-not-whole")
"""Rules that a log with gaps can't be judged by."""
FOLLOWED = ("torque-rate", "stop-not-latched")
"""Rules about what follows what; where cycles are missing in between, nobody knows."""
STAY_S = 1.0
"""A stay in REACT or STOPPED takes less in these runs."""
_SCENARIO = "contacts.toml"
BURN = "while True: pass"
SCRUB = """
import os, sys
block = os.urandom(1 << 20)
while True:
    with open(sys.argv[1], "wb", buffering=0) as file:
        for _ in range(64):
            file.write(block)
            os.fsync(file.fileno())
"""
"""Writes 64 MiB again and again, each MiB to the disk itself."""


@contextlib.contextmanager
def hogs(processors: int, disks: int, folder: Path) -> Iterator[list["subprocess.Popen[bytes]"]]:
    """Let so many processes burn processor time, and so many write, while the block lasts."""
    commands: list[list[str]] = [[sys.executable, "-c", BURN] for _ in range(processors)]
    commands += [[sys.executable, "-c", SCRUB, str(folder / f"hog{number}")] for number in range(disks)]
    processes = [subprocess.Popen(command) for command in commands]
    try:
        yield processes
    finally:
        for process in processes:
            process.kill()
        for process in processes:
            process.wait()


def run_hogs(chosen: argparse.Namespace) -> dict[str, Any]:
    """Run the host for some minutes beside hogs, in a new folder of `chosen.out`. Raises TimingError."""
    folder = _folder(chosen)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    lasts_s = chosen.minutes * 60.0
    contacts = write_contacts(folder / _SCENARIO, lasts_s, chosen.every)
    config = patient_config(folder, chosen.base, chosen.period_us, chosen.settings)
    with ExitStack() as stack:
        options = ("--scenario", str(folder / _SCENARIO), "--clock", chosen.clock, "--out", str(folder))
        stack.enter_context(emulator(CHANNEL, *options, folder=folder))
        begun = stack.enter_context(running(host_run(CHANNEL, folder, config), folder))
        stack.enter_context(hogs(chosen.processors, chosen.disks, folder))
        end_s = time.monotonic() + lasts_s
        while time.monotonic() < end_s and begun.process.poll() is None:
            time.sleep(0.2)  # until the run is over, or ends by itself
        status = begun.end() if begun.process.poll() is None else begun.process.returncode
    return {"config": config.name, "contacts": contacts, "status": status, "said": begun.told}


def finish_hogs(chosen: argparse.Namespace, result: dict[str, Any]) -> dict[str, Any]:
    """Judge the run, outside of a guest: all frames of 10 min take more memory than one has. Raises TimingError."""
    folder = _folder(chosen)
    return result | describe(folder, folder / result["config"], folder / _SCENARIO)


def _folder(chosen: argparse.Namespace) -> Path:
    return Path(chosen.out) / "run"


def describe(folder: Path, config: Path, scenario_path: Path) -> dict[str, Any]:
    """Judge a run by its log and the arm's truth. Raises TimingError where there is no log to judge."""
    log_path = folder / "host" / LOG_NAME
    if not log_path.exists():
        raise TimingError("the host has left no log")
    settings = load_settings(str(config))
    played = judged_log(log_path, folder / TRUTH_NAME, settings, load_scenario(str(scenario_path)))
    case = Case(played)
    if case.log is None:
        raise TimingError("the host's log has no cycle")
    cycle = read_log(log_path, (CYCLE.name,)).cycle
    violations = judge(played)
    if not case.log.is_complete:  # where packets are missing, so are frames
        known = outside_gaps(
            violations, [(case.t_s(begin_ns), case.t_s(end_ns)) for begin_ns, end_ns in gaps_ns(cycle)]
        )
        violations = [each for each in known if each.rule not in COUNTED]
    speed = np.degrees(np.abs(case.truth["dq"]))
    faults = [entry.event.message for entry in case.log.events if "-> FAULT" in entry.event.message]
    return {
        "cycles": len(cycle),
        "overruns": int(cycle["overruns"].max(initial=0)),
        "lateness_us": time_percentiles_us(cycle["lateness_ns"]),
        "feedback_us": time_percentiles_us(cycle["feedback_ns"]),
        "oldest_data_cycles": int(cycle["data_age"].max(initial=0)),
        "incomplete_cycles": int((cycle["frames_missing"] > 0).sum()),
        "armed_share": round(float(np.mean(case.state == SchemeState.MONITOR)), 3),
        "faults": len(faults),
        "fault_texts": faults[:10],
        "clear_contacts": len(clear_contacts(case)),
        "fastest_deg_s": float(speed.max(initial=0.0)),
        "violations": dict(Counter(violation.rule for violation in violations)),
        "first_violations": [f"{each.rule} at {each.t_s:.3f} s: {each.text}" for each in violations[:10]],
        "log_problem": case.log.problem or ("" if case.log.is_complete else "with gaps"),
        "processors": os.cpu_count(),
    }


def gaps_ns(cycle: Series) -> list[tuple[int, int]]:
    """Return from which logged cycle to which others are missing, but for those that the host skipped."""
    lacking = np.diff(cycle["cycle"].astype(np.int64)) - 1 > np.diff(cycle["overruns"].astype(np.int64))
    return list(zip(cycle.t_ns[:-1][lacking].tolist(), cycle.t_ns[1:][lacking].tolist(), strict=True))


def outside_gaps(violations: Sequence[Violation], gaps_s: Sequence[tuple[float, float]]) -> list[Violation]:
    """Leave out what follows a gap, of the rules about what follows what."""
    return [
        violation
        for violation in violations
        if violation.rule not in FOLLOWED
        or not any(begin_s <= violation.t_s <= end_s + STAY_S for begin_s, end_s in gaps_s)
    ]


def show_hogs(result: dict[str, Any]) -> str:
    """Lay out what `run_hogs` found."""
    said = result["said"]
    lines = [
        head("µs"),
        row("lateness of SYNC", result["lateness_us"]),
        row("SYNC out to last frame read", result["feedback_us"]),
        f"  {result['cycles']} cycles, {result['overruns']} overruns, {result['incomplete_cycles']} incomplete, oldest "
        f"data {result['oldest_data_cycles']} cycles; armed {result['armed_share']:.0%} of the time",
        f"  exit status {result['status']}, {result['faults']} faults, recoveries {said.get('recoveries')}, dropped "
        f"{said.get('dropped')}, log {result['log_problem'] or 'whole'}",
        f"  {result['clear_contacts']} clear contacts while armed; fastest {result['fastest_deg_s']:.0f} deg/s",
        f"  violations: {result['violations'] or 'none'}",
    ]
    return "\n".join([*lines, *(f"    {text}" for text in result["fault_texts"] + result["first_violations"])])
