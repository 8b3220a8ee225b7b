"""Rows of a recording, of any file format, turned into columns: sorted by time, in SI units, bad rows dropped.

Loggers repeat rows, cut the last one, write a word instead of a number. Such rows are dropped and counted; the
recording is refused only if they are many, and the error shows the first of them.

A recording is held in memory, at most `MOST_ROWS` rows of it: of a longer file only the requested span.
"""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adacd_hil.lab.offline.recording_map import RecordingMap
from adacd_hil.log.log_files import LogError
from adacd_hil.log.time_window import TimeWindow
from adacd_hil.printable import number_of
from adacd_hil.records import Vector

MOST_ROWS: Final = 4_000_000
"""Most rows of a file that are kept, and most samples made of them: an hour at 1 kHz, with a little to spare."""
SHORTEST_SAMPLES: Final = 50
"""A shorter stretch can't be used: the filters have not settled."""
LARGEST: Final = 1e6
"""Limit in rad, rad/s or Nm: a larger value isn't a measurement, and its square would spoil all others."""
BLOCK_ROWS: Final = 50_000
_SPARE_S = 1.0
"""Time kept before and after the requested span, for derived velocities and the grid of samples."""
_FEW_ROWS, _FEW_SHARE = 3, 0.01
"""Rows, or share of all rows, that may be unusable; with more, the file doesn't match the map."""

_OTHER_TIMES: Final = 3.0
"""Ratio of the mean difference of rows with one time to that of successive rows: two samples of one source have 1."""
_DOUBLED = "with the time of the row before"


@dataclass(frozen=True)
class RecordedColumns:
    """The columns of a recording in SI units. time_s (k,): increasing.

    begin_s: time of the file's first row, on the same scale. values (k, 2 n or 3 n): positions, torques and, if
    present, velocities side by side; missing ones are not finite. touched (k,): whether the arm is touched; None if
    unknown. notes: dropped rows and assumptions, a few words each.
    """

    time_s: Vector
    begin_s: float
    values: Vector
    touched: NDArray[np.bool_] | None
    notes: tuple[str, ...]


