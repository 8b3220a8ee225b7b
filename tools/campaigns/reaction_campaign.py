"""Measures peak force and impulse on each body region of ISO/TS 15066 for each reaction: a table and a picture.

    python tools/campaigns/reaction_campaign.py                       all regions, 3 places each, free and clamped
    python tools/campaigns/reaction_campaign.py --region chest -n 10  one region, 10 places
    python tools/campaigns/reaction_campaign.py --out runs/reactions  where picture and table go as well

Profile P on its trajectory, the model known, no bus. A body stands in link 2's way at a random place, free to be
pushed away or clamped against a wall; each reaction meets the same bodies. Force and impulse are the emulator's, from
the first touch until 1 s after it; a free body's peak is beside the transient limit, a clamped one's beside the
quasi-static limit of its region. Exit status: 0 no withdrawal is worse than a stop, 1 one is, 2 wrong usage.
"""

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from campaign_loop import add_jobs, play_trials
from contact_rig import Rig, Sample, rig_settings

from adacd_hil.cli.output import format_table
from adacd_hil.control.motions import corner_to_corner
from adacd_hil.lab import drawing
from adacd_hil.records import Reaction, SchemeState, Vector
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.schema import ConfigError
from firmware_sim.arm.touch_settings import BODY_REGIONS, BodySettings
from firmware_sim.scenario.scenario import Scenario

AFTER_S = 1.0
BEFORE_S = 0.25
"""How long before the arm comes a body steps in."""
TOLERANCE = 1.02
"""A withdrawal is worse than a stop if it has more than this times its peak force or impulse."""
TOUCHING_N = 0.5
APART_S = 0.02
"""Contacts with less than this between them are one."""
QUASI_STATIC_N = {
    "skull_forehead": 130.0,
    "face": 65.0,
    "neck": 150.0,
    "back_shoulder": 210.0,
    "chest": 140.0,
    "abdomen": 110.0,
    "pelvis": 180.0,
    "upper_arm_elbow": 150.0,
    "lower_arm_wrist": 160.0,
    "hand_finger": 140.0,
    "thigh_knee": 220.0,
    "lower_leg": 130.0,
}
"""Limit of the force on a region that is clamped; table A.2."""
TRANSIENT_FACTOR = 2.0
"""Limit where the region can recoil, over that; table A.2."""
NEVER_TOUCHED = ("skull_forehead", "face")
"""Regions for which the table has no transient limit: contact there is to be prevented."""


class Meeting(NamedTuple):
    """A body in the arm's way, and the arm's noise."""

    body: BodySettings
    seed: int


class Harm(NamedTuple):
    """What one meeting did to the body."""

    peak_N: float
    impulse_N_s: float
    contacts: int
    is_faulted: bool


def meetings(settings: Settings, region: str, is_clamped: bool, count: int, seed: int) -> list[Meeting]:
    """Put a body in the way of link 2 at random times and places."""
    random = np.random.default_rng([seed, list(BODY_REGIONS).index(region), is_clamped])
    amplitude, half_period_s = (
        np.radians(settings.trajectory.amplitude_deg),
        np.array(settings.trajectory.half_period_s),
    )
    length1_m, length2_m = settings.arm.link_length_m
    found: list[Meeting] = []
    while len(found) < count:
        q, dq, ddq = np.zeros(2), np.zeros(2), np.zeros(2)
        at_s = float(random.uniform(0.4, 0.8) + 1.125 * random.integers(0, 2))
        corner_to_corner(at_s, amplitude, half_period_s, q, dq, ddq)
        lever_m = float(random.uniform(0.4, 0.95)) * length2_m
        x_m = length1_m * np.cos(q[0]) + lever_m * np.cos(q.sum())
        y_m = length1_m * np.sin(q[0]) + lever_m * np.sin(q.sum())
        body = BodySettings(
            at_s=round(at_s - BEFORE_S, 4), link=2, x_m=float(x_m), y_m=float(y_m), region=region,
            radius_m=0.01, clamped=is_clamped,
        )  # fmt: skip
        start_deg = tuple(-float(value) for value in settings.trajectory.amplitude_deg)
        try:
            Scenario(start_deg=(start_deg[0], start_deg[1]), bodies=(body,))
        except ConfigError:
            continue
        found.append(Meeting(body, int(random.integers(2**31))))
    return found


def meet(settings: Settings, meeting: Meeting) -> Harm:
    """Let the arm meet a body."""
    start_deg = settings.trajectory.amplitude_deg
    scenario = Scenario(start_deg=(-start_deg[0], -start_deg[1]), bodies=(meeting.body,), seed=meeting.seed)
    rig = Rig(settings, scenario)
    return harm_of(rig.run(meeting.body.at_s + BEFORE_S + AFTER_S), settings.bus.period_s)


def harm_of(samples: Sequence[Sample], period_s: float) -> Harm:
    """Read force and impulse off the truth."""
    force: Vector = np.array([sample.true("contact_force")[0] for sample in samples])
    touching = np.flatnonzero(force > TOUCHING_N)
    contacts = 1 + int(np.sum(np.diff(touching) > APART_S / period_s)) if touching.size else 0
    is_faulted = any(sample.output.state is SchemeState.FAULT for sample in samples)
    return Harm(float(force.max()), period_s * float(force.sum()), contacts, is_faulted)


def reacting(reaction: Reaction) -> Settings:
    """Return settings with one reaction to everything."""
    name = reaction.name.lower()
    return rig_settings(
        reaction={"contact": [name] * 2, "collision": [name] * 2, "start": "measured", "rebound_s": 0.2}
    )


Harms = dict[tuple[str, bool], dict[Reaction, list[Harm]]]


