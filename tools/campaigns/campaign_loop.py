"""The loop of a campaign: its trials in worker processes, its progress, its options and its table of figures."""

import argparse
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import NamedTuple, TypeVar

from adacd_hil.cli.output import format_table

TrialT = TypeVar("TrialT")
ResultT = TypeVar("ResultT")

PROGRESS_EVERY = 20
"""Trials between two lines of progress."""


class Figure(NamedTuple):
    """One figure of a campaign beside its bound, as the table shows them. `is_met`: the value is within the bound."""

    name: str
    value: str
    bound: str = ""
    is_met: bool = True


def play_trials(
    play: Callable[[TrialT], ResultT],
    trials: Sequence[TrialT],
    jobs: int,
    line_of: Callable[[ResultT], str] | None = None,
) -> Iterator[ResultT]:
    """Play every trial and yield the results in the order of the trials; progress goes to stderr.

    One job plays in this process, more in processes of their own: they are spawned, so that what one has compiled or
    logged is nobody else's. `play` and the trials must be picklable then. `line_of` makes a line for each result;
    without it there is a count every PROGRESS_EVERY trials. An exception of a trial ends the campaign.
    """
    for done, result in enumerate(_results(play, trials, jobs), start=1):
        if line_of is not None:
            print(f"{done}/{len(trials)} {line_of(result)}", file=sys.stderr, flush=True)
        elif done % PROGRESS_EVERY == 0:
            print(f"{done}/{len(trials)}", file=sys.stderr, flush=True)
        yield result


def _results(play: Callable[[TrialT], ResultT], trials: Sequence[TrialT], jobs: int) -> Iterator[ResultT]:
    processes = min(jobs, len(trials))
    if processes <= 1:
        yield from map(play, trials)
        return
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        yield from pool.map(play, trials)


def add_jobs(parser: argparse.ArgumentParser) -> None:
    """Add `--jobs`: how many trials are played at a time, by default as many as there are processors."""
    parser.add_argument(
        "-j", "--jobs", type=parse_jobs, default=os.cpu_count() or 1, metavar="N", help="processes; default: all CPUs"
    )


def add_seeds(parser: argparse.ArgumentParser, count: int) -> None:
    """Add `--seeds`, by default the first `count`."""
    parser.add_argument(
        "--seeds",
        type=parse_seeds,
        default=range(count),
        metavar="A:B",
        help=f"B excluded, or one seed; default 0:{count}",
    )


def parse_jobs(text: str) -> int:
    """Read a number of processes. Raises ArgumentTypeError below 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text}: a number of processes, 1 or more")
    return int(text)


def parse_seeds(text: str) -> range:
    """Read `17` or `A:B`, B excluded. Raises ArgumentTypeError for what has no seed."""
    first, colon, last = text.partition(":")
    begin = int(first)
    end = int(last) if colon else begin + 1
    if begin < 0 or end <= begin:
        raise argparse.ArgumentTypeError(f"{text}: A:B with 0 <= A < B, or one number")
    return range(begin, end)


def print_figures(figures: Sequence[Figure]) -> None:
    """Print figures beside their bounds, and which of them are not met."""
    rows = [(figure.name, figure.value, figure.bound, "" if figure.is_met else "not met") for figure in figures]
    print(format_table(("figure", "measured", "bound", ""), rows))


def exit_status(figures: Sequence[Figure]) -> int:
    """Return 0 where all figures are within their bounds, else 1."""
    return 0 if all(figure.is_met for figure in figures) else 1
