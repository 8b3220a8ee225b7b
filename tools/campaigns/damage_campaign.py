"""Damages logs and kills runs, and checks what `log check` and `log recover` do with them.

    python tools/campaigns/damage_campaign.py                      1000 damaged logs, 20 killed runs
    python tools/campaigns/damage_campaign.py --logs 1000 --kills 0
    python tools/campaigns/damage_campaign.py --kills 200 --logs 0 --seed 7 --json
    python tools/campaigns/damage_campaign.py --kills 0 --logs 0 --vcan-kills 200  host, logger, arm, or two of them

A log of random numbers is cut, has bits flipped or stretches zeroed, at places that the seed chooses: check must find
it, and recover must save every intact chunk and no message that the log never had. A run of the experiment in real time
loses its writer, its control process or both by SIGKILL at moments that the seed chooses: recover must save all but the
last 0.3 s, cycle for cycle. With `--vcan-kills` host, logger and emulated arm are processes on a vcan, made by
tools/with-vcan where there is none: whoever is left must come to its documented end, the arm to rest
(vcan_kills.py).

Exit status: 0 all as it must be, 1 something isn't, 2 wrong usage.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # instruments that campaigns stand on

from campaign_loop import add_jobs, play_trials
from damage_trials import DamageResult, Undamaged, make_undamaged, run_trial
from kill_trials import LOSS_BOUND_S, KillResult, kill_trial
from side_by_side import CHANNEL
from vcan_kills import VcanKill, kill_on_vcan

ROOT = Path(__file__).resolve().parents[2]
ResultT = TypeVar("ResultT", DamageResult, KillResult, VcanKill)


def damaged_logs(count: int, seed: int, jobs: int, folder: Path) -> list[DamageResult]:
    """Damage `count` logs."""
    if not count:
        return []
    whole = make_undamaged(folder)
    return _judged(play_trials(partial(_damage, whole=whole, folder=folder), range(seed, seed + count), jobs))


def _damage(seed: int, whole: Undamaged, folder: Path) -> DamageResult:
    return run_trial(whole, seed, folder / str(seed))


def killed_runs(count: int, seed: int, folder: Path) -> list[KillResult]:
    """Kill `count` runs."""
    one = partial(_kill, folder=folder)
    return _judged(
        play_trials(
            one,
            range(seed, seed + count),
            1,
            lambda run: f"{run.victim} killed after {run.cycles} cycles, lost {run.lost_s:.3f} s",
        )
    )


def _kill(seed: int, folder: Path) -> KillResult:
    return kill_trial(seed, folder / f"kill{seed}")


def _judged(results: Iterable[ResultT]) -> list[ResultT]:
    """Collect results; violations are printed as they come."""
    found = []
    for result in results:
        found.append(result)
        for violation in result.violations:
            print(f"seed {result.seed}: {violation}", file=sys.stderr)
    return found


def killed_on_vcan(count: int, seed: int) -> list[VcanKill]:
    """Kill somebody in `count` runs on a vcan."""
    return _judged(
        play_trials(
            kill_on_vcan,
            range(seed, seed + count),
            1,
            lambda run: f"{run.victim} killed, {run.cycles} cycles saved, host's status {run.status}",
        )
    )


def summary(logs: Sequence[DamageResult], kills: Sequence[KillResult], vcan: Sequence[VcanKill]) -> dict[str, Any]:
    """Sum up."""
    statuses = Counter(str(result.exit_status) for result in logs)
    return {
        "damaged_logs": len(logs),
        "by_kind": dict(Counter(result.kind for result in logs)),
        "found_by_check": sum(result.found for result in logs),
        "recover_exit_status": dict(sorted(statuses.items())),
        "killed_runs": len(kills),
        "by_victim": dict(Counter(result.victim for result in kills)),
        "most_lost_s": max((result.lost_s for result in kills), default=0.0),
        "most_lost_on_vcan_s": max((result.lost_s for result in vcan), default=0.0),
        "bound_s": LOSS_BOUND_S,
        "killed_on_vcan": len(vcan),
        "by_victim_on_vcan": dict(Counter(result.victim for result in vcan)),
        "violations": sum(bool(result.violations) for result in (*logs, *kills, *vcan)),
    }


def main() -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--logs", type=int, default=1000, help="logs to damage")
    parser.add_argument("--kills", type=int, default=20, help="runs to kill, one at a time")
    parser.add_argument("--vcan-kills", type=int, default=0, help="the same with processes on a vcan")
    parser.add_argument("--seed", type=int, default=1)
    add_jobs(parser)
    parser.add_argument("--json", action="store_true", help="print every trial")
    arguments = parser.parse_args()
    if min(arguments.logs, arguments.kills, arguments.vcan_kills, arguments.seed) < 0:
        parser.error("counts and seed are 0 or more")
    if arguments.vcan_kills and not Path("/sys/class/net", CHANNEL).exists():
        launcher = [ROOT / "tools" / "with-vcan", "--can", CHANNEL, "--", sys.executable, __file__, *sys.argv[1:]]
        return subprocess.run(launcher, check=False).returncode
    with tempfile.TemporaryDirectory() as name:
        logs = damaged_logs(arguments.logs, arguments.seed, arguments.jobs, Path(name))
        kills = killed_runs(arguments.kills, arguments.seed, Path(name))
    vcan = killed_on_vcan(arguments.vcan_kills, arguments.seed)
    totals = summary(logs, kills, vcan)
    if arguments.json:
        found = (("logs", logs), ("kills", kills), ("vcan", vcan))
        trials = {name: [asdict(result) for result in results] for name, results in found}
        print(json.dumps({**totals, **trials}, indent=1))
    else:
        print("\n".join(f"{key}: {value}" for key, value in totals.items()))
    return 1 if totals["violations"] else 0


if __name__ == "__main__":
    sys.exit(main())
