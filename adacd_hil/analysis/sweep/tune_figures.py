"""Figures of a tuning: what is found against false alarms, and how late, and the files of its report."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from adacd_hil.analysis.drawing import COLOURS, Drawing, note, style
from adacd_hil.analysis.sweep.tune_roc import Choice, Tuning
from adacd_hil.analysis.thresholds.detector_comparison import paper_svg
from adacd_hil.file_access import replace_file
from adacd_hil.log.log_files import LogError

_LOOKS: Final = ("identified", "cad", "joint1", "joint2", "bar", "queue_log", "beside", "queue_receive", "muted")

_LEAST_RATE: Final = 1e-6
"""Per hour; what the model predicts below this nobody will ever check."""


def curves(tuning: Tuning) -> list[tuple[str, Choice]]:
    """Return what is drawn: the suggestion or else the logs' own filter, then the detectors."""
    scheme = tuning.best or tuning.candidates[0]
    return [(f"scheme: {scheme.name}", scheme.choice), *((choice.name, choice) for choice in tuning.detectors)]


def draw_roc(tuning: Tuning) -> Drawing:
    """Draw the share of contacts found against the upper bound of the rate that was counted; without truth, rates."""
    with style():
        figure = Figure(figsize=(10.0, 4.6))
        axes = figure.subplots()
        figure.subplots_adjust(left=0.065, right=0.72, bottom=0.12, top=0.9)
        for (name, choice), colour in zip(curves(tuning), ("alarm", *_LOOKS), strict=False):
            found = [each for _, each, _ in choice.roc]
            bounds = np.array([each.rate_bound_per_h for each in found])
            look: dict[str, Any] = {
                "color": COLOURS[colour],
                "linewidth": 2.0 if colour == "alarm" else 1.1,
                "label": name,
            }
            if found[0].contacts is None:
                axes.plot([factor for factor, _, _ in choice.roc], bounds, **look)
                continue
            shares = np.array([len(each.delays_ms) / max(each.contacts or 0, 1) for each in found])
            axes.plot(bounds, 100.0 * shares, marker="o", markersize=3.0, **look)
            predicted = [np.nan if rate is None or rate < _LEAST_RATE else rate for _, _, rate in choice.roc]
            axes.plot(predicted, 100.0 * shares, linestyle=":", **(look | {"label": None}))
            if colour == "alarm":
                low, high = np.array([each.share_bounds for each in found]).T
                axes.fill_between(bounds, 100.0 * low, 100.0 * high, color=COLOURS[colour], alpha=0.12, linewidth=0.0)
        has_truth = tuning.candidates[0].choice.chosen.contacts is not None
        bound_label = "false alarms per hour, upper 95 % bound of what was counted"
        if has_truth:
            axes.set(xscale="log", ylim=(-3.0, 103.0), xlabel=bound_label, ylabel="contacts found, %")
        else:
            axes.set(xscale="log", yscale="log", xlabel="factor on the thresholds", ylabel=bound_label)
        axes.set_title("False alarms and contacts found")
        note(axes, "counted where nothing was chosen; dotted: the tail model's prediction")
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
        hours = tuning.candidates[0].choice.checked.hours
        caption = (
            f"All thresholds of a detector times one factor. {hours:.3f} h without an alarm leave a bound of "
            f"{3.0 / hours:.3g} per hour, further left nothing can be counted."
            if hours > 0.0
            else "All thresholds of a detector times one factor."
        )
        return Drawing("roc", "False alarms and contacts found", caption, figure)


def draw_delays(tuning: Tuning) -> Drawing:
    """Draw the share of all contacts that is found within a time, at the chosen thresholds."""
    with style():
        figure = Figure(figsize=(10.0, 4.6))
        axes = figure.subplots()
        figure.subplots_adjust(left=0.065, right=0.72, bottom=0.12, top=0.9)
        for (name, choice), colour in zip(curves(tuning), ("alarm", *_LOOKS), strict=False):
            delays, contacts = _delays(choice)
            shares = 100.0 * np.arange(len(delays) + 1) / max(contacts, 1)
            axes.step(
                [0.0, *delays],
                shares,
                where="post",
                color=COLOURS[colour],
                linewidth=2.0 if colour == "alarm" else 1.1,
                label=name,
            )
        axes.set(ylim=(-3.0, 103.0), xlabel="time since the onset, ms", ylabel="contacts found, %")
        axes.set_title("Delay at the chosen thresholds")
        note(axes, f"for {tuning.rate_per_h:g} false alarms per hour")
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
        caption = "Contacts of all logs; what a curve lacks to 100 % is never found."
        return Drawing("delays", "Delay at the chosen thresholds", caption, figure)


def _delays(choice: Choice) -> tuple[Sequence[float], int]:
    halves = (choice.chosen, choice.checked)
    return sorted(delay for half in halves for delay in half.delays_ms), sum(half.contacts or 0 for half in halves)


def write_tuning(tuning: Tuning, out_dir: Path) -> tuple[Path, ...]:
    """Write tune.json, and the figures as PNG and SVG, into a folder. Raises LogError when they can't be written."""
    drawings = [draw_roc(tuning)]
    if tuning.candidates[0].choice.chosen.contacts:
        drawings.append(draw_delays(tuning))
    contents = {"tune.json": (json.dumps(tuning.as_json(), indent=2, allow_nan=False) + "\n").encode()}
    for drawing in drawings:
        contents |= {f"{drawing.name}.png": drawing.png(), f"{drawing.name}.svg": paper_svg(drawing).encode()}
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
        for name, content in contents.items():
            replace_file(out_dir / name, content)
    except OSError as error:
        raise LogError(f"report in {out_dir} can't be written: {error.strerror}") from None
    return tuple(out_dir / name for name in contents)
