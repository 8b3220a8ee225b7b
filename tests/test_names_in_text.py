"""Names in docstrings, comments and the pages on the code exist in the code: identifiers in backticks, and modules."""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))
import prose

ROOT = Path(__file__).resolve().parents[1]
TOPS = ("adacd_hil", "firmware_sim", "tools")
PAGES = ("docs/overview.md", "docs/adding-things.md", "docs/api.md", "CONTRIBUTING.md")
DATA = (
    "pyproject.toml",
    "adacd_hil/**/*.toml",
    "firmware_sim/**/*.toml",
    "dbc/*",
    "adacd_hil/**/*.js",
    "adacd_hil/**/*.html",
)
ELSEWHERE = {
    *("position_NAME", "velocity_NAME", "effort_NAME"),  # NAME stands for a joint's
    *("can_logger", "can_logconvert", "duckdb"),
    *("some/module.py", "some/test.py", "Coverage.py"),
    *("amr", "Kx"),  # mistyped names
}
"""Placeholders, names of other programs, and examples of mistakes."""
_NAME = re.compile(r"`([A-Za-z_]\w*(?:\.(?!py`|md`)[A-Za-z_]\w*)*)(?:\(\))?`")
_MODULE = re.compile(r"(?<![\w/.-])((?:[\w-]+/)*[\w-]+\.py)\b")
_NUMBERED = re.compile(r"_\d+(_|$)")
"""A column made of a field and a number, such as `tau_J_1`."""


def code_words(source: str) -> set[str]:
    """Return all words of a source outside of its docstrings and comments."""
    lines = source.split("\n")
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Expr(value=ast.Constant(value=str())):
                lines[node.lineno - 1 : node.end_lineno] = [""] * (node.end_lineno - node.lineno + 1)
    code = (line.split("  # ")[0] for line in lines if not line.lstrip().startswith("#"))
    return {word for line in code for word in re.findall(r"\w+", line)}


def stale_names(text: str, words: set[str], modules: list[str]) -> Iterator[str]:
    """Yield the names in a text that the code doesn't have; `_x` may be the end of a name."""
    for found in _NAME.finditer(text):
        parts = found[1].split(".")
        if not all(
            p in words or _NUMBERED.search(p) or (p[0] == "_" and any(word.endswith(p) for word in words))
            for p in parts
        ):
            yield found[1]
    for found in _MODULE.finditer(text):
        if not any(path == found[1] or path.endswith(f"/{found[1]}") for path in modules):
            yield found[1]


@pytest.fixture(scope="module")
def sources() -> dict[Path, str]:
    return {path: path.read_text() for top in TOPS for path in sorted((ROOT / top).rglob("*.py"))}


@pytest.fixture(scope="module")
def words(sources: dict[Path, str]) -> set[str]:
    found = {word for source in sources.values() for word in code_words(source)}
    for pattern in DATA:
        for path in ROOT.glob(pattern):
            found |= {*re.findall(r"\w+", path.read_text(errors="replace")), path.parent.name}
    names = [path.relative_to(ROOT) for path in sources]
    return found | {word for path in names for word in (*path.parts, path.stem)}


@pytest.mark.slow
def test_a_name_in_a_text_is_one_of_the_code(sources: dict[Path, str], words: set[str]) -> None:
    modules = [
        str(path.relative_to(ROOT)) for path in [*sources, *ROOT.glob("tests/**/*.py"), *ROOT.glob("docs/**/*.py")]
    ]
    texts = [(path, line, text) for path, source in sources.items() for line, text in prose.prose(source)]
    texts += [(ROOT / page, 1, (ROOT / page).read_text()) for page in PAGES]
    stale = [
        f"{path.relative_to(ROOT)}:{line}: {name}"
        for path, line, text in texts
        for name in stale_names(text, words, modules)
        if name not in ELSEWHERE
    ]
    assert not stale, "\n".join(stale)
