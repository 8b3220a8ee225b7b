"""Plays arms with errors that the model lacks: time to the certificate, false alarms, thresholds, missed pushes.

    python tools/campaigns/error_campaign.py --minutes 40 --only clean
    python tools/campaigns/error_campaign.py --profiles P --only 'lugre*,load*,cable*' -j 2

Each arm learns on the excitation and then moves at random, in `lab`'s closed loop; with --kg also once that payload has
been announced. Steps of torque begin every 20 ms, both signs, as each channel answers them (no bus, no tracking loop);
early: within 1 to 11 s after arming. What one step misses in 300 ms is missed. An alarm ends nothing here, so its rate
counts those that are 0.3 s apart. Tables go to stdout, progress to stderr. Exit status: 0 each was played, 2 wrong
usage.
"""

import argparse
import fnmatch
import json
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product

import numpy as np
from campaign_certified import CertifiedScheme
from campaign_loop import add_jobs, add_seeds, play_trials
from lab import PERIOD_S, Motion, cut, join, profile_arm, random_motion, record, still
from lab_arm import theta_of
from numpy.typing import NDArray
from played_record import play_record

from adacd_hil.cli.output import format_table
from adacd_hil.compiled import compiled
from adacd_hil.records import SchemeState
from adacd_hil.scheme.detect.sensitivity import AGREES
from adacd_hil.scheme.model.filter_bank import channels_of, step_response
from adacd_hil.scheme.supervisor import findings
from adacd_hil.scheme.supervisor.findings import CONTACT_SHIFT
from adacd_hil.score.judge import begins_of
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.setting_keys import apply_settings, parse_changes
from firmware_sim.arm.arms import EmulatedArm
from firmware_sim.arm.hardware_settings import MechanicsSettings, SensorSettings

Array = NDArray[np.float64]

LEARNS_S, LOADED_AFTER_S, LEARNS_AGAIN_S = 6.0, 12.0, 2.0
SETTLED_S, EARLY_S = 1.0, 11.0
GRID, WITHIN = 20, 300
"""Cycles between two onsets, and in which a step must be found."""
APART = 300
MOVING_RAD_S = 0.02
STEPS_NM = (0.1, 0.3, 1.0)
CABLES_NM = {"cable 0.05 Nm sin q": 0.05, "cable 0.1 Nm sin q": 0.1}
ELASTIC_DAMPING, ROTOR_KG_M2 = 0.02, (0.05, 0.01)


def mechanics_of(error: str, arm: EmulatedArm) -> MechanicsSettings:
    """Return what the error named does to the arm; the rigid plant where it is another's."""
    coulomb_Nm, inertia = np.array(arm.coulomb_Nm), theta_of(arm)[[0, 2]]

    def pair(values: Array) -> tuple[float, float]:
        return float(values[0]), float(values[1])

    def lugre(bristle_rad: float) -> MechanicsSettings:
        sigma0 = pair(coulomb_Nm / bristle_rad)
        return MechanicsSettings(
            static_Nm=pair(1.5 * coulomb_Nm), sigma0_Nm_rad=sigma0, sigma1_Nm_s=pair(1e-3 * np.array(sigma0))
        )

    def elastic(swing_Hz: float) -> MechanicsSettings:
        rad_s = 2.0 * np.pi * swing_Hz
        return MechanicsSettings(
            stiffness_Nm_rad=pair(rad_s**2 * inertia),
            damping_Nm_s=pair(2.0 * ELASTIC_DAMPING * rad_s * inertia),
            rotor_inertia_kg_m2=ROTOR_KG_M2,
        )

    made = {
        "lugre 1 mrad": lugre(1e-3),
        "lugre 4 mrad": lugre(4e-3),
        "load 6 %": MechanicsSettings(load_friction=(0.06, 0.06)),
        "stribeck x 2": MechanicsSettings(static_Nm=pair(2.0 * coulomb_Nm)),
        "tilt 0.5 deg": MechanicsSettings(tilt_deg=0.5, holding_brake_Nm=(5.0, 2.0)),
        "tilt 1 deg": MechanicsSettings(tilt_deg=1.0, holding_brake_Nm=(5.0, 2.0)),
        "ripple 0.05 Nm": MechanicsSettings(ripple_Nm=(0.05, 0.05)),
        "elastic 8 Hz": elastic(8.0),
        "elastic 25 Hz": elastic(25.0),
    }
    return made.get(error, MechanicsSettings())


