"""Names in a log stand once, where they are defined: to rename one is to change one line."""

import ast
from pathlib import Path

import pytest

from adacd_hil.log.log_files import CONFIG_NAME, HISTORY_NAME, LOG_NAME, SCENARIO_NAME, TARE_NAME, TRUTH_NAME
from adacd_hil.log.types.topics import RUN_TOPICS
from adacd_hil.log.types.truth_topic import TRUTH

ROOT = Path(__file__).parents[2]
OWN_RULES = {"straightforward.py", "mutations.py"}
"""Tools that write a log of their own, or damage one."""
PRODUCT = ("adacd_hil", "firmware_sim")
FILES = (LOG_NAME, TRUTH_NAME, CONFIG_NAME, TARE_NAME, HISTORY_NAME, SCENARIO_NAME)
TOPICS = tuple(topic.name for topic in (*RUN_TOPICS, TRUTH))


def spelled_out(path: Path, names: tuple[str, ...]) -> list[str]:
    """List the string literals of a file that are one of the names, or one with a field behind a dot."""
    return [
        f"{path.name}:{node.lineno}: {node.value}"
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        if node.value in names or node.value.startswith(tuple(f"{name}." for name in names if name.startswith("/")))
    ]


@pytest.mark.parametrize(
    ("names", "rooms", "homes"),
    [
        # joint_state_bags.py: the topic of other programs' bags, which ROS names
        pytest.param(TOPICS, (*PRODUCT, "tools"), {"topics.py", "truth_topic.py", "joint_state_bags.py"}, id="topics"),
        pytest.param(FILES, PRODUCT, {"log_files.py"}, id="files"),
    ],
)
def test_names_of_a_log_stand_in_one_file(names: tuple[str, ...], rooms: tuple[str, ...], homes: set[str]) -> None:
    files = [path for room in rooms for path in sorted((ROOT / room).rglob("*.py"))]
    assert [each for path in files if path.name not in homes | OWN_RULES for each in spelled_out(path, names)] == []
