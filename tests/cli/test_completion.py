"""What a shell completes: configurations, scenarios, keys and values of settings, interfaces, run folders."""

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

COMMAND = [sys.executable, "-c", "from adacd_hil.cli.start_host import start_host; start_host()"]
ENOUGH_S = 0.6
"""Of a processor. On an idle one an answer takes 0.1 to 0.25 s; where others compute beside, up to twice that."""


def ask(folder: Path, line: str, shell: str) -> list[str]:
    """Give what the shell is answered when the cursor stands at the end of a line."""
    words = line.split(" ")
    if shell == "bash":
        words = line.replace("=", " = ").split(" ")
    environment = {"_ADACD_HIL_COMPLETE": f"{shell}_complete", "COMP_WORDS": " ".join(words)}
    environment["COMP_CWORD"] = str(len([word for word in words[:-1] if word]) if words[-1] == "" else len(words) - 1)
    done = subprocess.run(
        COMMAND, cwd=folder, env=os.environ | environment, capture_output=True, text=True, check=True, timeout=60
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
def test_an_answer_takes_no_longer_than_a_person_waits(folder):
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    ask(folder, "adacd-hil replay --set reac", "bash")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert (after.ru_utime - before.ru_utime) + (after.ru_stime - before.ru_stime) < ENOUGH_S


@pytest.mark.slow
def test_help_imports_neither_numpy_nor_what_reads_a_bus_or_makes_pages():
    heavy = ("numpy", "can", "canopen", "cantools", "numba", "matplotlib", "jinja2")
    script = (
        "import sys; from adacd_hil.cli.main import cli; cli(['--help'], standalone_mode=False);"
        f"print([name for name in {heavy} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.splitlines()[-1] == "[]"


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
