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


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    out = tmp_path_factory.mktemp("site")
    assert build(ROOT / "docs", out) == ""
    return out


def test_every_page_is_in_the_site(site):
    pages = {
        path.relative_to(ROOT / "docs").with_suffix(".html")
        for pattern in ("*.md", "*.ipynb")
        for path in (ROOT / "docs").rglob(pattern)
        if not path.is_relative_to(ROOT / "docs" / "_site")
    }
    assert {page for page in pages if not (site / page).is_file()} == set()


def test_pages_outside_of_the_folder_are_in_the_site_and_their_links_lead_inside(site):
    contributing = (site / "contributing.html").read_text()
    assert "How a change lands" in contributing
    assert 'href="timing.html"' in contributing
    assert 'href="contributing.html"' in (site / "adding-things.html").read_text()


def test_a_notebook_is_in_the_site_with_what_it_prints_and_draws(site):
    page = (site / "notebooks" / "a-run.html").read_text()
    assert "8 contacts, 2 certificates" in page
    assert page.count('src="data:image/png;base64,') == 2
    assert 'href="../api.html"' in page


def test_a_broken_link_is_found(tmp_path):
    for name in ("adacd_hil", "CONTRIBUTING.md", "CHANGELOG.md", "pyproject.toml"):
        (tmp_path / name).symlink_to(ROOT / name)
    pages = tmp_path / "docs"
    shutil.copytree(ROOT / "docs", pages, ignore=shutil.ignore_patterns("_site"))
    glossary = pages / "glossary.md"
    glossary.write_text(f"{glossary.read_text()}\n[x](no-such-page.md) [y](scheme.md#no-such-heading)\n")
    (pages / "stray.md").write_text("# A page that nothing leads to\n")
    complaints = build(pages, tmp_path / "site")
    assert "no-such-page" in complaints
    assert "no-such-heading" in complaints
    assert "stray.md" in complaints
