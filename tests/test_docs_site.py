"""The documentation's site is built from every page, without a warning: no broken link, no page left out."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def build(pages: Path, out: Path) -> str:
    """Build the site; return what Sphinx complains of."""
    words = ["--quiet", "--keep-going", "--no-color", str(pages), str(out)]
    built = subprocess.run([sys.executable, "-m", "sphinx", *words], capture_output=True, text=True, check=True)
    return built.stderr


@pytest.mark.slow
def test_every_page_and_notebook_is_in_the_site_and_links_lead_inside(tmp_path):
    site = tmp_path / "site"
    assert build(ROOT / "docs", site) == ""
    pages = {
        path.relative_to(ROOT / "docs").with_suffix(".html")
        for pattern in ("*.md", "*.ipynb")
        for path in (ROOT / "docs").rglob(pattern)
        if not path.is_relative_to(ROOT / "docs" / "_site")
    }
    assert {page for page in pages if not (site / page).is_file()} == set()
    contributing = (site / "contributing.html").read_text()
    assert "How a change lands" in contributing
    assert 'href="timing.html"' in contributing
    assert 'href="contributing.html"' in (site / "adding-things.html").read_text()
    notebook = (site / "notebooks" / "a-run.html").read_text()
    assert "8 contacts, 2 certificates" in notebook
    assert notebook.count('src="data:image/png;base64,') == 2
    assert 'href="../api.html"' in notebook
