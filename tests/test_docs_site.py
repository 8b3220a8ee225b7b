"""The documentation's site is built from every page, without a warning: no broken link, no page left out."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def with_readme(folder: Path) -> Path:
    """Copy what the site is made of, the README as one more page; return the folder of the pages."""
    pages = folder / "docs"
    shutil.copytree(ROOT / "docs", pages, ignore=shutil.ignore_patterns("_site"))
    for path in ROOT.iterdir():
        if path.is_file():
            shutil.copy(path, folder)
        elif path.name in ("adacd_hil", "firmware_sim", "dbc", "tests", "tools"):
            (folder / path.name).symlink_to(path)
    links = re.compile(r"\]\((?!http)(docs/)?")
    readme = links.sub(lambda found: "](" if found[1] else "](../", (ROOT / "README.md").read_text())
    (pages / "readme.md").write_text(f"---\norphan: true\n---\n{readme}")
    return pages


def build(pages: Path, out: Path) -> str:
    """Build the site; return what Sphinx complains of."""
    words = ["--quiet", "--keep-going", "--no-color", str(pages), str(out)]
    built = subprocess.run([sys.executable, "-m", "sphinx", *words], capture_output=True, text=True, check=True)
    return built.stderr


@pytest.mark.slow
def test_every_page_and_notebook_is_in_the_site_and_links_lead_inside(tmp_path):
    pages, site = with_readme(tmp_path), tmp_path / "site"
    assert build(pages, site) == ""
    written = [path for pattern in ("*.md", "*.ipynb") for path in pages.rglob(pattern)]
    assert [path for path in written if not (site / path.relative_to(pages)).with_suffix(".html").is_file()] == []
    contributing = (site / "contributing.html").read_text()
    assert "How a change lands" in contributing
    assert 'href="timing.html"' in contributing
    assert 'href="contributing.html"' in (site / "adding-things.html").read_text()
    assert 'href="index.html"' in (site / "readme.html").read_text()
    notebook = (site / "notebooks" / "a-run.html").read_text()
    assert "8 contacts, 2 certificates" in notebook
    assert notebook.count('src="data:image/png;base64,') == 2
    assert 'href="../api.html"' in notebook
