"""Checks of a recording's columns before any fit: constant, stuck, clipped, noise, two sources, wrong unit or sign.

A dead sensor, or a column that was never filled in, always has the same value. A stuck one has the same value for a
while in which its joint moves. A clipped one stays at its largest value far longer than just below it. Velocities are
compared with the slope of the positions, positions and torques with the limits of the URDF.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.lab.offline.recording_import import ForeignRecording, derivative_window, derive, samples
from adacd_hil.lab.offline.recording_map import ANGLE_RAD, RecordingMap, units_by_slope
from adacd_hil.lab.serial_arm.urdf import SerialArm
from adacd_hil.lab.signal_noise import white_noise
from adacd_hil.printable import number_of
from adacd_hil.records import Vector

_MEASURED: Final = (("tau_J", "torque", "Nm"), ("q", "position", "rad"))
"""Key of `columns`, word and unit of the columns that every recording has."""
_STUCK_S: Final = 0.5
_STUCK_TRAVEL: Final = 0.2
"""Share of its whole travel that a joint makes during equal readings of a stuck torque."""
_STUCK_TIMES: Final = 5.0
"""Factor on the 99 % quantile of the other runs of equal readings: coarse sensors have long ones."""
_CLIPPED_SHARE, _CLIPPED_ROWS, _CLIPPED_RUN = 0.005, 10, 5
_CLIPPED_BAND: Final = 0.05
"""Band below the largest reading, share of the span: a clipped sensor spends less time in it than at the bound."""
_PLATEAU_SIGMAS: Final = 3.5
_PLATEAU_WIDTH: Final = 0.1
_PLATEAU_SHARE, _PLATEAU_TIMES = 0.02, 4.0
"""A sine stays at its crest for 2.4 times as long as just below it."""
_FEWEST_LEVELS, _FINE_LEVELS = 50, 200
"""Fewest distinct readings of a sensor for the check, and readings from which half the time at a bound suffices."""
STILL_RAD: Final = 0.01
"""Travel below which a joint is at rest."""
_SPIKE_WINDOW, _SPIKE_SIGMAS, _SPIKE_SPAN, _SPIKES_SHARE = 5, 30.0, 1.0, 0.005
"""Samples around one; its least distance to their median, by noise and by the usual span; largest share of spikes."""
_NOISE_STEP: Final = 0.5
"""Mean square of the steps from sample to sample over twice the variance: 1 for white noise, 0.01 for a motion of 1 Hz
at 50 Hz."""
_NOISE_PERIOD_S: Final = 0.02
"""Longest period for that check and for jumps: at longer ones a fast motion has such steps, too."""
_JUMP_RAD, _JUMP_TIMES, _MOST_JUMPS = 0.05, 10.0, 3
"""Least step of a position that is a jump, its ratio to the steps just before and after (no joint starts and stops
within two samples), and most jumps of an encoder."""
_TO_AND_FRO_TIMES: Final = 3.0
"""Ratio of the mean step to the next row to that to the row after it: 1 for noise, less for motion."""
_TURNS_THOUGH_STILL_RAD: Final = 0.3
"""Travel by the velocities, for a joint at rest by its positions, that velocity noise and offset can't explain."""
_WELL_CORRELATED: Final = 0.8
_SAME_SLOPE: Final = (0.8, 1.25)
_BEYOND_LIMITS: Final = 3.0
"""Factor on the limits of a joint: no arm goes there, but degrees read as radians are 57 times too large."""
BEYOND_EFFORT: Final = 30.0
"""Factor on the effort of the URDF: mNm read as Nm are 1000 times too large."""

IN_MAP: Final = "in the map: "
"""Begins a remedy that is a line of the map; arrays have none."""
CORRECT_UNITS: Final = "correct `columns`, `units` and `scale` of positions and torques"
CLIPPED_REMEDY: Final = "move slower, or raise the range of that sensor"
LEFT_OUT_REMEDY: Final = (
    "leave the velocities out (`columns.dq`; of a bag `velocity` in its messages): they are derived then"
)


