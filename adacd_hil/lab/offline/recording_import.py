"""Import of a foreign recording: a file and its map become samples at a fixed period, in SI units.

A gap in time, a missing or infinite value, and the beginning or end of a touch split a recording into stretches; the
model is carried over, the filters restart. Values between two samples are interpolated.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d
from scipy.signal import savgol_filter

from adacd_hil.lab.logs.joint_state_bags import is_bag
from adacd_hil.lab.offline.bag_recording import read_bag
from adacd_hil.lab.offline.csv_recording import read_csv
from adacd_hil.lab.offline.recorded_columns import MOST_ROWS, SHORTEST_SAMPLES, RecordedColumns
from adacd_hil.lab.offline.recording_map import RecordingMap, time_unit_of
from adacd_hil.lab.serial_arm.offline import Record
from adacd_hil.lab.signal_noise import resolution, white_noise
from adacd_hil.log.log_files import LogError
from adacd_hil.log.time_window import TimeWindow
from adacd_hil.printable import number_of
from adacd_hil.records import Vector
from adacd_hil.score.judge import contact_bounds

SHORTEST_PERIOD_S, LONGEST_PERIOD_S = 1e-5, 0.05
_LEAST_NOISE_NM = 1e-4
_MOST_BESIDE_JUMP_RAD = 0.8
"""Most motion in the time of a position jump: 16 rad/s in the longest period."""
_JITTER = 0.25
"""Share of a period by which the intervals of rows may vary: a derived velocity is wrong by as much."""
_DEGREE = 3  # of the polynomial whose slope is a derived velocity
_STEP_TO_SIGMA = 1.0 / np.sqrt(12.0)  # of the rounding to a step


@dataclass(frozen=True)
class RecordingStretch:
    """Samples without a gap in time. start_s: time of the first, since the recording's first row.

    is_touched (k,): whether the arm was touched at each sample; None if touches are unknown.
    """

    start_s: float
    record: Record
    is_touched: NDArray[np.bool_] | None

    @property
    def touches(self) -> list[tuple[int, int]]:
        """Index of each touch's first sample, and of the sample after its last.

        The list is empty if there are no touches or they are unknown.
        """
        return [] if self.is_touched is None else _true_runs(self.is_touched)


@dataclass(frozen=True)
class ForeignRecording:
    """A recording as samples at a fixed period, in stretches without a gap, in SI units.

    `noise_Nm` (n,), `velocity_noise_rad_s`: estimated rms of the white noise, of velocities that of the noisiest joint,
    0 if they are derived. `blur_s`: half the window over which velocities were derived from positions; 0 if they were
    measured. `columns`: rows as read from the file. `notes`: dropped rows and assumptions, a few words each.
    """

    path: Path
    period_s: float
    stretches: tuple[RecordingStretch, ...]
    noise_Nm: tuple[float, ...]
    velocity_noise_rad_s: float
    blur_s: float
    columns: RecordedColumns
    notes: tuple[str, ...] = ()

    @property
    def has_velocities(self) -> bool:
        """Whether velocities were measured, not derived from the positions: `blur_s` is 0."""
        return self.blur_s == 0.0

    @property
    def duration_s(self) -> float:
        """Sum of the stretches' durations, s."""
        return sum(len(record.q) for record in self.records) * self.period_s

    @property
    def records(self) -> list[Record]:
        """The samples as a list of `Record`, one per stretch, in their order."""
        return [stretch.record for stretch in self.stretches]

    @property
    def span_s(self) -> tuple[float, float]:
        """Begin of the first stretch and end of the last one, s since the recording's first row.

        Raises IndexError without stretches.
        """
        last = self.stretches[-1]
        return self.stretches[0].start_s, last.start_s + len(last.record.q) * self.period_s

    @property
    def own_rows(self) -> Vector:
        """The rows of the file, in SI units (k, c), between the begin of the first stretch and the end of the last one.

        Rows that lack a value are left out. Columns as of `RecordedColumns.values`. Empty without stretches.
        """
        if not self.stretches:
            return self.columns.values[:0]
        first, end = np.searchsorted(self.columns.time_s - self.columns.begin_s, self.span_s)
        rows = self.columns.values[first:end]
        return rows[np.isfinite(rows).all(axis=1)]

    def between(self, start_s: float, end_s: float) -> "ForeignRecording":
        """Return the recording with its stretches cut to a span of time, s since the recording's first row.

        A sample at `start_s` belongs to the span, a sample at `end_s` doesn't. Stretches left with fewer than
        `SHORTEST_SAMPLES` are dropped; there may be no stretch left. Noise, columns and notes stay those of the whole
        recording.
        """
        parts = [_cut(stretch, self.period_s, start_s, end_s) for stretch in self.stretches]
        kept = tuple(part for part in parts if len(part.record.q) >= SHORTEST_SAMPLES)
        return replace(self, stretches=kept)

    @property
    def free(self) -> "ForeignRecording":
        """The recording without touched samples; unchanged if touches are unknown.

        Samples within `blur_s` of a touch are left out, too, and parts with fewer than `SHORTEST_SAMPLES`. It may have
        no stretches.
        """
        return replace(self, stretches=tuple(part for stretch in self.stretches for part in self._untouched(stretch)))

    def _untouched(self, stretch: RecordingStretch) -> list[RecordingStretch]:
        """Return the untouched parts of a stretch with at least `SHORTEST_SAMPLES`.

        The whole stretch if touches are unknown. Samples whose derived velocity depends on touched samples are left
        out, too.
        """
        if stretch.is_touched is None:
            return [stretch]
        width = 2 * round(self.blur_s / self.period_s) + 1
        is_touched = np.convolve(stretch.is_touched, np.ones(width), "same") > 0.5
        parts = [_part(stretch, self.period_s, *bounds) for bounds in _true_runs(~is_touched)]
        return [part for part in parts if len(part.record.q) >= SHORTEST_SAMPLES]


