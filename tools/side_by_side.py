"""The cycle of the host beside the C yardstick's and the straightforward loop's: in turn, on one bus, in one run.

A *block* is one of them for some seconds against the emulator. Blocks alternate, so that what the machine does
besides hits all alike. Each process writes down its own times. How long it works per cycle is seen from outside: a
preloaded library (waits.c) notes when it waits. CPU clocks are read besides, in windows of a fifth of a second, where
the kernel's account is fine enough.
"""

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yardstick
from numpy.typing import NDArray

import adacd_hil
from adacd_hil.cli.output import ExitCode
from adacd_hil.log.log_files import LOG_NAME
from adacd_hil.log.reader import RunLog, read_log
from adacd_hil.log.types.topics import CYCLE
from adacd_hil.score.distribution import PERCENTILE_NAMES, PERCENTILES
from adacd_hil.wire.dbc_contract import contract_folder, load_codec

ROOT = Path(__file__).resolve().parent.parent
BIN = Path(sys.executable).parent
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(adacd_hil.__file__).resolve().parents[1])}
WAITS = Path(__file__).resolve().parent / "waits.c"
FINE_STEP_NS = 1_000_000
CHANNEL = "vcan0"
HOST, YARDSTICK, STRAIGHTFORWARD = "host", "yardstick", "straightforward"
SETTLE_S = 1.0
WINDOW_S = 0.2
WINDOW_TRIES = 4
QUIET_PERCENT = 10.0
START_LIMIT_S = 120.0
END_LIMIT_S = 30.0
ENDED_WELL = (ExitCode.OK, ExitCode.PARTIAL, ExitCode.INTERRUPTED)
"""PARTIAL: the log lacks what the machine had no time to write; INTERRUPTED: by SIGINT, as asked."""
TITLES = {
    "lateness": "lateness of wake-up",
    "stamp": "SYNC out to last frame's stamp",
    "answer": "last frame's stamp to last command out",
    "command": "SYNC out to last command out",
    "read": "last frame read to last command out",
}
"""The times of a cycle. The stamp is the kernel's, of the reception of the last frame. When that was read, the host
doesn't say: it reads no clock then.
"""
PATIENT = """
extends = "{base}"

[bus]  # a machine that stalls is to be measured, not to fault the arm
period_us = {period_us}
command_patience_cycles = 250
sync_patience_periods = 25.5
max_age_cycles = 100
heartbeat_ms = 1000

[operator]
script = []
acknowledge_after_s = 0.4
acknowledge_faults = 1000
acknowledge_fault_after_s = 0.1

[realtime]
misses = 1000000
sample_period = "nominal"  # the emulated arm moves one period per SYNC
"""
"""Configuration of a measured run."""


class TimingError(Exception):
    """A process that is measured did not run; one line."""


@dataclass(frozen=True)
class Window:
    """CPU time in ns that each process had used at some time `t_ns` of the monotonic clock."""

    t_ns: int
    cpu_ns: dict[str, int]


@dataclass(frozen=True)
class Block:
    """One process for some seconds. Arrays (n,) of the cycles of the measured part, int64 ns.

    cpu_us: µs per cycle by process, a value per window. work_us: µs of each cycle in which the process didn't wait;
    empty where that was not noted. overruns: periods skipped within the measured part.
    """

    name: str
    period_us: int
    due_ns: NDArray[np.int64]
    times_ns: dict[str, NDArray[np.int64]]
    cpu_us: dict[str, NDArray[np.float64]]
    overruns: int
    frames_lost: int
    work_us: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    scheduler: str = ""
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def cycles(self) -> int:
        """Count the measured cycles."""
        return len(self.due_ns)

    def cpu_per_cycle_us(self, process: str, percent: float = 50.0) -> float:
        """Return a percentile of the CPU time per cycle of a process, µs; NaN when it was not seen."""
        values = self.cpu_us.get(process, np.empty(0))
        return float(np.percentile(values, percent)) if values.size else float("nan")

    def work_per_cycle_us(self, percent: float = 50.0) -> float:
        """Return a percentile of the time per cycle in which the process didn't wait, µs; NaN when not noted."""
        return float(np.percentile(self.work_us, percent)) if self.work_us.size else float("nan")