class RecordingFinding(NamedTuple):
    """A finding on a recording, and the user's next step; "" if the user need not act.

    is_against: a reason why the torque isn't explained; else a remark. is_dead: no model can be fitted to the column.
    is_wrong: a fitted model is worthless, unless another interpretation of the map is found. With neither, a defect of
    a column is a possible reason of a bad fit.
    """

    text: str
    remedy: str = ""
    is_against: bool = True
    is_dead: bool = False
    is_wrong: bool = False


class _Columns(NamedTuple):
    """All samples of some recordings (k, n), one recording after the other.

    time_s (k,): since each recording's first row.
    """

    time_s: Vector
    q: Vector
    dq: Vector
    tau_J: Vector
    period_s: float


def find_faults(
    described: RecordingMap, fitted: Sequence[ForeignRecording], tested: ForeignRecording
) -> tuple[RecordingFinding, ...]:
    """Return the defects of the columns of the fitted recordings and the tested one; () if there are none.

    Velocities are checked only if all recordings have them.
    """
    recordings = [*fitted, tested]
    found = list(column_faults(described, recordings))
    still = np.ptp(samples(recordings, "q"), axis=0) < STILL_RAD
    for part, records in (("fitted", fitted), ("tested", [tested])):
        found += _of_rest(described, part, records, still)
    if all(recording.has_velocities for recording in recordings):
        found += _of_velocities(described, recordings)
    return tuple(found)


def column_faults(described: RecordingMap, recordings: Sequence[ForeignRecording]) -> Iterator[RecordingFinding]:
    """Yield the defects of torques and positions over all these recordings together.

    Defects of velocities are not sought. Velocities only show dead encoders, and joints beyond the URDF's limit of
    speed. recordings: at least one, with the same period, and with stretches.
    """
    stretches = [stretch for recording in recordings for stretch in recording.stretches]
    period_s = recordings[0].period_s
    times = [stretch.start_s + period_s * np.arange(len(stretch.record.q)) for stretch in stretches]
    q, dq, tau_J = (samples(recordings, name) for name in ("q", "dq", "tau_J"))
    columns = _Columns(np.concatenate(times), q, dq, tau_J, period_s)
    yield from _of_sources(described, recordings)
    yield from _of_torques(described, columns)
    yield from _of_positions(described, columns)
    yield from _of_jumps(described, recordings)
    yield from _of_spikes(described, columns)


def joined_names(names: list[str], count: int) -> str:
    """Join joints' names with commas and "and"; return "all joints" if the names are as many as `count`, and over two.

    names: at least one. count: number of joints of the arm.
    """
    if len(names) == count > 2:
        return "all joints"
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def column_name(described: RecordingMap, key: str, joint: int) -> str:
    """Return a joint's name; if the map names its column otherwise, with the column in parentheses. joint: from 0.

    key: of `columns` in the map, such as "tau_J".
    """
    name, columns = described.urdf.joint_names[joint], getattr(described.columns, key)
    return f"{name} ({columns[joint]})" if columns and columns[joint] != name else name


def _of_sources(described: RecordingMap, recordings: Sequence[ForeignRecording]) -> Iterator[RecordingFinding]:
    """Report the first column whose rows in the file, not resampled, alternate between two series of values.

    The torques of a recording are looked at before its positions, velocities not at all. Recordings with fewer than
    three whole rows are passed over. At most one finding.
    """
    n = described.joints
    for recording in recordings:
        rows = recording.own_rows
        if len(rows) < 3:
            continue
        next_row, row_after = (np.mean(np.abs(rows[step:] - rows[:-step]), axis=0) for step in (1, 2))
        is_double = next_row > _TO_AND_FRO_TIMES * row_after
        for (key, what, unit), first in zip(_MEASURED, (n, 0), strict=True):
            for joint in np.flatnonzero(is_double[first : first + n])[:1].tolist():
                yield RecordingFinding(
                    f"the {what} of {column_name(described, key, joint)} goes to and fro from row to row, by "
                    f"{next_row[first + joint]:.3g} {unit}: two sources in one column, or a loop that oscillates",
                    "record one source alone, or stop the oscillation",
                    is_wrong=True,
                )
                return


