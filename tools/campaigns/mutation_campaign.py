"""Feeds mutated files of every kind to the commands that read them, and counts violations.

    python tools/campaigns/mutation_campaign.py                            1000 mutations of each kind
    python tools/campaigns/mutation_campaign.py --kinds mcap blf --count 50 --seed 7
    python tools/campaigns/mutation_campaign.py --case mcap:113            one again, as it goes
    python tools/campaigns/mutation_campaign.py --light                    without the commands that take seconds
    python tools/campaigns/mutation_campaign.py --commands 1  each file through one of its kind's commands, drawn

What is counted: tracebacks, exit statuses that a command doesn't document, more than one line of complaint, control
characters in the output, commands that take longer than a minute, and the peak of memory beyond the program's own.
A case is a process of its own, forked from one that has everything loaded; it may address 4 GiB.

Exit status: 0 all as it must be; 1 something isn't, the files are kept; 2 wrong usage.
"""

import argparse
import contextlib
import json
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from mutation_seeds import Seeds, make_seeds  # noqa: E402
from mutations import Mutation, mutate_blf, mutate_bytes, mutate_history, mutate_mcap, mutate_text  # noqa: E402

MOST_BYTES = 300 * 10**6
"""Beyond what the program itself takes, which is 0.2 GB."""
MOST_SECONDS = 60
ADDRESSED = 4 << 30
_CONTROL = re.compile(rb"[\x00-\x08\x0b-\x1f\x7f]")


@dataclass(frozen=True)
class Command:
    """What is run. In its words FILE is the mutated file, OUT an empty folder, any other capital word a seed."""

    words: str
    statuses: tuple[int, ...]
    is_heavy: bool = False

    @property
    def name(self) -> str:
        """Its program, command and options."""
        return self.words


@dataclass(frozen=True)
class Kind:
    """A kind of file: how it is mutated, and who reads it."""

    mutate: Mutation
    commands: tuple[Command, ...]


