"""Measures what reading and replaying a log costs: time, processor time, memory.

    python tools/replay_bench.py                              four lengths, made of one run by repetition; reading
    python tools/replay_bench.py --run runs/demo/run.mcap     the same of a run that is there
    python tools/replay_bench.py --played --seconds 60 300    the emulated arm plays each length; reading and replay

Runs are repeated by `long_log.py`. Each figure is the best of some fresh processes, compiled code in the cache; the
first to fill it doesn't count. Absolute figures are this machine's; what grows with the length must be time alone, in
proportion.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from long_log import LongLog, write

from adacd_hil.log.log_files import LOG_NAME, find_parts
from adacd_hil.log.reader import LogStream
from adacd_hil.log.types.record_arrays import FRAME_TOPICS
from adacd_hil.log.types.topics import CONTACT, CONTROL, CYCLE, EVENTS, SCHEME

ROOT = Path(__file__).resolve().parent.parent
SECONDS = (60, 300, 900, 3600)
REPLAYED = (SCHEME.name, CONTROL.name, CYCLE.name, CONTACT.name, EVENTS.name)
FRAMES = tuple(FRAME_TOPICS)
HOUR_S = 3600.0
CLI = "from adacd_hil.cli.main import main; main()"
LAUNCH = """
import json, resource, subprocess, sys, time
start_s = time.perf_counter()
status = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL).returncode
wall_s = time.perf_counter() - start_s
usage = resource.getrusage(resource.RUSAGE_CHILDREN)
cpu_s = usage.ru_utime + usage.ru_stime
print(json.dumps({"wall_s": wall_s, "cpu_s": cpu_s, "peak_MB": usage.ru_maxrss / 1e3, "status": status}))
"""
"""A small process between: a child's most memory is at least what its parent had when it was made."""
READ = """
import json, sys
sys.path.insert(0, sys.argv[1])
from replay_bench import read
print(json.dumps(read(sys.argv[2])))
"""


def read(path: str) -> dict[str, Any]:
    """Read what a replay needs of a log."""
    stream = LogStream(Path(path), (*REPLAYED, *FRAMES))
    cycles = frames = 0
    for piece in stream:
        cycles += len(piece.series[CYCLE.name])
        frames += len(piece.frames)
    return {"cycles": cycles, "frames": frames, "problem": stream.problem}


def play(folder: Path, seconds: float) -> Path:
    """Let the emulated arm play a run of that length in which nothing happens."""
    scenario = folder / f"idle_{seconds:g}.toml"
    text = (ROOT / "firmware_sim" / "scenarios" / "idle.toml").read_text()
    lines = [f"lasts_s = {seconds:.1f}" if line.startswith("lasts_s") else line for line in text.splitlines()]
    scenario.write_text("\n".join(lines) + "\n")
    out = folder / f"played_{seconds:g}"
    subprocess.run(
        [sys.executable, "-c", CLI, "demo", "--scenario", str(scenario), "--out", str(out), "--json"],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    return out / LOG_NAME


def measure(command: list[str]) -> dict[str, float]:
    """Run a command; return its time, its processors' time, the most memory it had and its exit status."""
    launched = subprocess.run([sys.executable, "-c", LAUNCH, *command], capture_output=True, text=True, check=True)
    figures: dict[str, float] = json.loads(launched.stdout)
    return figures


def best(command: list[str], repeats: int) -> dict[str, float]:
    """Measure a command some times; return the quickest."""
    return min((measure(command) for _ in range(repeats)), key=lambda figures: figures["wall_s"])


def has_replay() -> bool:
    """Say whether there is the command `replay`."""
    command = [sys.executable, "-c", CLI, "replay", "--help"]
    return subprocess.run(command, check=False, capture_output=True).returncode == 0


def rows(chosen: argparse.Namespace, folder: Path) -> Iterator[str]:
    """Make the logs, measure, and describe each in a line; the last is of the shortest and the longest log."""
    if not chosen.played:
        repeated = LongLog(chosen.run or play(folder, min(chosen.seconds)))
    does_replay = chosen.played and has_replay()
    found: dict[str, list[tuple[float, float]]] = {}
    for seconds in sorted(chosen.seconds):
        if chosen.played:
            path = play(folder, seconds)
        else:
            path = folder / f"repeated_{seconds:g}.mcap"
            write(repeated, path, seconds, None, is_truth=False)
        parts = find_parts(path)
        cycles = read(str(path))["cycles"]
        lasts_s = cycles / 1000.0
        size_MB = sum(part.stat().st_size for part in parts.values()) / 1e6
        commands = {"read": [sys.executable, "-c", READ, str(Path(__file__).parent), str(path)]}
        if does_replay:
            commands["replay"] = [sys.executable, "-c", CLI, "replay", str(path), "--json"]
        for name, command in commands.items():
            figures = best(command, chosen.repeats)
            found.setdefault(name, []).append((lasts_s, figures["wall_s"]))
            yield (
                f"{name:7} {lasts_s:8.0f} {size_MB:8.0f} {len(parts):5d} {figures['wall_s']:8.2f} "
                f"{figures['cpu_s']:8.2f} {figures['peak_MB']:8.0f} {lasts_s / figures['wall_s']:8.0f} "
                f"{figures['status']:6.0f}"
            )
        for part in parts.values():
            part.unlink()
    for name, points in found.items():
        (first_s, first), (last_s, last) = points[0], points[-1]
        if last_s > first_s:
            rate = (last - first) / (last_s - first_s)
            yield f"{name}: {rate * HOUR_S:.2f} s for each hour and {first - rate * first_s:.2f} s besides"


def main() -> int:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, help="the run to repeat; default: one in which nothing happens")
    parser.add_argument("--played", action="store_true", help="play each length with the emulated arm")
    parser.add_argument("--seconds", type=float, nargs="+", default=SECONDS, help="lengths of the logs")
    parser.add_argument("--repeats", type=int, default=3, help="processes of which the quickest counts")
    parser.add_argument("--folder", type=Path, help="for the logs, 0.9 MB per second; default: a temporary one")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=chosen.folder) as folder:
        print(
            f"{'':7} {'log s':>8} {'MB':>8} {'parts':>5} {'time s':>8} {'proc. s':>8} {'peak MB':>8} "
            f"{'x real':>8} {'status':>6}"
        )
        for line in rows(chosen, Path(folder)):
            print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
