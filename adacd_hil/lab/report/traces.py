"""The curves of a page: their panels, their rounding, their packing.

The page's script draws them, so that a reader can enlarge any part; the data lie in the page, at their full rate.
Panels with the same abscissa make a *track*: the cycles of /scheme, those of /cycle, the dates of runs.

A series x (n,) becomes whole numbers, 0 where x is not finite, else 1 + round((x - low) / step). Of their first or
second differences, whichever is smaller (32 bits, they wrap), the sign goes to the lowest bit (zigzag); the bytes of
all numbers, the lowest first, lie one plane after the other; the planes are compressed by zlib and written in base64.
Smooth series take a fraction of a bit per sample, noise about four.
"""

import zlib
from base64 import b64encode
from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.lab.score.evaluation import QUEUES
from adacd_hil.lab.score.run_arrays import (
    COMPUTE,
    LATENESS,
    SLACK,
    SYNC_TO_COMMAND,
    CertifiedStream,
    CycleColumns,
    Run,
    is_realtime,
)
from adacd_hil.lab.signal_noise import white_noise
from adacd_hil.records import JOINTS, PARAMETER_NAMES, PARAMETER_UNITS, Vector
from adacd_hil.scheme.model.filter_bank import channels_of

FINEST: Final = {
    "rad": 2e-5,
    "rad/s": 5e-4,
    "Nm": 1e-3,
    "×": 0.02,
    "µs": 0.1,
    "bytes": 1.0,
    "periods": 1.0,
}
"""Finest steps by unit: the encoders' own, a fortieth of a threshold, a hundredth of its margin."""
_PARAMETER_STEP: Final = 1e-5
_NEAR: Final = 3.0
"""The range near zero, in thresholds."""
_BANK_COLOURS: Final = ("identified", "cad", "joint1", "beside", "joint2")


class Trace(NamedTuple):
    """One curve (n,), a value per sample of its track. finest: smallest step to which it may be rounded.

    colour: a variable of the page. is_dashed: drawn as a bound. is_mirrored: drawn at + and - the values.
    """

    label: str
    values: Vector
    finest: float
    colour: str
    is_dashed: bool = False
    is_mirrored: bool = False


class TracePanel(NamedTuple):
    """Curves on one ordinate. levels: values with a horizontal line of their own.

    near: half the ordinate's range when it shows the values near zero; None: no such range.
    """

    name: str
    title: str
    unit: str
    traces: tuple[Trace, ...]
    levels: tuple[float, ...] = ()
    near: float | None = None


class Track(NamedTuple):
    """Panels over one abscissa, `at_s` (n,), s.

    is_next (n,): samples that follow the one before without a gap; None: all do.
    """

    name: str
    at_s: Vector
    panels: tuple[TracePanel, ...]
    is_next: NDArray[np.bool_] | None = None


def panels_of(run: Run) -> tuple[TracePanel, ...]:
    """Return the panels of a run's curves over /scheme; those for which the run has no data are left out."""
    return (*_residuals(run), *_motion(run), *_channels(run), *_parameters(run))


def _motion(run: Run) -> Iterator[TracePanel]:
    for name, title, unit in (
        ("q", "Measured position q", "rad"),
        ("dq", "Measured velocity dq", "rad/s"),
        ("tau_J", "Measured joint torque tau_J", "Nm"),
    ):
        yield TracePanel(name, title, unit, _joint_traces(getattr(run.motion, name), unit))


def _joint_traces(values: Vector, unit: str) -> tuple[Trace, ...]:
    """Return a trace for each joint's values (n, 2) in a unit of FINEST."""
    return tuple(Trace(f"joint {j + 1}", values[:, j], FINEST[unit], f"joint{j + 1}") for j in range(JOINTS))


