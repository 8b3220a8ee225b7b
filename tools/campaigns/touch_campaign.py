"""Plays hands on an arm that learns: the certificates' errors, and the time until the arm monitors again.

    python tools/campaigns/touch_campaign.py --seeds 0:200 -j 2
    python tools/campaigns/touch_campaign.py --kind help --seeds 0:200
    python tools/campaigns/touch_campaign.py --untouched --seeds 0:200
    python tools/campaigns/touch_campaign.py --mujoco --seeds 0:200

Arms and touches by seed (`touch_trials`). Tables go to stdout, progress to stderr. Exit status: 0 all figures are
within their bounds, 1 one is not, 2 wrong usage.
"""

import argparse
import json
import sys
from dataclasses import asdict
from functools import partial

import numpy as np
from campaign_loop import Figure, add_jobs, add_seeds, exit_status, play_trials, print_figures
from touch_trials import AFTER_S, RULES, SIZES, Trial, play

from adacd_hil.cli.output import format_table

LARGE_NM, WRONG_NM = 0.1, 0.05
WRONG_SHARE = 0.01
BACK_S, BACK_SHARE = 5.0, 0.92
NEVER_SHARE = 0.01
WITHHELD_SHARE = 0.01


def touched_figures(trials: list[Trial]) -> list[Figure]:
    """Return the figures of touched arms."""
    judged = [max(trial.errors_Nm, default=0.0) for trial in trials if not trial.is_excused]
    wrong, large = sum(error > WRONG_NM for error in judged), sum(error > LARGE_NM for error in judged)
    by_word = sum(max(trial.by_word_Nm, default=0.0) > WRONG_NM for trial in trials if not trial.is_excused)
    never = sum(trial.back_after_s is None for trial in trials if trial.is_released and not trial.fault)
    released = sum(trial.is_released and not trial.fault for trial in trials)
    waited = [trial for trial in trials if trial.is_released and trial.is_reported and not trial.fault]
    back = sum(trial.back_after_s is not None and trial.back_after_s <= BACK_S for trial in waited)
    apart = "hands like a joint from before 0.5 s apart"
    return [
        Figure(
            f"off by > {WRONG_NM:g} Nm, {apart}", f"{wrong} of {len(judged)}", "1 %", wrong <= WRONG_SHARE * len(judged)
        ),
        Figure(f"off by > {LARGE_NM:g} Nm, {apart}", f"{large} of {len(judged)}", "0", large == 0),
        Figure(
            f"back within {BACK_S:g} s of the release",
            f"{back} of {len(waited)}",
            "92 %",
            back >= BACK_SHARE * len(waited),
        ),
        Figure(f"not back within {AFTER_S:g} s", f"{never} of {released}", "1 %", never <= NEVER_SHARE * released),
        Figure(f"by the user's word, off by > {WRONG_NM:g} Nm", f"{by_word} of {len(judged)}"),
    ]


def untouched_figures(trials: list[Trial]) -> list[Figure]:
    """Return the figures of arms that nobody touches."""
    withheld = sum(trial.is_withheld or trial.is_reported for trial in trials)
    times_s = [trial.certified_s for trial in trials if trial.certified_s is not None]
    worst = max((error for trial in trials for error in trial.errors_Nm), default=0.0)
    took = f"{np.median(times_s):.2f}, {max(times_s):.2f} s" if times_s else "never"
    return [
        Figure("withheld or reported", f"{withheld} of {len(trials)}", "1 %", withheld <= WITHHELD_SHARE * len(trials)),
        Figure("certified", f"{len(times_s)} of {len(trials)}", "all", len(times_s) == len(trials)),
        Figure("certified after, median and worst", took),
        Figure("largest error", f"{worst:.3f} Nm", f"{WRONG_NM:g} Nm", worst <= WRONG_NM),
        *_rule_figures(trials),
    ]


def _rule_figures(trials: list[Trial]) -> list[Figure]:
    """Return of each rule how much of its limit a fit was that led to a test."""
    shares = np.array([share for trial in trials for share in trial.rule_shares]).reshape(-1, len(RULES))
    return [
        Figure(f"share of its limit: {rule}, median and worst", f"{np.median(column):.2f}, {column.max():.2f}")
        for rule, column in zip(RULES, shares.T, strict=True)
        if column.size
    ]


def kind_table(trials: list[Trial]) -> str:
    """Return a table with a row for each kind of touch."""
    head = ("touch", "played", "reported", "withheld", "certified", "> 0.05 Nm", "> 0.1 Nm", "worst, Nm")
    rows = []
    for kind in SIZES:
        mine = [trial for trial in trials if trial.kind == kind]
        if not mine:
            continue
        errors = [max(trial.errors_Nm, default=0.0) for trial in mine]
        counts = (
            len(mine), sum(trial.is_reported for trial in mine), sum(trial.is_withheld for trial in mine),
            sum(bool(trial.errors_Nm) for trial in mine), sum(error > WRONG_NM for error in errors),
            sum(error > LARGE_NM for error in errors),
        )  # fmt: skip
        rows.append([kind, *map(str, counts), f"{max(errors, default=0.0):.3f}"])
    return format_table(head, rows, right=range(1, len(head)))


def main() -> int:
    """Play the seeds that were asked for."""
    parser = argparse.ArgumentParser(description="Hands on an arm that learns.")
    add_seeds(parser, 200)
    parser.add_argument("--untouched", action="store_true", help="leave the arms alone")
    parser.add_argument("--kind", choices=list(SIZES), default="", help="of all hands; help: one that helps the motion")
    parser.add_argument("--mujoco", action="store_true", help="play the arm in MuJoCo, with its friction")
    add_jobs(parser)
    parser.add_argument("--json", action="store_true", help="print each trial as JSON")
    options = parser.parse_args()
    one = partial(play, is_touched=not options.untouched, is_foreign=options.mujoco, kind=options.kind)
    trials = list(play_trials(one, options.seeds, options.jobs))
    figures = untouched_figures(trials) if options.untouched else touched_figures(trials)
    if options.json:
        print(json.dumps([asdict(trial) for trial in trials]))
    else:
        if not options.untouched:
            print(kind_table(trials))
        print_figures(figures)
    return exit_status(figures)


if __name__ == "__main__":
    sys.exit(main())
