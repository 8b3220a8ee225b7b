"""A report to be printed or sent on: report.pdf, the words and a page per figure, and report.png, all on one picture.

The same log gives the same bytes.
"""

import io
import textwrap
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.image import imsave
from numpy.typing import NDArray

from adacd_hil.analysis.drawing import COLOURS, Drawing, style

_WIDTH_IN: Final = 10.0
"""That of all figures."""
_LINES_A_PAGE: Final = 62
_LINE_IN: Final = 0.105
_FONT_SIZE: Final = 5.6
_VERDICT_LETTERS: Final = 96
_PNG_DOTS_PER_INCH: Final = 110
_ROOM_IN: Final = 0.32
"""Above each figure, for its title."""


def report_pdf(verdict: str, is_good: bool, lines: Sequence[str], drawings: Sequence[Drawing]) -> bytes:
    """Write verdict and tables, as many pages as they need, then a page per figure."""
    out = io.BytesIO()
    metadata: Any = {"CreationDate": None, "Creator": "adacd-hil"}  # None: without it
    with style(), PdfPages(out, metadata=metadata) as pages:
        for figure in _word_pages(verdict, is_good, lines):
            pages.savefig(figure)
        for drawing in drawings:
            pages.savefig(drawing.figure)
    return out.getvalue()


def report_png(verdict: str, is_good: bool, drawings: Sequence[Drawing]) -> bytes:
    """Draw the verdict and all figures below one another, each with its title."""
    with style():
        strips = [_pixels(_head(verdict, is_good))]
        for drawing in drawings:
            strips += [_pixels(_title(drawing.title)), _pixels(drawing.figure)]
    width = max(strip.shape[1] for strip in strips)
    sheet = np.full((sum(len(strip) for strip in strips), width, 4), 255, np.uint8)
    row = 0
    for strip in strips:
        sheet[row : row + len(strip), : strip.shape[1]] = strip
        row += len(strip)
    out = io.BytesIO()
    without_versions: Any = {"Software": None}
    imsave(out, sheet, format="png", metadata=without_versions)
    return out.getvalue()


def _pixels(figure: Figure) -> NDArray[np.uint8]:
    canvas: Any = FigureCanvasAgg(figure)
    figure.dpi = _PNG_DOTS_PER_INCH
    canvas.draw()
    return np.array(canvas.buffer_rgba())


def _word_pages(verdict: str, is_good: bool, lines: Sequence[str]) -> Iterator[Figure]:
    for first in range(0, max(len(lines), 1), _LINES_A_PAGE):
        chosen = lines[first : first + _LINES_A_PAGE]
        head = _head(verdict, is_good) if first == 0 else Figure(figsize=(_WIDTH_IN, 0.4))
        top_in = head.get_figheight()
        height_in = top_in + _LINE_IN * (len(chosen) + 4)
        head.set_figheight(height_in)
        for text in head.texts:
            text.set_y(1.0 - 0.35 / height_in)
        for number, line in enumerate(chosen):
            y = 1.0 - (top_in + _LINE_IN * number) / height_in
            head.text(0.04, y, line, fontsize=_FONT_SIZE, family="DejaVu Sans Mono", va="top", parse_math=False)
        yield head


def _head(verdict: str, is_good: bool) -> Figure:
    """Write the verdict, in the colour and the words of whether it is good."""
    words = textwrap.wrap(verdict, _VERDICT_LETTERS)
    figure = Figure(figsize=(_WIDTH_IN, 0.55 + 0.24 * len(words)))
    colour = COLOURS["good" if is_good else "alarm"]
    height_in = figure.get_figheight()
    text = "\n".join([("Good: " if is_good else "Not good: ") + words[0], *words[1:]])
    figure.text(
        0.04, 1.0 - 0.35 / height_in, text, fontsize=12, fontweight="bold", color=colour, va="top", parse_math=False
    )
    return figure


def _title(title: str) -> Figure:
    figure = Figure(figsize=(_WIDTH_IN, _ROOM_IN))
    figure.text(0.04, 0.25, title, fontsize=10.5, fontweight="bold", va="bottom", parse_math=False)
    return figure
