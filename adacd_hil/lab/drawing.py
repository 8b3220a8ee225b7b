"""Colours, style and curves of figures that are files of their own, PNG and SVG; pages draw by their script.

Drawn with matplotlib's object interface on a white ground.
"""

import io
import re
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from numpy.typing import NDArray

from adacd_hil.file_replacement import replace_files
from adacd_hil.log.log_files import failing_as
from adacd_hil.plain_values import json_text
from adacd_hil.records import Vector
from adacd_hil.score.emulator_truth import extreme_rows

_ON_WHITE: Final = (resources.files("adacd_hil.lab.report") / "assets/report.css").read_text("utf-8").partition("}")[0]
COLOURS: Final[dict[str, str]] = dict(re.findall(r"--(\w+): (#\w+)", _ON_WHITE))
"""Those of the pages, by their names."""
_DOTS_PER_INCH: Final = 150
ENVELOPE_BINS: Final = 1000
"""Two points each: as fine as the widest screen on which the report is read."""

_COLOURED: Final = {
    "axes.labelcolor": COLOURS["muted"],
    "axes.edgecolor": COLOURS["rule"],
    "axes.titlecolor": COLOURS["ink"],
    "grid.color": COLOURS["grid"],
    "text.color": COLOURS["ink"],
    "xtick.color": COLOURS["rule"],
    "ytick.color": COLOURS["rule"],
    "xtick.labelcolor": COLOURS["muted"],
    "ytick.labelcolor": COLOURS["muted"],
}


@cache
def _style() -> dict[Any, Any]:
    with resources.as_file(resources.files("adacd_hil.lab") / "figures.mplstyle") as file:
        return {**mpl.rcParamsDefault, **mpl.rc_params_from_file(file, use_default_template=False), **_COLOURED}


def style(more: dict[Any, Any] | None = None) -> AbstractContextManager[None]:
    """Return a context manager that applies the figures' style in place of the user's matplotlib configuration.

    The backend stays. more: rcParams that override the style's; a backend in it has no effect.
    """
    return mpl.rc_context({**_style(), **(more or {}), "backend": mpl.rcParams["backend"]})


@dataclass(frozen=True)
class Drawing:
    """A figure with the name of its files, its title and a caption."""

    name: str
    title: str
    caption: str
    figure: Figure

    def png(self) -> bytes:
        """Return the figure as PNG, on white, with `_DOTS_PER_INCH`; the figure keeps that resolution."""
        out = io.BytesIO()
        with style():
            canvas: Any = FigureCanvasAgg(self.figure)
            self.figure.dpi = _DOTS_PER_INCH
            canvas.print_png(out, metadata={"Software": None})
        return out.getvalue()


def paper_svg(drawing: Drawing) -> str:
    """Return a drawing as the text of an SVG file, on white, without a date.

    Its ids come from the drawing's name, so the same drawing gives the same text.
    """
    out = io.StringIO()
    with style({"svg.hashsalt": drawing.name}):
        canvas: Any = FigureCanvasSVG(drawing.figure)
        canvas.print_svg(out, metadata={"Date": None})
    return out.getvalue()


def write_figures(out_dir: Path, name: str, described: dict[str, Any], drawings: Iterable[Drawing]) -> tuple[Path, ...]:
    """Write NAME.json, and each drawing by its own name as PNG and SVG, into a folder; return the files' paths.

    The folder is made if missing; files of these names are replaced. described: content of NAME.json. Raises LogError
    if a file can't be written.
    """
    contents: dict[str, bytes | str] = {f"{name}.json": json_text(described) + "\n"}
    for drawing in drawings:
        contents |= {f"{drawing.name}.png": drawing.png(), f"{drawing.name}.svg": paper_svg(drawing)}
    with failing_as(f"report in {out_dir} can't be written"):
        return replace_files(out_dir, contents)


def envelope(y: Vector) -> NDArray[np.int64]:
    """Return indices of y (k,), ascending: both ends, and the extremes of each of `ENVELOPE_BINS` parts at most.

    The parts are equally long, except the last. A series with at most two values per part is returned whole. NaN is
    never smallest or largest.
    """
    width = -(-len(y) // ENVELOPE_BINS)
    if width <= 2:
        return np.arange(len(y))
    return np.union1d(extreme_rows([y], np.arange(0, len(y), width)), [0, len(y) - 1])


def plot(axes: Axes, x: Vector, y: Vector, **look: Any) -> None:
    """Draw y over x, both (k,), on the axes, by the points of y's `envelope` only. look: as of `Axes.plot`."""
    rows = envelope(y)
    axes.plot(x[rows], y[rows], **look)


def note(axes: Axes, text: str) -> None:
    """Write a text above the upper right corner of a panel."""
    axes.annotate(
        text,
        (1.0, 1.0),
        xycoords="axes fraction",
        xytext=(0, 5),
        textcoords="offset points",
        ha="right",
        va="bottom",
        fontsize=7.8,
        color=COLOURS["muted"],
    )


SIGMAS = 2.0


HistoryPanel = tuple[str, tuple[str, ...], Vector, Vector]
"""A panel: title, names of m curves, their values and deviations (n, m); nan: not known."""


def history_figure(dates: Sequence[str], panels: Sequence[HistoryPanel]) -> Drawing:
    """Return a drawing of panels below each other: values over n dates (ISO 8601), with bars of two deviations.

    A panel has at most three curves. A "Z" at the end of a date is left out.
    """
    at = np.array([date.removesuffix("Z") for date in dates], dtype="datetime64[s]")
    with style():
        figure = Figure(figsize=(7.2, 2.0 * len(panels)), layout="constrained")
        rows = np.atleast_1d(figure.subplots(len(panels), 1, sharex=True))
        for axes, (title, names, values, std) in zip(rows, panels, strict=True):
            for m, label in enumerate(names):
                colour = COLOURS[("joint1", "joint2", "beside")[m]]
                axes.errorbar(
                    at, values[:, m], SIGMAS * std[:, m], marker="o", ms=3, lw=1, capsize=2, color=colour,
                    label=label,
                )  # fmt: skip
            axes.set_title(title, loc="left")
            axes.grid(color=COLOURS["grid"])
            axes.margins(x=0.02)
            axes.legend(frameon=False, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(names))
        rows[-1].tick_params(axis="x", rotation=20)
    return Drawing("history", "What the arm's runs have certified", "Bars: two deviations.", figure)
