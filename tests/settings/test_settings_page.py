"""Each setting stands on the page of settings, is named where what it does is told or tested, and is read."""

import ast
import re
from pathlib import Path

import settings_page

from adacd_hil.settings.setting_keys import known_keys

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "settings.md"
NAMES = {key.rpartition(".")[2] for key in known_keys()}
NAMED_IN = ("tests/**/*.py", "docs/**/*.md", "README.md", "adacd_hil/configs/*.toml", "docs/examples/**/*.toml")


def test_the_page_is_what_the_declarations_say():
    assert PAGE.read_text(encoding="utf-8") == settings_page.page()


def test_a_setting_is_read_by_the_product():
    files = (path for package in ("adacd_hil", "firmware_sim") for path in (ROOT / package).rglob("*.py"))
    nodes = (node for path in files for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    attributes = (node for node in nodes if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load))
    read = {node.attr for node in attributes}  # what only declares a setting doesn't count
    assert NAMES - read == set()


def test_a_setting_is_named_by_a_test_a_document_or_a_configuration():
    files = {path for pattern in NAMED_IN for path in ROOT.glob(pattern)} - {PAGE, Path(__file__)}
    words = {word for path in files for word in re.findall("[A-Za-z0-9_]+", path.read_text(encoding="utf-8"))}
    assert NAMES - words == set()