def _of_torques(described: RecordingMap, columns: _Columns) -> Iterator[RecordingFinding]:
    """Report torques that are constant, stuck or clipped, and the one farthest over `BEYOND_EFFORT` times its effort.

    Constant torques aren't checked further. The effort is the URDF's; currents aren't compared with
    it.
    """
    n = described.joints
    constant = [joint for joint in range(n) if np.ptp(columns.tau_J[:, joint]) == 0.0]
    if constant:
        names = joined_names([column_name(described, "tau_J", joint) for joint in constant], n)
        always = ", ".join(dict.fromkeys(f"{columns.tau_J[0, joint] + 0.0:g}" for joint in constant))
        yield RecordingFinding(
            f"the torque of {names} is always {always} Nm: a dead sensor, or an empty column",
            "check that sensor, and `columns.tau_J`",
            is_dead=True,
        )
    for joint in (joint for joint in range(n) if joint not in constant):
        torque, name = columns.tau_J[:, joint], column_name(described, "tau_J", joint)
        run = _stuck_run(torque, columns.q, columns.period_s)
        run_Nm = None if run is None else round(float(torque[run[0]]), 9)
        if run is not None:
            seconds, start_s = (run[1] - run[0]) * columns.period_s, columns.time_s[run[0]]
            yield RecordingFinding(
                f"the torque of {name} is stuck at {torque[run[0]]:g} Nm for {seconds:.2g} s, from {start_s:.4g} s on, "
                "while the arm moves",
                "leave that time out with --from and --until, and check the sensor",
            )
        if bounds := [bound for bound in _clipped_at(torque) if bound != run_Nm]:
            yield RecordingFinding(
                f"the torque of {name} is clipped at {' and '.join(f'{bound:g}' for bound in bounds)} Nm",
                CLIPPED_REMEDY,
            )
    yield from _against_effort(described, columns)


def torques_and_limits(tau_J: Vector, arm: SerialArm) -> tuple[Vector, Vector]:
    """Return each joint's 99 % quantile of |tau_J| (n,), and its effort in the URDF (n,), inf if missing or 0.

    tau_J: (k, n), where nan is left out.
    """
    effort = np.where(np.isfinite(arm.torque_limit) & (arm.torque_limit > 0.0), arm.torque_limit, np.inf)
    return np.nanquantile(np.abs(tau_J), 0.99, axis=0), effort


def _against_effort(described: RecordingMap, columns: _Columns) -> Iterator[RecordingFinding]:
    """Report the torque that is farthest beyond `BEYOND_EFFORT` times the URDF's effort, if one is beyond.

    Report nothing if the torques are currents. The finding has `is_dead` if the URDF has no masses.
    """
    largest, effort = torques_and_limits(columns.tau_J, described.urdf)
    is_over = largest > BEYOND_EFFORT * effort
    if "A" in described.units.tau_J or not is_over.any():
        return
    joint = int(np.argmax(largest / effort))
    yield RecordingFinding(
        f"the torque of {column_name(described, 'tau_J', joint)} reaches {largest[joint]:.3g} Nm, the URDF allows "
        f"{effort[joint]:g} Nm",
        CORRECT_UNITS
        if described.units.tau_J == "mNm"
        else f"if the torques are mNm: {_unit_or_scale(described, 'tau_J', 'mNm', 1e-3, is_over | np.isinf(effort))}",
        is_dead=not np.any(described.urdf.theta_full),  # else its masses say more
    )


