"""Guesses the form of a CSV file, delimiter, head and decimals, and the role of its columns, by heads and by values.

A head is split into words, a number and a unit: `pos_meas_2`, `j1_deg`, `actual_qd_0`, `effort [mNm]`. Columns with the
same words and other numbers, or the arm's joints, are a group; a group of as many as the arm has joints is positions,
velocities or torques by one of its words. Without heads, columns whose slope other columns are, are positions.
"""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from adacd_hil.lab.offline.csv_recording import (
    DELIMITERS,
    head_of,
    is_iso_time,
    is_number,
    iso_seconds,
    opened_text,
    read_number,
    split_rows,
    trimmed,
)
from adacd_hil.lab.offline.recording_map import CsvSection, unit_of
from adacd_hil.log.log_files import LogError
from adacd_hil.records import Vector

_SEEN_ROWS: Final = 20_000
_HEAD_ROWS: Final = 60
"""Rows in which the head is searched."""
_FULL_ROWS: Final = 4
"""Consecutive rows of numbers that mark the beginning of the data."""
_ROLES: Final = {
    "time": ("t", "time", "timestamp", "stamp", "sec", "secs", "seconds", "clock"),
    "dq": ("dq", "qd", "vel", "velocity", "velocities", "qdot", "speed", "omega", "rate"),
    "tau_J": ("tau", "torque", "torques", "effort", "efforts", "trq", "moment", "load"),
    "current": ("current", "currents", "curr", "cur", "i", "amp", "amps"),
    "q": ("q", "pos", "position", "positions", "angle", "angles", "theta"),
    "contact": ("contact", "touched", "touch", "collision"),
}
_OTHERS: Final = ("ddq", "qdd", "acc", "acceleration", "temp", "temperature", "voltage", "error", "err")
"""Words of columns with another role, whatever else their heads contain."""
_NOT_MEASURED: Final = ("des", "desired", "cmd", "command", "commanded", "con", "ref", "target", "goal", "set", "fric",
                        "friction", "filt", "filtered", "ff", "ext", "external", "model")  # fmt: skip
_UNIT_ROLES: Final = {
    **dict.fromkeys(("rad", "deg", "rev"), "q"),
    **dict.fromkeys(("rad/s", "deg/s", "rpm"), "dq"),
    **dict.fromkeys(("Nm", "mNm"), "tau_J"),
    **dict.fromkeys(("A", "mA"), "current"),
    **dict.fromkeys(("s", "ms", "us", "ns"), "time"),
}
_ALIKE: Final = 0.9


@dataclass
class TableGuess:
    """A guess of a CSV file's form, and of the role of its columns.

    heads: of all columns, "1", "2", … if the file has none. units_below: units in a row below the heads, "" where there
    is none. is_iso: the first column has dates and times: its first cell is no number. columns, units, reasons: by
    role, "time", "q", "dq", "tau_J" or "contact": the heads of its columns, their unit if the file gives one ("A" for
    currents without one), and why an uncertain choice was made.
    """

    form: CsvSection
    heads: tuple[str, ...]
    units_below: tuple[str, ...]
    values: Vector  # (k, columns) of the rows that were read; dates in s since 1970; nan for cells without a number
    is_iso: bool = False
    columns: dict[str, tuple[str, ...]] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)

    def of(self, role: str) -> Vector:
        """Return the values of a role's columns (k, c). Raises KeyError if the guess has no columns of this role."""
        return self.values[:, [self.heads.index(name) for name in self.columns[role]]]


class _Head(NamedTuple):
    """A column's head, split up. place: of the column, from 0. words: lower case, no numbers. unit: "" without one.

    order: the joint's number or index; nan without one.
    """

    place: int
    words: tuple[str, ...]
    order: float  # number or index of the joint; nan without one
    unit: str


def guess_table(path: Path, joint_names: Sequence[str]) -> TableGuess:
    """Guess the form of a CSV file and the role of its columns, by their heads, or by their values if it has no heads.

    Only the first `_SEEN_ROWS` + `_HEAD_ROWS` lines are read. joint_names: of the arm, from the base; they also tell
    the number of joints. A role without fitting columns is missing in the guess. Raises LogError if the file can't be
    read, or its first `_HEAD_ROWS` hold no rows of numbers.
    """
    with opened_text(path) as file:
        lines = list(islice(file, _SEEN_ROWS + _HEAD_ROWS))
    form, heads, units, first = _form(path, lines)
    rows = islice(split_rows(path, lines, form.delimiter), first, None)
    values, is_iso = _values(rows, len(heads), form.decimal)
    guess = TableGuess(form, heads, units, values, is_iso)
    if form.has_header:
        _by_heads(guess, joint_names)
    else:
        _by_values(guess, len(joint_names))
    return guess


def _is_full(cells: list[str], decimal: str) -> bool:
    """Return whether each cell of a row is a number; the first may be a date and time instead."""
    return all(is_number(cell, decimal) for cell in cells[1:]) and (
        is_number(cells[0], decimal) or is_iso_time(cells[0])
    )


