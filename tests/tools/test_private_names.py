"""Instruments use the product's public names: none imports or touches a private one (`_x`) of another module."""

import ast
from pathlib import Path

import pytest
from tool_files import PYTHON_TOOLS

NAMED_TUPLE = {"_asdict", "_replace", "_fields", "_make"}
"""Public in spite of the underscore, which keeps them apart from fields."""
OWNERS = {"self", "cls"}


def private_names(source: str) -> list[str]:
    """List the private names of others in a source: imported, taken from a module or object, patched by its path."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom):
            found += [f"{node.lineno}: {alias.name} of {node.module}" for alias in node.names if is_private(alias.name)]
        if isinstance(node, ast.Attribute) and is_private(node.attr) and node.attr not in NAMED_TUPLE:
            owner = ast.unparse(node.value)
            if owner not in OWNERS and owner != "os":
                found.append(f"{node.lineno}: {owner}.{node.attr}")
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            parts = node.value.split(".")
            is_path = parts[0] in ("adacd_hil", "firmware_sim") and all(part.isidentifier() for part in parts)
            if is_path and any(map(is_private, parts)):
                found.append(f"{node.lineno}: {node.value}")
    return found


def is_private(name: str) -> bool:
    """Tell whether a name begins with one underscore."""
    return name.startswith("_") and not name.startswith("__")


@pytest.mark.parametrize("tool", PYTHON_TOOLS, ids=lambda path: path.name)
def test_a_tool_uses_public_names_only(tool: Path) -> None:
    assert private_names(tool.read_text(encoding="utf-8")) == []
