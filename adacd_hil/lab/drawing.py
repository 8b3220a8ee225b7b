"""Colours, style and curves of long series shared by all figures, and a drawing as PNG or as a fragment of a page.

Drawn with matplotlib's object interface on a white ground; `svg` makes a fragment for a page instead, whose colours are
the page's own CSS variables and which carries no style, script, date or reference to anything outside.
"""

import io
import json
import math
import re
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Final, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from adacd_hil.file_access import replace_files
from adacd_hil.log.log_files import failing_as
from adacd_hil.records import Vector

# Each colour is written once on paper and once as the page's variable of the same name.
COLOURS: Final = {
    "ink": "#1a2027",
    "muted": "#5a6672",
    "rule": "#c9d0d7",
    "grid": "#e6eaee",
    "identified": "#0067b1",
    "cad": "#d9780a",
    "beside": "#a8327e",
    "joint1": "#00856a",
    "joint2": "#8a4fa3",
    "alarm": "#c4342d",
    "good": "#1b7a43",
    "bar": "#7d8a97",
    "queue_receive": "#2a6f97",
    "queue_transmit": "#b0611a",
    "queue_log": "#6c5fb0",
    "adaptation": "#dcebf8",
    "detection": "#fdfdfe",
    "payload": "#f3ebdb",
    "fault": "#f7dedc",
}
PAPER: Final = "#ffffff"
_DOTS_PER_INCH: Final = 150
_ENVELOPE_BINS: Final = 1000
"""Two points each: as fine as the widest screen on which the report is read."""
PANEL_BINS: Final = 250
"""The same for a panel of which four share the width."""

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
    """Apply the figures' style for a while, whatever the user's own matplotlib configuration says."""
    return mpl.rc_context({**_style(), **(more or {}), "backend": mpl.rcParams["backend"]})


class SvgFragment(NamedTuple):
    """What is within an `svg` element, as markup, and the element's view box."""

    view_box: str
    shapes: str


@dataclass(frozen=True)
class Drawing:
    """A figure with its name, its title and one sentence that says what to see."""

    name: str
    title: str
    caption: str
    figure: Figure

    def png(self) -> bytes:
        """Render on white, 150 dots per inch."""
        out = io.BytesIO()
        with style():
            canvas: Any = FigureCanvasAgg(self.figure)
            self.figure.dpi = _DOTS_PER_INCH
            canvas.print_png(out, metadata={"Software": None})
        return out.getvalue()

    def svg(self) -> SvgFragment:
        """Render a fragment for a page, see the module's first lines. Its ids begin with the figure's name."""
        out = io.StringIO()
        with style({"svg.hashsalt": self.name}):
            canvas: Any = FigureCanvasSVG(self.figure)
            self.figure.patch.set_visible(False)
            canvas.print_svg(out)
            self.figure.patch.set_visible(True)
        return _fragment(out.getvalue(), self.name)


def paper_svg(drawing: Drawing) -> str:
    """Render a drawing as a file of its own, on white, without date."""
    out = io.StringIO()
    with style({"svg.hashsalt": drawing.name}):
        canvas: Any = FigureCanvasSVG(drawing.figure)
        canvas.print_svg(out, metadata={"Date": None})
    return out.getvalue()


def write_figures(out_dir: Path, name: str, described: dict[str, Any], drawings: Iterable[Drawing]) -> tuple[Path, ...]:
    """Write NAME.json, and each drawing as PNG and SVG, into a folder. Raises LogError when they can't be written."""
    contents: dict[str, bytes | str] = {f"{name}.json": json.dumps(described, indent=2, allow_nan=False) + "\n"}
    for drawing in drawings:
        contents |= {f"{drawing.name}.png": drawing.png(), f"{drawing.name}.svg": paper_svg(drawing)}
    with failing_as(f"report in {out_dir} can't be written"):
        return replace_files(out_dir, contents)


_SUPERSCRIPTS: Final = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