NO_BUS = "-i socketcan -c none"
FRAMES = (
    Command("adacd-hil log export FILE --format csv --out OUT", (0, 1, 2, 3)),
    Command("adacd-hil play FILE -i virtual -c x --speed 1000 --skip 0.001 --end 1", (0, 1, 2, 3, 5)),
    Command(f"firmware-sim play FILE {NO_BUS}", (1, 2, 5)),
    Command("adacd-hil replay FILE --config paper", (0, 1, 2, 3), is_heavy=True),
)
KINDS = {
    "toml": Kind(
        mutate_text,
        (
            Command("adacd-hil budget --config FILE", (0, 1, 2)),
            Command(f"adacd-hil run {NO_BUS} --config FILE --out OUT", (2, 5)),
            Command("adacd-hil replay SHORT_MCAP --config FILE", (0, 1, 2, 3), is_heavy=True),
        ),
    ),
    "scenario": Kind(
        mutate_text,
        (
            Command("firmware-sim check FILE", (0, 2)),
            Command("firmware-sim show FILE --all", (0, 2)),
            Command("firmware-sim show FILE --json", (0, 2)),
            Command(f"firmware-sim run {NO_BUS} --scenario FILE --out OUT", (2, 5)),
        ),
    ),
    "profile": Kind(mutate_text, (Command("adacd-hil budget --config USES_PROFILE", (0, 1, 2)),)),
    "dbc": Kind(
        mutate_text,
        (
            Command("adacd-hil budget --dbc FILE", (0, 1, 2)),
            Command(f"adacd-hil run {NO_BUS} --dbc FILE --out OUT", (2, 5)),
            Command("adacd-hil log export SHORT_MCAP --dbc FILE --format csv --out OUT", (0, 1, 2, 3)),
            Command("adacd-hil log export SHORT_LOG --dbc FILE --format csv --out OUT", (0, 1, 2, 3)),
        ),
    ),
    "eds": Kind(
        mutate_text,
        (
            Command("adacd-hil budget --config USES_EDS", (0, 1, 2)),
            Command(f"adacd-hil run {NO_BUS} --config USES_EDS --out OUT", (2, 5)),
        ),
    ),
    "mcap": Kind(
        mutate_mcap,
        (
            Command("adacd-hil log info FILE", (0, 1, 3)),
            Command("adacd-hil log check FILE", (0, 1, 3)),
            Command("adacd-hil log recover FILE --out OUT/x.mcap", (0, 1, 3)),
            Command("adacd-hil log cut FILE --from 0.05 --until 0.1 --out OUT/x.mcap", (0, 1)),
            Command("adacd-hil log cut FILE --contact 1 --out OUT/x.mcap", (0, 1)),
            Command("adacd-hil log export FILE --format parquet --out OUT", (0, 1, 2, 3)),
            *FRAMES,
            Command("adacd-hil replay FILE --set detector.threshold_Nm=0.1", (0, 1, 2, 3), is_heavy=True),
            Command("adacd-hil compare FILE SHORT_MCAP", (0, 1, 2, 3), is_heavy=True),
            Command("adacd-hil thresholds FILE", (0, 1, 2, 3), is_heavy=True),
            Command("adacd-hil report FILE --out OUT", (0, 1, 2, 3), is_heavy=True),
        ),
    ),
    "blf": Kind(mutate_blf, FRAMES),
    "asc": Kind(mutate_text, FRAMES),
    "candump": Kind(mutate_text, FRAMES),
    "can_csv": Kind(mutate_text, FRAMES),
    "trc": Kind(mutate_text, FRAMES),
    "csv": Kind(mutate_text, (Command("adacd-hil identify FILE --map MAP --out OUT", (0, 1, 2, 3)),)),
    "map": Kind(mutate_text, (Command("adacd-hil identify CSV --map FILE --watch CSV", (0, 1, 2, 3)),)),
    "urdf": Kind(mutate_text, (Command("adacd-hil identify CSV --map USES_URDF", (0, 1, 2, 3)),)),
    "tare": Kind(mutate_text, (Command(f"adacd-hil run {NO_BUS} --tare FILE --config paper --out OUT", (2, 5)),)),
    "history": Kind(
        mutate_history,
        (
            Command("adacd-hil history FILE", (0, 2)),
            Command("adacd-hil history FILE --plot OUT/x.png --json", (0, 2), is_heavy=True),
            Command(f"adacd-hil run {NO_BUS} --history FILE --config certified --out OUT", (2, 5)),
        ),
    ),
    "bytes": Kind(mutate_bytes, (Command("adacd-hil budget --config FILE", (0, 1, 2)),)),
}
"""`bytes`: a configuration as if it were binary."""


@dataclass
class Ran:
    """How a command went."""

    status: int
    peak_bytes: int
    seconds: float
    output: bytes


@dataclass
class Tally:
    """What was counted of a kind."""

    cases: int = 0
    commands: int = 0
    statuses: Counter[int] = field(default_factory=Counter)
    violations: list[str] = field(default_factory=list)
    peak_bytes: int = 0
    peak_of: str = ""
    slowest_s: float = 0.0
    slowest_of: str = ""

    def as_json(self) -> dict[str, object]:
        """Describe it."""
        return {**vars(self), "statuses": dict(sorted(self.statuses.items()))}


def run(words: Sequence[str], folder: Path) -> Ran:
    """Run a command in a process forked from this one, with its output in a file."""
    begin_s = time.monotonic()
    output = folder / "output"
    pid = os.fork()
    if not pid:
        with contextlib.suppress(BaseException):
            _be_command(words, output, folder)
        os._exit(99)
    status, usage = _wait(pid, begin_s + MOST_SECONDS)
    own = int((folder / "resident").read_text()) * resource.getpagesize()
    return Ran(status, max(0, usage.ru_maxrss * 1024 - own), time.monotonic() - begin_s, output.read_bytes())


def _wait(pid: int, end_s: float) -> tuple[int, resource.struct_rusage]:
    descriptor = os.pidfd_open(pid)
    try:
        import select

        poll = select.poll()
        poll.register(descriptor, select.POLLIN)
        if not poll.poll(max(0.0, end_s - time.monotonic()) * 1e3):
            os.kill(pid, signal.SIGKILL)
    finally:
        os.close(descriptor)
    _, status, usage = os.wait4(pid, 0)
    return os.waitstatus_to_exitcode(status), usage


