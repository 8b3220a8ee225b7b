"""Draft of a map from a recording and a URDF: columns by their heads or values, units by spans against the URDF.

The map marks each guess with its reason; `identify` reports wrong ones.
"""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from adacd_hil.file_access import read_input
from adacd_hil.lab.logs.joint_state_bags import JOINT_STATES, is_bag, joint_state_topics, opened_bag
from adacd_hil.lab.offline.column_checks import torques_and_limits
from adacd_hil.lab.offline.recording_map import ISO, TIME_S, CsvSection, UnitsSection, time_unit_of, units_by_slope
from adacd_hil.lab.offline.table_guess import TableGuess, guess_table
from adacd_hil.lab.serial_arm.urdf import SerialArm, UrdfError, read_urdf
from adacd_hil.log.log_files import LogError
from adacd_hil.records import Vector
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.toml_text import toml_value

_FINGERS: Final = re.compile(r"finger|gripper|claw|knuckle|jaw", re.IGNORECASE)
_BEYOND: Final = 1.5
"""Factor on the limits of the URDF, from which positions are degrees."""
_BEYOND_EFFORT: Final = 5.0
_SEEN_MESSAGES: Final = 20_000


class DraftedKey(NamedTuple):
    """A key of the map and its value. reason: why a guessed value was chosen; "" if the value is certain."""

    section: str
    key: str
    value: object
    reason: str


def map_text(recording: Path, keys: Sequence[DraftedKey]) -> str:
    """Return a map as the text of a TOML file, each guess with its reason in a comment."""
    lines = [f"# Drafted from {recording.name}: check the guesses."]
    for section in dict.fromkeys(key.section for key in keys):
        lines += ["", f"[{section}]"]
        for key in (key for key in keys if key.section == section):
            comment = f"  # a guess: {key.reason}" if key.reason else ""
            lines.append(f"{key.key} = {toml_value(key.value)}{comment}")
    return "\n".join(lines) + "\n"


def draft_map(recording: Path, urdf: Path, map_path: Path) -> list[DraftedKey]:
    """Return the keys of a map of a recording, for `map_text`; write no file.

    map_path: file in which the caller will save the map; the URDF's path is relative to its folder. Raises ConfigError
    if the URDF can't be read, or no columns or joints of the recording fit it; LogError if the recording can't be read,
    or has no joint states or no rows of numbers.
    """
    arm, locked = _read_arm(urdf)
    where = Path(os.path.relpath(urdf.resolve(), map_path.resolve().parent)).as_posix()
    keys = [DraftedKey("arm", "urdf", where, "")]
    if locked:
        keys.append(DraftedKey("arm", "locked", locked, "by their names joints of a gripper"))
    return keys + (_of_bag(recording, arm) if is_bag(recording) else _of_table(recording, arm))


def _read_arm(urdf: Path) -> tuple[SerialArm, tuple[str, ...]]:
    """Read the arm of a URDF; return it, and the names of the joints that the map must lock.

    If the URDF can't be read otherwise, all joints with a name like a gripper's are locked; else (). Raises ConfigError
    if it can't be read so either.
    """
    try:
        text = read_input(urdf)
        try:
            return read_urdf(text), ()
        except UrdfError:
            names = re.findall(r'<joint[^>]*name="([^"]+)"', text.decode("utf-8", "replace"))
            locked = tuple(dict.fromkeys(name for name in names if _FINGERS.search(name)))
            if not locked:
                raise
            return read_urdf(text, locked=locked), locked
    except OSError as error:
        raise ConfigError(f"URDF {urdf}: {error.strerror or error}") from None
    except UrdfError as error:
        raise ConfigError(f"URDF {urdf}: {error}") from None


