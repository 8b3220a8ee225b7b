"""tools/prose.py finds turns of phrase in docstrings and comments, and counts them per 1000 words."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
import prose

ROOT = Path(__file__).parents[2]
MOST_PER_1000_WORDS = {"relative clause as subject": 0.5, "what": 3.0, "hearsay": 0.3}
PAGES = ("docs", "README.md", "CONTRIBUTING.md", "CHANGELOG.md")
SOURCE = '''"""What is sent.

Where the bus is silent, nobody is told what happened.
"""

import os  # says so

NAME = "What is through"  # fine
'''


def test_each_place_is_listed_with_its_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    module = tmp_path / "module.py"
    module.write_text(SOURCE)
    assert prose.main([str(tmp_path)]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert [line.removeprefix(str(module)).split(": ")[:2] for line in shown[:-5]] == [
        [":1", "relative clause as subject"],
        [":3", "relative clause as subject"],
        [":1", "what"],
        [":3", "what"],
        [":3", "hearsay"],
        [":3", "is no, nobody, nothing, none"],
        [":6", "hearsay"],
    ]


@pytest.mark.slow
@pytest.mark.parametrize("tops", [("adacd_hil", "firmware_sim"), PAGES], ids=["code", "pages"])
def test_code_and_pages_keep_to_plain_sentences(tops: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert prose.main(["--figures", *(str(ROOT / top) for top in tops)]) == 0
    lines = capsys.readouterr().out.splitlines()[1:]
    figures = {
        name: float(line.removeprefix(name).split()[0]) for name in prose.PATTERNS for line in lines if name in line
    }
    assert {name: figures[name] for name, most in MOST_PER_1000_WORDS.items() if figures[name] > most} == {}