def _unit_or_scale(described: RecordingMap, key: str, unit: str, factor: float, is_meant: NDArray[np.bool_]) -> str:
    """Return the line of the map that corrects a unit, as text: `units.KEY` if all joints are meant, else `scale.KEY`.

    key: "q" or "tau_J". factor: on the scale of the joints meant. is_meant: (n,).
    """
    if is_meant.all():
        return f'`units.{key}` = "{unit}" in place of "{getattr(described.units, key)}"'
    return described.scaled(key, np.where(is_meant, factor, 1.0))


def _of_positions(described: RecordingMap, columns: _Columns) -> Iterator[RecordingFinding]:
    """Report joints at rest, dead encoders, noisy positions, and the first revolute joint far beyond the URDF's limits.

    Far is over `_BEYOND_LIMITS` times a limit of position or speed; a joint without limits of position has limits of
    two turns to each side. Linear joints and noisy positions aren't compared with limits. If no joint moves, report
    that in place of joints at rest and dead encoders.
    """
    n, urdf = described.joints, described.urdf
    travel = np.ptp(columns.q, axis=0)
    still = [joint for joint in range(n) if travel[joint] < STILL_RAD]
    if len(still) == n:
        yield RecordingFinding("the arm does not move", "record motion of every joint, fast and slow", is_dead=True)
    at_rest: list[int] = []
    for joint in still if len(still) < n else ():
        turned = float(np.ptp(np.cumsum(columns.dq[:, joint]))) * columns.period_s
        if turned > _TURNS_THOUGH_STILL_RAD:
            yield RecordingFinding(
                f"the position of {column_name(described, 'q', joint)} {_stays(columns.q[:, joint])}, though by its "
                "velocity it turns: a dead encoder",
                "check that encoder, and `columns.q`",
                is_wrong=True,
            )
        else:
            at_rest.append(joint)
    if at_rest:
        names = joined_names([column_name(described, "q", joint) for joint in at_rest], n)
        text = f"the position of {names} {_stays(columns.q[:, at_rest[0]])}: a dead encoder, or a joint"
        if len(at_rest) > 1:
            text = f"the positions of {names} change by less than {STILL_RAD:g} rad: dead encoders, or joints"
        yield RecordingFinding(
            f"{text} at rest, of which neither friction nor inertia can be learnt",
            "move every joint, name one that never moves in `arm.locked`, and check `columns.q`",
        )
    noise = [joint for joint in range(n) if joint not in still and _is_noise(columns.q[:, joint], columns.period_s)]
    if noise:
        names = joined_names([column_name(described, "q", joint) for joint in noise], n)
        yield RecordingFinding(
            f"the position of {names} is noise: from sample to sample it jumps as far as it goes at all",
            "check that encoder, and `columns.q`",
            is_dead=True,
        )
    low, high, limit = urdf.position_low, urdf.position_high, urdf.velocity_limit
    is_known = np.isfinite(low) & np.isfinite(high) & (high > low)
    bound = np.where(is_known, np.maximum(np.abs(low), np.abs(high)), 4.0 * math.pi)
    reach, speed = np.abs(columns.q).max(axis=0), np.quantile(np.abs(columns.dq), 0.99, axis=0)
    goes_far = reach > _BEYOND_LIMITS * bound
    is_fast = np.isfinite(limit) & (limit > 0.0) & (speed > _BEYOND_LIMITS * limit)
    is_beyond = (goes_far | is_fast) & (urdf.chain.is_prismatic == 0.0) & ~np.isin(np.arange(n), noise)
    for joint in np.flatnonzero(is_beyond)[:1].tolist():
        much = f"goes to {reach[joint]:.3g} rad" if goes_far[joint] else f"turns at {speed[joint]:.3g} rad/s"
        most = f"{bound[joint]:.3g} rad" if goes_far[joint] else f"{limit[joint]:g} rad/s"
        factor = ANGLE_RAD["deg"] / ANGLE_RAD[described.units.q]
        yield RecordingFinding(
            f"{column_name(described, 'q', joint)} {much}, beyond the {most} of the URDF",
            CORRECT_UNITS
            if described.units.q == "deg"
            else f"if the positions are degrees: {_unit_or_scale(described, 'q', 'deg', factor, is_beyond)}",
        )


