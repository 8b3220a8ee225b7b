"""What the programs show on a terminal: no line longer than it is wide, colours only where they are wanted."""

import json
import re
from pathlib import Path

import click
import pytest
from long_cases import long_but
from shown_terminal import Shown, show_on_terminal

from adacd_hil.cli.main import cli as host
from adacd_hil.records import Event
from firmware_sim.bench.bench_time import TruthLog
from firmware_sim.cli.emulator_main import cli as emulator

PLAY = """
import importlib, json, sys
from adacd_hil.terminal import open_terminals
open_terminals()
for program, *words in json.loads(sys.argv[1]):
    main = importlib.import_module(program).main
    sys.argv[0] = "/somewhere/bin/adacd-hil"
    try:
        main(words)
    except SystemExit as end:
        print(f"status {end.code}")
"""
COUNT = """
import sys
from adacd_hil import compile_progress
from adacd_hil.progress_lines import Progress
from adacd_hil.settings.schema import ConfigError
from adacd_hil.terminal import open_terminals
from firmware_sim.cli import emulator_main

def compile_slowly(*_, **__):
    for done in range(200):
        for listener in compile_progress._listeners:
            listener(f"compiling, {done} functions so far" + ", of a long name" * 10)
    raise ConfigError("and now it has an arm")

open_terminals()
Progress.COUNT_EVERY_NS = 0
emulator_main.Bench = compile_slowly
emulator_main.main(["run", "-i", "virtual", "-c", "x", "--scenario", "idle"])
"""
HOST, EMULATOR = "adacd_hil.cli.main", "firmware_sim.cli.emulator_main"
CONFIGURATION = """
extends = "certified"
name = "mine"
assumed = ["arm.link_length_m", "arm.rated_torque_Nm"]
"""
COMMANDS = [
    (HOST, "budget"),
    (HOST, "config", "show"),
    (HOST, "config", "check", "mine.toml"),
    (HOST, "config", "docs"),
    (HOST, "config", "docs", "certified"),
    (HOST, "config", "docs", "arm.torque_error_share"),
    (HOST, "log", "info", "truth.mcap"),
    (HOST, "log", "check", "truth.mcap"),
    (HOST, "log", "export", "truth.mcap", "--format", "csv"),
    (HOST, "runs", "."),
    (HOST, "scan", "-i", "virtual", "-c", "empty", "--seconds", "0.1"),
    (HOST, "monitor", "-i", "virtual", "-c", "empty", "--seconds", "0.1"),
    (HOST, "doctor", "-i", "virtual", "-c", "empty", "--config", "mine.toml"),
    (HOST, "replay", "truth.mcap"),
    (HOST, "report", "none.mcap"),
    (HOST, "history", "none.toml"),
    (HOST, "identify", "none.csv"),
    (HOST, "run", "-i", "sockecan", "-c", "x"),
    (HOST, "demo", "--scenario", "bump"),
    (HOST, "sweep", "--vary", "filter.a=1", "--out", "x"),
    (EMULATOR, "list"),
    (EMULATOR, "truths"),
    (EMULATOR, "check", "mine.toml"),
    (EMULATOR, "run", "-i", "socketcan", "-c", "can77"),
]


def commands_of(group: click.Group, program: str) -> list[tuple[str, ...]]:
    """List the words of a program's commands."""
    found: list[tuple[str, ...]] = [(program,)]
    for name, command in group.commands.items():
        below = commands_of(command, name) if isinstance(command, click.Group) else [(name,)]
        found += [(program, *words) for words in below]
    return found


HELPS = [(*words, "--help") for words in (*commands_of(host, HOST), *commands_of(emulator, EMULATOR))]


