"""The figures of the timing evidence: how the times of a cycle are distributed, and how they went over the run."""

from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from adacd_hil.lab.drawing import (
    COLOURS,
    Drawing,
    label_below,
    label_decades,
    legend_above,
    mark_lane,
    note,
    style,
)
from adacd_hil.lab.score.evaluation import QUEUES
from adacd_hil.log.logged_run import COMPUTE, LATENESS, SLACK, SYNC_TO_COMMAND, CycleColumns, Quantity
from adacd_hil.records import Vector
from adacd_hil.score.distribution import BINS_PER_DECADE
from adacd_hil.score.metrics import TimeStatistics, TimingEvidence

_SHOWN: Final = (LATENESS, COMPUTE, SYNC_TO_COMMAND, SLACK)
_LINES: Final[tuple[tuple[str, Any], ...]] = (("p50", "solid"), ("p99", (0, (4, 2))), ("p99.9", (0, (1, 1.4))))
"""How each percentile is drawn; slack has p1 and p0.1 in the place of the others."""
_FLOOR_US: Final = 1.0
"""What is less is drawn as this on a logarithmic axis."""
_BELOW: Final = (0.5, 0.85)
"""Where the bar of values below 1 µs stands."""
_BANDS: Final = 400
"""Stretches of time over the width of a figure, each with its smallest and largest value."""
_MARKS: Final = 300
"""Marks that fit beside each other over the width of a figure."""
_QUEUE_LINEAR_BYTES: Final = 100.0
"""Depth up to which the axis of the queues is linear, so that 0 has a place."""


def draw_timing(
    columns: CycleColumns, evidence: TimingEvidence, zero_ns: int, zero_name: str = "the first cycle"
) -> list[Drawing]:
    """Draw both figures; none without a cycle. zero_ns, zero_name: what the time over the run counts from."""
    if not len(columns):
        return []
    with style():
        drawings = [distributions(evidence)] if any(_shown(evidence)) else []
        return [*drawings, time_line(columns, evidence, zero_ns, zero_name)]


def _shown(evidence: TimingEvidence) -> list[TimeStatistics | None]:
    found = [evidence.times[quantity.name] for quantity in _SHOWN]
    return [statistics if statistics is not None and statistics.percentiles else None for statistics in found]


def distributions(evidence: TimingEvidence) -> Drawing:
    """Draw a histogram of each time on logarithmic axes, with its percentiles and the period."""
    figure = Figure(figsize=(10.0, 5.0))
    grid = figure.subplots(2, 2)
    figure.subplots_adjust(left=0.058, right=0.97, bottom=0.095, top=0.885, wspace=0.15, hspace=0.38)
    shown = _shown(evidence)
    worst_us = max(max(map(abs, s.percentiles.values())) for s in shown if s is not None)
    end_us = 10.0 ** np.ceil(np.log10(1.05 * max(worst_us, evidence.period_us)))
    for axes, quantity, statistics in zip(grid.flat, _SHOWN, shown, strict=True):
        axes.set_title(quantity.title)
        if statistics is None:
            _say_why_empty(axes, quantity, evidence)
            continue
        _distribution(axes, statistics, quantity.is_reserve)
        axes.axvline(evidence.period_us, color=COLOURS["alarm"], linewidth=1.0)
        axes.set_xlim(0.45, end_us)
        _label_times(axes, end_us, statistics.histogram.below > 0)
    for axes in grid[:, 0]:
        axes.set_ylabel("cycles")
        axes.yaxis.set_label_coords(-0.085, 0.5)
    label_below(figure, "time, µs")
    handles = [Line2D([], [], color=COLOURS["ink"], linewidth=1.0, linestyle=line) for _, line in _LINES]
    labels = ["p50", "p99, of slack p1", "p99.9, of slack p0.1", "period"]
    handles.append(Line2D([], [], color=COLOURS["alarm"], linewidth=1.0))
    figure.legend(handles, labels, loc="upper right", bbox_to_anchor=(0.97, 0.985), ncols=4, columnspacing=1.8)
    caption = f"Cycles per bin, {BINS_PER_DECADE} bins per decade, both axes logarithmic"
    caption += f"; the period is {evidence.period_us:g} µs."
    if any(statistics is not None and statistics.histogram.below for statistics in shown):
        caption += " The bar on the left holds what is below 1 µs; of slack, in red, overruns too."
    if evidence.is_modelled:
        caption += " Lockstep: times of the model of bus and host."
    return Drawing("timing-distributions", "Distribution of the times of a cycle", caption, figure)