def _residuals(run: Run) -> Iterator[TracePanel]:
    """Yield a panel per joint: residuals and thresholds of the run's scheme and, if it ran beside, the paper's.

    The CAD model's residual and the true external torque are added if known. Thresholds far above are cut by
    `_in_view`.
    """
    finest = FINEST["Nm"]
    ours = "identified" if run.certified is None else "certified"
    for joint in range(JOINTS):
        residual = run.tau_ext_hat[:, joint]
        traces = []
        if run.has_cad:
            traces.append(Trace("CAD model", run.tau_ext_hat_cad[:, joint], finest, "cad"))
        if run.beside is not None:
            traces.append(Trace("paper's", run.beside.tau_ext_hat[:, joint], finest, "beside"))
            bound = _in_view(run.beside.threshold[:, joint], residual)
            traces.append(Trace("its threshold", bound, finest, "beside", True, True))
        bound = _in_view(run.threshold[:, joint], residual)
        traces.append(Trace(ours, residual, finest, "identified"))
        traces.append(Trace("threshold", bound, finest, "ink", True, True))
        if run.truth is not None:
            traces.append(Trace("true", _true_torque(run)[:, joint], finest, "good"))
        finite = bound[np.isfinite(bound)]
        near = _NEAR * float(np.median(finite)) if finite.size else None
        title = f"Estimated external torque tau_ext_hat, joint {joint + 1}"
        yield TracePanel(f"residual{joint + 1}", title, "Nm", tuple(traces), near=near)


def _true_torque(run: Run) -> Vector:
    """Return the true external torque in each cycle, Nm (n, 2); zero in cycles that the truth doesn't have."""
    assert run.truth is not None
    torque = np.zeros((run.cycle.size, JOINTS))
    if run.truth.cycle.size:
        rows = np.minimum(np.searchsorted(run.truth.cycle, run.cycle), run.truth.cycle.size - 1)
        is_there = run.truth.cycle[rows] == run.cycle
        torque[is_there] = run.truth.tau_ext[rows[is_there]]
    return torque


def _in_view(threshold: Vector, residual: Vector) -> Vector:
    """Return a threshold (n,) with NaN where it exceeds both the largest residual and `_NEAR` times its own minimum."""
    largest = float(np.max(np.abs(residual[np.isfinite(residual)]), initial=0.0))
    finite = threshold[np.isfinite(threshold)]
    ceiling = max(largest, _NEAR * float(finite.min())) if finite.size else 0.0
    return np.where(threshold <= ceiling, threshold, np.nan)


def _channels(run: Run) -> Iterator[TracePanel]:
    """Yield a panel per joint of the bank's channels, and one of the largest ratio of residual to threshold.

    Yield none for a run that was not certified.
    """
    stream = run.certified
    if stream is None:
        return
    labels = [
        f"{cutoff:g} rad/s{'' if smoothing is None else ' smoothed'}" for cutoff, smoothing in channels_of(run.settings)
    ]
    for joint in range(JOINTS):
        traces = tuple(
            Trace(label, stream.tau_ext[:, channel, joint], FINEST["Nm"], _BANK_COLOURS[channel % len(_BANK_COLOURS)])
            for channel, label in enumerate(labels)
        )
        yield TracePanel(f"channels{joint + 1}", f"Residual channels, joint {joint + 1}", "Nm", traces[::-1])
    title = "Largest residual over its threshold, any channel (an alarm at 1)"
    yield TracePanel("share", title, "×", _joint_traces(_shares(stream), "×"), levels=(1.0,), near=1.5)


def _shares(stream: CertifiedStream) -> Vector:
    """Return |residual| / threshold (n, 2): in each cycle the largest of all channels."""
    shares = np.zeros((len(stream.tau_ext), JOINTS))
    for channel in range(stream.tau_ext.shape[1]):
        with np.errstate(over="ignore"):  # a damaged log's threshold near 0
            np.maximum(shares, np.abs(stream.tau_ext[:, channel]) / stream.threshold[:, channel], out=shares)
    return shares