SENSORS = {
    "10-bit torque": SensorSettings(torque_bits=(10, 10)),
    "18-bit encoder": SensorSettings(encoder_bits=(18, 18)),
    "gain and cross-talk 2 %": SensorSettings(gain_error=(0.02, -0.02), cross_talk=(0.02, 0.02)),
    "eccentric 1 mrad": SensorSettings(eccentricity_rad=(1e-3, 1e-3)),
    "offset drift 1 mNm/s": SensorSettings(offset_drift_Nm_s=(1e-3, 1e-3)),
    "hysteresis 0.05 Nm": SensorSettings(hysteresis_Nm=(0.05, 0.05)),
}
ERRORS = (
    "clean", "lugre 1 mrad", "lugre 4 mrad", "load 6 %", "stribeck x 2", "tilt 0.5 deg", "tilt 1 deg", "ripple 0.05 Nm",
    *SENSORS, *CABLES_NM, "elastic 8 Hz", "elastic 25 Hz",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One arm: profile, error, payload that is announced, kg, and seed."""

    profile: str
    error: str
    kg: float
    seed: int


@dataclass(frozen=True)
class Played:
    """What came of it. Times in s since learning began, thresholds of the slowest channel in Nm by joint.

    taken_back: certificates that what was learnt since contradicts. found_ms, found_early_ms: by step, of joint 1, the
    median, 95 % and worst, inf where it is missed; missed: shares.
    """

    case: Case
    armed_s: float | None
    hours: float = 0.0
    alarms: int = 0
    taken_back: int = 0
    median_Nm: tuple[float, ...] = ()
    most_Nm: tuple[float, ...] = ()
    wide_share: tuple[float, ...] = ()
    largest_share: float = 0.0
    found_early_ms: tuple[tuple[float, float, float], ...] = ()
    missed_early: tuple[float, ...] = ()


def motion_of(seed: int, minutes: float, is_loaded: bool) -> tuple[Motion, int]:
    """Return the whole motion, and the cycle in which the payload is announced, -1 for none."""
    excitation = CertifiedScheme("certified", load_settings("certified", "S")).adaptation_motion(is_payload=False)
    learning = cut(excitation, round(LEARNS_S / PERIOD_S))
    if not is_loaded:
        return join([learning, random_motion(seed, 60.0 * minutes)]), -1
    before = [learning, random_motion(seed, LOADED_AFTER_S), still(excitation.q_d[0], 0.6)]
    again = cut(excitation, round(LEARNS_AGAIN_S / PERIOD_S))
    return join([*before, again, random_motion(seed + 500, 60.0 * minutes)]), len(join(before).q_d)


@compiled
def find_steps(
    y: Array,
    h: Array,
    responses: Array,
    filters: int,
    onsets: NDArray[np.int64],
    joint: int,
    step_Nm: float,
    found: Array,
) -> None:
    """Fill after how many cycles a step on a joint is found, inf where it isn't. y, h (n, channels, 2); found (k,)."""
    for k in range(onsets.size):
        found[k] = np.inf
        for cycle in range(responses.shape[1]):
            t = onsets[k] + cycle
            for c in range(y.shape[1]):
                is_over = not abs(y[t, c, joint] + step_Nm * responses[c, cycle]) <= h[t, c, joint]
                if is_over and c >= filters:
                    smoothed = c - filters + 1
                    shown = abs(y[t, smoothed, joint] + step_Nm * responses[smoothed, cycle])
                    is_over = not shown <= AGREES * h[t, smoothed, joint]
                if is_over:
                    found[k] = min(found[k], cycle + 1.0)
            if found[k] < np.inf:
                break


def play(case: Case, minutes: float, changes: Mapping[str, str]) -> Played:
    """Record the arm, play the record through the compiled step with these settings changed, and measure."""
    base = profile_arm(case.profile)
    arm = replace(
        base,
        own_mechanics=mechanics_of(case.error, base.arm),
        sensors=SENSORS.get(case.error, SensorSettings()),
    )
    motion, loaded_at = motion_of(case.seed, minutes, case.kg > 0.0)
    feedforward, payloads = [(2.5, arm.theta)], []
    if loaded_at >= 0:
        payloads.append(((loaded_at - 50) * PERIOD_S, case.kg))
        feedforward.append((loaded_at * PERIOD_S + 1.0, theta_of(arm.arm, case.kg)))
    measured = record(arm, motion, seed=case.seed, feedforward=feedforward, payloads=payloads)
    tau_J = measured.tau_J
    if case.error in CABLES_NM:  # as one whose torque the motor makes up for, on the same way
        tau_J = tau_J + CABLES_NM[case.error] * np.sin(measured.q)
    settings = apply_settings(load_settings("certified", case.profile), changes)
    settings = replace(settings, arm=replace(settings.arm, link_length_m=arm.arm.link_length_m))
    count = len(motion.q_d)
    state, observation, y, h, _, _ = play_record(settings, measured.q, measured.dq, tau_J, loaded_at)
    begin = max(loaded_at, 0)
    is_monitored = (state == SchemeState.MONITOR) & (np.arange(count) >= begin)
    if not is_monitored.any():
        return Played(case, None)
    armed = int(np.argmax(is_monitored))
    is_over = is_monitored & (observation.astype(np.int64) >> CONTACT_SHIFT != 0)
    over = np.flatnonzero(is_over)
    is_quiet = is_monitored & ~is_over & (np.arange(count) >= armed + round(SETTLED_S / PERIOD_S))
    is_moving = is_quiet[:, None] & (np.abs(measured.dq) > MOVING_RAD_S)
    slow = h[:, 0]
    early = quiet_onsets(is_quiet, armed + round(EARLY_S / PERIOD_S))
    found = [_found_ms(settings, y, h, early, step) for step in STEPS_NM]
    return Played(
        case,
        armed_s=(armed - begin) * PERIOD_S,
        hours=float(is_monitored.sum()) * PERIOD_S / 3600.0,
        taken_back=int(np.count_nonzero(is_monitored & (observation.astype(np.int64) & findings.WITHHELD != 0))),
        alarms=int(np.count_nonzero(begins_of(over, APART))),
        median_Nm=tuple(float(np.median(slow[is_quiet, i])) for i in range(2)),
        most_Nm=tuple(float(np.percentile(slow[is_quiet, i], 99.0)) for i in range(2)),
        wide_share=tuple(float(np.mean(slow[is_moving[:, i], i] > 0.15)) for i in range(2)),
        largest_share=float((np.abs(y[is_quiet]) / h[is_quiet]).max()),
        found_early_ms=tuple(tuple(np.percentile(ms, (50, 95, 100), method="lower").tolist()) for ms in found),
        missed_early=tuple(float(np.mean(np.isinf(ms))) for ms in found),
    )


def quiet_onsets(is_quiet: NDArray[np.bool_], end: int) -> NDArray[np.int64]:
    """Return the grid's cycles before `end` from which on nothing else happens for as long as a step is waited for."""
    starts = np.arange(0, min(end, is_quiet.size - WITHIN), GRID)
    return starts[[bool(is_quiet[k : k + WITHIN].all()) for k in starts]]


def _found_ms(settings: Settings, y: Array, h: Array, onsets: NDArray[np.int64], step_Nm: float) -> Array:
    """Return after how long a step of joint 1 is found, ms, both signs; inf where it isn't, and without any onset."""
    responses = np.array(
        [[step_response((k + 0.5) * PERIOD_S, *channel) for k in range(WITHIN)] for channel in channels_of(settings)]
    )
    found = np.full((2, max(onsets.size, 1)), np.inf)
    for row, sign in enumerate((1.0, -1.0)):
        find_steps(y, h, responses, settings.filter_count, onsets, 0, sign * step_Nm, found[row])
    return 1e3 * PERIOD_S * found.ravel()


def row_of(played: Played) -> list[str]:
    """Return the table's row of one arm."""
    case = played.case
    name = [case.profile, f"{case.kg:g} kg" if case.kg else "", case.error, str(case.seed)]
    if played.armed_s is None:
        return [*name, "never", *[""] * 9]

    def joints(values: tuple[float, ...], text: str) -> str:
        return " / ".join(format(value, text) for value in values)

    return [
        *name,
        f"{played.armed_s:.2f} s",
        f"{played.alarms} in {60.0 * played.hours:.0f} min",
        str(played.taken_back or ""),
        joints(played.median_Nm, ".3f"),
        joints(played.most_Nm, ".3f"),
        joints(played.wide_share, ".1%"),
        f"{played.largest_share:.2f}",
        *(
            ", ".join(format(ms, ".0f") for ms in found) + f" ({missed:.1%})"
            for found, missed in zip(played.found_early_ms, played.missed_early, strict=True)
        ),
    ]


HEAD = (
    "arm", "payload", "error", "seed", "armed after", "false alarms", "taken back", "threshold, Nm: median", "99 %",
    "> 0.15 moving", "largest share", *(f"{step:g} Nm: median, 95 %, worst ms (missed)" for step in STEPS_NM),
)  # fmt: skip


def main() -> int:
    """Play the arms that were asked for."""
    parser = argparse.ArgumentParser(description="Arms with errors that the certified scheme may lack.")
    parser.add_argument("--profiles", default="P,S,M", metavar="NAMES")
    parser.add_argument("--only", default="*", metavar="PATTERNS", help=f"of {', '.join(ERRORS)}".replace("%", "%%"))
    parser.add_argument("--kg", default="0", metavar="MASSES", help="0, or a payload that is announced")
    add_seeds(parser, 1)
    parser.add_argument("--minutes", type=float, default=3.0, help="of random motion; default 3")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change a setting; repeatable")
    add_jobs(parser)
    parser.add_argument("--json", action="store_true", help="print each arm as JSON")
    options = parser.parse_args()
    patterns = options.only.split(",")
    errors = [error for error in ERRORS if any(fnmatch.fnmatch(error, pattern) for pattern in patterns)]
    if not errors:
        parser.error(f"--only {options.only!r} fits none of {', '.join(ERRORS)}")
    lists = options.profiles.split(","), errors, options.kg.split(","), options.seeds
    cases = [Case(profile, error, float(kg), seed) for profile, error, kg, seed in product(*lists)]
    one = partial(play, minutes=options.minutes, changes=parse_changes(options.set))
    rows = list(play_trials(one, cases, options.jobs, lambda played: f"{played.case.profile} {played.case.error}"))
    print(json.dumps([asdict(row) for row in rows]) if options.json else format_table(HEAD, map(row_of, rows)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
