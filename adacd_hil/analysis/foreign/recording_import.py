"""A recording of an arm that others made: a CSV file and its map become samples at a fixed period, in SI units.

A gap in time, a value that is missing or not finite, and where a touch begins or ends, part a recording in stretches;
the model is carried over, the filters begin anew. Values between two samples are interpolated.
"""

import csv
import io
import warnings
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from adacd_hil.analysis.foreign.recording_map import RecordingMap
from adacd_hil.config import ConfigError
from adacd_hil.input_files import open_input
from adacd_hil.log.errors import LogError
from adacd_hil.nearest_name import nearest_name
from adacd_hil.records import Vector
from adacd_hil.scheme.offline import Record

_SHORTEST_SAMPLES = 50
"""A shorter stretch teaches nothing: the filters have not settled."""
_LEAST_NOISE_NM = 1e-4
_DEGREE = 3  # of the polynomial whose slope is a derived velocity
_MEDIAN_TO_SIGMA = 1.4826 / np.sqrt(6.0)  # of the second difference of white noise


@dataclass(frozen=True)
class Stretch:
    """Samples without a gap: when the first was, and, if known, whether somebody touched the arm at each (k,)."""

    start_s: float
    record: Record
    is_touched: NDArray[np.bool_] | None


@dataclass(frozen=True)
class Recording:
    """A recording, time-first. `noise_Nm` (n,), `velocity_noise_rad_s`: rms of what looks like white noise in it.

    `blur_s`: how far a derived velocity looks ahead and back.
    """

    path: Path
    period_s: float
    stretches: tuple[Stretch, ...]
    noise_Nm: tuple[float, ...]
    velocity_noise_rad_s: float
    blur_s: float

    @property
    def duration_s(self) -> float:
        """Sum of the stretches."""
        return sum(len(stretch.record.q) for stretch in self.stretches) * self.period_s

    def between(self, start_s: float, end_s: float) -> "Recording":
        """Return what lies in a span of the recording's time, which begins with 0."""
        parts = [_cut(stretch, self.period_s, start_s, end_s) for stretch in self.stretches]
        kept = tuple(part for part in parts if len(part.record.q) >= _SHORTEST_SAMPLES)
        return replace(self, stretches=kept)

    @property
    def free(self) -> "Recording":
        """What nobody touched, as far as that is known."""
        return replace(self, stretches=tuple(part for stretch in self.stretches for part in self._untouched(stretch)))

    def _untouched(self, stretch: Stretch) -> list[Stretch]:
        """Split a stretch at its touches, with what is blurred around them."""
        if stretch.is_touched is None:
            return [stretch]
        width = 2 * round(self.blur_s / self.period_s) + 1
        is_touched = np.convolve(stretch.is_touched, np.ones(width), "same") > 0.5
        bounds = [0, *(np.flatnonzero(np.diff(is_touched)) + 1).tolist(), len(is_touched)]
        parts = [
            _part(stretch, self.period_s, first, last) for first, last in pairwise(bounds) if not is_touched[first]
        ]
        return [part for part in parts if len(part.record.q) >= _SHORTEST_SAMPLES]


