"""The documentation's site. `make docs` builds it with Sphinx from the same pages that a code host shows."""

import json
import tomllib
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

ROOT = Path(__file__).parent.parent

project = "adacd-hil"
author = "the adacd-hil authors"
version = release = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]

extensions = ["myst_parser"]
source_suffix = {".md": "markdown", ".ipynb": "markdown"}
root_doc = "index"
exclude_patterns = ["examples", "_site"]
nitpicky = True
myst_heading_anchors = 4  # links to headings, as code hosts make them

html_theme = "furo"
html_title = "adacd-hil"
html_copy_source = False
html_show_sphinx = False

OUTSIDE = {"](../CONTRIBUTING.md": "](contributing.md", "](../README.md": "](index.md"}
"""Links that lead out of `docs/` on a code host, and where they lead within the site."""


def setup(app: Sphinx) -> None:
    """Take notebooks as pages, and lead links out of `docs/` to the site's own pages."""
    app.connect("source-read", _as_page)


def _as_page(app: Sphinx, page: str, source: list[str]) -> None:
    if str(app.env.doc2path(page)).endswith(".ipynb"):
        source[0] = "\n\n".join(text for cell in json.loads(source[0])["cells"] for text in _pieces(cell))
    for outside, inside in OUTSIDE.items():
        source[0] = source[0].replace(outside, inside)


def _pieces(cell: dict[str, Any]) -> list[str]:
    """Write a cell of a notebook as Markdown, with the outputs that are stored in it."""
    text = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        return [text]
    printed = ["".join(output["text"]) for output in cell["outputs"] if "text" in output]
    drawn = [output["data"]["image/png"] for output in cell["outputs"] if "data" in output]
    return [
        f"```python\n{text}\n```",
        *(f"```text\n{each}```" for each in printed),
        *(f"![what the cell above draws](data:image/png;base64,{each})" for each in drawn),
    ]