def _be_command(words: Sequence[str], output: Path, folder: Path) -> None:
    """Become the command; never returns."""
    (folder / "resident").write_text(Path("/proc/self/statm").read_text().split()[1])
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESSED, ADDRESSED))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os._exit(_run_here(words, output, folder))


def _run_here(words: Sequence[str], output: Path, folder: Path) -> int:
    """Run a command in this process, with its output in a file; return its exit status."""
    import traceback

    descriptor = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(descriptor, stream)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.chdir(folder)
    sys.argv = list(words)
    try:
        _main_of(words[0])()
    except SystemExit as end:
        code = end.code
        status = code if isinstance(code, int) else 0 if code is None else 1
    except BaseException:
        sys.stderr.write(traceback.format_exc())
        status = 1
    return status


def _main_of(program: str) -> Callable[[], None]:
    if program == "adacd-hil":
        from adacd_hil.cli.main import main
    else:
        from firmware_sim.cli.emulator_main import main
    return main


def violations(command: Command, ran: Ran) -> Iterator[str]:
    """Say what a command did that it must not."""
    if b"Traceback" in ran.output or b"Exception ignored" in ran.output:
        lines = ran.output.decode(errors="replace").strip().splitlines()
        yield f"traceback: {lines[-1][:300]}"
    elif ran.status < 0 and ran.seconds >= MOST_SECONDS:
        yield f"still running after {MOST_SECONDS} s"
    elif ran.status not in command.statuses:
        yield f"exit status {ran.status}: {ran.output[-300:].decode(errors='replace')!r}"
    complaints = [line for line in ran.output.splitlines() if line.startswith((b"adacd-hil: ", b"firmware-sim: "))]
    if len([line for line in complaints if b"not granted" not in line]) > 1:
        yield f"{len(complaints)} lines of complaint: {complaints[:2]!r}"
    if b"Warning: " in ran.output:
        place = ran.output.index(b"Warning: ")
        yield f"a warning of Python's: {ran.output[max(0, place - 100) : place + 100]!r}"
    if found := _CONTROL.search(ran.output):
        yield f"control character {found[0]!r} in the output"
    if ran.peak_bytes > MOST_BYTES:
        yield f"{ran.peak_bytes / 1e6:.0f} MB of memory"


class Campaign:
    """Mutates and runs."""

    def __init__(self, seeds: Seeds, folder: Path, keep: Path, is_light: bool, most_commands: int) -> None:
        self._seeds = seeds
        self._folder = folder
        self._keep = keep
        self._is_light = is_light
        self._most_commands = most_commands
        self.tallies: dict[str, Tally] = {}

    def case(self, kind: str, number: int, seed: int, is_shown: bool = False) -> None:
        """Mutate one file of a kind, and run its commands."""
        tally = self.tallies.setdefault(kind, Tally())
        rng = random.Random(f"{seed}:{kind}:{number}")
        original = rng.choice(self._seeds.files[kind])
        data = KINDS[kind].mutate(original.read_bytes(), rng)
        folder = self._folder / "case"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        path = self._seeds.place(kind, original, folder)
        path.write_bytes(data)
        tally.cases += 1
        commands = [command for command in KINDS[kind].commands if not (command.is_heavy and self._is_light)]
        for command in commands if is_shown else rng.sample(commands, min(self._most_commands, len(commands))):
            self._run(kind, number, command, path, folder, tally, is_shown)

    def _run(
        self, kind: str, number: int, command: Command, path: Path, folder: Path, tally: Tally, is_shown: bool
    ) -> None:
        out = folder / "out"
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        names = {**self._seeds.names(folder), "FILE": str(path), "OUT": str(out)}
        words = [re.sub(r"[A-Z]{3}[A-Z_]*", lambda found: names[found[0]], word) for word in command.words.split()]
        ran = run(words, folder)
        tally.commands += 1
        tally.statuses[ran.status] += 1
        where = f"{kind}:{number} {command.name}"
        if ran.peak_bytes > tally.peak_bytes:
            tally.peak_bytes, tally.peak_of = ran.peak_bytes, where
        if ran.seconds > tally.slowest_s:
            tally.slowest_s, tally.slowest_of = ran.seconds, where
        if is_shown:
            print(f"$ {' '.join(words)}\n{ran.output.decode(errors='replace')}[{ran.status}]", file=sys.stderr)
        for text in violations(command, ran):
            tally.violations.append(f"{where}: {text}")
            print(tally.violations[-1], file=sys.stderr, flush=True)
            self._keep.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, self._keep / f"{kind}-{number}{path.suffix}")


