"""Each setting stands on the page of settings, is named where what it does is told or tested, and is read."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest
import settings_page

from adacd_hil.settings.setting_keys import known_keys

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "settings.md"
KEYS = list(known_keys())
NAMED_IN = ("tests/**/*.py", "docs/**/*.md", "README.md", "adacd_hil/configs/*.toml", "docs/examples/**/*.toml")


@pytest.fixture(scope="module")
def read_names() -> set[str]:
    """Names of all attributes that the product reads, but for what it declares."""
    files = (path for package in ("adacd_hil", "firmware_sim") for path in (ROOT / package).rglob("*.py"))
    trees = (ast.parse(path.read_text(encoding="utf-8")) for path in files)
    return {
        node.attr
        for tree in trees
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load)
    }


@pytest.fixture(scope="module")
def words() -> set[str]:
    """Words of tests, documents and configurations, without the page that lists every setting."""
    files = {path for pattern in NAMED_IN for path in ROOT.glob(pattern)} - {PAGE, Path(__file__)}
    return {word for path in files for word in re.findall("[A-Za-z0-9_]+", path.read_text(encoding="utf-8"))}


def test_the_page_is_what_the_declarations_say() -> None:
    assert PAGE.read_text(encoding="utf-8") == settings_page.page()


def test_the_tool_prints_the_page() -> None:
    done = subprocess.run([sys.executable, settings_page.__file__], capture_output=True, check=True)
    assert done.stdout.decode() == settings_page.page()


@pytest.mark.parametrize("key", KEYS)
def test_a_setting_is_read_by_the_product(key: str, read_names: set[str]) -> None:
    assert key.rpartition(".")[2] in read_names


@pytest.mark.parametrize("key", KEYS)
def test_a_setting_is_named_by_a_test_a_document_or_a_configuration(key: str, words: set[str]) -> None:
    assert key.rpartition(".")[2] in words
