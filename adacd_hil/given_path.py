"""What both command lines have beyond click's: paths with what is wrong with them, and lists of commands uncut.

What is wrong with a path is said before any work: what no `click.Path` looks at.
"""

import os
from pathlib import Path
from typing import Any

import click

from adacd_hil.file_access import dangling_link


class GivenPath(click.Path):
    """A path that has a name: an empty one, as of a variable that isn't set, would be the working directory."""

    def __init__(self, *, file_okay: bool = True, dir_okay: bool = True) -> None:
        super().__init__(path_type=Path, file_okay=file_okay, dir_okay=dir_okay)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Refuse an empty name."""
        if value == "":
            self.fail("the name is empty", param, ctx)
        return super().convert(value, param, ctx)


GIVEN_FILE = GivenPath(dir_okay=False)


class WrittenPath(GivenPath):
    """A path that is written: no link that leads nowhere stands where a folder would have to be made."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Refuse such a link."""
        path = Path(super().convert(value, param, ctx))
        link = dangling_link(path if self.dir_okay else path.parent)  # a file takes the place of a link
        if link is not None:
            self.fail(f"link {link} leads to {os.fsdecode(link.readlink())}, which is not there", param, ctx)
        return path


class CommandGroup(click.Group):
    """Commands whose summaries stand in the list as a whole, folded: click cuts those that a line has no room for."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list."""
        named = [(name, self.commands[name]) for name in self.list_commands(ctx)]
        with formatter.section("Commands"):
            formatter.write_dl(
                [(name, command.get_short_help_str(_LONGEST)) for name, command in named if not command.hidden]
            )


_LONGEST = 1000
