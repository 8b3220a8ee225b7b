"""tools/prose.py finds turns of phrase in docstrings and comments, and counts them per 1000 words."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
import prose

ROOT = Path(__file__).parents[2]
MOST_PER_1000_WORDS = {"relative clause as subject": 0.5, "what": 3.0, "hearsay": 0.3}
PAGES = ("docs", "README.md", "CONTRIBUTING.md", "CHANGELOG.md")


@pytest.mark.slow
@pytest.mark.parametrize("tops", [("adacd_hil", "firmware_sim"), PAGES], ids=["code", "pages"])
def test_code_and_pages_keep_to_plain_sentences(tops: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert prose.main(["--figures", *(str(ROOT / top) for top in tops)]) == 0
    lines = capsys.readouterr().out.splitlines()[1:]
    figures = {
        name: float(line.removeprefix(name).split()[0]) for name in prose.PATTERNS for line in lines if name in line
    }
    assert min(figures.values()) > 0.0  # they are found at all
    assert {name: figures[name] for name, most in MOST_PER_1000_WORDS.items() if figures[name] > most} == {}