_Form = tuple[CsvSection, tuple[str, ...], tuple[str, ...], int]
"""Form, heads, units below them, and the row where the data begin: a quoted head may have several lines."""


def _form(path: Path, lines: list[str]) -> _Form:
    """Return form, heads, units below them and first data row, from 0, by the first lines of a CSV file.

    The delimiter and decimal sign are those that give the data the most columns; of equal ones the first in the order
    of `DELIMITERS`, "." before ",". Data begin with `_FULL_ROWS` rows of equally many numbers, three or more; the first
    of a row may be a date and time. Raises LogError without such rows in the first `_HEAD_ROWS`. Without a line of
    heads these are "1", "2", ….
    """
    best: _Form | None = None
    for delimiter in DELIMITERS:
        for decimal in (".", ",") if delimiter != "," else (".",):
            table = list(split_rows(path, lines[:_HEAD_ROWS], delimiter))
            rows = [trimmed(cells) for _, cells in table]
            first = next((k for k in range(len(rows)) if _begins(rows[k : k + _FULL_ROWS], decimal)), None)
            if first is not None and (best is None or len(rows[first]) > len(best[1])):
                best = _form_at(rows, [0, *(number for number, _ in table)], first, delimiter, decimal)
    if best is None:
        raise LogError(f"recording {path}: no rows of numbers in its first {_HEAD_ROWS} lines")
    return best


def _begins(rows: list[list[str]], decimal: str) -> bool:
    """Return whether these are `_FULL_ROWS` rows of equally many cells, at least three each, all as of `_is_full`."""
    count = len(rows[0]) if rows else 0
    return len(rows) == _FULL_ROWS and count >= 3 and all(len(row) == count and _is_full(row, decimal) for row in rows)


def _form_at(rows: list[list[str]], skipped: list[int], first: int, delimiter: str, decimal: str) -> _Form:
    """Return the form of a file whose data begin at row `first`, from 0. skipped: number of lines above each row.

    The head is the closest row above with as many cells, the first of them not empty; a row of units may lie between.
    Without such a row, the heads are "1", "2", ….
    """
    count = len(rows[first])
    above = [k for k in range(first) if len(rows[k]) == count and head_of(rows[k])[0]]
    units: tuple[str, ...] = ("",) * count
    if len(above) > 1 and any(map(unit_of, rows[above[-1]])):
        units = tuple(map(unit_of, rows[above.pop()]))
    head = above[-1] if above else first
    heads = head_of(rows[head]) if above else [str(k + 1) for k in range(count)]
    return CsvSection(delimiter, decimal, bool(above), skipped[head]), tuple(heads), units, first


def _values(rows: Iterable[tuple[int, list[str]]], count: int, decimal: str) -> tuple[Vector, bool]:
    """Return the cells as numbers (k, count), dates in s, nan for other cells, and whether the first column has dates.

    It has if the first cell of the first row with all cells is no number. Rows with fewer than `count` cells are left
    out; further cells of a row, and rows after `_SEEN_ROWS`, too.
    """
    table: list[list[float]] = []
    is_iso = False
    for _, cells in islice(rows, _SEEN_ROWS):
        if len(cells) >= count:
            is_iso |= not table and not is_number(cells[0], decimal)
            table.append([_number(cell.strip(), decimal) for cell in cells[:count]])
    return np.array(table).reshape(-1, count), is_iso


def _number(cell: str, decimal: str) -> float:
    if is_number(cell, decimal):
        return read_number(cell, decimal)
    return float(iso_seconds(cell)) if is_iso_time(cell) else math.nan


# By heads.


def _by_heads(guess: TableGuess, joint_names: Sequence[str]) -> None:
    """Set columns, units and reasons of a guess by the heads; a role without fitting columns stays unset.

    Positions, velocities and torques need one numbered or named column per joint. If several groups fit a role, the
    smallest number of words for values that aren't measured decides, then the number of words, then the order. Currents
    are the torques if there are no torques.
    """
    groups: dict[tuple[tuple[str, ...], str], list[_Head]] = {}
    for place, (text, unit) in enumerate(zip(guess.heads, guess.units_below, strict=True)):
        head = _taken_apart(place, text, joint_names)
        head = head._replace(unit=unit or head.unit)
        groups.setdefault((head.words, head.unit), []).append(head)
    n = len(joint_names)
    chosen: dict[str, tuple[tuple[int, int, int], list[_Head]]] = {}
    others: dict[str, list[str]] = {}
    for (words, unit), group in groups.items():
        role = _role(words, unit)
        if role in ("time", "contact"):
            members = group[:1]
        else:
            members = sorted((head for head in group if not math.isnan(head.order)), key=lambda head: head.order)
            if len(members) != n:
                continue
        rank = (sum(word in _NOT_MEASURED for word in words), len(words), members[0].place)
        if role:
            others.setdefault(role, []).append(guess.heads[members[0].place])
        if role and (role not in chosen or rank < chosen[role][0]):
            chosen[role] = (rank, members)
    if "tau_J" not in chosen and "current" in chosen:
        chosen["tau_J"] = chosen["current"]
        guess.reasons["tau_J"] = "currents: `scale.tau_J` needs the gain of each joint, Nm/A"
        guess.units["tau_J"] = chosen["current"][1][0].unit or "A"
    for role, (_, members) in chosen.items():
        if role != "current":
            guess.columns[role] = tuple(guess.heads[head.place] for head in members)
            if len(others.get(role, ())) > 1:
                guess.reasons.setdefault(role, f"one of {', '.join(others[role])}")
            if members[0].unit:
                guess.units.setdefault(role, members[0].unit)


