"""Links that lead nowhere are named, and every path of a command is looked at for them."""

import click
import pytest

from adacd_hil.cli.main import cli as host_cli
from adacd_hil.control.history_file import use_history
from adacd_hil.file_replacement import dangling_link
from adacd_hil.given_path import GivenPath
from adacd_hil.settings.schema import ConfigError
from firmware_sim.cli.emulator_main import cli as emulator_cli


def test_a_history_that_a_link_leads_nowhere_for_is_no_first_run(tmp_path):
    link = tmp_path / "arm.toml"
    link.symlink_to("/unmounted/arm.toml")
    with pytest.raises(ConfigError, match=rf"^history {link}: link {link} leads to /unmounted/arm.toml, which is not"):
        use_history(link, 0)


def test_a_link_to_itself_leads_nowhere_and_one_to_a_folder_somewhere(tmp_path):
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "here").symlink_to(".")
    assert dangling_link(tmp_path / "loop" / "x") == tmp_path / "loop"
    assert dangling_link(tmp_path / "here" / "x") is None


@pytest.mark.parametrize("group", [host_cli, emulator_cli], ids=["adacd-hil", "firmware-sim"])
def test_every_path_is_looked_at(group):
    def parameters(command: click.Command) -> list[click.Parameter]:
        below = command.commands.values() if isinstance(command, click.Group) else ()
        return [*command.params, *(each for one in below for each in parameters(one))]

    paths = [one for one in parameters(group) if isinstance(one.type, click.Path)]
    assert paths
    assert [one.name for one in paths if not isinstance(one.type, GivenPath)] == []
