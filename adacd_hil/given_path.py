"""Additions to click for both command lines: checked names and paths, and command lists with whole summaries.

`GivenName`, `GivenPath` and `WrittenPath` refuse names and paths, before any work, that click lets pass.
"""

import os
from pathlib import Path
from typing import Any

import click

from adacd_hil.file_replacement import dangling_link


class GivenName(click.types.StringParamType):
    """A text that isn't empty."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the text. Raises click.BadParameter for an empty one."""
        if value == "":
            self.fail("the name is empty", param, ctx)
        return super().convert(value, param, ctx)


class GivenPath(click.Path):
    """A path with a name: click takes the empty path, as of an unset variable, for the working directory."""

    def __init__(self, *, file_okay: bool = True, dir_okay: bool = True) -> None:
        super().__init__(path_type=Path, file_okay=file_okay, dir_okay=dir_okay)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return a path as `click.Path` does; refuse an empty name, too.

        Raises click.BadParameter for a refused path.
        """
        if value == "":
            self.fail("the name is empty", param, ctx)
        return super().convert(value, param, ctx)


GIVEN_FILE = GivenPath(dir_okay=False)


class WrittenPath(GivenPath):
    """A path to write to: refused if a folder of it would have to be made at a link without a target."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return a path as `GivenPath` does; refuse a link without a target among the folders above it.

        A path that may be a folder is refused, too, if it is such a link itself; a file would replace the link. Raises
        click.BadParameter for a refused path.
        """
        path = Path(super().convert(value, param, ctx))
        link = dangling_link(path if self.dir_okay else path.parent)  # a file would replace the link
        if link is not None:
            self.fail(f"link {link} leads to {os.fsdecode(link.readlink())}, which is not there", param, ctx)
        return path


WRITTEN_FILE = WrittenPath(dir_okay=False)
WRITTEN_FOLDER = WrittenPath(file_okay=False)


class CommandGroup(click.Group):
    """A group of commands that lists whole summaries, folded; click cuts them to one line."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands that aren't hidden, each with its whole summary, into the help."""
        named = [(name, self.commands[name]) for name in self.list_commands(ctx)]
        with formatter.section("Commands"):
            formatter.write_dl(
                [(name, command.get_short_help_str(_LONGEST)) for name, command in named if not command.hidden]
            )


_LONGEST = 1000
