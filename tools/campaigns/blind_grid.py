"""Delays each cyclic frame by many amounts in many shares of the cycles, pushes the arm, and lists missed pushes.

    python tools/campaigns/blind_grid.py -j 2                      the whole grid, some 3,300 runs of 7 s: hours
    python tools/campaigns/blind_grid.py --every 20 -j 2           one row in twenty
    python tools/campaigns/blind_grid.py --scheme certified --contract arm --frame torque --delay 550 --share 1.0
    python tools/campaigns/blind_grid.py --first                   the one scenario that began it, by its own times

Profile P from its start corner. From 3 s on frames of one kind and node are late, in a share of the cycles that is
drawn for each frame or lies at the beginning of each push; link 1 is pushed with 8 N for 0.5 s at 4 s, link 2 with 3 N
at 5.8 s. A row is bad when a push was missed although nothing had been named and the arm had not stopped, when the
arm reacted to nothing without a named reason, or when the armed model stood still. Judged by run_rules.py.

Exit status: 0 no bad row, 1 a bad one, 2 wrong usage.
"""

import argparse
import dataclasses
import itertools
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from campaign_loop import add_jobs, play_trials
from random_run import CONFIGURATION, quick_paper
from run_rules import Case, judge
from witnessed_run import Played, play_witnessed

from adacd_hil.cli.output import format_table
from adacd_hil.records import SchemeState
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.run_settings import OperatorSettings, RequestSettings
from firmware_sim.scenario.scenario import Scenario

PLACES = (
    ("feedback", "drive1"), ("feedback", "drive2"), ("torque", "sensor1"), ("torque", "sensor2"),
    ("command", "drive1"), ("command", "drive2"), ("status", "drive1"), ("status", "sensor2"),
)  # fmt: skip
DELAYS_US = (50, 150, 300, 450, 550, 640, 800, 1000, 1250, 1500)
SHARES = (0.01, 0.1, 0.5, 1.0)
PATTERNS = ("random", "contiguous")
SCHEMES = ("certified", "paper")
CONTRACTS = ("arm", "arm_fd", "arm_stock")
LATE_S = 0.2
"""A reaction that begins so long after the end of a push is still one to it: the slowest filter."""


class Times(NamedTuple):
    """When what happens, s since the drives were enabled."""

    fault_s: float
    pushes_s: tuple[float, float]
    finish_s: float


SHORT = Times(3.0, (4.0, 5.8), 6.6)
FIRST = Times(6.0, (8.0, 9.5), 10.5)
PUSH_S = 0.5


@dataclass(frozen=True)
class Row:
    """One row of the grid. delay_us 0: nothing is late."""

    scheme: str
    contract: str
    frame: str
    node: str
    delay_us: int
    share: float
    pattern: str


@dataclass
class Outcome:
    """What came of a row. pushes: "found", "missed", "not armed", in order. end: state and fault, or the error.

    incomplete, stood_still: cycles in MONITOR that lacked something, and in which the filters did not go on.
    """

    row: Row
    pushes: list[str]
    end: str
    incomplete: int
    stood_still: int
    to_nothing: int
    named: str
    is_bad: bool
    rules: list[str]


def grid() -> list[Row]:
    """Return all rows; a share of 1 has no pattern, and a CAN FD drive no status frame."""
    rows = [Row(scheme, contract, "torque", "sensor1", 0, 1.0, "random") for scheme, contract in _HOSTS]
    for (scheme, contract), (frame, node), delay_us, share, pattern in itertools.product(
        _HOSTS, PLACES, DELAYS_US, SHARES, PATTERNS
    ):
        has_status = contract == "arm" or (contract == "arm_stock" and node.startswith("drive"))
        if (share == 1.0 and pattern == "contiguous") or (frame == "status" and not has_status):
            continue
        rows.append(Row(scheme, contract, frame, node, delay_us, share, pattern))
    return rows


_HOSTS = tuple(itertools.product(SCHEMES, CONTRACTS))


def settings_of(row: Row, times: Times) -> Settings:
    """Return the host of a row; stops are acknowledged after 0.4 s, so that it is armed for the second push."""
    settings = load_settings(row.scheme, "P")
    if row.contract in CONFIGURATION:
        settings = dataclasses.replace(settings, devices=load_settings(CONFIGURATION[row.contract], "P").devices)
    if row.scheme == "paper" and times == SHORT:
        settings = dataclasses.replace(settings, **quick_paper(settings))
    script = (RequestSettings(at_s=times.finish_s, request="finish"),)
    return dataclasses.replace(settings, operator=OperatorSettings(script=script, acknowledge_after_s=0.4))


