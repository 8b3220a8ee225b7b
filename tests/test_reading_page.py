"""The page that walks one torque frame through the code names files and lines that are there."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
STOPS = re.findall(r"^\d+\. `([^`]+)`, line `([^`]+)`:", (ROOT / "docs" / "reading.md").read_text(), re.MULTILINE)


def test_the_walk_has_ten_stops() -> None:
    assert len(STOPS) == 10


@pytest.mark.parametrize(("file", "line"), STOPS)
def test_a_stop_is_one_line_of_its_file(file: str, line: str) -> None:
    lines = (ROOT / file).read_text(encoding="utf-8").splitlines()
    assert len([each for each in lines if each.strip().startswith(line)]) == 1
