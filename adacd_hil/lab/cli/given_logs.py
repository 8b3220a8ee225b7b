"""Logs of which each must be another run, from the arguments of a command."""

import filecmp
import itertools
from collections.abc import Iterable
from pathlib import Path

from adacd_hil.cli.output import CommandError, ExitCode
from adacd_hil.log.log_files import PART_KEY
from adacd_hil.log.log_parts import log_in

_EVERY = 100
"""Of so many cycles one is compared."""


def different_logs(given: Iterable[Path]) -> list[Path]:
    """Return the paths of logs; a folder stands for the run log in it.

    Raises LogError for a folder without one or a log that can't be read, CommandError if a log is given twice, even as
    a link or a copy. A recovered or cut one is found if both have some of the same cycles of MONITOR.
    """
    paths = [log_in(each) for each in given]
    for first, second in itertools.combinations(paths, 2):
        if first == second or (first.is_file() and second.is_file() and _have_one_motion(first, second)):
            line = f"a log is given twice, as {first} and {second}: it is no further evidence"
            raise CommandError(line, ExitCode.USAGE)
    return paths


def _have_one_motion(first: Path, second: Path) -> bool:
    """Return whether two files are equal, or are logs of one run with some cycles of MONITOR in both.

    Raises LogError if one can't be read.
    """
    from adacd_hil.log.log_walk import run_metadata

    if filecmp.cmp(first, second, shallow=False):
        return True
    runs = [{key: text for key, text in run_metadata(path).items() if key != PART_KEY} for path in (first, second)]
    return bool(runs[0]) and runs[0] == runs[1] and not _watched(first).isdisjoint(_watched(second))


def _watched(path: Path) -> set[tuple[int, bytes]]:
    """Return pairs of time, ns, and bits of the joint torques, of each cycle in MONITOR that `_EVERY` divides."""
    from adacd_hil.lab.thresholds.free_motion import schemes
    from adacd_hil.log.logged_run import is_armed_in

    found: set[tuple[int, bytes]] = set()
    for scheme in schemes(path, None):
        is_taken = is_armed_in(scheme["state"].reshape(-1)) & (scheme["cycle"].reshape(-1) % _EVERY == 0)
        torques = (torque.tobytes() for torque in scheme["tau_J"][is_taken])
        found |= set(zip(scheme.t_ns[is_taken].tolist(), torques, strict=True))
    return found
