"""Quantities of an arm from certificate to certificate."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from adacd_hil.analysis.drawing import COLOURS, Drawing, style
from adacd_hil.records import Vector

SIGMAS = 2.0


class Panel(NamedTuple):
    """One panel: values and their deviations (n, m), a curve for each of m names."""

    title: str
    names: tuple[str, ...]
    values: Vector
    std: Vector


def history_figure(dates_utc: Sequence[str], panels: Sequence[Panel]) -> Drawing:
    """Draw panels over the dates of n certificates, ISO 8601, with two deviations."""
    at = np.array([date.removesuffix("Z") for date in dates_utc], dtype="datetime64[s]")
    with style():
        figure = Figure(figsize=(7.2, 2.0 * len(panels)), layout="constrained")
        rows = np.atleast_1d(figure.subplots(len(panels), 1, sharex=True))
        for axes, panel in zip(rows, panels, strict=True):
            for m, name in enumerate(panel.names):
                colour = COLOURS[("joint1", "joint2", "beside")[m % 3]]
                axes.errorbar(
                    at, panel.values[:, m], SIGMAS * panel.std[:, m], marker="o", ms=3, lw=1, capsize=2, color=colour,
                    label=name,
                )  # fmt: skip
            axes.set_title(panel.title, loc="left")
            axes.grid(color=COLOURS["grid"])
            axes.legend(frameon=False, loc="upper left")
        rows[-1].tick_params(axis="x", rotation=20)
    return Drawing("history", "What the arm's runs have certified", "Bars: two deviations.", figure)
