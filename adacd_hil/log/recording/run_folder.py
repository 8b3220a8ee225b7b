"""Check and preparation of the folder of a new log: it replaces no log but that of a start that failed.

The log of a start that failed before the first cycle is moved aside, so that the user can repeat the command.
"""

import itertools
from pathlib import Path
from typing import IO, Any

from mcap.opcode import Opcode

from adacd_hil.file_access import InUseError, check_unused, open_input
from adacd_hil.log.log_files import (
    CLOSED,
    ENDING_KEY,
    RUN_METADATA,
    SUFFIX,
    SUMMARY_METADATA,
    LogError,
    LogExistsError,
    failing_as,
    find_parts,
)

_FAILED_NAME = f"failed-start-{{}}{SUFFIX}"


def check_free(path: Path) -> None:
    """Raise LogExistsError if a log `path`, or a part of it, exists; not if it is the log of a start that failed.

    Raise LogError if that can't be examined. Changes no file.
    """
    if is_taken(path) and not _is_failed_start(path):
        raise _refusal(path)


def make_room(path: Path) -> None:
    """Rename the log of a start that failed, so that `path` is free; do nothing if it is free already.

    Raises LogExistsError for any other log at `path`, LogError if it can't be renamed or examined.
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

    Raises LogExistsError if a folder of the path is a file, LogError if the folder can't be read.
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
    """Return the error for a log `path` that is taken; it names the file in the way."""
    found = path if is_there(path) else next(iter(find_parts(path).values()))
    kind = "" if found.is_file() and not found.is_symlink() else ", which is no regular file"
    return LogExistsError(f"{found} is there already{kind}; choose another folder with --out, or move it away")


def _is_failed_start(path: Path) -> bool:
    """Return whether a log has one part only, which has no message, or has ended properly without a cycle.

    False for a log that can't be read. Raises LogExistsError if it is being written.
    """
    try:
        check_unused(path)
    except InUseError as error:
        raise LogExistsError(f"{error}; choose another folder with --out") from None
    if path.is_symlink() or not path.is_file() or list(find_parts(path)) != [0]:
        return False
    try:
        with open_input(path) as file:
            return _has_no_cycle(file)
    except (LogError, OSError):
        return False


def _has_no_cycle(file: IO[bytes]) -> bool:
    """Return whether a log of ours, a run's or an emulator's, has ended properly without a cycle, or has no message.

    False for a file without a summary, or one that isn't ours. Raises LogError for an invalid record.
    """
    # Only needed for an existing log, and slow to import.
    from adacd_hil.log.mcap.mcap_records import parse, read_end, read_record
    from adacd_hil.log.types.topics import CYCLE
    from adacd_hil.log.types.truth_topic import TRUTH

    end = read_end(file)
    kinds: dict[int, list[Any]] = {Opcode.STATISTICS: [], Opcode.CHANNEL: [], Opcode.METADATA_INDEX: []}
    for record in () if end is None else end.summary:
        if record.opcode in kinds:
            kinds[record.opcode].append(parse(record.opcode, record.body))
    if not kinds[Opcode.STATISTICS]:
        return False
    found = (read_record(file, index.offset).body for index in kinds[Opcode.METADATA_INDEX])
    metadata = {each.name: each.metadata for each in (parse(Opcode.METADATA, body) for body in found)}
    counts = kinds[Opcode.STATISTICS][0].channel_message_counts
    of_cycles = (channel for channel in kinds[Opcode.CHANNEL] if channel.topic in (CYCLE.name, TRUTH.name))
    cycles = sum(counts.get(channel.id, 0) for channel in of_cycles)
    is_closed = metadata.get(SUMMARY_METADATA, {}).get(ENDING_KEY) == CLOSED
    return bool(metadata.get(RUN_METADATA)) and ((is_closed and not cycles) or not sum(counts.values()))
