"""Sets the wall clock forward, back and to 1970 while a run goes on; nobody may notice."""

import argparse
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from side_by_side import (
    CHANNEL,
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

from adacd_hil.cli.output import ExitCode
from adacd_hil.log.log_files import LOG_NAME
from adacd_hil.log.reader import read_log

STEPS_S = {"none": 0.0, "forward an hour": 3600.0, "back an hour": -3600.0, "to 1970": -1e12, "forward a second": 1.0}
"""How far the clock is set; beyond 1970 it is set to the year's first day."""


def set_clock(step_s: float) -> None:
    """Set the wall clock. Raises TimingError where that isn't permitted."""
    try:
        time.clock_settime(time.CLOCK_REALTIME, max(time.time() + step_s, 86400.0))
    except OSError as error:
        raise TimingError(f"the clock can't be set: {error.strerror}") from None


def run_clock(chosen: argparse.Namespace) -> dict[str, Any]:
    """Play every step: undisturbed for some seconds, then the clock is set, then on for as long."""

    def play(name: str, folder: Path) -> dict[str, Any]:
        before_s, began_s = time.time(), time.monotonic()
        try:
            return run_step(STEPS_S[name], chosen, folder)
        finally:
            if STEPS_S[name]:
                time.clock_settime(time.CLOCK_REALTIME, before_s + time.monotonic() - began_s)

    return play_each(chosen.step or STEPS_S, play)


def run_step(step_s: float, chosen: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Run the host, set the clock half-way. Raises TimingError."""
    with ExitStack() as stack:
        options = ("--scenario", "idle", "--clock", chosen.clock)
        stack.enter_context(emulator(CHANNEL, *options, folder=folder))
        config = patient_config(folder, more=chosen.settings)
        begun = stack.enter_context(running(host_run(CHANNEL, folder, config), folder))
        time.sleep(chosen.seconds)  # before, then after the step: what is measured
        set_ns = time.monotonic_ns()
        if step_s:
            set_clock(step_s)
        time.sleep(chosen.seconds)
        status = begun.end()
    said = begun.told
    log = read_log(folder / "host" / LOG_NAME)
    cycle = log.cycle
    frames_ns = log.frames["t_ns"]
    spans = {"before": cycle.t_ns < set_ns, "after": cycle.t_ns >= set_ns}
    return {
        "status": status,
        "fault": said.get("fault"),
        "dropped": said.get("dropped"),
        "log_problem": log.problem,
        "cycles": {span: int(chosen_rows.sum()) for span, chosen_rows in spans.items()},
        "feedback_us": {span: time_percentiles_us(cycle["feedback_ns"][rows]) for span, rows in spans.items()},
        "overruns": int(cycle["overruns"].max(initial=0)),
        "incomplete": int((cycle["frames_missing"] > 0).sum()),
        "cycles_back_in_time": int((np.diff(cycle.t_ns) <= 0).sum()),
        "frames_off_s": float(np.abs(frames_ns - log.frames["cycle_t_ns"]).max(initial=0)) * 1e-9,
        "faults": [entry.event.message for entry in log.events if "-> FAULT" in entry.event.message],
        "violations": violations_of(status, said, log.problem, cycle.t_ns),
    }


def violations_of(status: int, said: dict[str, Any], problem: str, times_ns: Any) -> list[str]:
    """Say what a set clock has changed."""
    found = []
    if status not in (ExitCode.OK, ExitCode.INTERRUPTED):
        found.append(f"exit status {status}")
    if said.get("fault") not in ("NONE", None):
        found.append(f"fault {said['fault']}")
    if problem:
        found.append(problem)
    if (np.diff(times_ns) <= 0).any():
        found.append("the log's cycles go back in time")
    return found


def show_clock(result: dict[str, Any]) -> str:
    """Lay out what `run_clock` found."""
    return show_each("µs, SYNC out to last frame read", result, _clock_lines)


def _clock_lines(name: str, each: dict[str, Any]) -> list[str]:
    return [
        *(row(f"clock {name}, {span}", each["feedback_us"][span]) for span in ("before", "after")),
        f"  exit status {each['status']}, fault {each['fault']}, dropped {each['dropped']}, overruns "
        f"{each['overruns']}, incomplete {each['incomplete']}, frames at most {each['frames_off_s']:.3f} s from "
        f"their cycle; {'; '.join(each['violations']) or 'nothing noticed'}",
        *(f"  {text}" for text in each["faults"]),
    ]
