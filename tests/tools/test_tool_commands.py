"""Each instrument says with --help what it does, uses public names only, and names modules and files that exist."""

import ast
import contextlib
import importlib.util
import io
import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

import mutate
import pytest
from tool_files import PROGRAMS, PYTHON_TOOLS, ROOT

PATH = re.compile(r"(?<![\w/.])(?:adacd_hil|firmware_sim|tests|tools|docs|dbc)/[\w/-]+\.(?:py|md|c|toml|dbc)")
PRIVATE = re.compile(
    r"(?<!\bself)(?<!\bcls)(?<!\bos)\._(?!asdict|replace|fields|make)[A-Za-z]\w*|import (?:\([^)]*|.*)\b_[A-Za-z]\w*"
)
"""A private name of another module or object, imported, taken or patched by its path; not that of a named tuple."""


@pytest.mark.slow
@pytest.mark.parametrize("tool", PROGRAMS, ids=lambda path: path.name)
def test_a_tool_says_what_it_does_and_does_nothing_else(
    tool: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    if tool in PYTHON_TOOLS:
        status, said = help_of(tool, monkeypatch)
    else:
        done = subprocess.run([tool, "--help"], capture_output=True, text=True, check=False)
        status, said = done.returncode, done.stdout
    assert (status, len(said.split()) > 8) == (0, True)
    assert list(tmp_path.iterdir()) == []


def help_of(tool: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[object, str]:
    """Run a tool in this process, where what it imports is there already; return exit status and output."""
    monkeypatch.setattr(sys, "argv", [str(tool), "--help"])
    monkeypatch.setattr(sys, "path", [str(tool.parent), *sys.path])
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        try:
            runpy.run_path(str(tool), run_name="__main__")
        except SystemExit as ended:
            return ended.code, said.getvalue()
    return "it did not end", said.getvalue()


def dotted_names(tool: Path) -> set[str]:
    """Return the modules and names of the product that a tool holds as text, such as what it patches."""
    constants = (node for node in ast.walk(ast.parse(tool.read_text())) if isinstance(node, ast.Constant))
    texts = [node.value for node in constants if isinstance(node.value, str)]
    return {text for text in texts if re.fullmatch(r"(adacd_hil|firmware_sim)(\.\w+)+", text)}


def exists(dotted: str) -> bool:
    """Tell whether a dotted name is a module, or a name in one."""
    parent, _, name = dotted.rpartition(".")
    with contextlib.suppress(ModuleNotFoundError):
        if importlib.util.find_spec(dotted) is not None:
            return True
    return hasattr(importlib.import_module(parent), name)


@pytest.mark.parametrize("tool", PYTHON_TOOLS, ids=lambda path: path.name)
def test_modules_and_paths_that_a_tool_names_exist(tool: Path) -> None:
    assert [name for name in sorted(dotted_names(tool)) if not exists(name)] == []
    text = tool.read_text(encoding="utf-8")
    assert [path for path in dict.fromkeys(PATH.findall(text)) if not (ROOT / path).exists()] == []


@pytest.mark.parametrize("tool", PYTHON_TOOLS, ids=lambda path: path.name)
def test_a_tool_uses_public_names_only(tool: Path) -> None:
    assert PRIVATE.findall(tool.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(("module", "patterns"), mutate.TARGETS.items())
def test_what_is_mutated_exists_and_has_its_tests(module: str, patterns: tuple[str, ...]) -> None:
    assert (ROOT / module).is_file()
    assert [pattern for pattern in patterns if not list(ROOT.glob(pattern))] == []


def test_changes_listed_as_equivalent_are_of_text_that_stands_in_a_file_that_is_mutated() -> None:
    listed = tomllib.loads(mutate.EQUIVALENT.read_text())["equivalent"]
    gone = [
        f"{entry['file']}: {entry['before']}"
        for entry in listed
        if entry["file"] not in mutate.TARGETS or not stands_in(entry["before"], ROOT / entry["file"])
    ]
    assert gone == []


def stands_in(line: str, path: Path) -> bool:
    """Tell whether a line stands in a file, however the file breaks it."""
    return "".join(line.split()) in "".join(path.read_text(encoding="utf-8").split())
