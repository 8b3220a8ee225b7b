"""Logs of which each must be another run, from the arguments of a command."""

import filecmp
import itertools
from collections.abc import Iterable
from pathlib import Path

from adacd_hil.cli.output import CommandError, ExitCode
from adacd_hil.log.log_parts import log_in


def different_logs(given: Iterable[Path]) -> list[Path]:
    """Return the paths of logs; a folder stands for the run log in it.

    Raises LogError for a folder without one, CommandError if a log is given twice, even as a link or a copy.
    """
    paths = [log_in(each) for each in given]
    for first, second in itertools.combinations(paths, 2):
        if first == second or (first.is_file() and second.is_file() and filecmp.cmp(first, second, shallow=False)):
            line = f"a log is given twice, as {first} and {second}: it is no further evidence"
            raise CommandError(line, ExitCode.USAGE)
    return paths
