"""Plays every fault of the emulator's campaign by both clocks and compares the host's reaction with its row.

    python tools/campaigns/fault_campaign.py -j 4  all of tests/fault_table.py: table on stdout, progress on stderr
    python tools/campaigns/fault_campaign.py torque SYNC        cases whose names have one of these words
    python tools/campaigns/fault_campaign.py --markdown         the same as a Markdown table
    python tools/campaigns/fault_campaign.py --json             one object for each run

Exit status: 0 when every run is as its row says, 1 when one isn't, 2 for wrong usage. Runs in virtual time, about one
second each, after compiling.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from campaign_loop import add_jobs, play_trials  # noqa: E402
from fault_rig import Outcome, deviations, play  # noqa: E402 (they are the tests')
from fault_table import CASES, CLOCKS, Case, Expected  # noqa: E402


@dataclass(frozen=True)
class Result:
    """One run. `measured`: what came of it, in words. `deviations`: in what it isn't as its row says."""

    case: str
    clock: str
    fault: str
    delay_ms: int | None
    error: str
    collisions: int
    missing_frames: int
    late_commands: int
    measured: str
    deviations: list[str]


def run(job: tuple[int, str]) -> Result:
    """Play one case by one clock."""
    index, clock = job
    case = CASES[index]
    with tempfile.TemporaryDirectory() as folder:
        outcome = play(case, clock, Path(folder))
        return Result(
            case.name,
            clock,
            outcome.fault,
            outcome.delay_ms,
            outcome.error,
            outcome.collisions,
            outcome.missing_frames,
            outcome.late_commands,
            measured(outcome),
            deviations(outcome, case.expected(clock), case.wire),
        )


def measured(outcome: Outcome) -> str:
    """Say what came of a run."""
    if outcome.error:
        return f"ends: {outcome.error}"
    if outcome.faulted >= 0:
        return f"{outcome.fault}, {outcome.delay_ms} ms"
    words = ["collision" if outcome.collisions else "goes on"]
    for count, what, how in ((outcome.missing_frames, "frame", "missed"), (outcome.late_commands, "command", "late")):
        if count:
            words.append(f"{count} {what}{'s' if count > 1 else ''} {how}")
    return ", ".join(words)


def expectation(expected: Expected) -> str:
    """Say what a row expects."""
    if expected.error:
        return f"ends: {expected.error} …"
    if expected.fault:
        bound = f"{expected.low_ms}…{expected.high_ms}" if expected.low_ms < expected.high_ms else f"{expected.high_ms}"
        return f"{' or '.join(expected.fault)}, {bound} ms"
    return "collision" if expected.collisions else "goes on"


def wire(case: Case) -> str:
    """Say what the row expects on the wire."""
    return "; ".join(f"{seen.frames} × 0x{seen.can_id:03X} in {seen.cycles} ms" for seen in case.wire)


def markdown(results: Sequence[Result]) -> list[str]:
    """Make the table of the page: a line for each case."""
    found = {(result.case, result.clock): result for result in results}
    lines = [
        "| fault | scenario | on the wire | host must | lockstep: measured | real time: measured | remark |",
        "|---|---|---|---|---|---|---|",
    ]
    for case in CASES:
        if (case.name, CLOCKS[0]) not in found:
            continue
        must = [expectation(case.expected(clock)) for clock in CLOCKS]
        must = [f"lockstep: {must[0]}", f"real time: {must[1]}"] if must[0] != must[1] else must[:1]
        cells = [
            case.name,
            "; ".join(f"`{line}`" for line in case.toml.splitlines()),
            wire(case),
            "; ".join(must),
            *(found[case.name, clock].measured for clock in CLOCKS),
            case.note,
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def table(results: Sequence[Result]) -> list[str]:
    """Make the table for a terminal: a line for each run, and one for each deviation."""
    width = max(len(result.case) for result in results)
    lines = []
    for result in results:
        verdict = "DEVIATES" if result.deviations else "as expected"
        lines.append(f"{result.case:{width}}  {result.clock:8}  {verdict:11}  {result.measured}")
        lines += [f"    {line}" for line in result.deviations]
    return lines


def progress_line(result: Result) -> str:
    """Say of one run whether it is as its row says."""
    return f"{'DEVIATES' if result.deviations else 'ok':8}  {result.clock:8}  {result.case}"


def main() -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("words", nargs="*", help="play only cases whose names have one of these words")
    add_jobs(parser)
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true", help="print an array of objects")
    form.add_argument("--markdown", action="store_true", help="print a Markdown table")
    arguments = parser.parse_args()
    indices = [i for i, case in enumerate(CASES) if not arguments.words or any(w in case.name for w in arguments.words)]
    if not indices:
        parser.error("no case has such a name")
    jobs = [(index, clock) for index in indices for clock in CLOCKS]
    results = list(play_trials(run, jobs, arguments.jobs, progress_line))
    deviating = sum(bool(result.deviations) for result in results)
    if arguments.json:
        print(json.dumps([asdict(result) for result in results], indent=1))
    else:
        print("\n".join(markdown(results) if arguments.markdown else table(results)))
    print(f"{len(results) - deviating} of {len(results)} runs are as their rows say", file=sys.stderr)
    return 1 if deviating else 0


if __name__ == "__main__":
    sys.exit(main())
