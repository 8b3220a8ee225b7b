"""Check and preparation of the folder of a new log: it replaces no log but that of a start that failed.

The log of a start that failed before the first cycle is moved aside, so that the user can repeat the command.
"""

import itertools
from pathlib import Path

from adacd_hil.file_access import InUseError, check_unused
from adacd_hil.log.log_files import LogError, LogExistsError, failing_as, find_parts

_FAILED_NAME = "failed-start-{}.mcap"


def check_free(path: Path) -> None:
    """Raise LogExistsError if a log `path` exists, unless its start failed; LogError if that can't be examined."""
    if is_taken(path) and not _is_failed_start(path):
        raise _refusal(path)


def make_room(path: Path) -> None:
    """Rename the log of a start that failed, so that `path` is free.

    Raises LogExistsError for any other log, LogError.
    """
    check_free(path)
    if not is_taken(path):
        return
    names = (path.with_name(_FAILED_NAME.format(number)) for number in itertools.count(1))
    aside = next(name for name in names if not is_there(name))
    with failing_as(f"log {path} of a start that failed can't become {aside.name}"):
        path.rename(aside)


def is_taken(path: Path) -> bool:
    """Return whether any file, a dangling link included, has the name of a log or one of its parts.

    Raises LogExistsError if a folder of the path is a file, LogError.
    """
    try:
        return is_there(path) or bool(find_parts(path))
    except FileNotFoundError:
        return False
    except NotADirectoryError:  # a file has the name of its folder
        raise LogExistsError(f"log {path} can't be created: Not a directory") from None
    except OSError as error:
        raise LogError(f"log {path} can't be created: {error.strerror}") from None


def is_there(path: Path) -> bool:
    """Return whether any file of that name exists, a dangling link included."""
    return path.is_symlink() or path.exists()


def _refusal(path: Path) -> LogExistsError:
    found = path if is_there(path) else next(iter(find_parts(path).values()))
    kind = "" if found.is_file() and not found.is_symlink() else ", which is no regular file"
    return LogExistsError(f"{found} is there already{kind}; choose another folder with --out, or move it away")


def _is_failed_start(path: Path) -> bool:
    """Return whether a log is empty, or has ended properly without a cycle.

    Raises LogExistsError if it is being written.
    """
    try:
        check_unused(path)
    except InUseError as error:
        raise LogExistsError(f"{error}; choose another folder with --out") from None
    if path.is_symlink() or not path.is_file() or list(find_parts(path)) != [0]:
        return False
    from adacd_hil.log.log_info import read_info  # only needed for an existing log

    try:
        info = read_info(path)
    except LogError:
        return False
    has_no_cycle = info.ending == "closed" and not info.cycles
    return bool(info.metadata) and not info.problems and (has_no_cycle or not info.messages)