def _of_table(recording: Path, arm: SerialArm) -> list[DraftedKey]:
    """Draft the keys of a CSV file: the form that differs from the defaults, the columns, the units.

    Without times, draft `sampling.period_s` = 0 for the user to fill in. Raises ConfigError if no columns look like
    positions, or like torques or currents; LogError if the file can't be read.
    """
    guess = guess_table(recording, arm.joint_names)
    n, form = len(arm.joint_names), guess.form
    for role, what in (("q", "positions"), ("tau_J", "torques or currents")):
        if role not in guess.columns:
            raise ConfigError(
                f"recording {recording}: no {n} columns look like {what} of {', '.join(arm.joint_names)}; there are "
                f"{', '.join(guess.heads)}"
            )
    keys = []
    defaults = vars(CsvSection())
    keys += [DraftedKey("csv", key, value, "") for key, value in vars(form).items() if value != defaults[key]]
    for role in ("time", "q", "dq", "tau_J", "contact"):
        if role in guess.columns:
            names = guess.columns[role]
            value: object = names[0] if role in ("time", "contact") else names
            keys.append(DraftedKey("columns", role, value, guess.reasons.get(role, "")))
    keys += _units_of_table(guess, arm)
    if "time" not in guess.columns:
        keys.append(DraftedKey("sampling", "period_s", 0.0, "write how far rows are apart, s; there are no times"))
    return keys


def _units_of_table(guess: TableGuess, arm: SerialArm) -> list[DraftedKey]:
    """Draft the units that differ from the map's defaults.

    For currents, draft `scale.tau_J`, all 1, and `arm.has_rotors`, too.
    """
    keys = []

    def add_unit(role: str, default: str, guessed: str, reason: str) -> str:
        unit = guess.units.get(role) or guessed
        if unit != default:
            keys.append(DraftedKey("units", role, unit, "" if role in guess.units else reason))
        return unit

    step = 1e-3
    if "time" in guess.columns:
        step = float(np.nanmedian(np.diff(guess.of("time")[:, 0]))) or np.nan  # coarse times don't tell it
    if guess.is_iso:
        keys.append(DraftedKey("units", "time", ISO, ""))
    elif "time" in guess.columns:
        guessed = time_unit_of(step) or "s"
        step *= TIME_S[add_unit("time", "s", guessed, f"rows are {step:g} {guessed} apart")]
    angle = add_unit("q", "rad", *_angle_unit(guess.of("q"), arm))
    if "dq" in guess.columns:
        add_unit("dq", "rad/s", _speed_unit(guess, angle, step), "by the slope of the positions")
    torque = add_unit("tau_J", "Nm", *_torque_unit(guess.of("tau_J"), arm))
    if torque in ("A", "mA"):
        ones = (1.0,) * len(arm.joint_names)
        keys.append(DraftedKey("scale", "tau_J", ones, "Nm/A of each joint, which only its maker knows"))
        keys.insert(0, DraftedKey("arm", "has_rotors", True, "currents of motors turn the rotors, too"))
    return keys


def _angle_unit(q: Vector, arm: SerialArm) -> tuple[str, str]:
    """Return "deg" and the reason if a revolute joint goes far beyond its limit in the URDF, rad; else "rad", "".

    Far beyond is over `_BEYOND` times the limit. A joint without limits has one of a whole turn to each side. q (k, n).
    """
    bound = np.maximum(np.abs(arm.position_low), np.abs(arm.position_high))
    bound = np.where(np.isfinite(bound) & (bound > 0.0), bound, 2.0 * np.pi)
    reach = np.nanmax(np.abs(q), axis=0)
    over = np.nan_to_num(reach / bound) * (arm.chain.is_prismatic == 0.0)
    joint = int(np.argmax(over))
    if over[joint] <= _BEYOND:
        return "rad", ""
    return "deg", f"{arm.joint_names[joint]} goes to {reach[joint]:.3g}, the URDF to {bound[joint]:.3g} rad"


def _speed_unit(guess: TableGuess, angle: str, step_s: float) -> str:
    """Return the unit in which velocities are within 10 % of the positions' slope, whatever their sign.

    "rad/s" if there is none, or no position changes. angle: unit of the positions. step_s: interval of the rows.
    """
    slope = np.gradient(guess.of("q"), axis=0) / step_s * (np.pi / 180.0 if angle == "deg" else 1.0)
    square = np.nansum(slope**2)
    factor = abs(float(np.nansum(slope * guess.of("dq")) / square)) if square > 0.0 else 1.0
    return next((unit for key, unit in units_by_slope(UnitsSection(), factor) if key == "dq"), "rad/s")