def read_recording(path: Path, described: RecordingMap, period_s: float = 0.0) -> Recording:
    """Read a CSV file. period_s: of the samples, where neither the map nor the recording is to say.

    Raises LogError when it can't be read, ConfigError when it lacks a column of the map.
    """
    time_s, values, touched = _read_columns(path, described)
    period_s = described.sampling.period_s or period_s or float(np.median(np.diff(time_s)))
    is_whole = np.isfinite(values).all(axis=1)
    time_s, values = time_s[is_whole] - time_s[0], values[is_whole]
    touched = None if touched is None else touched[is_whole]
    n = described.joints
    longest_s = max(described.sampling.longest_gap_s, 1.5 * period_s)
    window = max(_DEGREE + 2, round(described.sampling.smoothing_s / period_s)) | 1
    shortest = max(_SHORTEST_SAMPLES, window)
    edges = np.flatnonzero(np.diff(time_s) > longest_s) + 1
    stretches = []
    for rows in np.split(np.arange(len(time_s)), edges):
        count = int((time_s[rows[-1]] - time_s[rows[0]]) / period_s + 1e-6) + 1
        if count < shortest:
            continue
        grid_s = time_s[rows[0]] + period_s * np.arange(count)
        columns = [np.interp(grid_s, time_s[rows], values[rows, column]) for column in range(values.shape[1])]
        q, tau_J = np.column_stack(columns[:n]), np.column_stack(columns[n : 2 * n])
        dq = np.column_stack(columns[2 * n :]) if described.columns.dq else _derive(q, period_s, window)
        is_touched = None
        if touched is not None:
            is_touched = touched[rows][np.searchsorted(time_s[rows], grid_s, side="right") - 1]
        stretches.append(Stretch(float(grid_s[0]), Record(q, dq, tau_J), is_touched))
    if not stretches:
        raise LogError(f"{path}: no {shortest} samples of {period_s:g} s without a gap")
    noise_Nm = _noise([stretch.record.tau_J for stretch in stretches])
    velocity = _noise([stretch.record.dq for stretch in stretches]) if described.columns.dq else np.zeros(n)
    return Recording(
        path=path,
        period_s=period_s,
        stretches=tuple(stretches),
        noise_Nm=tuple(np.maximum(noise_Nm, _LEAST_NOISE_NM).tolist()),
        velocity_noise_rad_s=min(float(velocity.max()), 1.0),
        blur_s=0.0 if described.columns.dq else 0.5 * window * period_s,
    )


def _read_columns(path: Path, described: RecordingMap) -> tuple[Vector, Vector, NDArray[np.bool_] | None]:
    """Return time (k,) s, positions, torques and velocities side by side (k, 2 n or 3 n), SI, and touches (k,)."""
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
    try:
        with warnings.catch_warnings(), _open(path) as file:
            warnings.simplefilter("ignore", UserWarning)  # of an empty file; said below
            table = np.loadtxt(
                file,
                delimiter=None if form.delimiter == " " else form.delimiter,
                skiprows=form.skip_rows + form.has_header,
                usecols=places,
                ndmin=2,
                converters=_number,
            )
    except (OSError, ValueError) as error:
        raise LogError(f"recording {path}: {str(error).splitlines()[0]}") from None
    if len(table) < _SHORTEST_SAMPLES:
        raise LogError(f"recording {path} has {len(table)} rows, {_SHORTEST_SAMPLES} are the least")
    time_s = table[:, 0] * described.time_s
    backward = np.flatnonzero(~(np.diff(time_s) > 0.0))
    if len(backward):
        row = int(backward[0]) + 1 + form.skip_rows + form.has_header
        raise LogError(f"recording {path}: time does not increase after row {row}: {time_s[backward[0]]:.9g} s")
    units = (*described.q_rad, *described.tau_J_Nm, *(described.dq_rad_s if columns.dq else ()))
    values = table[:, 1 : 1 + len(units)] * np.array(units)
    return time_s, values, table[:, -1] != 0.0 if columns.contact else None


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


def _cut(stretch: Stretch, period_s: float, start_s: float, end_s: float) -> Stretch:
    time_s = stretch.start_s + period_s * np.arange(len(stretch.record.q))
    first, last = np.searchsorted(time_s, (start_s, end_s))
    return _part(stretch, period_s, int(first), int(last))


def _part(stretch: Stretch, period_s: float, first: int, last: int) -> Stretch:
    record, touched = stretch.record, stretch.is_touched
    kept = Record(record.q[first:last], record.dq[first:last], record.tau_J[first:last])
    return Stretch(stretch.start_s + first * period_s, kept, None if touched is None else touched[first:last])
