"""Plays the attacks of attacks.py on a running arm: what the host noticed, and how the arm came to rest.

    python tools/campaigns/attack_campaign.py -j 2                  virtual time: the table on stdout
    python tools/campaigns/attack_campaign.py command sync          attacks whose names have one of these words
    python tools/campaigns/attack_campaign.py --json
    tools/with-vcan -- .venv/bin/python tools/campaigns/attack_campaign.py --vcan --keep runs/attacks  on a vcan

In virtual time host and devices run by the clock at 1 kHz, and the figures are exact (attacked_run.py). With
`--vcan` emulator, host and attacker are processes on one interface, at `--period-us`, and a second host, the commands
that look at an arm, and a host that is killed come on top; figures are then of the host's rules and of this machine.

Columns: ms from the first forged frame to the first line of the log that says that something is wrong; from there to
rest; degrees that the joint that went furthest went until then; deg/s at most. A row is bad when nothing was noticed,
when the line names something else, or when the arm was not at rest, slower than 0.05 rad/s for 0.1 s, 120 ms after it
was noticed.

Exit status: 0 no bad row, 1 a bad one, 2 wrong usage, 5 no vcan can be had.
"""

import argparse
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # instruments that campaigns stand on

import attack_vcan
from attacked_run import Finding, play_attack
from attacks import ATTACKS, find_attack
from campaign_loop import add_jobs, play_trials

from adacd_hil.cli.output import ExitCode, format_table

NOTHING = "nothing"
"""The run without an attacker, for comparison."""
HEAD = ("attack", "forged", "noticed ms", "rest after ms", "deg", "deg/s", "verdict", "end", "first line")


def virtual_names() -> list[str]:
    """Return the attacks that virtual time can play."""
    return [NOTHING, *(case.name for case in ATTACKS if case.only != "vcan")]


def _run(job: tuple[str, Path | None]) -> Finding:
    name, keep = job
    case = None if name == NOTHING else find_attack(name)
    with tempfile.TemporaryDirectory() as folder:
        return play_attack(case, Path(folder) if keep is None else keep / name)[0]


def play_virtual(names: Sequence[str], jobs: int, keep: Path | None) -> Iterator[Finding]:
    """Play attacks in virtual time, in order."""
    work = [(name, keep) for name in names]
    yield from play_trials(_run, work, jobs, lambda found: f"{found.name}: {found.verdict}")


def play_vcan(names: Sequence[str], channel: str, period_us: int, keep: Path | None) -> Iterator[Finding]:
    """Play attacks on an interface, one after the other."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) if keep is None else keep
        one = partial(attack_vcan.play_on_vcan, channel=channel, period_us=period_us, folder=place)
        yield from play_trials(one, names, 1, lambda found: f"{found.name}: {found.verdict}")


def as_table(findings: Sequence[Finding]) -> str:
    """Lay out what came of each attack."""
    rows = [
        [
            found.name, str(found.forged), _ms(found.noticed_ms), _ms(found.rest_after_notice_ms),
            f"{found.travelled_deg:.1f}", f"{found.fastest_deg_s:.0f}", found.verdict, found.end[:40],
            found.noticed_by[:70],
        ]
        for found in findings
    ]  # fmt: skip
    return format_table(list(HEAD), rows, right=range(1, 6))


def _ms(value: float | None) -> str:
    return "never" if value is None else f"{value:.0f}"


def is_bad(found: Finding) -> bool:
    """Whether a row is not as it must be."""
    return not found.verdict.startswith("ok")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(prog="attack_campaign", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("words", nargs="*", help="play only attacks whose names have one of these words")
    add_jobs(parser)
    parser.add_argument("--keep", type=Path, help="folder that keeps the logs")
    parser.add_argument("--vcan", metavar="NAME", nargs="?", const="vcan0", help="on this interface; default vcan0")
    parser.add_argument("--period-us", type=int, default=2000, help="cycle with --vcan; default %(default)s")
    parser.add_argument("--json", action="store_true", help="print all findings")
    chosen = parser.parse_args(argv)
    everything = attack_vcan.names() if chosen.vcan else virtual_names()
    names = [name for name in everything if not chosen.words or any(word in name for word in chosen.words)]
    if not names:
        parser.error("no attack has such a name")
    if chosen.vcan and not Path("/sys/class/net", chosen.vcan).exists():
        print(f"attack_campaign: there is no interface {chosen.vcan}; run it by tools/with-vcan", file=sys.stderr)
        return ExitCode.BUS_MISSING
    if chosen.vcan:
        findings = list(play_vcan(names, chosen.vcan, chosen.period_us, chosen.keep))
    else:
        findings = list(play_virtual(names, chosen.jobs, chosen.keep))
    if chosen.json:
        print(json.dumps([asdict(found) for found in findings], indent=1))
    else:
        print(as_table(findings))
        verdicts = Counter(found.verdict for found in findings)
        print("\n".join(f"{count} {verdict}" for verdict, count in verdicts.most_common()))
    return 1 if any(map(is_bad, findings)) else 0


if __name__ == "__main__":
    sys.exit(main())