def preload(seeds: Seeds, folder: Path, kinds: Sequence[str], is_light: bool) -> None:
    """Run every command once on a file that is as it should be: what it loads and compiles is there for all cases."""
    import_everything()
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        for kind in kinds:
            described = KINDS[kind]
            case = Path(scratch) / kind
            case.mkdir()
            original = seeds.files[kind][0]
            path = seeds.place(kind, original, case)
            shutil.copy(original, path)
            names = {**seeds.names(case), "FILE": str(path), "OUT": str(case / "out")}
            for command in described.commands:
                (case / "out").mkdir(exist_ok=True)
                words = [re.sub(r"[A-Z]{3}[A-Z_]*", lambda f, n=names: n[f[0]], word) for word in command.words.split()]
                if command.is_heavy and is_light:
                    continue
                status = _run_aside(words, case)
                said = (case / "output").read_text(errors="replace")
                if status not in (0, 1, 3, 5) or "Traceback" in said:
                    raise SystemExit(f"{words} on a whole file: {status} {said}")
                shutil.rmtree(case / "out")


def _run_aside(words: Sequence[str], folder: Path) -> int:
    """Run a command in this process, which is afterwards as before but for what was loaded."""
    streams, place, arguments = (sys.stdout, sys.stderr), Path.cwd(), sys.argv
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    kept = [os.dup(descriptor) for descriptor in range(3)]
    try:
        return _run_here(words, folder / "output", folder)
    finally:
        (sys.stdout, sys.stderr), sys.argv = streams, arguments
        os.chdir(place)
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for descriptor, copy in enumerate(kept):
            os.dup2(copy, descriptor)
            os.close(copy)


def import_everything() -> None:
    """Import what the commands import, so that no case has to."""
    import importlib

    for path in sorted((ROOT / "adacd_hil").rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        if "writer" not in name and "live" not in name:
            with contextlib.suppress(ImportError):
                importlib.import_module(name)
    importlib.import_module("firmware_sim.cli.emulator_main")
    from adacd_hil.scheduling import RealtimeGrant

    # Locked memory would have all that is loaded here count for every case, and real time would keep others waiting.
    for name, module in list(sys.modules.items()):
        if name.startswith("adacd_hil.") and hasattr(module, "request_realtime"):
            module.request_realtime = lambda *_: RealtimeGrant("SCHED_OTHER")


def main() -> int:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS), metavar="KIND")
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--case", metavar="KIND:NUMBER", help="this one only, its output shown")
    parser.add_argument("--light", action="store_true")
    parser.add_argument("--commands", type=int, default=99, metavar="N", help="through how many, drawn, a file goes")
    parser.add_argument("--keep", type=Path, default=Path("runs/mutations"), help="folder for files that do harm")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        seeds = make_seeds(folder / "seeds", options.light)
        preload(seeds, folder, [options.case.partition(":")[0]] if options.case else options.kinds, options.light)
        campaign = Campaign(seeds, folder, options.keep, options.light, options.commands)
        if options.case:
            kind, _, number = options.case.partition(":")
            campaign.case(kind, int(number), options.seed, is_shown=True)
        else:
            for kind in options.kinds:
                for number in range(options.count):
                    campaign.case(kind, number, options.seed)
                tally = campaign.tallies[kind]
                print(
                    f"{kind}: {tally.cases} files, {tally.commands} commands, {len(tally.violations)} violations, "
                    f"statuses {dict(sorted(tally.statuses.items()))}, peak {tally.peak_bytes / 1e6:.0f} MB, "
                    f"slowest {tally.slowest_s:.1f} s ({tally.slowest_of})",
                    file=sys.stderr,
                    flush=True,
                )
    described = {kind: tally.as_json() for kind, tally in campaign.tallies.items()}
    found = sum(len(tally.violations) for tally in campaign.tallies.values())
    if options.json:
        print(json.dumps(described, indent=2))
    print(f"{sum(t.commands for t in campaign.tallies.values())} commands, {found} violations")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
