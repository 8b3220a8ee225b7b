"""Bad input to the commands that work on a bus: one line, a documented exit status, nothing on stdout."""

import pytest
from click.testing import CliRunner

from adacd_hil.cli.main import cli

COMMANDS = ("scan", "commtest", "monitor")


def call(*arguments: str) -> tuple[int, str, list[str]]:
    result = CliRunner().invoke(cli, arguments)
    return result.exit_code, result.stdout, result.stderr.splitlines()


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    ("arguments", "status", "line"),
    [
        (("-i", "socketcan", "-c", "can77"), 5, "can77"),
        (("-i", "sockecan", "-c", "x"), 5, "did you mean 'socketcan'?"),
        (("-i", "udp_multicast", "-c", "239.0.0.1"), 5, "echoes own frames"),
        (("-i", "virtual", "-c", "x", "--config", "papper"), 2, "did you mean 'paper'?"),
        (("-i", "virtual", "-c", "x", "--dbc", "none.dbc"), 2, "none.dbc: No such file"),
    ],
)
def test_bad_input_is_one_line(command: str, arguments: tuple[str, ...], status: int, line: str) -> None:
    found, stdout, stderr = call(command, *arguments)
    (complaint,) = stderr
    assert (found, stdout) == (status, "")
    assert line in complaint


@pytest.mark.parametrize("command", COMMANDS)
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
