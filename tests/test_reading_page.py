"""The page that walks one torque frame through the code names files and lines that are there."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGE = (ROOT / "docs" / "reading.md").read_text(encoding="utf-8")
STOPS = re.findall(r"^\d+\. `([^`]+)`, line `([^`]+)`:", PAGE, re.MULTILINE)
FURTHER = re.findall(r"^- `([^`]+)`, line `([^`]+)`:", PAGE, re.MULTILINE)


def test_the_walk_has_ten_stops() -> None:
    assert len(STOPS) == 10
    assert len(FURTHER) == 4


@pytest.mark.parametrize(("file", "line"), [*STOPS, *FURTHER])
def test_a_stop_is_one_line_of_its_file(file: str, line: str) -> None:
    lines = (ROOT / file).read_text(encoding="utf-8").splitlines()
    assert len([each for each in lines if each.strip().startswith(line)]) == 1
