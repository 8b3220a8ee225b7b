"""Bad input to the commands that work on a bus: one line, a documented exit status, nothing on stdout."""

from pathlib import Path
from typing import NoReturn

import pytest
from click.testing import CliRunner

from adacd_hil.cli.commands import run_command
from adacd_hil.cli.main import cli
from adacd_hil.cli.output import CommandError

COMMANDS = ("scan", "commtest", "monitor")


def call(*arguments: str) -> tuple[int, str, list[str]]:
    result = CliRunner().invoke(cli, arguments)
    return result.exit_code, result.stdout, result.stderr.splitlines()


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("-i", "socketcan", "-c", "can77"), "can77"),
        (("-i", "sockecan", "-c", "x"), "did you mean 'socketcan'?"),
        (("-i", "udp_multicast", "-c", "239.0.0.1"), "echoes own frames"),
    ],
)
def test_a_bus_that_cant_be_opened_is_one_line(command: str, arguments: tuple[str, ...], line: str) -> None:
    found, stdout, stderr = call(command, *arguments)
    (complaint,) = stderr
    assert (found, stdout) == (5, "")
    assert line in complaint


@pytest.mark.parametrize("command", [*COMMANDS, "doctor"])
@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("--config", "papper"), "did you mean 'paper'?"),
        (("--config", "none.toml"), "configuration none.toml does not exist"),
        (("--dbc", "none.dbc"), "none.dbc: No such file"),
    ],
)
def test_a_configuration_that_cant_be_used_is_one_line(command: str, arguments: tuple[str, ...], line: str) -> None:
    found, stdout, stderr = call(command, "-i", "virtual", "-c", "x", *arguments)
    (complaint,) = stderr
    assert (found, stdout) == (2, "")
    assert line in complaint


@pytest.mark.parametrize("command", [*COMMANDS, "doctor"])
def test_a_profile_that_does_not_exist_is_usage(command: str) -> None:
    status, stdout, stderr = call(command, "-i", "virtual", "-c", "x", "--profile", "Q")
    assert (status, stdout) == (2, "")
    assert "'Q' is not one of 'P', 'S', 'M'" in stderr[-1]


@pytest.mark.slow
@pytest.mark.parametrize("command", ["scan", "commtest"])
def test_an_empty_bus_ends_with_devices_missing(command: str) -> None:
    status, _, stderr = call(command, "-i", "virtual", "-c", "empty", "--seconds", "0.1")
    assert status == 5
    assert not any("Traceback" in line for line in stderr)


class NoSession:
    """Ends before it looks for an arm."""

    def __init__(self, *_: object, **__: object) -> None:
        pass

    def interrupt(self) -> None:
        pass

    def run(self) -> NoReturn:
        raise CommandError("no arm")


@pytest.mark.parametrize(
    ("assumed", "line"),
    [
        ([], None),
        (["arm.sign"], "`arm.sign`; `adacd-hil doctor` asks for each"),
        (
            ["arm.sign", "arm.joint", "arm.link_length_m", "arm.rated_torque_Nm", "devices.drive1.node", "bus.bitrate"],
            "`arm.sign`, `arm.joint`, `arm.link_length_m`, `arm.rated_torque_Nm` and 2 more; "
            "`adacd-hil config check` names all",
        ),
    ],
)
def test_a_run_names_at_once_what_nobody_has_confirmed(
    assumed: list[str], line: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_command, "Session", NoSession)
    config = tmp_path / "mine.toml"
    config.write_text(f'extends = "certified"\nname = "mine"\nassumed = {assumed}\n')
    out = str(tmp_path / "run")
    status, _, stderr = call("run", "-i", "virtual", "-c", "x", "--config", str(config), "--out", out)
    warnings = [] if line is None else [f"warning: unconfirmed guesses: {line}"]
    assert (status, stderr) == (1, [*warnings, "adacd-hil: no arm"])
