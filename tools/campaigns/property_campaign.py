"""Plays random runs in lockstep and judges each from the wire and the truth, by rules that every run must keep.

    python tools/campaigns/property_campaign.py --seeds 0:1000 -j 2     a line for each violated run, then the table
    python tools/campaigns/property_campaign.py --seeds 17 --keep runs/seed17
    python tools/campaigns/property_campaign.py --seeds 0:1000 --json   figures of each run

A seed draws profile, scheme, contract, period, the host's latency and stalls, faults, contacts, bodies, hands, payload
and what the user asks (random_run.py). run_rules.py has the rules, wire_record.py a decoder of its
own. One run in `--replay-every` is replayed with `adacd-hil replay`, which must give the same decisions.

Exit status: 0 nothing violated and at least 80 % of the runs reached MONITOR, 1 otherwise, 2 wrong usage.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from campaign_loop import add_jobs, add_seeds, play_trials
from random_run import Drawn, draw_run
from run_rules import Case, Violation, clear_contacts, judge
from wire_record import write_candump
from witnessed_run import Played, play_witnessed

from adacd_hil.cli.output import format_table
from adacd_hil.records import SchemeState

ROOT = Path(__file__).resolve().parents[2]
LEAST_ARMED = 0.8
"""Share of the runs that must reach MONITOR; with fewer, the rules about it say little."""
REPLAY_S = 300.0


@dataclass
class Result:
    """One run. `violations`: rule, time in s, text. Angles in deg, of the truth."""

    seed: int
    line: str
    cycles: int = 0
    attempts: int = 0
    is_armed: bool = False
    armed_s: float = 0.0
    clear_contacts: int = 0
    state: str = ""
    fault: str = ""
    error: str = ""
    fastest_deg_s: float = 0.0
    furthest_deg: float = 0.0
    after_fault_deg: float = 0.0
    is_overdue: bool = False
    is_replayed: bool = False
    elapsed_s: float = 0.0
    violations: list[Violation] = field(default_factory=list)


def run_seed(seed: int, keep: Path | None, is_replayed: bool) -> Result:
    """Draw, play and judge one run."""
    start_s = time.monotonic()
    drawn = draw_run(seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) if keep is None else keep
        folder.mkdir(parents=True, exist_ok=True)
        played = play_witnessed(drawn.settings, drawn.scenario, folder, drawn.user)
        result = figures(drawn, played)
        result.violations = judge(played)
        if is_replayed and not (played.crash or played.overdue) and played.log is not None:
            result.is_replayed = True
            result.violations += replayed(folder)
        if keep is not None:
            save(drawn, played, result, keep)
    result.elapsed_s = round(time.monotonic() - start_s, 2)
    return result


def figures(drawn: Drawn, played: Played) -> Result:
    """Say what came of a run."""
    result = Result(drawn.seed, drawn.line, cycles=len(played.wire.sync_place), attempts=len(played.wire.boots))
    result.is_overdue = bool(played.overdue)
    if played.summary is not None:
        result.error = played.summary.error
        if played.summary.result is not None:
            result.state = played.summary.result.state.name
            result.fault = played.summary.result.fault.name
    if len(played.truth.block):
        result.fastest_deg_s = round(float(np.degrees(np.abs(played.truth["dq"]).max())), 1)
        result.furthest_deg = round(float(np.degrees(np.abs(played.truth["q"]).max())), 1)
    case = Case(played)
    if case.log is not None:
        period_s = played.settings.bus.period_s
        result.armed_s = round(float((case.state == SchemeState.MONITOR).sum()) * period_s, 3)
        result.is_armed = result.armed_s > 0.0
        result.clear_contacts = len(clear_contacts(case))
        result.after_fault_deg = round(after_fault_deg(case), 2)
    return result


def after_fault_deg(case: Case) -> float:
    """Return how far a joint went at most from the first row in FAULT of an attempt to that attempt's end, deg."""
    furthest = 0.0
    for first, last in case.stays(SchemeState.FAULT):
        q = case.truth["q"][case.truth_row[first] : case.truth_row[last] + 1]
        furthest = max(furthest, float(np.degrees(np.abs(q - q[0]).max(initial=0.0))))
    return furthest


def replayed(folder: Path) -> list[Violation]:
    """Replay the log with the command; what differs is a violation."""
    command = [sys.executable, "-c", "from adacd_hil.cli.main import main; main()", "replay", str(folder), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=REPLAY_S, check=False, cwd=ROOT)
    try:
        (own,) = json.loads(done.stdout)
    except ValueError:
        return [Violation("replay-fails", 0.0, f"status {done.returncode}: {done.stderr.strip()[-200:]}")]
    if not own["cycles"]:
        return []  # a run that never had a cycle
    if not own["identical"]:
        text = f"{own['mismatch_count']} values differ: {own['mismatched_fields']}; {'; '.join(own['notes'])}"
        return [Violation("replay-differs", 0.0, text)]
    return []


