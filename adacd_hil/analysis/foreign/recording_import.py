"""A recording of an arm that others made: a CSV file and its map become samples at a fixed period, in SI units.

A gap in time, a value that is missing or not finite, and where a touch begins or ends, part a recording in stretches;
the model is carried over, the filters begin anew. Values between two samples are interpolated.

A recording is held in memory, at most `MOST_ROWS` rows of it: of a longer file only the span that is asked for.
"""

import csv
import io
import math
import re
import warnings
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Final, TextIO

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from adacd_hil.analysis.foreign.recording_map import RecordingMap
from adacd_hil.file_access import open_input
from adacd_hil.log.log_files import LogError, TimeWindow
from adacd_hil.records import Vector
from adacd_hil.remedies import nearest_name
from adacd_hil.scheme.identify.offline import Record
from adacd_hil.settings.schema import ConfigError

MOST_ROWS: Final = 4_000_000
"""Rows of a file that are kept, and samples that they become: an hour at 1 kHz, with a little to spare."""
_BLOCK_ROWS = 100_000
_SPARE_S = 1.0
"""Kept before and after the span that is asked for: what a derived velocity and the grid of samples reach over."""
LARGEST = 1e6
"""rad, rad/s or Nm: what is larger is no measurement, and its square would spoil all others."""
SHORTEST_SAMPLES = 50
"""A shorter stretch teaches nothing: the filters have not settled."""
_LEAST_NOISE_NM = 1e-4
_DEGREE = 3  # of the polynomial whose slope is a derived velocity
_MEDIAN_TO_SIGMA = 1.4826 / np.sqrt(6.0)  # of the second difference of white noise


@dataclass(frozen=True)
class RecordingStretch:
    """Samples without a gap: when the first was, and, if known, whether somebody touched the arm at each (k,)."""

    start_s: float
    record: Record
    is_touched: NDArray[np.bool_] | None


@dataclass(frozen=True)
class ForeignRecording:
    """A recording, time-first. `noise_Nm` (n,), `velocity_noise_rad_s`: rms of what looks like white noise in it.

    `blur_s`: how far a derived velocity looks ahead and back.
    """

    path: Path
    period_s: float
    stretches: tuple[RecordingStretch, ...]
    noise_Nm: tuple[float, ...]
    velocity_noise_rad_s: float
    blur_s: float

    @property
    def duration_s(self) -> float:
        """Sum of the stretches."""
        return sum(len(stretch.record.q) for stretch in self.stretches) * self.period_s

    def between(self, start_s: float, end_s: float) -> "ForeignRecording":
        """Return what lies in a span of the recording's time, which begins with 0."""
        parts = [_cut(stretch, self.period_s, start_s, end_s) for stretch in self.stretches]
        kept = tuple(part for part in parts if len(part.record.q) >= SHORTEST_SAMPLES)
        return replace(self, stretches=kept)

    @property
    def free(self) -> "ForeignRecording":
        """What nobody touched, as far as that is known."""
        return replace(self, stretches=tuple(part for stretch in self.stretches for part in self._untouched(stretch)))

    def _untouched(self, stretch: RecordingStretch) -> list[RecordingStretch]:
        """Split a stretch at its touches, with what is blurred around them."""
        if stretch.is_touched is None:
            return [stretch]
        width = 2 * round(self.blur_s / self.period_s) + 1
        is_touched = np.convolve(stretch.is_touched, np.ones(width), "same") > 0.5
        bounds = [0, *(np.flatnonzero(np.diff(is_touched)) + 1).tolist(), len(is_touched)]
        parts = [
            _part(stretch, self.period_s, first, last) for first, last in pairwise(bounds) if not is_touched[first]
        ]
        return [part for part in parts if len(part.record.q) >= SHORTEST_SAMPLES]


def read_recording(
    path: Path, described: RecordingMap, period_s: float = 0.0, span: TimeWindow | None = None
) -> ForeignRecording:
    """Read a CSV file. period_s: of the samples, where neither the map nor the recording is to say.

    span: what has to be read of a file with more than `MOST_ROWS` rows; any other is read whole. Raises LogError when
    it can't be read or is too long, ConfigError when it lacks a column of the map.
    """
    time_s, begin_s, values, touched = _read_columns(path, described, span)
    return recording_of(path, described, time_s - begin_s, values, touched, period_s)


