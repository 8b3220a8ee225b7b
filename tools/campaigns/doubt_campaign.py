"""Plays what happens to an arm that monitors: payloads, certificates that become wrong, touches, slow pushes.

    python tools/campaigns/doubt_campaign.py payload --seeds 0:60 -j 2
    python tools/campaigns/doubt_campaign.py wrong --seeds 0:60
    python tools/campaigns/doubt_campaign.py touches --seeds 0:60
    python tools/campaigns/doubt_campaign.py slow --seeds 0:200 [--mujoco]

By seed an arm of `touch_trials` is certified and monitors for 1 to 5 s. payload: SIZES_KG are picked up by turns.
wrong: a joint's friction or its sensor's zero changes. touches: TOUCHES pushes at random times. slow: an arm of profile
P, S or M, with 1 kg or without, moves on the trajectory; a push on one joint grows by SLOW_NM_S until the arm reacts.
The user acknowledges every stop. Tables go to stdout, progress to stderr. Exit status: 0 all figures are within their
bounds, 1 one is not, 2 wrong usage.
"""

import argparse
import re
import sys
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
from campaign_loop import Figure, add_jobs, add_seeds, exit_status, play_trials, print_figures
from touch_trials import PERIOD_S, THETA, HandLoop

from adacd_hil.records import SchemeState, Vector
from adacd_hil.scheme.model.regressor import payload_direction

SIZES_KG = (0.05, 0.1, 0.2, 0.5, 1.0)
ERRORS = ("Coulomb friction", "viscous friction", "torque offset")
ERROR_SIZES = {"Coulomb friction": (0.1, 1.0), "viscous friction": (0.1, 0.5), "torque offset": (0.1, 2.0)}
"""Nm, Nm s/rad, Nm; log-uniform."""
FIRST_OF_ERRORS = {"Coulomb friction": 5, "viscous friction": 3}
WITHIN_S, WITHIN_CONTACTS = 60.0, 3
"""How long an arm is played; contacts after which a certificate that is wrong should be gone."""
MONITORS_S = (1.0, 5.0)
"""How long an arm monitors before anything happens to it."""
TOUCHES, APART_S = 20, 1.5
PUSH_NM, PUSH_S = (0.1, 3.0), (0.03, 0.8)
SLOW_NM_S, SLOW_BEGINS_S, SLOW_LARGEST_NM = (0.01, 0.2), (0.1, 10.0), 1.0
"""How a slow push grows, when it begins after the certificate, log-uniform, and where it ends if nothing finds it."""
FOUND_NM, FOUND_MEDIAN_NM = 0.1, 0.04
"""Torque at which a slow push is found at worst, and in the middle."""
NAMED = re.compile(r"\d+ contacts look like ([\d.]+) ± [\d.]+ (kg picked up|kg put down|Nm s/rad|Nm)")


class Played(NamedTuple):
    """What came of one arm. size: kg, Nm, Nm s/rad, of touches 0. named: size that contacts look like, 0 of nothing.

    said: why the certificate was taken back, or that something still pushes; "" if neither. contacts, after_s: until
    then, since the change. found_Nm: of a slow push at the first reaction, nan if there was none.
    """

    seed: int
    what: str
    size: float
    said: str
    named: float
    contacts: int
    after_s: float
    found_Nm: float = float("nan")


class Armed:
    """An arm that monitors, and what is said of its certificate."""

    def __init__(self, seed: int, arm: str = "", kg: float = 0.0, is_foreign: bool = False) -> None:
        self.loop = HandLoop(seed, is_foreign)
        if arm:
            self.loop.free = THETA[arm] + kg * payload_direction(self.loop.settings.arm.link_length_m, 7, 0.0)
            self.loop.theta = self.loop.free
        for _ in range(20_000):
            if self.loop.step().state is SchemeState.MONITOR:
                break
        else:
            raise RuntimeError(f"seed {seed}: not certified within 20 s")
        self.random = self.loop.random
        self.begun, self.contacts = self.loop.cycle, 0

    def between(self, low: float, high: float) -> float:
        """Draw log-uniformly."""
        return float(np.exp(self.random.uniform(np.log(low), np.log(high))))

    def play(self, seconds: float) -> str:
        """Go on until the certificate is doubted; return what is said then, "" if it isn't."""
        for _ in range(round(seconds / PERIOD_S)):
            output = self.loop.step()
            self.contacts += output.state is SchemeState.REACT and output.previous_state is SchemeState.MONITOR
            if self.loop.said("revoked"):
                return str(self.loop.said("revoked")[0])
            if output.state is SchemeState.FAULT:
                return output.fault.name
        return ""

    def played(self, seed: int, what: str, size: float, said: str) -> Played:
        """Sum up."""
        named = NAMED.match(said)
        after_s = (self.loop.cycle - self.begun) * PERIOD_S
        return Played(seed, what, size, said, float(named[1]) if named else 0.0, self.contacts, after_s)