def scenario_of(row: Row, times: Times) -> Scenario:
    """Return the arm, the pushes and the fault of a row."""
    first_s, second_s = times.pushes_s
    contacts = [
        {"at_s": first_s, "link": 1, "point_m": 0.3, "force_N": 8.0, "duration_s": PUSH_S},
        {"at_s": second_s, "link": 2, "point_m": 0.25, "force_N": 3.0, "duration_s": PUSH_S},
    ]
    faults: list[dict[str, Any]] = []
    late = {"kind": "delay", "frame": row.frame, "node": row.node, "delay_us": float(row.delay_us)}
    if row.delay_us and row.pattern == "random":
        faults = [late | {"at_s": times.fault_s, "probability": row.share}]
    elif row.delay_us:  # of the time from the fault to the second push's end, a share that begins before each push
        length_s = row.share * (second_s + PUSH_S - times.fault_s) / 2
        faults = [late | {"at_s": round(at_s - 0.005, 4), "duration_s": round(length_s, 4)} for at_s in times.pushes_s]
    table = {
        "name": "blind",
        "profile": "P",
        "start_deg": [-30.0, -60.0],
        "contacts": contacts,
        "faults": faults,
    }
    return parse(Scenario, table)


def play_row(row: Row, times: Times, folder: Path) -> Outcome:
    """Play and judge one row."""
    played = play_witnessed(settings_of(row, times), scenario_of(row, times), folder)
    return outcome_of(row, times, played)


def outcome_of(row: Row, times: Times, played: Played) -> Outcome:
    """Say what came of a row."""
    case = Case(played)
    violations = judge(played)
    rules = sorted({violation.rule for violation in violations})
    summary = played.summary
    end = played.overdue or played.crash
    if not end and summary is not None:
        result = summary.result
        end = summary.error or ("" if result is None else f"{result.state.name} {result.fault.name}")
    if case.log is None:
        return Outcome(row, ["not armed"] * len(times.pushes_s), end, 0, 0, 0, "", bool(rules), rules)
    pushes = [push_verdict(case, index) for index in range(len(times.pushes_s))]
    named = named_trouble(case, times.fault_s)
    is_armed = case.state == SchemeState.MONITOR
    missing = case.log.cycle["frames_missing"][: len(case.state)] > 0
    scheme = case.log.scheme
    stands = np.zeros(len(scheme), np.bool_)
    stands[1:] = (np.diff(scheme["tau_f"], axis=0) == 0.0).all(axis=1) & (
        np.diff(scheme["tau_f_hat"], axis=0) == 0.0
    ).all(axis=1)
    to_nothing = sum(violation.rule == "reaction-to-nothing" for violation in violations)
    is_silent_miss = "missed" in pushes and not named
    return Outcome(
        row=row,
        pushes=pushes,
        end=end,
        incomplete=int((missing & is_armed[: len(missing)]).sum()),
        stood_still=int((stands & is_armed).sum()),
        to_nothing=to_nothing,
        named=named,
        is_bad=is_silent_miss or bool(to_nothing) or "blind" in rules or bool(played.overdue or played.crash),
        rules=rules,
    )


def push_verdict(case: Case, index: int) -> str:
    """Say whether the scenario's contact of this index was found: by the truth and the log's states."""
    touched = np.flatnonzero(case.truth["contact_index"][case.truth_row, 0] == index)
    if not len(touched):
        return "not armed"  # the run was over
    first = int(touched[0])
    last = min(int(touched[-1]) + round(LATE_S / case.period_s), len(case.state) - 1)
    if case.state[max(first - 1, 0)] != SchemeState.MONITOR:
        return "not armed"
    during = case.state[first : last + 1]
    left = np.flatnonzero(during != SchemeState.MONITOR)
    if not len(left):
        return "missed"
    return "found" if during[left[0]] == SchemeState.REACT else SchemeState(int(during[left[0]])).name.lower()


def named_trouble(case: Case, fault_s: float) -> str:
    """Return the first warning or error from the fault on that names something else than a contact."""
    assert case.log is not None
    enabled = np.flatnonzero(case.state == SchemeState.ADAPT)
    if not len(enabled):
        return ""
    from_ns = int(case.log.scheme.t_ns[enabled[0]]) + round(fault_s * 1e9) - 50_000_000
    for entry in case.log.events:
        if entry.t_ns >= from_ns and entry.event.level in ("warning", "error"):
            return f"{entry.event.name}: {entry.event.message}"
    return ""


def _run(job: tuple[Row, Times, Path | None]) -> Outcome:
    row, times, keep = job
    with tempfile.TemporaryDirectory() as name:
        return play_row(row, times, Path(name) if keep is None else keep)


def play_rows(rows: Sequence[Row], times: Times, jobs: int, keep: Path | None) -> Iterator[Outcome]:
    """Play rows, in order."""
    work = [(row, times, None if keep is None else keep / f"{index:04}") for index, row in enumerate(rows)]
    yield from play_trials(_run, work, jobs)