def _parameters(run: Run) -> Iterator[TracePanel]:
    """Yield the estimates theta_hat, a panel per unit, with the true values if known."""
    names = run.parameter_names
    for unit in dict.fromkeys(PARAMETER_UNITS[name] for name in names):
        chosen = [name for name in names if PARAMETER_UNITS[name] == unit]
        traces: list[Trace] = []
        for name, colour in zip(chosen, _BANK_COLOURS, strict=False):
            traces.append(Trace(name, run.theta_hat[:, names.index(name)], _PARAMETER_STEP, colour))
            true = _true_parameter(run, name)
            if true is not None:
                traces.append(Trace(f"true {name}", true, _PARAMETER_STEP, colour, is_dashed=True))
        title = f"Identified parameters theta_hat: {', '.join(chosen)}"
        yield TracePanel(f"theta-{chosen[0]}", title, unit, tuple(traces))


def _true_parameter(run: Run, name: str) -> Vector | None:
    """Return a parameter's true value in each cycle (n,); before the truth's first value, that value.

    None without a truth, or if the truth hasn't the parameter.
    """
    truth = run.truth
    if truth is None or name not in PARAMETER_NAMES:
        return None
    if not truth.model_cycle.size:
        return None
    rows = np.maximum(np.searchsorted(truth.model_cycle, run.cycle, side="right") - 1, 0)
    return np.asarray(truth.theta[rows, PARAMETER_NAMES.index(name)])


_TIMES: Final = ((LATENESS, "identified"), (COMPUTE, "joint1"), (SYNC_TO_COMMAND, "joint2"), (SLACK, "cad"))


def timing_track(columns: CycleColumns, period_us: float, zero_ns: int, has_grid: bool) -> Track:
    """Return a track of the times of `_TIMES`, queues and skipped periods, over s since `zero_ns`.

    Without a skipped period there is no panel of skipped periods. period_us: drawn as a level in the panels of times.
    has_grid: False in lockstep, where lateness and queues are left out.
    """
    panels = []
    for quantity, colour in _TIMES:
        if has_grid or quantity is not LATENESS:
            title = f"{quantity.title}: {quantity.meaning}"
            trace = Trace(quantity.title, columns.times_us(quantity), FINEST["µs"], colour)
            panels.append(TracePanel(f"time-{quantity.name}", title, "µs", (trace,), levels=(period_us,)))
    if has_grid:
        traces = (
            Trace(name, columns[column].astype(np.float64), FINEST["bytes"], f"queue_{name}")
            for name, column in QUEUES.items()
        )
        title = "Queues: of the bus, to be received and to be sent, and to the log's writer"
        panels.append(TracePanel("queues", title, "bytes", tuple(traces)))
    if columns["overruns"].any():
        skipped = Trace("skipped", columns.steps("overruns").astype(np.float64), FINEST["periods"], "alarm")
        panels.append(TracePanel("skipped", "Periods that were skipped", "periods", (skipped,)))
    is_next = np.diff(columns["cycle"], prepend=-2) == 1
    at_s = np.asarray((columns.t_ns - zero_ns) * 1e-9, np.float64)
    return Track("timing", at_s, tuple(panels), is_next)


def run_tracks(run: Run) -> list[Track]:
    """Return the two tracks of a run's curves: over the cycles of /scheme, and over those of /cycle."""
    is_next = None if run.bucket == 1 else np.diff(run.cycle, prepend=run.cycle[:1] - 2) == 1
    timing = timing_track(run.timing, run.settings.bus.period_us, run.zero_ns, is_realtime(run))
    return [Track("scheme", run.time_s(), panels_of(run), is_next), timing]


STEPS_PER_SIGMA: Final = 2.0
"""A rounding error of 0.14 standard deviations: it makes the noise 1 % larger."""
_LARGEST_CODE: Final = 2**30


def step_of(values: Vector, finest: float, is_next: NDArray[np.bool_] | None = None) -> float:
    """Return the step to which a series (n,) is rounded: rms of white noise over STEPS_PER_SIGMA, at least `finest`.

    is_next (n,): samples that follow the one before without a gap; None: all do.
    """
    is_finite = np.isfinite(values)
    parts = [values[is_finite]]
    if is_next is not None:
        parts = np.split(parts[0], np.flatnonzero(~is_next[is_finite]))
    return max(finest, float(white_noise(*parts)) / STEPS_PER_SIGMA)


