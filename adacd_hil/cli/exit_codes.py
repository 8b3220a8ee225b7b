"""How a command ends: by an exit status, the same in every command, and where it fails by one line."""

import functools
import sys
from collections.abc import Callable
from enum import IntEnum
from typing import TYPE_CHECKING, Any

from adacd_hil.file_access import in_words, is_disk_full
from adacd_hil.log.log_files import LogError, LogExistsError
from adacd_hil.records import FaultReason
from adacd_hil.settings.schema import ConfigError
from adacd_hil.terminal import one_line
from adacd_hil.wire.bus import BusError, BusMissingError
from adacd_hil.wire.codec import CodecError

if TYPE_CHECKING:
    from adacd_hil.control.session import SessionSummary  # it compiles: seconds that a command without a run can spare


class ExitCode(IntEnum):
    """Documented exit status."""

    OK = 0
    FAILURE = 1
    USAGE = 2
    PARTIAL = 3
    SAFETY_STOP = 4
    BUS_MISSING = 5
    INTERRUPTED = 130


EPILOG = (
    "Exit status: 0 done; 1 failure (a tare: refused); 2 wrong usage or configuration; 3 partial result (the log lost "
    "something, or a disk is full); 4 safety stop (the run faulted or the arm fell silent); 5 bus or devices missing; "
    "130 interrupted."
)


class CommandError(Exception):
    """Ends a command with one line and an exit code."""

    def __init__(self, line: str, code: ExitCode = ExitCode.FAILURE) -> None:
        super().__init__(line)
        self.code = code


def exit_code(summary: "SessionSummary") -> ExitCode:
    """Choose the exit code of a run; the gravest reason wins."""
    if summary.result is None:
        return ExitCode.SAFETY_STOP if summary.has_started else ExitCode.BUS_MISSING
    if summary.result.fault is not FaultReason.NONE:
        return ExitCode.SAFETY_STOP
    if not summary.log.is_complete:
        return ExitCode.PARTIAL
    return ExitCode.INTERRUPTED if summary.result.is_interrupted else ExitCode.OK


_CODES = (
    (ConfigError, ExitCode.USAGE),
    (CodecError, ExitCode.USAGE),
    (BusMissingError, ExitCode.BUS_MISSING),
    (BusError, ExitCode.SAFETY_STOP),
    (LogExistsError, ExitCode.USAGE),
    (LogError, ExitCode.FAILURE),
    (OSError, ExitCode.FAILURE),
    (MemoryError, ExitCode.FAILURE),
)
_EXPECTED = (KeyboardInterrupt, CommandError, *(kind for kind, _ in _CODES))


def explained(command: Callable[..., ExitCode]) -> Callable[..., None]:
    """Turn what a command raises into one line and its exit code."""

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> None:
        try:
            code = command(*args, **kwargs)
        except _EXPECTED as error:
            code = complain(error)
        sys.exit(code)

    return run


def complain(error: BaseException) -> ExitCode:
    """Say in one line what ended a command; return its exit code."""
    is_interrupted = isinstance(error, KeyboardInterrupt)
    line = "interrupted" if is_interrupted else in_words(error) or type(error).__name__
    print(f"adacd-hil: {one_line(line)}", file=sys.stderr)
    if is_interrupted:
        return ExitCode.INTERRUPTED
    if is_disk_full(error):
        return ExitCode.PARTIAL
    if isinstance(error, CommandError):
        return error.code
    return next(code for kind, code in _CODES if isinstance(error, kind))
