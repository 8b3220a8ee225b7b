"""Plays arms whose wiring the host knows wrongly, from the first motion on, and counts the causes that the host names.

    python tools/campaigns/cause_campaign.py -j 2
    python tools/campaigns/cause_campaign.py --arms upright --only 'sensors*' --seeds 7 --list

`init` makes the arms, upright and flat. Each seed has masses, friction, sensor offsets, noise and a start of its own,
and of the right arms some carry a payload. Virtual time, no bus. By wrong statement: `certain`, the right cause named
alone; `among`, the right cause named beside others; `wrong`, other causes only, or a wrong one as certain;
`stopped`, without a cause; `refused` before the drives were enabled; `ran`, no fault before the end. Of right arms
`ran` is right, `stopped` another fault, and `wrong` a fault by the first motion.

Exit status: 0 no outcome is `wrong`, 1 otherwise, 2 wrong usage.
"""

import argparse
import dataclasses
import fnmatch
import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from campaign_loop import add_jobs, add_seeds, play_trials

from adacd_hil.api import load
from adacd_hil.cli.embedded_run import resolve, run_embedded
from adacd_hil.cli.output import format_table
from adacd_hil.control.first_motion import NO_CAUSE, TOO_SHORT
from adacd_hil.records import FaultReason
from adacd_hil.settings.run_settings import RequestSettings
from adacd_hil.settings.schema import ConfigError

ARMS: Final = ("upright", "flat")
LASTS_S: Final = {"upright": 9.0, "flat": 5.0}
RATED_NM: Final = 12.0
"""Of both drives: with different ones exchanged drives are refused before the first motion."""
RIGHT: Final = "right"


class Statement(NamedTuple):
    """What is wrong: `[wiring]` of the truth, and a pattern of the text that names it."""

    wiring: Mapping[str, object]
    pattern: str


def _reversed(joint: int, *parts: str) -> dict[str, object]:
    return {f"reversed_{part}": [joint == 1, joint == 2] for part in parts}


_EITHER: Final = r"either the sensor of \S+\[{place}\] or \S+\[{place}\] counts the other way"
STATEMENTS: Final[Mapping[str, Statement]] = {
    RIGHT: Statement({}, r"(?!)"),
    "sensors exchanged": Statement({"swapped": "sensors"}, r"sensors( of joints 1 and 2 are)? exchanged"),
    "drives exchanged": Statement({"swapped": "drives"}, r"drives( of joints 1 and 2 are)? exchanged"),
    "both exchanged": Statement({"swapped": "joints"}, r"joints( 1 and 2 are)? exchanged"),
    **{
        f"{part} {joint} reversed": Statement(_reversed(joint, *parts), pattern.format(joint=joint, place=joint - 1))
        for part, parts, pattern in (
            (
                "sensor",
                ("sensor",),
                rf"reverse the sensor of \S+\[{{place}}\]|torque sensor of joint {{joint}} reversed|{_EITHER}",
            ),
            (
                "encoder",
                ("joint", "motor", "sensor"),
                r"reverse the encoder of \S+\[{place}\]|encoder of joint {joint} reversed|position, of \S+\[{place}",
            ),
            (
                "motor",
                ("motor",),
                r"reverse the motor of \S+\[{place}\]|r motor of joint {joint} reversed|s motor of joint {joint} reve"
                r"|motor, of \S+\[{place}",
            ),
            (
                "drive",
                ("joint", "sensor"),
                rf"reverse both of \S+\[{{place}}\]|encoder and motor of joint {{joint}} reversed|{_EITHER}",
            ),
        )
        for joint in (1, 2)
    },
    "both sensors reversed": Statement({"reversed_sensor": [True, True]}, r"both torque sensors"),
    "joint 2 reversed": Statement({"reversed_joint": [False, True]}, r"joint 2 turns the other|joints reversed"),
}
"""By name."""
OUTCOMES: Final = ("certain", "among", "wrong", "stopped", "refused", "ran")


class Result(NamedTuple):
    """One arm. `line`: of the fault; `at_s`: since the drives were enabled."""

    arm: str
    statement: str
    seed: int
    outcome: str
    at_s: float
    line: str


def truth_of(statement: str, seed: int) -> str:
    """Make the truth: the wiring, and masses, friction and offsets of the seed."""
    rng = np.random.default_rng(seed)

    def pair(first: float, second: float) -> str:
        return f"[{first:.4f}, {second:.4f}]"

    lines = ["[wiring]"]
    for key, value in STATEMENTS[statement].wiring.items():
        lines.append(f"{key} = {str(value).lower()}" if isinstance(value, list) else f'{key} = "{value}"')
    lines += [
        "[factor]",
        f"mass = {pair(*rng.uniform(0.85, 1.1, 2))}",
        "[arm]",
        f"viscous_Nm_s = {pair(*(rng.uniform(0.02, 0.4, 2) * (1.0, 0.4)))}",
        f"coulomb_Nm = {pair(*(rng.uniform(0.0, 0.4, 2) * (1.0, 0.4)))}",
        f"torque_offset_Nm = {pair(*rng.uniform(-0.2, 0.2, 2))}",
        "[mechanics]",
        f"motor_coulomb_Nm = {pair(*(rng.uniform(0.0, 0.2, 2) * (1.0, 0.5)))}",
        f"motor_viscous_Nm_s = {pair(*(rng.uniform(0.0, 0.1, 2) * (1.0, 0.5)))}",
    ]
    return "\n".join(lines) + "\n"


