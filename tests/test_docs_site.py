"""The documentation's site is built from every page, without a warning: no broken link, no page left out."""

import shutil
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


@pytest.mark.slow
def test_a_broken_link_is_found(tmp_path):
    pages = tmp_path / "docs"
    pages.mkdir()
    for name in ("adacd_hil", "pyproject.toml"):
        (tmp_path / name).symlink_to(ROOT / name)
    for name in ("conf.py", "scheme.md"):
        shutil.copy(ROOT / "docs" / name, pages)
    (pages / "index.md").write_text(
        "# Contents\n\n```{toctree}\nscheme\n```\n\n[x](no-such-page.md) [y](scheme.md#no-such-heading)\n"
    )
    (pages / "stray.md").write_text("# A page that nothing leads to\n")
    complaints = build(pages, tmp_path / "site")
    assert "no-such-page" in complaints
    assert "no-such-heading" in complaints
    assert "stray.md" in complaints
