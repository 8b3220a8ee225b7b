"""The README's three ways to begin, played from its text as `tools/first_hour.py` plays them, in short.

Nothing is installed and nothing is on a bus: `.venv` leads to this process's own programs, demos last some seconds, and
commands that need `can0`, or a guest for one, are looked at only: what they read must be there by then.
"""

import os
import re
import sys
from pathlib import Path

import first_hour
import pytest
from documents import ROOT
from first_hour import Played, Step, Way, judge, play, read_way
from long_cases import long_but

pytestmark = pytest.mark.slow

SHORT = """
lasts_s = {lasts_s}
contacts = [{{ at_s = {touched_s}, link = 2, point_m = 0.2, force_N = 20.0, duration_s = 0.1 }}]
"""
LASTS_S = {"see": 1.0, "recordings": 10.3, "arm": 1.0}
"""How long demos last: for `identify` the README takes the first 9 s, in which nobody touches the arm."""
PROGRAMS = {
    "adacd-hil": "from adacd_hil.cli.start_host import start_host as start",
    "firmware-sim": "from firmware_sim.cli.start_emulator import start_emulator as start",
}
NOT_HERE = {
    r"-c can0|tools/with-vcan |report runs/vcan": "needs a bus",
    r"make test": "it is what runs this test",
    r"--rehearse": "plays the whole experiment",
    r"--scenario blow-chest|--truth": "played by the tests of scenarios and truths",
}
MADE_ON_A_BUS = {
    r"adacd-hil tare ": ("tare.toml", "short.toml"),
    r"--out runs/today": ("runs/today", "demo"),
    r"--out runs/vcan": ("runs/vcan", "demo"),
}
"""What commands that are not typed leave for later ones, and what stands for it."""


def newcomer_folder(folder: Path, lasts_s: float) -> dict[str, str]:
    """Make a folder that looks like a clone after `make install`; return the environment of its programs."""
    for path in ROOT.iterdir():
        if path.name not in (".git", ".venv", "runs"):
            (folder / path.name).symlink_to(path)
    programs = folder / ".venv" / "bin"
    programs.mkdir(parents=True)
    for name, line in PROGRAMS.items():
        (programs / name).write_text(f"#!{sys.executable}\n{line}\nif __name__ == '__main__':\n    start()\n")
    (programs / "python").write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    for path in programs.iterdir():
        path.chmod(0o755)
    (folder / ".venv" / ".run").touch()
    (folder / "short.toml").write_text(SHORT.format(lasts_s=lasts_s, touched_s=0.9 * lasts_s))
    return {**os.environ, "PYTHONPATH": str(ROOT), "ADACD_HIL_DEMO_SCENARIO": str(folder / "short.toml")}


def not_typed_here(text: str, folder: Path) -> str:
    """Say why a command is not typed, and leave what it would have made."""
    why = next((why for pattern, why in NOT_HERE.items() if re.search(pattern, text)), first_hour.not_typed(text))
    for made in [made for pattern, made in MADE_ON_A_BUS.items() if why and re.search(pattern, text)]:
        (folder / made[0]).symlink_to(made[1])
    return why


@pytest.mark.parametrize("name", long_but(2, ("arm", "recordings", "see")))  # the demo has tests of its own
def test_a_newcomer_gets_there_by_the_text_alone(name: str, tmp_path: Path) -> None:
    way = read_way(name)
    play(way, tmp_path, newcomer_folder(tmp_path, LASTS_S[name]), lambda text: not_typed_here(text, tmp_path))
    assert way.complaints == []
    assert sum(step.status is not None for step in way.played) >= 4


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (".venv/bin/adacd-hil replay no-such-run.mcap", "no-such-run.mcap"),
        ("grep x no-such-file", "No such file"),
        (".venv/bin/adacd-hil demo", "not found"),
    ],
)
def test_what_a_newcomer_can_not_type_is_a_complaint(text: str, said: str, tmp_path: Path) -> None:
    way = Way("x", [Step("x.md", text)], 0, [])
    play(way, tmp_path, dict(os.environ), lambda _: "")
    (complaint,) = way.complaints
    assert said in complaint


@pytest.mark.parametrize(
    ("text", "status", "said", "is_good"),
    [
        ("doctor", 1, "ok       load\n\x1b[31mFAILED\x1b[0m   rate   SYNC 594/s of 1000\n", True),
        ("doctor", 1, "FAILED   rate   SYNC 594/s\nFAILED   rate: see `commtest`\n", True),
        ("doctor", 1, "FAILED   rate   SYNC 594/s\nFAILED   nodes   Drive2 is silent\n", False),
        ("commtest", 1, "not sufficient: 8 % of the periods\n", True),
        ("commtest", 5, "not sufficient: 8 % of the periods\n", False),
        ("demo --truth wrong-sign", 4, "", True),
        ("demo --truth wrong-sign", 0, "", False),
        ("demo", 4, "", False),
    ],
)
def test_only_a_late_machine_and_a_mistake_that_is_shown_may_end_otherwise(
    text: str, status: int, said: str, is_good: bool
) -> None:
    step = Played("x.md", text, status)
    judge(step, said)
    assert step.is_good == is_good
