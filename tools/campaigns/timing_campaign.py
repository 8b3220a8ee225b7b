"""The long measurements of the cycle over vcan, each one command: JSON and a table in a folder, progress on stderr.

    python tools/campaigns/timing_campaign.py cycle --minutes 10       1 kHz beside the C yardstick, in turn
    python tools/campaigns/timing_campaign.py rates --minutes 2        2 kHz: classic frames, and CAN FD
    python tools/campaigns/timing_campaign.py hour --minutes 60        contacts, memory, every part of the log
    python tools/campaigns/timing_campaign.py disk --seconds 20  slow disk, full disk, logger killed, logger stopped
    python tools/campaigns/timing_campaign.py hogs --minutes 10        beside processes that take processor and disk
    python tools/campaigns/timing_campaign.py clock --seconds 10       the wall clock is set forward and back

All run through tools/with-vcan: emulator and host are two processes on one vcan interface. `--settings` adds TOML to
the configuration of the host, such as its [log] and [realtime] sections. docs/timing.md says how to read the results.
Exit status: 0 measured, 1 something that is measured did not run, 2 wrong usage.
"""

import argparse
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # instruments that campaigns stand on

import yardstick
from side_by_side import (
    CHANNEL,
    ROOT,
    TimingError,
    as_text,
    host_run,
    measure,
    patient_config,
    summarise,
    yardstick_run,
)
from timing_clock import STEPS_S, run_clock, show_clock
from timing_disk import DISK_CASES, STOPPED_S, run_disk, show_disk
from timing_hogs import finish_hogs, run_hogs, show_hogs
from timing_hour import CONTACT_S, finish_hour, run_hour, show_hour

from adacd_hil.cli.output import RUNS
from adacd_hil.wire.dbc_contract import contract_folder

PROGRAM = "timing_campaign"
BLOCK_S = 30.0


def contract_without_budget(folder: Path) -> Path:
    """Write the classic contract without the attribute that says when frames are sent.

    795 bits don't fit 0.5 ms at 1 Mbit/s, so a host refuses; vcan has no bit rate, and such a contract isn't judged.
    """
    path = folder / "arm.dbc"
    kept = [line for line in (contract_folder() / "arm.dbc").read_text().splitlines() if '"Trigger"' not in line]
    path.write_text("\n".join(kept) + "\n")
    return path


def run_beside_yardstick(chosen: argparse.Namespace, period_us: int, contract: str, base: str) -> dict[str, Any]:
    """Run host and yardstick in alternating blocks, `minutes` each. Raises TimingError."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        program, reason = yardstick.build(folder)
        if program is None:
            raise TimingError(reason)
        config = patient_config(folder, base, period_us, chosen.settings)
        options = ["--dbc", contract_without_budget(folder)] if contract == "arm" and period_us < 1000 else []
        runs = [
            yardstick_run(program, CHANNEL, folder, period_us, contract),
            host_run(CHANNEL, folder, config, *map(str, options)),
        ]
        total_s = chosen.minutes * 60.0
        rounds = max(1, round(total_s / BLOCK_S))
        devices = ["--contract", contract, "--clock", chosen.clock]
        blocks = measure(runs, rounds, total_s / rounds, period_us, folder, *devices)
        return summarise(blocks)


def run_cycle(chosen: argparse.Namespace) -> dict[str, Any]:
    """Measure 1 kHz."""
    return {"classic, 1 kHz": run_beside_yardstick(chosen, 1000, "arm", "paper")}


def run_rates(chosen: argparse.Namespace) -> dict[str, Any]:
    """Measure 2 kHz, with classic frames and with CAN FD's."""
    return {
        "classic, 2 kHz": run_beside_yardstick(chosen, 500, "arm", "paper"),
        "CAN FD, 2 kHz": run_beside_yardstick(chosen, 500, "arm_fd_500us", "fd_500us"),
    }


def show_sides(result: dict[str, Any]) -> str:
    """Lay out what `run_cycle` and `run_rates` measured."""
    parts = []
    for name, described in result.items():
        beyond = described["host"]["overruns_per_100000"] - described["yardstick"]["overruns_per_100000"]
        parts.append(f"{name}\n{as_text(described)}\noverruns beyond the yardstick's, per 100,000: {beyond:.1f}")
    return "\n\n".join(parts)


Measurement = Callable[[argparse.Namespace], dict[str, Any]]
COMMANDS: dict[str, tuple[Measurement, Callable[[dict[str, Any]], str]]] = {
    "cycle": (run_cycle, show_sides),
    "rates": (run_rates, show_sides),
    "hour": (run_hour, show_hour),
    "disk": (run_disk, show_disk),
    "hogs": (run_hogs, show_hogs),
    "clock": (run_clock, show_clock),
}

