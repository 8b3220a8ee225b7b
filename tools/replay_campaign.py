"""Plays the emulator's scenarios in this process and replays each log: the decisions must be the same to the bit.

    python tools/replay_campaign.py --config paper                    every scenario that `firmware-sim list` names
    python tools/replay_campaign.py --config certified push-link1 idle
    python tools/replay_campaign.py --logs runs/*/run.mcap            replay logs that are there

A scenario that doesn't get so far that the scheme decides anything counts as refused. Lines go to stdout as they come.
Exit status: 0 all are identical, 1 one is not, 2 wrong usage.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

from adacd_hil.analysis.replay.replay import replay
from adacd_hil.analysis.replay.replayed_outcome import Replay
from adacd_hil.cli.commands.demo_command import resolve, run_embedded
from adacd_hil.settings.schema import ConfigError
from firmware_sim.scenario.scenario import builtin_scenarios

_SHOWN = 3


def main() -> int:
    """Play and replay."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="scenarios, or logs with --logs; default: all scenarios")
    parser.add_argument("--config", default="paper", help="configuration, such as paper or certified")
    parser.add_argument("--logs", action="store_true", help="replay these logs, play nothing")
    parser.add_argument("--keep", type=Path, help="keep the logs in this folder")
    arguments = parser.parse_args()
    if arguments.logs:
        return _sum_up([_judge(name, Path(name), 0.0) for name in arguments.names])
    known = builtin_scenarios()
    for name in arguments.names:
        if name not in known:
            parser.error(f"no scenario {name!r}")
    with tempfile.TemporaryDirectory() as scratch:
        folder = arguments.keep or Path(scratch)
        return _sum_up([_play(name, arguments.config, folder) for name in arguments.names or known])


def _play(name: str, config: str, folder: Path) -> bool | None:
    begin_s = time.monotonic()
    out = folder / f"{config}-{name}"
    try:
        summary, _ = run_embedded(resolve(config, name, None, None), "lockstep", out)
    except ConfigError as error:
        print(f"{name}: refused: {error}", flush=True)
        return None
    return _judge(name, summary.log.path, time.monotonic() - begin_s)


def _judge(name: str, path: Path, played_s: float) -> bool | None:
    """Replay a log and say how it compares; None where there was nothing to compare."""
    begin_s = time.monotonic()
    found = replay(path)
    spent = f"{played_s:.1f} s played, {time.monotonic() - begin_s:.1f} s replayed"
    if found.cycles == 0:
        print(f"{name}: no cycles; {spent}", flush=True)
        return None
    print(f"{name}: {_verdict(found)}; {spent}", flush=True)
    for mismatch in found.mismatches[:_SHOWN]:
        print(f"    {mismatch.line(found.zero_ns)}", flush=True)
    return found.is_identical and found.is_whole


def _verdict(found: Replay) -> str:
    what = "identical" if found.is_identical else f"{found.mismatch_count} mismatches"
    attempts = f" in {found.attempts} attempts" if found.attempts > 1 else ""
    return (
        f"{what}, {found.compared} of {found.cycles} cycles compared{attempts}{''.join(f'; {n}' for n in found.notes)}"
    )


def _sum_up(verdicts: list[bool | None]) -> int:
    judged = [verdict for verdict in verdicts if verdict is not None]
    print(f"{sum(judged)} of {len(judged)} identical, {len(verdicts) - len(judged)} without cycles", flush=True)
    return 0 if all(judged) else 1


if __name__ == "__main__":
    sys.exit(main())
