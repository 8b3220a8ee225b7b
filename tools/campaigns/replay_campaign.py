"""Plays the emulator's scenarios in this process and replays each log: the decisions must be the same to the bit.

    python tools/campaigns/replay_campaign.py --config paper  every scenario that `firmware-sim list` names
    python tools/campaigns/replay_campaign.py --config certified push-link1 idle
    python tools/campaigns/replay_campaign.py --logs runs/*/run.mcap -j 2       replay logs that are there

A scenario that doesn't get so far that the scheme decides anything counts as refused. Lines go to stdout as they come.
Exit status: 0 all are identical, 1 one is not, 2 wrong usage.
"""

import argparse
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import NamedTuple

from campaign_loop import add_jobs, play_trials

from adacd_hil.cli.embedded_run import resolve, run_embedded
from adacd_hil.replay.replay import replay
from adacd_hil.replay.replayed_outcome import Replay
from adacd_hil.settings.schema import ConfigError
from firmware_sim.scenario.scenario import builtin_scenarios

_SHOWN = 3


class Verdict(NamedTuple):
    """What came of one log. `is_identical`: None where there was nothing to compare."""

    text: str
    is_identical: bool | None


def main() -> int:
    """Play and replay."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="scenarios, or logs with --logs; default: all scenarios")
    parser.add_argument("--config", default="paper", help="configuration, such as paper or certified")
    parser.add_argument("--logs", action="store_true", help="replay these logs, play nothing")
    parser.add_argument("--keep", type=Path, help="keep the logs in this folder")
    add_jobs(parser)
    arguments = parser.parse_args()
    known = builtin_scenarios()
    for name in arguments.names:
        if not arguments.logs and name not in known:
            parser.error(f"no scenario {name!r}")
    with tempfile.TemporaryDirectory() as scratch:
        play = partial(_play, config=arguments.config, folder=arguments.keep or Path(scratch))
        names = arguments.names if arguments.logs else arguments.names or known
        verdicts = []
        for verdict in play_trials(_judge if arguments.logs else play, names, arguments.jobs):
            print(verdict.text, flush=True)
            verdicts.append(verdict.is_identical)
    judged = [verdict for verdict in verdicts if verdict is not None]
    print(f"{sum(judged)} of {len(judged)} identical, {len(verdicts) - len(judged)} without cycles", flush=True)
    return 0 if all(judged) else 1


def _play(name: str, config: str, folder: Path) -> Verdict:
    begin_s = time.monotonic()
    try:
        summary, _ = run_embedded(resolve(config, name, None, None), "lockstep", folder / f"{config}-{name}")
    except ConfigError as error:
        return Verdict(f"{name}: refused: {error}", None)
    return _judge(name, summary.log.path, time.monotonic() - begin_s)


def _judge(name: str, path: Path | None = None, played_s: float = 0.0) -> Verdict:
    """Replay a log, by default the one of this name, and say how it compares."""
    begin_s = time.monotonic()
    found = replay(path or Path(name))
    spent = f"{played_s:.1f} s played, {time.monotonic() - begin_s:.1f} s replayed"
    if found.cycles == 0:
        return Verdict(f"{name}: no cycles; {spent}", None)
    mismatches = [f"    {mismatch.line(found.zero_ns)}" for mismatch in found.mismatches[:_SHOWN]]
    text = "\n".join([f"{name}: {_describe(found)}; {spent}", *mismatches])
    return Verdict(text, found.is_identical and found.is_whole)


def _describe(found: Replay) -> str:
    what = "identical" if found.is_identical else f"{found.mismatch_count} mismatches"
    attempts = f" in {found.attempts} attempts" if found.attempts > 1 else ""
    notes = "".join(f"; {note}" for note in found.notes)
    return f"{what}, {found.compared} of {found.cycles} cycles compared{attempts}{notes}"


if __name__ == "__main__":
    sys.exit(main())
