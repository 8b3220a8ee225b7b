"""Plays both schemes against a thousand arms, a day of motion and two thousand touches, and prints the figures.

    python tools/campaigns/scheme_campaign.py --quick                 a few minutes' worth
    python tools/campaigns/scheme_campaign.py --json campaign.json    everything; an hour or so on two CPUs
    python tools/campaigns/scheme_campaign.py --only steps --schemes paper

No bus: recordings of the emulated arm (`lab`), the schemes' compiled steps on them (`campaign_schemes`). Every run has
its seed. Tables go to stdout, progress to stderr. Exit status: 0 the last scheme has all figures within their bounds,
1 one is not, 2 wrong usage.
"""

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from campaign_bound import Bound
from campaign_figures import figure_table, is_all_good, variant_table
from campaign_loop import add_jobs, play_trials
from campaign_trials import (
    CONTACTS_PER_RECORD,
    Case,
    Row,
    leave_alone,
    profile_bound,
    push_links,
    push_steps,
    touch_while_adapting,
)
from lab_arm import FRICTIONS

PROFILES = ("P", "S", "M")
CELLS = tuple((profile, is_loaded) for profile in PROFILES for is_loaded in (False, True))
WATCHED_S = 60.0
DAY_PART_S = 300.0
PARTS = ("arms", "variants", "day", "steps", "contacts", "touches")


@dataclass(frozen=True)
class Size:
    """How much to play.

    seeds: of each of the first so many `frictions`. steps: records of pushes per profile and payload.
    """

    arms: int = 1000
    hours: float = 24.0
    seeds: int = 10
    steps: int = 12
    contacts: int = 2000
    touches: int = 300
    frictions: int = len(FRICTIONS)


QUICK = Size(arms=16, hours=0.5, seeds=1, steps=2, contacts=120, touches=12, frictions=3)


@dataclass(frozen=True)
class Job:
    """One trial in a process of its own."""

    part: str
    play: Callable[..., Any]
    arguments: tuple[Any, ...]

    def run(self) -> list[Row]:
        """Play it; a row for each thing that was tried."""
        result = self.play(*self.arguments)
        return result if isinstance(result, list) else [result]


def jobs_of(scheme: str, size: Size) -> Iterator[Job]:
    """List the trials of one scheme."""
    for seed in range(size.arms):
        case = Case(scheme, "random", seed, seed % 2 == 1)
        yield Job("arms", leave_alone, (case, WATCHED_S, 100_000 + seed))
    for profile, is_loaded in CELLS:
        for friction in FRICTIONS[: size.frictions]:
            for seed in range(size.seeds):
                case = Case(scheme, profile, 10_000 + seed, is_loaded, friction)
                yield Job("variants", leave_alone, (case, WATCHED_S, 200_000 + seed))
    for index in range(math.ceil(size.hours * 3600.0 / DAY_PART_S)):
        profile, is_loaded = CELLS[index % len(CELLS)]
        yield Job("day", leave_alone, (Case(scheme, profile, 20_000 + index, is_loaded), DAY_PART_S, 300_000 + index))
    for profile, is_loaded in CELLS:
        for seed in range(size.steps):
            yield Job("steps", push_steps, (Case(scheme, profile, 30_000 + seed, is_loaded),))
    for index in range(math.ceil(size.contacts / CONTACTS_PER_RECORD)):
        profile, is_loaded = CELLS[index % len(CELLS)]
        yield Job("contacts", push_links, (Case(scheme, profile, 40_000 + index, is_loaded),))
    for index in range(size.touches):
        profile = PROFILES[index % len(PROFILES)]
        yield Job("touches", touch_while_adapting, (Case(scheme, profile, 50_000 + index, False),))


def play(jobs: list[Job], processes: int) -> dict[str, list[Row]]:
    """Play all jobs, and give the rows of each part in the order of the jobs."""
    rows: dict[str, list[Row]] = {part: [] for part in PARTS}
    for job, tried in zip(jobs, play_trials(Job.run, jobs, processes), strict=True):
        rows[job.part] += tried
    return rows


def bounds() -> dict[tuple[str, bool], Bound]:
    """Measure the noise-limited bound of each profile, without and with payload."""
    return {(profile, is_loaded): profile_bound(profile, is_loaded) for profile, is_loaded in CELLS}


def as_plain(value: Any) -> Any:
    """Make what JSON knows of it: what is not finite becomes null."""
    if isinstance(value, dict):
        return {key: as_plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def main() -> int:
    """Play what was asked for."""
    parser = argparse.ArgumentParser(description="Plays the schemes against many arms, motions and touches.")
    parser.add_argument("--schemes", default="paper,certified", metavar="NAMES", help="configurations or TOML files")
    parser.add_argument("--only", default=",".join(PARTS), metavar="PARTS", help=f"of {', '.join(PARTS)}")
    parser.add_argument("--quick", action="store_true", help="a few minutes' worth")
    for name, value in vars(Size()).items():
        parser.add_argument(f"--{name}", type=type(value), metavar="N", help=f"default {value:g}")
    add_jobs(parser)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all rows and figures")
    options = parser.parse_args()
    base = QUICK if options.quick else Size()
    given = {name: getattr(options, name) for name in vars(base)}
    size = Size(**{name: getattr(base, name) if value is None else value for name, value in given.items()})
    schemes, parts = options.schemes.split(","), options.only.split(",")
    unknown = set(parts) - set(PARTS)
    if unknown:
        print(f"scheme_campaign: no part is called {', '.join(sorted(unknown))}", file=sys.stderr)
        return 2
    jobs = [job for scheme in schemes for job in jobs_of(scheme, size) if job.part in parts]
    rows = play(jobs, options.jobs)
    limits = bounds()
    figures = figure_table(rows, schemes, limits)
    print(figures.text)
    print()
    print(variant_table(rows, schemes))
    if options.json:
        content = {"size": vars(size), "schemes": schemes, "figures": figures.lines, "rows": rows}
        options.json.write_text(json.dumps(as_plain(content), indent=1) + "\n")
    return 0 if is_all_good(figures) else 1


if __name__ == "__main__":
    sys.exit(main())