def _stays(column: Vector) -> str:
    return f"changes by less than {STILL_RAD:g} rad" if np.ptp(column) else f"is always {column[0]:g} rad"


def _of_spikes(described: RecordingMap, columns: _Columns) -> Iterator[RecordingFinding]:
    """Report, for each torque and position, single samples far from their neighbours, as of a corrupted frame."""
    for key, what, unit in _MEASURED:
        for joint, column in enumerate(getattr(columns, key).T):
            rows = _spikes(column)
            if len(rows):
                yield RecordingFinding(
                    f"the {what} of {column_name(described, key, joint)} jumps for single samples, "
                    f"{number_of(len(rows), 'time')}, first to {column[rows[0]]:.4g} {unit} at "
                    f"{columns.time_s[rows[0]]:.4g} s",
                    "empty these cells: a missing value parts the recording, and does no harm",
                )


def _of_jumps(described: RecordingMap, recordings: Sequence[ForeignRecording]) -> Iterator[RecordingFinding]:
    """Report the first revolute joint whose position jumps and does not return, as of an encoder set to zero anew.

    A joint with more than `_MOST_JUMPS` is passed over: other checks report such a column.
    """
    for joint in np.flatnonzero(described.urdf.chain.is_prismatic == 0.0).tolist():
        jumps = [jump for recording in recordings for jump in _jumps(recording, joint)]
        if 0 < len(jumps) <= _MOST_JUMPS:
            step, time_s, was_still = jumps[0]
            yield RecordingFinding(
                f"the position of {column_name(described, 'q', joint)} jumps by {step:.3g} rad at {time_s:.4g} s: "
                f"{'it was stuck before, or ' * was_still}its zero has changed",
                "use the part before it or the part after it, with --from and --until, and check that encoder",
                is_wrong=True,
            )
            return


def _jumps(recording: ForeignRecording, joint: int) -> Iterator[tuple[float, float, bool]]:
    """Yield size, rad with sign, and time, s since the first row, of each lasting jump of a joint's position.

    The third value: whether the position was the same for `_STUCK_S` before. A jump is a step above `_JUMP_RAD` and
    `_JUMP_TIMES` the steps just before and after. There is none for a period above `_NOISE_PERIOD_S`. joint: from 0.
    """
    still = round(_STUCK_S / recording.period_s)
    for stretch in recording.stretches if recording.period_s <= _NOISE_PERIOD_S else ():
        q = stretch.record.q[:, joint]
        steps = q[2:] - q[:-2]  # over two samples: the row of a jump may lie between two samples
        size, before, after = np.abs(steps[2:-2]), np.abs(steps[:-4]), np.abs(steps[4:])
        rows = np.flatnonzero((size > _JUMP_RAD) & (size > _JUMP_TIMES * np.maximum(before, after)))
        for row in rows[np.diff(rows, prepend=-3) > 2].tolist():
            was_still = bool(row > still and np.ptp(q[row - still : row]) == 0.0)
            yield float(steps[row + 2]), stretch.start_s + (row + 4) * recording.period_s, was_still


def _spikes(column: Vector) -> NDArray[np.int64]:
    """Return the indices of samples (k,) that are far from the median of the `_SPIKE_WINDOW` around each.

    Far: by more than `_SPIKE_SIGMAS` of the noise and `_SPIKE_SPAN` of the usual span. Empty if they are over a share
    `_SPIKES_SHARE` of the samples, so always with few samples. The two samples at each end aren't checked.
    """
    if len(column) < _SPIKE_WINDOW:
        return np.zeros(0, np.int64)
    windows = np.lib.stride_tricks.sliding_window_view(column, _SPIKE_WINDOW)
    apart = np.abs(column[2:-2] - np.median(windows, axis=1))
    noise = float(white_noise(column))
    usual = np.ptp(np.quantile(column, (0.005, 0.995)))
    rows = np.flatnonzero(apart > max(_SPIKE_SIGMAS * noise, _SPIKE_SPAN * usual)) + 2
    return rows if len(rows) <= _SPIKES_SHARE * len(column) else rows[:0]