class RecordedRows:
    """Collects a recording's rows one by one, drops those out of order in time, and makes columns of the others."""

    def __init__(self, path: Path, width: int, time_unit_s: float, span: TimeWindow | None) -> None:
        """Start without rows.

        width: numbers of a row, its time included. time_unit_s: one unit of these times, s. span: the part to keep of a
        file with more than `MOST_ROWS` rows, in time since the first row; None: all. A shorter file is kept whole.
        """
        self.notes: list[str] = []
        self.count = 0
        """Rows so far."""
        self._path, self._width, self._unit_s, self._span = path, width + 1, time_unit_s, span
        self._block: list[float] = []
        self._kept: list[Vector] = []
        self._drops: Counter[str] = Counter()
        self._first_drops: dict[str, str] = {}
        self._doubled: list[Vector] = []  # differences of rows that have the time of the row before, from that row
        self._begin_s = self._latest_s = -np.inf
        self._is_long = False  # only the span is kept

    def append(self, number: int, row: list[float]) -> None:
        """Add a row, the time first. number: the row's in the file, from 1, for errors.

        Rows are examined in blocks. Raises LogError if more than `MOST_ROWS` must be kept.
        """
        self._block.append(number)
        self._block += row
        self.count += 1
        if self.count % BLOCK_ROWS == 0:
            self._flush()

    def drop(self, kind: str, first: str, count: int = 1) -> None:
        """Count `count` rows that are left out, without adding them.

        kind: text after the word "row", such as "cut short". first: description of the first of them; it is kept of the
        first call with this kind only.
        """
        if count:
            self._drops[kind] += count
            self._first_drops.setdefault(kind, first)

    @property
    def is_past_span(self) -> bool:
        """Whether the requested span and `_SPARE_S` more have been read, so that no further row is needed.

        It changes only with each `BLOCK_ROWS` rows. Always False without a span, and for a file with at most
        `MOST_ROWS` rows so far.
        """
        return self._is_long and self._span is not None and self._latest_s - self._begin_s > self._span.end_s + _SPARE_S

    def columns(self, described: RecordingMap, names: list[str], has_touches: bool = False) -> RecordedColumns:
        """Return all kept rows as columns in SI units; call it after the last row.

        names: of the value columns, for errors; more than 2 n include velocities. has_touches: the last number of a row
        is other than 0 while the arm is touched; NaN counts as touched. Raises LogError for fewer than
        `SHORTEST_SAMPLES` rows, too many dropped ones, rows of two sources, or a size above `LARGEST`.
        """
        self._flush()
        table = np.concatenate(self._kept) if self._kept else np.empty((0, self._width))
        self._check_drops(len(table))
        if len(table) < SHORTEST_SAMPLES:
            where = "" if self._span is None or self._span.is_whole else f" {self._span.text}"
            dropped = "".join(f"; {note}" for note in self._dropped())
            raise LogError(
                f"recording {self._path} has {number_of(len(table), 'row')}{where}, {SHORTEST_SAMPLES} are the least"
                f"{dropped}"
            )
        has_dq = len(names) > 2 * described.joints
        self._check_sources(table[:, 2 : 2 + len(names)], names)
        units = np.concatenate([described.factors(key) for key in ("q", "tau_J", "dq")[: 3 if has_dq else 2]])
        time_s, given = table[:, 1] * self._unit_s, table[:, 2 : 2 + len(units)]
        with np.errstate(over="ignore"):
            values = given * units
        self._check_values(given, values, time_s - self._begin_s, names)
        touched = table[:, -1] != 0.0 if has_touches else None
        notes = (*self.notes, *self._dropped())
        return RecordedColumns(time_s, self._begin_s, values, touched, notes)

    def _flush(self) -> None:
        """Drop rows of the latest block without a time, or whose time isn't later than all before; keep the others.

        Of a long file only rows in the requested span are kept. Raises LogError if more than `MOST_ROWS` are kept.
        """
        if not self._block:
            return
        table = np.array(self._block).reshape(-1, self._width)
        self._block = []
        time_s = np.where(np.isfinite(table[:, 1]), table[:, 1] * self._unit_s, np.nan)
        if np.isneginf(self._begin_s) and np.any(np.isfinite(time_s)):
            self._begin_s = float(time_s[np.isfinite(time_s)][0])
        before_s = np.fmax.accumulate(np.concatenate(([self._latest_s], time_s)))
        self._count_wrong_rows(table, time_s == before_s[:-1], _DOUBLED, "{time} once more")
        self._doubled.append(_differences(table[:, 2:])[np.diff(time_s) == 0.0])
        self._count_wrong_rows(table, time_s < before_s[:-1], "out of order", "time goes back to {time}")
        self._count_wrong_rows(table, np.isnan(time_s), "without a time", "it has no time")
        self._latest_s = float(before_s[-1])
        self._kept.append(table[time_s > before_s[:-1]])
        self._is_long |= self.count > MOST_ROWS
        if self._is_long:
            self._kept = [self._within(part) for part in self._kept]
        if sum(map(len, self._kept)) > MOST_ROWS:
            remedy = "cut it" if self._span is None else "choose a part with --from and --until"
            raise LogError(f"recording {self._path} has more than {MOST_ROWS} rows: {remedy}")

    def _count_wrong_rows(self, table: Vector, is_wrong: NDArray[np.bool_], kind: str, words: str) -> None:
        """Count the wrong rows of a table by `drop`, without removing them.

        table: number and time of each row first. words: of the first one, with {time} in it.
        """
        for number, time in table[is_wrong, :2][:1].tolist():
            first = words.format(time=f"{time * self._unit_s:.9g} s")
            self.drop(kind, f"row {number:.0f}: {first}", int(np.count_nonzero(is_wrong)))

    def _within(self, table: Vector) -> Vector:
        """Return the rows of a table in the requested span, widened by `_SPARE_S` at both ends; all without a span."""
        if self._span is None:
            return table
        time_s = table[:, 1] * self._unit_s - self._begin_s
        return table[(time_s >= self._span.start_s - _SPARE_S) & (time_s <= self._span.end_s + _SPARE_S)]

    def _dropped(self) -> list[str]:
        return [
            f"{number_of(count, 'row')} {kind} left out ({self._first_drops[kind]})"
            for kind, count in self._drops.items()
        ]

    def _check_drops(self, kept: int) -> None:
        """Raise LogError if more rows were dropped than both `_FEW_ROWS` and a share `_FEW_SHARE` of all rows.

        kept: number of kept rows. Rows with the time of the row before are not included.
        """
        count = self._drops.total() - self._drops[_DOUBLED]
        if count > max(_FEW_ROWS, _FEW_SHARE * (kept + count)):
            kind, most = max((pair for pair in self._drops.items() if pair[0] != _DOUBLED), key=lambda pair: pair[1])
            first = self._first_drops[kind]
            raise LogError(f"recording {self._path}, {first}; {number_of(most, 'row')} {kind} are too many")

    def _check_sources(self, values: Vector, names: list[str]) -> None:
        """Raise LogError if many rows have the time of the row before but other values, as of two sources in one table.

        values: as recorded (k, c). Many are more than both `_FEW_ROWS` and a share `_FEW_SHARE` of all rows. A column
        has other values if these rows' mean difference is over `_OTHER_TIMES` that from one time to the next.
        """
        apart = np.concatenate(self._doubled)[:, : len(names)]
        is_other = np.any(apart > 0.0, axis=1)
        count = int(np.count_nonzero(is_other))
        if count <= max(_FEW_ROWS, _FEW_SHARE * len(values)):
            return
        usual, other = (np.nansum(each, axis=0) / len(each) for each in (_differences(values), apart))
        for column in np.flatnonzero(other > _OTHER_TIMES * usual)[:1].tolist():
            raise LogError(
                f"recording {self._path}, {self._first_drops[_DOUBLED]}; {number_of(count, 'row')} with the time of "
                f"the row before have other values, column {names[column]!r} by {other[column]:.3g}, against "
                f"{usual[column]:.3g} from one time to the next: two sources in one table; record one of them"
            )

    def _check_values(self, given: Vector, values: Vector, time_s: Vector, names: list[str]) -> None:
        """Raise LogError if the size of a finite recorded value is above `LARGEST` in SI units.

        given: values as recorded, values: in SI units, (k, c). time_s (k,): since the first row, for errors.
        """
        too_large = np.argwhere(np.isfinite(given) & ~(np.abs(values) <= LARGEST))
        if len(too_large):
            row, column = too_large[0].tolist()
            raise LogError(
                f"recording {self._path}: column {names[column]!r} is {given[row, column]:g} at {time_s[row]:.9g} s, "
                f"more than {LARGEST:g} rad, rad/s or Nm"
            )


def _differences(rows: Vector) -> Vector:
    """Return the absolute differences of each row from the row before (k - 1, c); NaN where a value is not finite."""
    return np.abs(np.diff(np.where(np.isfinite(rows), rows, np.nan), axis=0))