def envelope(y: Vector, bins: int = _ENVELOPE_BINS) -> NDArray[np.intp]:
    """Choose the rows that keep the smallest and the largest value of each of `bins` equal parts, and both ends.

    Rows ascend. A series of at most two rows per part is kept whole. NaN is chosen only where a part has nothing else.
    """
    count = y.shape[0]
    width = -(-count // bins)
    if width <= 2:
        return np.arange(count)
    whole = count // width * width
    low = np.where(np.isnan(y), np.inf, y)
    high = np.where(np.isnan(y), -np.inf, y)
    starts = np.arange(0, whole, width)
    chosen = [starts + part[:whole].reshape(-1, width).argmin(axis=1) for part in (low, -high)]
    if whole < count:
        chosen += [[whole + part[whole:].argmin()] for part in (low, -high)]
    return np.unique(np.concatenate([*chosen, [0, count - 1]]))


def plot(axes: Axes, x: Vector, y: Vector, bins: int = _ENVELOPE_BINS, **look: Any) -> None:
    """Draw a curve by the rows of its envelope."""
    rows = envelope(y, bins)
    axes.plot(x[rows], y[rows], **look)


def label_decades(axis: Axis) -> None:
    """Label a logarithmic axis by words: as mathematics its labels take ten times as long to draw."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: _decade_text(value)))


def _decade_text(value: float) -> str:
    power = round(math.log10(value))
    return f"{value:g}" if power < 3 else "10" + str(power).translate(_SUPERSCRIPTS)


def mark_lane(axes: Axes, times: Sequence[float] | Vector, height: float, **marker: Any) -> None:
    """Mark times on a lane of the axes, at a part of their height; marker: of `Axes.plot`."""
    where = np.full(len(times), height)
    axes.plot(times, where, transform=axes.get_xaxis_transform(), linestyle="none", **marker)


def note(axes: Axes, text: str, colour: str = COLOURS["muted"]) -> None:
    """Write above the right end of a panel."""
    axes.annotate(
        text,
        (1.0, 1.0),
        xycoords="axes fraction",
        xytext=(0, 5),
        textcoords="offset points",
        ha="right",
        va="bottom",
        fontsize=7.8,
        color=colour,
    )


def legend_above(figure: Figure, handles: Sequence[Artist], labels: Sequence[str], height: float) -> None:
    """Put the legend above the right end of a figure of `height` inches."""
    figure.legend(
        handles,
        labels,
        loc="upper right",
        bbox_to_anchor=(0.985, 1.0 - 0.06 / height),
        ncols=len(labels),
        columnspacing=1.8,
    )


def label_below(figure: Figure, text: str) -> None:
    """Write one label for the abscissae of all panels."""
    figure.text(
        0.5175, 0.08 / figure.get_figheight(), text, ha="center", va="bottom", fontsize=8.5, color=COLOURS["muted"]
    )


_VARIABLES: Final = {colour: f"var(--{name})" for name, colour in COLOURS.items()} | {PAPER: "var(--paper)"}
_HEAD: Final = re.compile(r".*?<svg[^>]*viewBox=\"([^\"]*)\"[^>]*>", re.DOTALL)
_UNWANTED: Final = re.compile(r"<metadata>.*?</metadata>|<style[^>]*>.*?</style>|<!--.*?-->", re.DOTALL)
_STYLES: Final = re.compile(r' style="([^"]*)"')
_COLOUR: Final = re.compile(r"#[0-9a-f]{6}")
_ID: Final = re.compile(r' id="([^"]*)"')
_USE: Final = re.compile(r'(?:xlink:)?href="#([^"]*)"')
_URL: Final = re.compile(r"url\(#([^)]*)\)")


def _fragment(text: str, name: str) -> SvgFragment:
    """Turn matplotlib's file into a fragment: attributes for styles, variables for colours, ids of its own."""
    head = _HEAD.match(text)
    assert head is not None
    body = _UNWANTED.sub("", text[head.end() :])
    body = _STYLES.sub(_attributes, body)
    used = {found for pattern in (_USE, _URL) for found in pattern.findall(body)}
    body = _ID.sub(lambda m: f' id="{name}-{m[1]}"' if m[1] in used else "", body)
    body = _USE.sub(lambda m: f'href="#{name}-{m[1]}"', body)
    body = _URL.sub(lambda m: f"url(#{name}-{m[1]})", body)
    body = _COLOUR.sub(lambda m: _VARIABLES.get(m[0], m[0]), body)
    body = re.sub(r"\n\s*", "\n", body)
    return SvgFragment(head[1], body.strip().removesuffix("</svg>"))


def _attributes(match: re.Match[str]) -> str:
    """Write a style as presentation attributes, so that a strict content policy need not allow inline styles."""
    attributes = []
    for declaration in match[1].replace("&quot;", "'").split(";"):
        key, _, value = declaration.strip().partition(": ")
        if key == "font":
            attributes += _font(value)
        elif key:
            attributes.append((key, value.strip()))
    return "".join(f' {key}="{value}"' for key, value in attributes)


def _font(value: str) -> list[tuple[str, str]]:
    """Split the shorthand `[italic] [bold] 8.5px family`; the family is the page's own."""
    words = value.split("px", 1)[0].split()
    attributes = [("font-size", words[-1])]
    if "italic" in words or "oblique" in words:
        attributes.append(("font-style", "italic"))
    attributes += [("font-weight", word) for word in words[:-1] if word.isdigit() or word == "bold"]
    return attributes


SIGMAS = 2.0


class HistoryPanel(NamedTuple):
    """One panel: values and their deviations (n, m), a curve for each of m names; nan: not known.

    marks: rows at which something has changed. level: a line to compare with.
    """

    title: str
    names: tuple[str, ...]
    values: Vector
    std: Vector
    marks: tuple[int, ...] = ()
    level: float | None = None


HISTORY_CAPTION: Final = "Bars: two deviations."


def history_figure(
    dates: Sequence[str],
    panels: Sequence[HistoryPanel],
    name: str = "history",
    title: str = "What the arm's runs have certified",
    caption: str = HISTORY_CAPTION,
) -> Drawing:
    """Draw panels over n dates, ISO 8601, with two deviations."""
    at = np.array([date.removesuffix("Z") for date in dates], dtype="datetime64[s]")
    with style():
        figure = Figure(figsize=(7.2, 2.0 * len(panels)), layout="constrained")
        rows = np.atleast_1d(figure.subplots(len(panels), 1, sharex=True))
        for axes, panel in zip(rows, panels, strict=True):
            for row in panel.marks:
                axes.axvline(at[row], color=COLOURS["alarm"], linewidth=0.8, linestyle="--")
            if panel.level is not None:
                axes.axhline(panel.level, color=COLOURS["muted"], linewidth=0.8, linestyle=":")
            for m, label in enumerate(panel.names):
                colour = COLOURS[("joint1", "joint2", "beside")[m % 3]]
                axes.errorbar(
                    at, panel.values[:, m], SIGMAS * panel.std[:, m], marker="o", ms=3, lw=1, capsize=2, color=colour,
                    label=label,
                )  # fmt: skip
            axes.set_title(panel.title, loc="left")
            axes.grid(color=COLOURS["grid"])
            axes.margins(x=0.02)
            axes.legend(frameon=False, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(panel.names))
        rows[-1].tick_params(axis="x", rotation=20)
    return Drawing(name, title, caption, figure)
