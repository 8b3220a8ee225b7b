"""The folder of a run: the names in it, and which log a name stands for.

A log is never replaced. The one exception is a start that failed before the first cycle: its log is moved aside, so
that the same command can be given again once the cause is mended.
"""

import itertools
from pathlib import Path

from adacd_hil.log.errors import LogError, LogExistsError
from adacd_hil.log.parts import find_parts
from adacd_hil.output_files import InUseError, check_unused

LOG_NAME = "run.mcap"
"""The host's log."""
TRUTH_NAME = "truth.mcap"
"""The emulator's."""
CONFIG_DIGEST_KEY = "host_config_sha256"
"""Metadata of the emulator's log where the host is in the same process: of its configuration."""
_FAILED_NAME = "failed-start-{}.mcap"


def log_in(given: str | Path) -> Path:
    """Name the log that is meant: a folder stands for the run's log in it."""
    path = Path(given)
    return path / LOG_NAME if path.is_dir() else path


def check_free(path: Path) -> None:
    """Raise LogExistsError where `path` can't be the first part of a new log, LogError where that can't be told."""
    if is_taken(path) and not _is_failed_start(path):
        raise _refusal(path)


def make_room(path: Path) -> None:
    """Move aside the log of a start that failed. Raises LogExistsError for any other log, LogError."""
    check_free(path)
    if not is_taken(path):
        return
    names = (path.with_name(_FAILED_NAME.format(number)) for number in itertools.count(1))
    aside = next(name for name in names if not is_there(name))
    try:
        path.rename(aside)
    except OSError as error:
        raise LogError(f"log {path} of a start that failed can't become {aside.name}: {error.strerror}") from None


def is_taken(path: Path) -> bool:
    """Tell whether anything, a dangling link included, is where a log or one of its parts would be.

    Raises LogExistsError when a folder on the way to it is none, LogError.
    """
    try:
        return is_there(path) or bool(find_parts(path))
    except FileNotFoundError:
        return False
    except NotADirectoryError:  # something else is where its folder would be
        raise LogExistsError(f"log {path} can't be created: Not a directory") from None
    except OSError as error:
        raise LogError(f"log {path} can't be created: {error.strerror}") from None


def is_there(path: Path) -> bool:
    """Tell whether there is anything of that name, a dangling link included."""
    return path.is_symlink() or path.exists()


def _refusal(path: Path) -> LogExistsError:
    found = path if is_there(path) else next(iter(find_parts(path).values()))
    kind = "" if found.is_file() and not found.is_symlink() else ", which is no regular file"
    return LogExistsError(f"{found} is there already{kind}; choose another folder with --out, or move it away")


def _is_failed_start(path: Path) -> bool:
    """Tell whether a log has nothing, or, ended as it should, no cycle.

    Raises LogExistsError for one that is being written.
    """
    try:
        check_unused(path)
    except InUseError as error:
        raise LogExistsError(f"{error}; choose another folder with --out") from None
    if path.is_symlink() or not path.is_file() or list(find_parts(path)) != [0]:
        return False
    from adacd_hil.log.editing.info import read_info  # only where there is something to look at

    try:
        info = read_info(path)
    except LogError:
        return False
    has_no_cycle = info.ending == "closed" and not info.cycles
    return bool(info.metadata) and not info.problems and (has_no_cycle or not info.messages)