def measure(regions: Sequence[str], count: int, seed: int, jobs: int) -> Harms:
    """Let each reaction meet the same bodies, of each region free and clamped."""
    pairs = list(product(regions, (False, True)))
    results = play_trials(partial(_measure_pair, count=count, seed=seed), pairs, jobs)
    return dict(zip(pairs, results, strict=True))


def _measure_pair(pair: tuple[str, bool], count: int, seed: int) -> dict[Reaction, list[Harm]]:
    region, is_clamped = pair
    same = meetings(reacting(Reaction.NONE), region, is_clamped, count, seed)
    return {reaction: [meet(reacting(reaction), meeting) for meeting in same] for reaction in Reaction}


def limit_N(region: str, is_clamped: bool) -> float | None:
    """Return the standard's limit of the force; None without one."""
    if is_clamped:
        return QUASI_STATIC_N[region]
    return None if region in NEVER_TOUCHED else TRANSIENT_FACTOR * QUASI_STATIC_N[region]


def worse(harms: Harms) -> list[str]:
    """Name where a withdrawal is worse than a stop."""
    found = []
    for (region, is_clamped), by_reaction in harms.items():
        pairs = zip(by_reaction[Reaction.STOP], by_reaction[Reaction.WITHDRAW], strict=True)
        for number, (stop, withdrawal) in enumerate(pairs):
            for what, before, after in (
                ("N", stop.peak_N, withdrawal.peak_N),
                ("N s", stop.impulse_N_s, withdrawal.impulse_N_s),
            ):
                if after > TOLERANCE * before:
                    name = f"{region}, {'clamped' if is_clamped else 'free'}, place {number + 1}"
                    found.append(f"{name}: {after:.2f} {what} when withdrawing, {before:.2f} {what} when stopping")
    return found


def as_table(harms: Harms) -> str:
    """Lay out means over the places: peak N / impulse N s, with the number of contacts where it is not one."""
    head = ["body region", "", "limit N", *(reaction.name.lower() for reaction in Reaction)]
    rows = []
    for (region, is_clamped), by_reaction in harms.items():
        limit = limit_N(region, is_clamped)
        row = [region, "clamped" if is_clamped else "free", "none" if limit is None else f"{limit:.0f}"]
        for found in by_reaction.values():
            peak, impulse = np.mean([harm.peak_N for harm in found]), np.mean([harm.impulse_N_s for harm in found])
            contacts = np.mean([harm.contacts for harm in found])
            faults = sum(harm.is_faulted for harm in found)
            row.append(f"{peak:.0f} / {impulse:.2f} ({contacts:.1f})" + (f" {faults} faults" if faults else ""))
        rows.append(row)
    return format_table(head, rows, right=range(2, len(head)))


def draw(harms: Harms, path: Path) -> None:
    """Draw peak force and impulse of each reaction, free and clamped, region by region."""
    from matplotlib.figure import Figure

    regions = list(dict.fromkeys(region for region, _ in harms))
    colours = [drawing.COLOURS[name] for name in ("bar", "identified", "joint1", "cad", "joint2", "alarm")]
    with drawing.style():
        figure = Figure(figsize=(12.0, 7.0))
        axes = figure.subplots(2, 2, sharex=True)
        for column, is_clamped in enumerate((False, True)):
            for row, (what, unit) in enumerate((("peak_N", "peak force, N"), ("impulse_N_s", "impulse, N s"))):
                panel = axes[row][column]
                for number, (reaction, colour) in enumerate(zip(Reaction, colours, strict=True)):
                    heights = [
                        np.mean([getattr(harm, what) for harm in harms[region, is_clamped][reaction]])
                        for region in regions
                    ]
                    places = np.arange(len(regions)) + 0.14 * (number - 2.5)
                    panel.bar(places, heights, 0.13, color=colour, label=reaction.name.lower())
                panel.set_ylabel(unit)
                if row == 0:
                    panel.set_title("clamped against a wall" if is_clamped else "free to be pushed away")
                    for number, region in enumerate(regions):
                        limit = limit_N(region, is_clamped)
                        if limit is not None:
                            panel.plot([number - 0.45, number + 0.45], [limit, limit], color=drawing.COLOURS["ink"])
                panel.set_xticks(np.arange(len(regions)), regions, rotation=60, ha="right")
        figure.legend(*axes[0][0].get_legend_handles_labels(), loc="upper center", ncols=6)
        figure.tight_layout(rect=(0.0, 0.0, 1.0, 0.96))
        path.write_bytes(drawing.Drawing("reactions", "Reactions", "Peak force and impulse by reaction", figure).png())


def main(argv: Sequence[str] | None = None) -> int:
    """Run the campaign."""
    parser = argparse.ArgumentParser(prog="reaction_campaign", description="Force and impulse by reaction and region.")
    parser.add_argument("--region", action="append", choices=list(BODY_REGIONS), help="only this; may be repeated")
    parser.add_argument("-n", "--places", type=int, default=3, help="places per region; default %(default)s")
    parser.add_argument("--seed", type=int, default=1, help="default %(default)s")
    parser.add_argument("--out", type=Path, default=Path("runs/reactions"), help="folder; default %(default)s")
    add_jobs(parser)
    chosen = parser.parse_args(argv)
    harms = measure(chosen.region or list(BODY_REGIONS), chosen.places, chosen.seed, chosen.jobs)
    chosen.out.mkdir(parents=True, exist_ok=True)
    table = as_table(harms)
    print("peak N / impulse N s (contacts), mean over the places")
    print(table)
    (chosen.out / "reactions.txt").write_text(table + "\n", encoding="utf-8")
    draw(harms, chosen.out / "reactions.png")
    problems = worse(harms)
    print(*problems, sep="\n")
    print(f"picture: {chosen.out / 'reactions.png'}", file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
