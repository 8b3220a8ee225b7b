"""Measures which lines of the code that runs on an arm, and replays it, the reference runs and five faults reach.

    python tools/campaigns/reached_lines.py -j 2  the share, by package, and the files with the most lines not reached
    python tools/campaigns/reached_lines.py --functions      and every function that no run enters
    python tools/campaigns/reached_lines.py paper-quick lose-feedback     these runs alone

Plays each run of `tests/reference` and five scenarios of the emulator without compilation, the log's writer included,
and replays each log. The run of a known arm comes once more by the commands, on vcan, and its frames are decoded; the
stored log is replayed in each way of `stored_log`. A line counts once it was executed; importing a
module reaches the lines that define its functions, so the share of lines within functions is told apart. Neither the
emulator nor what a run and its replay do without (`LEFT_OUT`) counts.

Coverage.py is in no lock. Where it can't be imported, pip fetches it into a folder that is removed.
Exit status: 0 measured, 1 a run or a replay failed, 2 wrong usage.
"""

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from campaign_loop import add_jobs, play_trials

from adacd_hil.cli.embedded_run import resolve, run_embedded
from adacd_hil.cli.output import format_table
from adacd_hil.log.log_files import LOG_NAME

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "reference")]

import reference_runs  # noqa: E402 (it is the tests')
import stored_log  # noqa: E402 (so is this)

COVERAGE = "coverage==7.17.5"
FAULTS = ("corrupt-torque", "drive-fault-and-recovery", "lose-feedback", "power-loss-and-return", "stuck-torque")
KNOWN = "certified-known"
LEFT_OUT = ("adacd_hil/lab/", "adacd_hil/api.py", "adacd_hil/cli/completion.py")
_MOST_FILES = 25


class Reached(NamedTuple):
    """Lines that are reached, and all there are."""

    reached: int
    lines: int

    @property
    def percent(self) -> str:
        """The share in words."""
        return f"{100 * self.reached / max(self.lines, 1):.1f} %"


class Played(NamedTuple):
    """What came of a run: its error, empty where there is none."""

    name: str
    error: str


def main() -> int:
    """Play, measure, print."""
    known = [*reference_runs.names(), *FAULTS, *OTHER_WAYS]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="reference runs or scenarios; default: all")
    parser.add_argument("--functions", action="store_true", help="name the functions that no run enters")
    parser.add_argument("--json", type=Path, help="write Coverage.py's report to this file, too")
    add_jobs(parser)
    arguments = parser.parse_args()
    for name in arguments.names:
        if name not in known:
            parser.error(f"no run {name!r}; there are {', '.join(known)}")
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        environment = _environment(folder)
        trials = arguments.names or known
        played = list(play_trials(partial(_play_apart, environment=environment), trials, arguments.jobs, _line))
        failed = [each for each in played if each.error]
        report = _report(folder, environment)
    if arguments.json:
        arguments.json.write_text(json.dumps(report), encoding="utf-8")
    print(_share(report))
    _print(report, arguments.functions)
    for each in failed:
        print(f"{each.name}: {each.error}", file=sys.stderr)
    return 1 if failed else 0


def play(name: str, folder: Path) -> Path:
    """Play a reference run, or a scenario with the certified scheme, and give its log."""
    if name in reference_runs.names():
        reference_runs.play(name, folder)
    else:
        run_embedded(resolve("certified", name, None, None), "lockstep", folder)
    return folder / LOG_NAME


def replay(log: object, *options: object) -> None:
    """Replay a log by the command; it ends this process unless the decisions are the same."""
    from adacd_hil.cli.main import main as host

    sys.argv = ["adacd-hil", "replay", *map(str, (log, *options))]
    host()


def play_by_commands(folder: Path) -> None:
    """Play the run of a known arm by the commands, on vcan, and replay it by its frames."""
    call = f"play_on_vcan({KNOWN!r}, Path({os.fspath(folder)!r}))"
    program = f"import sys; from reference_runs import Path, play_on_vcan; sys.exit({call}.status)"
    command = [ROOT / "tools" / "with-vcan", "--can", "vcan0", "--", sys.executable, "-c", program]
    subprocess.run(command, check=True)
    replay(folder / LOG_NAME, "--frames")


def replay_stored(way: str, folder: Path) -> None:
    """Replay the stored log in a way of `stored_log`."""
    replay(*stored_log.WAYS[way](folder))


OTHER_WAYS = {
    f"{KNOWN} on vcan": play_by_commands,
    **{f"stored log, {way}": partial(replay_stored, way) for way in stored_log.WAYS},
}
"""The references that are no run on the embedded bus, by name."""