def _taken_apart(place: int, text: str, joint_names: Sequence[str]) -> _Head:
    """Split a head into lower-case words, unit and order of the joint.

    place: of the column, from 0. The order is the index in `joint_names` of a joint that the head names, else the
    head's last number, else nan.
    """
    unit, order = "", math.nan
    if match := re.search(r"[\[(]([^\])]*[^\])\d][^\])]*)[\])]", text):
        unit = unit_of(match[1])
        text = text.replace(match[0], " ") if unit else text
    for joint, name in sorted(enumerate(joint_names), key=lambda pair: -len(pair[1])):
        if re.search(rf"(?<![A-Za-z0-9]){re.escape(name)}(?![A-Za-z0-9])", text, re.IGNORECASE):
            order = float(joint)
            text = re.sub(re.escape(name), " ", text, count=1, flags=re.IGNORECASE)
            break
    if not unit and (parts := text.rsplit("_", 1)) and len(parts) == 2 and len(parts[1]) > 1 and unit_of(parts[1]):
        text, unit = parts[0], unit_of(parts[1])
    words = re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", text)
    numbers = [float(word) for word in words if word.isdigit()]
    if math.isnan(order) and numbers:
        order = numbers[-1]
    return _Head(place, tuple(word.casefold() for word in words if not word.isdigit()), order, unit)


def _role(words: tuple[str, ...], unit: str) -> str:
    """Return "time", "q", "dq", "tau_J", "current" or "contact", by a head's words, else by its unit.

    A word of time doesn't count beside a unit of another role: T is a torque, too. "" if neither tells the role, or a
    word is of another quantity, such as an acceleration.
    """
    if any(word in _OTHERS for word in words):
        return ""
    by_unit = _UNIT_ROLES.get(unit, "")
    found = [role for role, known in _ROLES.items() if any(word in known for word in words)]
    if by_unit not in ("", "time") and "time" in found:
        found.remove("time")
    return found[0] if found else by_unit


# By values.


def _by_values(guess: TableGuess, n: int) -> None:
    """Set columns and reasons of a guess by the values of the columns; n: number of joints.

    The first column is the time if it grows. If n adjacent columns are the slopes of n earlier ones, the earlier ones
    are the positions, the later ones the velocities, and the n after them, if there are so many, the torques. Otherwise
    the first n columns after the time are the positions, the next n the torques; with too few columns neither is set.
    """
    values = guess.values
    first = int(np.all(np.diff(values[:, 0]) > 0.0))
    if first:
        guess.columns["time"], guess.reasons["time"] = (guess.heads[0],), "it grows from row to row"
    blocks = [tuple(range(begin, begin + n)) for begin in range(first, values.shape[1] - n + 1)]
    time = values[:, 0] if first else np.arange(len(values), dtype=np.float64)
    for q in blocks:
        for dq in (block for block in blocks if block[0] >= q[-1] + 1):
            if _is_slope(time, values[:, q], values[:, dq]):
                _take(guess, "q", q, "others are their slope")
                _take(guess, "dq", dq, "they are the slope of the positions")
                torques = [block for block in blocks if block[0] >= dq[-1] + 1]
                if torques:
                    _take(guess, "tau_J", torques[0], "they come next")
                return
    if len(blocks) > n:
        _take(guess, "q", blocks[0], "they come first")
        _take(guess, "tau_J", blocks[n], "they come next")


def _take(guess: TableGuess, role: str, block: tuple[int, ...], reason: str) -> None:
    guess.columns[role] = tuple(guess.heads[place] for place in block)
    guess.reasons[role] = reason


def _is_slope(time: Vector, q: Vector, dq: Vector) -> bool:
    """Return whether dq (k, n) is, in any unit and with any sign, the slope of q (k, n) over time (k,).

    For each moving joint the two must correlate by more than `_ALIKE`. False if no joint moves, or a moving one's dq is
    constant.
    """
    slope = np.gradient(q, axis=0) / np.gradient(time)[:, None]
    moving = np.ptp(q, axis=0) > 0.0
    if not moving.any() or np.any(np.ptp(dq[:, moving], axis=0) == 0.0):
        return False
    pairs = zip(slope[:, moving].T, dq[:, moving].T, strict=True)
    return all(abs(float(np.corrcoef(_smooth(one), _smooth(other))[0, 1])) > _ALIKE for one, other in pairs)


def _smooth(column: Vector) -> Vector:
    return np.convolve(column, np.full(5, 0.2), "valid")