def play(folder: Path, commands: list[tuple[str, ...]], columns: int, **environment: str) -> Shown:
    """Play commands in a process on a terminal; of each, its output and `status N`."""
    program = f"import os; os.chdir({str(folder)!r})\n{PLAY}"
    return show_on_terminal(program, json.dumps(commands), columns=columns, **environment)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a configuration and a log."""
    made: Path = tmp_path_factory.mktemp("terminal")
    (made / "mine.toml").write_text(CONFIGURATION)
    with TruthLog(made / "truth.mcap", blocking=True) as log:
        log.event(0, Event("info", "run", "begun"))
    return made


MARKED = [(HOST, "doctor", "-i", "virtual", "-c", "empty"), (HOST, "report", "none.mcap")]


@pytest.fixture(scope="module")
def marked(folder: Path) -> Shown:
    """What a terminal with colours shows of `MARKED`."""
    return play(folder, MARKED, 80)


def is_one_word(line: str) -> bool:
    """Whether a line has nothing that could stand in the next one."""
    return len(line.split()) == 1


@pytest.mark.slow
@pytest.mark.parametrize("columns", long_but(1, [40, 80, 60]))  # tables and `fold` are tested at every width
def test_no_line_is_longer_than_the_terminal_and_plain_words_have_no_escape_code(folder, columns):
    shown = play(folder, COMMANDS, columns, NO_COLOR="1")
    assert [line for line in shown.lines if len(line) > columns and not is_one_word(line)] == []
    assert sum(line.startswith("status ") for line in shown.lines) == len(COMMANDS)
    assert "Traceback" not in shown.text
    assert shown.sequences <= {"\x1b[2K"}  # a line in progress is overwritten


@pytest.mark.slow
def test_a_terminal_that_is_dumb_gets_plain_text(folder):
    shown = play(folder, [*MARKED, (HOST, "monitor", "-i", "virtual", "-c", "x", "--once")], 80, TERM="dumb")
    assert "\x1b" not in shown.text
    assert "\r" not in shown.text.replace("\r\n", "")


@pytest.mark.slow
def test_marks_have_a_colour_and_say_the_same_without(folder, marked):
    for mark in ("\x1b[32mok\x1b[0m ", "\x1b[31mFAILED\x1b[0m   nodes ", "\x1b[31madacd-hil:\x1b[0m log none.mcap"):
        assert mark in marked.text
    assert marked.lines == play(folder, MARKED, 80, NO_COLOR="1").lines


@pytest.mark.slow
def test_what_a_check_says_while_it_goes_on_is_gone_when_it_ends(marked):
    assert "scheduler: " in marked.text
    assert [line for line in marked.lines if ": ok" in line or ": skipped" in line] == []
    assert marked.lines[0].startswith("ok       settings ")


@pytest.mark.slow
def test_help_is_whole_on_a_terminal(folder):
    shown = play(folder, HELPS, 60)
    assert [line for line in shown.lines if len(line) > 60 and not is_one_word(line)] == []
    assert shown.lines.count("status 0") == len(HELPS)
    assert [line for line in shown.lines if re.search(r"[a-z,:]\.\.\.$", line)] == []  # cut


@pytest.mark.slow
def test_an_emulator_that_compiles_counts_in_one_line_and_leaves_nothing():
    shown = show_on_terminal(COUNT, NO_COLOR="1")
    written = [piece.removeprefix("\x1b[2K") for line in shown.text.split("\r\n") for piece in line.split("\r")]
    counts = [piece for piece in written if piece.startswith("compiling,")]
    assert len(counts) > 10
    assert {len(count) for count in counts} == {59}
    assert shown.lines == ["firmware-sim: and now it has an arm", ""]
    assert shown.status == 2


SUGGEST = """
from adacd_hil.terminal import open_terminals
open_terminals()
from adacd_hil.cli.output import suggest
suggest("adacd-hil report runs/2026-11-25T10-00-00 --out /srv/reports/of/the/left/arm   # for others",
        "xdg-open x.html",
        "python -c 'a command of many words in one quote is what a shell takes as it is'   # of one piece")
"""


@pytest.mark.slow
def test_a_command_that_may_be_typed_next_can_be_copied_from_a_narrow_terminal():
    shown = show_on_terminal(SUGGEST)
    assert shown.text.startswith("\x1b[1mnext:\x1b[0m ")
    assert shown.lines == [
        "next: adacd-hil report runs/2026-11-25T10-00-00 --out \\",
        "  /srv/reports/of/the/left/arm",
        "      # for others",
        "      xdg-open x.html",
        "      python -c 'a command of many words in one quote is what a shell takes as it is'",
        "      # of one piece",
        "",
    ]