def save(drawn: Drawn, played: Played, result: Result, folder: Path) -> None:
    """Put beside the log what a person needs to look into the run."""
    for name, text in drawn.files.items():
        (folder / name).write_text(text)
    write_candump(folder / "wire.log", played.wire.passed)
    (folder / "result.json").write_text(json.dumps(as_dict(result), indent=1) + "\n")


def as_dict(result: Result) -> dict[str, object]:
    """Return a result as JSON has it."""
    return {**asdict(result), "violations": [violation._asdict() for violation in result.violations]}


def play_seed(job: tuple[int, Path | None, bool]) -> Result:
    """Play a seed, keep its files in a folder if one is given, and replay it if asked to."""
    seed, keep, is_replayed = job
    try:
        return run_seed(seed, keep, is_replayed)
    except Exception as error:
        result = Result(seed, "")
        result.violations = [Violation("judge-crash", 0.0, f"{type(error).__name__}: {error}")]
        return result


def play_all(seeds: Sequence[int], jobs: int, keep: Path | None, replay_every: int) -> Iterator[Result]:
    """Play all seeds, in order."""
    work = [
        (seed, None if keep is None else keep / f"seed{seed}", bool(replay_every) and index % replay_every == 0)
        for index, seed in enumerate(seeds)
    ]
    yield from play_trials(play_seed, work, jobs)


def summary(results: Sequence[Result]) -> dict[str, object]:
    """Sum up."""
    rules = Counter(rule for result in results for rule in {violation.rule for violation in result.violations})
    armed = sum(result.is_armed for result in results)
    return {
        "runs": len(results),
        "cycles": sum(result.cycles for result in results),
        "attempts": sum(result.attempts for result in results),
        "violated_runs": sum(bool(result.violations) for result in results),
        "unending": sum(result.is_overdue for result in results),
        "reached_monitor": armed,
        "reached_monitor_share": round(armed / max(len(results), 1), 4),
        "armed_s": round(sum(result.armed_s for result in results), 1),
        "clear_contacts": sum(result.clear_contacts for result in results),
        "replayed": sum(result.is_replayed for result in results),
        "ends": dict(Counter(result.error[:40] or result.fault or result.state for result in results)),
        "fastest_deg_s": max((result.fastest_deg_s for result in results), default=0.0),
        "after_fault_deg": max((result.after_fault_deg for result in results), default=0.0),
        "violations": dict(rules.most_common()),
    }


def as_table(results: Sequence[Result]) -> str:
    """Lay out each rule that was violated, with its seeds and the first text."""
    rows = []
    found: dict[str, list[tuple[int, Violation]]] = {}
    for result in results:
        for violation in result.violations:
            found.setdefault(violation.rule, []).append((result.seed, violation))
    for rule, cases in sorted(found.items(), key=lambda item: -len(item[1])):
        seeds = list(dict.fromkeys(seed for seed, _ in cases))
        shown = ", ".join(map(str, seeds[:6])) + (", …" if len(seeds) > 6 else "")
        rows.append([rule, str(len(seeds)), shown, cases[0][1].text])
    return format_table(["rule", "runs", "seeds", "first"], rows, right=(1,)) if rows else "nothing violated"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="property_campaign", description=(__doc__ or "").splitlines()[0], epilog="Exit status: see the head."
    )
    add_seeds(parser, 100)
    add_jobs(parser)
    parser.add_argument("--keep", type=Path, help="folder that keeps log, wire and settings of each run")
    parser.add_argument("--replay-every", type=int, default=20, help="replay one run in so many; 0: none")
    parser.add_argument("--json", action="store_true", help="print all results")
    chosen = parser.parse_args(argv)
    if chosen.replay_every < 0:
        parser.error("--replay-every is 0 or more")
    results = []
    for result in play_all(chosen.seeds, chosen.jobs, chosen.keep, chosen.replay_every):
        results.append(result)
        for violation in result.violations:
            print(f"seed {result.seed}: {violation.rule} at {violation.t_s:.3f} s: {violation.text}", file=sys.stderr)
    totals = summary(results)
    if chosen.json:
        print(json.dumps({**totals, "results": [as_dict(result) for result in results]}, indent=1))
    else:
        print(as_table(results))
        print("\n".join(f"{key}: {value}" for key, value in totals.items()))
    is_good = not totals["violations"] and float(str(totals["reached_monitor_share"])) >= LEAST_ARMED
    return 0 if is_good else 1


if __name__ == "__main__":
    sys.exit(main())