def recording_of(
    path: Path,
    described: RecordingMap,
    time_s: Vector,
    values: Vector,
    touched: NDArray[np.bool_] | None,
    period_s: float = 0.0,
) -> ForeignRecording:
    """Make a recording of columns: time (k,), values (k, 2 n or 3 n), touches (k,); path: its name, for errors.

    values: positions, torques and velocities side by side, in SI units; what is missing is not finite. Raises LogError.
    """
    period_s = described.sampling.period_s or period_s or float(np.median(np.diff(time_s)))
    is_whole = np.isfinite(values).all(axis=1)
    time_s, values = time_s[is_whole], values[is_whole]
    touched = None if touched is None else touched[is_whole]
    n = described.joints
    longest_s = max(described.sampling.longest_gap_s, 1.5 * period_s)
    window = max(_DEGREE + 2, round(described.sampling.smoothing_s / period_s)) | 1
    shortest = max(SHORTEST_SAMPLES, window)
    edges = np.flatnonzero(np.diff(time_s) > longest_s) + 1
    stretches = []
    room = MOST_ROWS
    for rows in np.split(np.arange(len(time_s)), edges) if len(time_s) else ():
        count = int((time_s[rows[-1]] - time_s[rows[0]]) / period_s + 1e-6) + 1
        if count < shortest:
            continue
        room -= count
        if room < 0:
            raise LogError(f"{path}: more than {MOST_ROWS} samples of {period_s:g} s")
        grid_s = time_s[rows[0]] + period_s * np.arange(count)
        columns = [np.interp(grid_s, time_s[rows], values[rows, column]) for column in range(values.shape[1])]
        q, tau_J = np.column_stack(columns[:n]), np.column_stack(columns[n : 2 * n])
        dq = np.column_stack(columns[2 * n :]) if described.columns.dq else _derive(q, period_s, window)
        is_touched = None
        if touched is not None:
            is_touched = touched[rows][np.searchsorted(time_s[rows], grid_s, side="right") - 1]
        stretches.append(RecordingStretch(float(grid_s[0]), Record(q, dq, tau_J), is_touched))
    if not stretches:
        raise LogError(f"{path}: no {shortest} samples of {period_s:g} s without a gap")
    noise_Nm = _noise([stretch.record.tau_J for stretch in stretches])
    velocity = _noise([stretch.record.dq for stretch in stretches]) if described.columns.dq else np.zeros(n)
    return ForeignRecording(
        path=path,
        period_s=period_s,
        stretches=tuple(stretches),
        noise_Nm=tuple(np.maximum(noise_Nm, _LEAST_NOISE_NM).tolist()),
        velocity_noise_rad_s=min(float(velocity.max()), 1.0),
        blur_s=0.0 if described.columns.dq else 0.5 * window * period_s,
    )


def _read_columns(
    path: Path, described: RecordingMap, span: TimeWindow | None
) -> tuple[Vector, float, Vector, NDArray[np.bool_] | None]:
    """Return time (k,) s and that of the file's first row, values (k, 2 n or 3 n) in SI units, touches (k,).

    Values: positions, torques and velocities side by side; what is missing is not finite.
    """
    columns, form = described.columns, described.csv
    try:
        with _open(path, "") as file:
            for _ in range(form.skip_rows):
                next(file, "")
            first = next(csv.reader(file, delimiter=form.delimiter), [])
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise LogError(f"recording {path}: {getattr(error, 'strerror', None) or error}") from None
    heads = [head.strip() for head in first] if form.has_header else []
    wanted = (columns.time, *columns.q, *columns.tau_J, *columns.dq, *filter(None, (columns.contact,)))
    places = [_place(name, heads, len(first), path) for name in wanted]
    table, start = _read_table(path, described, places, span)
    if len(table) < SHORTEST_SAMPLES:
        where = "" if span is None or span.is_whole else f" {span.text}"
        raise LogError(f"recording {path} has {len(table)} rows{where}, {SHORTEST_SAMPLES} are the least")
    units = np.array((*described.q_rad, *described.tau_J_Nm, *(described.dq_rad_s if columns.dq else ())))
    time_s, begin_s = table[:, 0] * described.time_s, start * described.time_s
    with np.errstate(over="ignore"):
        values = table[:, 1 : 1 + len(units)] * units
    too_large = np.argwhere(np.isfinite(table[:, 1 : 1 + len(units)]) & ~(np.abs(values) <= LARGEST))
    if len(too_large):
        row, column = too_large[0].tolist()
        raise LogError(
            f"recording {path}: column {wanted[1 + column]!r} is {table[row, 1 + column]:g} at "
            f"{time_s[row] - begin_s:.9g} s, more than {LARGEST:g} rad, rad/s or Nm"
        )
    return time_s, begin_s, values, table[:, -1] != 0.0 if columns.contact else None


