"""What a shell completes: configurations, scenarios, keys and values of settings, interfaces, run folders."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

START = "from adacd_hil.cli.start_host import start_host; start_host()"
COMMAND = [sys.executable, "-c", START]
HEAVY = {"numpy", "scipy", "can", "canopen", "cantools", "numba", "matplotlib", "jinja2", "lz4"}
"""Packages that take longer to import than a person waits for help or an answer."""


def telling(path: Path) -> list[str]:
    """Give the command that also writes the names of the heavy packages it has imported into a file."""
    told = f"open({str(path)!r}, 'w').write(' '.join(sorted({HEAVY!r} & set(sys.modules))))"
    return [sys.executable, "-c", f"import atexit, sys; atexit.register(lambda: {told}); {START}"]


def ask(folder: Path, line: str, shell: str, command: list[str] = COMMAND) -> list[str]:
    """Give what the shell is answered when the cursor stands at the end of a line."""
    words = line.split(" ")
    if shell == "bash":
        words = line.replace("=", " = ").split(" ")
    environment = {"_ADACD_HIL_COMPLETE": f"{shell}_complete", "COMP_WORDS": " ".join(words)}
    environment["COMP_CWORD"] = str(len([word for word in words[:-1] if word]) if words[-1] == "" else len(words) - 1)
    done = subprocess.run(
        command, cwd=folder, env=os.environ | environment, capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stderr == ""
    if shell != "bash":
        return done.stdout.split("\n")[1::3]
    return [row.partition(",")[2] for row in done.stdout.splitlines() if row.startswith("plain,")]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "my-arm.toml").touch()
    (tmp_path / "notes.txt").touch()
    for name in ("2026-11-24T10-00-00", "2026-11-25T10-00-00", "empty"):
        (tmp_path / "runs" / name).mkdir(parents=True)
    for run in tmp_path.glob("runs/2026*"):
        (run / "run.mcap").touch()
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shell", "line", "answer"),
    [
        ("bash", "adacd-hil demo --config ce", ["certified"]),
        ("bash", "adacd-hil demo --config my", ["my-arm.toml"]),
        ("bash", "adacd-hil demo --scenario two-p", ["two-people", "two-pushes-in-a-row"]),
        ("bash", "adacd-hil config check dem", ["demo", "demo_paper"]),
        ("bash", "adacd-hil config docs arm.ca", ["arm.cad_theta"]),
        ("bash", "adacd-hil config docs exc", ["excitation"]),
        ("bash", "adacd-hil replay --set reaction.sta", ["reaction.start="]),
        ("bash", "adacd-hil replay --set reaction.start=", ["desired", "measured"]),
        ("bash", "adacd-hil run -i socketcand", ["socketcand"]),
        ("bash", "adacd-hil report runs/", ["runs/2026-11-25T10-00-00", "runs/2026-11-24T10-00-00"]),
        ("zsh", "adacd-hil replay --set reaction.start=", ["reaction.start=desired", "reaction.start=measured"]),
    ],
)
def test_a_shell_is_answered_and_zsh_gets_key_and_value_in_one_word(folder, shell, line, answer):
    assert ask(folder, line, shell) == answer


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "imported"),
    [
        ("adacd-hil replay --set reac", "numpy"),
        ("adacd-hil report runs/", ""),
        ("adacd-hil demo --scenario two-p", ""),
    ],
)
def test_an_answer_imports_neither_what_reads_a_bus_nor_what_makes_pages(folder, line, imported):
    assert ask(folder, line, "bash", telling(folder / "imported"))
    assert (folder / "imported").read_text() in ("", imported)


@pytest.mark.slow
def test_help_imports_neither_numpy_nor_what_reads_a_bus_or_makes_pages(folder):
    command = [*telling(folder / "imported"), "--help"]
    done = subprocess.run(command, capture_output=True, check=True, timeout=60)
    assert b"Options:" in done.stdout
    assert (folder / "imported").read_text() == ""


@pytest.mark.slow
@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_each_shell_has_a_script(tmp_path, shell):
    environment = os.environ | {"_ADACD_HIL_COMPLETE": f"{shell}_source"}
    done = subprocess.run(
        COMMAND, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True, timeout=60
    )
    assert f"_ADACD_HIL_COMPLETE={shell}_complete" in done.stdout
    # What the templates of click are replaced by must be in them.
    assert ("nospace" in done.stdout) == (shell == "bash")
    assert ("local -a stay" in done.stdout) == (shell == "zsh")