def pack(values: Vector, step: float) -> tuple[str, dict[str, Any]]:
    """Return a series (n,) as base64 text of zlib data, and the table by which the page's script decodes it.

    Values are rounded to `step`, or to a larger step if their range has over `_LARGEST_CODE` steps. Code 0 is a value
    that isn't finite, code 1 is `low`. The codes are differenced, zigzag coded and split into byte planes. Table: low
    and step in the series' unit; order: number of differences, 1 or 2; planes: bytes per number.
    """
    is_finite = np.isfinite(values)
    finite = values[is_finite]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    step = max(step, (high - low) / _LARGEST_CODE)
    codes = np.zeros(values.size, np.int32)
    codes[is_finite] = 1 + np.rint((finite - low) / step).astype(np.int32)
    candidates = [_zigzag(np.diff(codes, order, prepend=np.zeros(order, np.int32))) for order in (1, 2)]
    order = int(np.argmin([candidate.sum(dtype=np.float64) for candidate in candidates]))
    numbers = candidates[order]
    count = max(1, -(-int(numbers.max(initial=0)).bit_length() // 8))
    planes = numbers.astype("<u4").view(np.uint8).reshape(-1, 4).T[:count]
    squeezer = zlib.compressobj(6, zlib.DEFLATED, 15, 9, zlib.Z_RLE)  # only zeros repeat in noise
    squeezed = squeezer.compress(planes.tobytes()) + squeezer.flush()
    form = {"low": low, "step": step, "order": order + 1, "planes": count}
    return b64encode(squeezed).decode("ascii"), form


def _zigzag(numbers: NDArray[np.int32]) -> NDArray[np.uint32]:
    return ((numbers << 1) ^ (numbers >> 31)).view(np.uint32)


_TIME_STEP_S: Final = 1e-5


class Traces(NamedTuple):
    """The curves of a page: panels by their track's name, packed series by name, and the plan for the page's script."""

    panels: dict[str, tuple[TracePanel, ...]]
    blocks: dict[str, str]
    plan: dict[str, Any]


def pack_tracks(
    tracks: Sequence[Track], period_s: float, marks: dict[str, Any] | None = None, is_dated: bool = False
) -> Traces | None:
    """Return the curves of a page, packed for its script; None if no track has two samples and a panel.

    Tracks with fewer are left out. period_s: the script can't zoom in below eight periods. marks: bands, contacts and
    faults of the run. is_dated: the abscissa is the time since 1970.
    """
    tracks = [track for track in tracks if track.at_s.size > 1 and track.panels]
    if not tracks:
        return None
    blocks: dict[str, str] = {}
    planned = []
    for track in tracks:
        at = _packed(blocks, f"trace-t-{track.name}", track.at_s, _TIME_STEP_S)
        panels = [
            {
                "name": panel.name,
                "unit": panel.unit,
                "near": panel.near,
                "levels": panel.levels,
                "curves": [
                    {
                        **_packed(blocks, f"trace-{panel.name}-{number}", trace.values,
                                  step_of(trace.values, trace.finest, track.is_next)),
                        "label": trace.label,
                        "colour": trace.colour,
                        "isDashed": trace.is_dashed,
                        "isMirrored": trace.is_mirrored,
                    }
                    for number, trace in enumerate(panel.traces)
                ],
            }
            for panel in track.panels
        ]  # fmt: skip
        planned.append({"name": track.name, "count": int(track.at_s.size), "time": at, "panels": panels})
    nothing: dict[str, Any] = {"bands": [], "contacts": [], "faults": []}
    plan = {"period": period_s, "isDated": is_dated, "tracks": planned, **nothing, **(marks or {})}
    return Traces({track.name: track.panels for track in tracks}, blocks, plan)


def _packed(blocks: dict[str, str], name: str, values: Vector, step: float) -> dict[str, Any]:
    """Pack a series into `blocks` under a name.

    Return a table with the name as "id" and the form that the script needs.
    """
    blocks[name], form = pack(values, step)
    return {"id": name, **form}
