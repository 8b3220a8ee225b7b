"""Pages from the Jinja2 templates in `templates`: the forms that all of them share, and the only place that renders.

A page needs nothing from outside and allows nothing but what it brings: its styles and scripts by their digests, no
inline style, no request (content security policy). Every value is escaped; where a template marks one as safe, it says
why it is. A template that asks for a value that it isn't given is an error. Pages follow the reader's light or dark
scheme and print in the light one.
"""

import hashlib
import re
from base64 import b64encode
from collections.abc import Iterable, Sequence
from functools import cache
from importlib import resources
from typing import Any, Final, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined

from adacd_hil.analysis.report.words import number_text

_PACKAGE: Final = "adacd_hil.analysis.report"
_UNIT: Final = re.compile(r"(?<=\d) (?=(?:s|kg|%)(?!\w))")
"""The space between a number and its unit, where a line must not end."""


class Heading(NamedTuple):
    """The head of a page: a line over the title, the title, and what is wrong, a line each."""

    over: str
    title: str
    problems: Sequence[str]
    is_good: bool


class Cell(NamedTuple):
    """What a cell of a table shows, and its class."""

    content: object
    kind: str = ""


class Table(NamedTuple):
    """A table; columns are aligned right but those of `left`. head: empty where it has none."""

    head: Sequence[Cell]
    rows: Sequence[Sequence[Cell]]
    left: Sequence[int]


def make_table(head: Sequence[object], rows: Iterable[Sequence[object]], left: Sequence[int] = (0,)) -> Table:
    """Make a table of cells, and of contents of cells without a class."""

    def line(contents: Sequence[object]) -> list[Cell]:
        return [content if isinstance(content, Cell) else Cell(content) for content in contents]

    return Table(line(head), [line(row) for row in rows], left)


class _Asset(NamedTuple):
    """A style or a script, and the digest by which the content security policy allows it."""

    text: str
    digest: str


def render_page(
    template: str, title: str, heading: Heading, styles: Sequence[str] = (), scripts: Sequence[str] = (), **values: Any
) -> str:
    """Write a page whose template extends `page.html.j2`; styles, scripts: further assets, by name."""
    sheets, programs = ([_asset(name) for name in names] for names in ((*styles, "report.css"), scripts))
    return render(template, title=title, heading=heading, styles=sheets, scripts=programs, **values)


def render(template: str, **values: Any) -> str:
    """Write a template with these values."""
    return _environment().get_template(template).render(values) + "\n"


@cache
def _environment() -> Environment:
    loader = PackageLoader(_PACKAGE)
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"number": number_text, "keep_units": lambda text: _UNIT.sub("\u00a0", text)}
    environment.policies["json.dumps_kwargs"] = {
        "ensure_ascii": False, "allow_nan": False, "separators": (",", ":"),
    }  # fmt: skip
    return environment


@cache
def _asset(name: str) -> _Asset:
    text = f"\n{resources.files(_PACKAGE).joinpath('assets', name).read_text(encoding='utf-8').strip()}\n"
    return _Asset(text, b64encode(hashlib.sha256(text.encode()).digest()).decode())