def _true_runs(is_true: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the index of the first element of each run of True, and of the element after its last."""
    return contact_bounds(np.where(is_true, 0, -1), None)


def samples(recordings: Iterable[ForeignRecording], name: str) -> Vector:
    """Return a quantity's samples from all recordings, one recording after the other (k, n).

    name: "q", "dq" or "tau_J". Raises ValueError if the recordings have no stretches.
    """
    return np.concatenate([getattr(record, name) for recording in recordings for record in recording.records])


def read_recording(
    path: Path, described: RecordingMap, period_s: float = 0.0, span: TimeWindow | None = None
) -> ForeignRecording:
    """Read a CSV file, an MCAP file or a rosbag, told apart by the first bytes, into samples at a fixed period.

    period_s: of the samples, if the map gives none; 0: the median interval of the file's rows. span: the part to read
    of a file with more than `MOST_ROWS` rows; any other is read whole. Raises LogError if the file can't be read, is
    too long, or has no usable stretch; ConfigError if the map names a column, topic or joint that the file lacks, or if
    the map lacks a key.
    """
    read = read_bag if is_bag(path) else read_csv
    return recording_of(path, described, read(path, described, span), period_s)


def recording_of(
    path: Path, described: RecordingMap, given: RecordedColumns, period_s: float = 0.0
) -> ForeignRecording:
    """Make a recording from columns: drop rows that lack a value, resample at a fixed period, and split at gaps.

    Velocities of all joints are derived from the positions if they are missing, or one joint's is constant although its
    position changes. Jumps of a revolute joint's position by one turn are removed. Stretches that are too short are
    dropped. path: of the recording, named in errors. period_s: if the map gives none; 0: the median interval of the
    rows. Raises LogError if too few rows have all values, no stretch without a gap has enough samples, or the samples
    are more than `MOST_ROWS`; also if the median interval is used and is outside `SHORTEST_PERIOD_S` to
    `LONGEST_PERIOD_S`.
    """
    n = described.joints
    is_whole = np.isfinite(given.values).all(axis=1)
    time_s, values = given.time_s[is_whole] - given.begin_s, given.values[is_whole]
    touched = None if given.touched is None else given.touched[is_whole]
    notes = list(given.notes)
    if missing := int(np.count_nonzero(~is_whole)):
        notes.append(f"{number_of(missing, 'row')} without all values")
    if len(time_s) < SHORTEST_SAMPLES:
        raise LogError(f"recording {path}: {number_of(len(time_s), 'row')} with all values, {SHORTEST_SAMPLES} needed")
    period_s = described.sampling.period_s or period_s or _period_s(path, time_s, described)
    values, idle = _without_idle_velocities(values, described)
    values, turned = _without_jumps(values, described)
    notes += [*idle, *turned]
    has_dq = values.shape[1] > 2 * n
    if described.columns.time and not has_dq and (jitter := _jitter(time_s, period_s)):
        notes.append(jitter)
    longest_s = max(described.sampling.longest_gap_s, 1.5 * period_s)
    window = derivative_window(described, period_s)
    shortest = max(SHORTEST_SAMPLES, window)
    edges = np.flatnonzero(np.diff(time_s) > longest_s) + 1
    stretches = []
    room = MOST_ROWS
    for rows in np.split(np.arange(len(time_s)), edges):
        count = int((time_s[rows[-1]] - time_s[rows[0]]) / period_s + 1e-6) + 1
        if count < shortest:
            continue
        room -= count
        if room < 0:
            raise LogError(f"{path}: more than {MOST_ROWS} samples of {period_s:g} s")
        grid_s = time_s[rows[0]] + period_s * np.arange(count)
        sampled = np.column_stack([np.interp(grid_s, time_s[rows], column) for column in values[rows].T])
        q, tau_J = sampled[:, :n], sampled[:, n : 2 * n]
        dq = sampled[:, 2 * n :] if has_dq else derive(q, period_s, window)
        is_touched = None
        if touched is not None:
            is_touched = touched[rows][np.searchsorted(time_s[rows], grid_s, side="right") - 1]
        stretches.append(RecordingStretch(float(grid_s[0]), Record(q, dq, tau_J), is_touched))
    if not stretches:
        raise LogError(f"{path}: no {shortest} samples of {period_s:g} s without a gap")
    noise_Nm = _noise([stretch.record.tau_J for stretch in stretches], values[:, n : 2 * n])
    velocity = max(_noise([stretch.record.dq for stretch in stretches], values[:, 2 * n :])) if has_dq else 0.0
    return ForeignRecording(
        path=path,
        period_s=period_s,
        stretches=tuple(stretches),
        noise_Nm=tuple(max(each, _LEAST_NOISE_NM) for each in noise_Nm),
        velocity_noise_rad_s=min(velocity, 1.0),
        blur_s=0.0 if has_dq else 0.5 * window * period_s,
        columns=given,
        notes=tuple(notes),
    )


def _period_s(path: Path, time_s: Vector, described: RecordingMap) -> float:
    """Return the median interval of the rows, s.

    Raises LogError if it is outside `SHORTEST_PERIOD_S` to `LONGEST_PERIOD_S`; the error names the unit of times that
    would fit.
    """
    period_s = float(np.median(np.diff(time_s)))
    if SHORTEST_PERIOD_S <= round(period_s, 9) <= LONGEST_PERIOD_S:
        return period_s
    unit = time_unit_of(period_s / described.time_s)
    remedy = f'; with `units.time` = "{unit}" they are {period_s / described.time_s:g} {unit}' if unit else ""
    raise LogError(
        f"recording {path}: rows are {period_s:g} s apart, {SHORTEST_PERIOD_S:g} to {LONGEST_PERIOD_S:g} s are "
        f"expected{remedy}"
    )


def _jitter(time_s: Vector, period_s: float) -> str:
    """Return a note on intervals between rows that vary by over `_JITTER` of a period; "" if they don't.

    Their 5 % and 95 % quantiles are compared.
    """
    short_s, long_s = np.quantile(np.diff(time_s), (0.05, 0.95)).tolist()
    if long_s - short_s < _JITTER * period_s:
        return ""
    return (
        f"rows are {1e3 * short_s:.3g} to {1e3 * long_s:.3g} ms apart: if they were sampled evenly, leave "
        f"`columns.time` out and write `sampling.period_s` = {(time_s[-1] - time_s[0]) / (len(time_s) - 1):.6g}"
    )


def _without_idle_velocities(values: Vector, described: RecordingMap) -> tuple[Vector, list[str]]:
    """Return the values without all velocities, and a note, if a joint's is constant although its position changes.

    Otherwise the values as given, and no note. A joint at rest removes no velocities. Some drivers leave velocities
    empty. values: positions, torques and, if recorded, velocities, n columns each.
    """
    n = described.joints
    idle = np.ptp(values[:, 2 * n :], axis=0) == 0.0
    moved = np.ptp(values[:, :n], axis=0) > 0.0
    if not len(idle) or not np.any(idle & moved):
        return values, []
    joint = int(np.flatnonzero(idle & moved)[0])
    name, always = described.urdf.joint_names[joint], values[0, 2 * n + joint]
    note = f"the velocity of {name} is always {always:g} rad/s: velocities are derived from the positions"
    return values[:, : 2 * n], [note]


def _without_jumps(values: Vector, described: RecordingMap) -> tuple[Vector, list[str]]:
    """Return a copy of the values with unwrapped positions, and a note on each joint that was unwrapped.

    A revolute joint is unwrapped if its steps above half a turn are all of one turn, within `_MOST_BESIDE_JUMP_RAD`.
    """
    notes = []
    values = values.copy()
    for joint in np.flatnonzero(described.urdf.chain.is_prismatic == 0.0).tolist():
        steps = np.abs(np.diff(values[:, joint]))
        jumps = steps[steps > np.pi]
        if len(jumps) and np.all(np.abs(jumps - 2.0 * np.pi) < _MOST_BESIDE_JUMP_RAD):
            values[:, joint] = np.unwrap(values[:, joint])
            name, times = described.urdf.joint_names[joint], number_of(len(jumps), "time")
            notes.append(f"the position of {name} jumps by a turn {times}: it goes on instead")
    return values, notes


def derivative_window(described: RecordingMap, period_s: float) -> int:
    """Return the number of samples in `sampling.smoothing_s`, the window over which a velocity is derived.

    It is rounded, then made odd by adding 1, and at least `_DEGREE` + 2.
    """
    return max(_DEGREE + 2, round(described.sampling.smoothing_s / period_s)) | 1


def derive(q: Vector, period_s: float, window: int) -> Vector:
    """Derive velocities (k, n) from positions, without delay: the slope of a cubic over `window` samples.

    It is exactly 0 where the position is constant in the window. window: as of `derivative_window`. Raises ValueError
    if k is below `window`.
    """
    dq = np.asarray(savgol_filter(q - q[0], window, _DEGREE, deriv=1, delta=period_s, axis=0), np.float64)
    dq[maximum_filter1d(q, window, axis=0) == minimum_filter1d(q, window, axis=0)] = 0.0  # rounding leaves a sign
    return dq


def _noise(parts: list[Vector], given: Vector) -> list[float]:
    """Return the estimated rms of each joint's white noise over all parts (k, n), at least that of rounding.

    given: the values as recorded (k, n), by whose steps the rounding is found.
    """
    rounding = [_STEP_TO_SIGMA * resolution(column) for column in given.T]
    noise: list[float] = np.maximum(white_noise(*parts), rounding).tolist()
    return noise


def _cut(stretch: RecordingStretch, period_s: float, start_s: float, end_s: float) -> RecordingStretch:
    time_s = stretch.start_s + period_s * np.arange(len(stretch.record.q))
    first, last = np.searchsorted(time_s, (start_s, end_s))
    return _part(stretch, period_s, int(first), int(last))


def _part(stretch: RecordingStretch, period_s: float, first: int, last: int) -> RecordingStretch:
    record, touched = stretch.record, stretch.is_touched
    kept = Record(record.q[first:last], record.dq[first:last], record.tau_J[first:last])
    return RecordingStretch(stretch.start_s + first * period_s, kept, None if touched is None else touched[first:last])
