"""What `run` names before it looks for an arm."""

from typing import NoReturn

import pytest
from called import called

from adacd_hil.cli.commands import run_command
from adacd_hil.cli.output import CommandError


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
def test_a_run_names_at_once_what_nobody_has_confirmed(assumed, line, tmp_path, monkeypatch):
    monkeypatch.setattr(run_command, "Session", NoSession)
    config = tmp_path / "mine.toml"
    config.write_text(f'extends = "certified"\nname = "mine"\nassumed = {assumed}\n')
    done = called("run", "-i", "virtual", "-c", "x", "--config", config, "--out", tmp_path / "run")
    warnings = [] if line is None else [f"warning: unconfirmed guesses: {line}"]
    assert (done.exit_code, done.stderr.splitlines()) == (1, [*warnings, "adacd-hil: no arm"])
