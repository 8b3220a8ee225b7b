"""A long run with contacts: memory of the processes, every part of the log, and how soon the arm reacts."""

import argparse
import os
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from side_by_side import (
    CHANNEL,
    emulator,
    head,
    host_run,
    patient_config,
    read_cycles,
    row,
    running,
    time_percentiles_us,
)
from witness import Seen, read_witness, witness

from adacd_hil.log.log_files import LOG_NAME, find_parts
from adacd_hil.log.reader import read_log
from adacd_hil.log.types.topics import CYCLE, EVENTS

FIRST_COMMAND_ID = 0x201
MEMORY_EVERY_S = 10.0
MEMORY_SETTLED_S = 60.0
MEGABYTE = 1e6
FIRST_CONTACT_S = 10.0
CONTACTS = ((1, 0.25, 90.0, 20.0), (1, 0.25, -90.0, 20.0), (2, 0.20, 90.0, 15.0), (2, 0.20, -90.0, 15.0))
"""Link, point in m, direction in degrees, force in N: those of the paper's experiment."""
CONTACT_S = 0.25
REACTION = "MONITOR -> REACT"


def write_contacts(path: Path, lasts_s: float, every_s: float) -> int:
    """Write a scenario with a contact every so many seconds, after one adaptation; return how many."""
    lines = [f'about = "A contact every {every_s:g} s."', 'group = "timing"', f"lasts_s = {lasts_s:.1f}"]
    lines += ["start_deg = [-30.0, -60.0]", "contacts = ["]
    count = max(0, int((lasts_s - FIRST_CONTACT_S) / every_s))
    for number in range(count):
        link, point_m, angle_deg, force_N = CONTACTS[number % len(CONTACTS)]
        at_s = FIRST_CONTACT_S + every_s * number
        lines.append(
            f"  {{ at_s = {at_s:.1f}, link = {link}, point_m = {point_m}, angle_deg = {angle_deg}, "
            f"force_N = {force_N}, duration_s = {CONTACT_S} }},"
        )
    path.write_text("\n".join([*lines, "]"]) + "\n")
    return count


def resident_bytes(pid: int) -> int:
    """Read the resident memory of a process; 0 when it is gone."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


def run_hour(chosen: argparse.Namespace) -> dict[str, Any]:
    """Let the host run with contacts; sample the memory of all processes. The log is read afterwards."""
    folder = chosen.out
    total_s = chosen.minutes * 60.0
    contacts = write_contacts(folder / "contacts.toml", total_s + 3600.0, chosen.every)
    config = patient_config(folder, period_us=chosen.period_us, more=chosen.settings)
    memory: list[list[float]] = []
    with ExitStack() as stack:
        where = ["--scenario", str(folder / "contacts.toml"), "--clock", chosen.clock]
        devices = stack.enter_context(emulator(CHANNEL, *where, folder=folder))
        counts = stack.enter_context(witness(CHANNEL, [FIRST_COMMAND_ID], folder / "witness.bin", folder))
        begun = stack.enter_context(running(host_run(CHANNEL, folder, config), folder))
        begin_s = time.monotonic()
        pids = begun.process.pid, begun.logger_pid or 0, devices.pid
        while (elapsed_s := time.monotonic() - begin_s) < total_s and begun.process.poll() is None:
            memory.append([elapsed_s, *(resident_bytes(pid) / MEGABYTE for pid in pids)])
            if len(memory) % 6 == 1:
                shown = ", ".join(f"{value:.1f}" for value in memory[-1][1:])
                print(f"{elapsed_s:6.0f} s of {total_s:.0f}, MB of host, logger, emulator: {shown}", file=sys.stderr)
            time.sleep(min(MEMORY_EVERY_S, max(0.1, total_s - elapsed_s)))  # between two readings of memory
        status = begun.end()
    return {"status": status, "said": begun.told, "contacts_planned": contacts, "memory_MB": memory, "witness": counts}


def read_parts(folder: Path) -> list[dict[str, Any]]:
    """Open every part of a log by itself, with a reader that isn't ours: its messages, or what is wrong with it."""
    parts: list[dict[str, Any]] = []
    for path in find_parts(folder / LOG_NAME).values():
        described: dict[str, Any] = {"name": path.name, "bytes": path.stat().st_size, "messages": 0, "problem": ""}
        try:
            with path.open("rb") as file:
                summary = make_reader(file).get_summary()
            if summary is None or summary.statistics is None:
                described["problem"] = "no summary"
            else:
                described["messages"] = summary.statistics.message_count
        except (McapError, OSError) as error:
            described["problem"] = f"{type(error).__name__}: {error}"
        parts.append(described)
    return parts