def _say_why_empty(axes: Axes, quantity: Quantity, evidence: TimingEvidence) -> None:
    reason = (
        "lockstep has no grid to be late on" if evidence.is_modelled and quantity is LATENESS else "not in this log"
    )
    axes.set_xticks([])
    axes.set_yticks([])
    axes.text(
        0.5, 0.5, reason, transform=axes.transAxes, ha="center", va="center", fontsize=9.0, color=COLOURS["muted"]
    )


def _distribution(axes: Axes, statistics: TimeStatistics, is_reserve: bool) -> None:
    histogram = statistics.histogram
    axes.set_xscale("log")
    axes.set_yscale("log")
    filled = np.flatnonzero(histogram.counts)
    if filled.size:
        places = slice(int(filled[0]), int(filled[-1]) + 1)
        edges = histogram.edges[places.start : places.stop + 1]
        axes.stairs(histogram.counts[places], edges, fill=True, color=COLOURS["bar"], baseline=0.5)
    if histogram.below:
        colour = COLOURS["alarm"] if is_reserve else COLOURS["bar"]
        axes.stairs([histogram.below], _BELOW, fill=True, color=colour, baseline=0.5)
    axes.set_ylim(0.5, 3.0 * max(int(histogram.counts.max()), histogram.below, 1))
    axes.yaxis.set_minor_locator(NullLocator())
    label_decades(axes.yaxis)
    found = statistics.percentiles
    for value_us, (_, line) in zip(found.values(), _LINES, strict=False):
        at_us = value_us if value_us >= _FLOOR_US else _BELOW[0] * 1.3
        axes.axvline(at_us, color=COLOURS["ink"], linewidth=1.0, linestyle=line)
    note(axes, "   ".join(f"{name} {_us_text(value_us)}" for name, value_us in found.items()) + " µs")


def _us_text(value_us: float) -> str:
    """Write a time with the digits that one can use."""
    text = f"{value_us:.1f}" if abs(value_us) < 10.0 and value_us else f"{value_us:,.0f}".replace(",", "\u2009")
    return text.replace("-", "−")


def _label_times(axes: Axes, end_us: float, has_below: bool) -> None:
    """Label the decades, and the bar below them where there is one."""
    decades = [10.0**power for power in range(round(np.log10(end_us)) + 1)]
    labels = {value: _us_text(value).removesuffix(".0") for value in decades}
    if has_below:
        labels = {float(np.sqrt(_BELOW[0] * _BELOW[1])): "<1", **{v: text for v, text in labels.items() if v > 1.0}}
    axes.xaxis.set_major_locator(FixedLocator(list(labels)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: labels.get(value, "")))
    axes.xaxis.set_minor_locator(FixedLocator([k * decade for decade in decades for k in range(2, 10)]))
    axes.tick_params(axis="x", which="minor", length=1.5, width=0.5, color=COLOURS["rule"])


def time_line(columns: CycleColumns, evidence: TimingEvidence, zero_ns: int, zero_name: str) -> Drawing:
    """Draw lateness, SYNC to command and the queues over the run, with the overruns."""
    time_s = np.asarray((columns.t_ns - zero_ns) * 1e-9, dtype=np.float64)
    panels: list[Quantity | None] = [SYNC_TO_COMMAND] if evidence.is_modelled else [LATENESS, SYNC_TO_COMMAND]
    has_queues = any(depth is not None for depth in evidence.queues_bytes.values())
    if has_queues:
        panels.append(None)
    height = 0.8 + 1.45 * len(panels)
    figure = Figure(figsize=(10.0, height))
    grid = figure.subplots(len(panels), 1, squeeze=False)[:, 0]
    figure.subplots_adjust(left=0.062, right=0.985, bottom=0.5 / height, top=1.0 - 0.36 / height, hspace=0.34)
    overruns_s = _overruns(columns, time_s)
    for axes, quantity in zip(grid, panels, strict=True):
        if quantity is None:
            _queue_panel(axes, columns, time_s)
        else:
            _time_panel(axes, columns.times_us(quantity), time_s, quantity, evidence.period_us)
        mark_lane(axes, overruns_s, 0.955, color=COLOURS["alarm"], marker="v", markersize=4.5)
        axes.set_xlim(float(time_s[0]), max(float(time_s[-1]), float(time_s[0]) + 1e-3))
        axes.tick_params(labelbottom=axes is grid[-1])
    label_below(figure, f"time since {zero_name}, s")
    handles = [Line2D([], [], color=COLOURS["alarm"], linewidth=1.0)]
    labels = ["period"]
    if overruns_s.size:
        handles.append(Line2D([], [], color=COLOURS["alarm"], marker="v", markersize=4.5, linestyle="none"))
        labels.append("overrun")
    legend_above(figure, handles, labels, height)
    caption = "The smallest and the largest value of each stretch of time, so that none is lost."
    if evidence.is_modelled:
        caption += " Lockstep: times of the model of bus and host; it has no grid to be late on and no queues."
    elif not has_queues:
        caption += " Queue depths are not in this log."
    return Drawing("timing-line", "Times over the run", caption, figure)