def _read_table(
    path: Path, described: RecordingMap, places: list[int], span: TimeWindow | None
) -> tuple[Vector, float]:
    """Return the columns at such places of all rows, or of those of a span; and the time in the first row."""
    form = described.csv
    head = form.skip_rows + form.has_header
    kept: list[Vector] = []
    rows = 0
    start = last = math.nan
    bounds = (-math.inf, math.inf) if span is None else (span.start_s - _SPARE_S, span.end_s + _SPARE_S)
    try:
        with warnings.catch_warnings(), _open(path) as file:
            warnings.simplefilter("ignore", UserWarning)  # at the end of the file
            while True:
                block = np.loadtxt(
                    file,
                    delimiter=None if form.delimiter == " " else form.delimiter,
                    skiprows=0 if rows else head,
                    usecols=places,
                    ndmin=2,
                    converters=_number,
                    max_rows=_BLOCK_ROWS,
                )
                if not len(block):
                    break
                start = float(block[0, 0]) if not rows else start
                time_s = np.concatenate(([last] if rows else [], block[:, 0])) * described.time_s
                _check_time(path, time_s, head + rows - bool(rows))
                rows, last = rows + len(block), float(block[-1, 0])
                kept.append(block)
                if rows <= MOST_ROWS:
                    continue
                kept = [_within(part, start, described.time_s, bounds) for part in kept]
                if sum(map(len, kept)) > MOST_ROWS:
                    remedy = "cut it" if span is None else "choose a part with --from and --until"
                    raise LogError(f"recording {path} has more than {MOST_ROWS} rows: {remedy}")
                if (last - start) * described.time_s > bounds[1]:
                    break
    except (OSError, ValueError) as error:
        line = re.sub(r"(?<=at row )\d+", lambda found: str(int(found[0]) + rows), str(error).splitlines()[0])
        raise LogError(f"recording {path}: {line}") from None
    return np.concatenate(kept) if kept else np.empty((0, len(places))), start


def _within(table: Vector, start: float, unit_s: float, bounds_s: tuple[float, float]) -> Vector:
    time_s = (table[:, 0] - start) * unit_s
    return table[(time_s >= bounds_s[0]) & (time_s <= bounds_s[1])]


def _check_time(path: Path, time_s: Vector, row: int) -> None:
    """Raise LogError unless the time increases. row: the one in the file before the first."""
    backward = np.flatnonzero(~(np.diff(time_s) > 0.0))
    if len(backward):
        place = int(backward[0])
        raise LogError(f"recording {path}: time does not increase after row {row + 1 + place}: {time_s[place]:.9g} s")


def _open(path: Path, newline: str | None = None) -> TextIO:
    return io.TextIOWrapper(open_input(path), encoding="utf-8-sig", newline=newline)


def _number(text: str) -> float:
    """Read a number; a missing one is nan."""
    return float(text) if text.strip() else float("nan")


def _place(name: str, heads: list[str], count: int, path: Path) -> int:
    """Find a column by its head or its number from 1. Raises ConfigError."""
    if name in heads:
        return heads.index(name)
    if name.isdecimal() and 1 <= int(name) <= count:
        return int(name) - 1
    nearest = nearest_name(name, heads)
    known = f"did you mean {nearest!r}?" if nearest else f"there are {', '.join(heads) or f'1 to {count}'}"
    raise ConfigError(f"recording {path} has no column {name!r}; {known}")


def _derive(q: Vector, period_s: float, window: int) -> Vector:
    """Derive velocities (k, n) from positions, without delay: the slope of a cubic over a window of samples."""
    return np.asarray(savgol_filter(q, window, _DEGREE, deriv=1, delta=period_s, axis=0), np.float64)


def _noise(parts: list[Vector]) -> Vector:
    """Estimate the rms of white noise (n,) by the median of the second difference, which motion hardly shows in."""
    seconds = np.concatenate([np.abs(np.diff(part, 2, axis=0)) for part in parts])
    return np.asarray(_MEDIAN_TO_SIGMA * np.median(seconds, axis=0))


def _cut(stretch: RecordingStretch, period_s: float, start_s: float, end_s: float) -> RecordingStretch:
    time_s = stretch.start_s + period_s * np.arange(len(stretch.record.q))
    first, last = np.searchsorted(time_s, (start_s, end_s))
    return _part(stretch, period_s, int(first), int(last))


def _part(stretch: RecordingStretch, period_s: float, first: int, last: int) -> RecordingStretch:
    record, touched = stretch.record, stretch.is_touched
    kept = Record(record.q[first:last], record.dq[first:last], record.tau_J[first:last])
    return RecordingStretch(stretch.start_s + first * period_s, kept, None if touched is None else touched[first:last])