@dataclass(frozen=True)
class Run:
    """How to run one of the three, and how to read what it wrote: dues, times, the rest."""

    name: str
    command: list[str | Path]
    read: Callable[[str], tuple[NDArray[np.int64], dict[str, NDArray[np.int64]], dict[str, Any]]]
    has_logger: bool = False
    log_folder: Path | None = None
    """Where it logs; what an earlier block has logged there goes before it runs again."""


def count_overruns(due_ns: NDArray[np.int64], period_us: int) -> int:
    """Count the periods that are missing between cycles."""
    return int(np.sum(np.rint(np.diff(due_ns) / (period_us * 1000.0)).astype(np.int64) - 1)) if len(due_ns) > 1 else 0


def cpu_per_cycle(windows: Sequence[Window], due_ns: NDArray[np.int64], process: str) -> NDArray[np.float64]:
    """Divide the CPU time of each window by the cycles that began in it, µs; windows without a cycle are left out."""
    values = []
    for before, after in itertools.pairwise(windows):
        count = int(np.count_nonzero((due_ns >= before.t_ns) & (due_ns < after.t_ns)))
        if count > 0 and process in before.cpu_ns and process in after.cpu_ns:
            values.append((after.cpu_ns[process] - before.cpu_ns[process]) * 1e-3 / count)
    return np.array(values, np.float64)