def play(trial: tuple[str, str, int], folder: Path, keep: Path | None, error: float | None = None) -> Result:
    """Play one arm to the end or to its first fault."""
    arm, statement, seed = trial
    truth = folder / f"{arm}-{statement}-{seed}.toml"
    truth.write_text(truth_of(statement, seed))
    try:
        cast = resolve(str(folder / f"{arm}.toml"), "idle", None, seed, str(truth))
    except ConfigError as refusal:
        return Result(*trial, "refused", 0.0, str(refusal))
    rng = np.random.default_rng([seed, 1])
    first, second = np.array((-20.0, -30.0)) + rng.uniform(-20.0, 20.0, 2)
    payload_kg = float(rng.choice((0.0, 0.3))) if statement == RIGHT else 0.0
    finish = (RequestSettings(at_s=LASTS_S[arm], request="finish"),)
    settings = dataclasses.replace(
        cast.settings, operator=dataclasses.replace(cast.settings.operator, script=finish, acknowledge_faults=0)
    )
    if error is not None:
        settings = dataclasses.replace(settings, safety=dataclasses.replace(settings.safety, first_motion_error=error))
    scenario = dataclasses.replace(cast.scenario, start_deg=(float(first), float(second)), payload_kg=payload_kg)
    with tempfile.TemporaryDirectory() as temporary:
        out = Path(temporary) if keep is None else keep / truth.stem
        summary, _ = run_embedded(cast._replace(settings=settings, scenario=scenario), "lockstep", out)
        run = load(out)
        lines = [event.message for event in run.events if "-> FAULT" in event.message]
    if summary.result is None:
        return Result(*trial, "refused", 0.0, "")
    at_s = len(run.state) * settings.bus.period_s
    line = lines[0] if lines else ""
    return Result(*trial, outcome_of(statement, summary.result.fault, line), at_s, line)


def outcome_of(statement: str, fault: FaultReason, line: str) -> str:
    """Sort a run by the line of its fault."""
    if fault is FaultReason.NONE:
        return "ran"
    is_certain = fault is FaultReason.MISCONFIGURED and "either" not in line
    is_right = re.search(STATEMENTS[statement].pattern, line) is not None
    if is_right:
        return "certain" if is_certain else "among"
    is_named = (fault is FaultReason.MISCONFIGURED and NO_CAUSE not in line) or (
        "perhaps" in line and TOO_SHORT not in line
    )
    return "wrong" if is_named else "stopped"


def make_arms(folder: Path) -> None:
    """Let `init` write a file for each kind of arm."""
    command = (str(Path(sys.executable).with_name("adacd-hil")), "init")
    lengths = ("--length-m", "0.4", "0.25", "--mass-kg", "2", "1", "--rated-torque-nm", *(2 * (str(RATED_NM),)))
    for arm in ARMS:
        file = str(folder / f"{arm}.toml")
        subprocess.run((*command, file, "--no-bus", *lengths, f"--{arm}", "--yes"), check=True, capture_output=True)


def line_of(result: Result) -> str:
    """Say what came of an arm."""
    return f"{result.arm}, {result.statement}, {result.seed}: {result.outcome}, {result.at_s:.2f} s. {result.line}"


def main() -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--arms", default=",".join(ARMS), help="kinds, separated by commas")
    parser.add_argument("--only", default="*", metavar="PATTERN", help="shell pattern for the statement")
    parser.add_argument("--list", action="store_true", help="print the line of each fault as it is played, to stderr")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the logs")
    parser.add_argument("--error", type=float, help="safety.first_motion_error of all runs")
    add_seeds(parser, 20)
    add_jobs(parser)
    options = parser.parse_args()
    names = fnmatch.filter(STATEMENTS, options.only)
    kinds = options.arms.split(",")
    if not names or not set(kinds) <= set(ARMS):
        parser.error(f"statements are {', '.join(STATEMENTS)}; arms {', '.join(ARMS)}")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        make_arms(folder)
        trials = [(arm, name, seed) for arm in kinds for name in names for seed in options.seeds]
        one = partial(play, folder=folder, keep=options.keep, error=options.error)
        results = list(play_trials(one, trials, options.jobs, line_of if options.list else None))
    rows = []
    for arm in kinds:
        for name in names:
            found = [r for r in results if (r.arm, r.statement) == (arm, name)]
            counts = Counter(r.outcome for r in found)
            median = np.median([r.at_s for r in found])
            rows.append((arm, name, *(str(counts[outcome] or "–") for outcome in OUTCOMES), f"{median:.2f}"))
    print(format_table(("arm", "wrong statement", *OUTCOMES, "median s"), rows))
    return 1 if any(result.outcome == "wrong" for result in results) else 0


if __name__ == "__main__":
    sys.exit(main())