FINISHES = {"hour": finish_hour, "hogs": finish_hogs}
"""What is made of a result outside of a guest."""


def parse_arguments(argv: Sequence[str]) -> argparse.Namespace:
    """Read the command line; exits with 2 on a usage error."""
    parser = argparse.ArgumentParser(prog=PROGRAM, description="Long measurements of the cycle over vcan.")
    commands = parser.add_subparsers(dest="command", required=True)
    for name, minutes in (("cycle", 10.0), ("rates", 2.0), ("hour", 60.0), ("hogs", 10.0)):
        command = commands.add_parser(name)
        command.add_argument("--minutes", type=float, default=minutes, help="of each side; default %(default)s")
    period = "SYNC period in µs; default %(default)s"
    for name in ("hour", "hogs"):
        commands.choices[name].add_argument("--period-us", type=int, default=1000, help=period)
        every = "seconds from contact to contact; default %(default)s"
        commands.choices[name].add_argument("--every", type=float, default=3.0, help=every)
    hogs = commands.choices["hogs"]
    hogs.add_argument("--processors", type=int, default=2, help="processes that burn time; default %(default)s")
    hogs.add_argument("--disks", type=int, default=1, help="processes that write and sync; default %(default)s")
    hogs.add_argument("--base", default="certified", help="configuration; default %(default)s")
    disk = commands.add_parser("disk")
    disk.add_argument("--seconds", type=float, default=20.0, help="before and during each case; default %(default)s")
    disk.add_argument("--stopped", type=float, default=STOPPED_S, help="seconds of SIGSTOP; default %(default)s")
    clock = commands.add_parser("clock")
    clock.add_argument("--seconds", type=float, default=10.0, help="before and after each step; default %(default)s")
    clock.add_argument("--step", action="append", choices=list(STEPS_S), help="only this one; may be repeated")
    disk.add_argument("--case", action="append", choices=DISK_CASES, help="only this one; may be repeated")
    for command in commands.choices.values():
        command.add_argument("--out", type=Path, metavar="FOLDER", help="default runs/timing-COMMAND")
        command.add_argument("--settings", default="", metavar="TOML", help="more for the host's configuration")
        command.add_argument(
            "--clock", choices=("sync", "wall"), default="sync", help="of the emulated arm; default %(default)s"
        )
        command.add_argument("--inside", action="store_true", help=f"on an interface {CHANNEL} that is up")
        command.add_argument("--mem", default="2G", help="of the guest, where there is one; default %(default)s")
    chosen = parser.parse_args(argv)
    if chosen.command in ("hour", "hogs") and not chosen.every > CONTACT_S:
        parser.error(f"--every = {chosen.every:g} s must be above the {CONTACT_S:g} s that a contact takes")
    if chosen.out is None:
        chosen.out = RUNS / f"timing-{chosen.command}"
    if re.search(r"^\s*period_us\b", chosen.settings, re.MULTILINE):
        parser.error("--settings can't change period_us: what is measured depends on it")
    return chosen


def main(argv: Sequence[str]) -> int:
    """Measure, write and print."""
    chosen = parse_arguments(argv)
    measure_it, show = COMMANDS[chosen.command]
    raw = chosen.out / "raw.json"
    if chosen.inside:
        try:
            raw.write_text(json.dumps(measure_it(chosen)))
        except (TimingError, RuntimeError) as error:
            print(f"{PROGRAM}: {error}", file=sys.stderr)
            return 1
        return 0
    chosen.out.mkdir(parents=True, exist_ok=True)
    raw.unlink(missing_ok=True)
    again = [sys.executable, __file__, *argv, "--inside", "--out", str(chosen.out)]
    launcher = [ROOT / "tools" / "with-vcan", "--can", CHANNEL, "--mem", chosen.mem, "--", *again]
    status = subprocess.run(launcher, check=False).returncode
    if status or not raw.exists():
        return status or 1
    result = json.loads(raw.read_text())
    try:
        result = FINISHES[chosen.command](chosen, result) if chosen.command in FINISHES else result
    except TimingError as error:
        print(f"{PROGRAM}: {error}", file=sys.stderr)
        return 1
    date = time.strftime("%Y-%m-%d %H:%M")
    machine = f"{platform.machine()}, {os.cpu_count()} CPUs, Python {platform.python_version()}, {date}"
    text = f"{chosen.command}; {machine}\n{show(result)}\n"
    (chosen.out / "result.json").write_text(json.dumps({"machine": machine, **result}, indent=2) + "\n")
    (chosen.out / "result.txt").write_text(text)
    print(text, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