def push_slowly(seed: int, is_foreign: bool) -> Played:
    """Play one push that grows slowly."""
    arm, kg = "PSM"[seed % 3], float(seed // 3 % 2)
    armed = Armed(seed, arm, kg, is_foreign)
    loop, random = armed.loop, armed.random
    joint, sign = int(random.integers(2)), float(random.choice([-1.0, 1.0]))
    rate, begins_s = armed.between(*SLOW_NM_S), armed.between(*SLOW_BEGINS_S)
    name = f"{arm} {kg:g} kg, joint {joint + 1}, {sign * rate:+.3f} Nm/s after {begins_s:.1f} s"
    before = armed.play(begins_s)
    if before or armed.contacts:
        return armed.played(seed, f"false alarm: {name}", rate, before or "contact")
    armed.begun = loop.cycle
    for cycle in range(round(SLOW_LARGEST_NM / rate / PERIOD_S)):
        loop.tau_ext[joint] = sign * rate * cycle * PERIOD_S
        if loop.step().state is not SchemeState.MONITOR:
            said = (loop.said("revoked") or [""])[-1]
            return armed.played(seed, name, rate, said)._replace(found_Nm=abs(float(loop.tau_ext[joint])))
    return armed.played(seed, name, rate, "")


def play(seed: int, part: str, is_foreign: bool = False) -> Played:
    """Play one arm. is_foreign: MuJoCo's, of slow pushes."""
    if part == "slow":
        return push_slowly(seed, is_foreign)
    armed = Armed(seed)
    loop = armed.loop
    loop.run(round(armed.random.uniform(*MONITORS_S) / PERIOD_S))
    armed.begun = loop.cycle
    if part == "payload":
        size = SIZES_KG[seed % len(SIZES_KG)]
        loop.free = loop.theta = loop.free + size * payload_direction(loop.settings.arm.link_length_m, 7, 0.0)
        return armed.played(seed, f"{size:g} kg", size, armed.play(WITHIN_S))
    if part == "wrong":
        what, joint = ERRORS[seed % len(ERRORS)], int(armed.random.integers(2))
        size = armed.between(*ERROR_SIZES[what])
        if what in FIRST_OF_ERRORS:
            theta: Vector = loop.theta.copy()
            theta[FIRST_OF_ERRORS[what] + joint] += size
            loop.free = loop.theta = theta
        else:
            loop.offset_Nm[joint] += size * armed.random.choice([-1.0, 1.0])
        said = armed.play(WITHIN_S)
        return armed.played(seed, what, size, said or (loop.said("touch") or [""])[-1])
    said = "".join(_touches(armed))
    return armed.played(seed, "touches", 0.0, said)


def _touches(armed: Armed) -> Iterator[str]:
    """Push again and again until the certificate is doubted."""
    loop, random = armed.loop, armed.random
    for _ in range(TOUCHES):
        torque = armed.between(*PUSH_NM) * random.choice([-1.0, 1.0])
        loop.tau_ext[:] = torque * (np.array([1.0, 0.0]) if random.random() < 0.5 else np.array([1.0, random.random()]))
        said = armed.play(armed.between(*PUSH_S))
        loop.tau_ext[:] = 0.0
        said = said or armed.play(float(random.exponential(APART_S)))
        if said:
            yield said
            return


def payload_figures(rows: list[Played]) -> list[Figure]:
    """Return the figures of payloads that nobody announced."""
    found = []
    for size in sorted({row.size for row in rows}):
        mine = [row for row in rows if row.size == size]
        named = [row for row in mine if "kg picked up" in row.said]
        near = sum(abs(row.named - size) <= 0.1 * size for row in named)
        contacts = [row.contacts for row in named] or [0]
        most, share = (5, 0.95 if size >= 0.2 else 0.9) if size >= 0.1 else (0, 0.0)
        percentile = float(np.percentile(contacts, 95.0, method="higher"))
        is_met = len(named) == len(mine) and near >= share * len(mine) and (not most or percentile <= most)
        found.append(
            Figure(
                f"{size:g} kg: named, within 10 %, contacts median / 95 % / worst",
                f"{len(named)}, {near} of {len(mine)}, {np.median(contacts):g} / {percentile:g} / {max(contacts)}",
                f"all, {share:.0%}, 5" if most else "all",
                is_met,
            )
        )
    return found


def wrong_figures(rows: list[Played]) -> list[Figure]:
    """Return the figures of certificates that have become wrong."""
    found = []
    for what in sorted({row.what for row in rows}):
        mine = [row for row in rows if row.what == what]
        seen = [row for row in mine if row.contacts]
        told = sum(bool(row.said) for row in seen)
        revoked = [row for row in mine if "taken back" in row.said]
        soon = sum(row.contacts <= WITHIN_CONTACTS for row in revoked)
        quiet = max((row.size for row in mine if not row.contacts), default=0.0)
        text = f"{len(revoked)}, {told}, {len(seen)} of {len(mine)}; without a contact up to {quiet:.2f}"
        is_met = told == len(seen)
        found.append(Figure(f"{what}: taken back, said, met by a contact", text, "each that is met", is_met))
        slowest_s = max((row.after_s for row in revoked), default=0.0)
        text = f"{soon} of {len(revoked)} within {WITHIN_CONTACTS}, the slowest after {slowest_s:.1f} s"
        found.append(Figure(f"{what}: contacts until it is taken back", text))
    return found


def touches_figures(rows: list[Played]) -> list[Figure]:
    """Return the figures of touches."""
    contacts = sum(row.contacts for row in rows)
    named, lost = sum(row.named > 0.0 for row in rows), sum(bool(row.said) for row in rows)
    return [
        Figure("sequences that were named as an error", f"{named} of {len(rows)}", "1 %", named <= 0.01 * len(rows)),
        Figure("sequences that took the certificate back", f"{lost} of {len(rows)}, {contacts} contacts"),
    ]


def slow_figures(rows: list[Played]) -> list[Figure]:
    """Return the figures of slow pushes."""
    pushed = [row for row in rows if not row.what.startswith("false")]
    found = np.array([row.found_Nm if np.isfinite(row.found_Nm) else SLOW_LARGEST_NM for row in pushed])
    median, most, worst = np.percentile(found, (50.0, 90.0, 100.0))
    text = f"{median:.3f}, {most:.3f}, {worst:.3f} Nm of {len(found)}"
    is_met = median <= FOUND_MEDIAN_NM and worst <= FOUND_NM
    bound = f"{FOUND_MEDIAN_NM:g}, {FOUND_NM:g} Nm"
    return [
        Figure("torque at the first reaction, median, 90 %, worst", text, bound, is_met),
        Figure("false alarms before the push", f"{len(rows) - len(pushed)} of {len(rows)}"),
    ]


FIGURES = {"payload": payload_figures, "wrong": wrong_figures, "touches": touches_figures, "slow": slow_figures}


def main() -> int:
    """Play the seeds that were asked for."""
    parser = argparse.ArgumentParser(description="What contacts have in common, played.")
    parser.add_argument("part", choices=list(FIGURES))
    add_seeds(parser, 60)
    add_jobs(parser)
    parser.add_argument("--mujoco", action="store_true", help="slow: play the arm in MuJoCo, with its friction")
    parser.add_argument("--list", action="store_true", help="print what was said of each arm")
    options = parser.parse_args()
    rows = list(play_trials(partial(play, part=options.part, is_foreign=options.mujoco), options.seeds, options.jobs))
    if options.list:
        for row in rows:
            found = f", {row.found_Nm:.3f} Nm" if np.isfinite(row.found_Nm) else ""
            print(
                f"{row.seed} {row.what} {row.size:.3g}{found}: {row.contacts} contacts, {row.after_s:.1f} s: {row.said}"
            )
    figures = FIGURES[options.part](rows)
    print_figures(figures)
    return exit_status(figures)


if __name__ == "__main__":
    sys.exit(main())
