"""The files of tools/: instruments, campaigns, and the modules that they are composed of."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2]
TOOLS = ROOT / "tools"


def _is_python(path: Path) -> bool:
    return path.suffix == ".py" or (path.suffix == "" and path.read_bytes().startswith(b"#!/usr/bin/env python"))


def _is_program(path: Path) -> bool:
    """Tell whether a file is run by its name: it has a part for that, or is a script of the shell."""
    if path.suffix == ".py" or _is_python(path):
        return any(
            isinstance(node, ast.If) and "__name__" in ast.unparse(node.test)
            for node in ast.parse(path.read_text(encoding="utf-8")).body
        )
    return path.suffix == ""


_FILES = sorted(path for folder in (TOOLS, TOOLS / "campaigns") for path in folder.iterdir() if path.is_file())
PYTHON_TOOLS = [path for path in _FILES if _is_python(path)]
PROGRAMS = [path for path in _FILES if _is_program(path)]
"""Those that somebody types; others are modules of theirs, C sources, and the guest's init."""
