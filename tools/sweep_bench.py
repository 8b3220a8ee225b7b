"""Measures a sweep: one worker, two, two of which one is killed halfway, and a scheduler started by hand.

Replays of short runs of the emulated arm, `--logs` of them, with `--settings` thresholds each. The tables have to be
the same, but for nothing.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from pyarrow import parquet

from adacd_hil.lab.tune.sweep import TABLE_NAME

BIN = Path(sys.executable).parent


def sweep(logs: Path, out: Path, settings: int, *more: str, kill_at: float | None = None) -> dict[str, object]:
    """Run the command; return what it printed. `kill_at`: share of the rows after which a worker is killed."""
    values = ",".join(f"{0.05 + 0.5 * k / settings:.6f}" for k in range(settings))
    command = [BIN / "adacd-hil", "sweep", logs, "--vary", f"detector.threshold_Nm={values}", "--out", out, "--json"]
    process = subprocess.Popen([*command, *more], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    said = []
    is_killed = kill_at is None
    for line in process.stderr:
        said.append(line)
        print(f"  {line}", end="", file=sys.stderr)
        words = line.split()
        if not is_killed and len(words) > 3 and words[1] == "of" and int(words[0]) >= kill_at * int(words[2]):
            os.kill(worker_of(process.pid), signal.SIGKILL)
            is_killed = True
            print(f"  killed a worker at row {words[0]}", file=sys.stderr)
    stdout, _ = process.communicate()
    if process.returncode or not is_killed:
        sys.exit(f"sweep ended with {process.returncode}, killed: {is_killed}: {''.join(said)}")
    return json.loads(stdout)


def worker_of(pid: int) -> int:
    """Return a process below this one that has computed most."""
    below, found = [pid], []
    while below:
        parent = below.pop()
        children = [
            int(child)
            for thread in Path(f"/proc/{parent}/task").glob("*/children")
            for child in thread.read_text().split()
        ]
        found += children
        below += children
    spent = {child: sum(map(int, Path(f"/proc/{child}/stat").read_text().split()[13:15])) for child in found}
    return max(spent, key=lambda child: spent[child])


def rows(out: Path) -> list[dict[str, object]]:
    """Read the table."""
    return parquet.read_table(out / TABLE_NAME).to_pylist()


def main() -> None:
    """Play the runs, sweep over them, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=10)
    parser.add_argument("--settings", type=int, default=100)
    parser.add_argument("--scenario", default="idle")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for seed in range(arguments.logs):
            print(f"playing {seed + 1} of {arguments.logs}", file=sys.stderr)
            demo = [BIN / "adacd-hil", "demo", "--config", "paper", "--scenario", arguments.scenario]
            out = folder / "logs" / str(seed)
            subprocess.run([*demo, "--seed", str(seed), "--out", out], check=True, capture_output=True)
        logs = folder / "logs"
        results = {
            "one worker": sweep(logs, folder / "one", arguments.settings, "--workers", "1"),
            "two workers": sweep(logs, folder / "two", arguments.settings, "--workers", "2"),
            "two, one killed": sweep(logs, folder / "killed", arguments.settings, "--workers", "2", kill_at=0.3),
        }
        scheduler_file = folder / "scheduler.json"
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        scheduler = subprocess.Popen(
            [BIN / "dask", "scheduler", "--scheduler-file", scheduler_file, "--no-dashboard", "--port", "0"], **quiet
        )
        while not scheduler_file.exists():
            time.sleep(0.1)  # Dask's file: there is nothing to wait on
        command = [BIN / "dask", "worker", "--scheduler-file", scheduler_file, "--nthreads", "1", "--no-dashboard"]
        workers = [subprocess.Popen(command, **quiet) for _ in range(2)]
        try:
            address = json.loads(scheduler_file.read_text())["address"]
            results["by hand"] = sweep(logs, folder / "hand", arguments.settings, "--scheduler", address)
        finally:
            for process in (*workers, scheduler):
                process.terminate()
        for label, result in results.items():
            print(f"{label:18} {result['rows']} rows, {result['failed']} failed, {result['rows_per_s']} rows/s")
        speed_up = results["two workers"]["rows_per_s"] / results["one worker"]["rows_per_s"]
        print(f"speed-up of two workers {speed_up:.2f}")
        same = all(rows(folder / other) == rows(folder / "one") for other in ("two", "killed", "hand"))
        print(f"tables {'equal' if same else 'DIFFER'}; {os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}")
        sys.exit(0 if same else 1)


if __name__ == "__main__":
    main()
