"""A self-contained HTML page and its parts: sections, tables, figures, numbers.

The page needs nothing from outside and allows nothing but what it brings: its styles and scripts by their digests, no
inline style, no request (content security policy). It follows the reader's light or dark scheme and prints in the
light one.
"""

import hashlib
import json
import re
from base64 import b64encode
from collections.abc import Iterable, Sequence
from html import escape
from importlib import resources
from typing import Final

from adacd_hil.analysis.drawing import Drawing

_UNIT: Final = re.compile(r"(?<=\d) (?=(?:s|kg|%)(?!\w))")
"""The space between a number and its unit, where a line must not end."""


STYLE: Final = "report.css"
"""The asset that every page has."""


def document(title: str, parts: Iterable[str], styles: Sequence[str] = (), scripts: Sequence[str] = ()) -> str:
    """Write the page around its parts, empty ones left out; styles, scripts: further assets, by name."""
    sheets = [_asset(name) for name in (*styles, STYLE)]
    programs = [_asset(name) for name in scripts]
    allowed = f"style-src {_digests(sheets)}" + (f"; script-src {_digests(programs)}" if programs else "")
    policy = f"default-src 'none'; {allowed}; base-uri 'none'; form-action 'none'"
    looks = "\n".join(f"<style>{sheet}</style>" for sheet in sheets)
    body = "\n".join(part for part in parts if part)
    ending = "".join(f"<script>{program}</script>\n" for program in programs)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{escape(title)}</title>\n"
        f"{looks}\n</head>\n<body>\n<main>\n{body}\n</main>\n{ending}</body>\n</html>\n"
    )


def _asset(name: str) -> str:
    text = resources.files("adacd_hil.analysis.report").joinpath("assets", name).read_text(encoding="utf-8")
    return f"\n{text.strip()}\n"


def _digests(texts: Iterable[str]) -> str:
    """Write what a content security policy allows these texts by."""
    digests = (b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in texts)
    return " ".join(f"'sha256-{digest}'" for digest in digests)


def data_block(name: str, text: str, kind: str = "text/plain") -> str:
    """Write text that a script reads and nobody sees; the text must not close the element, as base64 can't."""
    return f'<script type="{kind}" id="{escape(name)}">{text}</script>'


def json_block(name: str, value: object) -> str:
    """Write a value that a script reads, whatever texts are in it."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return data_block(name, text.replace("<", "\\u003c"), "application/json")


def heading(over: str, title: str, problems: Iterable[str], is_good: bool) -> str:
    """Write the head of a page: a line over the title, the title, and what is wrong, a line each."""
    lines = "".join(f'<p class="problem">{escape(problem)}</p>\n' for problem in problems)
    tone, word = ("good", "good") if is_good else ("bad", "not good")
    words = _UNIT.sub("&nbsp;", escape(title))
    first = f'<p class="over"><b class="badge">{word}</b> {escape(over)}</p>'
    return f'<header class="{tone}">\n{first}\n<h1>{words}</h1>\n{lines}</header>'


def wrap_section(title: str, *content: str) -> str:
    """Write a section; nothing where all its content is empty."""
    inner = "\n".join(part for part in content if part)
    return f"<section>\n<h2>{escape(title)}</h2>\n{inner}\n</section>" if inner else ""


def embed(drawing: Drawing) -> str:
    """Write a figure with its caption."""
    caption = f"<b>{escape(drawing.title)}.</b> {escape(drawing.caption)}"
    return (
        f'<figure id="{drawing.name}">\n<div class="scroll">{drawing.svg()}</div>\n'
        f"<figcaption>{caption}</figcaption>\n</figure>\n"
    )


Cell = str | tuple[str, str]
"""Text, already escaped, or the text and the class of its cell."""


def make_table(head: Sequence[str], rows: Iterable[Sequence[Cell]], left: Sequence[int] = (0,)) -> str:
    """Write a table; columns are aligned right but those of `left`."""

    def cell(tag: str, content: Cell, column: int) -> str:
        text, kind = content if isinstance(content, tuple) else (content, "")
        names = " ".join(filter(None, ("l" if column in left else "", kind)))
        kinds = f' class="{names}"' if names else ""
        return f"<{tag}{kinds}>{text}</{tag}>"

    def line(tag: str, cells: Sequence[Cell]) -> str:
        return "<tr>" + "".join(cell(tag, content, column) for column, content in enumerate(cells)) + "</tr>"

    body = "\n".join(line("td", row) for row in rows)
    top = f"<thead>{line('th', head)}</thead>\n" if any(head) else ""
    return f'<div class="scroll card"><table>\n{top}<tbody>\n{body}\n</tbody>\n</table></div>'
