"""Commands that another package adds by the entry point `adacd_hil.commands`."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

COMMAND = """
import click

@click.command()
def greet():
    \"\"\"Greet the arm.\"\"\"
    click.echo("hello, arm")

COMMANDS = (greet,)
"""


def called(folder: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    words = [str(Path(sys.executable).with_name("adacd-hil")), *arguments]
    paths = os.pathsep.join((str(folder), os.environ.get("PYTHONPATH", "")))
    environment = {**os.environ, "PYTHONPATH": paths}
    return subprocess.run(words, capture_output=True, text=True, check=False, env=environment)


def add_package(folder: Path, entry: str) -> None:
    about = folder / "greeting-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: greeting\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[adacd_hil.commands]\ngreeting = {entry}\n")
    (folder / "greeting.py").write_text(COMMAND)


@pytest.mark.slow
def test_a_package_adds_a_command(tmp_path):
    add_package(tmp_path, "greeting:COMMANDS")
    done = called(tmp_path, "greet")
    assert (done.returncode, done.stdout, done.stderr) == (0, "hello, arm\n", "")


@pytest.mark.slow
@pytest.mark.parametrize("entry", ["no_greeting:COMMANDS", "greeting:NONE"])
def test_commands_that_can_t_be_imported_are_named_and_cost_no_others(tmp_path, entry):
    add_package(tmp_path, entry)
    done = called(tmp_path, "run", "--help")
    assert done.returncode == 0
    assert "acknowledge a stop" in done.stdout
    [line] = done.stderr.splitlines()
    assert entry in line
