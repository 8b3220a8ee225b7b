"""What is said to install an extra can be typed as it stands."""

import re
import shlex
import sys
import tomllib
from pathlib import Path

import pytest

from adacd_hil import extras
from adacd_hil.extras import install_command

ROOT = Path(__file__).resolve().parent.parent


def test_in_a_clone_it_is_the_line_of_the_documents(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "executable", str(ROOT / ".venv" / "bin" / "python"))
    monkeypatch.setattr(Path, "exists", lambda path: path.name == "pip")
    assert install_command("live") == ".venv/bin/pip install -e '.[live]'"


def test_from_elsewhere_it_names_the_clone_and_a_pip_that_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    program, *words = shlex.split(install_command("sweep"))
    assert Path(program).is_file()
    assert words[-3:] == ["install", "-e", f"{ROOT}[sweep]"]


def test_without_a_source_tree_it_names_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras, "_ROOT", tmp_path)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "bin" / "python"))
    monkeypatch.chdir(tmp_path)
    assert install_command("mf4") == "bin/python -m pip install 'adacd-hil[mf4]'"


def test_every_extra_that_is_named_is_one() -> None:
    known = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = {
        name
        for path in (ROOT / "adacd_hil").rglob("*.py")
        for name in re.findall(r"install_command\(['\"](\w+)", path.read_text())
    }
    assert named == {"live", "sweep", "tables", "mf4"}
    assert named <= set(known)