def _is_noise(column: Vector, period_s: float) -> bool:
    """Return whether positions (k,) jump from sample to sample as white noise does.

    Their mean square step is then over `_NOISE_STEP` times twice their variance. Always False for a period above
    `_NOISE_PERIOD_S`.
    """
    return period_s <= _NOISE_PERIOD_S and float(np.mean(np.diff(column) ** 2)) > _NOISE_STEP * 2.0 * float(
        np.var(column)
    )


def _of_rest(
    described: RecordingMap, part: str, recordings: Sequence[ForeignRecording], still: NDArray[np.bool_]
) -> Iterator[RecordingFinding]:
    """Report joints that rest in the fitted, or the tested, part although they don't rest over both parts together.

    part: "fitted" or "tested", for the text. recordings: of this part. still (n,): joints that rest over both together.
    """
    rests = np.ptp(samples(recordings, "q"), axis=0) < STILL_RAD
    joints = np.flatnonzero(rests & ~still).tolist()
    if joints:
        names = "the arm" if rests.all() else joined_names([described.urdf.joint_names[i] for i in joints], len(rests))
        yield RecordingFinding(
            f"{names} does not move in the part that is {part}",
            "choose what is fitted with --from and --until, and other motion for --test",
            is_dead=bool(rests.all()),
        )


def _of_velocities(described: RecordingMap, recordings: list[ForeignRecording]) -> Iterator[RecordingFinding]:
    """Report the first joint whose velocities are in another joint's column; else the first with a wrong slope.

    A slope is wrong if the velocities correlate well with that of the positions, but have another sign or size.
    """
    n = described.joints
    products = np.zeros((n, n))
    window = derivative_window(described, recordings[0].period_s)
    squares, own = np.zeros(n), np.zeros(n)
    for record in (record for recording in recordings for record in recording.records):
        if len(record.q) >= window:
            slope = derive(record.q, recordings[0].period_s, window)
            products += slope.T @ record.dq
            squares += np.sum(slope**2, axis=0)
            own += np.sum(record.dq**2, axis=0)
    slopes = np.diag(products) / np.maximum(squares, 1e-12)
    alike = products / np.sqrt(np.maximum(np.outer(squares, own), 1e-24))
    moving = [joint for joint in range(n) if squares[joint] > 0.0]
    for joint in moving:
        other = int(np.argmax(np.abs(alike[joint])))
        if abs(alike[joint, joint]) < _WELL_CORRELATED < alike[joint, other]:
            yield RecordingFinding(
                f"the velocity of {column_name(described, 'dq', joint)} is in the column of "
                f"{column_name(described, 'dq', other)}",
                f"exchange them, or {LEFT_OUT_REMEDY}",
                is_wrong=True,
            )
            return
    for joint in moving:
        if abs(alike[joint, joint]) < _WELL_CORRELATED or _SAME_SLOPE[0] < slopes[joint] < _SAME_SLOPE[1]:
            continue
        name, factor = column_name(described, "dq", joint), float(slopes[joint])
        how = "has the other sign than" if factor < 0.0 else f"is {factor:.3g} times"
        keys = [f'`units.{key}` = "{unit}"' for key, unit in units_by_slope(described.units, abs(factor))]
        yield RecordingFinding(
            f"the velocity of {name} {how} its position's slope",
            " or ".join([*(f"{IN_MAP}{key}" for key in keys), LEFT_OUT_REMEDY]),
            is_wrong=True,
        )
        return


def _runs(column: Vector) -> NDArray[np.int64]:
    """Return the runs of equal successive readings: index of the first, and of the reading after the last (r, 2)."""
    edges = np.flatnonzero(np.diff(column) != 0.0) + 1
    bounds = np.concatenate(([0], edges, [len(column)]))
    return np.column_stack([bounds[:-1], bounds[1:]])


