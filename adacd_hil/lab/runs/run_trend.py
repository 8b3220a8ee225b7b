"""An arm's figures from run to run, and their last change beyond the expected variation.

A run is compared with the first one since the last change, so that slow drift adds up and is found. A **threshold** has
changed when it differs by more than a share of it, `THRESHOLD_SHARE` by default: it varies from run to run with the
identified parameters. If settings of the detection differ from those of the run before, `MEANT_SHARE` of that does.
**Friction and torque offsets** have changed when they differ by more than `LAST_SIGMAS` standard
deviations of both certificates together, the bound by which a run doubts the last certificate. The friction that the
paper's scheme identifies has no deviation, so its changes are not judged. Margins are only drawn.

Runs of an emulated arm in the same process are apart from those of the arm on a bus, and so are runs whose devices have
no serial number in common.

Shapes: n runs in order of their beginnings, a column for each joint (n, 2).
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from adacd_hil.lab.runs.run_summary import RunSummary
from adacd_hil.lab.runs.run_table import in_order
from adacd_hil.lab.stated_bounds import MEANT_SHARE, THRESHOLD_SHARE
from adacd_hil.lab.thresholds.free_motion import arm_differences
from adacd_hil.log.log_files import EMBEDDED
from adacd_hil.records import FRICTION_AT_RAD_S, JOINTS, Vector
from adacd_hil.scheme.identify.evidence import LAST_SIGMAS
from adacd_hil.settings.setting_keys import changed_keys

_DETECTION: Final = ("certified.", "detector.", "estimator.", "filter.", "scheme")
"""Settings that thresholds follow from."""
_TOLD_KEYS: Final = 3
_OF_A_RUN: Final = ("name", "history.", "operator.", "log.", "realtime.")
"""Settings that differ from run to run and do not affect the detection."""


class TrendChange(NamedTuple):
    """A run whose value at a joint (1, 2) differs from that of an earlier run, `before`.

    sigmas: the difference in standard deviations of both; None for a threshold.
    """

    run: RunSummary
    before: RunSummary
    joint: int
    value_before: float
    value: float
    sigmas: float | None


@dataclass(frozen=True)
class TrendQuantity:
    """A quantity over the runs of an arm: values and standard deviations (n, 2), nan if not known, and its changes."""

    name: str
    title: str
    values: Vector
    std: Vector
    changes: tuple[TrendChange, ...]


@dataclass(frozen=True)
class Trend:
    """The runs of an arm with a judge's figures, the oldest first; left_out: its other runs.

    quantities: thresholds, friction and offsets. margins (n,), nan where not known. sentence: on the last change of
    the thresholds; further: on those of friction and offsets, () without runs. assumed: a sentence on runs without
    serial numbers, "" if all have some.
    """

    arm: str
    runs: tuple[RunSummary, ...]
    left_out: tuple[RunSummary, ...]
    quantities: tuple[TrendQuantity, TrendQuantity, TrendQuantity]
    margins: Vector
    sentence: str
    further: tuple[str, ...]
    assumed: str

    def by_key(self) -> dict[str, Any]:
        """Return the trend by the keys of `trend --json`: runs, margins, sentences, and values and changes by quantity.

        "left_out" has the runs that are not judged, with their verdicts. Numbers that are not known are NaN.
        """
        names = [run.name for run in self.runs]
        return {
            "arm": self.arm,
            "runs": names,
            "started": [None if run.started is None else run.started.isoformat() for run in self.runs],
            "left_out": [{"run": run.name, "status": run.status, "verdict": run.verdict} for run in self.left_out],
            "margin": self.margins,
            **{
                each.name: {
                    "values": each.values,
                    "std": each.std,
                    "changes": [_change_json(change) for change in each.changes],
                }
                for each in self.quantities
            },
            "thresholds_last_changed": self.sentence,
            "drift": self.further,
            "assumed": self.assumed,
        }


def trends(runs: Iterable[RunSummary], threshold_share: float = THRESHOLD_SHARE) -> list[Trend]:
    """Return the trend of each arm, sorted by name; runs that are not judged are left out of it, but listed.

    Runs of one name whose settings or devices are of two arms are apart; the name of the later arm has the differing
    settings or the serial numbers. threshold_share: share of a threshold; a larger difference is a change. If settings
    of the detection differ from the run before, `MEANT_SHARE` of it counts.
    """
    by_arm: dict[str, list[RunSummary]] = {}
    for run in in_order(runs):
        name = arm_of(run)
        differing = arm_differences(
            next((each.settings for each in by_arm.get(name, ()) if each.settings), None), run.settings
        )
        name += "".join(f", {key} = {value}" for key, (_, value) in differing.items())
        by_arm.setdefault(_by_devices(name, run, by_arm), []).append(run)
    return [_trend(arm, found, threshold_share) for arm, found in sorted(by_arm.items())]


def _by_devices(name: str, run: RunSummary, by_arm: Mapping[str, Sequence[RunSummary]]) -> str:
    """Return the key in `by_arm`, earlier runs by arm, of the arm of this name that a run belongs to, or a new key.

    It belongs to the first one with a device in common, or if the devices of either are unknown. A new key is `name`
    for the first arm of the name, else `name` with the run's serial numbers.
    """
    others = [key for key in by_arm if key == name or key.startswith(f"{name}, serial numbers ")]
    for key in others:
        known = frozenset().union(*(each.devices for each in by_arm[key]))
        if not known or not run.devices or known & run.devices:
            return key
    serials = ", ".join(str(serial) for serial in sorted(serial for _, serial in run.devices))
    return f"{name}, serial numbers {serials}" if others else name


def arm_of(run: RunSummary) -> str:
    """Return the name of a run's arm, "unknown arm" without one.

    With ", emulated" if it was emulated in the host's process.
    """
    return f"{run.arm or 'unknown arm'}{', emulated' if run.interface == EMBEDDED else ''}"


def _trend(arm: str, runs: Sequence[RunSummary], threshold_share: float) -> Trend:
    """Return the trend of one arm: its judged runs, the changes of each quantity, and sentences on these."""
    judged = [run for run in runs if run.is_judged]

    def quantity(stem: str, title: str, share: float | None = None) -> TrendQuantity:
        values, std = (_columns([getattr(run, f"{stem}{end}", None) for run in judged]) for end in ("_Nm", "_std_Nm"))
        return TrendQuantity(f"{stem}_Nm", title, values, std, _changes(judged, values, std, share))

    found = (
        quantity("threshold", "Smallest threshold, median, Nm", threshold_share),  # it has no deviation
        quantity("friction", f"Friction at {FRICTION_AT_RAD_S:g} rad/s, Nm"),
        quantity("offset", "Torque offset, Nm"),
    )
    unknown = sum(not run.devices for run in judged)
    drifts = (_drift_sentence(found[1], "friction"), _drift_sentence(found[2], "torque offsets")) if judged else ()
    return Trend(
        arm,
        tuple(judged),
        tuple(run for run in runs if not run.is_judged),
        found,
        margins=np.array([math.nan if run.margin is None else run.margin for run in judged]),
        sentence=_threshold_sentence(judged, found[0]),
        further=drifts,
        assumed=f"{unknown} of {len(judged)} logs without a serial number of a device: assumed to be of this arm."
        if unknown
        else "",
    )


def _columns(pairs: Sequence[tuple[float, float] | None]) -> Vector:
    """Return values per joint as an array (n, 2), nan for None."""
    rows = [(math.nan,) * JOINTS if pair is None else pair for pair in pairs]
    return np.array(rows, np.float64).reshape(-1, JOINTS)


def _changes(runs: Sequence[RunSummary], values: Vector, std: Vector, share: float | None) -> tuple[TrendChange, ...]:
    """Return the runs whose value differs too much from the first one since the last change, joint by joint.

    Runs without a value are passed over; the changes are sorted by run, then by joint. share: of that first value,
    times `MEANT_SHARE` if settings of the detection differ from the run before; None: compare by standard deviations
    `std`, more than LAST_SIGMAS of both; without any deviation there is no change.
    """
    found: list[TrendChange] = []
    for joint in range(JOINTS):
        first: int | None = None
        for row in np.flatnonzero(np.isfinite(values[:, joint])).tolist():
            if first is None:
                first = row
                continue
            before, value = float(values[first, joint]), float(values[row, joint])
            both = math.hypot(std[first, joint], std[row, joint])
            sigmas = abs(value - before) / both if both > 0.0 else math.nan
            bound = 0.0 if share is None else share * abs(before)
            if share is not None and _is_meant(runs[row], runs[row - 1]):
                bound *= MEANT_SHARE
            is_changed = sigmas > LAST_SIGMAS if share is None else abs(value - before) > bound
            if is_changed:
                found.append(
                    TrendChange(runs[row], runs[first], joint + 1, before, value, None if share is not None else sigmas)
                )
                first = row
    order = {id(run): place for place, run in enumerate(runs)}
    return tuple(sorted(found, key=lambda change: (order[id(change.run)], change.joint)))


def _is_meant(run: RunSummary, before: RunSummary) -> bool:
    """Return whether settings of the detection differ from those of the run before: then thresholds may well change."""
    return any(key.startswith(_DETECTION) for key in _changed(run, before))


def _changed(run: RunSummary, before: RunSummary) -> dict[str, tuple[str, str]]:
    """Return the settings that differ from those of the run before, both values by key, without those of `_OF_A_RUN`.

    {} if the settings of either run are unknown.
    """
    if run.settings is None or before.settings is None or run.settings == before.settings:
        return {}
    changed = changed_keys(before.settings, run.settings)
    return {key: pair for key, pair in changed.items() if not key.startswith(_OF_A_RUN)}


def _threshold_sentence(runs: Sequence[RunSummary], thresholds: TrendQuantity) -> str:
    """Return a sentence on the last change of thresholds: run, values before and after, settings that changed with it.

    Without a change it says so, or why none can be found.
    """
    known = int(np.isfinite(thresholds.values).all(axis=1).sum())
    if not runs:
        return "No run is judged."
    if len(runs) == 1:
        return "Thresholds can't be compared: there is one run."
    if known < 2:
        return f"Thresholds can't be compared: {known} of {len(runs)} runs {'has' if known == 1 else 'have'} any."
    if not thresholds.changes:
        return f"Thresholds have not changed since {_when(runs[0])}: {known} runs."
    run, parts = _last_changes(thresholds)
    return f"Thresholds last changed with {_when(run)}: {parts}; {_settings_text(runs, run)}."


def _last_changes(quantity: TrendQuantity) -> tuple[RunSummary, str]:
    """Return the run of the last change, and a text with the change at each joint of it."""
    run = quantity.changes[-1].run
    parts = []
    for each in quantity.changes:
        if each.run is run:
            since = "" if each.sigmas is None else f", {each.sigmas:.1f} deviations since {each.before.name}"
            parts.append(f"joint {each.joint} {each.value_before:.3f} → {each.value:.3f} Nm{since}")
    return run, "; ".join(parts)


def _settings_text(runs: Sequence[RunSummary], run: RunSummary) -> str:
    """Return a phrase with the settings that a run changed against the one before it, `_TOLD_KEYS` of them by name.

    It may say that none changed, or that they are unknown.
    """
    place = next(number for number, each in enumerate(runs) if each is run)
    if run.settings is None or runs[place - 1].settings is None:
        return "the settings are not known"
    keys = _changed(run, runs[place - 1])
    if not keys:
        return "the settings are those of the run before"
    told = [f"{key} {one} → {two}" for key, (one, two) in list(keys.items())[:_TOLD_KEYS]]
    more = len(keys) - len(told)
    return f"settings changed there: {', '.join(told)}" + (f" and {more} more" if more else "")


def _drift_sentence(quantity: TrendQuantity, what: str) -> str:
    """Return a sentence on the last change of friction or torque offsets, or why none can be found.

    what: "friction" or "torque offsets", as the sentence's subject.
    """
    known = np.isfinite(quantity.values) & np.isfinite(quantity.std)
    rows = int(known.all(axis=1).sum())
    if rows < 2:
        there = f"there {'is' if rows == 1 else 'are'} {rows}"
        return f"{what.capitalize()} can't be compared: that takes two certificates with a deviation, {there}."
    if not quantity.changes:
        return f"{what.capitalize()}: no change beyond what the certificates' uncertainty explains."
    run, parts = _last_changes(quantity)
    return f"{what.capitalize()} changed beyond the certificates' uncertainty, last with {_when(run)}: {parts}."


def _when(run: RunSummary) -> str:
    date = "" if run.started is None else f" of {run.started:%Y-%m-%d %H:%M}"
    return f"run {run.name}{date}"


def _change_json(change: TrendChange) -> dict[str, Any]:
    return {
        "run": change.run.name,
        "before": change.before.name,
        "joint": change.joint,
        "from": change.value_before,
        "to": change.value,
        "sigmas": change.sigmas,
    }