def reaction_times(path: Path, seen: Seen) -> dict[str, Any]:
    """Read a log: is it whole, how went the cycles, and how long did each reaction take.

    compute: feedback read to commands handed over, by the host's clock, in the cycles that decide to react. wire:
    feedback read to the kernel's stamp of the first command after it. Raises LogError, TimingError.
    """
    log = read_log(path, (CYCLE.name, EVENTS.name))
    _, times_ns, rest = read_cycles(log)
    t_ns = log.cycle.t_ns
    compute_ns, wire_ns = [], []
    for event in log.events:
        place = int(np.searchsorted(t_ns, event.t_ns))
        if event.event.message != REACTION or place == len(t_ns) or t_ns[place] != event.t_ns:
            continue
        compute_ns.append(int(times_ns["compute"][place]))
        begin_ns = event.t_ns + log.epoch_ns
        sent = int(np.searchsorted(seen.wall_ns, begin_ns))
        if sent < len(seen.wall_ns):
            wire_ns.append(int(seen.wall_ns[sent]) - begin_ns - int(times_ns["feedback"][place]))
    return {
        "log_problem": log.problem,
        "cycles": len(t_ns),
        "overruns": int(log.cycle["overruns"][-1]),
        "frames_lost": rest["frames_lost"],
        "times_us": {name: time_percentiles_us(values) for name, values in times_ns.items()},
        "contacts_detected": len(compute_ns),
        "reaction_us": {
            "compute": time_percentiles_us(np.array(compute_ns, np.int64)),
            "wire": time_percentiles_us(np.array(wire_ns, np.int64)),
        },
        "reactions_witnessed": len(wire_ns),
    }


def memory_spans(memory: Sequence[Sequence[float]]) -> dict[str, list[float]]:
    """Return, of each process after the first minute, lowest, highest, and last less first, MB."""
    settled = [sample for sample in memory if sample[0] >= MEMORY_SETTLED_S] or list(memory)
    columns = np.array(settled)[:, 1:].T if settled else np.zeros((3, 1))
    names = ("host", "logger", "emulator")
    return {
        name: [float(column.min()), float(column.max()), float(column[-1] - column[0])]
        for name, column in zip(names, columns, strict=True)
    }


def finish_hour(chosen: argparse.Namespace, result: dict[str, Any]) -> dict[str, Any]:
    """Read the log and the witness of an hour."""
    seen = read_witness(chosen.out / "witness.bin")
    spans = {"memory_span_MB": memory_spans(result["memory_MB"]), "parts": read_parts(chosen.out / "host")}
    return result | reaction_times(chosen.out / "host" / LOG_NAME, seen) | spans


def show_hour(result: dict[str, Any]) -> str:
    """Lay out what `run_hour` and the log say."""
    said = result["said"]
    bad = [part for part in result["parts"] if part["problem"]]
    lines = [
        f"exit status {result['status']}, {result['cycles']} cycles in {len(result['parts'])} parts of the log, "
        f"{len(bad)} of them not readable, the log {result['log_problem'] or 'whole'}",
        f"dropped {said.get('dropped')}, frames lost {result['frames_lost']}, overruns {result['overruns']}, "
        f"faults {said.get('recoveries')}, log error {said.get('log_error')!r}",
        f"{result['contacts_detected']} contacts detected, {result['reactions_witnessed']} seen on the bus; "
        f"the witness lost {result['witness'].get('lost')} frames",
    ]
    lines += [f"  {part['name']}: {part['problem']}" for part in bad]
    lines.append(head("µs"))
    lines += [row(name, values) for name, values in result["times_us"].items()]
    lines.append(row("reaction: feedback read to command handed over", result["reaction_us"]["compute"]))
    lines.append(row("reaction: feedback read to command on the bus", result["reaction_us"]["wire"]))
    lines.append(f"{'MB':20} {'lowest':>8} {'highest':>8} {'change':>8}")
    lines += [
        f"{name:20} {low:8.1f} {high:8.1f} {change:+8.1f}"
        for name, (low, high, change) in result["memory_span_MB"].items()
    ]
    return "\n".join(lines)
