"""The documentation's site. `make docs` builds it with Sphinx from the same pages that a code host shows."""

import tomllib
from pathlib import Path

from sphinx.application import Sphinx

ROOT = Path(__file__).parent.parent

project = "adacd-hil"
author = "the adacd-hil authors"
version = release = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]

extensions = ["myst_parser"]
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
    """Lead links out of `docs/` to the site's own pages."""
    app.connect("source-read", _lead_inside)


def _lead_inside(_app: Sphinx, _page: str, source: list[str]) -> None:
    for outside, inside in OUTSIDE.items():
        source[0] = source[0].replace(outside, inside)
