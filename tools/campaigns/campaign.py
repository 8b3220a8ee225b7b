"""Plays scenarios with host and arm in one process each, and compares the outcomes with the expectations.

    python tools/campaigns/campaign.py                    all that come with the package
    python tools/campaigns/campaign.py --only 'clamp*'    those whose name or group fits a pattern
    python tools/campaigns/campaign.py my.toml -j 2       files, two runs at a time
    python tools/campaigns/campaign.py --seed 2  with other noise and other chance: expectations have to bear it
    python tools/campaigns/campaign.py --config paper     with this host only; can be repeated

Lockstep. Without --config each is played with `paper` and with `certified`: what the one does is the measure of what
the other does, and an expectation that nobody plays does not stay true. The table goes to stdout, progress to stderr.
Exit status: 0 all as expected, 1 one deviates or can't be played, 2 wrong usage or a scenario that is not one.
"""

import argparse
import fnmatch
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from campaign_loop import play_trials

from adacd_hil.cli.output import format_table
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.schema import ConfigError
from firmware_sim.scenario.scenario import builtin_scenarios, load_scenario

CONFIGS = ("paper", "certified")


@dataclass(frozen=True)
class Row:
    """A scenario that has been played. `problem`: empty, or why it could not be."""

    name: str
    config: str
    group: str
    expected: str
    measured: str
    deviations: tuple[str, ...]
    pace: float | None
    outcome: dict[str, Any] | None
    problem: str = ""

    @property
    def is_good(self) -> bool:
        """Whether it came as expected."""
        return not self.deviations and not self.problem


def play(task: tuple[str, str], seed: int | None, keep: Path | None) -> Row:
    """Play one scenario, or its file, with one configuration, its logs in a folder of `keep` or nowhere."""
    from played_outcome import deviations, expected_of, outcome_of

    from adacd_hil.cli.embedded_run import resolve, run_embedded

    name_or_file, config = task
    scenario = load_scenario(name_or_file)
    expect = expected_of(scenario, load_settings(config).scheme)
    expected = expect.text if expect else "–"
    try:
        cast = resolve(config, name_or_file, None, seed)
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) if keep is None else keep / Path(config).stem / scenario.name
            summary, truth_path = run_embedded(cast, "lockstep", out)
            outcome = outcome_of(summary, truth_path)
    except Exception as error:
        problem = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return Row(scenario.name, config, scenario.group, expected, "–", (), None, None, problem)
    found = deviations(expect, outcome) if expect else ()
    cycles = 0 if summary.result is None else summary.result.cycles
    pace = cycles * cast.settings.bus.period_s / summary.elapsed_s if cycles else None
    return Row(scenario.name, config, scenario.group, expected, outcome.text, found, pace, outcome._asdict())


def chosen(scenarios: Sequence[str], pattern: str) -> list[str]:
    """List what to play. Raises ConfigError for a file that is not a scenario."""
    names = list(scenarios) or builtin_scenarios()
    loaded = [(name, load_scenario(name)) for name in names]
    return [
        name
        for name, scenario in loaded
        if fnmatch.fnmatch(scenario.name, pattern) or fnmatch.fnmatch(scenario.group, pattern)
    ]


def as_text(rows: Sequence[Row]) -> str:
    """Make the table and, below it, what deviates."""
    head = ("scenario", "config", "expected", "measured", "", "pace")
    cells = [
        (
            row.name,
            row.config,
            row.expected,
            row.measured,
            "pass" if row.is_good else "FAIL",
            "–" if row.pace is None else f"{row.pace:.1f}",
        )
        for row in rows
    ]
    lines = [format_table(head, cells, right=(5,)), ""]
    lines += [f"{row.name}, {row.config}: {text}" for row in rows for text in (*row.deviations, row.problem) if text]
    return "\n".join([*lines, f"{sum(row.is_good for row in rows)} of {len(rows)} as expected"])


def progress_line(row: Row) -> str:
    """Say of one run whether it came as expected, and what did not."""
    state = "as expected" if row.is_good else "; ".join((*row.deviations, row.problem)).strip("; ")
    return f"{row.name}, {row.config}: {state}"


def main() -> int:
    """Play what was asked for."""
    parser = argparse.ArgumentParser(description="Plays scenarios and compares them with what they expect.")
    parser.add_argument("scenarios", nargs="*", metavar="NAME|FILE", help="default: all that come with the package")
    parser.add_argument("--only", default="*", metavar="PATTERN", help="shell pattern for name or group")
    parser.add_argument(
        "--config", action="append", metavar="NAME|FILE", help=f"the host's, repeatable; default: {', '.join(CONFIGS)}"
    )
    parser.add_argument("-j", "--jobs", type=int, default=1, metavar="N", help="how many at a time")
    parser.add_argument("--seed", type=int, metavar="N", help="another than the scenarios' own")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the logs, a folder for each scenario")
    parser.add_argument("--json", action="store_true", dest="as_json", help="print JSON in place of the table")
    options = parser.parse_args()
    configs = options.config or CONFIGS
    try:
        names = chosen(options.scenarios, options.only)
        for config in configs:
            load_settings(config)
    except ConfigError as error:
        print(f"campaign: {error}", file=sys.stderr)
        return 2
    if not names or options.jobs < 1:
        print("campaign: no scenario fits, or no process to play it in", file=sys.stderr)
        return 2
    tasks = [(name, config) for config in configs for name in names]
    one = partial(play, seed=options.seed, keep=options.keep)
    played = list(play_trials(one, tasks, options.jobs, progress_line))
    if options.as_json:
        print(json.dumps([vars(row) | {"is_good": row.is_good} for row in played], indent=2))
    else:
        print(as_text(played))
    return 0 if all(row.is_good for row in played) else 1


if __name__ == "__main__":
    sys.exit(main())