def _stuck_run(torque: Vector, q: Vector, period_s: float) -> tuple[int, int] | None:
    """Return the first and the end index of the longest run of equal torques (k,) if the sensor is stuck, else None.

    The sensor is stuck if the run has at least `_STUCK_S` and 20 samples, some joint of q (k, n) moves in it, and the
    other runs are `_STUCK_TIMES` shorter, by their 99 % quantile: a coarse sensor has many long runs. Runs at an
    extreme reading are left out unless one is as much longer than the others there: that sensor is dead.
    """
    runs = _runs(torque)
    lengths = runs[:, 1] - runs[:, 0]
    for bound in (torque.min(), torque.max()):
        at = torque[runs[:, 0]] == bound
        *_, second, longest = 0, *np.sort(lengths[at])
        if longest <= _STUCK_TIMES * second:
            lengths[at] = 1  # a clipped sensor, reported elsewhere
    place = int(np.argmax(lengths))
    first, last = runs[place].tolist()
    usual = float(np.quantile(np.delete(lengths, place), 0.99)) if len(lengths) > 1 else 0.0
    is_long = (last - first) * period_s >= _STUCK_S and last - first >= 20 and last - first > _STUCK_TIMES * usual
    is_moving = np.any(np.ptp(q[first:last], axis=0) > _STUCK_TRAVEL * np.ptp(q, axis=0))
    return (first, last) if is_long and is_moving else None


def clipped_torque(torque: Vector) -> tuple[float, float] | None:
    """Return the torque at which readings (k,) stop, as if clipped, and the share of readings there; None if none.

    Readings stop there if the band next to the extreme reading, as wide as the noise, holds far more of them than the
    band beside it. The largest reading is tried before the smallest. A joint that overcomes only friction looks like
    this, too. Extreme readings that repeat exactly are those of `_clipped_at`, and give None. None, too, without noise,
    or if the band would be wider than `_PLATEAU_WIDTH` of the span.
    """
    width, span = 2.0 * _PLATEAU_SIGMAS * float(white_noise(torque)), float(np.ptp(torque))
    if not 0.0 < width < _PLATEAU_WIDTH * span:
        return None
    for sign in (1.0, -1.0):
        if np.count_nonzero(torque == sign * np.max(sign * torque)) >= _CLIPPED_RUN:
            continue  # cut off behind the noise, see `_clipped_at`
        below = float(np.max(sign * torque)) - sign * torque
        at, beside = np.count_nonzero(below < width), np.count_nonzero((below >= width) & (below < 2.0 * width))
        if at > _PLATEAU_SHARE * len(torque) and at > _PLATEAU_TIMES * beside:
            return float(np.median(torque[below < width])), at / len(torque)
    return None


def _clipped_at(torque: Vector) -> Iterator[float]:
    """Yield the smallest and the largest reading of a torque (k,), each only if the sensor seems clipped there.

    Then many readings equal it, some in a long run, and more than lie in the band beside it; from `_FINE_LEVELS`
    distinct readings on, more than half as many suffice. A torque with fewer than `_FEWEST_LEVELS` yields none.
    """
    torque = torque.round(9)  # interpolation leaves rounding beside the steps of a coarse sensor
    levels = np.unique(torque)
    if len(levels) < _FEWEST_LEVELS:
        return
    runs = _runs(torque)
    lengths, at_run = runs[:, 1] - runs[:, 0], torque[runs[:, 0]]
    times = 1.0 if len(levels) < _FINE_LEVELS else 0.5
    for bound in (levels[0], levels[-1]):
        at = int(lengths[at_run == bound].sum())
        beside = int(np.count_nonzero(np.abs(torque - bound) <= _CLIPPED_BAND * (levels[-1] - levels[0]))) - at
        is_long = lengths[at_run == bound].max() >= _CLIPPED_RUN
        if at > max(_CLIPPED_SHARE * len(torque), _CLIPPED_ROWS, times * beside) and is_long:
            yield float(bound)
