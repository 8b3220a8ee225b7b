"""A page that names a setting with a number beside it, as in `patience_s` (10 s), has the default's number."""

import re
from collections import defaultdict
from pathlib import Path

import pytest

from adacd_hil.settings.setting_keys import known_keys

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
_NUMBERED = re.compile(r"`([a-zA-Z_.]+)` [\[(](\d[^\])]*)[\])]")
_NUMBER = re.compile(r"\d+(?:\.\d+)?")


def wrong_defaults(text: str) -> list[str]:
    """Return each setting with numbers that are no default of its name, as written; a number may be in thousandths."""
    named = defaultdict(set)
    for known in known_keys().values():
        for name in (known.key, known.key.rpartition(".")[2]):
            named[name] |= {float(number) for number in _NUMBER.findall(known.default)}
    return [
        found[0]
        for found in _NUMBERED.finditer(text)
        if named.get(found[1])
        and not all({number, number / 1000.0} & named[found[1]] for number in map(float, _NUMBER.findall(found[2])))
    ]


@pytest.mark.parametrize("page", PAGES, ids=[page.name for page in PAGES])
def test_a_default_in_a_page_is_the_settings(page):
    assert wrong_defaults(page.read_text()) == []


def test_a_stale_default_is_found():
    assert wrong_defaults("lasts `patience_s` (11 s), `certified.dahl_rad` [1, 4 mrad]") == ["`patience_s` (11 s)"]