def _torque_unit(tau: Vector, arm: SerialArm) -> tuple[str, str]:
    """Return "mNm" and the reason if a joint's torque is over `_BEYOND_EFFORT` times the URDF's effort, else "Nm", "".

    Its 99 % quantile counts. Without an effort the torque is over nothing. tau (k, n).
    """
    largest, effort = torques_and_limits(tau, arm)
    over = np.nan_to_num(largest / effort)
    joint = int(np.argmax(over))
    if over[joint] <= _BEYOND_EFFORT:
        return "Nm", ""
    return "mNm", f"they reach {largest[joint]:.3g}, the effort of the URDF is {effort[joint]:g} Nm"


def _of_bag(recording: Path, arm: SerialArm) -> list[DraftedKey]:
    """Draft the keys of a bag that differ from the defaults: stamp, names of joints, units.

    With several topics of joint states, draft `bag.topic`, too: /joint_states, or else the first. Only the first
    `_SEEN_MESSAGES` messages are read. Raises LogError if the bag can't be read or has no joint states, ConfigError if
    its joints don't fit the arm's.
    """
    keys = []
    with opened_bag(recording) as (topics, read_messages):
        found = joint_state_topics(topics)
        if not found:
            raise LogError(f"recording {recording} has no topic of sensor_msgs/msg/JointState")
        topic = JOINT_STATES if JOINT_STATES in found else found[0]
        if len(found) > 1:
            keys.append(DraftedKey("bag", "topic", topic, f"one of {', '.join(found)}"))
        names: dict[str, None] = {}
        positions, efforts = [], []
        is_stamped = False
        for _, (_, message) in zip(range(_SEEN_MESSAGES), read_messages(topic), strict=False):
            names |= dict.fromkeys(message.names)
            is_stamped |= message.stamp_ns != 0
            if len(message.names) == len(message.position) == len(message.effort):
                positions.append(dict(zip(message.names, message.position.tolist(), strict=True)))
                efforts.append(dict(zip(message.names, message.effort.tolist(), strict=True)))
    if not is_stamped:
        keys.append(DraftedKey("bag", "time", "received", "all stamps are 0"))
    chosen = _bag_names(recording, list(names), arm)
    if chosen != arm.joint_names:
        keys.append(DraftedKey("columns", "q", chosen, "by their endings and order"))
    if positions:
        q, tau = (
            np.array([[row.get(name, np.nan) for name in chosen] for row in rows]) for rows in (positions, efforts)
        )
        for key, values, unit_of, default in (("q", q, _angle_unit, "rad"), ("tau_J", tau, _torque_unit, "Nm")):
            unit, reason = unit_of(values, arm) if np.isfinite(values).any() else (default, "")
            if unit != default:
                keys.append(DraftedKey("units", key, unit, reason))
    return keys


def _bag_names(recording: Path, names: list[str], arm: SerialArm) -> tuple[str, ...]:
    """Return the bag's names of the arm's joints, in the arm's order.

    They are found by equal names, else by endings; else, if there are as many, all names of the bag in the order of
    their numbers. Raises ConfigError if none of these ways fits.
    """
    if set(arm.joint_names) <= set(names):
        return arm.joint_names
    chosen = []
    for wanted in arm.joint_names:
        ends = [name for name in names if name.endswith(wanted) or wanted.endswith(name)]
        if len(ends) == 1:
            chosen.append(ends[0])
    if len(set(chosen)) == len(arm.joint_names):
        return tuple(chosen)
    if len(names) == len(arm.joint_names):
        return tuple(sorted(names, key=_natural))
    raise ConfigError(
        f"recording {recording} has the joints {', '.join(names)}, the URDF {', '.join(arm.joint_names)}: write "
        "`columns.q` by hand"
    )


def _natural(name: str) -> list[tuple[bool, int, str]]:
    """Return a sort key that orders names by the numbers in them: joint2 before joint10."""
    parts = re.split(r"(\d+)", name)
    return [(part.isdigit(), int(part) if part.isdigit() else 0, part) for part in parts]