def _play_apart(name: str, environment: dict[str, str]) -> Played:
    """Play and replay a run, or replay a log, in a process that is measured."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = f"Path({scratch!r})"
        call = f"OTHER_WAYS[{name!r}]({folder})" if name in OTHER_WAYS else f"replay(play({name!r}, {folder}))"
        program = f"from reached_lines import *; from pathlib import Path; {call}"
        done = subprocess.run(
            [sys.executable, "-c", program], env=environment, cwd=ROOT, capture_output=True, text=True, check=False
        )
    said = done.stderr.strip().splitlines() or [""]
    return Played(name, f"exit status {done.returncode}: {said[-1]}" if done.returncode else "")


def _line(played: Played) -> str:
    return f"{played.name} {played.error or 'replayed the same'}"


def _environment(folder: Path) -> dict[str, str]:
    """Return the environment of a measured process: Coverage.py begins with its interpreter, in the writer, too."""
    packages = folder / "packages"
    packages.mkdir()
    if importlib.util.find_spec("coverage") is None:
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        subprocess.run([*command, "--target", str(packages), COVERAGE], check=True)
    settings = folder / "coveragerc"
    (packages / "sitecustomize.py").write_text("import coverage\ncoverage.process_startup()\n", encoding="utf-8")
    settings.write_text(
        f"[run]\nparallel = true\nsource = {ROOT / 'adacd_hil'}\ndata_file = {folder / 'data'}\n"
        "disable_warnings = no-data-collected,module-not-measured,module-not-imported\n",
        encoding="utf-8",
    )
    paths = [packages, ROOT, ROOT / "tools" / "campaigns", ROOT / "tests", ROOT / "tests" / "reference"]
    return {
        **os.environ,
        "NUMBA_DISABLE_JIT": "1",
        "COVERAGE_PROCESS_START": str(settings),
        "PYTHONPATH": os.pathsep.join(map(str, paths)),
    }


def _report(folder: Path, environment: dict[str, str]) -> dict[str, Any]:
    """Join what the processes have measured; return Coverage.py's report of it."""
    report = folder / "report.json"
    _coverage(["combine", "--quiet"], folder, environment)
    _coverage(["json", "--quiet", "-o", str(report)], folder, environment)
    found: dict[str, Any] = json.loads(report.read_text(encoding="utf-8"))
    return found


def _coverage(words: list[str], folder: Path, environment: dict[str, str]) -> None:
    own = {key: value for key, value in environment.items() if key != "COVERAGE_PROCESS_START"}
    command = [sys.executable, "-m", "coverage", *words, f"--rcfile={folder / 'coveragerc'}"]
    subprocess.run(command, env=own, cwd=ROOT, check=True)


def is_counted(path: str) -> bool:
    """Return whether a file, named from the root, belongs to what runs on an arm or replays it."""
    return not path.startswith(LEFT_OUT)


def _functions(files: dict[str, Any]) -> Iterator[tuple[str, str, Reached]]:
    """Yield file, name and lines of each function."""
    for path, file in files.items():
        for name, function in file["functions"].items():
            if name:
                summary = function["summary"]
                yield path, name, Reached(summary["covered_lines"], summary["num_statements"])


def _counted(report: dict[str, Any]) -> dict[str, Any]:
    """Return the part of a report of each file that counts."""
    return {path: file for path, file in report["files"].items() if is_counted(path)}


def _share(report: dict[str, Any]) -> str:
    """Return in words how much of all lines, and of the lines within functions, was reached."""
    files = _counted(report)
    whole = _sum(_of(file["summary"]) for file in files.values())
    within = _sum(reached for _, _, reached in _functions(files))
    return f"{whole.percent} of {whole.lines} lines reached; within functions {within.percent} of {within.lines}"


def _print(report: dict[str, Any], names_functions: bool) -> None:
    files = _counted(report)
    lines = {path: _of(file["summary"]) for path, file in files.items()}
    functions = list(_functions(files))
    packages: dict[str, list[Reached]] = {}
    for path, reached in lines.items():
        packages.setdefault(str(Path(path).parent), []).append(reached)
    rows = [[name, *_cells(_sum(each))] for name, each in sorted(packages.items())]
    print("\n" + format_table(["package", "reached", "lines", "not"], rows))
    missing = sorted(lines.items(), key=lambda item: item[1].reached - item[1].lines)
    rows = [[path, *_cells(reached)] for path, reached in missing[:_MOST_FILES]]
    print("\n" + format_table(["file", "reached", "lines", "not"], rows))
    never = [(path, name, reached) for path, name, reached in functions if reached.lines and not reached.reached]
    print(f"\n{len(never)} of {len(functions)} functions never entered, {sum(each.lines for *_, each in never)} lines")
    if names_functions:
        count = Counter(path for path, *_ in never)
        for path, _ in count.most_common():
            inside = ", ".join(f"{name} ({reached.lines})" for other, name, reached in never if other == path)
            print(f"{path}: {inside}")


def _of(summary: dict[str, int]) -> Reached:
    return Reached(summary["covered_lines"], summary["num_statements"])


def _sum(parts: Any) -> Reached:
    kept = list(parts)
    return Reached(sum(each.reached for each in kept), sum(each.lines for each in kept))


def _cells(reached: Reached) -> list[str]:
    return [reached.percent, str(reached.lines), str(reached.lines - reached.reached)]


if __name__ == "__main__":
    sys.exit(main())