HEAD = (
    "scheme", "contract", "late", "µs", "share", "", "link 1", "link 2", "end", "incomplete", "still", "to nothing",
    "verdict", "named",
)  # fmt: skip


def as_table(outcomes: Sequence[Outcome]) -> str:
    """Lay out rows."""
    rows = []
    for outcome in outcomes:
        row = outcome.row
        rows.append([
            row.scheme, row.contract, f"{row.frame} {row.node}" if row.delay_us else "nothing", str(row.delay_us),
            f"{row.share:.0%}", row.pattern if row.share < 1.0 else "", *outcome.pushes, outcome.end,
            str(outcome.incomplete), str(outcome.stood_still), str(outcome.to_nothing),
            "BAD" if outcome.is_bad else "", outcome.named[:60],
        ])  # fmt: skip
    return format_table(list(HEAD), rows, right=(3, 4, 9, 10, 11))


def summary(outcomes: Sequence[Outcome]) -> dict[str, object]:
    """Sum up."""
    bad = [outcome for outcome in outcomes if outcome.is_bad]
    return {
        "rows": len(outcomes),
        "bad": len(bad),
        "pushes": dict(Counter(push for outcome in outcomes for push in outcome.pushes)),
        "missed_in_silence": sum(o.pushes.count("missed") for o in outcomes if not o.named),
        "stood_still_rows": sum("blind" in outcome.rules for outcome in outcomes),
        "to_nothing_rows": sum(bool(outcome.to_nothing) for outcome in outcomes),
        "ends": dict(Counter(outcome.end for outcome in outcomes)),
        "rules": dict(Counter(rule for outcome in outcomes for rule in outcome.rules).most_common()),
        "bad_by_frame": dict(Counter(f"{o.row.frame} {o.row.node}" for o in bad)),
    }


def chosen_rows(chosen: argparse.Namespace) -> list[Row]:
    """Return the rows that the options leave."""
    if chosen.first:
        return [Row(scheme, contract, "torque", "sensor1", 550, 1.0, "random") for scheme, contract in _HOSTS]
    rows = [
        row
        for row in grid()
        if (not chosen.scheme or row.scheme == chosen.scheme)
        and (not chosen.contract or row.contract == chosen.contract)
        and (not chosen.frame or row.frame == chosen.frame)
        and (not chosen.node or row.node == chosen.node)
        and (chosen.delay is None or row.delay_us == chosen.delay)
        and (chosen.share is None or row.share == chosen.share)
    ]
    return rows[chosen.offset :: chosen.every]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(prog="blind_grid", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scheme", choices=SCHEMES)
    parser.add_argument("--contract", choices=CONTRACTS)
    parser.add_argument("--frame", choices=sorted({frame for frame, _ in PLACES}))
    parser.add_argument("--node", choices=sorted({node for _, node in PLACES}))
    parser.add_argument("--delay", type=int, choices=(0, *DELAYS_US), help="µs")
    parser.add_argument("--share", type=float, choices=SHARES)
    parser.add_argument("--every", type=int, default=1, help="play one row in so many; default: all")
    parser.add_argument("--offset", type=int, default=0, help="beginning with this one")
    parser.add_argument("--first", action="store_true", help="torque of sensor 1 late by 550 µs, pushes at 8 and 9.5 s")
    add_jobs(parser)
    parser.add_argument("--keep", type=Path, help="folder that keeps the logs")
    parser.add_argument("--all", action="store_true", help="print every row, not only the bad ones")
    parser.add_argument("--json", action="store_true", help="print all rows as JSON")
    chosen = parser.parse_args(argv)
    if chosen.every < 1 or chosen.offset < 0:
        parser.error("--every is 1 or more, --offset 0 or more")
    rows = chosen_rows(chosen)
    if not rows:
        parser.error("no row of the grid is left")
    outcomes = []
    for outcome in play_rows(rows, FIRST if chosen.first else SHORT, chosen.jobs, chosen.keep):
        outcomes.append(outcome)
        if outcome.is_bad:
            print(f"bad: {outcome.row}: {', '.join(outcome.pushes)}; {', '.join(outcome.rules)}", file=sys.stderr)
    totals = summary(outcomes)
    if chosen.json:
        print(json.dumps({**totals, "outcomes": [asdict(outcome) for outcome in outcomes]}, indent=1))
    else:
        shown = outcomes if chosen.all or chosen.first else [outcome for outcome in outcomes if outcome.is_bad]
        print(as_table(shown) if shown else "no bad row")
        print("\n".join(f"{key}: {value}" for key, value in totals.items()))
    return 1 if totals["bad"] else 0


if __name__ == "__main__":
    sys.exit(main())