def _overruns(columns: CycleColumns, time_s: Vector) -> Vector:
    """Give the times of overruns, of those that a mark would cover one."""
    at_s = time_s[columns.steps("overruns") > 0]
    width_s = max(float(time_s[-1] - time_s[0]), 1e-9) / _MARKS
    _, first = np.unique((at_s - time_s[0]) // width_s, return_index=True)
    return np.asarray(at_s[first], dtype=np.float64)


def _time_panel(axes: Axes, values_us: Vector | None, time_s: Vector, quantity: Quantity, period_us: float) -> None:
    assert values_us is not None
    shown_us = np.maximum(values_us, _FLOOR_US)
    axes.set_yscale("log")
    _band(axes, time_s, shown_us, COLOURS["bar"])
    axes.axhline(period_us, color=COLOURS["alarm"], linewidth=1.0)
    low_us, high_us = min(float(shown_us.min()), period_us) / 1.5, 2.5 * max(float(shown_us.max()), period_us)
    axes.set_ylim(low_us, high_us)
    steps = (1.0,) if high_us > 100.0 * low_us else (1.0, 2.0, 5.0)
    powers = range(int(np.floor(np.log10(low_us))), int(np.ceil(np.log10(high_us))) + 1)
    _label_levels(axes, [step * 10.0**power for power in powers for step in steps])
    axes.set_ylabel("µs")
    axes.set_title(f"{quantity.title} — {quantity.meaning}")


def _band(axes: Axes, time_s: Vector, values: Vector, colour: str, is_clear: bool = False) -> None:
    """Fill between the smallest and the largest value of each stretch of time; is_clear: lets others shine through."""
    starts = np.arange(0, time_s.size, -(-time_s.size // _BANDS))
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    at_s = np.append(time_s[starts], time_s[-1])
    low, high = np.append(low, low[-1]), np.append(high, high[-1])
    axes.fill_between(
        at_s, low, high, step="post", color=colour, linewidth=0.0 if is_clear else 0.6, alpha=0.22 if is_clear else None
    )
    if is_clear:
        axes.step(at_s, high, where="post", color=colour, linewidth=1.0)


def _label_levels(axes: Axes, levels: list[float]) -> None:
    axes.yaxis.set_major_locator(FixedLocator(levels))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: _short_text(value)))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_label_coords(-0.047, 0.5)


def _short_text(value: float) -> str:
    """Write a level of an axis, from 10 000 on in thousands, from 1 000 000 on in millions."""
    if value >= 1e6:
        return f"{value * 1e-6:g}\u2009M"
    return f"{value * 1e-3:g}\u2009k" if value >= 1e4 else f"{value:g}"


def _queue_panel(axes: Axes, columns: CycleColumns, time_s: Vector) -> None:
    axes.set_yscale("symlog", linthresh=_QUEUE_LINEAR_BYTES, linscale=0.6)
    largest, handles = 0.0, []
    for name, column in QUEUES.items():
        if column in columns:
            depth = columns[column].astype(np.float64)
            _band(axes, time_s, depth, COLOURS[f"queue_{name}"], is_clear=True)
            handles.append(Line2D([], [], color=COLOURS[f"queue_{name}"], linewidth=1.2, label=name))
            largest = max(largest, float(depth.max()))
    top = 10.0 ** np.ceil(np.log10(max(3.0 * largest, 10.0 * _QUEUE_LINEAR_BYTES)))
    axes.set_ylim(-0.08 * _QUEUE_LINEAR_BYTES, top)
    _label_levels(axes, [0.0, *(10.0**power for power in range(2, round(np.log10(top)) + 1))])
    axes.set_ylabel("bytes")
    axes.set_title("Queues — of the bus, to be received and to be sent, and to the log's writer")
    axes.legend(handles=handles, loc="lower right", bbox_to_anchor=(1.0, 1.035), ncols=len(handles), columnspacing=1.6)