def work_per_cycle(path: Path, begin_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Add up, for all cycles but the last, the time in which a process didn't wait, µs; empty without a file.

    begin_ns (n,): when each cycle began. What is noted is in ticks of the processor's counter, but for the first two
    rows, which say what they are in ns.
    """
    if not path.exists() or len(begin_ns) < 2:
        return np.empty(0)
    noted = np.fromfile(path, np.int64).reshape(-1, 2)
    (start, start_ns), (end, end_ns) = noted[:2].tolist()
    waits_ns = (noted[2:] - start) * ((end_ns - start_ns) / (end - start)) + start_ns
    stretch_ns = np.stack((waits_ns[:-1, 1], waits_ns[1:, 0]), axis=1)
    done_ns = np.cumsum(np.maximum(stretch_ns[:, 1] - stretch_ns[:, 0], 0.0))
    before_ns = np.concatenate(([0], done_ns[:-1]))
    worked_ns = np.interp(begin_ns, stretch_ns.ravel(), np.stack((before_ns, done_ns), axis=1).ravel())
    return np.diff(worked_ns) * 1e-3


def is_cpu_clock_fine() -> bool:
    """Return whether this kernel's account of CPU time moves in steps that tell cycles apart."""
    begin_ns = now_ns = time.process_time_ns()
    while now_ns == begin_ns:
        now_ns = time.process_time_ns()
    return now_ns - begin_ns < FINE_STEP_NS


def cpu_clock_ns(pid: int) -> int:
    """Read the CPU time of all threads of another process, ns (clock_getcpuclockid). Raises OSError when it is gone."""
    return time.clock_gettime_ns((~pid << 3) | 2)


def children_of(pid: int) -> list[int]:
    """List the child processes of a process, as /proc shows them."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rsplit(")", 1)[1].split()
            except OSError:
                continue
            if int(fields[1]) == pid:
                found.append(int(entry.name))
    return found


@contextmanager
def emulator(channel: str, *options: str, folder: Path) -> Iterator["subprocess.Popen[Any]"]:
    """Run the emulated arm while the block lasts. Raises TimingError when it doesn't begin."""
    complaints = folder / "emulator.stderr"
    with complaints.open("w") as stderr, (folder / "emulator.json").open("w") as stdout:
        command = [BIN / "firmware-sim", "run", "-i", "socketcan", "-c", channel, "--json", *options]
        process = subprocess.Popen(command, stdout=stdout, stderr=stderr, env=ENVIRONMENT)
        try:
            wait_for("ready", process, complaints)
            yield process
        finally:
            process.terminate()
            try:
                process.wait(END_LIMIT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                raise TimingError(f"firmware-sim did not end within {END_LIMIT_S:g} s of SIGTERM") from None


def wait_for(word: str, process: "subprocess.Popen[Any]", complaints: Path) -> None:
    """Wait until a line on stderr is `word`. Raises TimingError with what it says when the process ends before."""
    limit_s = time.monotonic() + START_LIMIT_S
    while word not in complaints.read_text().splitlines():
        if process.poll() is not None or time.monotonic() > limit_s:
            text = " | ".join(complaints.read_text().split("\n")).strip(" |")
            raise TimingError(f"{Path(str(process.args[0])).name} did not get to {word!r}: {text}")  # type: ignore[index]
        time.sleep(0.05)  # another process writes the file: there is nothing to wait on


def take_window(pids: dict[str, int]) -> Window:
    """Read the CPU clocks of some processes; one that has gone is left out.

    Of some tries the quickest counts: between the clocks of a slow one the processes have worked.
    """
    tries: list[tuple[int, Window]] = []
    for _ in range(WINDOW_TRIES):
        used = {}
        t_ns = time.monotonic_ns()
        for name, pid in pids.items():
            try:
                used[name] = cpu_clock_ns(pid)
            except OSError:
                continue
        tries.append((time.monotonic_ns() - t_ns, Window(t_ns, used)))
    return min(tries, key=lambda each: each[0])[1]


class Running:
    """A process that has begun its cycles. `complaints`: what it says on stderr."""

    def __init__(self, process: "subprocess.Popen[str]", complaints: Path, has_logger: bool) -> None:
        self.process = process
        self.complaints = complaints
        self.logger_pid = children_of(process.pid)[0] if has_logger else None
        self.said = ""

    @property
    def told(self) -> dict[str, Any]:
        """What it printed as JSON; empty without a word."""
        return json.loads(self.said) if self.said.strip() else {}

    def end(self) -> int:
        """Send SIGINT, wait and return the exit status; what was printed is in `said`."""
        self.process.send_signal(signal.SIGINT)
        self.said, _ = self.process.communicate(timeout=END_LIMIT_S)
        return self.process.returncode


def waits_path(run: Run, folder: Path) -> Path:
    """Name the file of a process's waits."""
    return folder / f"{run.name}.waits"


@contextmanager
def running(run: Run, folder: Path, preload: Path | None = None) -> Iterator[Running]:
    """Run one of the three while the block lasts; with `preload`, its waits are noted.

    Raises TimingError when it doesn't begin its cycles.
    """
    complaints = folder / f"{run.name}.stderr"
    environment = dict(ENVIRONMENT)
    if run.log_folder is not None:
        shutil.rmtree(run.log_folder, ignore_errors=True)
    if preload is not None:
        waits_path(run, folder).unlink(missing_ok=True)
        environment |= {"LD_PRELOAD": str(preload), "WAITS": str(waits_path(run, folder))}
    with complaints.open("w") as stderr:
        process = subprocess.Popen(run.command, stdout=subprocess.PIPE, stderr=stderr, text=True, env=environment)
    try:
        wait_for("running", process, complaints)
        yield Running(process, complaints, run.has_logger)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()


def run_block(
    run: Run, seconds: float, period_us: int, emulator_pid: int, folder: Path, preload: Path | None = None
) -> Block:
    """Run one block and read what it says. Raises TimingError."""
    with running(run, folder, preload) as begun:
        time.sleep(SETTLE_S)  # what is measured begins once it cycles
        pids = {run.name: begun.process.pid, "emulator": emulator_pid}
        if begun.logger_pid is not None:
            pids["logger"] = begun.logger_pid
        windows = [take_window(pids)]
        begin_s = time.monotonic()
        while time.monotonic() - begin_s < seconds and begun.process.poll() is None:
            time.sleep(WINDOW_S)  # as long as a window lasts
            windows.append(take_window(pids))
        status = begun.end()
        if status not in ENDED_WELL:
            raise TimingError(f"{run.name} ended with status {status}: {begun.complaints.read_text().strip()[-400:]}")
    due_ns, times_ns, rest = run.read(begun.said)
    measured = (due_ns >= windows[0].t_ns) & (due_ns < windows[-1].t_ns)
    due_ns = due_ns[measured]
    if not len(due_ns):
        raise TimingError(f"{run.name} made no cycle in the measured part")
    return Block(
        name=run.name,
        period_us=period_us,
        due_ns=due_ns,
        times_ns={name: values[measured] for name, values in times_ns.items()},
        cpu_us={name: cpu_per_cycle(windows, due_ns, name) for name in pids if is_cpu_clock_fine()},
        work_us=work_per_cycle(waits_path(run, folder), due_ns + times_ns["lateness"][measured]),
        overruns=count_overruns(due_ns, period_us),
        frames_lost=rest.pop("frames_lost", 0),
        scheduler=rest.pop("scheduler", ""),
        notes=rest,
    )


def read_samples(path: Path, columns: Sequence[str]) -> tuple[NDArray[np.int64], dict[str, NDArray[np.int64]]]:
    """Read the samples of the yardstick or the straightforward loop."""
    rows = np.fromfile(path, np.int64).reshape(-1, len(columns))
    column = {name: rows[:, place] for place, name in enumerate(columns)}
    stamp_ns = column["command"] - column["answer"]
    times_ns = {name: column[name] for name in ("lateness", "answer", "command")}
    return rows[:, 0], {**times_ns, "stamp": stamp_ns, "read": column["compute"]}


def yardstick_run(program: Path, channel: str, folder: Path, period_us: int, contract: str = "arm") -> Run:
    """Say how the yardstick is run."""
    samples = folder / "yardstick.samples"
    codec = load_codec(contract_folder() / f"{contract}.dbc")
    longest_s = 1200.0

    def read(said: str) -> tuple[NDArray[np.int64], dict[str, NDArray[np.int64]], dict[str, Any]]:
        described = json.loads(said)
        kept = ("frames_lost", "scheduler", "cycles_incomplete", "cycles_unsent")
        return *read_samples(samples, yardstick.COLUMNS), {name: described[name] for name in kept}

    arguments = yardstick.arguments(codec, channel, period_us, longest_s, 0.0, samples)
    return Run(YARDSTICK, [program, *arguments], read)


def straightforward_run(channel: str, folder: Path) -> Run:
    """Say how the straightforward loop is run."""
    samples, log = folder / "straightforward.samples", folder / "straightforward.mcap"
    program = ROOT / "tools" / "straightforward.py"

    def read(said: str) -> tuple[NDArray[np.int64], dict[str, NDArray[np.int64]], dict[str, Any]]:
        described = json.loads(said)
        kept = ("scheduler", "cycles_incomplete", "frames_rejected")
        return *read_samples(samples, yardstick.COLUMNS), {name: described[name] for name in kept}

    command = [sys.executable, program, "-c", channel, "--log", log, "--samples", samples]
    return Run(STRAIGHTFORWARD, command, read)


def host_run(channel: str, folder: Path, config: Path, *options: str) -> Run:
    """Say how the host is run; its log is in folder/host."""
    out = folder / "host"

    def read(said: str) -> tuple[NDArray[np.int64], dict[str, NDArray[np.int64]], dict[str, Any]]:
        described = json.loads(said) if said.strip() else {}
        due_ns, times_ns, rest = read_cycles(read_log(out / LOG_NAME, (CYCLE.name,)))
        times_ns["stamp"], times_ns["answer"] = times_ns.pop("feedback"), times_ns.pop("compute")
        kept = ("dropped", "fault", "recoveries", "log_error")
        return due_ns, times_ns, rest | {name: described[name] for name in kept if name in described}

    command = [BIN / "adacd-hil", "run", "-i", "socketcan", "-c", channel, "--config", config, "--clock", "realtime"]
    return Run(HOST, [*command, "--out", out, "--json", *options], read, has_logger=True, log_folder=out)


def read_cycles(log: RunLog) -> tuple[NDArray[np.int64], dict[str, NDArray[np.int64]], dict[str, Any]]:
    """Take the times of the cycles from a log. Raises TimingError when it has none."""
    cycle = {name: np.asarray(log.cycle[name], np.int64) for name in log.cycle.fields}
    t_ns = log.cycle.t_ns
    if not len(t_ns):
        raise TimingError("the host's log has no cycle")
    feedback_ns, command_ns = cycle["feedback_ns"], cycle["command_ns"]
    times_ns = {
        "lateness": cycle["lateness_ns"],
        "feedback": feedback_ns,
        "compute": command_ns - feedback_ns,
        "command": command_ns,
    }
    scheduler = log.metadata.get("scheduler", "")
    lost = int(np.ptp(cycle["frames_lost"])) if "frames_lost" in cycle else 0
    return t_ns - cycle["lateness_ns"], times_ns, {"frames_lost": lost, "scheduler": scheduler}


def patient_config(folder: Path, base: str = "paper", period_us: int = 1000, more: str = "") -> Path:
    """Write the configuration of a measured run; `more` is TOML that outweighs it."""
    patient, path = folder / "patient.toml", folder / "measured.toml"
    patient.write_text(PATIENT.format(base=base, period_us=period_us))
    path.write_text(f'extends = "{patient.resolve()}"\n{more}\n')
    return path


def measure(
    runs: Sequence[Run], rounds: int, seconds: float, period_us: int, folder: Path, *devices: str
) -> dict[str, list[Block]]:
    """Run the blocks in turn, each of `seconds` and with an emulator of its own; progress on stderr.

    `devices`: options of the emulator. Raises TimingError.
    """
    blocks: dict[str, list[Block]] = {run.name: [] for run in runs}
    preload, _ = yardstick.build(folder, WAITS, "-shared", "-fPIC", "-ldl")
    for number in range(rounds):
        for run in runs:
            with emulator(CHANNEL, "--scenario", "idle", *devices, folder=folder) as played:
                block = run_block(run, seconds, period_us, played.pid, folder, preload)
            blocks[run.name].append(block)
            print(
                f"round {number + 1}/{rounds}  {run.name:16} {block.cycles} cycles, {block.overruns} overruns, "
                f"{block.work_per_cycle_us():.0f} µs of work per cycle",
                file=sys.stderr,
                flush=True,
            )
    return blocks


def play_each(names: Iterable[str], play: Callable[[str, Path], dict[str, Any]]) -> dict[str, Any]:
    """Play cases one after the other, each in a folder of its own in memory; a TimingError costs its case only."""
    result: dict[str, Any] = {}
    for name in names:
        print(name, file=sys.stderr, flush=True)
        with tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
            try:
                result[name] = play(name, Path(folder))
            except TimingError as error:
                result[name] = {"problem": str(error)}
    return result


def show_each(title: str, result: dict[str, Any], lines_of: Callable[[str, dict[str, Any]], list[str]]) -> str:
    """Lay out what `play_each` returned, below a head of this title."""
    lines = [head(title)]
    for name, each in result.items():
        lines += [f"{name}: {each['problem']}"] if "problem" in each else lines_of(name, each)
    return "\n".join(lines)


def time_percentiles_us(times_ns: NDArray[np.int64]) -> list[float]:
    """Return PERCENTILES, µs; empty without a value."""
    return [float(value) * 1e-3 for value in np.percentile(times_ns, PERCENTILES)] if len(times_ns) else []


def head(title: str) -> str:
    """Lay out the line above rows of percentiles."""
    return f"{title:54} {' '.join(f'{name:>8}' for name in PERCENTILE_NAMES)}"


def row(name: str, values: Sequence[float]) -> str:
    """Lay out one row of percentiles."""
    return f"{name:54} " + " ".join(f"{value:8.1f}" for value in values)


def ratios(above: Sequence[Block], below: Sequence[Block], value: Callable[[Block], float]) -> list[float]:
    """Divide round by round: the median of the rounds, the lowest, the highest; NaN where there's nothing to divide."""
    each = np.array([value(a) / value(b) if value(b) > 0.0 else np.nan for a, b in zip(above, below, strict=True)])
    return [float(np.median(each)), float(each.min()), float(each.max())]


def per_100_000(blocks: Sequence[Block]) -> float:
    """Return the periods skipped per 100,000 periods of the measured parts."""
    overruns = sum(block.overruns for block in blocks)
    return overruns * 1e5 / max(sum(block.cycles for block in blocks) + overruns, 1)


def summarise(blocks: dict[str, list[Block]]) -> dict[str, Any]:
    """Put the figures of all blocks together, for people and machines."""
    described: dict[str, Any] = {}
    for name, each in blocks.items():
        described[name] = {
            "scheduler": each[0].scheduler,
            "period_us": each[0].period_us,
            "blocks": len(each),
            "cycles": sum(block.cycles for block in each),
            "overruns": sum(block.overruns for block in each),
            "overruns_per_100000": per_100_000(each),
            "frames_lost": sum(block.frames_lost for block in each),
            "cpu_us": float(np.median([block.cpu_per_cycle_us(name) for block in each])),
            "work_us": float(np.median([block.work_per_cycle_us() for block in each])),
            "work_quiet_us": float(np.median([block.work_per_cycle_us(QUIET_PERCENT) for block in each])),
            "cpu_of_others_us": {
                other: float(np.median([block.cpu_per_cycle_us(other) for block in each]))
                for other in each[0].cpu_us
                if other != name
            },
            "times_us": {
                time_name: time_percentiles_us(np.concatenate([block.times_ns[time_name] for block in each]))
                for time_name in each[0].times_ns
            },
            "notes": [block.notes for block in each],
        }
    pairs = [(HOST, YARDSTICK), (STRAIGHTFORWARD, HOST)]
    described["ratios"] = {
        f"{above}/{below}": {
            "cpu": ratios(blocks[above], blocks[below], lambda block: block.cpu_per_cycle_us(block.name)),
            "work": ratios(blocks[above], blocks[below], Block.work_per_cycle_us),
            "work_quiet": ratios(blocks[above], blocks[below], lambda block: block.work_per_cycle_us(QUIET_PERCENT)),
            "command_p50": ratios(
                blocks[above], blocks[below], lambda block: float(np.median(block.times_ns["command"]))
            ),
            "answer_p50": ratios(
                blocks[above], blocks[below], lambda block: float(np.median(block.times_ns["answer"]))
            ),
        }
        for above, below in pairs
        if blocks.get(above) and blocks.get(below)
    }
    return described


def as_text(described: dict[str, Any]) -> str:
    """Lay the figures out as a table."""
    lines = [head("µs")]
    names = [name for name in (YARDSTICK, HOST, STRAIGHTFORWARD) if name in described]
    for time_name, title in TITLES.items():
        for name in names:
            if time_name in described[name]["times_us"]:
                lines.append(row(f"{title:38} {name:>15}", described[name]["times_us"][time_name]))
    lines.append("")
    titles = (
        f"{'work µs/cycle':>13} {'quiet':>8} {'CPU µs':>8} {'overruns':>9} {'/100,000':>9} {'cycles':>9} {'lost':>5}"
    )
    lines.append(f"{'':20} {titles}  scheduler")
    for name in names:
        each = described[name]
        skipped = (
            f"{each['overruns']:9d} {each['overruns_per_100000']:9.1f} {each['cycles']:9d} {each['frames_lost']:5d}"
        )
        work = f"{each['work_us']:13.1f} {each['work_quiet_us']:8.1f} {each['cpu_us']:8.1f}"
        lines.append(f"{name:20} {work} {skipped}  {each['scheduler']}")
        lines += [
            f"{f'  its {other}':20} {'':13} {'':8} {value:8.1f}" for other, value in each["cpu_of_others_us"].items()
        ]
    lines.append("")
    for pair, each in described["ratios"].items():
        for what, (middle, low, high) in each.items():
            if np.isnan(middle):
                continue
            lines.append(f"{pair + ', ' + what:44} {middle:8.2f} ({low:.2f} to {high:.2f} by round)")
    return "\n".join(lines)


def compare(rounds: int, seconds: float) -> dict[str, Any]:
    """Run all three beside each other at 1 kHz and return the figures. Raises TimingError.

    Where there is no C compiler one line says so, and it is the other two.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        program, reason = yardstick.build(folder)
        if reason:
            print(reason, file=sys.stderr)
        runs = [] if program is None else [yardstick_run(program, CHANNEL, folder, 1000)]
        runs += [host_run(CHANNEL, folder, patient_config(folder)), straightforward_run(CHANNEL, folder)]
        return summarise(measure(runs, rounds, seconds, 1000, folder))
