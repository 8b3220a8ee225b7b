"""A program's first moments: Ctrl-C while it still imports ends it without a traceback."""

import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

SCRIPTS = tomllib.loads((Path(__file__).parent.parent / "pyproject.toml").read_text())["project"]["scripts"]
INTERRUPT = """
import importlib, signal, sys
module, function = sys.argv[1].split(":")
place, sys.argv[1:] = sys.argv[2], ["--version"]
class Interrupting:
    def find_spec(self, name, path, target=None):
        if name == place:
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Interrupting())
getattr(importlib.import_module(module), function)()
"""
ENDS = {"adacd-hil": (130, b"adacd-hil: interrupted\n"), "firmware-sim": (0, b"")}


def interrupted(program: str, place: str, **given: object) -> "subprocess.CompletedProcess[bytes]":
    """Start a program as its console script does, with a Ctrl-C when it imports a module."""
    command = [sys.executable, "-c", INTERRUPT, SCRIPTS[program], place]
    return subprocess.run(command, capture_output=True, check=False, **given)  # type: ignore[call-overload,no-any-return]


@pytest.mark.slow
@pytest.mark.parametrize("place", ["MAIN", "click", "adacd_hil.terminal", "importlib.metadata"])
@pytest.mark.parametrize("program", ENDS)
def test_ctrl_c_during_imports_ends_as_later(program: str, place: str) -> None:
    main = {"adacd-hil": "adacd_hil.cli.main", "firmware-sim": "firmware_sim.cli.emulator_main"}[program]
    done = interrupted(program, place.replace("MAIN", main))
    assert (done.returncode, done.stdout, done.stderr) == (ENDS[program][0], b"", ENDS[program][1])


IMPORT_ERROR = """
import sys
from adacd_hil.cli.main import main
class Failing:
    def find_spec(self, name, path, target=None):
        if name == "numpy":
            try:
                raise {cause}
            except BaseException as error:
                raise ImportError("initialization failed") from error
sys.meta_path.insert(0, Failing())
sys.argv[1:] = ["config", "docs", "arm"]
main()
"""


@pytest.mark.slow
def test_ctrl_c_that_an_import_turns_into_an_error_ends_as_any_other() -> None:
    for cause, status in (("KeyboardInterrupt", 130), ("ValueError", 1)):
        command = [sys.executable, "-c", IMPORT_ERROR.format(cause=cause)]
        done = subprocess.run(command, capture_output=True, check=False)
        assert done.returncode == status
        assert (done.stderr == b"adacd-hil: interrupted\n") == (status == 130)


@pytest.mark.slow
def test_ctrl_c_is_ignored_where_it_was() -> None:
    done = interrupted(
        "adacd-hil", "adacd_hil.terminal", preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN)
    )
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.startswith(b"adacd-hil, version ")
