"""What the commands' exit statuses mean; the same numbers in every command."""

from enum import IntEnum
from typing import TYPE_CHECKING

from adacd_hil.records import FaultReason

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
